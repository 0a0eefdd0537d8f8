"""Rows for the linear plant: simulation against SciPy's, and its derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _timing import Table, side_by_side
from scipy.signal import StateSpace, lsim

from microid import Driver, Mechanics, Piezo, Stage

_TIME_CONSTANT_s, _NATURAL_Hz, _DAMPING, _GAIN = 8e-4, 420.0, 0.035, 0.12
# Dyadic, so that multiples of it and their differences are exact, and both sides see the same times.
_INTERVAL_s = 2.0**-13


def _stage(parameters: jax.Array) -> Stage:
    time_constant_s, natural_Hz, damping, gain = parameters
    return Stage.of(driver=Driver(time_constant_s), piezo=Piezo(gain), mechanics=Mechanics(natural_Hz, damping))


@eqx.filter_jit
def _simulate(parameters: jax.Array, time_s: jax.Array, voltage_V: jax.Array) -> jax.Array:
    return _stage(parameters)(time_s, voltage_V)


@eqx.filter_jit
def _jacobian(parameters: jax.Array, time_s: jax.Array, voltage_V: jax.Array) -> jax.Array:
    return jax.jacfwd(_simulate)(parameters, time_s, voltage_V)


@eqx.filter_jit
def _gradient(parameters: jax.Array, time_s: jax.Array, voltage_V: jax.Array) -> jax.Array:
    return jax.grad(lambda p: jnp.sum(_simulate(p, time_s, voltage_V) ** 2))(parameters)


def _peer() -> StateSpace:
    rate = 2 * np.pi * _NATURAL_Hz
    matrix = np.array([[-1 / _TIME_CONSTANT_s, 0, 0], [0, 0, rate], [rate, -rate, -2 * _DAMPING * rate]])
    drive, read = np.array([[1 / _TIME_CONSTANT_s], [0], [0]]), np.array([[0, _GAIN, 0]])
    return StateSpace(matrix, drive, read, np.zeros((1, 1)))


def plant(samples: int, repeats: int, seed: int, table: Table) -> None:
    """Simulate a driver and mechanics under lines between samples, and differentiate in its four parameters."""
    rng = np.random.default_rng(seed)
    held_V = np.append(0.0, np.repeat(rng.uniform(0, 100, samples // 10), 10)[: samples - 1])
    parameters = jnp.array([_TIME_CONSTANT_s, _NATURAL_Hz, _DAMPING, _GAIN])
    interval, voltage_V = jnp.asarray(_INTERVAL_s), jnp.asarray(held_V)
    even_s = np.arange(samples) * _INTERVAL_s
    even, uneven = jnp.asarray(even_s), jnp.asarray(even_s + rng.uniform(-0.3, 0.3, samples) * _INTERVAL_s)
    peer = _peer()
    expected_um = lsim(peer, held_V, even_s)[1]
    off = float(np.max(np.abs(_simulate(parameters, interval, voltage_V) - expected_um)) / np.ptp(expected_um))
    taken = side_by_side(
        {
            "interval": lambda: _simulate(parameters, interval, voltage_V),
            "even": lambda: _simulate(parameters, even, voltage_V),
            "uneven": lambda: _simulate(parameters, uneven, voltage_V),
            "lsim": lambda: lsim(peer, held_V, even_s)[1],
            "jacobian": lambda: _jacobian(parameters, interval, voltage_V),
            "gradient": lambda: _gradient(parameters, interval, voltage_V),
            "jacobian of even": lambda: _jacobian(parameters, even, voltage_V),
            "jacobian of uneven": lambda: _jacobian(parameters, uneven, voltage_V),
        },
        repeats,
    )
    case = f"plant, T = {samples:.0e}"
    note = f"{off:.1g} of the range from lsim"
    table.ratio(f"{case}, one interval, over lsim", "10x (50x)", taken["lsim"], taken["interval"], note=note)
    table.ratio(f"{case}, even times, over lsim", "10x (50x)", taken["lsim"], taken["even"])
    table.ratio(f"{case}, uneven times, over lsim of even ones", "", taken["lsim"], taken["uneven"])
    slower = {
        "Jacobian over simulation, one interval": ("<= 6x (4x)", "interval", "jacobian"),
        "gradient over simulation, one interval": ("", "interval", "gradient"),
        "Jacobian over simulation, even times": ("", "even", "jacobian of even"),
        "Jacobian over simulation, uneven times": ("", "uneven", "jacobian of uneven"),
    }
    for what, (wanted, once, often) in slower.items():
        table.ratio(f"{case}, {what}", wanted, taken[once], taken[often], inverse=True)
