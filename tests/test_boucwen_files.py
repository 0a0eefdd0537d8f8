"""The files of the Bouc-Wen benchmark, against adaptive integration of its equations as they are stated."""

import json

import numpy as np
import pytest
from _command import refused, run
from scipy.integrate import solve_ivp
from test_export_c import COMPILER
from test_export_simulation import simulated_um

import fits
import microid as m

SAMPLES, RATE_Hz = 300, 750.0
# Parameters of the law that the benchmark does not have, or that are only seen with another.
UNSEEN = "slope_um_per_V", "offset_um", "exponent"


@pytest.mark.study
def test_the_benchmark_is_written_as_files(tmp_path):
    done = run("synth", "boucwen", "--out", tmp_path, "--samples", SAMPLES, "--seed", 4)
    assert done.exit_code == 0
    tables = {}
    for name in ("estimation", "test_multisine", "test_sweep"):
        path = tmp_path / f"{name}.csv"
        assert path.read_text().startswith("time_s,force_N,displacement_um\n")
        tables[name] = np.loadtxt(path, delimiter=",", skiprows=1).T
        assert tables[name].shape == (3, SAMPLES)
        np.testing.assert_allclose(tables[name][0], np.arange(SAMPLES) / RATE_Hz, rtol=1e-12)
    truth = json.loads((tmp_path / "truth.json").read_text())
    noise_um = tables["estimation"][2] - truth["runs"]["estimation"]["displacement_um"]
    # Of 300 samples the standard deviation is within 20 % but once in a million times.
    assert 0.8 * 8 < noise_um.std() < 1.2 * 8
    assert not np.allclose(tables["estimation"][1], tables["test_multisine"][1])

    time_s, force_N, moved_um = tables["test_sweep"]

    def slope(t, state):
        y, v, z = state
        force = 40 * np.sin(2 * np.pi * (20 * t + 10 / 60 * t**2 / 2))
        return v, (force - 10 * v - 5e4 * y - z) / 2, 5e4 * v - 1e3 * (0.8 * abs(v) * z - 1.1 * v * abs(z))

    np.testing.assert_allclose(force_N, 40 * np.sin(2 * np.pi * (20 * time_s + 10 / 60 * time_s**2 / 2)), atol=1e-9)
    exact = solve_ivp(slope, (0, time_s[-1]), [0, 0, 0], "LSODA", time_s, rtol=1e-9, atol=1e-12)
    # Newmark's rule at 15 kHz, and filters that take what is above 375 Hz away.
    assert np.sqrt(np.mean((exact.y[0] * 1e6 - moved_um)[30:] ** 2)) < 5e-3 * moved_um.std()


@pytest.mark.study
def test_the_benchmark_from_its_files_to_c(tmp_path):
    """Fit, model file, simulation and C by the command alone, judged on the sweep, which is without noise."""
    assert run("synth", "boucwen", "--out", tmp_path, "--samples", 2000, "--seed", 5).exit_code == 0
    mechanics = m.HystereticMechanics(m.Mechanics(26.0, 0.03), m.hysteresis.BoucWen(0.0, 1.3, 5e-4, 0.0))
    alike = "force.offset_um", "mechanics.inner.gain", *(f"mechanics.law.{name}" for name in UNSEEN)
    start, fitted = tmp_path / "start.json", tmp_path / "fitted.json"
    fits.save_model(start, m.Stage.of(force=m.Piezo(25.0), mechanics=mechanics).freeze(*alike), None, {})
    asked = "--columns", "voltage_V=force_N[V]"
    done = run("fit", tmp_path / "estimation.csv", "--start", start, "--hold", "curves", "--out", fitted, *asked)
    assert done.exit_code == 0, done.stderr
    found = {one["name"]: one for one in fits.load_model(fitted).report["parameters"]}
    oscillator = json.loads((tmp_path / "truth.json").read_text())["oscillator"]
    true = {"beta": oscillator["gamma"], "gamma": oscillator["delta"]}
    for name, value in true.items():
        one = found[f"mechanics.law.{name}"]
        assert abs(one["value"] - 1e-6 * oscillator["beta"] * value) < 4 * one["sd"]

    sweep = np.loadtxt(tmp_path / "test_sweep.csv", delimiter=",", skiprows=1).T
    assert run("simulate", fitted, tmp_path / "test_sweep.csv", "--out", tmp_path / "p.csv", *asked).exit_code == 0
    _, _, predicted_um, sd_um = np.loadtxt(tmp_path / "p.csv", delimiter=",", skiprows=1).T
    # What 2,000 samples leave of the parameters is a tenth of the noise.
    known_um = np.sqrt(np.mean(sd_um**2))
    assert known_um < 1.0
    assert np.sqrt(np.mean((predicted_um - sweep[2]) ** 2)) < 3 * known_um
    if COMPILER is None:
        pytest.skip("there is no C compiler on this machine: what is exported is not tried")
    # In lines at the bench's own rate, from which the record was brought down.
    assert run("export", fitted, "--rate", 15000, "--name", "rig", "--out", tmp_path / "c").exit_code == 0
    time_s = np.arange(20 * SAMPLES) / 15000
    force_N = 40 * np.sin(2 * np.pi * (20 * time_s + 10 / 60 * time_s**2 / 2))
    moved_um = simulated_um(tmp_path / "c", "rig", force_N, 0.0)[::20]
    assert np.sqrt(np.mean((moved_um - sweep[2][:SAMPLES])[30:] ** 2)) < 3 * known_um


def test_scenarios_are_not_cut(tmp_path):
    refused(run("synth", "quickstart", "--out", tmp_path / "q", "--samples", 200), "--samples")
