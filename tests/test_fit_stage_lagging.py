"""Fast runs behind a lag, which begin in the middle of their motion and never get to the ends of their command."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from _command import run
from _plant_reference import driver_and_mechanics, states
from _wrong_records import said
from scipy import signal

import data_synth
import fits
import microid as m
from fits.diagnosis import _baseline
from fits.stage._plan import Plan
from fits.stage._solve import Problem
from fits.stage._steps import _visible

RATE_Hz, LAG_s, FINE = 10_000.0, 0.55e-3, 40


def triangle(rng, frequency_Hz, periods, noise_um=2e-4):
    """A triangle of +-90 V that has run for long, through a lag and plays, read by a sensor almost without noise."""
    period = round(RATE_Hz / frequency_Hz)
    n = period * (periods + 2) * FINE + 1
    command = 90 * signal.sawtooth(2 * np.pi / (period * FINE) * np.arange(n), 0.5)
    _, lagging, _ = signal.lsim(([1], [LAG_s, 1]), command - command[0], np.arange(n) / (RATE_Hz * FINE))
    lagging += command[0]
    radii = np.linspace(0.5, 40, 60)
    weight = np.exp(-radii / 20)
    play, moved = np.zeros(60), np.empty(n)
    for k, value in enumerate(lagging):
        play = np.clip(play, value - radii, value + radii)
        moved[k] = 0.1 * value + 0.17 * (play @ weight) / weight.sum()
    seen = slice(2 * period * FINE, None, FINE)
    reading = moved[seen] + noise_um * rng.standard_normal(len(moved[seen]))
    return fits.Record(np.arange(len(reading)) / RATE_Hz, command[seen], reading, source=f"{frequency_Hz:g}Hz.csv")


@pytest.mark.parametrize(
    ("frequencies_Hz", "periods"),
    [
        pytest.param((40.0, 100.0), (6, 15), id="two"),
        pytest.param((100.0,), (15,), id="one", marks=pytest.mark.study),
    ],
)
@pytest.mark.study
def test_a_lag_is_found_whatever_came_before(rng, frequencies_Hz, periods):
    records = [triangle(rng, *each) for each in zip(frequencies_Hz, periods, strict=True)]
    result = fits.fit_stage(records, levels=24)
    assert "show a lag, but no resonance" in said(result, "mechanics was left out")
    assert [parameter.name for parameter in result.parameters] == ["driver.time_constant_s"]
    # The rest of a per cent is structure finer than the grid: the least of the plays moves after 0.5 V.
    assert result["driver.time_constant_s"].value == pytest.approx(LAG_s, rel=0.01)
    assert result.held_out.e_rms_pct < 0.02
    # Structure finer than the grid is alike over a few samples: 1.7 at most on nine rigs.
    assert max(run.correlation_samples for run in result.runs) < 5


def test_a_linear_stage_is_fitted_to_a_run_with_hysteresis(tmp_path):
    # What no linear stage follows changes slowly, over hundreds of samples, and hides what the mode does.
    assert run("synth", "stage", "--out", tmp_path).exit_code == 0
    stage = m.Stage.of(driver=m.Driver(1e-3), piezo=m.Piezo(0.3), mechanics=m.Mechanics(100.0, 0.1))
    found = fits.fit_stage([tmp_path / "fast.csv"], stage=stage.freeze("driver.gain", "mechanics.gain"))
    # Of that rig; that of a linear stage is of no rig, so that no interval is asked for.
    assert found["mechanics.natural_frequency_Hz"].value == pytest.approx(180.0, rel=0.03)


@pytest.fixture(scope="module")
def hidden_by_a_lag(tmp_path_factory):
    """A slow and a fast run of a rig with a resonance of 134 Hz behind a sensor with a low-pass of 20 ms."""
    sizes = {"slow_samples": 1500, "fast_samples": 3000, "temperature": False, "other_axis": False}
    bench = data_synth.hidden(("sensor_lowpass",), seed=78, rms_per_noise=300.0, **sizes)
    folder = tmp_path_factory.mktemp("lag")
    data_synth.write(bench, folder)
    return folder / "slow.csv", folder / "fast.csv"


def test_a_lag_that_hides_the_resonance_is_thought_of(hidden_by_a_lag, tmp_path):
    """The rate is 26 times the resonance: to sample faster would not help."""
    told = run("fit", *hidden_by_a_lag, "--model", "stage", "--levels", 8, "--out", tmp_path / "stage.json")
    assert told.exit_code == 2
    assert (
        "a lag of the readings may hide the resonance, too: microid diagnose fits the stage beside one" in told.stderr
    )


def test_a_diagnosis_does_not_advise_itself(hidden_by_a_lag, monkeypatch):
    def refused(*_, **__):
        fits.fit_stage(hidden_by_a_lag, levels=8)

    monkeypatch.setattr(_baseline, "solve_stage", refused)
    monkeypatch.setattr(_baseline, "_static", lambda *given: SimpleNamespace(dynamic=False, remarks=given[-2]))
    (remark,) = _baseline.fit_baseline(fits.read_runs(hidden_by_a_lag), [], 0.2, "negative", print).remarks
    assert "taken as quasi-static: fast.csv: " in remark
    assert "microid diagnose" not in remark


def test_a_driver_faster_than_a_sample_is_seen_under_steps(rng):
    truth = {"driver.time_constant_s": 9e-5, "mechanics.natural_frequency_Hz": 260.0, "mechanics.damping_ratio": 0.02}
    interval_s, per_step = 2.5e-4, 120
    ramp = np.concatenate(
        [np.linspace(a, b, 400, endpoint=False) for a, b in [(0, 100), (100, 10), (10, 80), (80, 0)]]
    )
    voltage = np.concatenate([ramp, np.repeat(rng.uniform(0, 100, 12), per_step)])
    time = interval_s * np.arange(len(voltage))
    seen = states(*driver_and_mechanics(*truth.values()), time, voltage, "zero", 0.0)[:, 1]
    record = fits.Record(time, voltage, 0.8 * seen + rng.normal(0, 0.015, len(time)), source="one.csv")
    result = fits.fit_stage([record], stage=fits.default_stage("zero"), initial="negative", levels=8, holdout=0.0)
    for name, value in truth.items():
        # Sixteen steps per sample follow it to some thousandths.
        assert abs(result[name].value - value) < 5 * result[name].sd + 5e-3 * value
    assert result.in_sample.rms_um < 1.1 * 0.015


@pytest.mark.parametrize(
    ("hold", "tau_s", "begun_s"), [("zero", 1e-9, 8e-5), ("zero", 3e-4, 3e-4), ("first", 1e-6, 1e-6)]
)
def test_a_fit_begins_with_a_driver_that_held_commands_show(hold, tau_s, begun_s):
    """One that settles between steps has no derivative; the study of held commands fits such rigs."""
    record = fits.Record(4e-4 * np.arange(50), np.arange(50.0), np.arange(50.0), source="run.csv")
    parts = {"driver": m.Driver(tau_s), "piezo": m.Piezo(0.2), "mechanics": m.Mechanics(120.0, 0.05)}
    stage = m.Stage.of(hold=hold, **parts).freeze("driver.gain", "mechanics.gain")
    plan = Plan((record,), ("unknown",), 0.0, (0.0, 49.0), "squares", lambda _: None, None, (hold,), False)
    problem = _visible(plan, Problem.of(stage, None, np.zeros(0), None, 1.0))
    begun = problem.chain.stage(jnp.asarray(problem.z), jnp.zeros(0))
    assert float(begun["driver"].time_constant_s) == pytest.approx(begun_s, rel=1e-3)
    assert float(begun["mechanics"].natural_frequency_Hz) == pytest.approx(120.0)
