"""The files of the Bouc-Wen benchmark, against adaptive integration of its equations as they are stated."""

import json

import numpy as np
import pytest
from _command import refused, run
from scipy.integrate import solve_ivp

SAMPLES, RATE_Hz = 300, 750.0


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


def test_scenarios_are_not_cut(tmp_path):
    refused(run("synth", "quickstart", "--out", tmp_path / "q", "--samples", 200), "--samples")
