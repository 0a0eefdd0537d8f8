"""What a fit of slow loops suggests beside a hysteresis: triangles at two rates, by plays and filters of SciPy."""

import numpy as np
import pytest
from scipy.signal import lfilter, sawtooth

import fits

RATE_Hz, LAG_s, GAIN_um_per_V, NOISE_um = 10_000, 4.5e-4, 0.1, 1.6e-3
# Kelvin-Voigt elements, each decade of time the same.
CONSTANTS_s = (3e-3, 3e-2, 3e-1)


def triangles(frequency_Hz, rng, gain, lag_s):
    """Some periods of a triangle from rest: plays, then relaxations of one gain each, then a lag."""
    time_s = np.arange(round(8 / frequency_Hz * RATE_Hz)) / RATE_Hz
    voltage_V = 90 * sawtooth(2 * np.pi * frequency_Hz * time_s + np.pi / 2, 0.5)
    radius_V = np.linspace(0, 60, 300)
    weight = np.exp(-radius_V / 20)
    play, played = np.zeros(len(radius_V)), np.empty(len(time_s))
    for k, now in enumerate(voltage_V):
        play = np.clip(play, now - radius_V, now + radius_V)
        played[k] = 0.7 * now + 0.3 * (weight @ play) / weight.sum()
    moved_um = GAIN_um_per_V * played
    moved_um = moved_um + sum(gain * lagged(moved_um, one) for one in CONSTANTS_s)
    measured_um = lagged(moved_um, lag_s) + rng.normal(0, NOISE_um, len(time_s))
    return fits.Record(time_s, voltage_V, measured_um, source=f"triangle_{frequency_Hz}_Hz.csv")


def lagged(moved_um, constant_s):
    if constant_s == 0:
        return moved_um
    left = np.exp(-1 / (RATE_Hz * constant_s))
    return lfilter([1 - left], [1, -left], moved_um)


def suggested(rng, gain, lag_s):
    found = fits.fit([triangles(f, rng, gain, lag_s) for f in (20, 40)], levels=16)
    return [one for one in found.remarks if "fit again with" in one]


@pytest.mark.parametrize(
    ("gain", "lag_s", "options"),
    [
        pytest.param(0.0, LAG_s, ["a lag"], id="lag"),
        pytest.param(0.01, LAG_s, ["a lag", "a lag and 3 relaxations"], id="both", marks=pytest.mark.study),
        pytest.param(0.03, 0.0, ["3 relaxations"], id="relaxations", marks=pytest.mark.study),
        pytest.param(0.0, 0.0, [], id="neither", marks=pytest.mark.study),
    ],
)
def test_what_explains_most_is_suggested_first(rng, gain, lag_s, options):
    """A density alone meets the lag half way, and relaxations of negative gain would take up what is left."""
    remarks = suggested(rng, gain, lag_s)
    assert [remark.split("fit again with ")[1] for remark in remarks] == options
    assert all(remark.startswith("a lag") for remark in remarks[:1] if lag_s)
