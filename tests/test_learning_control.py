"""Resonators, learning from trials and two degrees of freedom, against NumPy and SciPy and what follows by hand."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from _models import compiled, linear_stage_of
from _plant_reference import driver_and_mechanics, states, van_loan
from jax import lax
from scipy.interpolate import CubicSpline
from scipy.signal import cont2discrete, lfilter

import microid.control as c

T = 1e-3
SAMPLES = 300
GAIN, OFFSET = 0.12, 1.5
PLANT = (2e-3, 60.0, 0.2)


@compiled
def play(controller, reference_um, measured_um, feedforward_V):
    def visit(state, now):
        return controller.step(state, *now)

    return lax.scan(visit, controller.init(measured_um[0]), (reference_um, measured_um, feedforward_V))[1]


def linear_stage(plant=PLANT, gain=GAIN):
    return linear_stage_of(plant, gain, OFFSET)


def random_pid(rng, **others):
    return c.PID(*rng.uniform([0.2, 20, 1e-4], [1, 60, 1e-3]), T, filter_s=rng.uniform(1e-3, 3e-3), **others)


def pid_by_numpy(pid, error):
    """Commands of a PID controller under an error, all weights being one; no limits."""
    kp, ki, kd, tf = (
        float(getattr(pid, name))
        for name in ("proportional_V_per_um", "integral_V_per_um_s", "derivative_V_s_per_um", "filter_s")
    )
    slope = lfilter([kd / (tf + T), -kd / (tf + T)], [1, -tf / (tf + T)], error)
    return kp * error + ki * T * np.cumsum(error) + slope


def plant_polynomials(plant=PLANT, gain=GAIN, delay=0):
    tau_s, natural_Hz, damping = plant
    rate = 2 * np.pi * natural_Hz
    bottom = np.polymul([tau_s, 1], [1 / rate**2, 2 * damping / rate, 1])
    above, below, _ = cont2discrete(([gain], bottom), T, method="zoh")
    return above[0], np.append(below, np.zeros(delay))


@pytest.mark.parametrize("limits", [(-np.inf, np.inf), (23.0, 27.0)])
def test_resonators_are_those_of_numpy(limits, rng):
    frequency, gain, lead = rng.uniform(5, 80, 3), rng.uniform(20, 200, 3), rng.uniform(-180, 180, 3)
    pid = random_pid(rng)
    # Without the anti-windup, which is tested elsewhere.
    pid = c.PID(pid.proportional_V_per_um, 0.0, 0.0, T, tracking_s=np.inf, lower_V=limits[0], upper_V=limits[1])
    reference = 5 + np.sin(2 * np.pi * 20 * T * np.arange(SAMPLES))
    measured, ahead = reference - rng.normal(0, 0.5, SAMPLES), 25 + rng.normal(0, 2, SAMPLES)
    held, expected = np.zeros(3, dtype=complex), []
    for r, y, ff in zip(reference, measured, ahead, strict=True):
        turned = held * np.exp(2j * np.pi * frequency * T)
        pushed = turned + gain * T * (r - y)
        wanted = (
            ff + float(pid.proportional_V_per_um) * (r - y) + np.sum((np.exp(1j * np.radians(lead)) * pushed).real)
        )
        expected.append(np.clip(wanted, *limits))
        held = pushed if limits[0] < wanted < limits[1] else turned
    found = play(c.ResonantPID(pid, frequency, gain, lead), reference, measured, ahead)
    if np.isfinite(limits[0]):
        assert np.any(np.isin(expected, limits)) and not np.all(np.isin(expected, limits))  # noqa: PT018
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def test_without_resonators_it_is_the_pid_controller_and_its_sum(rng):
    pid = random_pid(rng)
    error = rng.normal(0, 1, SAMPLES)
    zeros = np.zeros(SAMPLES)
    found = play(c.ResonantPID(pid, [20.0], [0.0], [0.0]), error, zeros, zeros)
    # The derivative starts from the first reading of zero error.
    np.testing.assert_allclose(found, pid_by_numpy(pid, error), rtol=1e-9, atol=1e-9)


def test_transfer_of_resonators_is_the_response_to_an_impulse(rng):
    controller = c.ResonantPID(
        random_pid(rng), rng.uniform(5, 80, 2), rng.uniform(20, 200, 2), rng.uniform(-90, 90, 2)
    )
    z, n = 1.05 * np.exp(1j * rng.uniform(0.1, 3, 5)), np.arange(1500)
    response = np.asarray(play(controller, np.append(0, np.eye(1, 1500)[0]), *np.zeros((2, 1501))))[1:]
    np.testing.assert_allclose(
        controller.transfer(jnp.asarray(z)), (response * z[:, None] ** -n).sum(axis=1), rtol=1e-9
    )


def test_resonators_need_one_shape():
    with pytest.raises(ValueError, match="one shape"):
        c.ResonantPID(c.PID(1.0, 1.0, 0.0, T), [20.0, 30.0], [1.0], [0.0])


@compiled
def around(pid, stage, frequency_Hz, rate_per_s):
    """A controller, the margins of its loop, and those of the loop without resonators."""
    found = c.ResonantPID.around(pid, stage, frequency_Hz, rate_per_s, delay=1)
    return found, c.margins(found, stage, delay=1)


def test_the_error_of_a_sinusoid_vanishes_at_the_stated_rate(rng):
    """A pole of the closed loop stands at the rate and the frequency; SciPy's polynomials have the same poles."""
    frequency, rate = rng.uniform(10, 25), rng.uniform(0.2, 0.5)
    pid, stage = c.PID(0.3, 120.0, 0.0, T), linear_stage()
    found, margins = around(pid, stage, jnp.asarray([frequency]), jnp.asarray(rate))
    gain, lead = float(found.resonant_V_per_um_s[0]) * T, np.radians(float(found.lead_deg[0]))
    turn = 2 * np.pi * frequency * T
    top, bottom = plant_polynomials(delay=1)
    slow, ring = [1, -1], [1, -2 * np.cos(turn), 1]
    pi = [0.3 + 120 * T, -0.3]
    resonant = gain * np.array([np.cos(lead), -np.cos(turn - lead), 0])
    above = np.polyadd(np.polymul(pi, ring), np.polymul(resonant, slow))
    poles = np.roots(np.polyadd(np.polymul(np.polymul(slow, ring), bottom), np.polymul(above, top)))
    assert float(margins.radius) == pytest.approx(np.abs(poles).max(), abs=1e-8)
    near = poles[np.argmin(np.abs(poles - np.exp(1j * turn)))]
    assert -np.log(np.abs(near)) / T == pytest.approx(rate, rel=0.05)
    assert np.abs(np.angle(near)) / (2 * np.pi * T) == pytest.approx(frequency, abs=0.02 * rate)
    assert bool(margins.stable)


def test_resonators_follow_a_sinusoid_that_the_pid_controller_does_not(rng):
    """What is left after the transient is nothing, where the PID controller alone leaves `|S|` of the amplitude."""
    pid, stage, frequency = c.PID(0.3, 120.0, 0.0, T), linear_stage(), 20.0
    reference = OFFSET + 3 + np.sin(2 * np.pi * frequency * T * np.arange(3000))
    resonant = c.ResonantPID.around(pid, stage, np.array([frequency]), 8.0)
    left = [np.abs(c.simulate_loop(x, stage, reference).error_um[-200:]).max() for x in (pid, resonant)]
    top, bottom = plant_polynomials()
    z = np.exp(2j * np.pi * frequency * T)
    sensitivity = 1 / (1 + (0.3 + 120 * T * z / (z - 1)) * np.polyval(top, z) / np.polyval(bottom, z))
    assert left[0] == pytest.approx(abs(sensitivity), rel=0.02)
    assert left[1] < 1e-4 * left[0]


def learnt_by_numpy(command, error, bandwidth_Hz, share, loop=None):
    """The correction in plain NumPy: polynomials of the sampled plant on the unit circle, edges held."""
    n = len(error)
    f = np.maximum(np.fft.rfftfreq(3 * n), 5e-10) / T
    z = np.exp(2j * np.pi * f * T)
    top, bottom = plant_polynomials()
    path = np.polyval(top, z) / np.polyval(bottom, z)
    if loop is not None:
        kp, ki = loop
        path = path / (1 + (kp + ki * T * z / (z - 1)) * path)
    q = 1 / (1 + (f / bandwidth_Hz) ** 8)
    whole = np.concatenate([np.full(n, error[0]), error, np.full(n, error[-1])])
    return command + np.fft.irfft(share * q / path * np.fft.rfft(whole), 3 * n)[n : 2 * n]


@pytest.mark.parametrize("loop", [None, (0.3, 60.0)])
def test_a_correction_is_that_of_numpy(loop, rng):
    command, error = rng.normal(30, 5, SAMPLES), rng.normal(0, 0.3, SAMPLES)
    bandwidth, share = rng.uniform(30, 80), rng.uniform(0.3, 1)
    controller = None if loop is None else c.PID(*loop, 0.0, T)
    found = c.learn_once(
        command, error, linear_stage(), T, bandwidth_Hz=bandwidth, share=share, controller=controller
    )
    expected = learnt_by_numpy(command, error, bandwidth, share, loop)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def bump(at, low, high, width):
    return low + (high - low) * np.exp(-(((at - at[-1] / 2) / width) ** 2))


def plant_by_numpy(command, plant, gain):
    """The stage under held commands, in SciPy's matrix exponentials."""
    x = states(*driver_and_mechanics(*plant), T * np.arange(len(command)), command, "zero")
    return OFFSET + gain * x[:, 1]


def test_what_is_slow_shrinks_by_one_minus_the_share_from_trial_to_trial(rng):
    """And faster or slower by as much as the model is wrong: by `1 - μ (1 + d)`."""
    at, share, wrong = T * np.arange(600), rng.uniform(0.3, 0.6), rng.uniform(0.7, 1.3)
    reference = bump(at, OFFSET, OFFSET + 4, 0.06)
    found = c.iterative_learning(
        lambda command: plant_by_numpy(np.asarray(command), PLANT, wrong * GAIN),
        reference,
        np.zeros(600),
        linear_stage(),
        T,
        trials=6,
        share=share,
        bandwidth_Hz=80.0,
    )
    assert found.error_um.shape == (7, 600)
    np.testing.assert_allclose(found.rms_um[1:5] / found.rms_um[:4], abs(1 - share * wrong), rtol=0.02)


def test_learning_on_a_plant_that_is_not_the_model_leaves_next_to_nothing(rng):
    """Ten trials in a loop, on a plant of other time constants and damping: errors fall a hundredfold."""
    at = T * np.arange(600)
    reference = bump(at, OFFSET, OFFSET + 4, 0.05)
    other = tuple(np.array(PLANT) * rng.uniform(0.9, 1.1, 3))
    truth, pid = linear_stage(other, 0.9 * GAIN), c.PID(0.3, 60.0, 0.0, T)
    found = c.iterative_learning(
        lambda command: c.simulate_loop(pid, truth, reference, feedforward_V=command).displacement_um,
        reference,
        np.zeros(600),
        linear_stage(),
        T,
        trials=10,
        share=0.8,
        bandwidth_Hz=50.0,
        controller=pid,
    )
    assert found.rms_um[-1] < 0.01 * found.rms_um[0]
    again = plant_by_numpy(np.asarray(found.command_V), other, 0.9 * GAIN)
    assert again.shape == (600,)


def test_trials_that_teach_nothing_leave_the_best_command(rng):
    """A bench that is turned round: every trial is worse, and the first command is the answer."""
    reference, first = bump(T * np.arange(200), 1.0, 2.0, 0.02), np.full(200, 10.0)
    filters = {"bandwidth_Hz": 40.0, "trials": 3}
    found = c.iterative_learning(lambda u: 3 - 0.12 * u, reference, first, linear_stage(), T, **filters)
    assert np.all(np.diff(found.rms_um) > 0)
    np.testing.assert_array_equal(found.command_V, first)
    with pytest.raises(ValueError, match="trial 0 is not finite"):
        c.iterative_learning(lambda u: u * np.nan, reference, first, linear_stage(), T, **filters)
    with pytest.raises(ValueError, match="one shape"):
        c.iterative_learning(lambda u: u, reference[1:], first, linear_stage(), T, **filters)
    bounded = c.iterative_learning(
        lambda u: 1.5 + 0.12 * u, reference, first, linear_stage(), T, limits_V=(0.0, 3.0), **filters
    )
    assert np.all((bounded.command_V >= 0) & (bounded.command_V <= 3))


@pytest.mark.parametrize("lag_s", [0.0, 0.01])
def test_two_degrees_are_those_of_scipy(lag_s, rng):
    """Reference model by lfilter, inverse by splines, response by matrix exponentials."""
    at = T * np.arange(SAMPLES)
    reference = bump(at, 4.0, 9.0, 0.04) if lag_s == 0 else 4.0 + 3 * (at > 0.05)
    found = c.two_degrees(linear_stage(), T, reference, lag_s=lag_s)
    target, keep = reference, np.exp(-T / lag_s) if lag_s else 0.0
    for _ in range(4):
        target = lfilter([1 - keep], [1, -keep], target, zi=[keep * target[0]])[0]
    tau_s, natural_Hz, damping = PLANT
    rate, spline = 2 * np.pi * natural_Hz, CubicSpline(at, target)
    piezo_V = (target + 2 * damping / rate * spline(at, 1) + spline(at, 2) / rate**2 - OFFSET) / GAIN
    lines = piezo_V + tau_s * CubicSpline(at, piezo_V)(at, 1)
    held = np.append((lines[:-1] + lines[1:]) / 2, lines[-1])
    np.testing.assert_allclose(found.target_um, target, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.feedforward_V, held, rtol=0, atol=1e-8)
    step, push, _ = van_loan(*driver_and_mechanics(*PLANT), T, "zero")
    x, expected = np.full(3, lines[0]) * np.array([1, 1, 0]), []
    for u in held:
        expected.append(OFFSET + GAIN * x[1])
        x = step @ x + push * u
    np.testing.assert_allclose(found.expected_um, expected, rtol=0, atol=1e-8)
    assert np.abs(found.expected_um - target).max() < 0.05


def test_with_a_perfect_model_the_feedback_does_nothing(rng):
    pid = random_pid(rng)
    reference = 4.0 + rng.uniform(1, 3) * (np.arange(SAMPLES) > 50)
    found = c.two_degrees(linear_stage(), T, reference, lag_s=0.01)
    run = c.simulate_loop(
        pid, linear_stage(), found.expected_um, feedforward_V=found.feedforward_V, start=found.start, delay=0
    )
    np.testing.assert_allclose(run.command_V, found.feedforward_V, rtol=1e-7)
    cut = c.two_degrees(linear_stage(), T, reference, lag_s=0.01, limits_V=(25.0, 30.0))
    assert np.ptp(cut.feedforward_V) == 5
    assert float(eqx.filter_jit(lambda x: x.expected_um[0])(cut)) == pytest.approx(OFFSET + 25 * GAIN)
