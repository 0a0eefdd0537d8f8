"""A cause that is many times what a resonance makes hides that from the plain stage."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from fits import Record, diagnose
from fits.diagnosis import _diagnose
from fits.diagnosis._baseline import fit_baseline
from fits.diagnosis._noise import find_faults
from fits.diagnosis._plain_fit import PlainFit
from fits.diagnosis._prepare import prepared
from fits.diagnosis._regression import regress
from microid import Mechanics

RATE_Hz, COUNT, PARTS, NOISE_um = 4300.0, 3200, 40, 0.001


def dahl(fine_V, length_V, exponent):
    """State of Dahl's law, of some exponent, in short explicit steps, from where it is in the middle."""
    z, found = 0.0, []
    for move in np.r_[0.0, np.diff(fine_V)] / length_V:
        z = np.clip(z + move * (1 - z * np.sign(move)) ** exponent, -1, 1)
        found.append(z)
    return np.array(found)


def without_poles(reading, progress, *_):
    """The plain stage as a fit beside such a law may end: it shows no resonance."""
    settings = reading.records, reading.aside, reading.fraction, reading.initial, progress
    slow = fit_baseline(*settings, left_out=("no poles were fitted",))
    regression = regress(fit_baseline(*settings, onward=slow.with_driver_alone(3e-4)))
    assert regression.baseline.resonance_Hz is None
    return prepared(reading, PlainFit(regression, find_faults(regression)), (), progress)


@pytest.mark.study
def test_a_resonance_is_asked_for_again_beside_the_law_that_hid_it(rng, monkeypatch):
    """A stage was left without mechanics, and 13 nm of its ringing were a vibration of the floor."""
    monkeypatch.setattr(_diagnose, "prepare_diagnosis", without_poles)
    length_V, exponent = rng.uniform(18, 26), rng.uniform(1.25, 1.45)
    resonance_Hz, damping = rng.uniform(150, 190), rng.uniform(0.012, 0.02)
    fine = np.arange((COUNT - 1) * PARTS + 1) / PARTS / RATE_Hz
    end_s = fine[-1]
    decay = (1 - 0.93 * fine / end_s) * np.minimum(fine / (0.05 * end_s), 1)
    loops_V = 50 - 50 * decay * np.cos(2 * np.pi * 8.3 * fine / end_s)
    waves = np.arange(2, 40) / end_s
    sines = sum(np.cos(2 * np.pi * f * fine + rng.uniform(0, 2 * np.pi)) / f**0.7 for f in waves)
    many_V = 50 + 48 * np.minimum(fine / (0.05 * end_s), 1) * sines / np.max(np.abs(sines))
    natural = 2 * np.pi * resonance_Hz
    over, under, _ = cont2discrete(
        ([natural**2], [1, 2 * damping * natural, natural**2]), 1 / RATE_Hz / PARTS, method="foh"
    )
    runs = []
    for source, drive_V in (("loops.csv", loops_V), ("many.csv", many_V)):
        # The command runs in lines between samples.
        command_V = drive_V[::PARTS]
        between_V = np.interp(fine, fine[::PARTS], command_V)
        moved_um = 0.3 * between_V - 3.0 * dahl(between_V, length_V, exponent)
        rung_um = moved_um[0] + lfilter(np.ravel(over), under, moved_um - moved_um[0])
        read_um = rung_um[::PARTS] + NOISE_um * rng.standard_normal(COUNT)
        runs.append(Record(fine[::PARTS], command_V, read_um, source=source))
    found = diagnose(runs)
    print(length_V, exponent, resonance_Hz, damping, found.summary())
    [mechanics] = [part for part in found.extended.parts if isinstance(part, Mechanics)]
    assert float(mechanics.natural_frequency_Hz) == pytest.approx(resonance_Hz, rel=0.02)
    [law] = [one for one in found.causes if one.name == "bouc_wen_hysteresis"]
    assert {one.name: one.value for one in law.parameters}["approach"] == pytest.approx(exponent, abs=0.05)
    assert found.gain.heldout_rms_after_um < 0.1 * found.gain.heldout_rms_before_um
