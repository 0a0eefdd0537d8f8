"""A loop under a sensor whose noise wanders: what neighbours share is no reason to smooth the density away."""

import numpy as np
import pytest
from scipy.signal import lfilter

import fits

NOISE_um, SAMPLES = 0.03, 4000
TURNS_V = [0, 100, 0, 80, 20, 100, 40, 70, 30, 90, 0, 60, 10, 100, 0, 50, 5, 75, 25, 100, 0]


def displacement(voltage_V):
    """Plays of many widths beside a slope, sample by sample; from negative saturation."""
    radius_V = np.linspace(0, 50, 400)
    weight = radius_V * np.exp(-radius_V / 8)
    play, out_um = voltage_V[0] + radius_V, np.empty(len(voltage_V))
    for k, now in enumerate(voltage_V):
        play = np.clip(play, now - radius_V, now + radius_V)
        out_um[k] = 0.1 * now + 0.3 * (weight @ play) / weight.sum()
    return out_um


@pytest.mark.parametrize("memory", [pytest.param(0.9, marks=pytest.mark.study), 0.99])
@pytest.mark.study
def test_wandering_noise_leaves_the_density_as_rough_as_it_is(rng, memory):
    path = np.r_[0, np.cumsum(np.abs(np.diff(TURNS_V)))]
    voltage_V = np.interp(np.linspace(0, path[-1], SAMPLES), path, TURNS_V)
    true_um = displacement(voltage_V)
    noise_um = lfilter([(1 - memory**2) ** 0.5], [1, -memory], rng.standard_normal(SAMPLES + 500))[500:] * NOISE_um
    record = fits.Record(np.arange(SAMPLES) / 50, voltage_V, true_um + noise_um, source="wandering.csv")
    found = fits.fit([record], holdout=0.0, initial="negative")
    predicted = fits.predict(found.model, record, initial="negative", uncertainty=found.uncertainty)
    off_um = predicted.displacement_um - true_um
    off_um -= off_um.mean()
    assert np.std(off_um) < 1.5 * NOISE_um
    assert np.mean(np.abs(off_um) < 1.96 * predicted.displacement_sd_um) > 0.85
