"""The inverse of a whole stage, played into a fine simulation in NumPy and SciPy that shares no code with it."""

import jax
import numpy as np
import pytest
from _models import compiled, random_model
from _plant_reference import driver_and_mechanics, mechanics_alone, states
from _reference import central_differences
from scipy.interpolate import CubicSpline

import microid as m

LEVELS, RANGE_V = 9, 100.0
PARTS = {"all": (True, True), "no driver": (False, True), "no mechanics": (True, False)}


class Relays:
    """Relays with the density `flat + slant alpha` below 100 V, and a slope, by areas under the staircase."""

    def __init__(self, rng):
        self.flat_um_per_V2, self.slant_um_per_V3 = rng.uniform(1e-3, 3e-3), rng.uniform(0, 2e-5)
        self.slope_um_per_V, self.offset_um = rng.uniform(0.05, 0.2), rng.normal()

    def model(self):
        alpha_V = np.linspace(0, RANGE_V, LEVELS)[np.tril_indices(LEVELS)[0]]
        areas_V2 = m.densities.node_areas(LEVELS)[np.tril_indices(LEVELS)] * RANGE_V**2
        weights_um = (self.flat_um_per_V2 + self.slant_um_per_V3 * alpha_V) * areas_V2
        reversible = m.Reversible(np.full(LEVELS, self.slope_um_per_V), 0.0, RANGE_V)
        return m.Preisach(m.densities.GridDensity(weights_um, 0.0, RANGE_V), reversible, self.offset_um)

    def area_um(self, high_V, low_V):
        d = high_V - low_V
        slanted = self.slant_um_per_V3 * (low_V * d**2 / 2 + d**3 / 3)
        return self.flat_um_per_V2 * d**2 / 2 + slanted + self.slope_um_per_V * d

    def play(self, voltage_V):
        corners, heights, tip, up, out = [0.0], [0.0], 0.0, True, []
        for value in voltage_V.tolist():
            if value != tip and (value > tip) != up:
                corners.append(tip)
                heights.append(out[-1])
                up = not up
            while len(corners) > 2 and (corners[-2] <= value if up else corners[-2] >= value):
                del corners[-2:], heights[-2:]
            low, high = sorted((corners[-1], value))
            out.append(heights[-1] + (self.area_um(high, low) if up else -self.area_um(high, low)))
            tip = value
        return np.array(out) + self.offset_um


def random_stage(rng, driver=True, mechanics=True):
    law, parts = Relays(rng), {}
    if driver:
        parts["driver"] = m.Driver(rng.uniform(1e-3, 3e-3), rng.uniform(5, 15))
    parts["hysteresis"] = law.model()
    if mechanics:
        parts["mechanics"] = m.Mechanics(rng.uniform(90, 150), rng.uniform(0.02, 0.2), rng.uniform(1, 3))
    parts["sensor"] = m.Sensor(rng.uniform(0.9, 1.1), rng.normal())
    return m.Stage.of(**parts), law


def play_finely(stage, law, time_s, voltage_V, pieces):
    """Displacement between samples too, under a command in lines."""
    count = pieces * (len(time_s) - 1) + 1
    fine_s = np.interp(np.arange(count) / pieces, np.arange(len(time_s)), time_s)
    u = np.interp(fine_s, time_s, voltage_V)
    if "driver" in stage.names:
        a, b = driver_and_mechanics(float(stage["driver"].time_constant_s), 1.0, 1.0)
        u = float(stage["driver"].gain) * states(a[:1, :1], b[:1], fine_s, u, "first")[:, 0]
    w = law.play(u)
    if "mechanics" in stage.names:
        part = stage["mechanics"]
        plant = mechanics_alone(float(part.natural_frequency_Hz), float(part.damping_ratio))
        w = float(part.gain) * states(*plant, fine_s, w, "first")[:, 0]
    return fine_s, float(stage["sensor"].offset_um) + float(stage["sensor"].gain) * w


def smooth_reference(stage, law):
    """Rest, a smooth start and two tones, in the middle of what can be reached; a function of time."""
    gain = float(stage["sensor"].gain) * float(stage["mechanics"].gain if "mechanics" in stage.names else 1.0)
    lowest_um = float(stage["sensor"].offset_um) + gain * law.offset_um
    stroke_um = gain * law.area_um(RANGE_V, 0.0)

    def reference_um(time_s):
        x = np.clip(8 * time_s - 0.08, 0, 1)
        rise = x**4 * (35 - 84 * x + 70 * x**2 - 20 * x**3)
        tones = 0.2 * np.sin(2 * np.pi * 9 * time_s) + 0.1 * np.sin(2 * np.pi * 23 * time_s + 1)
        return lowest_um + stroke_um * (0.05 + rise * (0.45 + tones))

    return reference_um, stroke_um


@compiled
def inverted(stage, time_s, reference_um):
    return m.invert_stage(stage, time_s, reference_um)


@pytest.mark.parametrize("parts", PARTS)
def test_the_stage_follows_at_and_between_samples(parts, rng):
    """To second order in the interval, at which lines miss the extremes between samples."""
    stage, law = random_stage(rng, *PARTS[parts])
    reference_um, stroke_um = smooth_reference(stage, law)
    errors = []
    for samples in (301, 1201) if parts == "all" else (1201,):
        time_s = np.linspace(0, 0.4, samples)
        found = inverted(stage, time_s, reference_um(time_s))
        assert np.all(found.reachable)
        fine_s, played_um = play_finely(stage, law, time_s, np.asarray(found.voltage_V), 2400 // (samples - 1))
        errors.append(np.sqrt(np.mean((played_um - reference_um(fine_s)) ** 2)) / stroke_um)
    assert errors[-1] < 3e-4
    if parts == "all":
        assert np.log(errors[0] / errors[1]) / np.log(4) > 1.3
        # The lag and the ringing that the hysteresis' inverse alone leaves.
        static_V = inverted(
            stage.without("driver").without("mechanics"), time_s, static_um(stage, reference_um(time_s))
        )
        _, played_um = play_finely(
            stage, law, time_s, np.asarray(static_V.voltage_V) / float(stage["driver"].gain), 2
        )
        off = np.sqrt(np.mean((played_um[::2] - reference_um(time_s)) ** 2)) / stroke_um
        assert off > 10 * errors[1]


def static_um(stage, reference_um):
    """What the sensor would read without the gain of the mechanics."""
    offset_um = float(stage["sensor"].offset_um)
    return offset_um + (reference_um - offset_um) / float(stage["mechanics"].gain)


def test_what_it_needs_is_in_closed_form(rng):
    """Uneven times or one interval, parts in any number, and derivatives of SciPy's splines."""
    time_s = np.cumsum(rng.uniform(0.5e-3, 2e-3, 40))
    reference_um = rng.normal(size=40)
    first, second = m.Mechanics(80.0, 0.1, 2.0), m.Mechanics(150.0, 1.3, 0.5)
    driver = m.Driver(2e-3, 3.0)
    stage = m.Stage.of(driver=driver, piezo=m.Piezo(0.2, 1.0), first=first, second=second, sensor=m.Sensor(1.1, 2.0))

    def undone(times, values, natural_Hz, damping, gain):
        spline, rate = CubicSpline(times, values), 2 * np.pi * natural_Hz
        return (values + 2 * damping / rate * spline(times, 1) + spline(times, 2) / rate**2) / gain

    for given, times in ((time_s, time_s), (np.asarray(1e-3), 1e-3 * np.arange(40))):
        found = inverted(stage, given, reference_um)
        w = undone(times, undone(times, (reference_um - 2) / 1.1, 150.0, 1.3, 0.5), 80.0, 0.1, 2.0)
        v = (w - 1) / 0.2
        u = (v + 2e-3 * CubicSpline(times, v)(times, 1)) / 3
        for got, wanted in ((found.piezo_displacement_um, w), (found.piezo_voltage_V, v), (found.voltage_V, u)):
            np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-11 * np.abs(wanted).max())
        assert found.reachable.all()


def weigh(stage, vector, time_s, reference_um, weight):
    return weight @ m.invert_stage(m.Coordinates(stage)(vector), time_s, reference_um).voltage_V


weighed = compiled(weigh)


@compiled
def gradient(stage, vector, time_s, reference_um, weight):
    return jax.grad(lambda v, r: weigh(stage, v, time_s, r, weight), argnums=(0, 1))(vector, reference_um)


@pytest.mark.study
def test_derivatives_are_those_of_finite_differences(rng):
    stage = m.Stage.of(
        driver=m.Driver(2e-3, 5.0),
        hysteresis=random_model(rng, 3),
        mechanics=m.Mechanics(100.0, 0.1, 2.0),
        sensor=m.Sensor(1.0, 0.5),
    )
    law = stage["hysteresis"]
    lowest_um, highest_um = law.offset_um, law(law.density.upper_V[None])[0]
    share = 0.5 + 0.3 * np.sin(np.linspace(0.0, 9.0, 24)) + 0.02 * rng.uniform(size=24)
    reference_um = np.asarray(0.5 + 2 * (lowest_um + share * (highest_um - lowest_um)))
    time_s, vector = np.asarray(4e-3), np.asarray(m.Coordinates(stage).of(stage))
    weight = rng.normal(size=24)
    of_parameters, of_reference = gradient(stage, vector, time_s, reference_um, weight)
    for found, at, function in (
        (of_parameters, vector, lambda x: weighed(stage, x, time_s, reference_um, weight)),
        (of_reference, reference_um, lambda x: weighed(stage, vector, time_s, x, weight)),
    ):
        expected = central_differences(function, at, np.full(len(at), 1e-6))
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-5 * np.abs(expected).max())


def test_what_is_out_of_reach_is_flagged_and_the_voltage_clipped(rng):
    stage, law = random_stage(rng)
    reference_um, stroke_um = smooth_reference(stage, law)
    time_s = np.linspace(0, 0.4, 301)
    found = inverted(stage, time_s, reference_um(time_s) + 0.8 * stroke_um * np.sin(time_s / 0.3) ** 4)
    needed = np.asarray(found.piezo_displacement_um) - law.offset_um
    outside = (needed < 0) | (needed > law.area_um(RANGE_V, 0.0))
    assert outside.any()
    np.testing.assert_array_equal(found.reachable, ~outside)
    assert 0 <= np.min(found.piezo_voltage_V) <= np.max(found.piezo_voltage_V) <= RANGE_V


def test_parts_without_an_inverse_and_too_few_samples_are_refused(rng):
    stage, _ = random_stage(rng)
    with pytest.raises(ValueError, match="4 samples"):
        m.invert_stage(stage, np.arange(3.0), np.zeros(3))
    plays = m.hysteresis.PrandtlIshlinskii(0.2, np.ones(1), np.ones(1), 0.0)
    with pytest.raises(ValueError, match="'hysteresis' is a PrandtlIshlinskii"):
        m.invert_stage(stage.swap("hysteresis", plays), np.arange(8.0), np.zeros(8))
