"""Feedforward: the voltage that makes a stage follow a reference (Eq. 19-21)."""

from functools import partial
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import microid
from fits.control._follow import (
    TOLERABLE,
    Compensation,
    Doubt,
    beside_effects,
    binding,
    compensate_plain,
    follow,
    within_range,
)
from fits.io._errors import DataError
from fits.io._given import AnyRuns, reference_given
from fits.io._kept import kept
from fits.io._length import length
from fits.io._record import Record, Reference
from fits.loop._plain import PlainLoop, PlainModel
from fits.loop._run import initial_state, prepare_run, simulate_run
from fits.loop._stepped import intervals
from fits.loop._surface import Surface
from fits.stage._encode import encode
from fits.stage._model_file import AnyModel, model_given
from fits.stage._plain_stage import plain_model
from microid import AbstractLinear, Preisach, Reversible, Stage, Start, innermost
from microid.densities import GridDensity
from microid.effects import AbstractEffect

Way = Literal["static", "dynamic"]

# What is cut off a command by less than this fraction of the limits' width does not show.
_SHOWS = 1e-4
# Doubt about the displacement needed, or a start in motion, that is worth a remark: a fraction of the span.
_WORTH_SAYING = 0.01
_FEWEST = 16


def compensate(
    model: AnyModel,
    reference: AnyRuns,
    initial: str = "negative",
    clip: bool = False,
    limits_V: tuple[float, float] | None = None,
    way: Way = "static",
) -> Compensation:
    """Find the voltage whose displacement is the reference.

    The model is a `Preisach` or a `Stage`, a fit or a model file of one, or the name of such a file. The reference is
    one or a record, or what `read_reference` takes, as the sensor would read it: the model's
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
    model, _ = model_given(model)
    reference = reference_given(reference)
    if reference.displacement_um is None:
        raise DataError(f"{reference.source}: a displacement column is needed here; give one.")
    wanted, time_s = reference.displacement_um, reference.time_s
    if way not in ("static", "dynamic"):
        raise ValueError(f"way must be 'static' or 'dynamic', got {way!r}")
    if isinstance(model, Preisach):
        if way == "dynamic":
            raise DataError("expected a stage to compensate dynamically, found a hysteresis without mechanics.")
        return compensate_plain(plain_loop_of(model), reference, initial, clip, limits_V)
    stage = plain_stage_of(model)
    if way == "static" and stage is not None:
        return compensate_plain(stage, reference, initial, clip, limits_V)
    if (plain := plain_of(model)) is not model:
        _refuse_needs(model)
        without = partial(compensate, plain, initial=initial, clip=clip, limits_V=limits_V, way=way)
        return beside_effects(reference, without, lambda program: simulate_model(model, program, initial))
    law = plain_loop_of(static_equivalent(model))
    needed, doubt_um = wanted, 0.0
    if way == "dynamic":
        needed, doubt_um = demand(model, time_s, wanted, reference.source)
    turning, moving = demand_remarks(wanted, needed, doubt_um)
    remarks = turning + moving
    limits = within_range(law.range_V, limits_V)
    doubt = Doubt(doubt_um, *turning) if way == "dynamic" else None
    voltage, clipped = follow(law, reference, needed, initial, clip, limits, doubt)
    if way == "dynamic":
        voltage, cut, more = _led(model, reference, voltage, limits, clip, binding(law, limits))
        clipped, remarks = clipped | cut, remarks + more
    played = simulate_model(model, Record(time_s, voltage, None, source=reference.source), initial)
    return Compensation(voltage, played, wanted, clipped, tuple(remarks))


def _refuse_needs(stage: Stage) -> None:
    """Refuse, in a `DataError`, a stage whose effects depend on more than the command."""
    needs = sorted({name for part in stage.parts if isinstance(part, AbstractEffect) for name in part.needs})
    if needs:
        raise DataError(
            f"the model depends on {', '.join(needs)}, which a reference does not tell; use baseline.json.",
            of_model=True,
        )


def _led(
    stage: Stage,
    reference: Reference | Record,
    static_V: np.ndarray,
    limits: tuple[float, float],
    clip: bool,
    bind: str,
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Compensate the driver's lag within the limits: the command, which samples were cut, and remarks on that."""
    piezo_V = jnp.asarray(gains_of(stage)[0] * static_V)
    asked_V = np.asarray(_command(stage, jnp.asarray(reference.time_s), piezo_V))
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
            "from the ends of the range, or have it clipped to the nearest that can be reached (clip=True)."
        )
    cut = excess_V > _SHOWS * width_V
    said = f"the command was cut to the limits at {int(cut.sum())} of its samples, by at most {excess_V.max():.3g} V."
    return voltage_V, cut, [said] if cut.any() else []


@kept
def _nodes(model: Preisach) -> tuple[Float[Array, "N N"], Float[Array, " N"]]:
    return model.density.nodes_um_per_V2(), model.reversible.slope_um_per_V


def plain_loop_of(model: Preisach) -> PlainLoop:
    """The same hysteresis in NumPy."""
    density, slope = (np.asarray(values)[..., None] for values in _nodes(model))
    surface = Surface.of(density, slope, float(model.density.lower_V), float(model.density.upper_V))
    return PlainLoop(surface, float(model.offset_um))


def plain_of(stage: Stage) -> Stage:
    """The same stage without effects of `microid.effects.EFFECTS`; itself where it has none."""
    if not any(isinstance(part, AbstractEffect) for part in stage.parts):
        return stage
    parts = {
        name: innermost(part)
        for name, part in zip(stage.names, stage.parts, strict=True)
        if not isinstance(part, AbstractEffect) or hasattr(part, "inner")
    }
    return Stage(tuple(parts.values()), tuple(parts), stage.hold, stage.substeps)


def hysteresis_of(stage: Stage) -> Preisach:
    """Find the one Preisach hysteresis of a stage."""
    for part in stage.parts:
        if isinstance(innermost(part), Preisach):
            return innermost(part)
    parts = ", ".join(f"{n} ({type(p).__name__})" for n, p in zip(stage.names, stage.parts, strict=True))
    raise DataError(
        f"expected a stage with a Preisach hysteresis, found {parts}; fit one with a hysteresis.", of_model=True
    )


def gains_of(stage: Stage) -> tuple[float, float, float]:
    """Static gains of a stage ahead of its hysteresis and behind it, and the reading where the piezo's is zero."""
    law = stage.parts.index(hysteresis_of(stage))
    ahead, behind, offset = 1.0, 1.0, 0.0
    for k, part in enumerate(stage.parts):
        if not isinstance(part, AbstractLinear):
            continue
        gain, own = map(float, _at_rest(part))
        if not (np.isfinite(gain) and gain > 0):
            raise DataError(
                f"part {stage.names[k]!r} of the stage: expected a positive static gain, found {gain:g}; turn the "
                "sign of the column of its signal, and fit again.",
                of_model=True,
            )
        if k < law:
            ahead *= gain
        else:
            behind, offset = behind * gain, gain * offset + own
    return ahead, behind, offset


@kept
def _at_rest(part: AbstractLinear) -> tuple[Float[Array, ""], Float[Array, ""]]:
    return part.static_gain, part.system().offset


def plain_stage_of(stage: Stage) -> PlainModel | None:
    """The same stage in NumPy, without its uncertainty; None where that has no form for one of its parts."""
    try:
        return plain_model({"model": encode(stage), "uncertainty": None, "fit": {}})
    except DataError:
        return None


def static_equivalent(model: Preisach | Stage) -> Preisach:
    """Return the hysteresis between command and sensor, as slow commands see it: the static gains folded in.

    A `DataError` refuses a stage without a Preisach hysteresis, or with a static gain that is not positive.
    """
    if isinstance(model, Preisach):
        return model
    stage = plain_of(model)
    return _folded(hysteresis_of(stage), *map(jnp.asarray, gains_of(stage)))


# As one program: one operation after the other they would be compiled each by itself.
@kept
def _folded(
    law: Preisach, ahead: Float[Array, ""], behind: Float[Array, ""], offset_um: Float[Array, ""]
) -> Preisach:
    lower, upper = law.density.lower_V / ahead, law.density.upper_V / ahead
    weights = law.weights_um[np.tril_indices(law.density.levels)]
    return Preisach(
        GridDensity(behind * weights, lower, upper),
        Reversible(behind * ahead * law.reversible.slope_um_per_V, lower, upper),
        offset_um + behind * law.offset_um,
    )


def demand(stage: Stage, time_s: np.ndarray, reference_um: np.ndarray, source: str) -> tuple[np.ndarray, float]:
    """Find what the sensor would have to read at rest for the mechanics to follow a reference, and how sure that is.

    The displacement in um has the shape `(n,)` of the times and the reference. Its largest error is estimated as a
    third of what it would be off if every other sample were missing.
    """
    if len(time_s) < _FEWEST:
        raise DataError(
            f"{source}: expected {_FEWEST} samples or more to compensate dynamically, found {len(time_s)}; sample "
            "the reference more finely, or compensate statically."
        )
    _, behind, offset_um = gains_of(stage)
    every, other = (
        offset_um + behind * np.asarray(_demand(stage, jnp.asarray(time_s[::n]), jnp.asarray(reference_um[::n])))
        for n in (1, 2)
    )
    # Away from the ends, where splines are less sure than the reference is.
    return every, float(np.max(np.abs(every[::2] - other)[2:-2]) / 3)


def demand_remarks(reference_um: np.ndarray, needed_um: np.ndarray, doubt_um: float) -> tuple[list[str], list[str]]:
    """Remarks that a reference turns faster than its samples show, and that it moves at first, from `demand`."""
    start_um, little_um = abs(float(needed_um[0] - reference_um[0])), _WORTH_SAYING * float(np.ptp(reference_um))
    turning = (
        "the reference turns within a sample, so that the displacement its acceleration asks for is uncertain by "
        f"{length(doubt_um)}; smooth it, sample it more finely, or compensate statically."
    )
    moving = (
        f"the reference begins in motion and the stage at rest, {length(start_um)} away from what it would need; "
        "begin with a rest and a smooth start."
    )
    return [turning] if doubt_um > little_um else [], [moving] if start_um > max(little_um, doubt_um) else []


def simulate_model(model: Preisach | Stage, record: Record, initial: str) -> np.ndarray:
    """Displacement of a hysteresis or a whole stage under a voltage, in um, shape `(n,)`; see `compensate`."""
    law = model if isinstance(model, Preisach) else hysteresis_of(model)
    lower, upper = float(law.density.lower_V), float(law.density.upper_V)
    if isinstance(model, Preisach):
        return simulate_run(model, prepare_run(record, (lower, upper), initial, 1.0))
    if (plain := plain_stage_of(model)) is not None:
        return plain.play(record, initial)
    # Even times are given as the one interval between them: that takes half as long to compile.
    each_s = intervals(record.time_s)
    time_s = float(each_s[0]) if len(each_s) == 1 else record.time_s
    return respond(model, time_s, record.voltage_V, Start(memory=initial_state(initial, lower, upper)))


def respond(stage: Stage, time_s: np.ndarray | float, voltage_V: np.ndarray, start: Start) -> np.ndarray:
    """Displacement of a stage in um, shape `(n,)` as the voltage has; the time may be one interval."""
    return np.asarray(_respond(stage, jnp.asarray(time_s), jnp.asarray(voltage_V), start))


_demand = kept(microid.piezo_demand)
_command = kept(microid.driver_command)
_respond = kept(Stage.__call__)
