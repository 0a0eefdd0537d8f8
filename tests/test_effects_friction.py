"""Laws of Bouc and Wen as effects, inside the mechanics and of the voltage, against adaptive integration."""

from dataclasses import replace
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
from _models import random_model
from scipy import integrate
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


@pytest.mark.parametrize(
    ("sigma", "exponent", "asymmetry", "approach"),
    [(1.0, 1.0, 0.0, 1.0), (0.6, 1.7, -0.1, 1.0), (0.9, 1.3, 0.12, 1.0), (1.0, 1.0, 0.0, 1.6), (0.8, 1.2, 0.1, 0.8)],
)
def test_a_state_of_bouc_and_wen_stays_behind_the_voltage(rng, sigma, exponent, asymmetry, approach):
    hysteresis, voltage = random_model(rng, 8), wander(rng, 300, 10, 90)
    amplitude, length = 2.0, 20.0
    given = BY_NAME["bouc_wen_hysteresis", ""](hysteresis, amplitude, length / 80, sigma, exponent, 80.0, asymmetry)
    effect = replace(given, approach=jnp.asarray(approach))

    def slope(z, way):
        bent = 1 - sigma + sigma * np.sign(z) * way + asymmetry * (way + np.sign(z))
        left = 1 - abs(z) ** exponent * bent
        return np.sign(left) * abs(left) ** approach / length

    # Up from the lower end of the range to where the record begins, and along it.
    lower = float(hysteresis.density.lower_V)
    states = followed([lower, *voltage], -((1 - 2 * asymmetry) ** (-1 / exponent)), lambda _, z, way: slope(z, way))
    given = through(hysteresis, 1e-3, voltage)
    np.testing.assert_allclose(through(effect, 1e-3, voltage), given - amplitude * states, atol=1e-4 * amplitude)


@pytest.mark.parametrize(
    ("gain", "loss"), [((0.4, -0.2, 0.1, -0.3), (0.0, 0.0)), ((-0.3, 0.25, 0.0, 0.1), (0.3, -0.15))]
)
def test_its_gain_and_loss_vary_with_the_voltage(rng, gain, loss):
    hysteresis, voltage = random_model(rng, 8), wander(rng, 300, 10, 58)
    lower, amplitude, length = float(hysteresis.density.lower_V), 2.0, 20.0
    span = float(hysteresis.density.upper_V) - lower
    effect = BY_NAME["bouc_wen_hysteresis", ""](
        *(hysteresis, amplitude, length / span, 0.8, 1.4, span, 0.0, 0.0), *gain, *loss, lower
    )

    def varied(place):
        return [np.exp(np.polynomial.legendre.legval(place, [0, *some])) for some in (gain, loss)]

    def slope(volt, z, way):
        one, two = varied(2 * (volt - lower) / span - 1)
        return (one - two * abs(z) ** 1.4 * (0.2 + 0.8 * np.sign(z) * way)) / length

    first = varied(np.linspace(-1, 1, 1001))
    states = followed([lower, *voltage], -(np.max(first[0] / first[1]) ** (1 / 1.4)), slope)
    given = through(hysteresis, 1e-3, voltage)
    np.testing.assert_allclose(through(effect, 1e-3, voltage), given - amplitude * states, atol=1e-3 * amplitude)


@pytest.mark.parametrize(("sigma", "exponent", "approach"), [(1.1, 1.4, 1.0), (1.0, 1.0, 1.4), (0.8, 1.8, 1.0)])
def test_steps_of_several_lengths_are_followed_as_well(rng, sigma, exponent, approach):
    """They had been two steps of the rule, off by 4 to 14 % of the part."""
    hysteresis, voltage = random_model(rng, 8), np.repeat(rng.uniform(10, 90, 40), 5)
    amplitude, length = 2.0, 12.0
    given = BY_NAME["bouc_wen_hysteresis", ""](hysteresis, amplitude, length / 80, sigma, exponent, 80.0)
    effect = replace(given, approach=jnp.asarray(approach))

    def slope(_, z, way):
        left = 1 - abs(z) ** exponent * (1 - sigma + sigma * np.sign(z) * way)
        return np.sign(left) * abs(left) ** approach / length

    states = followed([float(hysteresis.density.lower_V), *voltage], -1.0, slope)
    plain = through(hysteresis, 1e-3, voltage)
    np.testing.assert_allclose(through(effect, 1e-3, voltage), plain - amplitude * states, atol=2e-3 * amplitude)


def followed(voltage, first, slope):
    """States at all voltages but the first by adaptive integration along the voltage."""
    states = [first]
    for before, there in pairwise(voltage):
        way = np.sign(there - before)
        found = integrate.solve_ivp(lambda u, z, w=way: slope(u, z, w), (before, there), states[-1:], rtol=1e-9)
        states.append(found.y[0, -1])
    return np.array(states[1:])
