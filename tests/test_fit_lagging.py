"""Runs without a slow part, whose hysteresis lags the command and never gets to the ends of the range."""

import numpy as np
import pytest
from scipy import signal

import fits
from fits.loop._lagging import known_behind_lag

RATE_Hz, LAG_s, FINE = 10_000.0, 0.55e-3, 40


def triangle(rng, frequency_Hz, periods, noise_um=2e-4):
    """A triangle of +-90 V that has run for long, through a lag and plays, read by a sensor almost without noise."""
    n = round(RATE_Hz / frequency_Hz * (periods + 2)) * FINE + 1
    command = 90 * signal.sawtooth(2 * np.pi * frequency_Hz / (RATE_Hz * FINE) * np.arange(n), 0.5)
    decay = np.exp(-1 / (RATE_Hz * FINE * LAG_s))
    share = (1 - decay) * RATE_Hz * FINE * LAG_s
    voltage = signal.lfilter([1 - share, share - decay], [1, -decay], command - command[0]) + command[0]
    radii = np.linspace(0.5, 40, 60)
    weight = np.exp(-radii / 20)
    play, moved = np.zeros(60), np.empty(n)
    for k, value in enumerate(voltage):
        play = np.clip(play, value - radii, value + radii)
        moved[k] = 0.1 * value + 0.17 * (play @ weight) / weight.sum()
    seen = slice(2 * round(RATE_Hz / frequency_Hz) * FINE, None, FINE)
    reading = moved[seen] + noise_um * rng.standard_normal(len(moved[seen]))
    time = np.arange(len(reading)) / RATE_Hz
    return fits.Record(time, command[seen], reading, source=f"{frequency_Hz:g}Hz.csv"), voltage[seen]


def test_a_fast_run_alone_is_fitted_though_its_past_is_unknown(rng):
    record, _ = triangle(rng, 100.0, 15)
    result = fits.fit_stage([record], levels=24)
    assert result["driver.time_constant_s"].value == pytest.approx(LAG_s, rel=0.01)
    assert result.held_out.e_rms_pct < 0.02


@pytest.mark.parametrize("frequency_Hz", [40.0, 100.0])
def test_the_past_is_unknown_until_the_lagging_voltage_has_turned_at_both_ends(rng, frequency_Hz):
    record, lagging_V = triangle(rng, frequency_Hz, 5)
    known = known_behind_lag(record.voltage_V, record.displacement_um, np.ones(len(record), dtype=bool))
    first = int(np.argmax(known))
    half = round(RATE_Hz / frequency_Hz / 2)
    turn = half + int(np.argmax(lagging_V[half : 2 * half]))
    assert abs(first - turn) <= 2
    assert known[first:].all()


def test_a_slow_run_and_one_that_jumps_out_lose_nothing(rng):
    time = np.arange(2000) / 200
    voltage = 60 + 60 * signal.sawtooth(2 * np.pi * 0.2 * time, 0.5)
    all_of_it = np.ones(2000, dtype=bool)
    reading = 0.3 * voltage + 0.05 * rng.standard_normal(2000)
    assert known_behind_lag(voltage, reading, all_of_it).all()
    hit = rng.random(2000) < 0.03
    assert known_behind_lag(voltage, reading + np.where(hit, 50.0, 0.0), all_of_it).sum() >= 1000
    assert not known_behind_lag(voltage, reading, ~all_of_it).any()
