"""Stages fitted to runs whose loops are told before the voltage has been at both of its ends."""

import numpy as np
import pytest
from scipy.signal import lsim

import fits
from fits.stage._began import prepare_asides

RATE_Hz, FINE, NOISE_um, TOP_V = 2000, 16, 0.002, 80.0
TIME_CONSTANT_s, FREQUENCY_Hz, DAMPING = 6e-4, 240.0, 0.04
HALF_V = np.linspace(0, 40, 300)


def strained(voltage_V, place):
    """Two thirds follow at once, the rest behind plays of a smooth spread of widths, shape `(300,)`, in place."""
    weight, out = np.exp(-(((HALF_V - 8) / 9) ** 2)), np.empty(len(voltage_V))
    for k, voltage in enumerate(voltage_V):
        np.clip(place, voltage - HALF_V, voltage + HALF_V, out=place)
        out[k] = weight @ place
    return 0.08 * voltage_V + 0.04 * out / np.sum(weight)


def triangles(ends_V, duration_s):
    """Straight lines between voltages, evenly long."""
    at = np.arange(round(duration_s * RATE_Hz)) / (duration_s * RATE_Hz)
    return np.interp(at, np.linspace(0, 1, len(ends_V)), ends_V)


def multisine(rng, centre_V, each_V, duration_s):
    """Ten sines up to beyond the resonance about a voltage."""
    time_s = np.arange(round(duration_s * RATE_Hz)) / RATE_Hz
    shapes = zip(np.geomspace(5, 500, 10), rng.uniform(0, 6, 10), strict=True)
    waves = [np.sin(2 * np.pi * f * time_s + p) for f, p in shapes]
    return centre_V + np.minimum(1, time_s / 0.05) * each_V * np.sum(waves, axis=0)


def run(rng, command_V, before_V, source):
    """What a rig that went through some voltages makes of a command, by SciPy in fine steps, with noise."""
    n = len(command_V)
    fine_s = np.arange((n - 1) * FINE + 1) / (RATE_Hz * FINE)
    line_V = np.interp(fine_s, np.arange(n) / RATE_Hz, command_V)
    place = np.zeros_like(HALF_V)
    for before in np.atleast_2d(before_V).T:
        strained(before, place)
    _, driven_V, _ = lsim(([1.0], [TIME_CONSTANT_s, 1.0]), line_V - line_V[0], fine_s)
    still_um = strained(driven_V + line_V[0], place)
    rate = 2 * np.pi * FREQUENCY_Hz
    _, moved_um, _ = lsim(([rate**2], [1.0, 2 * DAMPING * rate, rate**2]), still_um - still_um[0], fine_s)
    reading_um = moved_um[::FINE] + still_um[0] + NOISE_um * rng.standard_normal(n) + rng.uniform(-5, 5)
    return fits.Record(fine_s[::FINE], command_V, reading_um, source=source)


@pytest.fixture(scope="module")
def random_before():
    """Voltages that a run was driven through before, from a fresh seed."""
    return lambda rng, last_V: np.append(rng.uniform(0.1, 0.9, 20) * TOP_V, last_V)


def _is_predicted(found, aside):
    values = {one.name: one.value for one in found.parameters}
    held = found.runs[-1].held_out
    print(values, held)
    assert values["mechanics.natural_frequency_Hz"] == pytest.approx(FREQUENCY_Hz, rel=1e-3)
    assert values["driver.time_constant_s"] == pytest.approx(TIME_CONSTANT_s, rel=0.02)
    # A smooth density is of finite levels, and the plays of a past have turned where no spline does.
    assert held.samples > 1000
    assert held.rms_um < 2 * NOISE_um
    # What is not known of the past is no part of a band around a run whose past is fitted.
    (alone,) = prepare_asides(found.model, [aside], (0.0, TOP_V), "unknown", found.runs[0].substeps)
    sd_um = found.uncertainty.sd_um(found.model.with_substeps(1), alone)
    print("band", np.sqrt(np.mean(sd_um**2)))
    assert np.sqrt(np.mean(sd_um**2) + NOISE_um**2) == pytest.approx(held.rms_um, rel=0.4)


def test_loops_are_learnt_from_samples_that_an_unknown_past_reaches(rng, random_before):
    """The voltage is at its second end half-way, after all but a few narrow loops."""
    narrow = [40 + 8 * (-1) ** k for k in range(12)]
    grows_V = [40, 48, 30, 56, 24, 66, 14, 74, 8, 80, 0, *narrow]
    first = triangles(grows_V, 2.0)
    second = np.append(multisine(rng, 40.0, 3.0, 0.9), triangles([40, TOP_V, 0, 40], 0.4))
    second = np.append(second, multisine(rng, 40.0, 1.0, 0.7))
    third = triangles([20, 70, 35, 60, 10, 55, 25, 72, 5, 40], 1.0)
    named = zip((first, second, third), ("a.csv", "b.csv", "third.csv"), strict=True)
    runs = [run(rng, command, random_before(rng, command[0]), name) for command, name in named]
    found = fits.fit_stage(runs[:2], holdout=runs[2:])
    assert [one.has_past for one in found.runs] == [True, True, True]
    _is_predicted(found, runs[2])
    name = "mechanics.natural_frequency_Hz"
    profile = fits.profile_stage(found, runs[:2], name, points=3, holdout=0.0)
    # All but quadratic, of the same samples as the fit.
    width = profile.upper - profile.lower, found[name].upper - found[name].lower
    print("profile", width)
    assert width[0] == pytest.approx(width[1], rel=0.3)


def test_at_the_low_end_of_the_voltage_plays_may_be_as_they_were_never_moved(rng):
    """A stack that was never driven begins at 0 V elsewhere than where the way back to 0 V leads."""
    first = triangles([0, 80, 0, 70, 10, 60, 20, 50, 30, 40, 40, 66, 12, 80, 0], 2.0)
    second = np.append(triangles([0, 40], 0.2), multisine(rng, 40.0, 4.0, 1.8))
    third = triangles([0, 30, 12, 60, 20, 55, 5, 70, 40, 50], 1.0)
    runs = [run(rng, one, [0.0], name) for one, name in ((first, "a.csv"), (second, "b.csv"), (third, "third.csv"))]
    found = fits.fit_stage(runs[:2], holdout=runs[2:])
    assert [one.has_past for one in found.runs] == [True, True, True]
    _is_predicted(found, runs[2])
