"""Poles read off a response, and where they stand: ahead of the hysteresis or behind it."""

import numpy as np
from scipy import signal

import fits
from fits.loop._run import prepare_run
from fits.stage._start import MeasuredResponse, measure_response, start_lagging, start_stages


def poles_of(stage):
    """Time constant, and the rates of the mechanics, in order."""
    rate = 2 * np.pi * float(stage["mechanics"].natural_frequency_Hz)
    damping = complex(stage["mechanics"].damping_ratio)
    spread = np.sqrt(damping**2 - 1)
    return float(stage["driver"].time_constant_s), np.sort(
        np.real(rate * np.array([damping - spread, damping + spread]))
    )


def test_real_poles_are_tried_on_either_side(rng):
    rates = np.sort(2 * np.pi * rng.uniform(10, 20, 3) * np.array([1, 6, 36]))
    frequency_Hz = np.geomspace(1, 2000, 200)
    s = 2j * np.pi * frequency_Hz
    response = np.prod([rate / (s + rate) for rate in rates], axis=0)
    measured = MeasuredResponse(frequency_Hz, response, np.full(len(s), 0.999))
    found = [poles_of(stage) for stage in start_stages(fits.default_stage(), [measured])]
    for k in range(3):
        others = np.delete(rates, k)
        assert any(
            abs(time * rates[k] - 1) < 1e-3 and np.all(np.abs(pair / others - 1) < 1e-3) for time, pair in found
        )


def test_poles_that_ring_have_one_place(rng):
    frequency_Hz = np.geomspace(1, 2000, 200)
    s = 2j * np.pi * frequency_Hz
    natural = 2 * np.pi * rng.uniform(50, 200)
    response = natural**2 / (s**2 + 0.1 * natural * s + natural**2) / (1 + 1e-3 * s)
    measured = MeasuredResponse(frequency_Hz, response, np.full(len(s), 0.999))
    best = start_stages(fits.default_stage(), [measured])[0]
    assert abs(float(best["driver"].time_constant_s) / 1e-3 - 1) < 1e-3
    assert abs(2 * np.pi * float(best["mechanics"].natural_frequency_Hz) / natural - 1) < 1e-4


def test_a_short_sweep_through_a_resonance_that_rings_for_long_shows_where_it_is(rng):
    rate_Hz, count = 8000.0, 4000
    time_s = np.arange(count) / rate_Hz
    natural, damping, lag_s = 2 * np.pi * rng.uniform(300, 600), rng.uniform(0.01, 0.03), rng.uniform(3e-4, 9e-4)
    command = 50 + 40 * signal.chirp(time_s, 20.0, time_s[-1], 1200.0, phi=-90) * signal.windows.tukey(count, 0.1)
    system = signal.TransferFunction([natural**2], np.polymul([1.0, 2 * damping * natural, natural**2], [lag_s, 1.0]))
    moved = 50 + signal.lsim(system, command - 50, time_s)[1] + 0.02 * rng.standard_normal(count)
    run = prepare_run(fits.Record(time_s, command, moved), (10.0, 90.0), "unknown", 0.2, gain=None)
    best = start_stages(fits.default_stage(), [measure_response(run, command)])[0]
    assert abs(2 * np.pi * float(best["mechanics"].natural_frequency_Hz) / natural - 1) < 1e-3
    assert abs(float(best["mechanics"].damping_ratio) / damping - 1) < 0.05
    assert abs(float(best["driver"].time_constant_s) / lag_s - 1) < 0.05


def test_a_lag_of_the_reading_is_found_beside_that_of_the_driver_either_way(rng):
    """Without it the poles bend: a resonance of low damping was read as one of 0.9."""
    frequency_Hz = np.geomspace(1, 2000, 200)
    s = 2j * np.pi * frequency_Hz
    natural, lags_s = 2 * np.pi * rng.uniform(80, 200), rng.uniform([2e-4, 3e-3], [1e-3, 6e-3])
    response = natural**2 / (s**2 + 0.1 * natural * s + natural**2) / np.prod(1 + s * lags_s[:, None], axis=0)
    measured = MeasuredResponse(frequency_Hz, 0.2 * response, np.full(len(s), 0.999))
    found = start_lagging(fits.default_stage(), [measured])
    for order in (lags_s, lags_s[::-1]):
        assert any(
            np.allclose([float(stage["driver"].time_constant_s), lag_s], order, rtol=1e-3)
            and abs(2 * np.pi * float(stage["mechanics"].natural_frequency_Hz) / natural - 1) < 1e-3
            and abs(float(stage["mechanics"].damping_ratio) / 0.05 - 1) < 1e-2
            for stage, lag_s in found
        )


def test_responses_of_too_few_lines_say_nothing_of_a_lag():
    few = MeasuredResponse(np.ones(3), np.ones(3, dtype=complex), np.full(3, 0.9))
    assert start_lagging(fits.default_stage(), [few]) == []
