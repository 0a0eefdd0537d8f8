"""The band of a loop's fit holds truths of other making: relays on a grid, and plays in a narrow ridge."""

import numpy as np
import pytest

import fits
from fits.stats._noise import repeated_square

NOISE_um, SAMPLES = 0.03, 1500
TURNS_V = [0, 100, 4, 92, 9, 81, 15, 70, 22, 60, 28, 53, 85, 30, 75, 22, 62, 35]


def _voltage_V():
    path = np.r_[0, np.cumsum(np.abs(np.diff(TURNS_V)))]
    return np.interp(np.linspace(0, path[-1], SAMPLES), path, TURNS_V)


def _relays(voltage_V, number=120):
    """A bell of relays in the half-plane, whose steps are no smaller than the noise; from negative saturation."""
    at_V = (np.arange(number) + 0.5) / number * 100
    upper, lower = np.meshgrid(at_V, at_V, indexing="ij")
    weight = np.exp(-(((upper + lower) / 2 - 50) ** 2) / 1800 - (upper - lower - 10) ** 2 / 1200) * (upper >= lower)
    on, out_um = np.zeros(weight.shape, dtype=bool), 0.13 * voltage_V
    for k, now in enumerate(voltage_V):
        on = (on | (upper <= now)) & (lower <= now)
        out_um[k] += 6 * np.sum(weight * on) / weight.sum()
    return out_um


def _ridge(voltage_V, rng):
    radius_V = rng.normal(15, 1, 300)
    play, out_um = voltage_V[0] + radius_V, 0.13 * voltage_V
    for k, now in enumerate(voltage_V):
        play = np.clip(play, now - radius_V, now + radius_V)
        out_um[k] += 0.06 * play.mean()
    return out_um


@pytest.mark.study
@pytest.mark.parametrize("law", ["relays", "ridge"])
def test_the_band_owns_up_to_structure_finer_than_the_grid(rng, law):
    voltage_V = _voltage_V()
    true_um = _relays(voltage_V) if law == "relays" else _ridge(voltage_V, rng)
    covered, rms_um = [], []
    for _ in range(3):
        read_um = true_um + NOISE_um * rng.standard_normal(SAMPLES)
        record = fits.Record(0.01 * np.arange(SAMPLES), voltage_V, read_um, source=f"{law}.csv")
        ahead = fits.fit([record], holdout=1 / 3, initial="negative").predict(record, initial="negative")
        seen = np.arange(SAMPLES) < 2 * SAMPLES // 3
        off_um = true_um - ahead.displacement_um
        off_um = (off_um - off_um[seen].mean())[~seen]
        covered.append(np.mean(np.abs(off_um) < 1.96 * ahead.displacement_sd_um[~seen]))
        rms_um.append(np.sqrt(np.mean(off_um**2)))
    assert np.mean(covered) > 0.8
    # A band as wide as that would hold anything.
    assert max(rms_um) < NOISE_um


def test_what_comes_back_with_the_voltage_is_told_from_noise(rng):
    place = np.concatenate([np.linspace(0, 1, 500), np.linspace(1, 0, 500)] * 5)
    noise = rng.standard_normal(len(place))
    steps = 0.5 * np.sign(np.sin(2 * np.pi * 60 * place))  # variance 1/4, finer than any grid
    assert repeated_square(place, steps + noise, 1.0) == pytest.approx(0.25, abs=0.1)
    assert repeated_square(place, noise, 1.0) < 0.1
    # Nothing is said of samples that are never far enough apart.
    assert repeated_square(place, steps + noise, 1000.0) == 0.0
