"""Sweeps run: against SciPy and relays, in any chunks, stopped at any moment, and on broken disks."""

import contextlib
import errno
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from _command import OFF, files, refused, run
from _seed import seed_of
from _sweeps import parsed, small, stage_um

from fits import DataError
from fits.sweeps import _store
from fits.sweeps._run import run_sweep
from fits.sweeps._show import open_sweep, summarise
from fits.sweeps._spec import chunk_count, read_sweep
from fits.sweeps._stages import memory_before, nominal_stage, varied
from fits.sweeps._types import Block
from fits.sweeps.kinds.simulate import SimulateJob
from microid import Start

ROOT = Path(__file__).parents[1]


def table(folder):
    return pd.read_parquet(folder / "results.parquet")


@pytest.fixture(scope="module")
def once(tmp_path_factory):
    """One sweep for all tests."""
    drawn = seed_of("test_sweep_run")
    sweep, folder = parsed(small(drawn)), tmp_path_factory.mktemp("sweep") / "whole"
    run_sweep(sweep, str(folder))
    return sweep, folder


@pytest.fixture
def finished(once, tmp_path):
    sweep, folder = once
    shutil.copytree(folder, tmp_path / "whole")
    return sweep, tmp_path / "whole"


def test_rows_agree_with_scipy_and_a_loop_of_relays(tmp_path, rng, seed):
    traces = "[outputs]\ntraces = true\n[[axis]]"
    text = small(seed, rows=3).replace("[[axis]]", traces, 1).replace("sd = 0.04", "sd = 0.005")
    text = text.replace("samples = 60\ninterval_s = 1e-3", "samples = 600\ninterval_s = 1e-4")
    run_sweep(parsed(text), str(tmp_path / "out"))
    found = open_sweep(tmp_path / "out")
    time_s = np.arange(600) * 1e-4
    voltage_V = 60 + 40 * np.sin(2 * np.pi * 40 * time_s)
    for row in range(3):
        values = {
            name: float(found[name][row]) for name in ("mechanics.natural_frequency_Hz", "mechanics.damping_ratio")
        }
        expected = stage_um(nominal_stage(), values, time_s, voltage_V)
        stroke = np.ptp(expected)
        np.testing.assert_allclose(found["voltage_V"][row], voltage_V, atol=1e-9)
        # Relays of a four-hundredth of the range, and lines between samples.
        assert np.abs(found["displacement_um"][row].values - expected).max() < 4e-3 * stroke
        assert abs(float(found["stroke_um"][row]) - stroke) < 4e-3 * stroke
        assert float(found["displacement_final_um"][row]) == float(found["displacement_um"][row, -1])


def test_rows_agree_with_the_stage_itself(rng):
    sweep = parsed(small(1))
    stage, program = nominal_stage(), sweep.job.program
    names = ("mechanics.damping_ratio", "driver.gain", "hysteresis.density.packed_um", "program.amplitude_V")
    ends = (0.01, 0.3), (0.5, 1.1), (0, 2), (1, 90)
    values = {name: rng.uniform(*each, 8) for name, each in zip(names, ends, strict=True)}
    # One of three, as compiling takes long.
    initial = str(rng.choice(["negative", "positive", "demagnetised"]))
    memory = memory_before(stage, initial)
    relative = ("hysteresis.density.packed_um",)
    block = Block(values, relative, np.arange(8), np.zeros(8, dtype=int), 0)
    found = SimulateJob(stage, program, initial, every=1).compute(block).outputs
    for row in range(8):
        changed = varied(stage, {name: jnp.asarray(each[row]) for name, each in values.items()}, relative)
        moved = eqx.filter_jit(changed)(
            jnp.asarray(program.interval_s), found["voltage_V"][row], Start(memory=memory)
        )
        assert jnp.abs(found["displacement_um"][row] - moved).max() < 1e-12 * jnp.abs(moved).max()


def test_rows_do_not_depend_on_chunks(finished, tmp_path):
    sweep, whole = finished
    other = parsed(sweep.text.replace("chunk_rows = 256", "chunk_rows = 512"))
    assert chunk_count(other) != chunk_count(sweep)
    run_sweep(other, str(tmp_path / "other"))
    assert table(whole).equals(table(tmp_path / "other"))


def test_a_failed_row_has_its_reason_and_stops_nothing(finished):
    sweep, folder = finished
    found = table(folder)
    wrong = found["mechanics.damping_ratio"] < 0
    assert 0 < wrong.sum() < len(found) == len(sweep.plan)
    assert np.array_equal(found["status"] == 2, wrong)
    assert np.array_equal(found["reason"].str.startswith("mechanics.damping_ratio = -"), wrong)
    assert np.array_equal(found["stroke_um"].isna(), wrong)
    assert np.array_equal(found["row"], np.arange(len(found)))


def test_results_are_labelled(finished):
    sweep, folder = finished
    found = open_sweep(folder)
    assert found["stroke_um"].attrs["units"] == "um"
    assert found["mechanics.natural_frequency_Hz"].attrs["units"] == "Hz"
    assert "mechanics.natural_frequency_Hz" in found.coords
    assert found.attrs["sweep"] == sweep.text
    assert found.attrs["seed"] == sweep.seed
    assert found.attrs["versions"]["numpy"] == np.__version__
    assert found["status"].dtype == np.int8


def test_what_is_done_is_not_done_again(finished):
    sweep, folder = finished
    before = table(folder)
    outcome = run_sweep(sweep, str(folder), resume=True)
    assert (outcome.computed, outcome.again) == (0, 0)
    assert before.equals(table(folder))


@pytest.mark.parametrize("how", ["flip", "cut", "remove", "ledger"])
def test_a_corrupted_chunk_is_noticed_and_computed_again(finished, rng, how):
    sweep, folder = finished
    before = table(folder)
    if how == "ledger":
        (folder / "ledger" / "00000001.json").write_text("{")
    else:
        path = folder / "results.zarr" / "stroke_um" / "1"
        content = bytearray(path.read_bytes())
        content[rng.integers(16, len(content))] ^= 1 << int(rng.integers(8))
        path.unlink() if how == "remove" else path.write_bytes(
            content[: len(content) // 2] if how == "cut" else content
        )
    outcome = run_sweep(sweep, str(folder), resume=True)
    assert outcome.computed in (0, 256)
    assert how == "flip" or outcome.computed == 256
    assert before.equals(table(folder))


KILLS = """
import os, random, signal, sys, time, traceback, warnings
import jax
jax.config.update("jax_enable_x64", True)
warnings.simplefilter("ignore")  # JAX warns of a fork; the children only write
import pandas as pd
from fits.sweeps import _run, _spec

toml, whole, out, seed, kills = sys.argv[1:]
kept, moments = pd.read_parquet(whole), random.Random(int(seed))

def compute(sweep, chunk, tell):
    time.sleep(0.05)  # so that some are killed while they compute
    part = kept.iloc[_spec.rows_of(sweep, chunk)]
    outputs = {name: part[name].to_numpy() for name in kept.columns if name not in ("row", "reason")}
    return _spec.t.Rows(outputs, tuple(part["reason"]))

_run.compute_chunk = compute

def start(folder):
    child = os.fork()
    if child == 0:
        try:
            _run.run_sweep(_spec.read_sweep(toml), folder, resume=os.path.exists(folder + "/about.json"))
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    return child

began = time.monotonic()
assert os.waitpid(start(out + "-first"), 0)[1] == 0
longest = time.monotonic() - began
killed = 0
for _ in range(int(kills)):
    child = start(out)
    time.sleep(moments.uniform(0, 0.8 * longest))
    os.kill(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    killed += os.WIFSIGNALED(status)
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0
print(killed)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a process that is killed here is a forked one")
@pytest.mark.parametrize("kills", [3, pytest.param(10, marks=pytest.mark.study)])
@pytest.mark.study
def test_killed_at_random_moments_no_row_is_lost_or_doubled(finished, tmp_path, seed, kills):
    sweep, whole = finished
    file, out = tmp_path / "sweep.toml", tmp_path / "killed"
    file.write_text(sweep.text)
    arguments = [str(file), str(whole / "results.parquet"), str(out), str(seed), str(kills)]
    done = subprocess.run(
        [sys.executable, "-c", KILLS, *arguments],
        cwd=ROOT,
        env=os.environ | OFF | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 0  # not all had ended before
    for folder in (out, tmp_path / "killed-first"):
        again = read_sweep(file)
        run_sweep(again, str(folder), resume=(folder / "about.json").exists())
        assert table(folder).equals(table(whole))


class _DiedError(Exception):
    """What no code of ours knows of."""


@pytest.mark.parametrize("at", range(1, 60, 9))
def test_stopped_between_any_two_writes_it_goes_on(finished, tmp_path, monkeypatch, at):
    """Every file that is put in its place is a moment at which a process may die."""
    sweep, whole = finished
    replace, left = os.replace, [at]

    def dying(*arguments, **keywords):
        if left[0] == 0:
            raise _DiedError
        left[0] -= 1
        return replace(*arguments, **keywords)

    out = tmp_path / "out"
    monkeypatch.setattr("os.replace", dying)
    monkeypatch.setattr("fits.sweeps._run.compute_chunk", lambda sweep, chunk, tell: rows_from(sweep, whole, chunk))
    with contextlib.suppress(_DiedError):
        run_sweep(sweep, str(out))
    monkeypatch.setattr("os.replace", replace)
    # The threads that write go on for a moment, since the process has not really died.
    before = None
    for _ in range(100):
        there = set(out.rglob("*"))
        if there == before and not any(path.suffix == ".partial" for path in there):
            break
        before = there
        time.sleep(0.2)
    run_sweep(sweep, str(out), resume=(out / "about.json").exists())
    assert table(out).equals(table(whole))


def rows_from(sweep, folder, chunk):
    from fits.sweeps._spec import rows_of
    from fits.sweeps._types import Rows

    part = table(folder).iloc[rows_of(sweep, chunk)]
    outputs = {name: part[name].to_numpy() for name in part.columns if name not in ("row", "reason")}
    return Rows(outputs, tuple(part["reason"]))


def test_a_full_disk_is_a_sentence_and_the_rest_stays(finished, tmp_path, monkeypatch):
    sweep, whole = finished
    out = str(tmp_path / "out")
    monkeypatch.setattr("fits.sweeps._run.compute_chunk", lambda sweep, chunk, tell: rows_from(sweep, whole, chunk))
    write = _store.atomic_write_text

    def full(path, text):
        if "00000001" in str(path):
            raise OSError(errno.ENOSPC, "No space left on device")
        write(path, text)

    monkeypatch.setattr(_store, "atomic_write_text", full)
    with pytest.raises(DataError, match=r"No space left on device.*resume"):
        run_sweep(sweep, out)
    monkeypatch.setattr(_store, "atomic_write_text", write)
    assert summarise(out)["chunks_done"] == 1
    outcome = run_sweep(sweep, out, resume=True)
    assert outcome.computed == len(sweep.plan) - 256
    assert table(tmp_path / "out").equals(table(whole))


def test_what_does_not_fit_on_the_disk_is_refused_before(tmp_path, monkeypatch, seed):
    monkeypatch.setattr(_store.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**6, 10**6, 1000))
    with pytest.raises(DataError, match="600 rows would take about"):
        run_sweep(parsed(small(seed)), str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_the_command_refuses_in_one_sentence(finished, tmp_path, seed):
    sweep, whole = finished
    file = tmp_path / "sweep.toml"
    file.write_text(sweep.text)
    refused(run("sweep", file, "--out", whole), "resume it to go on")
    (tmp_path / "other.toml").write_text(small(seed + 1))
    refused(run("sweep", tmp_path / "other.toml", "--out", whole, "--resume"), "another sweep")
    refused(run("sweep", tmp_path / "none.toml", "--out", whole), "no such file")
    refused(run("sweep", "show", tmp_path), "there is no sweep")
    refused(run("sweep", file, "--out", file), "expected a folder")
    about = json.loads((whole / "about.json").read_text())
    about["versions"]["jax"] = "0.0.1"
    (whole / "about.json").write_text(json.dumps(about))
    refused(run("sweep", file, "--out", whole, "--resume"), "jax 0.0.1")
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    if not os.access(locked, os.W_OK):
        refused(run("sweep", file, "--out", locked / "out"), "can be written to")


def test_the_command_runs_shows_and_draws(finished, tmp_path):
    _, whole = finished
    assert run("sweep", "--example", "control").stdout.startswith("# A sweep")
    shown = run("sweep", "show", whole, "--best", "stroke_um", "--largest", "--plots", tmp_path / "plots", "--json")
    summary = json.loads(shown.stdout)
    found = table(whole)
    assert summary["done"] + summary["failed"] == summary["rows"] == len(found)
    assert summary["left"] == 0
    assert summary["best"]["rows"][0]["row"] == found["stroke_um"].idxmax()
    assert summary["outputs"]["stroke_um"]["median"] == pytest.approx(found["stroke_um"].median(), rel=1e-12)
    assert files(tmp_path / "plots") == ["heat_0.png", "index.html", "parallel.png"]
    assert "largest stroke_um" in run("sweep", "show", whole, "--best", "stroke_um", "--largest").stdout


def test_two_processes_do_not_share_a_folder(finished):
    sweep, whole = finished
    with _store.opened(sweep, str(whole), True), pytest.raises(DataError, match="another process"):
        run_sweep(sweep, str(whole), resume=True)
