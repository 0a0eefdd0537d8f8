"""A narrow band of a residual, whatever its size and shape."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from fits.diagnosis._noise import _bands, _one_floor
from fits.diagnosis._thresholds import THRESHOLDS
from fits.stats._band import Band, band_of, line_in

# Residuals over a time, some with white noise of standard deviation one.
ODD = {
    "line": lambda t, white: np.sin(2 * np.pi * 37.3 * t),
    "lines": lambda t, white: sum(10.0 ** (-2 * k) * np.sin(2 * np.pi * f * t) for k, f in enumerate((3, 11, 83))),
    "spike": lambda t, white: np.where(t == t[2000], 1e12, white),
    "step": lambda t, white: np.where(t > 2, 1e9, 0.0) + 1e-9 * white,
    "burst": lambda t, white: np.where((t > 1) & (t < 1.1), 1e8, 1e-8) * white,
    "steep": lambda t, white: np.cumsum(np.cumsum(np.cumsum(white))),
    "faint": lambda t, white: 1e-160 * white,
    "loud": lambda t, white: 1e160 * white,
    "constant": lambda t, white: 0 * t + 1e200,
}


@pytest.mark.parametrize("unit", [1e-160, 1e-30, 1.0, 1e150])
def test_a_band_is_the_same_in_any_unit_and_nothing_overflows(rng, unit):
    n, rate_Hz = 20_000, 500.0
    # Noise through a resonance at 30 Hz of quality 20.
    radius = np.exp(-np.pi * 30 / 20 / rate_Hz)
    past = [1.0, -2 * radius * np.cos(2 * np.pi * 30 / rate_Hz), radius**2]
    wave = lfilter([1.0], past, rng.standard_normal(n + 5000))[5000:]
    residual = 0.05 * rng.standard_normal(n) + 0.1 * wave / np.std(wave)
    command_V = np.linspace(0.0, 1.0, n)
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        found = band_of(unit * residual, 1 / rate_Hz, command_V)
    assert found.z > 8
    assert found.frequency_Hz == pytest.approx(30, rel=0.1)
    assert found.size_um / unit == pytest.approx(0.1, rel=0.35)


@pytest.mark.parametrize("of", ODD)
def test_nothing_overflows_on_residuals_that_are_far_from_noise(rng, of):
    time_s = 1e-3 * np.arange(4000)
    residual_um = ODD[of](time_s, rng.standard_normal(time_s.size))
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        found = band_of(residual_um, 1e-3, time_s)
    assert np.isfinite([found.frequency_Hz, found.size_um, found.sd_um, found.quality, found.z]).all()


def test_what_comes_back_with_the_voltage_is_no_vibration(rng):
    """Kinks of a few plays, 11 V apart, passed at an even speed by loops that shrink: 45 a second, in time."""
    time_s = np.arange(10000) / 2500
    turns = np.cumsum(np.r_[0, 2 * np.linspace(200, 60, 40)])
    place_V = np.interp(500 * time_s, turns / 2, np.r_[0, np.cumsum(np.resize([1, -1], 40) * np.diff(turns) / 2)])
    kinks_um = 0.02 * np.sin(2 * np.pi * place_V / 11)
    noise_um = 0.003 * rng.standard_normal(len(time_s))
    assert band_of(kinks_um + noise_um, 1 / 2500, place_V).z < 8
    shaking_um = 0.02 * np.sin(2 * np.pi * 45 * time_s + np.cumsum(0.02 * rng.standard_normal(len(time_s))))
    assert band_of(shaking_um + noise_um, 1 / 2500, place_V).z > 8


def test_a_slow_floor_is_told_from_loops_that_are_as_long_as_it_remembers(rng):
    """A band of 9 Hz forgets its phase within 3 s: passes of a loop 14 cycles apart agree by chance.

    Of 100 records 97 showed it, so that five of 20 do not once in 2,500 times.
    """
    n, rate_Hz = 3400, 100.0
    radius = np.exp(-np.pi * 9 / 80 / rate_Hz)
    past = [1.0, -2 * radius * np.cos(2 * np.pi * 9 / rate_Hz), radius**2]
    loops_V = 50 - 50 * np.cos(2 * np.pi * np.arange(n) / rate_Hz * 9 / 14)
    agreed = 0
    for _ in range(20):
        wave = lfilter([1.0], past, rng.standard_normal(n + 5000))[5000:]
        found = band_of(wave / np.std(wave) + 0.2 * rng.standard_normal(n), 1 / rate_Hz, loops_V)
        agreed += found.z > 8 and not found.mains and found.frequency_Hz == pytest.approx(9, rel=0.05)
    assert agreed >= 16


def test_what_a_run_may_play_is_the_floor_where_another_run_shows_it():
    seen = Band(33.0, 0.04, 0.004, 16.0, 15.0, 2000.0, 3, played=True)
    other = Band(32.4, 0.03, 0.004, 13.0, 6.0, 4000.0)
    assert not _one_floor([seen, other], THRESHOLDS).played
    for elsewhere in (replace(other, frequency_Hz=70.0), replace(other, z=2.0)):
        assert seen not in (_one_floor([seen, elsewhere], THRESHOLDS), _one_floor([elsewhere, seen], THRESHOLDS))
    assert _one_floor([seen], THRESHOLDS).played


def ringing(rng, middle_Hz, quality, n, rate_Hz):
    """Noise through a resonance, of variance one."""
    radius = np.exp(-np.pi * middle_Hz / quality / rate_Hz)
    past = [1.0, -2 * radius * np.cos(2 * np.pi * middle_Hz / rate_Hz), radius**2]
    wave = lfilter([1.0], past, rng.standard_normal(n + 20_000))[20_000:]
    return wave / np.std(wave)


def test_a_band_of_one_run_that_another_would_show_is_not_the_floors(rng):
    """Of 400 records of a floor none was said to be alone; of a line of one run alone, all."""

    def found(*residuals):
        return _one_floor(_bands(list(residuals), THRESHOLDS), THRESHOLDS).alone

    n, rate_Hz = 6000, 800.0
    time_s = np.arange(n) / rate_Hz
    quiet = [0.3 * rng.standard_normal(n) for _ in range(2)]
    line = np.sin(2 * np.pi * 97.9 * time_s)
    settings = 1 / rate_Hz, time_s
    assert found((line + quiet[0], *settings), (quiet[1], *settings))
    # Where it is too short to tell, or too slowly sampled, it may be there.
    for short in ((quiet[1][:30], *settings), (quiet[1], 1 / 200, time_s)):
        assert not found((line + quiet[0], *settings), short)
    floor = ringing(rng, 26.0, 15.0, 2 * n, rate_Hz)
    parts = [(part + own, *settings) for part, own in zip(np.split(floor, 2), quiet, strict=True)]
    assert not found(*parts)


def test_a_line_is_followed_by_its_phase_and_noise_of_a_band_is_not(rng):
    n, rate_Hz = 6000, 3000.0
    time_s, middle_Hz = np.arange(n) / rate_Hz, rng.uniform(230, 280)
    used = (np.arange(n) < 2500) | (np.arange(n) > 2900)
    line = 0.05 * np.sin(2 * np.pi * middle_Hz * time_s + rng.uniform(0, 6))
    white = 0.006 * rng.standard_normal(n)
    band = band_of(line + white, 1 / rate_Hz, time_s)
    assert band.is_line
    frequency_Hz, found = line_in(line + white, 1 / rate_Hz, used, band)
    # The phase of both quadratures is known to 0.006 / 0.05 * sqrt(2 / n) or 2e-3, and five times that at an end.
    assert frequency_Hz == pytest.approx(middle_Hz, abs=0.02)
    np.testing.assert_allclose(found, line, atol=2.5e-3)
    # Noise of a quality of 40 forgets its phase within some cycles.
    radius = np.exp(-np.pi * middle_Hz / 40 / rate_Hz)
    past = [1.0, -2 * radius * np.cos(2 * np.pi * middle_Hz / rate_Hz), radius**2]
    wave = lfilter([1.0], past, rng.standard_normal(n + 5000))[5000:]
    wave = 0.05 * wave / np.std(wave) + white
    assert line_in(wave, 1 / rate_Hz, used, replace(band_of(wave, 1 / rate_Hz, time_s), bins=1)) is None


def test_a_line_above_all_mains_is_a_band(rng):
    time_s = np.arange(6000) / 3000.0
    residual = 0.01 * np.sin(2 * np.pi * 417.0 * time_s) + 0.006 * rng.standard_normal(6000)
    found = band_of(residual, 1 / 3000.0, time_s)
    assert found.z > 8
    assert found.frequency_Hz == pytest.approx(417.0, rel=0.01)
    assert not found.mains
