"""Commands that are killed, or asked to end, at random moments: nothing is half written, and nothing stays behind."""

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from _command import OFF
from _sweeps import small
from PIL import Image

from fits.io._file_set import usable_folder
from fits.io._temporary import is_temporary

ROOT = Path(__file__).parents[1]
# As many as the study of each command kills; real commands take seconds each.
MOMENTS = int(os.environ.get("MICROID_MOMENTS", 50))
SIGNALS = (signal.SIGKILL, signal.SIGTERM)
# Of a sweep's folder and of the format of its results.
OWN = {".lock", ".zarray", ".zattrs", ".zgroup", ".zmetadata"}
pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no SIGKILL here")

# What every command writes with, without what takes seconds before: one set of files after another.
WRITER = """
import json, sys
from pathlib import Path
from fits.cli._common import heed_signals, in_sentences
from fits.io._file_set import file_set

@in_sentences
def write(given):
    folder, first, rounds = given.folder, given.first, given.rounds
    for number in range(first, first + rounds):
        with file_set() as files:
            model = files.file(folder / "model.json")
            places = [files.folder(folder / "plots"), files.folder(folder / f"new{number % 7}" / "below")]
            for path in (model, *(place / f"{name}.json" for place in places for name in "abc")):
                with open(path, "w") as file:
                    json.dump({"number": number, "ballast": "x" * 5000}, file)
        print(number, flush=True)

heed_signals()
folder, first, rounds = sys.argv[1:]
write(folder=Path(folder), first=int(first), rounds=int(rounds))
"""


# The command, whose diagnosis is made up: the real one takes long, and touches no file.
DIAGNOSE = """
import sys, types
from fits.cli._main import main

def diagnose(*_, **__):
    import numpy as np
    from _diagnosis import diagnosis
    return diagnosis(np.random.default_rng(1))

made_up = types.ModuleType("fits.diagnosis._diagnose")
made_up.diagnose = diagnose
sys.modules[made_up.__name__] = made_up
sys.argv = ["microid", *sys.argv[1:]]
main()
"""


def hidden(folder):
    """What is there under names that a user does not look for."""
    found = [path for path in folder.rglob("*") if path.name.startswith(".") or path.suffix == ".partial"]
    return sorted(str(path.relative_to(folder)) for path in found if path.name not in OWN)


def begin(*arguments, **options):
    command = [sys.executable, *map(str, arguments)]
    paths = os.pathsep.join((str(ROOT), str(ROOT / "tests")))
    env = os.environ | {"PYTHONPATH": paths} | OFF | options.pop("env", {})
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env, **options)


@pytest.mark.parametrize("number", range(6))
@pytest.mark.parametrize("sent", SIGNALS)
def test_files_that_belong_together_are_whole_at_any_moment(tmp_path, rng, sent, number):
    process = begin("-c", WRITER, tmp_path, 1, 10**6)
    assert process.stdout.readline() == "1\n"
    time.sleep(rng.uniform(0, 0.2))
    process.send_signal(sent)
    _, stderr = process.communicate()
    assert process.returncode == (-sent if sent == signal.SIGKILL else 128 + sent), stderr
    found = {
        path.relative_to(tmp_path): json.loads(path.read_text())["number"]
        for path in tmp_path.rglob("[a-z]*.json")
        if not any(part.startswith(".") for part in path.relative_to(tmp_path).parts)
    }
    shown = {path: written for path, written in found.items() if path.parts[0] in ("model.json", "plots")}
    assert len(shown) == 4
    if sent == signal.SIGTERM:
        assert stderr == "Terminated: no unfinished file was left.\n"
        assert hidden(tmp_path) == []
        # All are of one round, which the signal did not stop.
        assert len(set(shown.values())) == 1
    for folder in tmp_path.glob("new*"):
        # A new folder appears with all that is in it.
        names = sorted(path.name for path in (folder / "below").iterdir() if path.suffix)
        assert names == ["a.json", "b.json", "c.json"]
    # The next start removes what is left, and only that.
    assert begin("-c", WRITER, tmp_path, 0, 7).communicate()[1] == ""
    assert hidden(tmp_path) == []
    assert len([path for path in tmp_path.rglob("*") if path.is_file()]) == 4 + 7 * 3


# A class that is told its name wraps what is raised meanwhile in another exception.
IMPORTED = """
import os, time

class Slow:
    def __set_name__(self, owner, name):
        os.kill(os.getpid(), int(os.environ["SENT"]))
        time.sleep(30)

class Named:
    slow = Slow()
"""


@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGINT])
def test_a_request_to_end_during_an_import_ends_in_a_sentence(tmp_path, sent):
    (tmp_path / "imported.py").write_text(IMPORTED)
    # What is started in the background ignores Ctrl-C.
    heeded = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    program = f"{heeded}; from fits.cli._common import heed_signals; heed_signals(); import imported"
    process = begin("-c", program, cwd=tmp_path, env={"SENT": str(int(sent))})
    _, stderr = process.communicate()
    assert process.returncode == 128 + sent
    said = "Terminated" if sent == signal.SIGTERM else "Interrupted"
    assert stderr == f"{said}: no unfinished file was left.\n"


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A folder with records, a model, a sweep and a cache of compiled functions, and what the commands say of it."""
    folder = tmp_path_factory.mktemp("bench")
    (folder / "sweep.toml").write_text(small(1))
    for command in ("synth quickstart --out csv --seed 5", "fit csv/train.csv --levels 8 --out model.json"):
        run_whole(folder, folder, command)
    return folder


def start(bench, folder, command):
    cache, program = bench / "cache", ("-c", DIAGNOSE) if command.startswith("diagnose") else ("-m", "fits")
    arguments = [bench / part if (bench / part).exists() else part for part in command.split()]
    return begin(*program, *arguments, cwd=folder, env={"MICROID_CACHE": str(cache)})


def run_whole(bench, folder, command, status=0):
    process = start(bench, folder, command)
    _, stderr = process.communicate()
    assert process.returncode == status, stderr


def whole(path):
    """Read a file with something that fails on half of it."""
    if path.suffix == ".json":
        return json.loads(path.read_text())
    if path.suffix == ".png":
        with Image.open(path) as picture:
            return picture.load()
    if path.suffix == ".csv":
        comments = sum(line.startswith("#") for line in path.read_text(encoding="utf-8").splitlines())
        return np.loadtxt(path, delimiter=",", skiprows=comments + 1)
    if path.suffix == ".parquet":
        return pd.read_parquet(path)
    text = path.read_text(encoding="utf-8")
    assert text.rstrip().endswith({".html": "</html>", ".toml": "256"}.get(path.suffix, ("}", "*/", "#endif")))
    return text


def shown(folder):
    """What a user finds, but for the results of a sweep, which the table repeats."""
    files = [path for path in folder.rglob("*") if path.is_file() and "results.zarr" not in path.parts]
    names = [path.relative_to(folder) for path in files]
    return {name: whole(folder / name) for name in names if not any(part.startswith(".") for part in name.parts)}


@pytest.mark.parametrize(("sent", "said"), [(signal.SIGTERM, "Terminated"), (signal.SIGINT, "Interrupted")])
def test_a_request_between_the_calls_of_a_command_ends_it_as_any_other(sent, said):
    """The library that reads the command line ends with status 1 and a word of its own there."""
    asked = f"main.cli.make_context = lambda *_, **__: os.kill(os.getpid(), {int(sent)})"
    # In the background a shell has it ignored.
    heard = "signal.signal(signal.SIGINT, signal.default_int_handler)"
    code = f"import os, signal\nfrom fits.cli import _main as main\n{heard}\n{asked}\nmain.main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 128 + sent
    assert done.stderr.strip().startswith(said)


# The command, one that starts in the same folder and is soon refused, and what it leaves in the end.
COMMANDS = {
    "fit": ("fit csv/train.csv --levels 8 --out m.json --plots plots", "fit none.csv --out m.json --plots plots"),
    "diagnose": ("diagnose csv/train.csv --out report/new", "diagnose none.csv --out report/new"),
    "export": ("export model.json --out c/code", None),
    "sweep": ("sweep sweep.toml --out swept", None),
}


@pytest.mark.study
@pytest.mark.parametrize("name", COMMANDS)
def test_commands_are_killed_at_many_random_moments(bench, tmp_path, seed, name):
    command, refused = COMMANDS[name]
    moments = random.Random(seed)

    def resumed():
        return f"{command} --resume" if name == "sweep" and (tmp_path / "swept" / "about.json").exists() else command

    run_whole(bench, tmp_path, command)  # compiles
    shutil.rmtree(tmp_path)
    tmp_path.mkdir()
    began = time.monotonic()
    run_whole(bench, tmp_path, command)
    longest = time.monotonic() - began
    good = shown(tmp_path)
    count = {}
    for moment in range(MOMENTS):
        if moments.random() < 0.5:
            shutil.rmtree(tmp_path)
            tmp_path.mkdir()
        sent = SIGNALS[moment % 2]
        process = start(bench, tmp_path, resumed())
        # Half of them near the end, when files are written.
        time.sleep(longest * moments.uniform(*moments.choice([(0, 1), (0.7, 1.05)])))
        process.send_signal(sent)
        _, stderr = process.communicate()
        count[process.returncode] = count.get(process.returncode, 0) + 1
        # The second is a request that comes before the command listens; nothing is there then.
        assert process.returncode in {0, -sent, *((128 + sent,) if sent == signal.SIGTERM else ())}, stderr
        assert "Traceback" not in stderr
        there = set(shown(tmp_path))
        assert there <= set(good)
        # What is in one folder is there at once; SIGTERM undoes what is not.
        assert name in ("fit", "sweep") or there in (set(), set(good))
        assert name == "sweep" or sent == signal.SIGKILL or there in (set(), set(good))
        left = hidden(tmp_path)
        if sent == signal.SIGTERM and name != "sweep":
            assert left == []
        if name != "sweep" and not left:
            continue
        run_whole(bench, tmp_path, refused or resumed(), 2 if refused else 0)
        assert hidden(tmp_path) == []
        count["left"] = count.get("left", 0) + bool(left)
    print(name, f"{longest:.1f} s", count)
    run_whole(bench, tmp_path, resumed())
    assert hidden(tmp_path) == []
    for path, content in shown(tmp_path).items():
        if path.suffix in (".h", ".c", ".html"):
            # A page says when it was made.
            now, then = (re.sub(r"[-\d]+ [:\d]+ UTC", "", one) for one in (content, good[path]))
            assert now == then
        elif path.suffix == ".parquet":
            assert content.equals(good[path])
    assert set(shown(tmp_path)) == set(good)


@pytest.mark.parametrize("moment", ["rmdir", "exists"])
def test_a_request_to_end_leaves_nothing_of_a_trial(tmp_path, monkeypatch, moment):
    done, asked = getattr(Path, moment), []

    def interrupted(path):
        if is_temporary(path.name) and not asked:
            asked.append(path)
            raise KeyboardInterrupt
        return done(path)

    monkeypatch.setattr(Path, moment, interrupted)
    with pytest.raises(KeyboardInterrupt):
        usable_folder(tmp_path)
    assert asked
    assert list(tmp_path.iterdir()) == []
