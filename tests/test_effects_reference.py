"""Physical effects against SciPy and closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _models import compiled, random_model
from _parts import BY_NAME, motion, through, uneven, wander
from scipy import signal

import microid as m
from fits.stage._solve_stage import default_stage
from microid import effects as fx
from microid._part import Signal


def test_slew_limit_follows_with_the_limit(rng):
    time, command = uneven(rng, 300, 1e-3), wander(rng, 300, 0, 100)
    limit = 0.6 * np.max(np.abs(np.diff(command) / np.diff(time)))
    fine = np.linspace(0, time[-1], 200_001)
    voltage, path = command[0], []
    for target in np.interp(fine, time, command):
        voltage += np.clip(target - voltage, -limit * fine[1], limit * fine[1])
        path.append(voltage)
    found = through(BY_NAME["slew_limit", ""](limit), time, command)
    assert np.max(np.abs(found - command)) > 1
    np.testing.assert_allclose(found, np.interp(time, fine, path), atol=0.5 * limit * 1e-3)


@pytest.mark.parametrize("spacing", ["even", "uneven"])
def test_stiffness_hardening_is_duffings(rng, spacing):
    time = 2e-4 * np.arange(200) if spacing == "even" else uneven(rng, 200, 2e-4)
    push = wander(rng, 200, 5, 30)
    rate, damping, kappa, centre, half, gain = 2 * np.pi * 120, 0.03, 0.05, 12.0, 15.0, 1.2

    def right_hand(y, w):
        force = gain * w - y[0] - kappa * (y[0] - centre) ** 3 / half**2
        return [y[1], rate**2 * force - 2 * damping * rate * y[1]]

    roots = np.roots([kappa / half**2, 0, 1, centre - gain * push[0]])
    start = centre + float(roots[np.argmin(np.abs(roots.imag))].real)
    truth = motion(time, push, right_hand, np.array([start, 0.0]))[:, 0]
    mechanics = m.Mechanics(120.0, damping, gain)
    effect = BY_NAME["stiffness_hardening", ""](mechanics, kappa, centre, half)
    times = 2e-4 if spacing == "even" else time
    found, plain = through(effect, times, push), through(mechanics, times, push)
    np.testing.assert_allclose(found, truth, atol=0.04 * np.max(np.abs(truth - plain)))


def test_loops_narrow_along_the_path_of_the_command(rng):
    model = random_model(rng)
    law, (low, high) = model, (float(model.density.lower_V), float(model.density.upper_V))
    path_V = np.r_[low, wander(rng, 400, low, high)]
    given = through(law, 1e-3, path_V)
    levels = np.linspace(low, high, 65)
    up_down_up = through(law, 1e-3, np.r_[levels, levels[::-1], levels])
    middle = (up_down_up[65:130][::-1] + up_down_up[130:]) / 2
    moved_V = np.r_[0, np.cumsum(np.abs(np.diff(path_V)))]
    wider = 0.2 * np.exp(-moved_V / 150.0)
    found = through(BY_NAME["accommodation", "narrowing"](law, 0.2, 150.0), 1e-3, path_V)
    np.testing.assert_allclose(found, given + wider * (given - np.interp(path_V, levels, middle)), atol=1e-9)


def test_voltage_dependent_capacitance_is_a_changing_lag(rng):
    time, push = uneven(rng, 200, 2e-4), wander(rng, 200, 0, 100)
    truth = motion(time, push, lambda v, u: (2 * u - v) / (1e-3 * (1 + 0.4 * (v - 100) / 100)), 2 * push[:1])[:, 0]
    driver = m.Driver(1e-3, 2.0)
    found = through(BY_NAME["voltage_dependent_capacitance", ""](driver, 0.4, 100.0, 100.0), time, push)
    np.testing.assert_allclose(found, truth, atol=0.03 * np.max(np.abs(truth - through(driver, time, push))))


def lagged(time, values, frequency_Hz, damping_ratio):
    rate = 2 * np.pi * frequency_Hz
    system = signal.TransferFunction([1], [1 / rate**2, 2 * damping_ratio / rate, 1])
    return values[0] + signal.lsim(system, values - values[0], time)[1]


def test_second_resonance_and_load_change_against_lsim(rng):
    time, push = 2e-4 * np.arange(400), wander(rng, 400, 5, 30)
    first = m.Mechanics(120.0, 0.03, 1.5)
    found = through(BY_NAME["second_resonance", ""](first, -0.1, 400.0, 0.02), 2e-4, push)
    one, other = lagged(time, push, 120, 0.03), lagged(time, push, 400, 0.02)
    np.testing.assert_allclose(found, 1.5 * (1.1 * one - 0.1 * other), atol=1e-8)
    found = through(BY_NAME["second_resonance", "added"](first, -0.1, 400.0, 0.02), 2e-4, push)
    np.testing.assert_allclose(found, 1.5 * (one - 0.1 * (other - push)), atol=1e-8)
    loaded = through(BY_NAME["load_change", ""](first, 0.44), 2e-4, push)
    np.testing.assert_allclose(loaded, 1.5 * lagged(time, push, 100, 0.025), atol=1e-8)


def test_backlash_drags_along(rng):
    path, gap, start = wander(rng, 400, 0, 20), rng.uniform(0.1, 2), rng.uniform(-1, 1)
    place, truth = path[0] + start * gap, []
    for value in path:
        place = min(max(place, value - gap), value + gap)
        truth.append(place)
    for form in ("", "output"):
        np.testing.assert_allclose(through(BY_NAME["backlash", form](gap, start), 1e-3, path), truth, atol=1e-12)
    # One drives the mechanics, which ring on; the other holds what the mechanics do.
    stage = default_stage()
    inside, outside = (fx.extend(stage, BY_NAME["backlash", form](gap, start)) for form in ("", "output"))
    assert inside.names == ("driver", "hysteresis", "backlash", "mechanics")
    assert outside.names == ("driver", "hysteresis", "mechanics", "backlash")


def dahl(path, state=0.0, slope=0.2, amplitude=1.0, length=8.0):
    out, before = [], path[0]
    for value in path:
        sign = np.sign(value - before)
        state = sign + (state - sign) * np.exp(-abs(value - before) / length) if sign else state
        out.append(slope * value - amplitude * state)
        before = value
    return np.array(out)


def branches(path):
    """Mean of the loop's two branches over the range of a path, as a function of the voltage."""
    low, high = np.min(path), np.max(path)
    fine = np.linspace(low, high, 4000)
    loop = dahl(np.concatenate([[path[0]], fine, fine[::-1], fine]))[1:].reshape(3, -1)
    return lambda v: np.interp(v, fine, (loop[1][::-1] + loop[2]) / 2)


def test_accommodation_feeds_the_irreversible_part_back(rng):
    path = wander(rng, 400, 0, 100)
    mean, plain = branches(path)(path), dahl(path)
    truth = plain
    for _ in range(12):
        truth = dahl(path + 0.4 * (truth - mean))
    law = m.hysteresis.Dahl(0.2, 1.0, 8.0)
    found = through(BY_NAME["accommodation", ""](law, 0.4), 1e-3, path)
    assert np.max(np.abs(truth - plain)) > 0.03
    np.testing.assert_allclose(found, truth, atol=0.05 * np.max(np.abs(truth - plain)))


def test_rate_dependence_widens_loops_by_the_decade(rng):
    rate, onset = 10 ** rng.uniform(2, 4), 50.0
    path = 100 * np.abs((np.arange(1200) / 300 + 1) % 2 - 1)
    interval = 100 / 300 / rate
    plain = dahl(path)
    law = m.hysteresis.Dahl(0.2, 1.0, 8.0)
    found = through(BY_NAME["rate_dependence", ""](law, 0.07, onset), interval, path)
    wider = 0.07 * np.log10(1 + rate / onset) * (plain - branches(path)(path))
    # The mean of the loop is a line between levels, and at turns the rate is not what it is around them.
    keep = np.arange(1200) % 300 > 20
    np.testing.assert_allclose((found - plain)[keep], wider[keep], atol=0.05 * np.max(np.abs(wider)))
    relaxing = through(BY_NAME["rate_dependence", "relaxation"](law, 0.2, 30 * interval), interval, path)
    beside = plain - branches(path)(path)
    lag = signal.TransferFunction([1], [30 * interval, 1])
    late = beside[0] + signal.lsim(lag, beside - beside[0], interval * np.arange(1200))[1]
    np.testing.assert_allclose(relaxing - plain, 0.2 * (late - beside), atol=5e-3 * np.max(np.abs(beside)))


@pytest.mark.parametrize("spacing", ["even", "uneven"])
def test_times_shift_by_any_amount(rng, spacing):
    n, interval = 600, 1e-3
    time = interval * np.arange(n) if spacing == "even" else uneven(rng, n, interval)
    times = interval if spacing == "even" else time
    wave = lambda t: np.sin(2 * np.pi * 20 * t + 0.3)  # noqa: E731
    delay = rng.uniform(0, 5e-3)
    keep = time > 0.01
    error = 5e-4
    found = through(BY_NAME["transport_delay", ""](delay), times, wave(time), hold="smooth")
    np.testing.assert_allclose(found[keep], wave(time - delay)[keep], atol=error)
    ppm = rng.uniform(-2e4, 2e4)
    found = through(BY_NAME["clock_mismatch", ""](ppm), times, wave(time), hold="smooth")
    when = time * (1 + 1e-6 * ppm)
    inside = when < time[-1]
    np.testing.assert_allclose(found[inside][2:], wave(when)[inside][2:], atol=error)
    found = through(BY_NAME["dropped_samples", ""](interval, 0.3), times, wave(time), hold="smooth")
    early, late = time < 0.28, (time > 0.32) & (time < time[-1] - 2 * interval)
    np.testing.assert_allclose(found[early][2:], wave(time)[early][2:], atol=error)
    np.testing.assert_allclose(found[late], wave(time + interval)[late], atol=error)


def test_the_slope_of_a_delay_is_the_velocity_where_there_is_none(rng):
    time = 1e-3 * np.arange(400)
    wave = np.sin(2 * np.pi * 20 * time)
    given = Signal(jnp.asarray(wave), jnp.asarray(0.0), "smooth")
    for name in ("transport_delay", "sensor_lowpass"):
        none = BY_NAME[name, ""](0.0)
        change = jax.tree_util.tree_map(jnp.ones_like, none)
        slope = tangent(none, change, given)
        velocity = 2 * np.pi * 20 * np.cos(2 * np.pi * 20 * time)
        np.testing.assert_allclose(np.asarray(slope)[5:-5], -velocity[5:-5], atol=2e-3 * np.max(velocity))


@compiled
def tangent(effect, change, given):
    return eqx.filter_jvp(lambda e: e.run(jnp.asarray(1e-3), given).values, (effect,), (change,))[1]


@pytest.mark.parametrize("share", [0.05, 0.7, 5.0, 300.0])
def test_sensor_lowpass_at_any_lag(rng, share):
    time, interval = 1e-3 * np.arange(3000), 1e-3
    lag, rate = share * interval, 2 * np.pi * 15
    found = through(BY_NAME["sensor_lowpass", ""](lag), interval, np.sin(rate * time), hold="smooth")
    turn = 1 / (1 + 1j * rate * lag)
    truth = np.imag(turn * np.exp(1j * rate * time)) - np.imag(turn) * np.exp(-time / lag)
    np.testing.assert_allclose(found[2:], truth[2:], atol=2e-4)
    path = wander(rng, 3000, 0, 20)
    lines = path[0] + signal.lsim(signal.TransferFunction([1], [lag, 1]), path - path[0], time)[1]
    np.testing.assert_allclose(through(BY_NAME["sensor_lowpass", ""](lag), interval, path), lines, atol=1e-9)


def test_slow_effects_in_closed_form(rng):
    n, interval = 500, 0.1
    time, path = interval * np.arange(n), wander(rng, n, 0, 20)
    temperature, other = 20 + wander(rng, n, 0, 5), wander(rng, n, -20, 20)
    decay = 1 - np.exp(-time / 7)
    follow = signal.lsim(signal.TransferFunction([1], [7.0, 1]), temperature - temperature[0], time)[1]
    cases = {
        ("thermal_drift", ""): ((0.01,), 0.01 * time),
        ("thermal_drift", "exponential"): ((0.3, 7.0), 0.3 * decay),
        ("thermal_drift", "temperature"): ((0.2, 7.0), 0.2 * follow),
        ("mount_relaxation", ""): ((0.3, 7.0), 0.3 * decay),
        ("mount_relaxation", "logarithmic"): ((0.3, 7.0), 0.3 * np.log10(1 + time / 7)),
        ("zero_shift", ""): (
            (0.3, 7.02, 0.07),
            0.3 * np.interp(time, [7.02, 7.02 + np.hypot(0.07, interval)], [0, 1]),
        ),
        ("cross_coupling", ""): ((0.01,), 0.01 * other),
        ("cross_coupling", "quadratic"): ((1e-4,), 1e-4 * other**2),
        ("thermal_gain", "temperature"): (
            (2e-3, 7.0, 20.0, 1.0),
            2e-3 * (follow + temperature[0] - 20) * (path - 1),
        ),
        ("sensor_nonlinearity", ""): (
            (0.01, -0.02, 9.0, 11.0),
            0.01 * (path - 9) ** 2 / 11 - 0.02 * (path - 9) ** 3 / 121,
        ),
    }
    turn, cosine, sine = 2 * np.pi * (path - 9) / 0.3, np.array([0.01, -0.003]), np.array([-0.02, 0.005])
    waves = [c * np.cos(k * turn) + s * np.sin(k * turn) for k, c, s in zip((1, 2), cosine, sine, strict=True)]
    cases["cyclic_error", ""] = (cosine, sine, 0.3, 9.0), sum(waves)
    for key, (given, truth) in cases.items():
        found = through(BY_NAME[key](*given), interval, path, temperature_degC=temperature, other_um=other)
        np.testing.assert_allclose(found - path, truth, atol=1e-9, err_msg=str(key))


def test_gains_that_follow_the_command(rng):
    n, interval = 500, 0.01
    time, path = interval * np.arange(n), wander(rng, n, 0, 100)
    travelled = np.concatenate([[0], np.cumsum(np.abs(np.diff(path)))])
    found = through(BY_NAME["aging", ""](0.01, 200.0, 3.0), interval, path)
    np.testing.assert_allclose(found - path, 0.01 * np.log10(1 + travelled / 200) * (path - 3), atol=1e-9)
    found = through(BY_NAME["aging", "over_records"](0.01, 200.0, 3.0), interval, path, path_V=700 + travelled)
    truth = 0.01 * np.log10(1 + (700 + travelled) / 200) * (path - 3)
    np.testing.assert_allclose(found - path, truth, atol=1e-9)
    ramp = 20 * time
    found = through(BY_NAME["thermal_gain", "self_heating"](0.1, 2.0, 500.0), interval, ramp)
    heat = 400 / 500 * (time - 2 * (1 - np.exp(-time / 2)))
    np.testing.assert_allclose(found - ramp, 0.1 * heat * ramp, rtol=0.02, atol=0.01)
    # Of currents it takes as much as of a lag from where it was warm.
    found = through(BY_NAME["thermal_gain", "resistive_heating"](0.1, 2.0, 50.0, 3.0, 0.7), interval, ramp)
    warm = 0.16 + (0.7 - 0.16) * np.exp(-time / 2)
    np.testing.assert_allclose(found - ramp, 0.1 * warm * (ramp - 3), rtol=0.01, atol=2e-3)
    found = through(BY_NAME["thermal_gain", "exponential"](0.04, 2.0, 3.0), interval, path)
    np.testing.assert_allclose(found - path, 0.04 * np.exp(-time / 2) * (path - 3), atol=1e-9)


def test_rails_cut_off_what_is_beyond(rng):
    path = wander(rng, 500, 0, 100)
    upper = through(BY_NAME["driver_saturation", ""](80.0), 1e-3, path)
    lower = through(BY_NAME["driver_saturation", "lower"](20.0), 1e-3, path)
    np.testing.assert_allclose(upper, np.minimum(path, 80), atol=1e-12)
    np.testing.assert_allclose(lower, np.maximum(path, 20), atol=1e-12)


def test_hum_has_its_lines(rng):
    cosine, sine = rng.normal(size=(2, 3))
    n, interval = 2000, 1e-3
    found = through(BY_NAME["mains_hum", "50_Hz"](cosine, sine, 50.0), interval, np.zeros(n))
    lines = np.fft.rfft(found)[[100, 200, 300]] / (n / 2)
    np.testing.assert_allclose(lines, cosine - 1j * sine, atol=1e-9)


def test_initial_state_is_a_way_before_the_record(rng):
    model = random_model(rng)
    low, high = float(model.density.lower_V), float(model.density.upper_V)
    span = high - low
    path = np.concatenate(
        [np.linspace(low + 0.3 * span, low + 0.7 * span, 40), np.linspace(low + 0.7 * span, low, 40)]
    )
    found = through(BY_NAME["initial_state", ""](model, 0.25 * span), 1e-3, path)
    longer = np.concatenate([[low + 0.55 * span], path])
    np.testing.assert_allclose(found, through(model, 1e-3, longer)[1:], atol=1e-9)
    plain = through(model, 1e-3, np.concatenate([path[:1], path]))[1:]
    beyond = np.arange(80) > np.argmax(path > low + 0.551 * span)
    np.testing.assert_allclose(found[beyond], plain[beyond], atol=1e-9)
    assert np.max(np.abs(found - plain)) > 1e-3


def test_creep_goes_on_along_the_logarithm():
    time = 2e-3 * np.arange(50_000)
    step = np.where(time > 0, 10.0, 0.0)
    crept = through(BY_NAME["creep", ""](0.02, 0.1), 2e-3, step) - step
    line = 0.02 * 10 * np.log10(1 + time / 0.1)
    np.testing.assert_allclose(crept[1:], line[1:], atol=0.01 * line[-1])


def test_noise_has_the_variance_that_is_said(rng):
    n = 200_000
    time = 1e-3 * np.arange(n)
    smooth = 10 * np.sin(2 * np.pi * 1.7 * time)
    given = Signal(jnp.asarray(smooth), jnp.asarray(0.0), "smooth")

    def said(name, *values):
        return np.mean(BY_NAME[name, ""](*values).variance_um2(jnp.asarray(1e-3), given))

    rounded = 0.1 * np.round(smooth / 0.1) - smooth
    np.testing.assert_allclose(said("quantisation", 0.1), np.var(rounded), rtol=0.05)
    shifted = 10 * np.sin(2 * np.pi * 1.7 * (time + 1e-4 * rng.standard_normal(n))) - smooth
    np.testing.assert_allclose(said("timestamp_jitter", 1e-4), np.var(shifted), rtol=0.05)
    spikes = (rng.uniform(size=n) < 0.05) * rng.standard_normal(n) * 3
    np.testing.assert_allclose(said("outliers", 0.05, 3.0), np.var(spikes), rtol=0.15)
    lost = rng.uniform(size=n) < 0.03
    held = smooth[np.maximum.accumulate(np.where(lost, 0, np.arange(n)))]
    # Lost one after another they are off by more.
    np.testing.assert_allclose(said("repeated_readings", 0.03), np.var(held - smooth), rtol=0.2)
    assert said("floor_vibration", 0.2, 20.0, 10.0) == pytest.approx(0.04)


def test_a_gain_ages_along_the_logarithm_of_the_time_since_it_began(rng):
    time_s, push = np.sort(rng.uniform(0, 20, 300)), wander(rng, 300, 5, 30)
    time_s -= time_s[0]
    per_decade, onset_s, age_s, zero_um = -0.03, 0.4, 7.0, 2.0
    more = per_decade * np.log10((age_s + time_s) / onset_s)
    effect = BY_NAME["aging", "over_time"](per_decade, onset_s, np.log(age_s / onset_s), zero_um)
    found = through(effect, time_s, push)
    np.testing.assert_allclose(found, push + more * (push - zero_um), rtol=1e-12)
