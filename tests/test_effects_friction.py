"""Hysteresis inside the mechanics as an effect, against adaptive integration."""

import numpy as np
import pytest
from test_effects_reference import BY_NAME, motion, through, wander

import microid as m


@pytest.mark.parametrize("gamma", [0.0, -0.6, 1.0])
def test_it_is_that_of_dahl_or_of_bouc_and_wen_on_the_mass(rng, gamma):
    time, push = 2e-4 * np.arange(200), wander(rng, 200, 5, 30)
    rate, damping, amplitude, length = 2 * np.pi * 120, 0.03, 0.3, 0.8

    def right_hand(y, w):
        force = w - y[0] - amplitude * y[2]
        built = (y[1] - y[2] * abs(y[1]) - gamma * y[1] * abs(y[2])) / length
        return [y[1], rate**2 * force - 2 * damping * rate * y[1], built]

    truth = motion(time, push, right_hand, np.array([push[0], 0.0, 0.0]))[:, 0]
    mechanics = m.Mechanics(120.0, damping)
    effects = [BY_NAME["friction", "bouc_wen"](mechanics, amplitude, length, gamma)]
    if not gamma:
        effects.append(BY_NAME["friction", ""](mechanics, amplitude, length))
    plain = through(mechanics, 2e-4, push)
    for effect in effects:
        found = through(effect, 2e-4, push)
        np.testing.assert_allclose(found, truth, atol=0.04 * np.max(np.abs(truth - plain)))
