"""A lag of the readings in slow runs: it is no driver's, and what noise looks like is no resonance."""

import numpy as np
import pytest

from fits import Record, diagnose

NOISE_um, INTERVAL_s = 0.01, 0.01
NAMES = {"sensor_lowpass": "time_constant_s", "transport_delay": "delay_s"}


def late(rng, count, lag_s):
    """Plays of 30 widths, under loops of 10 s whose amplitude varies, read through a first-order low-pass filter."""
    time_s = INTERVAL_s * np.arange(count)
    voltage_V = 60 + 50 * np.sin(2 * np.pi * time_s / 10) * (0.6 + 0.4 * np.cos(2 * np.pi * time_s / 110))
    half_V, weight = np.linspace(0, 45, 30), np.exp(-np.linspace(0, 3, 30))
    place, moved = np.full(30, voltage_V[0]), np.empty(count)
    for k, voltage in enumerate(voltage_V):
        place = np.minimum(np.maximum(place, voltage - half_V), voltage + half_V)
        moved[k] = 0.2 * voltage + 0.05 * (weight @ place) / weight.sum()
    # Exact for signals in lines between the samples.
    left, reading, behind = np.exp(-INTERVAL_s / lag_s), moved.copy(), 0.0
    for k in range(1, count):
        behind = left * behind - (moved[k] - moved[k - 1]) * lag_s / INTERVAL_s * (1 - left)
        reading[k] += behind
    return Record(time_s, voltage_V, reading + NOISE_um * rng.standard_normal(count), source="day.csv")


@pytest.mark.study
def test_a_lag_of_the_readings_is_named_in_slow_runs(rng):
    lag_s = 0.02
    found = diagnose([late(rng, 11_000, lag_s)])
    print(found.summary())
    first = found.causes[0]
    assert first.name in NAMES
    value = next(one for one in first.parameters if one.name == NAMES[first.name])
    assert abs(value.value - lag_s) < 0.05 * lag_s
    assert found.gain.heldout_rms_after_um < 1.2 * NOISE_um
