"""The linear parts against SciPy: matrix exponentials, lsim, freqs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _models import compiled, without_a_cpu
from _plant_reference import by_eigenvalues, driver_and_mechanics, mechanics_alone, states, van_loan
from _reference import central_differences
from scipy.signal import freqs, lsim, lti

import microid as m
from microid._linear import _all_at_once, _one_by_one

SAMPLES = 150
# Time constant in s, natural frequency in Hz, damping ratio, per a millisecond between samples.
PLANTS = {
    "light": (8e-4, 40.0, 0.03),
    "undamped": (8e-4, 40.0, 0.0),
    "critical": (2e-3, 60.0, 1.0),
    "nearly critical": (2e-3, 60.0, 1 + 1e-9),
    "over-damped": (2e-3, 60.0, 3.0),
    "triple pole": (1 / (2 * np.pi * 60), 60.0, 1.0),
    "driver on a mechanical pole": (2 / (2 * np.pi * 60), 60.0, 1.25),
    "stiff driver": (1e-9, 40.0, 0.1),
    "stiff mechanics": (5e-3, 1e6, 0.7),
    "stiff and over-damped": (5e-3, 2e3, 50.0),
    "slow": (50.0, 0.02, 0.4),
}


@compiled
def respond(plant, time_s, signal, before):
    return plant(time_s, signal, m.Start(rest_V=before))


@compiled
def jacobian(parameters, time_s, signal):
    def function(parameters):
        return linear_stage(*parameters)(time_s, signal, m.Start(rest_V=0.0))

    return function(parameters), jax.jacfwd(function)(parameters), jax.jacrev(function)(parameters)


def linear_stage(time_constant_s, natural_frequency_Hz, damping_ratio, gain=1.0, hold="first"):
    driver = m.Driver(time_constant_s)
    return m.Stage.of(
        driver=driver, piezo=m.Piezo(gain), mechanics=m.Mechanics(natural_frequency_Hz, damping_ratio), hold=hold
    )


def times(rng, even):
    """A dyadic interval, of which multiples and differences are exact; or intervals from a half to three of it."""
    step = 2.0**-10 * (np.ones(SAMPLES) if even else rng.uniform(0.5, 3, SAMPLES))
    return np.cumsum(step) - step[0]


def commands(rng):
    """Steps, rests and slopes between -50 V and 50 V."""
    jumps = np.repeat(rng.uniform(-50, 50, SAMPLES // 10), 10)
    return np.where(
        np.arange(SAMPLES) < SAMPLES // 2, jumps, np.interp(np.arange(SAMPLES), np.arange(0, 150, 10), jumps[::10])
    )


@pytest.mark.parametrize("even", [True, False], ids=["even", "uneven"])
@pytest.mark.parametrize("hold", ["first", "zero"])
@pytest.mark.parametrize("name", PLANTS)
def test_plant_is_that_of_the_matrix_exponential(name, hold, even, rng):
    time_s, signal = times(rng, even), commands(rng)
    before = np.asarray(rng.uniform(-50, 50))
    interval = by_eigenvalues if "stiff" in name else van_loan
    expected = states(*driver_and_mechanics(*PLANTS[name]), time_s, signal, hold, before, interval)[:, 1]
    plant = linear_stage(*PLANTS[name], hold=hold)
    np.testing.assert_allclose(respond(plant, time_s, signal, before), expected, rtol=0, atol=1e-12 * 100)
    if even:
        got = respond(plant, np.asarray(time_s[1]), signal, before)
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12 * 100)


@pytest.mark.parametrize("even", [True, False], ids=["even", "uneven"])
@pytest.mark.parametrize("name", PLANTS)
def test_derivatives_are_finite_and_right_at_every_limit(name, even, rng):
    time_s, signal = times(rng, even), commands(rng)
    parameters = np.array(PLANTS[name])
    forward, reverse = (np.asarray(x) for x in jacobian(parameters, time_s, signal)[1:])
    assert np.all(np.isfinite(forward))
    scale = np.abs(forward).max(axis=0)
    np.testing.assert_allclose(forward / scale, reverse / scale, rtol=0, atol=1e-10)

    def function(parameters):
        return states(*driver_and_mechanics(*parameters), time_s, signal, "first", 0.0)[:, 1]

    if "stiff" in name:
        return
    step = 1e-5 * np.maximum(parameters, 1e-2 * (np.arange(3) == 2))
    expected = central_differences(function, parameters, step)
    np.testing.assert_allclose(forward / scale, expected / scale, rtol=0, atol=3e-7)


def test_fast_states_have_vanishing_derivatives(rng):
    """A driver a million times faster than the samples: its lag shifts the output, and stiffness breaks nothing."""
    time_s, signal = times(rng, True), commands(rng)
    _, forward, _ = jacobian(np.array(PLANTS["stiff driver"]), time_s, signal)
    a, b = mechanics_alone(*PLANTS["stiff driver"][1:])
    x = states(a, b, time_s, signal, "first", 0.0)
    # To first order in tau a lag subtracts tau times the velocity, from the second sample on.
    np.testing.assert_allclose(
        forward[1:, 0], -x[1:, 1] * a[0, 1], rtol=0, atol=1e-4 * np.abs(x[:, 1] * a[0, 1]).max()
    )


@pytest.mark.parametrize("hold", ["first", "zero"])
def test_plant_is_that_of_lsim(hold, rng):
    tau_s, natural_Hz, damping = rng.uniform(1e-3, 5e-3), rng.uniform(20, 80), rng.uniform(0.02, 2)
    rate = 2 * np.pi * natural_Hz
    time_s, signal = times(rng, True), commands(rng)
    signal[0] = 0
    plant = lti([0.3], np.polymul([tau_s, 1], [1 / rate**2, 2 * damping / rate, 1]))
    expected = lsim(plant, signal, time_s, interp=hold == "first")[1]
    got = respond(linear_stage(tau_s, natural_Hz, damping, 0.3, hold), time_s, signal, np.zeros(()))
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-11 * np.ptp(expected))


def test_dense_time_changes_nothing(rng):
    """Lines between samples, sampled sixteen times as often; and steps of 1e-7 of a period, which lose no digits."""
    plant = linear_stage(2e-3, 45.0, 0.05)
    time_s, signal = times(rng, False), commands(rng)
    fine_s = np.interp(np.arange(16 * SAMPLES - 15) / 16, np.arange(SAMPLES), time_s)
    fine = np.interp(fine_s, time_s, signal)
    coarse = respond(plant, time_s, signal, np.asarray(3.0))
    np.testing.assert_allclose(respond(plant, fine_s, fine, np.asarray(3.0))[::16], coarse, rtol=0, atol=1e-11 * 100)


@compiled
def both_ways(step, push):
    return m.recur(step, push), _one_by_one(step, push), _all_at_once(step, push)


def pulled(step, push, weight):
    @compiled
    def gradient(step, push):
        return jax.grad(lambda step, push: weight.ravel() @ m.recur(step, push).ravel(), argnums=(0, 1))(step, push)

    return gradient(step, push)


@pytest.mark.parametrize("order", [1, 2, 4])
def test_sequential_and_parallel_recurrences_agree(order, rng, monkeypatch):
    step = rng.normal(size=(SAMPLES, order, order)) / (1 + order)
    push, weight = rng.normal(size=(2, SAMPLES, order))
    z, expected = np.zeros(order), []
    for matrix, more in zip(step, push, strict=True):
        z = matrix @ z + more
        expected.append(z)
    for got in both_ways(step, push):
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    by_cpu = pulled(step, push, weight)
    dense = np.eye(SAMPLES * order)
    for k in range(1, SAMPLES):
        dense[k * order : (k + 1) * order, (k - 1) * order : k * order] = -step[k]
    adjoint = np.linalg.solve(dense.T, weight.ravel()).reshape(push.shape)
    np.testing.assert_allclose(by_cpu[1], adjoint, rtol=0, atol=1e-12 * np.abs(adjoint).max())
    without_a_cpu(monkeypatch)
    for one, other in zip(pulled(step, push, weight), by_cpu, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * np.abs(other).max())


def test_transfer_functions_are_those_of_scipy(rng):
    """Eq. 15, 17 and, with the amplifier's gain in (12), their product (18)."""
    tau_s, natural_Hz, damping, gain, ratio = rng.uniform(0.1, 2, 5) * [1e-3, 300, 1, 3, 5]
    per_V = rng.uniform(0.1, 1)
    driver, piezo = m.Driver(tau_s, gain), m.Piezo(per_V, 4.0)
    mechanics = m.Mechanics(natural_Hz, damping, ratio)
    rate = 2 * np.pi * natural_Hz
    frequency_Hz = np.geomspace(0.1, 1e5, 60)
    slow, fast = [tau_s, 1], [1 / rate**2, 2 * damping / rate, 1]
    stages = {
        15: (m.Stage.of(driver=driver, piezo=piezo), [gain * per_V], slow),
        17: (mechanics, [ratio], fast),
        18: (
            m.Stage.of(driver=driver, piezo=piezo, mechanics=mechanics),
            [gain * per_V * ratio],
            np.polymul(slow, fast),
        ),
    }
    for model, over, under in stages.values():
        expected = freqs(over, under, 2 * np.pi * frequency_Hz)[1]
        np.testing.assert_allclose(compiled(model.frequency_response)(frequency_Hz), expected, rtol=1e-10)
        s = rng.normal(size=9) * 1e3 + 1j * rng.normal(size=9) * 1e3
        np.testing.assert_allclose(
            compiled(model.transfer)(s), np.polyval(over, s) / np.polyval(under, s), rtol=1e-10
        )
        np.testing.assert_allclose(model.static_gain, over[0] / under[-1], rtol=1e-13)
        # Of a pair rounding alone decides which comes first, by its real part.
        roots, wanted = (np.sort_complex(-1j * np.asarray(x)) for x in (model.poles_rad_per_s, np.roots(under)))
        np.testing.assert_allclose(roots, wanted, rtol=1e-8)


def test_poles_meet_at_critical_damping():
    poles = np.asarray(m.Mechanics(10.0, 1.0).poles_rad_per_s)
    np.testing.assert_array_equal(poles, [-20 * np.pi, -20 * np.pi])


@pytest.mark.parametrize("damping", [1.5, 1e4, 1e9])
def test_the_slow_pole_keeps_its_digits(damping):
    """Above critical damping it is that of spring and damper, `-k / c`, to second order in `1 / zeta`."""
    slow, fast = np.asarray(m.Mechanics(1 / (2 * np.pi), damping).poles_rad_per_s)
    np.testing.assert_allclose(slow * fast, 1, rtol=1e-14)
    np.testing.assert_allclose(slow + fast, -2 * damping, rtol=1e-14)
    if damping > 100:
        np.testing.assert_allclose(slow, -1 / (2 * damping), rtol=1e-7)


def test_a_sine_settles_to_the_frequency_response(rng):
    plant = linear_stage(2e-3, 60.0, 0.2, 0.4)
    frequency_Hz = rng.uniform(20, 120)
    time_s = np.arange(8192) * 2.0**-14
    angle = 2 * np.pi * frequency_Hz * time_s
    settled = np.asarray(respond(plant, time_s, 10 * np.sin(angle), np.zeros(())))[4096:]
    design = np.stack([np.sin(angle), np.cos(angle)], axis=1)[4096:]
    (real, imag), *_ = np.linalg.lstsq(design, settled, rcond=None)
    # Lines between samples stand in for the sine: their amplitude is smaller by sinc squared.
    expected = 10 * complex(plant.frequency_response(frequency_Hz)) * np.sinc(frequency_Hz * 2.0**-14) ** 2
    assert abs(real + 1j * imag - expected) < 1e-5 * abs(expected)


def test_physical_quantities_make_the_same_parts():
    driver = m.Driver.from_circuit(100.0, 7e-6, 10.0)
    np.testing.assert_allclose([driver.time_constant_s, driver.gain], [7e-4, 10.0], rtol=1e-14)
    piezo = m.Piezo.from_stack(100, 5e-4, 30.0, 10.0)
    np.testing.assert_allclose(piezo.gain_um_per_V, 100 * 5e-4 * 30 / 40, rtol=1e-14)
    mechanics = m.Mechanics.from_mass(0.5, 2e5, 20.0, 3.0)
    poles = np.sort_complex(np.asarray(mechanics.poles_rad_per_s))
    np.testing.assert_allclose(poles, np.sort_complex(np.roots([0.5, 20.0, 2e5])), rtol=1e-12)
    np.testing.assert_allclose(mechanics.static_gain, 3.0)


def test_one_sample_and_none_of_inertia():
    plant = linear_stage(1e-3, 50.0, 0.1, 2.0)
    np.testing.assert_allclose(respond(plant, np.zeros(1), np.full(1, 3.0), np.asarray(3.0)), [6.0])
    np.testing.assert_allclose(respond(plant, np.zeros(1), np.full(1, 3.0), np.asarray(1.0)), [2.0])
    sensor = m.Stage.of(piezo=m.Piezo(2.0, 1.0), sensor=m.Sensor(3.0, 0.5))
    np.testing.assert_allclose(sensor(np.arange(3.0), np.arange(3.0)), [3.5, 9.5, 15.5])


def test_times_rounded_in_single_precision_count_as_even():
    time_s = (100 + np.arange(SAMPLES) * 1e-3).astype(np.float32)
    signal = np.sin(np.arange(SAMPLES) / 9).astype(np.float32)
    plant = jax.tree.map(lambda x: x.astype(jnp.float32), linear_stage(2e-3, 60.0, 0.1))
    got = respond(plant, time_s, signal, signal[0])
    assert got.dtype == np.float32
    exact_s = np.arange(SAMPLES) * (float(time_s[-1]) - float(time_s[0])) / (SAMPLES - 1)
    expected = states(*driver_and_mechanics(2e-3, 60.0, 0.1), exact_s, signal.astype(float), "first")[:, 1]
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-4)


def test_whole_volts_are_no_integers():
    """An interval rounded to a whole number of seconds is none."""
    system, before = m.Driver(1e-3).system(), np.asarray(0.0)
    whole_V = np.array([0, 3, -2, 5])
    respond = compiled(system.respond)
    expected = respond(np.asarray(1e-3), whole_V.astype(float), before)
    np.testing.assert_array_equal(respond(np.asarray(1e-3), whole_V, before), expected)
    stage = compiled(m.Stage.of(driver=m.Driver(1e-3), piezo=m.Piezo(1.0)))
    np.testing.assert_array_equal(stage(np.asarray(1e-3), whole_V, m.Start(rest_V=before)), expected)


def test_an_unknown_hold_is_refused():
    with pytest.raises(ValueError, match="hold must be 'first', 'zero' or 'smooth'"):
        m.Driver(1e-3).system().respond(np.arange(2.0), np.arange(2.0), jnp.asarray(0.0), "second")
