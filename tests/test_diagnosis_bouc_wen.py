"""A hysteresis that is no Preisach operator, whose law the diagnosis has to find beside the density."""

import numpy as np
import pytest

from fits import Record, diagnose

NOISE_um, RATE_Hz, PARTS = 0.01, 100.0, 40
TURNS_V = 0, 100, 0, 85, 15, 75, 25, 60, 40, 50, 0, 35, 15, 70, 45, 100, 60, 80, 20, 45, 0, 90, 30, 55, 0


def behind(voltage_V, length_V, sigma, exponent, asymmetry):
    """State of Bouc and Wen in short explicit steps, from where the voltage has come down for long."""
    fine = np.interp(np.arange((len(voltage_V) - 1) * PARTS + 1) / PARTS, np.arange(len(voltage_V)), voltage_V)
    z, found = -((1 - 2 * asymmetry) ** (-1 / exponent)), []
    for move in np.r_[0.0, np.diff(fine)] / length_V:
        way, side = np.sign(move), np.sign(z)
        bent = 1 - sigma + sigma * side * way + asymmetry * (way + side)
        z += move * (1 - abs(z) ** exponent * bent)
        found.append(z)
    return np.array(found[::PARTS])


@pytest.mark.study
def test_what_forgets_reversals_by_and_by_is_named_and_its_law_found(rng):
    """It had been unexplained, or friction and creep."""
    way_V = np.r_[0, np.cumsum(np.abs(np.diff(TURNS_V)))]
    voltage_V = np.interp(np.arange(0, way_V[-1], 80 / RATE_Hz), way_V, TURNS_V)
    length_V, sigma, exponent = rng.uniform(12, 35), rng.uniform(0.6, 0.9), rng.uniform(1.1, 1.8)
    amplitude_um, asymmetry = rng.uniform(0.8, 2.0), rng.uniform(-0.1, 0.1)
    truth_um = 0.2 * voltage_V - amplitude_um * behind(voltage_V, length_V, sigma, exponent, asymmetry)
    read_um = truth_um + NOISE_um * rng.standard_normal(len(truth_um))
    found = diagnose([Record(np.arange(len(voltage_V)) / RATE_Hz, voltage_V, read_um, source="loops.csv")])
    print(found.summary())
    (cause,) = found.causes
    assert cause.name == "bouc_wen_hysteresis"
    value = {one.name: one.value for one in cause.parameters}
    assert value["length"] == pytest.approx(length_V / 100, rel=0.1)
    assert value["asymmetry"] == pytest.approx(asymmetry, abs=0.03)
    assert found.gain.heldout_rms_after_um < 1.3 * NOISE_um
