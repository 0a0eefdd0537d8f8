"""Beside what no effect of the library makes, evidence of those that are none is large: they must predict better."""

import numpy as np
import pytest
from scipy.signal import lfilter

from fits import Record, diagnose
from fits.diagnosis._conclude import _may_be_worse_z
from fits.diagnosis._extension import Compared, predicts_worse
from fits.diagnosis._thresholds import THRESHOLDS

RATE_Hz, NOISE_um, TOP_V = 200.0, 4e-3, 150.0


@pytest.mark.parametrize(("doubts", "better_by", "named"), [(0, 0.0, True), (1, 0.0, False), (1, 0.02, True)])
def test_a_doubt_wants_the_support_of_what_was_held_out(rng, doubts, better_by, named):
    before = rng.standard_normal(5000)
    compared = [Compared(None, before, (1 - better_by) * before, np.ones(5000, dtype=bool))]
    assert predicts_worse(compared, _may_be_worse_z(doubts, THRESHOLDS), THRESHOLDS.worse_share) != named


def measured(rng, voltage_V, step_V, source):
    """A converter of coarse steps, a driver's lag between samples that it holds, and 400 plays."""
    given_V = step_V * np.round(voltage_V / step_V)
    share = np.exp(-1 / (RATE_Hz * 0.011))
    # What is held since the sample before has come so far at a sample.
    driven_V = lfilter([0, 1 - share], [1, -share], given_V)
    half_V = np.random.default_rng(1).gamma(2.0, 8.0, 400)
    place, moved = driven_V[0] + half_V, np.empty(len(driven_V))
    for k, voltage in enumerate(driven_V):
        place = np.clip(place, voltage - half_V, voltage + half_V)
        moved[k] = 0.11 * voltage + 0.045 * place.mean()
    noisy = moved + NOISE_um * rng.standard_normal(len(moved))
    return Record(np.arange(len(moved)) / RATE_Hz, voltage_V, noisy, source=source)


@pytest.mark.study
def test_steps_of_the_converter_are_no_effect_of_the_library(rng):
    """A rail of 0.4 V had been named beside them, and two jumps of the zero; neither predicted anything better."""
    step_V = TOP_V / rng.uniform(140, 200)
    waves = rng.uniform(0.5, 2.2, 5)[:, None]
    time_s = np.arange(0, 20, 1 / RATE_Hz)
    mixed = np.sin(2 * np.pi * waves * time_s).sum(axis=0)
    mixed = np.r_[0.0, TOP_V * (0.5 + 0.5 * mixed / np.abs(mixed).max())]
    levels_V = np.r_[np.linspace(0, TOP_V, 13), np.linspace(TOP_V, 0, 13), rng.uniform(0, TOP_V, 30)]
    phase = 2 * np.pi * 0.2 * 20 / np.log(12) * (12 ** (time_s / 20) - 1)
    runs = [
        measured(rng, voltage_V, step_V, f"{name}.csv")
        for name, voltage_V in {
            "mixed": mixed,
            "stairs": np.repeat(levels_V, 60),
            "chirp": TOP_V * (0.5 - 0.5 * np.cos(phase)),
        }.items()
    ]
    found = diagnose(runs[:2], holdout=runs[2:])
    print(found.summary())
    gain = found.gain
    assert found.verdict != "effect_found" or gain.heldout_rms_after_um < 0.97 * gain.heldout_rms_before_um
    assert found.verdict != "no_effect"
