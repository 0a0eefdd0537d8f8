"""What repeats itself with the position, found and taken off before noise is read off the rest."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from fits.diagnosis import _plain_fit
from fits.diagnosis._noise import _without_cycles
from fits.diagnosis._thresholds import THRESHOLDS
from fits.stats._cycles import Cycles, cycles
from fits.stats._noise import rough_noise_um


def sweeps(rng, count=6000, stroke_um=30.0):
    """Positions of a motion to and fro between random turns, in um, shape `(n,)`."""
    turns_um = rng.uniform(0, 1, 30) * stroke_um / 4 + np.tile([0, 0.75], 15) * stroke_um
    way_um = np.r_[0, np.cumsum(np.abs(np.diff(turns_um)))]
    return np.interp(np.linspace(0, way_um[-1], count), way_um, turns_um)


@pytest.mark.parametrize("amplitude_um", [0.05, 0.1])
def test_cycles_are_no_noise(rng, amplitude_um):
    position_um, noise_um, period_um = sweeps(rng), 0.01, rng.uniform(0.2, 0.4)
    noise = noise_um * rng.standard_normal(len(position_um))
    left = noise + amplitude_um * np.sin(2 * np.pi * position_um / period_um + rng.uniform(0, 6))
    used = [np.ones(len(left), dtype=bool)]
    (rest,) = _without_cycles([left], [position_um], used, THRESHOLDS)
    assert rough_noise_um(left) > 2 * noise_um
    assert rough_noise_um(rest) == pytest.approx(noise_um, rel=0.2)
    assert cycles([left], [position_um]).period_um == pytest.approx(period_um, rel=1e-3)


def test_noise_and_what_repeats_itself_with_time_stay(rng):
    position_um = sweeps(rng)
    noise = 0.01 * rng.standard_normal(len(position_um))
    hum = noise + 0.1 * np.sin(2 * np.pi * rng.uniform(0.05, 0.2) * np.arange(len(noise)))
    used = [np.ones(len(noise), dtype=bool)]
    assert cycles([noise], [position_um]).z < 15
    for left in (noise, hum):
        (rest,) = _without_cycles([left], [position_um], used, THRESHOLDS)
        assert rest is left


def test_evidence_of_a_period_is_in_units_of_what_is_left(rng):
    """Structure that noise was not read off makes any period look certain in units of that noise."""
    time_s = np.linspace(0, 10, 6000)
    position_um = 15 + 10 * np.sin(3 * time_s) + 4 * np.sin(7.7 * time_s + rng.uniform(0, 6))
    noise = rng.standard_normal(len(position_um))
    wandering = 3 * lfilter([1.0], [1.0, -0.3], rng.standard_normal(len(position_um)))
    assert cycles([noise + wandering], [position_um]).z < THRESHOLDS.cycles
    wave = np.sin(2 * np.pi * position_um / 0.3)
    found = cycles([noise + 20 * wave], [position_um])
    assert found.z > THRESHOLDS.cycles
    assert found.drop == pytest.approx(200 * len(position_um), rel=0.1)


@pytest.mark.parametrize(("step_um", "asked"), [(0.0, True), (0.1, True), (0.0348, False), (0.0349, False)])
def test_what_repeats_itself_with_the_step_of_the_readings_is_their_rounding(monkeypatch, step_um, asked):
    monkeypatch.setattr(_plain_fit, "repeats_in", lambda *_: Cycles(0.0348, 900.0, 1e4))
    monkeypatch.setattr(_plain_fit, "scales_of", lambda bench, noise_um, period_um: period_um)
    faults = SimpleNamespace(quantum_um=step_um, noise=[SimpleNamespace(total_um=0.01)])
    parts = {"projector": None, "left": None, "bench": SimpleNamespace(plain=None)}
    here = SimpleNamespace(faults=faults, thresholds=THRESHOLDS, **parts)
    assert _plain_fit.PlainFit.scales.func(here) == (0.0348 if asked else None)
