"""The unknown past of a run against relays in random states."""

import jax.numpy as jnp
import numpy as np
import pytest
from _models import random_model
from scipy.interpolate import BSpline
from scipy.signal import lsim

import data_synth
import fits
import microid as m
from fits import Record
from fits.diagnosis._baseline import fit_baseline
from fits.loop._known import known_samples, pasts_to_estimate
from fits.loop._past import past_columns, rough_past_columns
from fits.loop._run import prepare_run
from fits.stage._run import nuisance_columns
from fits.stats._noise import stretches

# Columns of either function that are splines; those of its kinks follow.
LEVELS, SPLINES = 120, 7


def relays(voltage, state, weight, on_V, off_V):
    """The sum of relays, one loop in Python over the samples."""
    out = np.empty(len(voltage))
    for k, value in enumerate(voltage):
        state = np.where(value >= on_V, 1.0, np.where(value <= off_V, -1.0, state))
        out[k] = weight @ state
    return out


def half_plane(rng):
    """Relays over 0 to 1 V, and a smooth density that decays with their width and varies with their bias."""
    level = (np.arange(LEVELS) + 0.5) / LEVELS
    on_V, off_V = (one.ravel() for one in np.meshgrid(level, level, indexing="ij"))
    inside = on_V > off_V
    on_V, off_V = on_V[inside], off_V[inside]
    weight = np.exp(-(on_V - off_V) / 0.3) * (1 + 0.5 * np.sin(4 * (on_V + off_V) + rng.uniform(0, 6)))
    return on_V, off_V, weight / weight.sum()


def grown(n, start):
    """A sine whose amplitude grows, so that it goes a little farther each time."""
    phase = np.linspace(0, 24 * np.pi, n)
    return (
        0.5 + (start - 0.5) * np.cos(phase) + (0.5 - abs(start - 0.5)) * np.linspace(0, 1, n) ** 0.7 * np.sin(phase)
    )


WAYS = {
    "up first": lambda n: np.interp(np.linspace(0, 4, n), [0, 1, 2, 3, 4], [0.3, 0.9, 0.1, 0.9, 0.3]),
    "down first": lambda n: np.interp(np.linspace(0, 4, n), [0, 1, 2, 3, 4], [0.6, 0.2, 0.8, 0.4, 0.8]),
    "ever farther": lambda n: grown(n, 0.5),
    "a little, and then farther": lambda n: np.interp(
        np.linspace(0, 4, n), [0, 1, 2, 3, 4], [0.5, 0.65, 0.1, 0.9, 0.3]
    ),
}


@pytest.mark.parametrize("way", WAYS)
def test_relays_not_yet_swept_add_what_the_columns_span(rng, way):
    on_V, off_V, weight = half_plane(rng)
    # Not on a level, so that no relay switches on the spot.
    voltage = WAYS[way](4000) + 1e-6
    swept = np.where(voltage[0] >= on_V, 1.0, -1.0)
    known = (on_V <= voltage[0]) | (off_V >= voltage[0])
    # Whatever turns it went through before: states that vary smoothly over the half-plane.
    phases = rng.uniform(0, 6) + np.linspace(0, 2 * np.pi, 6)
    pasts = [np.clip(3 * np.sin(5 * on_V - 3 * off_V + phase), -1, 1) for phase in phases]
    # That which differs most from none.
    before = max(pasts, key=lambda past: weight[~known] @ (past[~known] + 1))
    past = relays(voltage, np.where(known, swept, before), weight, on_V, off_V)
    plain = relays(voltage, np.where(known, swept, -1.0), weight, on_V, off_V)
    columns = np.asarray(past_columns(jnp.asarray(voltage)))
    basis = np.concatenate([columns, np.ones((len(voltage), 1))], axis=1)
    difference = past - plain
    left = difference - basis @ np.linalg.lstsq(basis, difference, rcond=None)[0]
    assert np.std(difference) > 0.01
    # What is left is the relays' own coarseness, and what a sum of two functions misses.
    assert np.std(left) < 0.05 * np.std(difference)


def test_a_function_of_how_far_a_run_went_has_a_kink_where_it_went_the_other_way(rng):
    """Plays at rest; a first swing smaller than the next left 25 nm of 11 um, which looked like a zero shift."""
    start, first = 0.5, rng.uniform(0.6, 0.75)
    voltage = np.interp(np.linspace(0, 4, 4000), range(5), [start, first, 0.1, 0.9, 0.3])
    radius = rng.gamma(2.0, 0.08, 2000)
    difference = np.empty(len(voltage))
    rested, swept = np.full(len(radius), start), np.full(len(radius), start - radius)
    for k, value in enumerate(voltage):
        rested, swept = (np.clip(one, value - radius, value + radius) for one in (rested, swept))
        difference[k] = np.mean(rested - swept)
    columns = np.asarray(past_columns(jnp.asarray(voltage)))
    splines = np.concatenate([half[:, :SPLINES] for half in np.split(columns, 2, axis=1)], axis=1)

    def left(basis):
        basis = np.concatenate([basis, np.ones((len(voltage), 1))], axis=1)
        return np.std(difference - basis @ np.linalg.lstsq(basis, difference, rcond=None)[0])

    print(np.std(difference), left(splines), left(columns))
    assert left(columns) < 0.01 * np.std(difference)
    assert left(columns) < 0.3 * left(splines)


def play(voltage, radius, at):
    """One play, one loop in Python over the samples."""
    out = np.empty(len(voltage))
    for k, value in enumerate(voltage):
        at = out[k] = min(max(at, value - radius), value + radius)
    return out


@pytest.mark.parametrize("way", WAYS)
def test_the_past_of_few_plays_has_kinks_that_no_spline_follows(rng, way):
    voltage = WAYS[way](4000)
    difference = np.zeros(len(voltage))
    for radius in rng.uniform(0.02, 0.3, 6):
        before = voltage[0] + radius * rng.uniform(-1, 1)
        difference += rng.exponential() * (play(voltage, radius, before) - play(voltage, radius, voltage[0] - radius))
    smooth = np.concatenate([past_columns(jnp.asarray(voltage)), np.ones((len(voltage), 1))], axis=1)
    rough = np.concatenate([smooth, rough_past_columns(voltage, np.linspace(0, 1, 65))], axis=1)
    left, less = (
        np.std(difference - basis @ np.linalg.lstsq(basis, difference, rcond=None)[0]) for basis in (smooth, rough)
    )
    assert np.std(difference) > 0.01
    assert less < 0.5 * left
    assert less < 0.02 * np.std(difference)


@pytest.mark.parametrize("stride", [1, 3])
def test_what_a_past_adds_rings_as_the_mechanics_does(rng, stride):
    """A jump to where the run has not been, of plays in random states between two lags, by SciPy."""
    rate_Hz, natural = 4000.0, 2 * np.pi * rng.uniform(150, 400)
    lag_s = rng.uniform(2e-4, 2e-3)
    parts = {"hysteresis": random_model(rng), "mechanics": m.Mechanics(natural / (2 * np.pi), 0.03)}
    stage = m.Stage.of(driver=m.Driver(lag_s), **parts)
    time_s = np.arange(2000) / rate_Hz
    volts = np.interp(time_s, [0, 0.1, 0.2, 0.25, 0.2501, 0.4, 0.5], np.array([0.3, 0.5, 0.2, 0.4, 0.9, 0.1, 0.3]))
    fine_s = np.arange(1999 * 8 + 1) / rate_Hz / 8
    command_V = np.interp(fine_s, time_s, volts)
    driven_V = volts[0] + lsim(([1.0], [lag_s, 1.0]), command_V - volts[0], fine_s)[1]
    difference = np.zeros(len(fine_s))
    for radius in np.linspace(0.02, 0.4, 60):
        before = driven_V[0] + radius * rng.uniform(-1, 1)
        difference += np.exp(-radius / 0.2) * (
            play(driven_V, radius, before) - play(driven_V, radius, driven_V[0] - radius)
        )
    moved = lsim(([natural**2], [1.0, 0.06 * natural, natural**2]), difference - difference[0], fine_s)[1][::8]
    run = prepare_run(Record(time_s, volts, volts), (0.1, 0.9), "unknown", 0.0, stride, estimated=True)
    basis = np.asarray(nuisance_columns(stage, run.samples))[: len(moved)]
    still = np.concatenate([past_columns(jnp.asarray(driven_V[::8])), np.ones((len(moved), 1))], axis=1)
    left, less = (np.std(moved - one @ np.linalg.lstsq(one, moved, rcond=None)[0]) for one in (still, basis))
    assert np.std(moved) > 0.01
    assert less < 0.1 * left
    assert less < 0.02 * np.std(moved)


@pytest.mark.parametrize("stride", [1, 3])
def test_what_a_driver_was_still_charged_with_decays_along_the_slope_of_a_branch(rng, stride):
    """A curved branch between a driver that began elsewhere and the mechanics, by SciPy."""
    rate_Hz, natural, lag_s = 4000.0, 2 * np.pi * rng.uniform(150, 400), rng.uniform(1e-3, 3e-3)
    parts = {"hysteresis": random_model(rng), "mechanics": m.Mechanics(natural / (2 * np.pi), 0.03)}
    stage = m.Stage.of(driver=m.Driver(lag_s), **parts)
    fine_s = np.arange(1199 * 8 + 1) / rate_Hz / 8
    volts = np.full(1200, 0.4)
    volts[600:] += 0.2 * np.sin(2 * np.pi * 10 * fine_s[:4800:8])
    charged_V = rng.choice([-1, 1]) * rng.uniform(0.1, 0.3)
    rest_V = 0.4 + lsim(([1.0], [lag_s, 1.0]), np.interp(fine_s, fine_s[::8], volts) - 0.4, fine_s)[1]
    branch = np.polynomial.Polynomial([0.0, 1.0, *rng.uniform(-0.5, 0.5, 2)])
    difference = branch(rest_V + charged_V * np.exp(-fine_s / lag_s)) - branch(rest_V)
    moved = lsim(([natural**2], [1.0, 0.06 * natural, natural**2]), difference, fine_s)[1][::8]
    run = prepare_run(Record(fine_s[::8], volts, volts), (0.1, 0.9), "unknown", 0.0, stride)
    basis = np.asarray(nuisance_columns(stage, run.samples))[: len(moved)]
    left = moved - basis @ np.linalg.lstsq(basis, moved, rcond=None)[0]
    assert basis.shape[1] == 6
    assert np.std(left) < 0.02 * np.std(moved)


def test_columns_are_the_b_splines_of_scipy(rng):
    voltage = np.cumsum(rng.normal(0, 1, 200))
    for reached, columns in zip(
        (np.maximum.accumulate(voltage), np.minimum.accumulate(voltage)),
        np.split(np.asarray(past_columns(jnp.asarray(voltage))), 2, axis=1),
        strict=True,
    ):
        left = (reached[-1] - reached) / (reached[-1] - reached[0])
        knots = np.r_[np.zeros(4), 0.2, 0.4, 0.6, 0.8, np.ones(4)]
        np.testing.assert_allclose(
            columns[:, :SPLINES], BSpline.design_matrix(left, knots, 3).toarray()[:, 1:], atol=1e-13
        )


def test_a_past_is_estimated_where_a_loop_is_left_beside_it():
    once = np.r_[np.linspace(0, 1, 100), np.linspace(1, 0, 100)]

    def estimated(voltage, holdout=0.0):
        record = Record(np.arange(len(voltage)) * 1.0, voltage, voltage)
        return pasts_to_estimate([record], (0.0, 1.0), holdout) == (True,)

    assert not estimated(once)
    assert estimated(np.r_[once, once, once])
    assert not estimated(np.r_[once, once, once], holdout=0.6)
    # A slow return within the range is no whole loop.
    assert not estimated(np.r_[once, 0.4 * once])
    # Loops that grow show it within what they have reached, though the last reaches the ends alone.
    assert estimated(grown(6000, 0.5))


def test_a_past_is_estimated_of_the_runs_that_would_lose_much_to_it():
    once = np.r_[np.linspace(0, 1, 100), np.linspace(1, 0, 100)]
    late = np.r_[np.full(500, 0.5), once]
    loops, lost = (Record(np.arange(len(one)) * 1.0, one, one) for one in (np.r_[once, once, once], late))
    assert pasts_to_estimate([loops, lost], (0.0, 1.0), 0.0) == (True, True)
    assert pasts_to_estimate([loops, lost], (0.0, 1.0), 0.0, 0.5) == (False, True)
    assert pasts_to_estimate([lost], (0.0, 1.0), 0.0, 0.5) == (False,)


def test_of_a_run_that_goes_farther_at_its_end_less_is_held_out(rng):
    on_V, off_V, weight = half_plane(rng)
    voltage = grown(600, 0.5)
    # What is met for the first time is as two pasts left it, and no fit of what was before says how.
    one, other = (relays(voltage, np.full(len(weight), state), weight, on_V, off_V) for state in (-1.0, 1.0))
    record = Record(np.arange(600) * 0.01, voltage, one)

    def spread_of(held_out):
        left = (one - other)[held_out]
        return np.max(np.abs(left - (one - other)[np.flatnonzero(~held_out)[-1]]))

    stated, estimated = (
        prepare_run(record, (0.0, 1.0), initial, 0.2, estimated=True) for initial in ("negative", "unknown")
    )
    assert stated.held_out.sum() == 120
    assert 0 < estimated.held_out.sum() < 120
    assert spread_of(estimated.held_out) < 0.25 * spread_of(stated.held_out)


def test_what_a_run_reaches_first_at_its_end_is_followed_by_samples_that_are_fitted():
    time_s = np.arange(600) * 0.01
    voltage = np.where(np.arange(600) < 580, 0.4 + 0.3 * np.sin(time_s), 1.0)
    run = prepare_run(Record(time_s, voltage, voltage), (0.0, 1.0), "unknown", 0.2, estimated=True)
    # How far the step goes is told by what was before it and what comes after.
    assert run.fitted[580:].sum() == run.held_out.sum() == 10


def test_a_run_that_begins_near_its_highest_is_fitted_as_far_as_it_goes():
    time_s = np.arange(600) * 0.01
    # The way up is a hundredth of the range, and all that the past before the run reaches there.
    voltage = 0.5 + (0.4 + 0.01 * time_s / time_s[-1]) * np.cos(2 * np.pi * time_s / 0.6)
    run = prepare_run(Record(time_s, voltage, voltage), (0.0, 1.0), "unknown", 0.2, estimated=True)
    beyond = max(voltage[run.held_out].max(initial=0.0) - voltage[run.fitted].max(), 0.0)
    assert beyond <= 0.02 * (voltage.max() - voltage[0])


def test_a_run_held_out_whose_past_is_unknown_to_its_end_ends_nothing(tmp_path):
    """It stays between a quarter and three quarters of the range, and goes farthest at its last sample."""
    data_synth.write(data_synth.hidden((), seed=7, slow_samples=1000, fast_samples=1500), tmp_path)
    slow, fast = (fits.read_csv(tmp_path / f"{name}.csv") for name in ("slow", "fast"))
    inside = (
        np.abs(slow.voltage_V - np.mean([slow.voltage_V.min(), slow.voltage_V.max()])) < np.ptp(slow.voltage_V) / 4
    )
    first, stop = max(stretches(inside), key=lambda one: one[1] - one[0])
    part = {"time_s": slow.time_s[first:stop], "voltage_V": slow.voltage_V[first:stop]}
    third = Record(**part, displacement_um=slow.displacement_um[first:stop], source="third.csv")
    assert known_samples(third.voltage_V, slow.voltage_V.min(), slow.voltage_V.max()).sum() < 50
    baseline = fit_baseline([slow, fast], [third], 0.0, "unknown", lambda _: None)
    (aside,) = baseline.aside
    assert aside.known.all()
    assert aside.hold == baseline.stage.hold
