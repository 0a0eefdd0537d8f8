"""Spoilt files of every kind: refused in one sentence, or taken with results that are finite; never a traceback.

By default a small sample. `MICROID_FUZZ=10000 pytest tests/test_fuzz.py -m study -s` is the study: so many inputs in
this process (`-k in_this_process`) and 300 through the command (`-k through_the_command`), with the time of each
beside that of the good file.
"""

import collections
import copy
import json
import math
import os
import re
import subprocess
import sys
import time
import traceback
import warnings

import jax
import numpy as np
import pytest
from _command import run
from _fuzz import spoilt
from _fuzz_files import LEVELS, csv, good_files, loops

import data_synth
import fits
from data_synth import ScenarioError
from data_synth._engine import refinement
from data_synth._plant import Plant
from fits.control._gains import read_gains
from fits.sweeps._spec import chunk_rows, compute_chunk, read_sweep

SAMPLE, COMMANDS = 80, 3
STUDY = int(os.environ.get("MICROID_FUZZ", 0))
# What takes longer than this is looked at: less is lost among what the machine does besides.
SLOW_s, TIMES = 2.0, 3.0
# No command reads the first two, and a sweep may ask for any number of rows.
NO_COMMAND = ("response.csv", "multisine.csv", "sweep.toml")


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A good file of each kind by its name, and the folder they are in."""
    folder = tmp_path_factory.mktemp("good")
    (folder / "loops.csv").write_bytes(csv(loops()))
    done = run("fit", folder / "loops.csv", "--levels", LEVELS, "--out", folder / "loop.json", "--quiet")
    assert done.exit_code == 0, done.output
    return good_files(folder, folder / "loop.json")


def commands(good, name, path, out, rng):
    """What is run with a file whose reader has taken it: arguments of the command."""
    some = rng.uniform()
    csv_out, initial = out / "out.csv", str(rng.choice(["negative", "positive", "demagnetised"]))
    if name == "record.csv":
        share = ["--holdout", str(rng.choice([0, 0.2]))]
        return ["fit", path, "--levels", LEVELS, "--out", out / "out.json", "--quiet", *share] if some < 0.5 else None
    if name == "program.csv":
        model = good["stage.json" if some < 0.5 else "model.json"]
        return ["simulate", model, path, "--out", csv_out, "--initial", initial]
    if name == "reference.csv":
        clip = ["--clip"] if some < 0.5 else []
        return ["compensate", good["model.json"], path, "--out", csv_out, "--initial", initial, *clip]
    if name in ("model.json", "stage.json"):
        if some < 0.2:
            return ["info", path]
        if some < 0.6:
            return ["simulate", path, good["program.csv"], "--out", csv_out]
        return ["compensate", path, good["reference.csv"], "--out", csv_out, "--clip"]
    if name == "design.toml":
        return ["sensitivity", path, "--axis", "x", "--json"] if some < 0.3 else None
    return None


def read(good, name, path, rng):
    """Read a file as the program does, and use what needs no command; what is returned holds only finite numbers."""
    if name in ("record.csv", "program.csv"):
        required = ("time_s", "voltage_V", "displacement_um")[: 3 if name == "record.csv" else 2]
        record = fits.read_csv(path, required=required)
        return [
            record.time_s,
            record.voltage_V,
            *([] if record.displacement_um is None else [record.displacement_um]),
        ]
    if name == "reference.csv":
        found = fits.read_reference(path)
        return [found.time_s, found.displacement_um]
    if name == "idle.csv":
        noise = fits.idle_noise(fits.read_idle(path))
        return [noise.sd_um, noise.mean_sd_um, noise.drift_sd_um_per_s, noise.asd_um_per_rtHz, noise.adev_um]
    if name == "response.csv":
        response = fits.read_response(path)
        return [response.frequency_Hz, np.abs(response.response_um_per_V)]
    if name == "multisine.csv":
        estimate = fits.estimate_response(fits.read_multisine(path))
        return [np.abs(estimate.response_um_per_V), estimate.variance_um2_per_V2]
    if name in ("model.json", "stage.json"):
        return [leaf for leaf in jax.tree.leaves(fits.load_model(path).model) if isinstance(leaf, jax.Array)]
    if name == "design.toml":
        design = fits.read_design(path)
        return [float(value) for value in design.tolerance.values()]
    if name == "gains.json":
        return list(read_gains(str(path)).pid.values())
    if name == "sweep.toml":
        sweep = read_sweep(path)
        rows = np.arange(min(len(sweep.plan), 20))
        if len(sweep.plan) <= 300 and rng.uniform() < 0.2:
            compute_chunk(sweep, 0)
        return [chunk_rows(sweep), *sweep.plan.values(rows).values()]
    scenario = data_synth.load_scenario(str(path))
    bench = data_synth.simulate(scenario, 3)
    return [column for record in bench.records for column in record.columns().values()]


def in_one_line(sentence):
    assert 0 < len(sentence) <= 1200, len(sentence)
    assert "jaxtyping" not in sentence, sentence
    assert "Float[" not in sentence, sentence


def tried(good, name, path, out, rng):
    """Say whether a file was refused or taken; an AssertionError says what is wrong."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = read(good, name, path, rng)
    except (fits.DataError, ScenarioError) as error:
        in_one_line(" ".join(str(error).split()))
        return "refused"
    assert all(np.all(np.isfinite(np.asarray(each))) for each in found), "what was read is not finite"
    arguments = commands(good, name, path, out, rng)
    if arguments is None:
        return "taken"
    done = run(*arguments)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise AssertionError(f"{arguments[0]}: " + "".join(traceback.format_exception(done.exception)[-3:]))
    return judged(done.exit_code, done.stdout, done.stderr, out)


def judged(code, stdout, stderr, out):
    files = sorted(out.rglob("*"))
    if code == 2:
        lines = [line for line in stderr.splitlines() if not re.match(r"(\[[#.]+\])? +\d+\.\d s  ", line)]
        assert len(lines) == 1, stderr[-2000:]
        in_one_line(lines[0])
        assert files == [], files
        return "refused by the command"
    assert code == 0, (code, stdout[-500:], stderr[-2000:])
    for path in files:
        if path.suffix == ".csv":
            table = np.genfromtxt(path, delimiter=",", skip_header=1)
            assert np.all(np.isfinite(table)), f"{path.name} holds numbers that are not finite"
        elif path.suffix == ".json":
            json.loads(path.read_text(), parse_constant=lambda word: pytest.fail(word))
    return "taken by the command"


def inputs(good, seed, count, folder):
    """Spoilt files in turn: number, name of the good file, path, and a generator for what is done with it."""
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        name = sorted(good)[k % len(good)]
        path = folder / f"{k}{os.path.splitext(name)[1]}"
        path.write_bytes(spoilt(rng, name, good[name].read_bytes()))
        yield k, name, path, rng


def empty(folder):
    folder.mkdir(exist_ok=True)
    for path in folder.iterdir():
        path.unlink()
    return folder


def test_good_files_are_taken(good, tmp_path):
    for name, path in good.items():
        found = tried(good, name, path, empty(tmp_path / "out"), np.random.default_rng(0))
        assert found.startswith("taken"), (name, found)


def test_spoilt_files_are_refused_in_one_sentence_or_taken(good, tmp_path, seed):
    for k, name, path, rng in inputs(good, seed, SAMPLE, tmp_path):
        print(f"input {k}, of {name}")
        tried(good, name, path, empty(tmp_path / "out"), rng)


def through_the_command(good, name, path, out):
    """A file given to the command in a process of its own."""
    model, target = good["model.json"], out / "out.csv"
    arguments = {
        "record.csv": ["fit", path, "--levels", LEVELS, "--out", out / "out.json"],
        "program.csv": ["simulate", model, path, "--out", target],
        "reference.csv": ["compensate", model, path, "--out", target, "--clip"],
        "model.json": ["simulate", path, good["program.csv"], "--out", target],
        "stage.json": ["simulate", path, good["program.csv"], "--out", target],
        "design.toml": ["sensitivity", path, "--axis", "x", "--json"],
        "scenario.toml": ["synth", path, "--out", out],
        "idle.csv": ["budget", "paper", model, path, "--axis", "x", "--json"],
        "gains.json": ["control", model, good["reference.csv"], "--gains", path, "--out", target],
    }[name]
    done = subprocess.run(
        [sys.executable, "-m", "fits", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env={"MICROID_CACHE": str(good["model.json"].parent / "cache")} | os.environ,
    )
    return judged(done.returncode, done.stdout, done.stderr, out)


@pytest.mark.study
def test_the_command_refuses_them_with_status_2_or_writes_finite_files(good, tmp_path, seed):
    names = np.random.default_rng(seed).permutation([name for name in sorted(good) if name not in NO_COMMAND])
    some = {name: good[name] for name in names[:COMMANDS].tolist()}
    for k, name, path, _ in inputs(some, seed, COMMANDS, tmp_path):
        print(f"input {k}, of {name}")
        through_the_command(good, name, path, empty(tmp_path / "out"))


def work(name, path):
    """How much a file that was taken asks for: fine steps of a scenario and its plays, substeps of a stage."""
    if name == "scenario.toml":
        scenario = data_synth.load_scenario(str(path))
        rng, rig = np.random.default_rng(0), scenario.rig
        plant = Plant() if scenario.plant is None else scenario.plant.draw(rng)
        counts = [len(each.voltage_V(rig.lower_V, rig.lower_V, rig.upper_V, rng)) for each in scenario.runs]
        return rig.plays * sum(
            n * refinement(plant, each.sample_rate_Hz, n) for n, each in zip(counts, scenario.runs, strict=True)
        )
    return fits.load_model(path).model.substeps if name == "stage.json" else 1


study = pytest.mark.skipif(not STUDY, reason="MICROID_FUZZ says how many")


@pytest.mark.study
@study
def test_study_in_this_process(good, tmp_path, seed):
    """The figures of the whole study; each fault is printed with the number of its input."""
    usual = collections.defaultdict(float)
    out = tmp_path / "out"
    for name, path in good.items():
        for k in range(12):
            began = time.monotonic()
            found = tried(good, name, path, empty(out), np.random.default_rng(k))
            if k > 3:  # without what is compiled once
                usual[name, found] = max(usual[name, found], time.monotonic() - began)
    figures, faults, slow = collections.Counter(), [], []
    for k, name, path, rng in inputs(good, seed, STUDY, tmp_path):
        if k % 5000 == 4999:
            jax.clear_caches()  # what is compiled maps memory, of which a process may have only so many pieces
        began, again = time.monotonic(), copy.deepcopy(rng)
        try:
            found = tried(good, name, path, empty(out), rng)
        except Exception as error:
            found = "FAULT"
            faults.append(f"{k} {name}: {type(error).__name__}: {str(error)[-600:]}")
            print(faults[-1], flush=True)
            path.rename(path.with_suffix(".kept" + path.suffix))
        figures[name, found] += 1
        took = time.monotonic() - began
        most = max(SLOW_s, TIMES * max(usual[name, "taken"], usual[name, "taken by the command"]))
        if took > most and found != "FAULT":
            # The same again, without what was compiled for it: each process compiles once, for good files too.
            began, found = time.monotonic(), tried(good, name, path, empty(out), again)
            took, more = time.monotonic() - began, work(name, path) / work(name, good[name])
            if took > most * max(1.0, more):
                slow.append(f"{k} {name}: {found} in {took:.1f} s, {more:.3g} times the work")
                print(slow[-1], flush=True)
        path.unlink(missing_ok=True)
    print(*(f"{count:6} {name:15} {found}" for (name, found), count in sorted(figures.items())), sep="\n")
    print(f"{sum(figures.values())} in this process, {len(faults)} faults, {len(slow)} slow ones")
    assert not faults
    assert not slow


@pytest.mark.study
@study
def test_study_through_the_command(good, tmp_path, seed):
    """The same, each input in a process of its own."""
    named, out = {name: path for name, path in good.items() if name not in NO_COMMAND}, tmp_path / "out"

    def timed(name, path):
        began = time.monotonic()
        return through_the_command(good, name, path, empty(out)), time.monotonic() - began

    usual = {name: [timed(name, path) for _ in range(2)][-1] for name, path in named.items()}
    print(usual, flush=True)
    figures, broken, slow = collections.Counter(), [], []
    for k, name, path, _ in inputs(named, seed, math.ceil(STUDY * 0.03), tmp_path):
        try:
            found, took = timed(name, path)
        except Exception as error:
            broken.append(f"{k} {name}: {type(error).__name__}: {str(error)[-600:]}")
            print(broken[-1], flush=True)
            continue
        figures[name, found] += 1
        print(k, name, found, f"{took:.1f} s", flush=True)
        most = TIMES * usual[name][1]
        if took > most and found.startswith("taken"):
            most *= max(1.0, work(name, path) / work(name, good[name]))
        # Again, as this machine may have done much besides.
        if took > most and (took := timed(name, path)[1]) > most:
            slow.append(f"{k} {name}: {found} in {took:.1f} s, most {most:.1f} s")
            print(slow[-1], flush=True)
    print(*(f"{count:6} {name:15} {found}" for (name, found), count in sorted(figures.items())), sep="\n")
    print(f"{sum(figures.values())} through the command, {len(broken)} faults, {len(slow)} slow ones")
    assert not broken
    assert not slow
