"""Flicker noise, from many relaxations of all time constants, and what is told from it."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from fits import Record
from fits.diagnosis._residual_tests import is_flicker, run_regressors
from fits.loop._run import prepare_run
from fits.stats._flicker import Flicker


def relaxations(rng, count, size):
    """Noise of a power of about `size / f`: relaxations, four of each decade, all as strong (McWhorter)."""
    rates = np.geomspace(1e-5, 2.0, 22)
    sums = np.zeros(count)
    for rate in rates:
        kept = np.exp(-rate)
        driven = rng.standard_normal(count) * np.sqrt(1 - kept**2)
        driven[0] = rng.standard_normal()
        sums += lfilter([1.0], [1.0, -kept], driven)
    # Each has a power of 2 rate / (rate^2 + (2 pi f)^2); their sum is 1 / (2 f) per e-fold of the rate.
    step = np.log(rates[1] / rates[0])
    return np.sqrt(size * 2 * step) * sums


@pytest.mark.parametrize("size", [0.003, 0.03])
def test_the_powers_of_both_parts_are_found(rng, size):
    found = [Flicker.of(rng.standard_normal(4000) + relaxations(rng, 4000, size)) for _ in range(20)]
    # Whittle's estimates of 4,000 samples scatter by 3 and by 15 % or so.
    assert np.mean([one.white for one in found]) == pytest.approx(1.0, abs=0.05)
    assert np.mean([one.rising for one in found]) == pytest.approx(size, rel=0.2)


def test_what_columns_take_of_such_noise_is_foretold(rng):
    """Slow columns take far more of it than of white noise, fast ones no more."""
    count, size = 3000, 0.02
    time = np.arange(count) / count
    slow = np.stack([np.cos(np.pi * k * time) for k in range(3, 15)], axis=1)
    fast = np.stack([np.cos(np.pi * k * time) for k in range(2000, 2012)], axis=1)
    draws = [rng.standard_normal(count) + relaxations(rng, count, size) for _ in range(200)]
    for columns in (slow, fast):
        basis = np.linalg.qr(columns)[0]
        taken = np.mean([np.sum((basis.T @ one) ** 2) for one in draws])
        foretold = np.trace(basis.T @ Flicker(1.0, size).passed(basis))
        assert taken == pytest.approx(foretold, rel=0.15)


def test_an_octave_with_a_resonance_in_it_is_no_flicker_noise(rng):
    chances, count = [], 3000
    for _ in range(200):
        noise = rng.standard_normal(count) + relaxations(rng, count, 0.02)
        chances.append(Flicker.of(noise).chance(noise))
    # Octaves are not quite independent of the fit: as many or fewer are improbable than are said to be.
    assert np.mean(np.array(chances) < 0.05) < 0.15
    ringing = lfilter([0.15], [1.0, -2 * 0.98 * np.cos(0.2), 0.98**2], rng.standard_normal(count))
    found = noise + ringing
    assert Flicker.of(found).chance(found) < 1e-3


def test_what_goes_with_the_position_is_no_flicker_noise(rng):
    """Four loops, and a curve along each branch of as large a mean square as the noise wanders by, or none."""
    count, size = 3000, 0.02
    time_s = np.arange(count) / 1000.0
    voltage_V = 50 - 45 * np.cos(2 * np.pi * 4 * time_s / time_s[-1])
    place_um = 0.3 * voltage_V
    run = prepare_run(Record(time_s, voltage_V, place_um), (5.0, 95.0), "negative", 0.0)
    groups = run_regressors([run], [place_um])
    bare = SimpleNamespace(split=lambda joined: [joined], off=lambda joined: joined, join=np.concatenate)
    nothing = np.zeros((count, 0))
    up = np.gradient(voltage_V) >= 0
    curve = np.where(up, 1.0, -1.0) * np.sin(np.pi * (voltage_V - 5) / 90) - 0.3 * np.cos(np.pi * voltage_V / 45)
    found = []
    for _ in range(40):
        wander = relaxations(rng, count, size)
        noise = rng.standard_normal(count) + wander
        errors = noise + curve * np.std(wander) / np.std(curve)
        found.append([is_flicker(bare, nothing, one - one.mean(), groups) for one in (noise, errors)])
    alone, beside = np.mean(found, axis=0)
    print(alone, beside)
    assert alone > 0.7
    assert beside < 0.05
