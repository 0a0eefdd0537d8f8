"""Tuning against closed forms, NumPy's loops and finite differences, and what it must refuse."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _models import densities_of, limits_V, linear_stage_of, random_model
from _plant_reference import driver_and_mechanics, van_loan
from _reference import central_differences
from _seed import seed_of

import fits
import microid as m
import microid.control as c
from fits.control import _make
from fits.control._tune import _problem
from fits.control._tune_problem import Goal, judge
from fits.control._tune_start import ultimate_point
from fits.io._record import Reference

T = 1e-3
SAMPLES = 160
PLANT, GAIN, OFFSET = np.array([2e-3, 60.0, 0.3]), 0.12, 1.5


def stage_of(plant, gain=GAIN):
    return linear_stage_of(plant, gain, OFFSET)


def drawn(rng, count=3):
    """Parameters and gains of plants, the nominal first."""
    scatter = np.concatenate([np.ones((1, 4)), rng.uniform(0.9, 1.1, (count - 1, 4))])
    return [(PLANT * one[:3], GAIN * one[3]) for one in scatter]


def a_step(rng):
    return OFFSET + rng.uniform(2, 4) * (np.arange(SAMPLES) > 20)


def by_numpy(pid, plant, gain, reference, noise):
    """Displacements and commands of a loop from rest under 0 V."""
    step, push, _ = van_loan(*driver_and_mechanics(*plant), T, "zero")
    kp, ki, kd, tf = (
        float(getattr(pid, name))
        for name in ("proportional_V_per_um", "integral_V_per_um_s", "derivative_V_s_per_um", "filter_s")
    )
    x, total, slope, before, out = np.zeros(3), 0.0, 0.0, 0.0, []
    for r, n in zip(reference, noise, strict=True):
        y = OFFSET + gain * x[1]
        e = r - y - n
        total += ki * T * e
        slope = (tf * slope + kd * (e - before)) / (tf + T)
        before, u = e, kp * e + total + slope
        out.append((y, u))
        x = step @ x + push * u
    return np.array(out).T


def cost_by_numpy(runs, reference, effort, rate):
    errors, commands = (np.stack(x) for x in zip(*runs, strict=True))
    changes = np.diff(commands, prepend=0.0, axis=1)
    roots = [np.sqrt(np.mean(x**2)) for x in (reference - errors, commands, changes)]
    return roots[0] + effort * roots[1] + rate * roots[2]


def test_the_ultimate_point_of_three_equal_lags_is_eight(rng):
    """`(1 + τ s)^-3` turns by 180 degrees at `√3 / τ`, where its modulus is an eighth."""
    tau_s, gain = rng.uniform(1e-3, 1e-2), rng.uniform(0.05, 0.5)
    found = ultimate_point(stage_of((tau_s, 1 / (2 * np.pi * tau_s), 1.0), gain), tau_s / 2000)
    assert found.gain_V_per_um == pytest.approx(8 / gain, rel=3e-3)
    assert found.period_s == pytest.approx(2 * np.pi * tau_s / np.sqrt(3), rel=3e-3)


def test_the_start_follows_the_rules_and_is_safe_for_every_plant(rng):
    plants = [stage_of(*one) for one in drawn(rng)]
    point, pid = ultimate_point(plants[0], T), fits.relay_start(plants, T)
    halvings = np.log2(0.6 * point.gain_V_per_um / float(pid.proportional_V_per_um))
    assert halvings == pytest.approx(round(halvings), abs=1e-9)
    assert float(pid.proportional_V_per_um / pid.integral_V_per_um_s) == pytest.approx(point.period_s / 2)
    assert float(pid.derivative_V_s_per_um / pid.proportional_V_per_um) == pytest.approx(point.period_s / 8)
    assert all(float(c.margins(pid, one).gain_margin) >= 2 for one in plants)


def test_a_stage_that_moves_the_wrong_way_has_no_start():
    with pytest.raises(fits.DataError, match="expected a positive gain"):
        fits.relay_start(stage_of(PLANT, -GAIN), T)


def test_the_steepest_slope_is_that_of_the_major_loop(rng):
    model = random_model(rng)
    density, slope = densities_of(model)
    lower, upper = limits_V(model)
    fine = np.linspace(lower, upper, 1501)
    h = fine[1] - fine[0]
    table = density(fine[:, None], fine[None, :]) * (fine[None, :] <= fine[:, None])
    along = [np.trapezoid(table, dx=h, axis=axis) + slope(fine) for axis in (0, 1)]
    expected = max(one.max() for one in along)
    found = fits.steepest_slope(m.Stage.of(hysteresis=model))
    assert found == pytest.approx(expected, rel=0.02)
    assert fits.steepest_slope(stage_of(PLANT)) is None
    plays = m.hysteresis.PrandtlIshlinskii(0.1, np.array([0.2, 0.3]), np.array([1.0, 2.0]), 0.0)
    assert fits.steepest_slope(m.Stage.of(hysteresis=plays)) == pytest.approx(0.6)
    with pytest.raises(fits.DataError, match="is a Dahl"):
        fits.steepest_slope(m.Stage.of(law=m.hysteresis.Dahl(0.1, 0.05, 1.0, 1.0)))


@pytest.fixture(scope="module")
def tuned():
    """One search over three plants for a step, and all that went into it."""
    rng = np.random.default_rng(seed_of("test_tune"))
    plants, reference = drawn(rng), a_step(rng)
    noise = rng.normal(0, 0.01, SAMPLES)
    pid = fits.relay_start([stage_of(*one) for one in plants], T)
    goal = Goal(effort_um_per_V=1e-3, rate_um_per_V=5e-3, overshoot_max_pct=2.0)
    told = []
    result = fits.tune_controller(
        pid, [stage_of(*one) for one in plants], reference, goal=goal, noise_um=noise, progress=told.append
    )
    return plants, reference, noise, pid, goal, result, told


def test_the_costs_are_those_of_numpy(tuned):
    plants, reference, noise, pid, goal, result, _ = tuned
    for controller, cost in ((pid, result.cost_before_um), (result.controller, result.cost_after_um)):
        runs = [by_numpy(controller, *one, reference, noise) for one in plants]
        expected = cost_by_numpy(runs, reference, goal.effort_um_per_V, goal.rate_um_per_V)
        assert cost == pytest.approx(expected, rel=1e-4)
    # Limits may cost something where the start does not keep them, and then that is said.
    assert result.cost_after_um < result.cost_before_um or "beyond a limit" in result.remarks[0]
    assert result.converged or any("stopped before" in remark for remark in result.remarks)


def test_the_reports_of_all_plants_are_those_of_numpy_and_within_the_limits(tuned):
    plants, reference, noise, _, _, result, _ = tuned
    way = np.ptp(reference)
    for one, report in zip(plants, result.plants, strict=True):
        y, u = by_numpy(result.controller, *one, reference, noise)
        overshoot = 100 * max(y.max() - reference.max(), 0, reference.min() - y.min()) / way
        assert report.overshoot_pct == pytest.approx(overshoot, abs=1e-6)
        assert overshoot < 2.1
        assert report.error_rms_um == pytest.approx(np.sqrt(np.mean((reference - y) ** 2)), rel=1e-9)
        assert (report.command_min_V, report.command_max_V) == pytest.approx((u.min(), u.max()))
        assert report.command_step_max_V == pytest.approx(np.abs(np.diff(u, prepend=0)).max())
        alone = c.margins(result.controller, stage_of(*one))
        assert float(report.margins.gain_margin) == pytest.approx(float(alone.gain_margin), rel=1e-9)
        assert float(alone.gain_margin) > 1.99
        assert float(alone.sensitivity_peak) < 2.01
    assert result.worst.error_rms_um == max(one.error_rms_um for one in result.plants)


def test_nothing_near_is_better_within_the_limits(tuned, rng):
    """Gains a few per cent off, in NumPy: none is both cheaper and within all limits."""
    plants, reference, noise, _, goal, result, _ = tuned
    names = ("proportional_V_per_um", "integral_V_per_um_s", "derivative_V_s_per_um")
    for _ in range(20):
        scale = np.exp(rng.normal(0, 0.05, 3))
        near = eqx.tree_at(
            lambda p: [getattr(p, name) for name in names],
            result.controller,
            [getattr(result.controller, name) * one for name, one in zip(names, scale, strict=True)],
        )
        runs = [by_numpy(near, *one, reference, noise) for one in plants]
        cost = cost_by_numpy(runs, reference, goal.effort_um_per_V, goal.rate_um_per_V)
        beyond = max(100 * (y.max() - reference.max()) / np.ptp(reference) for y, _ in runs)
        assert cost > result.cost_after_um * (1 - 2e-3) or beyond > 2.0


def test_slopes_of_the_cost_are_those_of_finite_differences(tuned):
    plants, reference, noise, pid, goal, *_ = tuned
    stages = [stage_of(*one) for one in plants]
    signals = {"feedforward_V": None, "noise_um": noise}
    fixed = {"start": m.Start(), "delay": 0, "resolution_um": None}
    problem = _problem(pid, stages, goal, reference, signals, 0, None, **fixed)
    y = 0.1 * np.arange(1.0, 4.0)
    found = eqx.filter_jit(jax.jacfwd(lambda y: judge(problem, y)[2]))(jnp.asarray(y))
    expected = central_differences(lambda y: judge(problem, jnp.asarray(y))[2], y, np.full(3, 1e-5))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7 * np.abs(expected).max())
    # At the origin, a coordinate is the logarithm of its gain.
    names = [row.path for row in problem.coordinates.table]
    assert names == ["proportional_V_per_um", "integral_V_per_um_s", "derivative_V_s_per_um"]
    more = problem.controller(jnp.full(3, 1e-6))
    for name in names:
        assert float(getattr(more, name) / getattr(pid, name)) == pytest.approx(1 + 1e-6, abs=1e-10)


def test_a_second_search_retraces_nothing_and_says_that_it_began_at_the_best(tuned, caplog):
    plants, reference, noise, _, goal, result, told = tuned
    assert told[0].startswith("start: cost")
    stages = [stage_of(*one) for one in plants]
    options = {"goal": goal, "noise_um": noise, "starts": 1}
    with jax.log_compiles():
        try:
            again = fits.tune_controller(result.controller, stages, reference, **options)
            assert again.cost_after_um <= result.cost_after_um * 1.001
            if again.cost_after_um > result.cost_after_um * (1 - 1e-9):
                assert any("already as good" in remark for remark in again.remarks)
        except fits.FitError as error:
            assert error.status is fits.FitStatus.NOT_STATIONARY  # noqa: PT017
    assert not [record for record in caplog.records if "Compiling jit(descend)" in record.getMessage()]
    assert not [record for record in caplog.records if "Compiling jit(judge)" in record.getMessage()]


def test_loops_that_are_unstable_and_limits_that_cannot_be_kept_are_refused(tuned):
    plants, reference, noise, pid, _, result, _ = tuned
    stages = [stage_of(*one) for one in plants]
    wild = eqx.tree_at(lambda p: p.integral_V_per_um_s, pid, 100 * pid.integral_V_per_um_s)
    with pytest.raises(fits.FitError, match=r"^the tuning failed: .*at the start, with plant 1, 2, 3 of 3") as caught:
        fits.tune_controller(wild, stages, reference, noise_um=noise)
    assert caught.value.status is fits.FitStatus.UNSTABLE
    # Every run begins with a command of next to nothing.
    goal = Goal(command_min_V=50.0, command_max_V=60.0)
    with pytest.raises(fits.FitError, match=r"^the tuning failed") as caught:
        fits.tune_controller(result.controller, stages, reference, goal=goal, noise_um=noise, starts=1)
    assert caught.value.status is fits.FitStatus.LIMITS
    for words, change in (
        ("same parts", {"plants": [stages[0], m.Stage.of(piezo=m.Piezo(0.1))]}),
        ("noise_um has shape", {"noise_um": noise[1:]}),
        ("skip: expected", {"skip": SAMPLES}),
        ("no parameter 'gain'", {"free": ["gain", "integral_V_per_um_s"]}),
    ):
        given = {"controller": pid, "plants": stages, "reference_um": reference} | change
        with pytest.raises(fits.DataError, match=words):
            fits.tune_controller(**given)


@pytest.mark.study
def test_an_integral_controller_of_a_gain_is_that_of_the_closed_form(rng):
    """Without inertia a step leaves `(1 - k)^n`, and the gain margin is `2 / k`: one of 4 wants `k` to be a half."""
    gain = rng.uniform(0.05, 0.5)
    stage = m.Stage.of(piezo=m.Piezo(gain))
    # Not farther off than the search reaches, some sixfold.
    pid = c.PID(0.0, rng.uniform(0.1, 0.2) / (T * gain), 0.0, T)
    reference = 1.0 * (np.arange(40) > 2)
    goal = Goal(gain_margin_min=4.0, phase_margin_min_deg=None, sensitivity_peak_max=None)
    result = fits.tune_controller(pid, stage, reference, goal=goal, starts=1)
    assert float(result.controller.integral_V_per_um_s) * T * gain == pytest.approx(0.5, rel=4e-3)
    assert result.converged
    assert any("gain_margin_min" in remark for remark in result.remarks)
    assert set(result.gains) == {"integral_V_per_um_s"}


@pytest.mark.study
def test_a_reference_that_stands_still_can_be_tuned_for(rng):
    """It has no range to overshoot; what is left of the error is the noise that the controller lets through."""
    stage, noise = m.Stage.of(piezo=m.Piezo(0.2)), rng.normal(0, 0.1, 60)
    pid = c.PID(0.0, 0.5 / (T * 0.2), 0.0, T)
    result = fits.tune_controller(
        pid, stage, np.zeros(60), goal=Goal(overshoot_max_pct=1.0), noise_um=noise, starts=1
    )
    assert result.cost_after_um < result.cost_before_um
    assert result.plants[0].overshoot_pct == 0


def test_plants_are_drawn_with_the_covariance_of_the_fit(rng):
    """The perturbations are rows of a factor: coordinates scatter as its square, in NumPy."""
    stage = m.Stage.of(piezo=m.Piezo(0.12), mechanics=m.Mechanics(60.0, 0.1, 1.0)).freeze("mechanics")
    factor = rng.normal(0, 0.1, (2, 1))
    none = jnp.zeros((2, 0))
    known = fits.StageUncertainty(jnp.asarray(factor), none, jnp.zeros(2), jnp.asarray(0.0), None)
    plants = fits.draw_plants(stage, 400, uncertainty=known, seed=int(rng.integers(2**31)))
    gains = np.array([float(one["piezo"].gain_um_per_V) for one in plants])
    assert gains[0] == pytest.approx(0.12)
    # The gain's scale is 0.1 um/V.
    assert gains[1:].std() == pytest.approx(0.1 * np.sqrt(np.sum(factor**2)), rel=0.2)
    with pytest.raises(fits.DataError, match="nothing of its uncertainty"):
        fits.draw_plants(stage, 2)
    assert fits.draw_plants(stage, 1) == (stage,)
    with pytest.raises(ValueError, match="count"):
        fits.draw_plants(stage, 0, uncertainty=known)


def test_a_controller_made_around_another_is_told_of_as_it_was_tuned_last(monkeypatch):
    """What was said of the PID controller alone is not said beside it, nor twice under another name."""
    stage = m.Stage.of(piezo=m.Piezo(0.1), mechanics=m.Mechanics(200.0, 0.1))
    at = 1e-3 * np.arange(100)
    ready = _make.setup(stage, Reference(at, 1 - np.cos(2 * np.pi * 30 * at), "r"), "none")

    def tuned(controller, *_, **__):
        return SimpleNamespace(controller=controller, remarks=(f"of {type(controller).__name__}",))

    monkeypatch.setattr(_make, "tune_controller", tuned)
    loop = _make.Loop(ready, [stage], 0.0, 0, None, 0)
    maker = _make.Maker(loop, Goal(), 1, 0, None, lambda _: None)
    assert maker.make("pid", None, []).remarks == ["of PID"]
    at_Hz, of_all = maker.make("resonant", None, []).remarks
    assert "resonator is at 30.0" in at_Hz or "resonator is at 29.9" in at_Hz
    assert of_all == "of ResonantPID"
