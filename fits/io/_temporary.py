"""Names of temporary files that say which process makes them, and the removal of what dead processes have left.

A name is `.microid-HOST-BOOT-PID-START-RANDOM` with the ending of the file to be. What another process has made is
removed only where it is certain that this process is gone: one of the same start of this machine has no process of
this number and starting time any more; one of an earlier start was last written before this one.
"""

import contextlib
import functools
import hashlib
import os
import re
import secrets
import shutil
import socket
import time
from pathlib import Path

_NAME = re.compile(r"\.microid-([0-9a-f]{8})-([0-9a-f]{8})-(\d{1,10})-(\d{1,20})-[0-9a-f]{16}(\..*)?", re.DOTALL)
# Folders that were looked through: once in a process is enough.
_CLEANED: set[str] = set()


def temporary_name(ending: str = "") -> str:
    """Make a new name for this process's use, with an ending such as `.csv` by which a format is told."""
    host, boot = _machine()
    pid = os.getpid()
    kept = ending if len(ending) <= 12 else ""  # longer ones tell no format
    return f".microid-{host}-{boot}-{pid}-{_started(pid) or 0}-{secrets.token_hex(8)}{kept}"


def is_temporary(name: str) -> bool:
    """Whether a name is one of `temporary_name`, of whatever process."""
    return _NAME.fullmatch(name) is not None


def remove_stale(folder: Path) -> None:
    """Remove this user's temporary files and folders of dead processes of this machine, once for each folder."""
    if str(folder) in _CLEANED or is_temporary(folder.name):
        return
    _CLEANED.add(str(folder))
    # What cannot be seen or removed stays: it is in nobody's way.
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            found = _NAME.fullmatch(entry.name)
            if found is None or not _stale(entry, *found.groups()[:4]):
                continue
            if entry.is_dir(follow_symlinks=False):
                shutil.rmtree(entry.path, ignore_errors=True)
            else:
                with contextlib.suppress(OSError):
                    os.unlink(entry.path)


def _stale(entry: os.DirEntry[str], host: str, boot: str, pid: str, start: str) -> bool:
    try:
        status = entry.stat(follow_symlinks=False)
    except OSError:
        return False
    # Without user numbers, as on Windows, there is also no harmless way to ask for a process.
    if not hasattr(os, "geteuid") or status.st_uid != os.geteuid():
        return False
    here, now = _machine()
    if host != here:
        return False
    if boot != now:
        # Another container on this machine looks like another start of it, but has not written before this start.
        with contextlib.suppress(OSError, ValueError, IndexError):
            uptime_s = float(Path("/proc/uptime").read_text(encoding="ascii").split()[0])
            # A clock that was set right meanwhile must not make a live file look old.
            return status.st_mtime < time.time() - uptime_s - 60
        return False
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):
        pass  # another user's
    # Where it is not certain that the process has ended, it lives.
    return _started(int(pid)) not in (None, int(start)) and int(start) != 0


def _started(pid: int) -> int | None:
    """Starting time of a process in the system's ticks; -1 if it has ended, None where it is not known."""
    try:
        # The second field is a name in brackets, which may hold anything.
        fields = Path(f"/proc/{pid}/stat").read_text("ascii", "replace").rpartition(")")[2].split()
        return -1 if fields[0] in ("Z", "X", "x") else int(fields[19])  # listed, but ended
    except (OSError, ValueError, IndexError):
        return None


@functools.cache
def _machine() -> tuple[str, str]:
    """Digests of this machine, and of its running since the last start, as far as processes see each other."""
    host, boot = [socket.gethostname()], list[str]()
    for parts, path in ((host, "/etc/machine-id"), (boot, "/proc/sys/kernel/random/boot_id")):
        with contextlib.suppress(OSError):
            parts.append(Path(path).read_text(encoding="ascii", errors="replace").strip())
    with contextlib.suppress(OSError):
        boot.append(os.readlink("/proc/self/ns/pid"))
    first, second = (hashlib.sha256("\n".join(parts).encode("utf-8", "replace")) for parts in (host, boot))
    return first.hexdigest()[:8], second.hexdigest()[:8]
