"""JAX as the command needs it: double precision, and compiled functions kept between calls."""

import itertools
import logging
import os
import stat
from contextlib import suppress
from pathlib import Path

import click
import jax

from fits.io._errors import DataError
from fits.io._kept import keep_in

# A first run spends most of its time compiling. With these flags it takes half as long, and what is compiled is as
# fast, within 15 %, for all but loops that take less than a millisecond.
_QUICK_TO_COMPILE = {
    "xla_cpu_parallel_codegen_split_count": "1",
    "xla_backend_optimization_level": "1",
}
# XLA ends the process at a flag it does not know, and jaxlib 0.11 has no other emitters any more.
if jax.__version_info__ < (0, 11):
    _QUICK_TO_COMPILE["xla_cpu_use_fusion_emitters"] = "false"


def start_jax(accelerator: bool = False) -> None:
    """Configure JAX before any computation; a `DataError` if others can write to the folder MICROID_CACHE names.

    It runs on the CPU unless `accelerator`, or JAX_PLATFORMS, says otherwise: what is computed for one record is a
    chain of small programs, which a GPU runs no faster and compiles more slowly.
    """
    stated = os.environ.get("XLA_FLAGS", "")
    flags = [f"--{name}={value}" for name, value in _QUICK_TO_COMPILE.items() if f"--{name}=" not in stated]
    os.environ["XLA_FLAGS"] = " ".join([*flags, stated])
    jax.config.update("jax_enable_x64", True)
    if not accelerator and not os.environ.get("JAX_PLATFORMS"):
        jax.config.update("jax_platforms", "cpu")
    folder = _cache_folder()
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        # A diagnosis compiles some 300 functions, most of them in a tenth of a second: together they matter.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    keep_in(None if folder is None or accelerator else folder / "traced")
    logging.getLogger(__name__).debug("JAX %s, compiled functions in %s", jax.__version__, folder or "no folder")


def require_float64(what: str) -> None:
    """Raise a `RuntimeError` where JAX is in single precision, in which `what` begins, as `sweeps need`."""
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(f'{what} float64: jax.config.update("jax_enable_x64", True)')


def _cache_folder() -> Path | None:
    """Make the folder for compiled functions; None where there is none or it cannot be written to.

    What is in it runs as the user's own code: one that others can write to is refused if asked for, else not used.
    """
    stated = os.environ.get("MICROID_CACHE")
    if stated in ("", "0", "off"):
        return None
    try:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(stated).expanduser() if stated else Path(base) / "microid" / "jax"
        # The user's alone, whatever new files are by default.
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            return None
        found = _open_to_others(folder)
    except (OSError, RuntimeError):
        return None
    if found is None:
        return folder
    why, remedy = found
    why += ", and what is in it would be run as your own code"
    if stated:
        raise DataError(f"MICROID_CACHE: {why}; {remedy}, or name another folder.")
    click.echo(f"Note: {why}, so nothing is kept; {remedy}, or name another folder in MICROID_CACHE.", err=True)
    return None


def _open_to_others(folder: Path) -> tuple[str, str] | None:
    """Say what of a folder other users could change, and the remedy; None where there is nothing."""
    if not hasattr(os, "geteuid"):
        return None
    real = Path(os.path.realpath(folder))
    for place in {*Path(os.path.abspath(folder)).parents, *real.parents}:
        mode = place.lstat().st_mode
        # Whoever can rename a folder can put another in its place; a sticky one, such as /tmp, forbids that.
        if not stat.S_ISLNK(mode) and mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
            return f"anyone can write to {place}", f"run chmod o-w {place}"
    remedy = f"delete {folder}, which is then made anew for you alone"
    others = stat.S_IWGRP | stat.S_IWOTH
    enterable = real.stat().st_mode & (stat.S_IXGRP | stat.S_IXOTH)
    inside = (os.path.join(above, name) for above, folders, files in os.walk(real) for name in (*folders, *files))
    for path in itertools.chain([str(real)], inside):
        with suppress(FileNotFoundError):  # deleted by another process of the user
            found = os.lstat(path)
            if found.st_uid != os.geteuid():
                return f"{path} belongs to another user", remedy
            loose = found.st_mode & others and not stat.S_ISLNK(found.st_mode)
            if loose and (enterable or path == str(real)):
                return f"other users can write to {path}", remedy
    return None
