"""What a hysteresis can follow of a reference, and the voltage for it, without JAX."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from fits.io._errors import DataError
from fits.io._record import Record, Reference
from fits.loop._plain import PlainLoop, PlainModel, extremes_V

# Short of an end of its range by this fraction of it, a reference is still within reach: files round.
_SLACK = 1e-9
# What can be reached depends on the past, so it is found again until it stays; two or three times are usual.
_PASSES = 50
# At an end of the range what a stage needs may overshoot by this fraction of it, and is cut, before that is refused.
TOLERABLE = 0.01


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


@dataclass(frozen=True)
class Doubt:
    """By how much it is doubtful what is needed to follow a reference, and why, where that is worth saying."""

    by_um: float
    turning: str = ""


def follow(
    law: PlainLoop,
    reference: Reference | Record,
    needed_um: np.ndarray,
    initial: str,
    clip: bool,
    limits: tuple[float, float],
    doubt: Doubt | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the voltage for what is needed to follow a reference, and where it is clipped, shape `(n,)` each.

    See `compensate`. There is a doubt where what is needed is not the reference itself.
    """
    wanted, time_s = np.asarray(reference.displacement_um), reference.time_s
    voltage, lowest, highest = _within(law, needed_um, initial, limits)
    # Less than it is uncertain by is not out of reach: splines swing a little where a reference leaves an end.
    stroke = float(np.max(highest) - np.min(lowest))
    slack = max(_SLACK * stroke, min(doubt.by_um, TOLERABLE * stroke) if doubt else 0.0)
    clipped = (needed_um < lowest - slack) | (needed_um > highest + slack)
    if clipped.any() and not clip:
        k = int(np.argmax(clipped))
        asked = f"asks for {wanted[k]:.6g} um"
        if doubt:
            asked += f", which takes {needed_um[k]:.6g} um of the piezo in the sensor's units"
        if doubt and doubt.turning and lowest[k] <= wanted[k] <= highest[k]:
            raise DataError(f"{reference.source}: sample {k + 1} (time {time_s[k]:g} s) {asked}, but {doubt.turning}")
        raise DataError(
            f"{reference.source}: sample {k + 1} (time {time_s[k]:g} s) {asked}, but "
            f"{lowest[k]:.6g} to {highest[k]:.6g} um can be reached there, sensor offset included, because "
            f"{binding(law, limits)}; {int(clipped.sum())} of {len(wanted)} samples are out of reach: shift or "
            f"shrink the reference,{' slow it down,' if doubt else ''} "
            "or have it clipped to the nearest that can be reached (clip=True)."
        )
    return voltage, clipped


def binding(law: PlainLoop, limits: tuple[float, float]) -> str:
    """Say which limits they are."""
    low, high = limits
    if limits == law.range_V:
        return f"the model was fitted between {low:g} and {high:g} V"
    return f"the voltage is limited to {low:g} to {high:g} V"


def compensate_plain(
    model: PlainModel, reference: Reference | Record, initial: str, clip: bool, limits_V: tuple[float, float] | None
) -> Compensation:
    """Find the voltage whose displacement by the hysteresis of a model is the reference; see `compensate`."""
    if (plain := model.without_effects) is not model:
        without = partial(compensate_plain, plain, initial=initial, clip=clip, limits_V=limits_V)
        return beside_effects(reference, without, lambda program: model.play(program, initial))
    law, wanted = model.static, np.asarray(reference.displacement_um)
    voltage, clipped = follow(law, reference, wanted, initial, clip, within_range(law.range_V, limits_V))
    program = Record(reference.time_s, voltage, None, source=reference.source)
    return Compensation(voltage, model.play(program, initial), wanted, clipped)


def beside_effects(
    reference: Reference | Record,
    invert: Callable[[Reference], Compensation],
    play: Callable[[Record], np.ndarray],
) -> Compensation:
    """Invert a stage with effects, which `play` simulates, by iteration with the inverse of the plain stage."""
    time_s, wanted = reference.time_s, np.asarray(reference.displacement_um)
    asked, before = wanted, np.inf
    # Each round reduces the error to a few percent of what it was.
    for k in range(12):
        # What is asked of the plain stage is another displacement than the reference.
        source = f"{reference.source}, less what the effects of the model add" if k else reference.source
        found = invert(Reference(time_s, asked, source))
        played = play(Record(time_s, found.voltage_V, None, source=reference.source))
        change = played - found.displacement_um
        moved = float(np.max(np.abs(wanted - change - asked)))
        if moved <= 1e-9 * float(np.ptp(wanted)) or moved > 0.9 * before:
            break
        asked, before = wanted - change, moved
    return Compensation(found.voltage_V, played, wanted, found.clipped, found.remarks)


def within_range(range_V: tuple[float, float], limits_V: tuple[float, float] | None) -> tuple[float, float]:
    """Check voltage limits against the range of the model, which they are by default."""
    lower, upper = range_V
    if limits_V is None:
        return lower, upper
    low, high = map(float, limits_V)
    if not lower <= low < high <= upper:
        raise DataError(
            f"voltage limits: expected two rising ones between {lower:g} and {upper:g} V, where the model was "
            f"fitted, found {low:g},{high:g}."
        )
    return low, high


def _within(
    law: PlainLoop, wanted_um: np.ndarray, initial: str, limits: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Voltage within the limits, and what could have been reached at every sample."""
    n = len(wanted_um)
    voltage, *ends = law.invert(wanted_um, initial)
    lowest, highest = (np.full(n, end) for end in ends)
    if limits == law.range_V:
        return voltage, lowest, highest
    tip = extremes_V(initial, *law.range_V)[-1]
    # Each pass makes at least one more sample right, since what can be reached depends on earlier ones only.
    for _ in range(_PASSES):
        before = voltage = np.clip(voltage, *limits)
        earlier = np.append(tip, voltage[:-1])
        lowest = _reach(law, np.maximum.accumulate(earlier), limits[0], initial)
        highest = _reach(law, np.minimum.accumulate(earlier), limits[1], initial)
        voltage = np.clip(law.invert(np.clip(wanted_um, lowest, highest), initial)[0], *limits)
        # To the last digit, which the root leaves open.
        voltage = np.where(wanted_um >= highest, limits[1], np.where(wanted_um <= lowest, limits[0], voltage))
        if np.allclose(voltage, before, rtol=0, atol=_SLACK * (limits[1] - limits[0])):
            return voltage, lowest, highest
    raise DataError("the reference keeps crossing what the voltage limits allow; widen them or shrink it.")


def _reach(law: PlainLoop, reached_V: np.ndarray, limit_V: float, initial: str) -> np.ndarray:
    """Displacement at a voltage limit, after each of the running extremes on the other side.

    Going to a limit wipes out all that happened within the limits. What remains is what the start remembers beyond
    them, and how far away from this limit the voltage has been since.
    """
    path = np.stack([reached_V, np.full(len(reached_V), limit_V)], axis=1).ravel()
    return law.respond(path, initial)[1::2]
