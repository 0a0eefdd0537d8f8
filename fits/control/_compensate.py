"""Feedforward: the voltage that makes a stage follow a reference (Eq. 19-21)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from fits.control import _compensate_stage as whole
from fits.io._errors import DataError
from fits.io._record import Record, Reference
from fits.loop._run import initial_state
from microid import AbstractEffect, Preisach, Stage, Staircase, invert

Way = Literal["static", "dynamic"]

# References pass through compiled functions in multiples of this many samples.
_PIECE = 8192
# Short of an end of its range by this fraction of it, a reference is still within reach: files round.
_SLACK = 1e-9
# What can be reached depends on the past, so it is found again until it stays; two or three times are usual.
_PASSES = 50
# At an end of the range what a stage needs may overshoot by this fraction of it, and is cut, before that is refused.
_TOLERABLE = 0.01
# What is cut off a command by less than this fraction of the limits' width does not show.
_WORTH_SAYING = 1e-4


@dataclass(frozen=True)
class Compensation:
    """A voltage for a reference, and what the model does with it; all arrays have the shape `(n,)`.

    The voltage is within the limits, and the displacement the response of the whole model, sensor offset included.
    Where samples are `clipped`, out of reach, the nearest voltage or displacement that can be reached was taken.
    Remarks are what keeps a stage from following, one sentence each.
    """

    voltage_V: np.ndarray
    displacement_um: np.ndarray
    reference_um: np.ndarray
    clipped: np.ndarray
    remarks: tuple[str, ...] = ()


def compensate(
    model: Preisach | Stage,
    reference: Reference | Record,
    initial: str = "negative",
    clip: bool = False,
    limits_V: tuple[float, float] | None = None,
    way: Way = "static",
) -> Compensation:
    """Find the voltage whose displacement is the reference.

    The reference is as the sensor would read it: the model's `offset_um`, its reading at negative saturation, is
    included. The memory before the first sample is `negative`, `positive` or `demagnetised`. With `clip` the nearest
    that can be reached is taken where the reference is out of reach, instead of refusing it. Limits are the lowest
    and highest voltage allowed; the range the model was fitted on by default. For a stage these are commands, and its
    range is that of its hysteresis over the gain of its driver.

    The way `"static"` is by the exact inverse of the hysteresis, with the static gains of a stage; its response then
    lags and rings. `"dynamic"` is by the inverse of the whole stage, for references that are smooth and begin at
    rest; see `microid.invert_stage`. A `DataError` says that the reference cannot be followed, that the limits are
    not within the model's range, or that the model has nothing dynamic to compensate.
    """
    if reference.displacement_um is None:
        raise DataError(f"{reference.source}: a displacement column is needed here; name it with --columns.")
    wanted, time_s = reference.displacement_um, reference.time_s
    if isinstance(model, Stage) and (plain := whole.plain_of(model)) is not model:
        without = partial(compensate, plain, initial=initial, clip=clip, limits_V=limits_V, way=way)
        return _beside_effects(model, plain, reference, initial, without)
    law = whole.static_equivalent(model)
    needed, doubt_um = wanted, 0.0
    if way == "dynamic":
        if not isinstance(model, Stage):
            raise DataError("expected a stage for --dynamic, found a Preisach model, which has no mechanics.")
        needed, doubt_um = whole.demand(model, time_s, wanted, reference.source)
    elif way != "static":
        raise ValueError(f"way must be 'static' or 'dynamic', got {way!r}")
    turning, moving = whole.demand_remarks(wanted, needed, doubt_um)
    remarks = turning + moving
    lower, upper = float(law.density.lower_V), float(law.density.upper_V)
    limits = within_range(law, limits_V)
    bind = f"the voltage is limited to {limits[0]:g} to {limits[1]:g} V"
    if limits == (lower, upper):
        bind = f"the model was fitted between {lower:g} and {upper:g} V"
    voltage, lowest, highest = _follow(law, needed, initial_state(initial, lower, upper), limits)
    # Less than it is uncertain by is not out of reach: splines swing a little where a reference leaves an end.
    stroke = float(np.max(highest) - np.min(lowest))
    slack = max(_SLACK * stroke, min(doubt_um, _TOLERABLE * stroke))
    clipped = (needed < lowest - slack) | (needed > highest + slack)
    if clipped.any() and not clip:
        k = int(np.argmax(clipped))
        asked = f"asks for {wanted[k]:.6g} um"
        if way == "dynamic":
            asked += f", which takes {needed[k]:.6g} um of the piezo in the sensor's units"
        if turning and lowest[k] <= wanted[k] <= highest[k]:
            raise DataError(f"{reference.source}: sample {k + 1} (time {time_s[k]:g} s) {asked}, but {turning[0]}")
        raise DataError(
            f"{reference.source}: sample {k + 1} (time {time_s[k]:g} s) {asked}, but "
            f"{lowest[k]:.6g} to {highest[k]:.6g} um can be reached there, sensor offset included, because {bind}; "
            f"{int(clipped.sum())} of {len(wanted)} samples are out of reach: shift or shrink the reference,"
            f"{' slow it down,' if way == 'dynamic' else ''} or take the nearest that can be reached with --clip."
        )
    if isinstance(model, Stage) and way == "dynamic":
        voltage, cut, more = _led(model, reference, voltage, limits, clip, bind)
        clipped, remarks = clipped | cut, remarks + more
    played = whole.simulate_model(model, Record(time_s, voltage, None, source=reference.source), initial)
    return Compensation(voltage, played, wanted, clipped, tuple(remarks))


def _beside_effects(
    stage: Stage, plain: Stage, reference: Reference | Record, initial: str, invert: Callable[..., Compensation]
) -> Compensation:
    """Invert a stage with effects by fixed-point iteration with the inverse of the plain stage, which has none."""
    needs = sorted({name for part in stage.parts if isinstance(part, AbstractEffect) for name in part.needs})
    if needs:
        raise DataError(
            f"the model depends on {', '.join(needs)}, which a reference does not tell; use baseline.json.",
            of_model=True,
        )
    time_s, wanted = reference.time_s, np.asarray(reference.displacement_um)
    asked, before = wanted, np.inf
    # Each round reduces the error to a few percent of what it was.
    for _ in range(12):
        found = invert(Reference(time_s, asked, reference.source))
        program = Record(time_s, found.voltage_V, None, source=reference.source)
        played = whole.simulate_model(stage, program, initial)
        change = played - whole.simulate_model(plain, program, initial)
        moved = float(np.max(np.abs(wanted - change - asked)))
        if moved <= 1e-9 * float(np.ptp(wanted)) or moved > 0.9 * before:
            break
        asked, before = wanted - change, moved
    return Compensation(found.voltage_V, played, wanted, found.clipped, found.remarks)


def _led(
    stage: Stage,
    reference: Reference | Record,
    static_V: np.ndarray,
    limits: tuple[float, float],
    clip: bool,
    bind: str,
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Compensate the driver's lag within the limits: the command, which samples were cut, and remarks on that."""
    asked_V = whole.command(stage, reference.time_s, static_V)
    if stage.hold == "zero":
        # A step stands for the line across its interval.
        asked_V = np.append((asked_V[:-1] + asked_V[1:]) / 2, asked_V[-1])
    voltage_V = np.clip(asked_V, *limits)
    excess_V, width_V = np.abs(asked_V - voltage_V), limits[1] - limits[0]
    if excess_V.max() > _TOLERABLE * width_V and not clip:
        k = int(np.argmax(excess_V > _TOLERABLE * width_V))
        raise DataError(
            f"{reference.source}: sample {k + 1} (time {reference.time_s[k]:g} s) needs a command of "
            f"{asked_V[k]:.6g} V to make up for the driver's lag, but {bind}; slow the reference down, keep it away "
            "from the ends of the range, or cut the command there with --clip."
        )
    cut = excess_V > _WORTH_SAYING * width_V
    said = f"the command was cut to the limits at {int(cut.sum())} of its samples, by at most {excess_V.max():.3g} V."
    return voltage_V, cut, [said] if cut.any() else []


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
        earlier = np.append(tip, voltage[:-1])
        lowest = _reach(model, np.maximum.accumulate(earlier), limits[0], start)
        highest = _reach(model, np.minimum.accumulate(earlier), limits[1], start)
        padded[:n] = np.clip(wanted_um, lowest, highest)
        padded[n:] = padded[n - 1]
        voltage = np.clip(np.asarray(_invert(model, jnp.asarray(padded), start).voltage_V)[:n], *limits)
        # To the last digit, which the root leaves open.
        voltage = np.where(wanted_um >= highest, limits[1], np.where(wanted_um <= lowest, limits[0], voltage))
        if np.allclose(voltage, before, rtol=0, atol=_SLACK * (limits[1] - limits[0])):
            return voltage, lowest, highest
    raise DataError("the reference keeps crossing what the voltage limits allow; widen --limits or shrink it.")


def _reach(model: Preisach, extremes_V: np.ndarray, limit_V: float, start: Staircase) -> np.ndarray:
    """Displacement at a voltage limit, after each of the running extremes on the other side.

    Going to a limit wipes out all that happened within the limits. What remains is what the start remembers beyond
    them, and how far away from this limit the voltage has been since.
    """
    n = len(extremes_V)
    path = np.stack([extremes_V, np.full(n, limit_V)], axis=1).ravel()
    path = np.pad(path, (0, -2 * n % (2 * _PIECE)), mode="edge")
    return np.asarray(_respond(model, jnp.asarray(path), start))[1 : 2 * n : 2]


_invert = eqx.filter_jit(invert)
_respond = eqx.filter_jit(lambda model, voltage_V, start: model(voltage_V, start))
