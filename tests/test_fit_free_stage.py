"""Stages whose hysteresis no regression solves for: against SciPy's adaptive integration and plays in NumPy."""

import dataclasses

import numpy as np
import pytest
from _command import columns_of, files, refused, run
from _plant_reference import play_positions
from _seed import seed_of
from _stage_records import linear_displacement, multisine
from scipy import stats
from scipy.integrate import solve_ivp

import fits
import microid as m

FREQUENCY_Hz, DAMPING, GAIN_um_per_V = 20.0, 0.1, 0.25
LAW = {"stiffness_um_per_V": 0.8, "beta": 0.15, "gamma": -0.05}
NOISE_um, T = 0.15, 1e-3
SEEN = {"mechanics.inner.natural_frequency_Hz": FREQUENCY_Hz, "mechanics.inner.damping_ratio": DAMPING}
SEEN |= {f"mechanics.law.{name}": value for name, value in LAW.items()}


def oscillator_record(rng, source="run.csv", samples=900):
    """A Bouc-Wen oscillator from rest, under lines through the samples of a multisine."""
    time_s = np.arange(samples) * T
    voltage_V = multisine(rng, time_s, 3.0, 60.0, 0.9, 60.0)
    voltage_V = voltage_V - voltage_V[0]
    omega = 2 * np.pi * FREQUENCY_Hz

    def motion(t, x):
        y, v, h = x
        w = GAIN_um_per_V * np.interp(t, time_s, voltage_V)
        turn = LAW["gamma"] * v * abs(h) + LAW["beta"] * abs(v) * h
        return [v, omega**2 * (w - y - h) - 2 * DAMPING * omega * v, LAW["stiffness_um_per_V"] * v - turn]

    settings = {"t_eval": time_s, "method": "LSODA", "rtol": 1e-9, "atol": 1e-10, "max_step": T}
    clean_um = solve_ivp(motion, (0, time_s[-1]), [0.0, 0.0, 0.0], **settings).y[0]
    return fits.Record(time_s, voltage_V, clean_um + 3.0 + NOISE_um * rng.standard_normal(samples), source=source)


def yielding(beta=0.1, gamma=0.0):
    """A start some way off; what is only seen together with something else is frozen, but for one of two gains."""
    law = m.hysteresis.BoucWen(0.0, 0.6, beta, gamma, substeps=1)
    mechanics = m.HystereticMechanics(m.Mechanics(24.0, 0.1, 1.25), law)
    return m.Stage.of(piezo=m.Piezo(0.2), mechanics=mechanics).freeze(
        "mechanics.law.slope_um_per_V", "mechanics.law.exponent"
    )


@pytest.fixture(scope="module")
def rig():
    """The later part of a record, and one from rest to hold out."""
    rng = np.random.default_rng(seed_of("free stage"))
    return oscillator_record(rng)[200:], oscillator_record(rng, "heldout.csv")


@pytest.fixture
def written(rig, tmp_path):
    """The record as a file, in a folder."""
    record = rig[0]
    table = np.column_stack([record.time_s, record.voltage_V, record.displacement_um])
    header = "time_s,voltage_V,displacement_um"
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header=header, comments="")
    return tmp_path


def test_an_oscillator_that_yields_is_found_from_a_start_some_way_off(rig):
    fitted = fits.fit_stage(rig[0], stage=yielding(), holdout=[rig[1]])
    assert fitted.status is fits.FitStatus.CONVERGED
    for name, value in SEEN.items():
        assert abs(fitted[name].value - value) < 4 * fitted[name].sd
        assert fitted[name].sd < 0.2 * abs(value)
        assert fitted[name].lower < fitted[name].value < fitted[name].upper
    gains = "piezo.gain_um_per_V", "mechanics.inner.gain"
    assert {p.name for p in fitted.parameters} == {*SEEN, *gains}
    assert fitted[gains[0]].value * fitted[gains[1]].value == pytest.approx(GAIN_um_per_V, rel=0.02)
    assert fitted.unseen in [(f"only {one} * {other} is seen, not each",) for one, other in (gains, gains[::-1])]
    # Held-out samples are off by the noise, and by nothing else.
    assert fitted.held_out.rms_um == pytest.approx(NOISE_um, rel=0.15)
    assert not fitted.misfit.far
    # What depends on how it moved before is neither fitted nor compared.
    assert all(50 < one.unknown < 400 for one in fitted.runs)
    # The sensor's offset does not load the spring.
    assert fitted.runs[0].offset_um == pytest.approx(3.0, abs=0.05)
    assert float(fitted.model["piezo"].offset_um) == 0.0
    assert fitted.model.substeps == fitted.runs[0].substeps > 1


def test_what_does_not_converge_is_no_answer(rig):
    endless = yielding(beta=-1.0, gamma=-1.0)  # a state without bound
    with pytest.raises(fits.FitError, match="the fit failed"):
        fits.fit_stage(rig[0], stage=endless, holdout=0.0, initial="negative")


def test_what_cannot_be_fitted_is_refused(rig):
    frozen = yielding().freeze("piezo", "mechanics")
    with pytest.raises(fits.DataError, match=r"no parameter is free.*thaw"):
        fits.fit_stage(rig[0], stage=frozen)
    with pytest.raises(fits.DataError, match="levels is 8, and the stage has no hysteresis on a grid"):
        fits.fit_stage(rig[0], stage=yielding(), levels=8)
    behind = fits.default_stage().thaw("mechanics.gain").swap("mechanics", yielding()["mechanics"])
    with pytest.raises(fits.DataError, match=r"the weights of hysteresis .* freeze"):
        fits.fit_stage(rig[0], stage=behind)


def test_plays_ahead_of_mechanics_are_found_wherever_the_poles_begin(rng):
    n, rate_Hz, finer = 1500, 4000.0, 16
    time_s = np.arange(n) / rate_Hz
    voltage_V = multisine(rng, time_s, 4.0, 250.0, 0.25, 20.0)
    voltage_V = voltage_V - voltage_V[0]
    fine_s = np.arange((n - 1) * finer + 1) / (rate_Hz * finer)
    path_V = np.interp(fine_s, time_s, voltage_V)
    weight, threshold_V = np.array([0.1, 0.05]), np.array([2.0, 8.0])
    driven_um = 0.2 * path_V + play_positions(path_V, threshold_V, np.zeros(2)) @ weight
    clean_um = linear_displacement(fine_s, driven_um, 1e-9, 120.0, 0.05, 1.0)[::finer]
    record = fits.Record(time_s, voltage_V, clean_um + 3.0 + 0.02 * rng.standard_normal(n), source="plays.csv")

    law = m.hysteresis.PrandtlIshlinskii(0.15, np.array([0.08, 0.08]), np.array([1.0, 10.0]), 0.0)
    stage = m.Stage.of(hysteresis=law, mechanics=m.Mechanics(20.0, 0.5)).freeze("mechanics.gain")
    found = fits.fit_stage(record, stage=stage, initial="negative")
    truth = [0.2, *weight, *threshold_V, 120.0, 0.05]
    for p, value in zip(found.parameters, truth, strict=True):
        assert abs(p.value - value) < 4 * p.sd
    assert found.held_out.rms_um == pytest.approx(0.02, rel=0.15)
    # Here the part of the law has room for the sensor's offset.
    assert float(found.model["hysteresis"].offset_um) == pytest.approx(3.0, abs=0.1)


def test_the_command_starts_from_a_model_file(rig, written):
    start, out = written / "start.json", written / "fitted.json"
    fits.save_model(start, yielding(), None, {})
    told = run("info", start)
    assert told.stdout.endswith("saved without the uncertainty of a fit, so how well it predicts is not known\n")

    done = run("fit", written / "run.csv", "--start", start, "--holdout", "0.0", "--out", out)
    assert done.exit_code == 0, done.stderr
    assert "mechanics (HystereticMechanics)" in done.stdout
    loaded = fits.load_model(out)
    assert loaded.report["status"] == "converged"
    found = {p["name"]: p for p in loaded.report["parameters"]}
    for name, value in SEEN.items():
        assert abs(found[name]["value"] - value) < 4 * found[name]["sd"]

    assert run("info", out).exit_code == 0
    program = np.c_[rig[1].time_s, rig[1].voltage_V]
    np.savetxt(written / "p.csv", program, delimiter=",", header="time_s,voltage_V", comments="")
    done = run("simulate", out, written / "p.csv", "--out", written / "out.csv")
    assert done.exit_code == 0, done.stderr
    off_um = rig[1].displacement_um - columns_of(written / "out.csv")["displacement_um"]
    assert np.std(off_um) < 2 * NOISE_um


def test_the_command_refuses_bad_starts_in_one_sentence(written):
    (written / "text.json").write_text("no model")
    (written / "other.json").write_text("{}")
    fits.save_model(written / "piezo.json", m.Piezo(0.1), None, {})
    fits.save_model(written / "start.json", yielding(), None, {})
    before = files(written)

    def fit(start, *more):
        return run("fit", written / "run.csv", "--start", written / start, "--out", written / "out.json", *more)

    refused(fit("missing.json"), "missing.json")
    refused(fit("text.json"), "text.json", "JSON")
    refused(fit("other.json"), "other.json", "expected a model")
    refused(fit("piezo.json"), "piezo.json", "expected a stage to start from, found a Piezo")
    refused(fit("start.json", "--lag"), "--lag")
    refused(fit("start.json", "--out", written / "start.json"), "start.json")
    assert files(written) == before


@pytest.mark.study
def test_intervals_hold_what_they_say():
    z = []
    for k in range(15):
        rng = np.random.default_rng(seed_of(f"free stage {k}"))
        record = dataclasses.replace(oscillator_record(rng), source=f"rig {k}")
        found = fits.fit_stage(record, stage=yielding(), holdout=0.0, initial="negative")
        z.append([(found[name].value - value) / found[name].sd for name, value in SEEN.items()])
    z = np.array(z)
    print("rms of (estimate - truth) / sd", np.sqrt(np.mean(z**2, axis=0)), "inside 95 %", np.mean(np.abs(z) < 1.96))
    # Each parameter's mean square is a chi-square, wrong by chance once in ten thousand studies.
    low, high = stats.chi2.ppf([5e-5, 1 - 5e-5], len(z)) / len(z)
    assert np.all(np.mean(z**2, axis=0) < high * 1.25)
    assert np.all(np.mean(z**2, axis=0) > low / 1.25)
