"""Colour of noise that is read off the fastest changes: planted autoregressions, lines, bursts and slow misfits."""

import numpy as np
import pytest
from scipy.signal import lfilter

from fits.diagnosis._thresholds import THRESHOLDS
from fits.stats._colour import Spectrum, coloured
from fits.stats._noise import Noise
from fits.stats._sensor_noise import Floor, pooled

SAMPLES = 40_000


def of_first_order(rng, correlation, samples=SAMPLES):
    """An autoregression of variance one."""
    new = rng.standard_normal(samples + 500) * (1 - correlation**2) ** 0.5
    return lfilter([1.0], [1.0, -correlation], new)[500:]


def noise_of(*residuals):
    return coloured([Spectrum.of(one) for one in residuals], THRESHOLDS.apart_z)


def test_white_noise_has_no_colour(rng):
    assert noise_of(*rng.standard_normal((3, SAMPLES))) == [None, None, None]


@pytest.mark.parametrize("correlation", [0.3, 0.5, 0.65])
def test_a_colour_of_first_order_is_found(rng, correlation):
    spectrum = Spectrum.of(of_first_order(rng, correlation))
    found, error = spectrum.correlation()
    assert abs(found - correlation) < 5 * error
    assert error < 0.1
    (noise,) = noise_of(of_first_order(rng, correlation))
    assert noise.total_um == pytest.approx(1.0, rel=0.35)


def test_lines_bursts_and_what_is_slow_do_not_colour_noise(rng):
    time = np.arange(SAMPLES)
    for size in (0.0, 1.0):
        left = rng.standard_normal(SAMPLES) + 20 * np.sin(time / 400) + 3 * np.sin(0.8 * time) * size
        left += 10 * np.exp(-(time % 1500) / 40) * np.sin(1.1 * time) * size
        assert noise_of(left) == [None]


def test_what_is_no_noise_of_first_order_is_left_alone(rng):
    """A misfit far above the noise, which falls off into it: the fastest changes bend."""
    left = np.cumsum(rng.standard_normal(SAMPLES)) + 0.5 * rng.standard_normal(SAMPLES)
    (noise,) = noise_of(np.cumsum(left - left.mean()) * 0.2)
    assert noise is None


def test_one_sensor_has_one_colour(rng):
    alike = noise_of(of_first_order(rng, 0.6), 2 * of_first_order(rng, 0.6, 2 * SAMPLES))
    assert alike[0].past == alike[1].past
    assert [one.total_um for one in alike] == pytest.approx([1.0, 2.0], rel=0.35)
    apart = noise_of(of_first_order(rng, 0.3), of_first_order(rng, 0.7))
    assert apart[0].past < 0.45 < 0.55 < apart[1].past
    assert Spectrum.of(rng.standard_normal(900)) is None


def test_colour_is_asked_where_nothing_was_idle(rng):
    level, left = Noise(0.4, np.zeros(0)), of_first_order(rng, 0.7)
    found = pooled([Floor(level, 0, Spectrum.of(left)), Floor(level, 4000)], THRESHOLDS.apart_z)
    assert found[0].noise.total_um == pytest.approx(1.0, rel=0.35)
    assert found[1].noise == level


@pytest.mark.parametrize("spread", [False, True])
def test_a_whitened_signal_is_coloured_again(rng, spread):
    values = np.cumsum(rng.standard_normal(500))
    noise = Noise(0.03, np.array([1.2, -0.5]), rng.uniform(1, 3, 500) if spread else None)
    np.testing.assert_allclose(noise.colour(noise.whiten(values)), values, rtol=1e-9, atol=1e-9)
