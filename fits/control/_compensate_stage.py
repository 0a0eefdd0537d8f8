"""A whole stage in feedforward: what its driver and mechanics ask for beyond the inverse of the hysteresis."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import microid
from fits.io._errors import DataError
from fits.io._length import length
from fits.io._record import Record
from fits.loop._plain import PlainModel
from fits.loop._run import initial_state, prepare_run, simulate_run
from fits.stage._encode import encode
from fits.stage._plain_file import plain_model
from microid import AbstractEffect, AbstractLinear, GridDensity, Preisach, Reversible, Stage, Start, innermost

# Doubt about the displacement needed, or a start in motion, that is worth a remark: a fraction of the span.
_WORTH_SAYING = 0.01
_FEWEST = 16


def plain_of(stage: Stage) -> Stage:
    """The same stage without effects of `microid.EFFECTS`; itself where it has none."""
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


@eqx.filter_jit
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
@eqx.filter_jit
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
            f"{source}: expected {_FEWEST} samples or more for --dynamic, found {len(time_s)}; sample the reference "
            "more finely, or use --static."
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
        f"{length(doubt_um)}; smooth it, sample it more finely, or use --static."
    )
    moving = (
        f"the reference begins in motion and the stage at rest, {length(start_um)} away from what it would need; "
        "begin with a rest and a smooth start."
    )
    return [turning] if doubt_um > little_um else [], [moving] if start_um > max(little_um, doubt_um) else []


def command(stage: Stage, time_s: np.ndarray, static_V: np.ndarray) -> np.ndarray:
    """Compensate the driver's lag: the command that gives the piezo a static voltage, shape `(n,)`."""
    return np.asarray(_command(stage, jnp.asarray(time_s), jnp.asarray(gains_of(stage)[0] * static_V)))


def simulate_model(model: Preisach | Stage, record: Record, initial: str) -> np.ndarray:
    """Displacement of a hysteresis or a whole stage under a voltage, in um, shape `(n,)`; see `compensate`."""
    law = model if isinstance(model, Preisach) else hysteresis_of(model)
    lower, upper = float(law.density.lower_V), float(law.density.upper_V)
    if isinstance(model, Preisach):
        return simulate_run(model, prepare_run(record, (lower, upper), initial, 1.0))
    if (plain := plain_stage_of(model)) is not None:
        return plain.play(record, initial)
    n = len(record)
    step_s = record.duration_s / max(n - 1, 1) or 1.0
    # Even times are given as the one interval between them: that takes half as long to compile.
    uneven_s = np.abs(record.time_s - (record.time_s[0] + step_s * np.arange(n))).max()
    even = uneven_s <= 1e-13 * max(np.abs(record.time_s).max(), step_s)
    time_s = step_s if even else record.time_s
    start = Start(memory=initial_state(initial, lower, upper))
    return respond(model, time_s, record.voltage_V, start)


def respond(stage: Stage, time_s: np.ndarray | float, voltage_V: np.ndarray, start: Start) -> np.ndarray:
    """Displacement of a stage in um, shape `(n,)` as the voltage has; the time may be one interval."""
    return np.asarray(_respond(stage, jnp.asarray(time_s), jnp.asarray(voltage_V), start))


_demand = eqx.filter_jit(microid.piezo_demand)
_command = eqx.filter_jit(microid.driver_command)
_respond = eqx.filter_jit(lambda stage, time_s, voltage_V, start: stage(time_s, voltage_V, start))
