"""What a record shows of its sensor by itself: planted noise, hum, spikes, rounding and jitter."""

import numpy as np
import pytest

from fits.diagnosis._thresholds import THRESHOLDS
from fits.stats._noise import quantum_um
from fits.stats._sensor_noise import floor_of, jitter_s, spikes


def floor_in(voltage_V, residual_um, rate_Hz=1000.0):
    used = np.ones(len(voltage_V), dtype=bool)
    return floor_of(voltage_V, residual_um, used, rate_Hz, 0.01, 1e-9, THRESHOLDS.apart_z, THRESHOLDS.minor_share)


def spikes_in(voltage_V, residual_um):
    return np.flatnonzero(spikes(voltage_V, residual_um, 0.0, THRESHOLDS.spike_z))


def test_the_floor_is_read_off_idle_stretches(rng):
    voltage = np.concatenate([np.linspace(0, 100, 1000), np.full(1000, 100.0), np.linspace(100, 0, 1000)])
    left = 0.05 * rng.standard_normal(3000) + 2 * np.sin(np.arange(3000) / 30) * (np.arange(3000) % 2000 < 1000)
    floor = floor_in(voltage, left)
    assert floor.idle
    assert floor.noise.total_um == pytest.approx(0.05, rel=0.15)


def test_spikes_are_found_and_ringing_is_not(rng):
    time = np.arange(4000) / 1000
    ringing = 0.5 * np.exp(-(time % 1.0) / 0.05) * np.sin(2 * np.pi * 100 * time)
    left = 0.02 * rng.standard_normal(4000) + ringing
    assert len(spikes_in(np.sin(time), left)) == 0
    where = 300 + 400 * np.arange(8)
    left[where] += rng.choice([-1, 1], 8) * rng.uniform(0.6, 3.0, 8)
    assert set(spikes_in(np.sin(time), left)) == set(where)
    # By chance, one has another close by.
    left[where[::3] + 7] += 1.0
    assert set(spikes_in(np.sin(time), left)) == {*where, *(where[::3] + 7)}


def test_spikes_are_found_while_the_command_moves_where_they_are_as_many_as_elsewhere(rng):
    """One in a hundred samples, so that one in eight stretches that move has one."""
    n = 4000
    voltage = np.where(np.arange(n) < 2000, 50.0, 50 + 40 * np.sin(np.arange(n) * 0.7))
    quiet = 0.02 * rng.standard_normal(n)
    where = np.sort(rng.permutation(np.arange(20, n, 40))[:40])
    spoilt = quiet.copy()
    spoilt[where] += rng.choice([-1, 1], 40) * rng.uniform(0.6, 3.0, 40)
    assert set(spikes_in(voltage, spoilt)) == set(where)
    # Of those that come only where the command moves, it may be the cause.
    moved = quiet.copy()
    moving = np.arange(2020, n, 40)
    moved[moving] += rng.choice([-1, 1], len(moving)) * rng.uniform(0.9, 1.1, len(moving))
    assert len(spikes_in(voltage, moved)) == 0


def test_a_last_digit_is_found_and_noise_has_none(rng):
    values = 20 * np.sin(np.arange(6000) / 300) + 0.01 * rng.standard_normal(6000)
    assert quantum_um(values) == 0
    assert quantum_um(np.round(values / 0.076) * 0.076) == pytest.approx(0.076, rel=1e-3)


def test_jitter_is_noise_that_grows_with_the_speed(rng):
    time = np.arange(20_000) / 1000
    speed = 500 * np.cos(2 * np.pi * time)
    quiet = 0.02 * rng.standard_normal(len(time))
    _, z, most = jitter_s(quiet, speed, 0.0, THRESHOLDS.apart_z)
    assert z < 8
    assert most < 0.5e-4
    size, z, most = jitter_s(quiet + 1e-4 * speed * rng.standard_normal(len(time)), speed, 0.0, THRESHOLDS.apart_z)
    assert z > 8
    assert size == pytest.approx(1e-4, rel=0.25)
    assert most > 1e-4


def test_what_bends_alike_in_neighbours_is_no_jitter(rng):
    # A staircase that a rough model leaves, only where the stage is fast.
    time = np.arange(20_000) / 1000
    speed = 500 * np.cos(2 * np.pi * time)
    noise = 0.02 * rng.standard_normal(len(time))
    fast = np.abs(speed) > 450
    left = noise + np.where(fast, 1.5 * np.abs((np.arange(len(time)) % 14) / 14 - 0.5) ** 2, 0.0)
    assert jitter_s(left, speed, 0.0, THRESHOLDS.apart_z)[0] == 0
    found = jitter_s(left + 1e-4 * speed * rng.standard_normal(len(time)), speed, 0.0, THRESHOLDS.apart_z)[0]
    assert found == pytest.approx(1e-4, rel=0.3)


def test_hum_is_no_part_of_the_floor(rng):
    mains = rng.choice([50.0, 60.0]) * (1 + rng.uniform(-1e-3, 1e-3))
    voltage = np.concatenate([np.linspace(0, 100, 1000), np.full(3000, 100.0)])
    noise = 0.05 * rng.standard_normal(4000)
    # Sampled at 70 Hz, hum is a line of another frequency.
    for rate in (1000.0, 70.0):
        time = np.arange(4000) / rate
        left = (
            noise
            + 0.3 * np.sin(2 * np.pi * mains * time + rng.uniform(0, 6))
            + 0.1 * np.cos(4 * np.pi * mains * time)
        )
        found = floor_in(voltage, left, rate).noise
        assert found.total_um == pytest.approx(0.05, rel=0.2)
    assert floor_in(voltage, noise).noise.total_um == pytest.approx(0.05, rel=0.15)


def test_readings_that_keep_to_one_digit_are_no_outliers(rng):
    """What changes from sample to sample is next to nothing there, which once left no sample of an idle command."""
    voltage = np.zeros(400)
    residual = np.repeat(rng.choice([-1.0, 1.0], 20), 20) + 1e-9 * rng.standard_normal(400)
    floor = floor_of(voltage, residual, np.ones(400, dtype=bool), 1e3, 0.0, 1e-9, 3.0, 0.05)
    assert floor.idle > 0
    assert 0.3 < floor.noise.total_um < 3.0
