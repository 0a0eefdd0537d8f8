"""A hysteresis that is no Preisach operator, whose law the diagnosis has to find beside the density."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from fits import Record, diagnose, fit_stage

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
    assert value["length_share"] == pytest.approx(length_V / 100, rel=0.1)
    assert value["asymmetry"] == pytest.approx(asymmetry, abs=0.03)
    assert found.gain.heldout_rms_after_um < 1.3 * NOISE_um


def curved_loops(rng):
    """Time, voltage and displacement of Coleman and Hodgdon's law, its length and its tilt."""
    way_V = np.r_[0, np.cumsum(np.abs(np.diff(TURNS_V)))]
    voltage_V = np.interp(np.arange(0, way_V[-1], 60 / RATE_Hz), way_V, TURNS_V)
    length_V, tilt = rng.uniform(20, 35), rng.choice([-1, 1]) * rng.uniform(0.25, 0.5)
    fine_V = np.interp(np.arange((len(voltage_V) - 1) * PARTS + 1) / PARTS, np.arange(len(voltage_V)), voltage_V)
    z, states = tilt - 1, []
    for here, move in zip(fine_V, np.r_[0.0, np.diff(fine_V)], strict=True):
        z += (move * (1 + tilt * (here / 50 - 1)) - abs(move) * z) / length_V
        states.append(z)
    time_s = np.arange(len(voltage_V)) / RATE_Hz
    return time_s, voltage_V, 0.2 * voltage_V - 1.5 * np.array(states[::PARTS]), length_V, tilt


@pytest.mark.study
def test_a_law_whose_curve_is_no_line_is_found_and_a_drift_behind_it(rng):
    """Coleman and Hodgdon's: the drift had to leave nothing but noise before the law was fitted beside it."""
    time_s, voltage_V, moved_um, length_V, tilt = curved_loops(rng)
    constant_s = rng.uniform(0.2, 0.4) * time_s[-1]
    truth_um = moved_um + 0.12 * -np.expm1(-time_s / constant_s)
    read_um = truth_um + NOISE_um * rng.standard_normal(len(truth_um))
    found = diagnose([Record(time_s, voltage_V, read_um, source="loops.csv")])
    print(length_V, tilt, constant_s, found.summary())
    law, other = sorted(found.causes, key=lambda one: one.name != "bouc_wen_hysteresis")
    assert {"thermal_drift"} & {other.name, *other.also_consistent}
    value = {one.name: one.value for one in law.parameters}
    assert value["length_share"] == pytest.approx(length_V / 100, rel=0.1)
    assert value["gain_first"] == pytest.approx(np.arctanh(tilt), abs=0.1)
    assert found.gain.heldout_rms_after_um < 1.3 * NOISE_um


@pytest.mark.study
def test_a_cyclic_error_behind_a_law_is_found_where_that_puts_the_stage(rng):
    """It was asked for at the positions of the plain stage, off by more than a period, and counted as noise then."""
    time_s, voltage_V, moved_um, length_V, tilt = curved_loops(rng)
    period_um, phase = rng.uniform(0.25, 0.4), rng.uniform(0, 2 * np.pi)
    read_um = moved_um + 0.04 * np.sin(2 * np.pi * moved_um / period_um + phase)
    read_um += NOISE_um * rng.standard_normal(len(read_um))
    found = diagnose([Record(time_s, voltage_V, read_um, source="loops.csv")])
    print(length_V, tilt, period_um, found.summary())
    value = {one.name: {each.name: each.value for each in one.parameters} for one in found.causes}
    assert {*value} == {"bouc_wen_hysteresis", "cyclic_error"}
    assert value["cyclic_error"]["period_um"] == pytest.approx(period_um, rel=2e-3)
    waves_um = [value["cyclic_error"][f"{name}[0]"] for name in ("cosine_um", "sine_um")]
    assert np.hypot(*waves_um) == pytest.approx(0.04, rel=0.1)
    assert found.gain.heldout_rms_after_um < 1.3 * NOISE_um


def test_a_resonance_shows_beside_small_loops_of_another_gain(rng):
    """Such runs were said to hold no dynamics: a gain alone left as little of the fast one as the poles did."""
    law = rng.uniform(20, 30), 0.8, 1.0, 0.0
    resonance_Hz, damping, rate_Hz = rng.uniform(400, 600), rng.uniform(0.04, 0.08), 8000.0
    way_V = np.r_[0, np.cumsum(np.abs(np.diff(TURNS_V)))]
    slow_V = np.interp(np.arange(0, way_V[-1], 100 / RATE_Hz), way_V, TURNS_V)
    time_s = np.arange(2500) / rate_Hz
    waves = np.unique(np.geomspace(3, 0.6 * resonance_Hz * time_s[-1], 35).astype(int)) / time_s[-1]
    swing_V = (np.cos(2 * np.pi * waves * time_s[:, None] + rng.uniform(0, 2 * np.pi, len(waves)))).sum(axis=1)
    ramp = np.minimum(time_s / 0.05, 1)
    fast_V = ramp * (50 + 20 * swing_V / np.abs(swing_V).max())
    slow_um, fast_um = (0.2 * v - 1.6 * behind(v, *law) for v in (slow_V, fast_V))
    natural = 2 * np.pi * resonance_Hz
    over, under, _ = cont2discrete(([natural**2], [1, 2 * damping * natural, natural**2]), 1 / rate_Hz, "foh")
    fast_um = lfilter(np.ravel(over), under, fast_um - fast_um[0]) + fast_um[0]
    runs = [
        Record(np.arange(len(v)) / rate, v, um + 0.003 * rng.standard_normal(len(um)), source=source)
        for v, um, rate, source in ((slow_V, slow_um, RATE_Hz, "slow.csv"), (fast_V, fast_um, rate_Hz, "fast.csv"))
    ]
    found = {one.name: one.value for one in fit_stage(runs, initial="negative").parameters}
    assert found["mechanics.natural_frequency_Hz"] == pytest.approx(resonance_Hz, rel=0.05)
