"""Feedforward: the voltage that makes a stage follow a reference (Eq. 19-21)."""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits._errors import DataError
from fits._record import Record, Reference
from fits._run import initial_state, prepare_run, simulate_run
from microid import Inversion, Preisach, Staircase, invert

# References pass through compiled functions in multiples of this many samples.
_PIECE = 8192
# Short of an end of its range by this fraction of it, a reference is still within reach: files round.
_SLACK = 1e-9
# What can be reached depends on the past, so it is found again until it stays; two or three times are usual.
_PASSES = 50


@dataclass(frozen=True)
class Compensation:
    """A voltage for a reference, and what the model does with it.

    Attributes
    ----------
    voltage_V
        Shape `(n,)`, within the limits.
    displacement_um
        Response of the model, sensor offset included, shape `(n,)`.
    reference_um
        What was asked for, shape `(n,)`.
    clipped
        Samples out of reach, where the nearest displacement that can be reached was taken, shape `(n,)`.
    """

    voltage_V: np.ndarray
    displacement_um: np.ndarray
    reference_um: np.ndarray
    clipped: np.ndarray


def compensate(
    model: Preisach,
    reference: Reference | Record,
    initial: str = "negative",
    clip: bool = False,
    limits_V: tuple[float, float] | None = None,
) -> Compensation:
    """Find the voltage whose displacement is the reference, by the exact inverse of the hysteresis.

    Parameters
    ----------
    model
        From a fit or a model file.
    reference
        Displacement wanted, as the sensor would read it: the model's `offset_um`, its reading at negative
        saturation, is included.
    initial
        Memory before the first sample: `negative`, `positive` or `demagnetised`.
    clip
        Take the nearest that can be reached where the reference is out of reach, instead of refusing it.
    limits_V
        Lowest and highest voltage allowed; the range the model was fitted on by default.

    Raises
    ------
    DataError
        If the reference cannot be followed, or the limits are not within the model's range.
    """
    if reference.displacement_um is None:
        raise DataError(f"{reference.source}: a displacement column is needed here; name it with --columns.")
    wanted = reference.displacement_um
    lower, upper = float(model.density.lower_V), float(model.density.upper_V)
    limits = within_range(model, limits_V)
    start = initial_state(initial, lower, upper)
    voltage, lowest, highest = _follow(model, wanted, start, limits)
    slack = _SLACK * float(np.max(highest) - np.min(lowest))
    clipped = (wanted < lowest - slack) | (wanted > highest + slack)
    if clipped.any() and not clip:
        k = int(np.argmax(clipped))
        bind = (
            f"the model was fitted between {lower:g} and {upper:g} V"
            if limits == (lower, upper)
            else (f"the voltage is limited to {limits[0]:g} to {limits[1]:g} V")
        )
        raise DataError(
            f"{reference.source}: sample {k + 1} (time {reference.time_s[k]:g} s) asks for {wanted[k]:.6g} um, but "
            f"{lowest[k]:.6g} to {highest[k]:.6g} um can be reached there, sensor offset included, because {bind}; "
            f"{int(clipped.sum())} of {len(wanted)} samples are out of reach: shift or shrink the reference, or take "
            "the nearest that can be reached with --clip."
        )
    run = prepare_run(Record(reference.time_s, voltage, None, source=reference.source), lower, upper, initial, 1.0)
    return Compensation(voltage, simulate_run(model, run), wanted, clipped)


def within_range(model: Preisach, limits_V: tuple[float, float] | None) -> tuple[float, float]:
    """Check voltage limits against the range of the model, which they are by default."""
    lower, upper = float(model.density.lower_V), float(model.density.upper_V)
    if limits_V is None:
        return lower, upper
    low, high = map(float, limits_V)
    if not lower <= low < high <= upper:
        raise DataError(
            f"--limits: expected two rising voltages between {lower:g} and {upper:g} V, where the model was fitted, "
            f"found {low:g},{high:g}."
        )
    return low, high


def _follow(
    model: Preisach, wanted_um: np.ndarray, start: Staircase, limits: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Voltage within the limits, and what could have been reached at every sample."""
    n = len(wanted_um)
    padded = np.pad(wanted_um, (0, -n % _PIECE), mode="edge")
    found = _invert(model, jnp.asarray(padded), start)
    lowest, highest = (np.full(n, float(end)) for end in (found.lowest_um, found.highest_um))
    voltage = np.asarray(found.voltage_V)[:n]
    if limits == (float(model.density.lower_V), float(model.density.upper_V)):
        return voltage, lowest, highest
    tip = float(start.extremes_V[int(start.count) - 1])
    # Each pass makes at least one more sample right, since what can be reached depends on earlier ones only.
    for _ in range(_PASSES):
        before = voltage = np.clip(voltage, *limits)
        lowest = _reach(model, np.maximum.accumulate(_earlier(voltage, tip)), limits[0], start)
        highest = _reach(model, np.minimum.accumulate(_earlier(voltage, tip)), limits[1], start)
        padded[:n] = np.clip(wanted_um, lowest, highest)
        padded[n:] = padded[n - 1]
        voltage = np.clip(np.asarray(_invert(model, jnp.asarray(padded), start).voltage_V)[:n], *limits)
        # To the last digit, which the root leaves open.
        voltage = np.where(wanted_um >= highest, limits[1], np.where(wanted_um <= lowest, limits[0], voltage))
        if np.allclose(voltage, before, rtol=0, atol=_SLACK * (limits[1] - limits[0])):
            return voltage, lowest, highest
    raise DataError("the reference keeps crossing what the voltage limits allow; widen --limits or shrink it.")


def _earlier(voltage_V: np.ndarray, tip_V: float) -> np.ndarray:
    return np.append(tip_V, voltage_V[:-1])


def _reach(model: Preisach, extremes_V: np.ndarray, limit_V: float, start: Staircase) -> np.ndarray:
    """Displacement at a voltage limit, after each of the running extremes on the other side.

    Going to a limit wipes out all that happened within the limits. What remains is what the start remembers beyond
    them, and how far away from this limit the voltage has been since.
    """
    n = len(extremes_V)
    path = np.stack([extremes_V, np.full(n, limit_V)], axis=1).ravel()
    path = np.pad(path, (0, -2 * n % (2 * _PIECE)), mode="edge")
    return np.asarray(_respond(model, jnp.asarray(path), start))[1 : 2 * n : 2]


@eqx.filter_jit
def _invert(model: Preisach, displacement_um: Float[Array, " n"], start: Staircase) -> Inversion:
    return invert(model, displacement_um, start)


@eqx.filter_jit
def _respond(model: Preisach, voltage_V: Float[Array, " n"], start: Staircase) -> Float[Array, " n"]:
    return model(voltage_V, start)
