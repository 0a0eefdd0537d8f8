"""Runs that begin where no loop comes by, made by plain plays; and steps that a bound or a zero once broke."""

from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from test_diagnosis_tangent import baseline_of

from fits import FitError, Record, diagnose
from fits.diagnosis._effects import Bench, Law
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import refit
from fits.diagnosis._regression import _slope_of_change, regress
from fits.loop._choose_grid import _resolve
from fits.loop._known import known_samples
from fits.loop._result import FitStatus
from fits.stats._noise import Noise
from microid.effects.backlash import Backlash

NOISE_um = 0.02


def plays(voltage_V, start_V):
    """Displacement of plays of all widths that rested at one voltage, or stand where a loop leaves them (None)."""
    half_V = np.linspace(0, 50, 800)
    weight = np.exp(-half_V / 15)
    place = np.full_like(half_V, 0.0 if start_V is None else start_V) + (half_V if start_V is None else 0.0)
    out = []
    for voltage in voltage_V:
        place = np.minimum(np.maximum(place, voltage - half_V), voltage + half_V)
        out.append(weight @ place)
    return 0.3 * np.array(out) / weight.sum()


def record(rng, start_V):
    """Reversal curves between 0 and 100 V, from the bottom."""
    turns = [0, 100, 0, 80, 20, 100, 40, 70, 30, 90, 0, 60, 10, 100, 0, 50, 5, 75, 25, 100, 0]
    path = np.r_[0, np.cumsum(np.abs(np.diff(turns)))]
    voltage_V = np.interp(np.linspace(0, path[-1], 3000), path, turns)
    reading_um = plays(voltage_V, start_V) + NOISE_um * rng.standard_normal(len(voltage_V))
    return Record(np.arange(3000) / 50, voltage_V, reading_um, source="plays.csv")


@pytest.mark.parametrize("start_V", [0.0, pytest.param(None, marks=pytest.mark.study)])
def test_a_first_way_of_its_own_is_no_effect(rng, start_V):
    run = record(rng, start_V)
    found = diagnose([run])
    assert found.verdict == "no_effect"
    assert found.noise_um == pytest.approx(NOISE_um, rel=0.1)
    # The first way differs from later ones by far more than noise, and nothing of it is left out.
    assert float(np.ptp(plays(run.voltage_V, 0.0) - plays(run.voltage_V, None))) > 20 * NOISE_um
    assert found.runs[0].fitted.sum() >= 0.79 * len(run)


def test_a_line_in_the_noise_is_no_mode():
    # Noise in which a mode without damping, which nothing drives, explains more than chance does as a rule.
    found = diagnose([record(np.random.default_rng(0), 0.0)])
    assert found.verdict == "no_effect"
    assert found.baseline_parameters == ()


def test_samples_known_whatever_was_before():
    voltage_V = np.array([0.0, 50.0, 100.0, 50.0, 0.0, 50.0])
    assert known_samples(voltage_V, 0.0, 100.0).tolist() == [True] * 6
    # Within the range, the extremes of the run itself.
    assert known_samples(voltage_V / 2 + 10, 0.0, 100.0).tolist() == [False, False, True, True, True, True]
    assert known_samples(voltage_V / 2 + 10, 0.0, 100.0, "negative").all()


@pytest.mark.study
def test_a_coordinate_at_its_bound_holds_no_other_back(rng):
    baseline = baseline_of(rng)
    bench, truth_um = Bench(baseline), 0.03
    gap = Backlash(jnp.asarray(truth_um), jnp.asarray(1.0 - 1e-12))
    sd = 1e-3
    change_um = bench.respond([[gap]] * len(bench.prepared))
    regression = regress(baseline)
    noisy = tuple(
        after - before + sd * rng.standard_normal(len(after))
        for after, before in zip(change_um, bench.plain, strict=True)
    )
    projector = Projector(replace(regression, residuals=noisy), [Noise(sd, np.zeros(0))] * len(noisy))
    start = Law([replace(gap, half_gap_um=jnp.asarray(0.6 * truth_um))] * len(noisy))
    found = refit(bench, projector, [start], [start.start])
    half_gap_um = float(found.laws[0].effect(found.x[0], 0).half_gap_um)
    spread = found.covariance()[0, 0] ** 0.5 * half_gap_um
    assert half_gap_um == pytest.approx(truth_um, abs=5 * spread + 1e-3 * truth_um)


def test_what_shows_nothing_does_not_move_the_baseline(rng):
    baseline = baseline_of(rng)
    regression = regress(baseline)
    left = tuple(0.01 * rng.standard_normal(len(residual)) for residual in regression.residuals)
    noise = [Noise(0.01, np.zeros(0))] * len(left)
    plain = Projector(replace(regression, residuals=left), noise)
    # Unknowns of the runs that died away before the samples that count.
    own = tuple(np.concatenate([one, np.zeros((len(one), 2))], axis=1) for one in regression.nuisance)
    dead = Projector(replace(regression, residuals=left, nuisance=own), noise)
    expected, moved = (projector.move(projector.residual) for projector in (plain, dead))
    np.testing.assert_allclose(moved.z, expected.z, atol=1e-6)
    np.testing.assert_allclose(moved.columns_um, expected.columns_um, atol=1e-6)


def test_a_stage_without_driver_and_mechanics_has_no_coordinates(rng):
    static = SimpleNamespace(z=np.zeros(0))
    run = SimpleNamespace(record=record(rng, None))
    assert _slope_of_change(static, (Backlash(jnp.asarray(0.03), jnp.asarray(0.5)),), run).shape == (3000, 0)


def test_a_grid_that_fails_leaves_the_coarser():
    class Trial:
        def __init__(self, levels):
            self.error_um = 1.0 / levels
            self.solution = type("Solution", (), {"hyper": None})
            self.data = type("Data", (), {"grid": type("Grid", (), {"levels": levels})})

    def failing_beyond(most):
        def trial(levels, hyper):
            if levels > most:
                raise FitError(FitStatus.MAX_STEPS)
            return Trial(levels)

        return trial

    kept, trials = _resolve(failing_beyond(20), None, 64, 0.0)
    assert kept.data.grid.levels == trials[-1].levels <= 20
    with pytest.raises(FitError):
        _resolve(failing_beyond(0), None, 64, 0.0)
