"""Feedforward: the voltage that makes a stage follow a reference (Eq. 19-21)."""

from collections.abc import Callable
from functools import partial
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from fits.control import _compensate_stage as whole
from fits.control._follow import TOLERABLE, Compensation, Doubt, binding, compensate_plain, follow, within_range
from fits.io._errors import DataError
from fits.io._given import AnyRuns, reference_given
from fits.io._record import Record, Reference
from fits.loop._plain import PlainLoop
from fits.loop._surface import Surface
from microid import AbstractEffect, Preisach, Stage

Way = Literal["static", "dynamic"]

# What is cut off a command by less than this fraction of the limits' width does not show.
_WORTH_SAYING = 1e-4


def compensate(
    model: Preisach | Stage,
    reference: AnyRuns,
    initial: str = "negative",
    clip: bool = False,
    limits_V: tuple[float, float] | None = None,
    way: Way = "static",
) -> Compensation:
    """Find the voltage whose displacement is the reference.

    The reference is one or a record, or what `read_reference` takes, as the sensor would read it: the model's
    `offset_um`, its reading at negative saturation, is included. The memory before the first sample is `negative`,
    `positive` or `demagnetised`. With `clip` the nearest that can be reached is taken where the reference is out of
    reach, instead of refusing it. Limits are the lowest and highest voltage allowed; the range the model was fitted
    on by default. For a stage these are commands, and its range is that of its hysteresis over the gain of its
    driver.

    The way `"static"` is by the exact inverse of the hysteresis, with the static gains of a stage; its response then
    lags and rings. `"dynamic"` is by the inverse of the whole stage, for references that are smooth and begin at
    rest; see `microid.invert_stage`. A `DataError` says that the reference cannot be followed, that the limits are
    not within the model's range, or that the model has nothing dynamic to compensate.
    """
    reference = reference_given(reference)
    if reference.displacement_um is None:
        raise DataError(f"{reference.source}: a displacement column is needed here; name it with --columns.")
    wanted, time_s = reference.displacement_um, reference.time_s
    if way not in ("static", "dynamic"):
        raise ValueError(f"way must be 'static' or 'dynamic', got {way!r}")
    if isinstance(model, Preisach):
        if way == "dynamic":
            raise DataError("expected a stage for --dynamic, found a Preisach model, which has no mechanics.")
        return compensate_plain(plain_loop_of(model), reference, initial, clip, limits_V)
    if (plain := whole.plain_of(model)) is not model:
        without = partial(compensate, plain, initial=initial, clip=clip, limits_V=limits_V, way=way)
        return _beside_effects(model, plain, reference, initial, without)
    stage = whole.plain_stage_of(model)
    if way == "static" and stage is not None:
        return compensate_plain(stage, reference, initial, clip, limits_V)
    law = plain_loop_of(whole.static_equivalent(model))
    needed, doubt_um = wanted, 0.0
    if way == "dynamic":
        needed, doubt_um = whole.demand(model, time_s, wanted, reference.source)
    turning, moving = whole.demand_remarks(wanted, needed, doubt_um)
    remarks = turning + moving
    limits = within_range(law.range_V, limits_V)
    doubt = Doubt(doubt_um, *turning) if way == "dynamic" else None
    voltage, clipped = follow(law, reference, needed, initial, clip, limits, doubt)
    if way == "dynamic":
        voltage, cut, more = _led(model, reference, voltage, limits, clip, binding(law, limits))
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
    if excess_V.max() > TOLERABLE * width_V and not clip:
        k = int(np.argmax(excess_V > TOLERABLE * width_V))
        raise DataError(
            f"{reference.source}: sample {k + 1} (time {reference.time_s[k]:g} s) needs a command of "
            f"{asked_V[k]:.6g} V to make up for the driver's lag, but {bind}; slow the reference down, keep it away "
            "from the ends of the range, or cut the command there with --clip."
        )
    cut = excess_V > _WORTH_SAYING * width_V
    said = f"the command was cut to the limits at {int(cut.sum())} of its samples, by at most {excess_V.max():.3g} V."
    return voltage_V, cut, [said] if cut.any() else []


@eqx.filter_jit
def _nodes(model: Preisach) -> tuple[Float[Array, "N N"], Float[Array, " N"]]:
    return model.density.nodes_um_per_V2(), model.reversible.slope_um_per_V


def plain_loop_of(model: Preisach) -> PlainLoop:
    """The same hysteresis in NumPy."""
    density, slope = (np.asarray(values)[..., None] for values in _nodes(model))
    surface = Surface.of(density, slope, float(model.density.lower_V), float(model.density.upper_V))
    return PlainLoop(surface, float(model.offset_um))
