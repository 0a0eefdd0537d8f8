"""Intervals of the parameters of causes where records hardly show one of them, against SciPy's filter."""

from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter
from test_diagnosis_comparison import NOISE_UM, stage_on

from fits import Record
from fits.diagnosis._effects import Bench, Law
from fits.diagnosis._explanation import Cause, Explanation, best_of_ends
from fits.diagnosis._findings import _parameters, profile_likelihood
from fits.diagnosis._joint_fit import leave_bounds
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import nothing, refit
from fits.diagnosis._regression import regress
from fits.diagnosis._thresholds import THRESHOLDS
from fits.stats._noise import Noise
from microid import Driver
from microid.effects import EFFECTS
from microid.effects.bouc_wen_hysteresis import BoucWenHysteresis
from microid.effects.mains_hum import MainsHum
from microid.effects.second_resonance import SecondResonance

STEP_S, COUNT = 0.01, 3300


def lagging(warm_K, lag_s):
    """What follows a temperature with a lag, in lines between samples."""
    keep = np.exp(-STEP_S / lag_s)
    late = (1 - keep) * lag_s / STEP_S
    return lfilter([1 - late, late - keep], [1, -keep], warm_K - warm_K[0])


def drifting(rng, expansion_um_per_K, lag_s):
    """A law fitted to a drift that was planted in what a plain stage leaves, and what it was fitted with."""
    seed = int(rng.integers(2**31))
    time_s = STEP_S * np.arange(COUNT)
    voltage_V = 50 + 50 * np.cos(2 * np.pi * 0.3 * time_s) * (1 - 0.01 * time_s)
    # Its first value is read off a line through the first readings.
    periods_s, phases = rng.uniform([12, 25], [16, 40]), rng.uniform(0, 2 * np.pi, 2)
    warm_K = 20 + 0.3 * np.sin(2 * np.pi * time_s[:, None] / periods_s + phases).sum(1)
    beside = {"temperature_degC": warm_K}
    bare = [Record(time_s, voltage_V, voltage_V / 10, beside, source="slow")]
    plain = Bench(stage_on(seed, bare, False)).plain[0]
    planted = expansion_um_per_K * lagging(warm_K, lag_s)
    measured = [replace_(bare[0], plain + planted + NOISE_UM * rng.standard_normal(COUNT))]
    bench = Bench(stage_on(seed, measured, False))
    projector = Projector(regress(bench.baseline), [Noise(NOISE_UM, np.zeros(0))], (0.0, 0.0))
    form = next(one for one in EFFECTS if (one.name, one.form) == ("thermal_drift", "temperature"))
    law = Law([form(jnp.asarray(expansion_um_per_K), jnp.asarray(lag_s))])
    return SimpleNamespace(
        bench=bench, projector=projector, warm_K=warm_K, model=refit(bench, projector, [law], [law.start])
    )


def replace_(record, displacement_um):
    return Record(record.time_s, record.voltage_V, displacement_um, record.extra, source=record.source)


def followed(case):
    law, x = case.model.laws[0], case.model.x[0]
    covariance = case.model.covariance()
    along = profile_likelihood(case.bench, case.projector, case.model, 0, covariance)
    return covariance, along, [law.effect(there, 0) for _, there in along], law, x


@pytest.mark.study
def test_a_lag_that_does_not_show_is_followed_as_far_as_it_may_be(rng):
    case = drifting(rng, 0.004, 5.0)
    covariance, along, effects, law, x = followed(case)
    left = case.projector.off(case.projector.residual)
    costs, sizes = [], []
    for effect in effects:
        # For each lag, the best expansion by ordinary least squares, and what it leaves.
        column = case.projector.off(case.projector.join([lagging(case.warm_K, float(effect.time_constant_s))]))
        sizes.append(column @ left / (column @ column))
        costs.append(left @ left - (column @ left) ** 2 / (column @ column))
    lowest = min(case.model.cost, *costs)
    away = np.maximum(np.sqrt(np.array(costs) - lowest), 3)
    # How many steps it takes is chance.
    assert len(along) > 2
    assert profile_likelihood(case.bench, case.projector, case.model, 0, covariance, lambda: False) == []
    np.testing.assert_allclose([one for one, _ in along], away, atol=0.05)
    # An expansion goes a little way at a time; for lags far beyond the record it would have far to go.
    near = np.abs(sizes) < 0.3
    found = np.array([float(effect.expansion_um_per_K) for effect in effects])
    np.testing.assert_allclose(found[near], np.array(sizes)[near], rtol=0.02, atol=1e-4)
    # What is reported reaches as far.
    expansion = _parameters(law, x, covariance, along, STEP_S)[0]
    above = np.max((np.array(sizes)[near] - expansion.value) / away[near])
    assert expansion.upper >= expansion.value + 1.9 * above


@pytest.mark.study
def test_what_shows_well_is_not_followed(rng):
    case = drifting(rng, 2.0, 5.0)
    covariance, along, _, law, x = followed(case)
    assert along == []
    value, sd = (getattr(_parameters(law, x, covariance, along, STEP_S)[1], name) for name in ("value", "sd"))
    assert value == pytest.approx(5.0, abs=5 * sd)


def bench_of(count, respond):
    """A bench of one run, whose effects are a function of their own."""
    return SimpleNamespace(
        prepared=[None],
        plain=[np.zeros(count)],
        simulate_in=lambda run, own, near: respond(own),
        displacement_um=lambda run, simulated: simulated,
    )


def test_a_fit_finds_its_way_from_near_a_bound():
    # Here a Gauss-Newton step, cut to the farthest that is allowed, goes beyond the optimum to where all is worse.
    column = np.linspace(-1e3, 1e3, 50)
    form = next(one for one in EFFECTS if one.name == "voltage_dependent_capacitance")
    law = Law([form(Driver(1e-3), jnp.asarray(0.886), jnp.zeros(()), jnp.ones(()))])
    bench = bench_of(50, lambda own: float(own[0].slope) * column)
    projector = SimpleNamespace(residual=0.8 * column, off=lambda joined: joined, join=lambda signals: signals[0])
    found = refit(bench, projector, [law], [law.start])
    assert float(law.effect(found.x[0], 0).slope) == pytest.approx(0.8, abs=1e-3)


def test_a_line_turns_its_amplitudes_as_its_frequency_is_found(rng):
    # 0.02 Hz off the phase runs away by a turn and a half: large amplitudes have to change place.
    time_s, phase = np.arange(4000) / 500, rng.uniform(0, 2 * np.pi)
    wave = 2 * np.pi * 50.025 * time_s + phase

    def lines(own):
        turns = 2 * np.pi * float(own[0].frequency_Hz) * time_s * np.arange(1, 4)[:, None]
        return np.asarray(own[0].cosine_um) @ np.cos(turns) + np.asarray(own[0].sine_um) @ np.sin(turns)

    start = np.array([0.4 * np.cos(phase + 1.0), 0.0, 0.0]), np.array([-0.4 * np.sin(phase + 1.0), 0.0, 0.0])
    law = Law([MainsHum(*map(jnp.asarray, start), jnp.asarray(50.008))])
    bench = bench_of(4000, lines)
    noise = 0.06 * rng.standard_normal(4000)
    projector = SimpleNamespace(
        residual=(0.4 * np.cos(wave) + noise) / 0.06, off=lambda joined: joined, join=lambda um: um[0] / 0.06
    )
    found = refit(bench, projector, [law], [law.start])
    assert float(law.effect(found.x[0], 0).frequency_Hz) == pytest.approx(50.025, abs=1.2e-3)
    assert found.cost == pytest.approx(4000, rel=0.12)


def at_slope(value, truth):
    """A capacitance of some slope, in records that show another."""
    column = np.linspace(-1e3, 1e3, 50)
    form = next(one for one in EFFECTS if one.name == "voltage_dependent_capacitance")
    law = Law([form(Driver(1e-3), jnp.asarray(value), jnp.zeros(()), jnp.ones(()))])
    bench = bench_of(50, lambda own: float(own[0].slope) * column)
    projector = SimpleNamespace(residual=truth * column, off=lambda joined: joined, join=lambda signals: signals[0])
    return bench, projector, refit(bench, projector, [law], [law.start], 0)


@pytest.mark.parametrize("way", [1, -1])
def test_what_ended_at_its_bound_is_tried_weaker_where_the_baseline_follows(way, monkeypatch):
    # Beside the baseline as it is, the bound is best; beside one that has followed something weaker, that is.
    stuck = at_slope(way * (0.9 - 1e-9), way * 2.0)
    freed = at_slope(way * 0.7, way * 0.7)[:2]
    monkeypatch.setattr("fits.diagnosis._joint_fit._follow", lambda *_: freed)
    assert stuck[-1].laws[0].at_bound(stuck[-1].x[0])
    *at, model = leave_bounds(*stuck, False)
    assert float(model.laws[0].effect(model.x[0], 0).slope) == pytest.approx(way * 0.7, abs=1e-3)
    assert tuple(at) == freed


def test_at_a_bound_where_weaker_is_worse_it_stays(monkeypatch):
    stuck = at_slope(0.9 - 1e-9, 1.0)
    worse = at_slope(0.9 - 1e-9, 5.0)[:2]
    monkeypatch.setattr("fits.diagnosis._joint_fit._follow", lambda *_: worse)
    assert leave_bounds(*stuck, False) == stuck


def test_what_is_not_at_its_bound_stays(monkeypatch):
    inside = at_slope(0.7, 2.0)
    monkeypatch.setattr("fits.diagnosis._joint_fit._follow", lambda *_: at_slope(0.5, 0.5)[:2])
    assert leave_bounds(*inside, False) == inside


def test_a_parameter_alone_in_its_effect_is_followed_with_the_other_effects_fitted_around_it():
    form = next(one for one in EFFECTS if one.name == "voltage_dependent_capacitance")
    first = 5 * np.linspace(-1, 1, 50)
    second = first**3 / 25
    laws = [Law([form(Driver(1e-3), jnp.asarray(slope), jnp.zeros(()), jnp.ones(()))]) for slope in (0.85, 0.3)]
    assert [law.size for law in laws] == [1, 1]
    bench = bench_of(50, lambda own: float(own[0].slope) * first + float(own[1].slope) * second)
    measured = 0.85 * first + 0.3 * second
    projector = SimpleNamespace(residual=measured, off=lambda joined: joined, join=lambda signals: signals[0])
    model = refit(bench, projector, laws, [law.start for law in laws])
    along = profile_likelihood(bench, projector, model, 0, np.eye(1))
    slopes = np.array([float(laws[0].effect(there, 0).slope) for _, there in along])
    left = measured - slopes[:, None] * first
    # The second slope has bounds of its own.
    others = np.clip(left @ second / (second @ second), -0.9, 0.9)
    costs = np.sum((left - others[:, None] * second) ** 2, axis=1)
    assert len(along) > 2
    np.testing.assert_allclose([away for away, _ in along], np.maximum(np.sqrt(costs), 3), atol=0.02)
    assert np.any(costs > 9)


def test_of_explanations_that_are_not_told_apart_one_with_nothing_near_its_bound_is_taken():
    bench, projector, stuck = at_slope(0.9 - 1e-9, 0.9)
    inside = at_slope(0.2, 0.2)[-1]
    plain = nothing(bench, projector)
    projector.count = 50

    def explained_by(one):
        criterion = one.criterion(projector.count)
        return Explanation((), bench, projector, one, (), None, criterion, criterion, np.zeros(0))

    bound, free, none = map(explained_by, (stuck, inside, plain))
    # Where there is no effect, there is no bound.
    assert [one.near_bound for one in (bound, free, none)] == [True, False, False]
    assert best_of_ends([none], plain, THRESHOLDS) is none
    assert best_of_ends([bound, free], plain, THRESHOLDS) is free
    assert best_of_ends([bound, none], plain, THRESHOLDS) is bound


def test_causes_that_add_less_than_the_models_of_others_are_off_by_do_not_count():
    _, _, one = at_slope(0.2, 0.2)
    plain = replace(one, cost=20000.0)

    def explained_by(cost, *names):
        causes = [Cause(name, 50.0, 0.0, (), 1.0) for name in names]
        return Explanation(tuple(causes), None, None, replace(one, cost=cost), (), None, cost, cost, np.zeros(0))

    # Models are off by 6 % of 100 standard deviations, those of confusions by 60 %.
    creep = explained_by(10000.0, "creep")
    for name, most in (("slew_limit", 36.0), ("mount_relaxation", 3600.0)):
        for gained, first in ((0.9 * most, creep), (1.1 * most, None)):
            both = explained_by(10000.0 - gained, name, "creep")
            assert best_of_ends([both, creep], plain, THRESHOLDS) is (first or both), name


def test_a_mode_without_a_peak_and_a_play_are_at_a_bound():
    """Beyond a damping ratio of 1 / sqrt(2) no peak is left, and a high power switches as a play does."""

    def at_bound(make, *values):
        law = Law([make(None, *map(jnp.asarray, values))])
        return law.at_bound(law.start)

    assert [at_bound(SecondResonance, 0.01, 300.0, one) for one in (0.05, 0.5, 0.699)] == [False, False, True]
    laws = [at_bound(BoucWenHysteresis, 0.1, 0.3, 0.8, one, 100.0) for one in (1.4, 6.0, 9.99)]
    assert laws == [False, False, True]
