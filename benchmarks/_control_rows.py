"""Rows for closed loops: many gains at once, against a loop in NumPy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _timing import Table, side_by_side
from scipy.linalg import expm

from microid import Driver, Mechanics, Piezo, Stage
from microid.control import PID, simulate_loop

_TIME_CONSTANT_s, _NATURAL_Hz, _DAMPING, _GAIN = 8e-4, 420.0, 0.1, 0.12
_INTERVAL_s = 1e-4
# NumPy takes one gain set after the other, or all of them as rows, step by step; so many steps are timed.
_TIMED = 2000


@eqx.filter_jit
def _errors(gains: jax.Array, reference_um: jax.Array) -> jax.Array:
    stage = Stage.of(driver=Driver(_TIME_CONSTANT_s), piezo=Piezo(_GAIN), mechanics=Mechanics(_NATURAL_Hz, _DAMPING))

    def one(gain: jax.Array) -> jax.Array:
        run = simulate_loop(PID(*gain, _INTERVAL_s, lower_V=-20.0, upper_V=150.0), stage, reference_um)
        return jnp.sqrt(jnp.mean(run.error_um**2))

    return jax.vmap(one)(gains)


def _sampled() -> tuple[np.ndarray, np.ndarray]:
    rate = 2 * np.pi * _NATURAL_Hz
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = [[-1 / _TIME_CONSTANT_s, 0, 0], [0, 0, rate], [rate, -rate, -2 * _DAMPING * rate]]
    matrix[0, 3] = 1 / _TIME_CONSTANT_s
    whole = expm(matrix * _INTERVAL_s)
    return whole[:3, :3], whole[:3, 3]


def _one_by_numpy(gain: np.ndarray, reference_um: np.ndarray) -> float:
    """One loop in the way it is usually written."""
    step, push = _sampled()
    kp, ki, kd = gain
    x, total, before, square = np.zeros(3), 0.0, 0.0, 0.0
    for wanted in reference_um:
        error = wanted - _GAIN * x[1]
        total += ki * _INTERVAL_s * error
        asked = kp * error + total + kd * (error - before) / _INTERVAL_s
        command = min(max(asked, -20.0), 150.0)
        total, before = total + command - asked, error
        x = step @ x + push * command
        square += error**2
    return float(np.sqrt(square / len(reference_um)))


def _all_by_numpy(gains: np.ndarray, reference_um: np.ndarray) -> np.ndarray:
    """All loops at once, as arrays over the gains."""
    step, push = _sampled()
    kp, ki, kd = gains.T
    x, total, before, square = np.zeros((3, len(gains))), np.zeros(len(gains)), np.zeros(len(gains)), 0.0
    for wanted in reference_um:
        error = wanted - _GAIN * x[1]
        total = total + ki * _INTERVAL_s * error
        asked = kp * error + total + kd * (error - before) / _INTERVAL_s
        command = np.clip(asked, -20.0, 150.0)
        total, before = total + command - asked, error
        x = step @ x + push[:, None] * command
        square = square + error**2
    return np.sqrt(square / len(reference_um))


def control(steps: int, sets: int, repeats: int, seed: int, table: Table) -> None:
    """Close a loop for many sets of gains."""
    rng = np.random.default_rng(seed)
    gains = rng.uniform([0.05, 50, 1e-5], [0.5, 500, 1e-4], (sets, 3))
    reference = 3 + np.sin(2 * np.pi * 20 * _INTERVAL_s * np.arange(steps))
    short = reference[:_TIMED]
    ours = np.asarray(_errors(jnp.asarray(gains), jnp.asarray(short)))
    off = float(np.max(np.abs(ours / _all_by_numpy(gains, short) - 1)))
    assert abs(_one_by_numpy(gains[0], short) / ours[0] - 1) < 1e-6
    taken = side_by_side(
        {
            "ours": lambda: _errors(jnp.asarray(gains), jnp.asarray(reference)),
            "one": lambda: _one_by_numpy(gains[0], short),
            "all": lambda: _all_by_numpy(gains, short),
        },
        repeats,
    )
    case = f"closed loop, {steps:.0e} steps, {sets} gain sets"
    # What NumPy takes goes with steps, and one loop after the other with sets.
    alone, together = ([value * factor for value in taken[name]] for name, factor in (
        ("one", sets * steps / _TIMED), ("all", steps / _TIMED)
    ))  # fmt: skip
    note = f"{off:.1g} off; from {_TIMED} steps"
    table.ratio(f"{case}, over NumPy, one set after the other", "(100x)", alone, taken["ours"], note=note)
    table.ratio(f"{case}, over NumPy, all sets as arrays", "", together, taken["ours"])
