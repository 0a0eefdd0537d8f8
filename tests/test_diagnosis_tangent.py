"""The tangent of a stage with effects that level off, against differences of whole simulations."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import lsim

from fits import Record
from fits.diagnosis._baseline import Baseline, simulate, with_effects
from fits.diagnosis._certainty import Certainty
from fits.diagnosis._effects import Bench, Law
from fits.diagnosis._joint_fit import fit_jointly
from fits.diagnosis._predict import Hypothesis, Predictor
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import refit
from fits.diagnosis._regression import regress, saturating
from fits.loop._design import Grid
from fits.loop._run import prepare_run
from fits.stage._chain import Chain, offsets_out
from fits.stage._run import place_of_hysteresis
from fits.stage._solve_stage import default_stage
from fits.stats._noise import Noise
from microid.effects.backlash import Backlash
from microid.effects.clock_mismatch import ClockMismatch
from microid.effects.driver_saturation import DriverSaturation
from microid.effects.sensor_lowpass import SensorLowpass
from microid.effects.slew_limit import SlewLimit
from microid.effects.transport_delay import TransportDelay

LEVELS, RANGE_V = 10, (0.0, 100.0)


@pytest.fixture(autouse=True)
def _no_padding(monkeypatch):
    """The runs below are all of one length."""
    monkeypatch.setattr("fits.loop._run._SHORTEST", 1)


def two_runs():
    """A slow decaying loop, and a fast chirp that the mechanics does not follow."""
    slow_s, fast_s = np.linspace(0, 20, 900), np.linspace(0, 0.5, 900)
    slow_V = 50 + 50 * np.cos(2 * np.pi * 0.3 * slow_s) * (1 - 0.03 * slow_s)
    fast_V = 50 + 40 * np.sin(2 * np.pi * (10 + 60 * fast_s) * fast_s)
    return [
        Record(time_s, voltage_V, voltage_V / 10, source=name)
        for name, time_s, voltage_V in (("slow", slow_s, slow_V), ("fast", fast_s, fast_V))
    ]


def baseline_of(rng, levels=LEVELS):
    """A plain stage with a density drawn at random, as no fit has to find it."""
    stage = default_stage()
    grid = Grid(*RANGE_V, levels)
    columns_um = rng.uniform(0.2, 1.0, grid.columns)
    chain = Chain(offsets_out(stage, True), place_of_hysteresis(stage), grid)
    z = np.asarray(chain.coordinates.of(stage))
    runs, fine = (
        tuple(prepare_run(record, RANGE_V, "negative", 0.0, stride) for record in two_runs()) for stride in (4, 16)
    )
    prior = np.eye(grid.columns)
    return Baseline(chain, z, columns_um, prior, 10.0, RANGE_V, runs, (), runs, (), fine, (), fine, (), True, ())


EFFECTS = {
    "backlash": Backlash(jnp.asarray(0.02), jnp.asarray(0.3)),
    "driver_saturation": DriverSaturation(jnp.asarray(75.0)),
    "slew_limit": SlewLimit(jnp.asarray(6e3)),
}


@pytest.mark.study
def test_the_intervals_of_a_stage_are_those_of_dense_least_squares(rng):
    """Derivatives are differences of whole simulations; density, offsets and an effect are fitted beside."""
    baseline, noise_um = baseline_of(rng, 3), 0.01
    lag = SensorLowpass(jnp.asarray(2e-3))
    bench, regression = Bench(baseline), regress(baseline, ((), ()), [[lag], [lag]])
    projector = Projector(replace(regression, finer=()), [Noise(noise_um, np.zeros(0))] * 2)
    model = refit(bench, projector, [law := Law([lag, lag])], [law.start], 0)
    model = replace(model, residual=rng.standard_normal(len(model.residual)))
    found = Certainty(projector, model, bench, baseline).parameters()

    def response(moved):
        z, columns_um, x = np.split(moved, [len(baseline.z), len(baseline.z) + len(baseline.columns_um)])
        stage = baseline.moved(z, columns_um).stage
        return [simulate(with_effects(stage, [law.effect(law.start + x, 0)]), run) for run in baseline.coarse]

    size, steps = len(baseline.z) + len(baseline.columns_um) + law.size, []
    for k in range(size):
        step = 1e-4 * (np.arange(size) == k)
        steps.append([(a - b) / 2e-4 for a, b in zip(response(step), response(-step), strict=True)])
    blocks = [
        np.column_stack([*(each[run] for each in steps), *(np.ones(900) * (run == other) for other in (0, 1))])
        for run in (0, 1)
    ]
    prior = np.zeros((len(baseline.columns_um), size + 2))
    prior[:, len(baseline.z) : -2 - law.size] = np.eye(len(prior))
    design = np.concatenate([*(block / noise_um for block in blocks), prior])
    sd = np.sqrt(np.diagonal(np.linalg.inv(design.T @ design)))[: len(baseline.z)]
    # No more than chance makes sums of white noise over blocks wider.
    z_sd = [one.sd / abs(slope) for one, slope in zip(found, baseline.chain.parameters(baseline.z)[2], strict=True)]
    np.testing.assert_array_less(0.98 * sd, z_sd)
    np.testing.assert_array_less(z_sd, 1.6 * sd)
    for one in found:
        assert one.lower < one.value < one.upper


@pytest.mark.study
@pytest.mark.parametrize("name", EFFECTS)
def test_the_tangent_goes_through_what_levels_off(name, rng):
    baseline, effect = baseline_of(rng), EFFECTS[name]
    dressed, plain = (regress(baseline, kinds, [own, own]) for kinds, own in ((None, [effect]), ((), [])))
    assert dressed.saturating == ((effect,), (effect,))
    size, p = len(baseline.columns_um), len(baseline.z)
    # A smooth change of the density, and one of driver and mechanics.
    wave = np.sin(np.linspace(0, rng.uniform(2, 6), size) + rng.uniform(0, 6))
    for dz, dcolumns_um in (
        (np.zeros(p), 1e-4 * baseline.columns_um * wave),
        (1e-5 * rng.standard_normal(p), np.zeros(size)),
    ):
        ahead, behind = (
            [
                simulate(with_effects(baseline.moved(way * dz, way * dcolumns_um).stage, [effect]), run)
                for run in baseline.fine
            ]
            for way in (1, -1)
        )
        truth = np.concatenate([(a - b) / 2 for a, b in zip(ahead, behind, strict=True)])
        said, without = (
            np.linalg.norm(np.concatenate([rows @ np.append(dcolumns_um, dz) for rows in one.rows]) - truth)
            for one in (dressed, plain)
        )
        print(f"off by {said / np.linalg.norm(truth):.4f}, the plain one by {without / np.linalg.norm(truth):.4f}")
        assert said < 0.05 * np.linalg.norm(truth)
        assert said < 0.5 * without


@pytest.mark.study
def test_what_is_finer_than_the_grid_goes_through_it_too(rng):
    baseline, effect = baseline_of(rng), EFFECTS["driver_saturation"]
    dressed, plain = (regress(baseline, None, [own, own]) for own in ([effect], []))
    # Nothing moves any more beyond the rail, while it does without.
    slow = baseline.runs[0].record
    above = (slow.voltage_V > 78.0) & np.append(slow.voltage_V[1:] > 78.0, False) & (np.arange(len(slow)) > 20)
    inner = above[1:] & above[:-1]
    still, moving = (np.abs(np.diff(one.finer[0][0], axis=0)[inner]).max() for one in (dressed, plain))
    assert still < 0.05 * moving


def test_only_effects_that_level_off_ahead_of_the_mechanics_are_gone_through():
    late = TransportDelay(jnp.asarray(1e-3))
    assert saturating([*EFFECTS.values(), late]) == tuple(EFFECTS.values())


@pytest.mark.parametrize(
    "effect",
    [TransportDelay(jnp.asarray(5e-4)), pytest.param(SensorLowpass(jnp.asarray(5e-4)), marks=pytest.mark.study)],
)
def test_derivatives_along_the_driver_go_through_what_comes_after(effect, rng):
    baseline = baseline_of(rng)
    p = len(baseline.z)
    beside, plain = (regress(baseline, None, [own, own]) for own in ([effect], []))
    dz = 1e-4 * rng.standard_normal(p)
    run = baseline.fine[1]
    ahead, behind = (simulate(with_effects(baseline.moved(way * dz, 0.0).stage, [effect]), run) for way in (1, -1))
    truth = (ahead - behind) / 2
    said, without = (np.linalg.norm(one.rows[1][:, -p:] @ dz - truth) for one in (beside, plain))
    print(f"off by {said / np.linalg.norm(truth):.2e}, the plain one by {without / np.linalg.norm(truth):.2e}")
    # Derivatives are taken in fewer steps between samples.
    assert said < 2e-3 * np.linalg.norm(truth)
    assert without > 0.02 * np.linalg.norm(truth)


def test_a_baseline_moves_no_farther_than_its_tangent_holds(rng):
    baseline = baseline_of(rng)
    # A driver without delay: no derivative leads away from there.
    asleep = baseline.moved(np.array([-14.0, *np.zeros(len(baseline.z) - 1)]), 0.0)
    projector = Projector(regress(asleep), [Noise(0.01, np.zeros(0))] * 2)
    pull = projector.join([rng.standard_normal(len(run.record)) for run in asleep.runs])
    moved = projector.move(1e4 * pull)
    assert np.all(np.isfinite(moved.z))
    assert np.all(np.abs(moved.z - asleep.z) < 4)


@pytest.mark.study
def test_a_driver_that_was_fitted_away_comes_back_beside_the_cause(rng):
    truth, late = baseline_of(rng), ClockMismatch(jnp.asarray(rng.uniform(500.0, 1000.0)))
    records = [
        Record(
            run.record.time_s,
            run.record.voltage_V,
            simulate(with_effects(truth.stage, [late]), run) + 0.01 * rng.standard_normal(len(run.record)),
            source=run.record.source,
        )
        for run in truth.fine
    ]
    runs, fine = (
        tuple(prepare_run(record, RANGE_V, "negative", 0.0, stride) for record in records) for stride in (4, 16)
    )
    here = replace(truth, runs=runs, coarse=runs, finest=fine, fine=fine)
    asleep = here.moved(np.array([-14.0, *np.zeros(len(here.z) - 1)]), 0.0)
    law = Law([late, late])

    def from_(start):
        bench, projector = Bench(start), Projector(regress(start), [Noise(0.01, np.zeros(0))] * 2)
        found, _, model = fit_jointly(bench, projector, refit(bench, projector, [law], [law.start], 4))
        print(truth.z, found.baseline.z, float(late.rate_ppm), float(model.effects(1)[0].rate_ppm), model.cost)
        return found.baseline.z[0], model.cost

    (back, cost), (_, least) = from_(asleep), from_(here)
    assert back == pytest.approx(truth.z[0], abs=1.0)
    assert cost < least + 25


def answer_um(tau_s, natural_Hz, damping, lag_s, late_s, time_s, voltage_V):
    """Of a stage without hysteresis of 0.1 um/V, exactly: poles, and steps of which a delay is a multiple."""
    w = 2 * np.pi * natural_Hz
    poles = np.polymul(np.polymul([tau_s, 1], [lag_s, 1]), [1 / w**2, 2 * damping / w, 1])
    many = 16
    fine_s = np.linspace(time_s[0], time_s[-1], many * (len(time_s) - 1) + 1)
    _, out, _ = lsim(([0.1], np.trim_zeros(poles, "f")), np.interp(fine_s, time_s, voltage_V), fine_s)
    behind = round(late_s / (fine_s[1] - fine_s[0]))
    return np.concatenate([np.zeros(behind), out])[: len(out) : many]


@pytest.mark.study
def test_a_delay_and_a_lag_are_told_apart_by_as_much_as_is_predicted(rng):
    interval_s, noise_um = 1e-3, 0.01
    # Nothing but an offset is seen in the runs at hand, and the density is known.
    base = baseline_of(rng)
    grid = base.chain.grid
    columns_um = np.r_[np.zeros(grid.columns - LEVELS), np.full(LEVELS, 10.0)]
    rest = Record(interval_s * np.arange(300), np.zeros(300), np.zeros(300), source="rest")
    coarse, fine = ((prepare_run(rest, RANGE_V, "negative", 0.0, stride),) for stride in (4, 16))
    prior = 1e9 * np.eye(grid.columns)
    known = Baseline(
        base.chain, base.z, columns_um, prior, 10.0, RANGE_V, coarse, (), coarse, (), fine, (), fine, (), True, ()
    )
    bench, projector = Bench(known), Projector(regress(known), [Noise(noise_um, np.zeros(0))])
    late_s = interval_s / 16 * int(rng.integers(4, 12))
    laws = [Law([one]) for one in (SensorLowpass(jnp.asarray(late_s)), TransportDelay(jnp.asarray(late_s)))]
    lag, delay = (Hypothesis((law,), (law.start,)) for law in laws)
    predictor = Predictor(bench, projector, (lag, delay), ((0, 1),))
    assert predictor.present_z < 0.1
    # Steps as fast as the samples allow.
    time_s = interval_s * np.arange(600)
    voltage_V = np.where(np.arange(600) < 20, 0.0, 60.0 * (np.arange(600) // 7 % 2))
    exact = [1e-3, 100.0, 0.1]
    true = answer_um(*exact, late_s, 0.0, time_s, voltage_V)
    other = answer_um(*exact, 0.0, late_s, time_s, voltage_V)
    ends = [answer_um(*exact, 0.0, late_s + way * interval_s / 16, time_s, voltage_V) for way in (1, -1)]
    rows = [np.ones(600), ends[0] - ends[1]]
    for k in range(3):
        moved = [[*exact[:k], exact[k] * (1 + way), *exact[k + 1 :]] for way in (1e-4, -1e-4)]
        ends = [answer_um(*one, 0.0, late_s, time_s, voltage_V) for one in moved]
        rows.append((ends[0] - ends[1]) / 2e-4)
    matrix, off = np.stack(rows, axis=1), true - other
    follow = np.linalg.lstsq(matrix / np.linalg.norm(matrix, axis=0), off, rcond=None)[0]
    expected = np.linalg.norm(off - matrix / np.linalg.norm(matrix, axis=0) @ follow) / noise_um
    said = predictor.predicted_z(time_s, voltage_V)
    print(f"late by {late_s:.2g} s: {said:.2f} predicted, {expected:.2f} exactly")
    assert said == pytest.approx(expected, rel=0.05)


@pytest.mark.study
def test_what_readings_at_jittering_instants_change_in_the_mean_is_followed(rng):
    """Many readings of SciPy's spline through the response, each at an instant of its own, and their mean."""
    baseline = replace(baseline_of(rng), blurred=True)
    regression = regress(baseline)
    run = baseline.fine[1]
    plain, time_s = simulate(baseline.stage, run), run.record.time_s
    jitter_s = rng.uniform(0.1, 0.3) * (time_s[1] - time_s[0])
    spline = CubicSpline(time_s, plain)
    off_s = jitter_s * rng.standard_normal((4000, 1))
    # In pairs that are as early as late, so that the first order is gone.
    mean = np.mean([spline(time_s + d) + spline(time_s - d) for d in off_s], axis=0) / 2
    own = regression.nuisance[1]
    assert own.shape[1] == regress(replace(baseline, blurred=False)).nuisance[1].shape[1] + 1
    inside = slice(20, -20)
    change, column = (mean - plain)[inside], own[inside, -1]
    size = column @ change / (column @ column)
    assert size == pytest.approx(np.mean(off_s**2) / 2, rel=0.1)
    left = change - size * column
    assert np.linalg.norm(left) < 0.2 * np.linalg.norm(change)
