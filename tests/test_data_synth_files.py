"""What the bench writes: measured columns in one place, the truth in another, the same bytes for the same seed."""

import ast
import dataclasses
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import data_synth as ds
from data_synth.__main__ import main

ROOT = Path(__file__).parents[1]
NUMBER = r"-?\d+(?:\.\d+)?(?:e-?\d+)?"
ROW = re.compile(f"{NUMBER},{NUMBER},{NUMBER}")


@pytest.fixture
def scenario():
    scenario = ds.load_scenario("unknown_history")
    return dataclasses.replace(scenario, rig=dataclasses.replace(scenario.rig, relays=100, plays=40))


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_same_seed_same_bytes(scenario, seed, tmp_path):
    ds.write(ds.simulate(scenario, seed), tmp_path / "a")
    ds.write(ds.simulate(scenario, seed), tmp_path / "b")
    ds.write(ds.simulate(scenario, seed + 1), tmp_path / "c")
    a, b, c = (contents(tmp_path / name) for name in "abc")
    assert a == b
    assert a.keys() == c.keys() == {"train.csv", "heldout.csv", "truth.json"}
    assert all(a[name] != c[name] for name in a)


def test_seeds_come_from_the_argument_then_the_scenario_then_chance(scenario):
    seeded = dataclasses.replace(scenario, seed=5)
    assert ds.simulate(seeded, 6).seed == 6
    assert ds.simulate(seeded).seed == 5
    fresh = ds.simulate(scenario)
    assert fresh.seed != ds.simulate(scenario).seed
    again = ds.simulate(scenario, fresh.seed)
    np.testing.assert_array_equal(again.records[1].displacement_um, fresh.records[1].displacement_um)
    with pytest.raises(ds.ScenarioError, match="the seed must be zero or positive, got -1"):
        ds.simulate(scenario, -1)


def test_runs_share_the_rig_and_nothing_else(scenario, seed):
    """Taking a run away, or noise, leaves the other run's truth as it is."""
    whole = ds.simulate(scenario, seed)
    first = ds.simulate(dataclasses.replace(scenario, runs=scenario.runs[:1]), seed)
    quiet = ds.simulate(dataclasses.replace(scenario, sensor=ds.Sensor()), seed)
    assert first.rig == whole.rig == quiet.rig
    np.testing.assert_array_equal(first.records[0].displacement_um, whole.records[0].displacement_um)
    for noisy, silent in zip(whole.records, quiet.records, strict=True):
        np.testing.assert_array_equal(noisy.true_displacement_um, silent.true_displacement_um)
        np.testing.assert_array_equal(silent.displacement_um, silent.true_displacement_um)
    assert whole.records[0].history_V.tolist() != whole.records[1].history_V.tolist()


def test_a_csv_holds_what_was_measured_and_nothing_else(scenario, seed, tmp_path):
    bench = ds.simulate(scenario, seed)
    ds.write(bench, tmp_path)
    for record in bench.records:
        header, *rows = (tmp_path / f"{record.name}.csv").read_text().removesuffix("\n").split("\n")
        assert header == "time_s,voltage_V,displacement_um"
        assert all(ROW.fullmatch(row) for row in rows)
        columns = np.array([[float(cell) for cell in row.split(",")] for row in rows]).T
        for column, measured in zip(columns, (record.time_s, record.voltage_V, record.displacement_um), strict=True):
            np.testing.assert_array_equal(column, measured)
        # Single readings may equal the truth (a stage at rest at exactly zero); the noise as a whole is there.
        assert np.std(record.displacement_um - record.true_displacement_um) == pytest.approx(0.03, rel=0.2)
        # The history before the record stays unknown: only its end, where the record starts, can be seen.
        assert not set(np.round(record.history_V[2:-1], 6)) & set(columns[1])


def test_the_truth_stands_in_a_file_of_its_own(scenario, seed, tmp_path):
    bench = ds.simulate(scenario, seed)
    ds.write(bench, tmp_path)
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert truth["schema"] == "data_synth.truth/1"
    assert truth["scenario"] == {"name": "unknown_history", "text": scenario.text}
    assert truth["seed"] == bench.seed
    assert truth["sensor"] == {"noise_um": 0.03, "quantum_um": 0.001, "offset_um": 0.0}
    assert truth["rig"]["stroke_um"] == bench.rig.stroke_um
    assert truth["rig"]["loop_width"] == bench.rig.loop_width
    for record in bench.records:
        np.testing.assert_array_equal(truth["runs"][record.name]["displacement_um"], record.true_displacement_um)
        np.testing.assert_array_equal(truth["runs"][record.name]["history_V"], record.history_V)


def test_the_sensor_adds_white_noise_an_offset_and_a_last_digit(rng):
    n = 20_000
    sensor = ds.Sensor(noise_um=0.05, quantum_um=0.02, offset_um=3.0)
    still_um = np.full(n, 10.0)
    noise_um = sensor.read(still_um, rng) - still_um - 3.0
    sd_um = np.hypot(0.05, 0.02 / np.sqrt(12))  # Sheppard: a last digit adds its own spread
    assert abs(noise_um.mean()) < 5 * sd_um / np.sqrt(n)
    assert noise_um.std() == pytest.approx(sd_um, rel=5 / np.sqrt(2 * n))
    assert abs(noise_um[1:] @ noise_um[:-1]) / (noise_um @ noise_um) < 5 / np.sqrt(n)
    digits = (noise_um + 13.0) / 0.02
    np.testing.assert_allclose(digits, np.round(digits), atol=1e-8)


@pytest.mark.parametrize("settings", [{"noise_um": -0.1}, {"quantum_um": np.inf}, {"offset_um": np.nan}])
def test_sensors_that_cannot_be_are_refused(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        ds.Sensor(**settings)


def test_a_folder_that_cannot_be_written_to_is_one_sentence(scenario, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ds.ScenarioError, match=r"file/out: cannot be written to: Not a directory$"):
        ds.write(ds.simulate(scenario), tmp_path / "file" / "out")


def test_a_failed_write_leaves_the_old_file_and_no_other(scenario, tmp_path, monkeypatch):
    ds.write(ds.simulate(scenario), tmp_path)
    before = contents(tmp_path)

    def fail(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(ds.ScenarioError, match="No space left on device"):
        ds.write(ds.simulate(scenario), tmp_path)
    assert contents(tmp_path) == before


def command(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "data_synth", *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_command_writes_a_scenario(seed, tmp_path):
    done = command("major_loops", tmp_path / "out", "--seed", seed)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[0] == f"seed {seed}"
    assert set(contents(tmp_path / "out")) == {"triangles.csv", "sines.csv", "truth.json"}
    assert json.loads((tmp_path / "out" / "truth.json").read_text())["seed"] == seed
    ds.write(ds.simulate(ds.load_scenario("major_loops"), seed), tmp_path / "here")
    assert contents(tmp_path / "here") == contents(tmp_path / "out")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["major_lops", "out"], "no scenario is called 'major_lops'"),
        (["lab.toml", "out"], "lab.toml: cannot be read: No such file or directory"),
        (["major_loops", "pyproject.toml/out"], "pyproject.toml/out: cannot be written to: Not a directory"),
        (["major_loops", "out", "--seed", "-3"], "the seed must be zero or positive, got -3"),
    ],
)
def test_the_command_says_what_is_wrong_in_one_sentence(arguments, sentence, capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(sentence)
    assert err.count("\n") == 1


def test_the_package_imports_numpy_scipy_and_the_standard_library_only():
    for path in (ROOT / "data_synth").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0
                names = [node.module]
            roots = {name.split(".")[0] for name in names}
            assert roots <= {"numpy", "scipy", "data_synth"} | set(sys.stdlib_module_names), path


def test_using_the_package_loads_neither_jax_nor_the_other_packages():
    code = "import sys, data_synth.__main__ as m; assert m.main(['nowhere', 'out']) == 2; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = {name.split(".")[0] for name in done.stdout.split()}
    assert "data_synth" in loaded
    assert not loaded & {"jax", "jaxlib", "equinox", "microid", "fits", "pandas", "numba", "matplotlib"}


def test_the_public_list_is_what_can_be_used():
    public = {
        name for name, value in vars(ds).items() if not name.startswith("_") and not isinstance(value, type(ast))
    }
    assert public == set(ds.__all__)
