"""The closed loop against NumPy and against the stage's own answer to whole records; figures of merit by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _models import PLACES, compiled, limits_V, linear_stage_of, nested_voltages, play, random_model, stroke_um
from _plant_reference import driver_and_mechanics, van_loan
from _reference import central_differences

import microid as m
import microid.control as c
from microid.control._hysteresis_step import _step_form

T = 1e-3
SAMPLES = 120
IDLE = (0.0, 0.0, 0.0, T)


@compiled
def along(law, voltage_V, before_V, start):
    step = _step_form("law", law)
    state, first = step.init(before_V, start)
    return first, jax.lax.scan(lambda state, x: step.step(state, x), state, voltage_V)[1]


@compiled
def simulate(*args, **options):
    return c.simulate_loop(*args, **options)


@compiled
def respond(stage, voltage_V, start):
    return stage(jnp.asarray(T), voltage_V, start)


def voltages(rng, model, samples=SAMPLES):
    """Nested loops, rests, and a few samples beyond the range."""
    lower, upper = limits_V(model)
    found = nested_voltages(rng, lower, upper, samples)
    found[rng.integers(0, samples, 3)] = [lower - 5, upper + 5, upper]
    return found


@pytest.mark.parametrize("kind", ["low", "high", "middle"])
def test_preisach_by_the_step_is_preisach_along_the_record(kind, rng):
    model = random_model(rng)
    lower, upper = limits_V(model)
    start = {
        "low": m.negative_saturation(lower, PLACES),
        "high": m.positive_saturation(lower, upper, PLACES),
        "middle": m.demagnetised(lower, upper, rng.uniform(lower, upper), PLACES),
    }[kind]
    voltage = voltages(rng, model)
    before = jnp.asarray(rng.uniform(lower, upper))
    first, rest = along(model, jnp.asarray(voltage), before, start)
    expected, _ = play(model, np.append(before, voltage), start)
    np.testing.assert_allclose(np.append(first, rest), expected, rtol=0, atol=1e-9)


def test_a_full_memory_forgets_the_smallest_loops(rng):
    """Ever smaller loops, twice as many as there are places: what is forgotten is smaller than the last kept."""
    model = random_model(rng)
    lower, upper = limits_V(model)
    turns = np.arange(2 * PLACES)
    swing = 0.75**turns * np.where(turns % 2, -1, 1)
    path = (lower + upper) / 2 + (upper - lower) / 2 * np.append(swing, np.geomspace(0.75**47, 1, 31))
    exact, _ = play(model, path, m.negative_saturation(lower, PLACES))
    path = np.append(path, np.full(SAMPLES + 1 - len(path), path[-1]))
    first, rest = along(model, jnp.asarray(path[1:]), jnp.asarray(path[0]), m.negative_saturation(lower, PLACES))
    found = np.append(first, rest)[: len(exact)]
    assert 1e-9 < np.abs(found - exact).max() < 2 * 0.75 ** (PLACES - 3) * stroke_um(model)
    # Once the forgotten loops would have been wiped out as well, everything is as it was.
    np.testing.assert_allclose(found[-10:], exact[-10:], rtol=0, atol=1e-9)


def prandtl(rng):
    return m.hysteresis.PrandtlIshlinskii(0.05, rng.uniform(0, 0.05, 4), rng.uniform(1, 40, 4), 3.0)


def stages(rng):
    """Chains of every kind, each with the memory it started from."""
    model = random_model(rng)
    lower, upper = limits_V(model)
    driver, mechanics = m.Driver(rng.uniform(5e-4, 5e-3), 1.1), m.Mechanics(rng.uniform(20, 100), 0.1, 2.0)
    sensor, start = m.Sensor(0.98, 4.0), m.demagnetised(lower, upper, None, 32)
    return {
        "linear": (m.Stage.of(driver=driver, piezo=m.Piezo(0.06, 2.0), mechanics=mechanics, sensor=sensor), None),
        "driver, hysteresis, mechanics": (m.Stage.of(driver=driver, hysteresis=model, mechanics=mechanics), start),
        "no driver": (m.Stage.of(hysteresis=model, mechanics=mechanics, sensor=sensor), start),
        "no mechanics": (m.Stage.of(driver=driver, hysteresis=model), start),
        "plays": (
            m.Stage.of(driver=driver, hysteresis=prandtl(rng), mechanics=mechanics),
            rng.uniform(-1, 1, 4) * 0.5,
        ),
    }


@pytest.mark.parametrize(
    ("name", "substeps"),
    [
        ("linear", 1),
        ("driver, hysteresis, mechanics", 3),
        pytest.param("no driver", 1, marks=pytest.mark.study),
        pytest.param("no mechanics", 2, marks=pytest.mark.study),
        ("plays", 1),
    ],
)
def test_without_feedback_the_loop_is_the_stage_under_a_held_command(name, substeps, rng):
    stage, memory = stages(rng)[name]
    stage = m.Stage(stage.parts, stage.names, "zero", substeps)
    command, start = rng.uniform(-20, 130, SAMPLES), m.Start(rng.uniform(0, 60), memory)
    run = simulate(c.PID(*IDLE), stage, np.zeros(SAMPLES), feedforward_V=command, start=start)
    np.testing.assert_allclose(run.displacement_um, respond(stage, jnp.asarray(command), start), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(run.command_V, command)
    np.testing.assert_array_equal(run.time_s, T * np.arange(SAMPLES))


def test_a_stage_without_inertia_answers_one_sample_late(rng):
    command = rng.uniform(0, 100, 20)
    run = simulate(c.PID(*IDLE), m.Stage.of(piezo=m.Piezo(0.1, 1.0)), np.zeros(20), feedforward_V=command)
    np.testing.assert_allclose(run.displacement_um, 1 + 0.1 * np.append(0, command[:-1]), rtol=1e-12)


GAIN, OFFSET = 0.12, 1.5
PLANT = (2e-3, 60.0, 0.2)


def linear_stage():
    return linear_stage_of(PLANT, GAIN, OFFSET)


def by_numpy(gains, reference, feedforward, noise, delay, resolution_um, resolution_V, limits, before_V):
    """Read, decide, move, in plain NumPy: PI in position form, states by SciPy's matrix exponential."""
    a, b = driver_and_mechanics(*PLANT)
    step, push, _ = van_loan(a, b, T, "zero")
    x = np.linalg.solve(a, -b) * before_V
    total, readings, out = 0.0, [], []
    for r, ff, n in zip(reference, feedforward, noise, strict=True):
        y = OFFSET + GAIN * x[1]
        readings.append(np.rint((y + n) / resolution_um) * resolution_um)
        at_rest = OFFSET + GAIN * before_V
        seen = readings[-1 - delay] if len(readings) > delay else np.rint(at_rest / resolution_um) * 0 + at_rest
        total += gains[1] * T * (r - seen)
        u = ff + gains[0] * (r - seen) + total
        u = np.clip(np.rint(u / resolution_V) * resolution_V, *limits)
        out.append((y, seen, u, r - y))
        x = step @ x + push * u
    return np.array(out).T


@pytest.mark.parametrize("delay", [0, 3])
def test_loop_is_that_of_numpy(delay, rng):
    gains, at = rng.uniform([0.2, 100], [1, 300]), T * np.arange(SAMPLES)
    reference = 6 + 2 * np.sin(2 * np.pi * 10 * at) + 2 * (at > 0.05)
    noise, feedforward, before_V = rng.normal(0, 0.05, SAMPLES), 5 * reference, rng.uniform(20, 40)
    more = {"resolution_um": 0.01, "resolution_V": 0.05, "limits_V": (25.0, 60.0)}
    pid = c.PID(*gains, 0.0, T)
    run = simulate(
        pid,
        linear_stage(),
        reference,
        feedforward_V=feedforward,
        noise_um=noise,
        delay=delay,
        start=m.Start(before_V),
        **more,
    )
    expected = by_numpy(gains, reference, feedforward, noise, delay, *more.values(), before_V)
    found = (run.displacement_um, run.measured_um, run.command_V, run.error_um)
    assert np.any(expected[2] == 60)
    for one, two in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-10)


def test_a_loop_at_rest_stays_there_with_any_controller(rng):
    """Under no feedforward the controllers begin with the command that has held the stage."""
    before_V = rng.uniform(10, 90)
    rest = OFFSET + GAIN * before_V
    pid = c.PID(0.5, 100.0, 1e-4, T, reference_weight=0.2, derivative_weight=0.0)
    key = jax.random.key(rng.integers(2**31))
    for controller in (
        c.BPPID.around(pid, key),
        c.CMACPID(pid, 0.0, 10.0, 100.0, learning_rate=0.1, limit_V=5.0),
    ):
        run = simulate(controller, linear_stage(), np.full(50, rest), start=m.Start(before_V), delay=2)
        np.testing.assert_allclose(run.command_V, before_V, rtol=1e-9)
        np.testing.assert_allclose(run.displacement_um, rest, rtol=1e-9)


@pytest.mark.parametrize("kind", ["pid", "bp"])
def test_anti_windup_prevents_the_overshoot_of_a_windup(kind, rng):
    """A slow stage, a command at its limit for long: what has added up meanwhile must be undone first, or not."""
    slow = m.Stage.of(driver=m.Driver(0.05), piezo=m.Piezo(0.1))
    # The PI controller cancels the stage's pole: a first-order loop, without overshoot, if there were no limits.
    gain = rng.uniform(50, 80)
    limits = {"lower_V": 0.0, "upper_V": 100 * rng.uniform(1.3, 1.4)}
    pid = c.PID.from_times(gain, 0.05, 1e-9, T, **limits)
    after, bound = {}, eqx.tree_at(lambda pid: pid.tracking_s, pid, jnp.asarray(np.inf))
    good = c.BPPID.around(pid, jax.random.key(0), learning_rate_per_um2=0.0) if kind == "bp" else pid
    if kind == "bp":
        good = eqx.tree_at(lambda bp: bp.network.output_weight, good, jnp.zeros((3, 3)))
    for name, controller in (("winds up", bound), ("does not", good)):
        run = simulate(controller, slow, np.full(2000, 10.0))
        assert np.any(run.command_V == pid.upper_V)
        after[name] = float(jnp.max(run.displacement_um) / 10 - 1)
    assert after["winds up"] > 0.05
    assert after["does not"] < 0.001


def test_cmac_learns_a_period_that_the_pid_controller_cannot_follow(rng):
    at = T * np.arange(4000)
    reference = OFFSET + 5 + 2 * np.sin(2 * np.pi * 2 * at + rng.uniform(0, 6))
    pid = c.PID(1.0, 20.0, 0.0, T)
    cmac = c.CMACPID(
        pid, 2.0, 12.0, 40.0, learning_rate=0.1, limit_V=100.0, levels=(200, 4), generalisation=16, memory=4096
    )
    last = slice(3500, None)
    errors = [
        c.tracking_errors(reference[last], simulate(one, linear_stage(), reference).displacement_um[last])
        for one in (pid, cmac)
    ]
    assert errors[1].e_rms_pct < 0.5 * errors[0].e_rms_pct


def test_derivatives_through_the_loop_are_those_of_finite_differences(rng):
    """By the gains, and by the density of a hysteresis inside the loop."""
    model = random_model(rng, levels=5)
    mechanics, before = m.Mechanics(60.0, 0.3), m.Start(limits_V(model)[0])
    low, high = np.asarray(model(jnp.asarray(limits_V(model))))
    slope = (high - low) / np.ptp(limits_V(model))
    reference = low + (high - low) * (0.5 - 0.3 * np.cos(2 * np.pi * 8 * T * np.arange(60)))

    def loss(numbers):
        pid = c.PID(numbers[0], numbers[1], numbers[2], T, filter_s=1e-3)
        packed = numbers[3] * model.density.packed_um
        stage = m.Stage.of(hysteresis=eqx.tree_at(lambda h: h.density.packed_um, model, packed), mechanics=mechanics)
        return jnp.sum(c.simulate_loop(pid, stage, reference, delay=1, start=before).error_um ** 2)

    numbers, both = np.append(np.array([0.2, 40, 2e-4]) / slope, 1.0), compiled(jax.value_and_grad(loss))
    found = np.asarray(both(jnp.asarray(numbers))[1])
    expected = central_differences(lambda x: both(jnp.asarray(x))[0], numbers, 1e-6 * numbers)
    scale = np.abs(expected * numbers).max()
    np.testing.assert_allclose(found * numbers / scale, expected * numbers / scale, rtol=0, atol=1e-5)


TRACES = []


class Counting(c.AbstractPlant):
    """A displacement of a tenth of the voltage, with which to count how often it is traced."""

    def init(self, start):
        return (), jnp.zeros(())

    def step(self, state, command_V):
        TRACES.append("step")
        return state, command_V / 10


def test_new_data_and_new_gains_do_not_retrace(rng):
    def go():
        pid = c.PID(*rng.uniform(0.1, 1, 3), T, filter_s=rng.uniform(0, 1), upper_V=rng.uniform(5, 9))
        more = {"noise_um": rng.normal(size=30), "resolution_um": rng.uniform(), "limits_V": (rng.uniform(-9, -1), 9)}
        return c.simulate_loop(pid, Counting(), rng.normal(size=30), delay=1, **more)

    go()
    count = len(TRACES)
    go()
    assert len(TRACES) == count


def test_many_loops_at_once_are_each_what_they_are_alone(rng):
    stage, reference = linear_stage(), 3 + rng.normal(0, 1, 40)
    gains, noise = rng.uniform([0.1, 50, 1e-4], [1, 200, 1e-3], (3, 3)), rng.normal(0, 0.1, (3, 40))

    def one(gains, noise):
        return c.simulate_loop(c.PID(*gains, T), stage, reference, noise_um=noise, delay=2).displacement_um

    together = jax.vmap(one)(jnp.asarray(gains), jnp.asarray(noise))
    for k in range(3):
        np.testing.assert_allclose(together[k], one(jnp.asarray(gains[k]), noise[k]), rtol=1e-10)


class _OnlyWhole(m.AbstractHysteresis):
    """A law for whole records."""

    def __call__(self, voltage_V, start=None):
        return 0.1 * voltage_V


def test_what_cannot_be_run_is_refused(rng):
    pid, stage, zeros = c.PID(*IDLE), linear_stage(), np.zeros(5)
    with pytest.raises(ValueError, match=r"noise_um must have the shape \(5,\)"):
        c.simulate_loop(pid, stage, zeros, noise_um=np.zeros(4))
    with pytest.raises(ValueError, match="one axis"):
        c.simulate_loop(pid, stage, np.zeros((2, 5)))
    with pytest.raises(ValueError, match="delay must be"):
        c.simulate_loop(pid, stage, zeros, delay=-1)
    whole = m.Stage.of(law=_OnlyWhole())
    with pytest.raises(ValueError, match="'law' is a _OnlyWhole, which has no form for single samples"):
        c.simulate_loop(pid, whole, zeros)


def test_tracking_errors_are_shares_of_the_range_of_the_reference():
    found = c.tracking_errors(np.array([0.0, 1, 2, 4]), np.array([0.0, 1.2, 2, 3.6]))
    assert float(found.e_max_pct) == pytest.approx(10)
    assert float(found.e_rms_pct) == pytest.approx(100 * np.sqrt(0.2 / 4) / 4)


def test_step_metrics_are_those_of_a_second_order_system(rng):
    """Overshoot `exp(-pi zeta / sqrt(1 - zeta^2))`; the last exit from the band is where the curve itself is."""
    damping, rate, target = rng.uniform(0.1, 0.6), rng.uniform(20, 60), rng.uniform(3, 9)
    at = np.arange(0, 60 / (damping * rate), 0.01 / rate)
    turn = rate * np.sqrt(1 - damping**2)
    curve = 1 - np.exp(-damping * rate * at) * (
        np.cos(turn * at) + damping / np.sqrt(1 - damping**2) * np.sin(turn * at)
    )
    found = c.step_metrics(at, 1 + (0.9 * target - 1) * curve, target, 1.0, band_pct=5)
    expected = 100 * np.exp(-np.pi * damping / np.sqrt(1 - damping**2))
    assert float(found.overshoot_pct) == pytest.approx(expected, rel=1e-3)
    assert float(found.settling_value_um) == pytest.approx(0.9 * target, rel=1e-6)
    assert float(found.positioning_error_pct) == pytest.approx(10 * target / (target - 1), rel=1e-6)
    assert float(found.settling_time_s) == pytest.approx(at[np.flatnonzero(np.abs(curve - 1) > 0.05)[-1] + 1])
    assert float(c.step_metrics(at[:100], curve[:100], 1.0, band_pct=1e-9).settling_time_s) == np.inf


def test_what_has_not_settled_overshoots_its_target_and_not_the_mean_of_its_end():
    """A sine about 5 that ends above its band: beyond a target of 4, from 1 on, is 2 of 3 um."""
    at = np.linspace(0, 10.2, 1021)
    found = c.step_metrics(at, 5 + np.sin(2 * np.pi * at), 4.0, 1.0)
    assert float(found.settling_time_s) == np.inf
    assert float(found.overshoot_pct) == pytest.approx(100 * 2 / 3, rel=1e-9)
    creeping = c.step_metrics(at, 4 * at / 10.2, 5.0)
    still = c.step_metrics(at, np.full_like(at, 1.0), 5.0, 1.0)
    for one in (creeping, still):
        assert (float(one.settling_time_s), float(one.overshoot_pct)) == (np.inf, 0)


def test_positioning_errors_are_those_of_table_2():
    for value, pct in ((6.429, 2.78), (6.488, 1.89), (6.542, 1.07), (6.601, 0.18)):
        found = c.step_metrics(np.arange(9.0), np.full(9, value), 6.613)
        assert float(found.positioning_error_pct) == pytest.approx(pct, abs=0.006)
        assert (float(found.overshoot_pct), float(found.settling_time_s)) == (0, 0)
