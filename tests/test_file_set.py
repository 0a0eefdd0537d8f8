"""Files that appear together: what may be replaced, what a failure leaves, whose temporary files are removed."""

import os
import re
import shutil
import signal
import socket
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fits import DataError
from fits.cli._common import Terminated, in_sentences
from fits.io._atomic import atomic_write_text
from fits.io._file_set import file_set
from fits.io._temporary import is_temporary, remove_stale, temporary_name

ROOT = Path(__file__).parents[1]


def contents(folder):
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


def write_two(folder, first="first", second="second", model="model"):
    with file_set() as files:
        unfinished, place = files.file(folder / "model.json"), files.folder(folder / "plots")
        for name, text in (("a.txt", first), ("b.txt", second)):
            (place / name).write_text(text)
        unfinished.write_text(model)


def test_files_appear_together_and_folders_in_one_step(tmp_path):
    with file_set() as files:
        unfinished, place = files.file(tmp_path / "model.json"), files.folder(tmp_path / "new" / "below")
        (place / "a.txt").write_text("a")
        unfinished.write_text("model")
        assert all(is_temporary(path.name) for path in tmp_path.iterdir())
    assert contents(tmp_path) == {"model.json": "model", "new/below/a.txt": "a"}
    (tmp_path / "plain").mkdir()
    assert (tmp_path / "new").stat().st_mode == (tmp_path / "plain").stat().st_mode
    with file_set() as files:
        (files.folder(tmp_path / "new" / "below") / "b.txt").write_text("b")
        files.absent(tmp_path / "new" / "below" / "a.txt")
        files.absent(tmp_path / "never")
    assert contents(tmp_path) == {"model.json": "model", "new/below/b.txt": "b"}


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("at", range(3))
def test_a_rename_that_fails_undoes_those_before_it(tmp_path, monkeypatch, old, at):
    if old:
        write_two(tmp_path, "old a", "old b", "old model")
    before = contents(tmp_path)
    count = 0

    def failing(whole):
        def move(*arguments):
            nonlocal count
            count += 1
            if count == min(at, 1 if not old else 2) + 1:
                raise OSError(28, "No space left on device")
            return whole(*arguments)

        return move

    # A new folder is renamed, then the model; in one that is there each file is replaced.
    for name in ("replace", "rename"):
        monkeypatch.setattr(os, name, failing(getattr(os, name)))
    with pytest.raises(DataError, match="No space left"):
        write_two(tmp_path)
    assert contents(tmp_path) == before
    assert (tmp_path / "plots").exists() == old


def refused(words, use):
    """Have a set used in a way that is refused."""

    def whole():
        with file_set() as files:
            use(files)

    with pytest.raises(DataError, match=words) as caught:
        whole()
    assert "\n" not in str(caught.value)
    assert not any(is_temporary(part) for part in re.split(r"[/: ]", str(caught.value)))


def test_what_is_in_the_way_is_found_before_anything_is_renamed(tmp_path):
    write_two(tmp_path)
    before = contents(tmp_path)
    (tmp_path / "plots" / "c.txt").mkdir()

    def three(files):
        place = files.folder(tmp_path / "plots")
        for name in "abc":
            (place / f"{name}.txt").write_text("new")

    refused(r"plots/c\.txt: expected the name of a file to write, found a folder", three)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("same", ["model.json", "plots"])
def test_two_results_for_one_place_are_refused(tmp_path, same):
    def at_once(files):
        files.file(tmp_path / same)
        files.folder(tmp_path / same)

    def in_the_end(files):
        files.file(tmp_path / "plots" / "a.txt").write_text("one")
        (files.folder(tmp_path / "plots") / "a.txt").write_text("other")

    refused("two results would go to this place", at_once)
    (tmp_path / "plots").mkdir()
    refused("two results would go to this place", in_the_end)
    assert contents(tmp_path) == {}


def make_pipe(path):
    os.mkfifo(path)


def make_socket(path):
    with socket.socket(socket.AF_UNIX) as made:
        # Names of sockets are short.
        made.bind(os.path.relpath(path))


def make_device(path):
    try:
        # The numbers of /dev/null.
        os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 3))
    except PermissionError:
        pytest.skip("only the superuser makes devices")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no such files here")
@pytest.mark.parametrize("make", [make_pipe, make_socket, make_device])
def test_nothing_but_regular_files_is_replaced(tmp_path, monkeypatch, make):
    monkeypatch.chdir(tmp_path)
    make(tmp_path / "thing")
    (tmp_path / "link").symlink_to(tmp_path / "thing")
    before = (tmp_path / "thing").stat()
    for name in ("thing", "link"):
        with pytest.raises(DataError, match=f"^{name}: expected a regular file or a new name, found a device"):
            atomic_write_text(name, "text")
    # Also where it comes up only in the end.
    refused("found a device", lambda files: (files.folder(tmp_path) / "thing").write_text("text"))
    after = (tmp_path / "thing").stat()
    assert (after.st_mode, after.st_ino, after.st_rdev) == (before.st_mode, before.st_ino, before.st_rdev)
    assert sorted(os.listdir(tmp_path)) == ["link", "thing"]


@pytest.mark.parametrize(
    ("name", "words"),
    [("", "empty one"), ("n" * 300, "cannot be the name of a file"), ("a\0b", "cannot be the name of a file")],
)
def test_names_that_cannot_be_are_refused_before_the_work(tmp_path, name, words):
    place = name and str(tmp_path / name)
    refused(words, lambda files: files.file(place))
    below = place and os.path.join(place, "below")
    refused("name of a folder", lambda files: files.folder(below))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("what", ["file", "folder"])
def test_a_folder_that_is_removed_meanwhile_is_one_sentence(tmp_path, what):
    def write(files):
        path = files.file(tmp_path / "gone" / "a") if what == "file" else files.folder(tmp_path / "gone") / "a"
        shutil.rmtree(tmp_path / "gone")
        path.write_text("text")

    (tmp_path / "gone").mkdir()
    refused("No such file or directory", write)
    assert list(tmp_path.iterdir()) == []


LIMITED = """
import resource, sys
from pathlib import Path
from fits.io._errors import DataError
from fits.io._file_set import file_set

resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
try:
    with file_set() as files:
        folder = files.folder(sys.argv[1])
        (folder / "small.h").write_text("small")
        (folder / "large.c").write_text("x" * 20_000)
except DataError as error:
    print(error)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no such limit here")
@pytest.mark.parametrize("old", [False, True])
def test_what_does_not_fit_leaves_the_old_set(tmp_path, old):
    target = tmp_path / "code"
    if old:
        target.mkdir()
        (target / "small.h").write_text("old")
    before = contents(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, target],
        capture_output=True, text=True, check=True, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert "File too large" in done.stdout
    assert done.stdout.count("\n") == 1
    assert contents(tmp_path) == before
    assert target.exists() == old


@pytest.fixture
def ended():
    """Number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def named(**changes):
    """A temporary name of this process, but for some of its parts."""
    parts = dict(zip(("host", "boot", "pid", "start", "word"), temporary_name().split("-")[1:], strict=True))
    return ".microid-" + "-".join(str(changes.get(key, part)) for key, part in parts.items()) + ".json"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="a process is known by its starting time on Linux")
def test_only_what_dead_processes_of_this_machine_left_is_removed(tmp_path, ended):
    sleeping = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"])
    try:
        began = int(Path(f"/proc/{sleeping.pid}/stat").read_text().rpartition(")")[2].split()[19])
        long_ago = time.time() - 1e9
        stay = [
            (named(), None),
            (named(pid=sleeping.pid, start=began), None),
            (named(pid=ended, host="0" * 8), None),
            (named(pid=ended, host="0" * 8), long_ago),
            # Another container, perhaps.
            (named(pid=ended, boot="0" * 8), None),
            (".hidden", None),
            (".microid-abcdefgh", None),
            ("a.json", None),
        ]
        go = [
            (named(pid=ended), None),
            # The number was used again.
            (named(pid=sleeping.pid, start=began - 1), None),
            (named(boot="0" * 8), long_ago),
        ]
        for name, written in [*stay, *go]:
            (tmp_path / name).write_text("")
            if written:
                os.utime(tmp_path / name, (written, written))
        folder = tmp_path / named(pid=ended).removesuffix(".json")
        (folder / "below").mkdir(parents=True)
        remove_stale(tmp_path)
        assert sorted(os.listdir(tmp_path)) == sorted(name for name, _ in stay)
    finally:
        sleeping.kill()
        sleeping.wait()


@pytest.mark.skipif(not Path("/proc/self/stat").exists() or os.geteuid() != 0, reason="needs the superuser")
def test_what_another_user_left_stays(tmp_path, ended):
    name = named(pid=ended)
    (tmp_path / name).write_text("")
    os.chown(tmp_path / name, 12345, -1)
    remove_stale(tmp_path)
    assert (tmp_path / name).exists()


@pytest.mark.skipif(not shutil.rmtree.avoids_symlink_attacks, reason="folders are not opened here to be removed")
def test_an_interruption_is_told_though_a_folder_was_being_closed(tmp_path, monkeypatch, capsys):
    """`shutil.rmtree` closes a folder again where the signal comes just after it was closed."""
    close = os.close

    def interrupted(number):
        close(number)
        monkeypatch.undo()
        raise Terminated(signal.SIGTERM)

    @in_sentences
    def work(_given):
        with file_set() as files:
            (files.folder(tmp_path / "plots") / "a.json").write_text("a")
            monkeypatch.setattr(os, "close", interrupted)
            shutil.rmtree(files.folder(tmp_path / "others"))

    with pytest.raises(SystemExit) as end:
        work()
    assert end.value.code == 128 + signal.SIGTERM
    assert capsys.readouterr().err == "Terminated: no unfinished file was left.\n"
    assert not any(tmp_path.iterdir())


LOST = """
import signal, sys, time
from fits.cli._common import heed_signals, in_sentences

class Noisy:
    def __del__(self):
        print("inside", flush=True)
        for _ in range(10**9):
            time.sleep(0.01)

@in_sentences
def work(_given):
    print("begin", flush=True)
    Noisy()
    time.sleep(1000)

# A session without a terminal may have left them ignored.
for number in (signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.SIG_DFL)
heed_signals()
work()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there are no such signals here")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_request_to_end_is_not_lost_in_a_finaliser(number):
    process = subprocess.Popen(
        [sys.executable, "-c", LOST],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert [process.stdout.readline() for _ in range(2)] == ["begin\n", "inside\n"]
    process.send_signal(number)
    try:
        _, stderr = process.communicate(timeout=60)
    finally:
        process.kill()
    assert (process.returncode, stderr) == (128 + number, "Terminated: no unfinished file was left.\n")


def test_names_tell_formats_and_fit(tmp_path):
    assert Path(temporary_name(".png")).suffix == ".png"
    assert re.fullmatch(r"\.microid-[0-9a-f]{8}-[0-9a-f]{8}-\d+-\d+-[0-9a-f]{16}", temporary_name("." + "x" * 200))
    assert not is_temporary("model.json")
