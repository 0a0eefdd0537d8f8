"""Slow loops of a rig that relaxes and whose readings lag, against plays and SciPy's linear systems."""

import json

import numpy as np
import pytest
from _command import refused, run
from _seed import seed_of
from scipy.signal import lsim

import fits
from fits.stage._fit_slow import _stage

NOISE_um, INTERVAL_s, LAG_s, GAIN, CONSTANT_s = 0.02, 0.02, 0.1, 0.08, 5.0
TURNS_V = [0, 100, 0, 80, 20, 100, 40, 70, 30, 90, 0, 60, 10, 100, 100, 0, 0, 50, 5, 75, 25, 100, 0, 90, 20, 60, 0]
LEVELS = 16


def displacement(time_s, voltage_V):
    """Plays of many widths beside a slope, what relaxes behind them, and a lag; from negative saturation."""
    radius_V = np.linspace(0, 50, 400)
    weight = radius_V * np.exp(-radius_V / 20)
    play, out_um = voltage_V[0] + radius_V, np.empty(len(voltage_V))
    for k, now in enumerate(voltage_V):
        play = np.clip(play, now - radius_V, now + radius_V)
        out_um[k] = 0.1 * now + 0.3 * (weight @ play) / weight.sum()
    out_um -= out_um[0]
    out_um += GAIN * lsim(([1.0], [CONSTANT_s, 1.0]), out_um, time_s)[1]
    return lsim(([1.0], [LAG_s, 1.0]), out_um, time_s)[1]


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(seed_of("test_fit_slow"))
    # Each way takes 2.5 s, and so does each rest.
    voltage_V = np.interp(np.arange(0, 2.5 * (len(TURNS_V) - 1), INTERVAL_s), 2.5 * np.arange(len(TURNS_V)), TURNS_V)
    time_s = np.arange(len(voltage_V)) * INTERVAL_s
    noisy_um = displacement(time_s, voltage_V) + rng.normal(0, NOISE_um, len(time_s))
    return fits.Record(time_s, voltage_V, noisy_um, source="relaxing.csv")


@pytest.fixture(scope="module")
def result(record):
    return fits.fit_slow([record], lag=True, relaxations=4, levels=LEVELS, holdout=0.25, initial="negative")


def test_what_lags_and_relaxes_is_fitted_beside_the_loop(record, result):
    assert result.held_out.rms_um < 1.6 * NOISE_um
    assert result["lag.time_constant_s"].value == pytest.approx(LAG_s, rel=0.1)
    alone = fits.fit([record], levels=LEVELS, holdout=0.25, initial="negative")
    assert alone.held_out.rms_um > 3 * result.held_out.rms_um
    assert any("again with a lag" in remark for remark in alone.remarks)
    assert any("relaxations" in remark for remark in alone.remarks)


def test_the_model_is_saved_simulated_and_inverted(record, result, tmp_path):
    path = tmp_path / "model.json"
    fits.save_model(path, result.model, result.uncertainty, fits.fit_report(result))
    model = fits.load_model(path).model
    # From negative saturation up, and round smaller loops there.
    rise, waves = np.linspace(0, np.pi, 500), np.linspace(0, 5 * np.pi, 1000)
    wanted_um = np.r_[5.0 * (1.0 - np.cos(rise)), 10.0 - 3.0 * (1 - np.cos(waves))] + result.hysteresis.offset_um
    time_s = np.arange(len(wanted_um)) * INTERVAL_s
    found = fits.compensate(model, fits.Reference(time_s, wanted_um, "wanted.csv"))
    there_um = displacement(time_s, found.voltage_V)
    off_um = there_um - wanted_um
    assert np.std(off_um[50:]) < 3 * NOISE_um


@pytest.mark.study
def test_the_command_takes_both(record, tmp_path):
    path = tmp_path / "relaxing.csv"
    table = np.c_[record.time_s, record.voltage_V, record.displacement_um]
    np.savetxt(path, table, delimiter=",", header="time_s,voltage_V,displacement_um", comments="")
    asked = ["fit", path, "--lag", "--relaxation", 4, "--levels", LEVELS, "--holdout", 0.25, "--initial", "negative"]
    done = run(*asked, "--out", tmp_path / "model.json", "--json", "--quiet")
    assert done.exit_code == 0
    said = json.loads(done.stdout)
    assert said["parts"][0]["name"] == "hysteresis"
    assert said["held_out"]["rms_um"] < 1.6 * NOISE_um
    refused(run(*asked, "--model", "stage", "--out", tmp_path / "other.json"), "--lag")


def fast_run():
    rng = np.random.default_rng(seed_of("fast_relaxations"))
    time_s = np.arange(3000) * 2e-4
    voltage_V = 50 + 50 * np.sin(2 * np.pi * 10 * time_s)
    moved_um = 0.1 * voltage_V + 0.003 * lsim(([1.0], [0.05, 1.0]), voltage_V, time_s)[1]
    return fits.Record(time_s, voltage_V, moved_um + rng.normal(0, 0.001, len(time_s)), source="quick.csv")


def test_relaxations_of_fast_runs_begin_where_a_model_file_may_hold_them():
    quick = fast_run()
    constants_s = [float(part.time_constant_s) for part in _stage([quick], False, 3).parts[1:]]
    assert constants_s == pytest.approx([0.02, np.sqrt(0.02 * 0.15), 0.15], rel=1e-3)
    with pytest.raises(fits.DataError, match=r"relaxations from 0\.02 s on show in runs of 0\.08 s or more"):
        fits.fit_slow([quick[:300]], relaxations=2, levels=8)


@pytest.mark.study
def test_relaxations_of_fast_runs_are_saved_and_read(tmp_path):
    result = fits.fit_slow([fast_run()], relaxations=2, levels=8)
    fits.save_model(tmp_path / "model.json", result.model, result.uncertainty, fits.fit_report(result))
    constants_s = [float(part.time_constant_s) for part in fits.load_model(tmp_path / "model.json").model.parts[1:]]
    assert all(constant >= 0.02 for constant in constants_s)
