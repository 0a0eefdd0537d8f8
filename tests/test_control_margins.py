"""Margins against SciPy's transfer functions, their roots and impulses, and against what follows by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _models import compiled, random_model
from _reference import central_differences
from scipy.signal import cont2discrete, dimpulse, dlti, freqz

import microid as m
import microid.control as c

T = 1e-3


def random_loop(rng):
    """Gains in V/um, V/(um s) and V s/um, a filter, a plant, and a delay: stable or not. One delay is one program."""
    plant = rng.uniform([5e-4, 40, 0.1, 0.05], [3e-3, 150, 0.5, 0.2])
    slowest = 2 * np.pi * plant[1] * plant[2] / plant[3]
    gains = slowest * rng.uniform([2e-5, 0.05, 1e-8], [2e-3, 0.8, 5e-7])
    return gains, rng.uniform(1e-4, 2e-3), plant, 2


def built(gains, filter_s, plant):
    tau_s, natural_Hz, damping, gain = plant
    stage = m.Stage.of(
        driver=m.Driver(tau_s), piezo=m.Piezo(gain, 3.0), mechanics=m.Mechanics(natural_Hz, damping), substeps=2
    )
    return c.PID(*gains, T, filter_s=filter_s, lower_V=0.0, upper_V=1.0, tracking_s=0.1), stage


@compiled
def _margins(pid, stage, delay, slope_um_per_V=None):
    return c.margins(pid, stage, delay=delay, slope_um_per_V=slope_um_per_V)


def margins_of(gains, filter_s, plant, delay):
    return _margins(*built(gains, filter_s, plant), delay)


def polynomials(gains, filter_s, plant, delay):
    """Numerators and denominators, in falling powers of z, of the controller and of the plant with its delay."""
    kp, ki, kd = gains
    tau_s, natural_Hz, damping, gain = plant
    rate = 2 * np.pi * natural_Hz
    continuous = [gain], np.polymul([tau_s, 1], [1 / rate**2, 2 * damping / rate, 1])
    numerator, denominator, _ = cont2discrete(continuous, T, method="zoh")
    slow, late = [1, -1], [filter_s + T, -filter_s]
    controller = np.polyadd(
        kp * np.polymul(slow, late), np.polyadd(ki * T * np.polymul([1, 0], late), kd * np.polymul(slow, slow))
    )
    return controller, np.polymul(slow, late), numerator[0], np.append(denominator, np.zeros(delay))


def closed_radius(loop, factor=1.0):
    c_n, c_d, p_n, p_d = loop
    return np.abs(np.roots(np.polyadd(np.polymul(c_d, p_d), factor * np.polymul(c_n, p_n)))).max()


def stable_loop(rng):
    while True:
        numbers = random_loop(rng)
        if closed_radius(polynomials(*numbers)) < 0.999:
            return numbers


def response(loop, frequency_Hz):
    c_n, c_d, p_n, p_d = loop
    z = np.exp(2j * np.pi * frequency_Hz * T)
    return np.polyval(c_n, z) / np.polyval(c_d, z) * np.polyval(p_n, z) / np.polyval(p_d, z)


def test_loop_gain_is_that_of_scipy(rng):
    numbers = random_loop(rng)
    pid, stage = built(*numbers[:3])
    frequency = np.geomspace(0.1, 499, 50)
    found = compiled(c.loop_gain.__wrapped__)(pid, stage, jnp.asarray(frequency), delay=2)
    c_n, c_d, p_n, p_d = polynomials(*numbers)
    expected = np.ones(50, dtype=complex)
    for top, bottom in ((c_n, c_d), (p_n, p_d)):
        short = np.append(np.zeros(len(bottom) - len(top)), top)
        expected *= freqz(short, bottom, frequency, fs=1 / T)[1]
    np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_gain_margin_is_the_factor_at_which_a_pole_leaves_the_unit_circle(rng):
    for _ in range(4):
        numbers = stable_loop(rng)
        found, loop = margins_of(*numbers), polynomials(*numbers)
        assert bool(found.stable)
        assert float(found.radius) == pytest.approx(closed_radius(loop), abs=1e-8)
        factor = float(found.gain_margin)
        assert closed_radius(loop, factor) == pytest.approx(1, abs=1e-6)
        assert all(closed_radius(loop, f) < 1 for f in np.linspace(1, factor * (1 - 1e-6), 40))
        assert closed_radius(loop, factor * 1.001) > 1
        # At that frequency the loop gain is real and negative.
        there = response(loop, float(found.gain_margin_Hz))
        assert there == pytest.approx(-1 / factor, rel=1e-5)


def test_phase_margin_and_sensitivity_are_those_of_a_dense_grid(rng):
    frequency = np.concatenate([np.geomspace(1e-3, 1, 40_000), np.linspace(1, 500, 400_001)[:-1]])
    for _ in range(4):
        numbers = stable_loop(rng)
        found, gain = margins_of(*numbers), response(polynomials(*numbers), frequency)
        crossed = np.flatnonzero(np.diff(np.sign(np.abs(gain) - 1)))
        angle = np.abs(np.angle(-gain[crossed], deg=True))
        assert float(found.phase_margin_deg) == pytest.approx(angle.min(), abs=0.05)
        there = response(polynomials(*numbers), float(found.phase_margin_Hz))
        assert (abs(there), abs(np.angle(-there, deg=True))) == pytest.approx((1, angle.min()), rel=1e-3, abs=0.05)
        assert float(found.crossover_Hz) == pytest.approx(frequency[crossed[-1]], rel=1e-3, abs=2e-3)
        sensitivity = 1 / np.abs(1 + gain)
        assert float(found.sensitivity_peak) == pytest.approx(sensitivity.max(), rel=1e-5)
        assert float(found.sensitivity_peak_Hz) == pytest.approx(frequency[sensitivity.argmax()], rel=1e-2, abs=0.5)


def test_noise_is_amplified_by_the_root_of_the_energy_of_the_answer_to_an_impulse(rng):
    for _ in range(4):
        numbers = stable_loop(rng)
        found, (c_n, c_d, p_n, p_d) = margins_of(*numbers), polynomials(*numbers)
        whole = np.polyadd(np.polymul(c_d, p_d), np.polymul(c_n, p_n))
        count = int(40 / -np.log(closed_radius((c_n, c_d, p_n, p_d)))) + 100
        # The delay lies between reading and controller: what is written here with the plant's poles is late as well.
        ahead = np.polymul(c_n, p_d[: len(p_d) - numbers[3]])
        for top, name in (
            (np.polymul(c_n, p_n), "noise_to_displacement"),
            (ahead, "noise_to_command_V_per_um"),
        ):
            answer = dimpulse(dlti(top, whole, dt=T), n=count)[1][0].ravel()
            assert float(getattr(found, name)) == pytest.approx(np.sqrt(np.sum(answer**2)), rel=1e-6)


def test_integral_controller_without_inertia_is_as_by_hand(rng):
    """With `k = K_i T g` the pole is `1 - k`, the gain margin `2 / k`, and noise passes as `k / (2 - k)`."""
    k, g = rng.uniform(0.2, 0.9), rng.uniform(0.05, 0.5)
    found = _margins(c.PID(0.0, k / (T * g), 0.0, T), m.Stage.of(piezo=m.Piezo(g)), 0)
    assert float(found.radius) == pytest.approx(1 - k, abs=1e-12)
    assert float(found.gain_margin) == pytest.approx(2 / k, rel=1e-6)
    # |L| = 1 where 2 sin(w T / 2) = k; the integrator lags there by 90 degrees and half a sample.
    turn = 2 * np.arcsin(k / 2)
    assert float(found.crossover_Hz) == pytest.approx(turn / (2 * np.pi * T), rel=1e-9)
    assert float(found.phase_margin_deg) == pytest.approx(90 - np.degrees(turn) / 2, rel=1e-9)
    assert float(found.sensitivity_peak) == pytest.approx(2 / (2 - k), rel=1e-6)
    assert float(found.noise_to_displacement) == pytest.approx(np.sqrt(k / (2 - k)), rel=1e-9)


def test_a_controller_that_does_nothing_has_every_margin():
    found = _margins(*built([1e-9, 0, 0], 0.0, [1e-3, 50, 0.1, 0.1]), 2)
    assert bool(found.stable)
    assert (float(found.phase_margin_deg), float(found.crossover_Hz)) == (np.inf, 0)
    assert float(found.gain_margin) > 1e6
    assert float(found.sensitivity_peak) == pytest.approx(1, abs=1e-6)


def test_an_unstable_loop_is_refused_and_a_stable_one_passed_on(rng):
    numbers = stable_loop(rng)
    found = margins_of(*numbers)
    assert c.require_stable(found) is found
    unstable = margins_of(np.array(numbers[0]) * float(found.gain_margin) * 1.01, *numbers[1:])
    assert not bool(unstable.stable)
    assert float(unstable.noise_to_displacement) == np.inf
    with pytest.raises(ValueError, match="the closed loop is unstable: its largest pole has modulus 1"):
        c.require_stable(unstable)


def test_the_loop_that_is_called_stable_is_the_one_that_settles(rng):
    """The margin is that of the simulation: just below the gain margin it settles, just above it does not."""
    numbers = stable_loop(rng)
    found = margins_of(*numbers)
    for factor, settles in ((0.9, True), (1.1, False)):
        gains = np.array(numbers[0]) * float(found.gain_margin) * factor
        pid, stage = built(gains, *numbers[1:3])
        free = eqx.tree_at(lambda pid: (pid.lower_V, pid.upper_V), pid, (jnp.asarray(-np.inf), jnp.asarray(np.inf)))
        radius = float(margins_of(gains, *numbers[1:]).radius)
        length = int(12 / abs(np.log(radius))) + 200
        error = np.abs(c.simulate_loop(free, stage, np.full(length, 4.0), delay=2).error_um)
        assert (error[-100:].max() < 0.1) == settles


def test_a_hysteresis_stands_for_its_slope(rng):
    gains, filter_s, plant, delay = stable_loop(rng)
    pid, stage = built(gains, filter_s, plant)
    bent = stage.swap("piezo", random_model(rng))
    with pytest.raises(ValueError, match="'piezo' is not linear: give the slope_um_per_V"):
        c.margins(pid, bent, delay=delay)
    found = _margins(pid, bent, delay, plant[3])
    for one, two in zip(
        jax.tree.leaves(found), jax.tree.leaves(margins_of(gains, filter_s, plant, delay)), strict=True
    ):
        np.testing.assert_allclose(one, two, rtol=1e-6)
    with pytest.raises(ValueError, match="delay must be"):
        c.margins(pid, stage, delay=-1)


def _figures(numbers, delay):
    found = c.margins(*built(numbers[:3], numbers[3], numbers[4:]), delay=delay)
    return jnp.stack(
        [
            found.radius,
            found.gain_margin,
            found.phase_margin_deg,
            found.crossover_Hz,
            found.sensitivity_peak,
            found.noise_to_displacement,
            found.noise_to_command_V_per_um,
        ]
    )


@compiled
def _both(numbers, delay):
    """One program for the figures and their derivatives, since compiling takes longer than both."""
    return _figures(numbers, delay), jax.jacrev(lambda x: _figures(x, delay))(numbers)


@pytest.mark.study
def test_derivatives_are_those_of_finite_differences(rng):
    gains, filter_s, plant, delay = stable_loop(rng)
    numbers = np.concatenate([gains, [filter_s], plant])
    found = np.asarray(_both(jnp.asarray(numbers), delay)[1]) * numbers
    step = 1e-6 * numbers
    expected = central_differences(lambda x: _both(jnp.asarray(x), delay)[0], numbers, step) * numbers
    scale = np.abs(expected).max(axis=1, keepdims=True)
    np.testing.assert_allclose(found / scale, expected / scale, rtol=0, atol=2e-4)
