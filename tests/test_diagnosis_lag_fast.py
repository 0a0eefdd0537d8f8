"""What the plain stage bends its poles or its density for: a lag of the readings, a gain that settles."""

import numpy as np
import pytest
from _lags import through

from fits import Record, diagnose

NOISE_um, SLOW_Hz, FAST_Hz = 0.03, 200.0, 3000.0
TURNS_V = 0, 100, 0, 100, 75, 100, 50, 100, 25, 100, 0, 85, 15, 75, 25, 60, 40, 50, 0


def ways_V(turns_V, rate_V_per_s, rate_Hz):
    way_V = np.r_[0, np.cumsum(np.abs(np.diff(turns_V)))]
    return np.interp(np.arange(0, way_V[-1], rate_V_per_s / rate_Hz), way_V, turns_V)


def measured(rng, voltage_V, rate_Hz, lags_s, natural, damping, source, warmer=0.0, warm_s=1.0):
    """Driver, 60 plays of gamma-distributed widths, a resonance and the sensor, in steps of a few samples' parts.

    The gain is larger at the beginning by a part that decays.
    """
    # A sensor without a lag is one of a nanosecond.
    parts = int(np.ceil(20 / (rate_Hz * min(one for one in (*lags_s, 1 / natural) if one > 1e-8))))
    fine = np.interp(np.arange((len(voltage_V) - 1) * parts + 1) / parts, np.arange(len(voltage_V)), voltage_V)
    driven = through([1], [lags_s[0], 1], fine, rate_Hz * parts)
    half_V = np.sort(np.random.default_rng(1).gamma(2.0, 6.0, 60))
    place, moved = driven[0] + half_V, np.empty(len(driven))
    for k, voltage in enumerate(driven):
        place = np.minimum(np.maximum(place, voltage - half_V), voltage + half_V)
        moved[k] = 0.12 * voltage + 0.05 * place.mean()
    moved = through([natural**2], [1, 2 * damping * natural, natural**2], moved, rate_Hz * parts)
    reading = through([1], [lags_s[1], 1], moved, rate_Hz * parts)[::parts]
    noise, time_s = NOISE_um * rng.standard_normal(len(reading)), np.arange(len(reading)) / rate_Hz
    reading = reading * (1 + warmer * np.exp(-time_s / warm_s))
    return Record(time_s, voltage_V, reading + noise, source=source)


def fast_and_slow(rng, most_Hz):
    """A slow voltage of loops within loops, and a multisine up to a frequency, at the rates of the constants."""
    waves = np.arange(2, most_Hz, 2.0)
    time_s = np.arange(0, 1.0, 1 / FAST_Hz)
    multisine = np.cos(2 * np.pi * np.outer(time_s, waves) + rng.uniform(0, 2 * np.pi, len(waves))).sum(axis=1)
    multisine *= 15 / np.abs(multisine).max()
    fast_V = np.r_[ways_V([0, 100, 0, 50 + multisine[0]], 600.0, FAST_Hz), 50 + multisine]
    return fast_V, ways_V(TURNS_V, 100.0, SLOW_Hz)


@pytest.mark.study
def test_a_lag_for_which_the_poles_bend_is_named_alone(rng):
    """It had been called a second resonance, or a delay and friction."""
    driver_s, lag_s = rng.uniform(3e-4, 1.2e-3), rng.uniform(3.5e-3, 5e-3)
    rig = (driver_s, lag_s), 2 * np.pi * rng.uniform(100, 140), rng.uniform(0.03, 0.1)
    fast_V, slow_V = fast_and_slow(rng, 300)
    found = diagnose(
        [measured(rng, slow_V, SLOW_Hz, *rig, "slow.csv"), measured(rng, fast_V, FAST_Hz, *rig, "fast.csv")]
    )
    print(found.summary())
    (cause,) = found.causes
    assert cause.name == "sensor_lowpass"
    value = next(one for one in cause.parameters if one.name == "time_constant_s")
    assert abs(value.value - lag_s) < 0.05 * lag_s
    assert found.gain.heldout_rms_after_um < 1.2 * NOISE_um


@pytest.mark.study
def test_a_lag_that_hides_the_resonance_is_named(rng):
    """It had been called a second resonance: the plain stage had two poles of its own in the place of the lag."""
    driver_s, lag_s = rng.uniform(5e-4, 1.2e-3), rng.uniform(0.015, 0.025)
    rig = (driver_s, lag_s), 2 * np.pi * rng.uniform(120, 150), rng.uniform(0.03, 0.06)
    runs, aside = (
        [
            measured(rng, slow_V, SLOW_Hz, *rig, f"slow_{name}.csv"),
            measured(rng, fast_V, FAST_Hz, *rig, f"fast_{name}.csv"),
        ]
        for name, (fast_V, slow_V) in (("fitted", fast_and_slow(rng, 300)), ("aside", fast_and_slow(rng, 300)))
    )
    found = diagnose(runs, holdout=aside)
    print(found.summary())
    assert found.causes[0].name == "sensor_lowpass"
    value = next(one for one in found.causes[0].parameters if one.name == "time_constant_s")
    assert abs(value.value - lag_s) < 0.05 * lag_s
    assert found.gain.heldout_rms_after_um < 1.3 * NOISE_um


@pytest.mark.study
def test_a_gain_that_approaches_its_balance_neither_ages_nor_creeps(rng):
    """It had been called aging, with a creep of 40 ms."""
    rig = (rng.uniform(3e-4, 1e-3), 1e-9), 2 * np.pi * rng.uniform(160, 250), rng.uniform(0.03, 0.1)
    warmer, warm_s = rng.uniform(0.02, 0.04), rng.uniform(4, 10)
    fast_V, slow_V = fast_and_slow(rng, 400)
    # The fast run follows when all is in balance.
    slow = measured(rng, slow_V, SLOW_Hz, *rig, "slow.csv", warmer, warm_s)
    found = diagnose([slow, measured(rng, fast_V, FAST_Hz, *rig, "fast.csv")])
    print(found.summary())
    (cause,) = found.causes
    assert cause.name == "thermal_gain"
    gain, constant = (next(one for one in cause.parameters if one.name.startswith(n)) for n in ("gain", "time_con"))
    assert abs(gain.value - warmer) < 4 * gain.sd
    assert abs(constant.value - warm_s) < 4 * constant.sd
    assert found.gain.heldout_rms_after_um < 1.3 * NOISE_um
