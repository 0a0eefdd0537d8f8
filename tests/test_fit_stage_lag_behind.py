"""Rigs of a hysteresis and a linear plant behind it: the lag of the stage is not ahead of the hysteresis."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from _lags import through
from scipy import signal

import fits
import microid as m
from fits.stage._solve_stage import default_stage

RATE_Hz, FINE, SAMPLES = 5000.0, 8, 1600
LAG_s, NATURAL_Hz, DAMPING = 0.9e-3, 260.0, 0.12


def moved_um(command_V, ahead_s, behind_s):
    """Forty plays between two lags, ahead of a mode, in steps of an eighth of the sampling interval."""
    fine = np.interp(np.arange((len(command_V) - 1) * FINE + 1) / FINE, np.arange(len(command_V)), command_V)
    rate_Hz = RATE_Hz * FINE
    seen_V = through([1], [ahead_s, 1], fine, rate_Hz) if ahead_s else fine
    radii = np.linspace(0.5, 45, 40)
    weight = np.exp(-radii / 20)
    play, given = np.full(40, seen_V[0]), np.empty(len(fine))
    for k, value in enumerate(seen_V):
        play = np.clip(play, value - radii, value + radii)
        given[k] = 0.04 * value + 0.03 * (play @ weight) / weight.sum()
    rate = 2 * np.pi * NATURAL_Hz
    moved = through([rate**2], [1, 2 * DAMPING * rate, rate**2], given, rate_Hz)
    return through([1], [behind_s, 1], moved, rate_Hz)[::FINE]


def records(rng, ahead_s, behind_s, noise_um=5e-4):
    """Triangles of growing size, and a sweep beyond the mode on a slow sine; from rest after a full loop."""
    time_s = np.arange(SAMPLES) / RATE_Hz
    triangle = 50 + (15 + 35 * time_s / time_s[-1]) * signal.sawtooth(2 * np.pi * 9 * time_s + 0.5 * np.pi, 0.5)
    sweep = signal.chirp(time_s, 20, time_s[-1], 600, phi=-90)
    wave = 50 - 42 * np.cos(2 * np.pi * 5 * time_s) + 5 * sweep
    loop = np.r_[np.linspace(0, 100, 1500), np.linspace(100, 0, 1500)]
    out = []
    for name, command in (("triangles", triangle), ("sweep", wave)):
        command = np.r_[loop, np.linspace(0, command[0], 500), np.full(200, command[0]), command]
        reading = moved_um(command, ahead_s, behind_s)[-SAMPLES:]
        reading += noise_um * rng.standard_normal(SAMPLES)
        out.append(fits.Record(time_s, command[-SAMPLES:], reading, source=f"{name}.csv"))
    return out


def test_the_lag_of_a_linear_plant_behind_the_hysteresis_is_put_there(rng):
    found = fits.fit_stage(records(rng, 0.0, LAG_s), levels=16)
    assert found.model.names == ("hysteresis", "lag", "mechanics")
    assert any("lies behind the hysteresis" in one for one in found.remarks)
    values = [parameter.value for parameter in found.parameters]
    np.testing.assert_allclose(values, (LAG_s, NATURAL_Hz, DAMPING), rtol=0.01)
    assert found.misfit.times_noise < 1.5


@pytest.mark.parametrize(
    "behind_s", [0.0, pytest.param(0.15e-3, marks=pytest.mark.study)], ids=["alone", "beside a sensor's"]
)
def test_the_lag_of_a_driver_stays_ahead_of_it(rng, behind_s):
    found = fits.fit_stage(records(rng, LAG_s, behind_s), levels=16)
    assert found.model.names == ("driver", "hysteresis", "mechanics")
    assert not any("lies behind the hysteresis" in one for one in found.remarks)


@pytest.mark.study
def test_a_stage_that_is_given_stays_as_it_is(rng):
    found = fits.fit_stage(records(rng, 0.0, LAG_s), stage=default_stage(), levels=16)
    assert found.model.names == ("driver", "hysteresis", "mechanics")


@pytest.mark.study
def test_such_a_rig_has_no_effect_and_what_it_hides_is_found(rng):
    """Before, all of them had a low-pass of the sensor, of the time constant of their plant."""
    plain = fits.diagnose(records(rng, 0.0, LAG_s))
    assert plain.verdict == "no_effect"
    hidden = []
    for one in records(rng, 0.0, LAG_s):
        hum_um = 0.004 * np.sin(2 * np.pi * 50.0 * np.asarray(one.time_s) + rng.uniform(0, 6))
        hidden.append(replace(one, displacement_um=np.asarray(one.displacement_um) + hum_um))
    assert [cause.name for cause in fits.diagnose(hidden).causes] == ["mains_hum"]


def test_a_lag_is_that_of_scipy_and_has_an_inverse(rng):
    time_s = np.arange(400) / RATE_Hz
    given = 50 - 50 * np.cos(2 * np.pi * 30 * time_s) ** 3
    stage = m.Stage.of(piezo=m.Piezo(jnp.asarray(0.3)), lag=m.Lag(jnp.asarray(LAG_s)))
    moved = np.asarray(stage(jnp.asarray(time_s), jnp.asarray(given)))
    expected = 0.3 * through([1], [LAG_s, 1], given, RATE_Hz)
    np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-10)
    response = np.asarray(stage["lag"].frequency_response(jnp.asarray([10.0, 100.0])))
    np.testing.assert_allclose(response, signal.freqs([1], [LAG_s, 1], 2 * np.pi * np.array([10.0, 100.0]))[1])
    wanted = np.asarray(moved[200:])
    back = m.invert_stage(stage, jnp.asarray(time_s[200:]), jnp.asarray(wanted))
    inside = slice(5, -5)
    np.testing.assert_allclose(np.asarray(back.voltage_V)[inside], given[200:][inside], atol=0.05)
