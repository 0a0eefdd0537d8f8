"""What a stage makes of a run: its response, what is left of the run, and where its hysteresis stands."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import qr

import microid as m
from fits.io._errors import DataError
from fits.io._kept import kept
from fits.io._record import Record
from fits.io.columns import COLUMNS, columns_beside
from fits.loop._known import known_samples
from fits.loop._past import past_columns
from fits.loop._prediction import Initial, inside
from fits.loop._result import FitResult
from fits.loop._run import Run, Samples, prepare_run

# Relative size of what is too small to be seen.
_TINY = 1e-12
# Part of a column beside the others below which it is rounding.
_DEPENDENT = 1e-10
# Powers of what a driver was charged with.
_POWERS = 3


@kept
def respond(stage: m.Stage, samples: Samples) -> Float[Array, " n"]:
    """Simulate a run, in um, shape `(n,)`."""
    start = samples.start if any(isinstance(m.innermost(part), m.Preisach) for part in stage.parts) else m.Start()
    stage = stage.with_hold(samples.hold)
    return stage(samples.time_s, samples.voltage_V, start, samples.beside)[:: samples.stride]


@kept
def nuisance_columns(stage: m.Stage, samples: Samples) -> Float[Array, "n k"]:
    """What a run's nuisance parameters add, `(n, k)`: an offset in um, its past, and how the stage moved before.

    The latter are free motions of what follows the hysteresis, or of the whole chain without one, and of relaxations
    behind it; and of a driver ahead of it, what it was still charged with, as a hysteresis gives it: its powers, as
    the slope of a branch is not the same all along.
    """
    columns = settled_columns(stage, samples)
    place = place_of_hysteresis(stage)
    charging = _free_motions(stage.parts[:place], samples) if samples.moving and place is not None else None
    if charging is None or place is None:
        return columns
    charging = charging / (jnp.max(jnp.abs(charging), axis=0)[None] + _TINY)
    powers = jnp.concatenate([charging**power for power in range(1, _POWERS + 1)], axis=1)
    more = answered(stage, place, samples, powers, ahead(stage, place, samples))
    return jnp.concatenate([columns, more], axis=1)


def settled_columns(stage: m.Stage, samples: Samples) -> Float[Array, "n k"]:
    """The same but for what a driver was still charged with."""
    offset = jnp.ones((samples.weight.shape[0], 1))
    place = place_of_hysteresis(stage)
    if samples.has_past and place is not None:
        past, seen = _past_ahead(stage, place, samples)
        offset = jnp.concatenate([offset, answered(stage, place, samples, past, seen)], axis=1)
    if not samples.moving:
        return offset
    behind = stage.parts[0 if place is None else place + 1 :]
    time = samples.time_s - samples.time_s.ravel()[0]
    if samples.time_s.ndim == 0:
        time = samples.time_s * jnp.arange(samples.voltage_V.shape[0], dtype=time.dtype)
    relaxing = [p for p in behind if isinstance(p, m.effects.AbstractEffect) and p.relaxation]
    late = [jnp.exp(-time / getattr(part, part.relaxation)) for part in relaxing]
    offset = jnp.concatenate([offset, *(one[:: samples.stride, None] for one in late)], axis=1)
    swinging = _free_motions(behind, samples)
    return offset if swinging is None else jnp.concatenate([offset, swinging[:: samples.stride]], axis=1)


def _free_motions(parts: Sequence[Any], samples: Samples) -> Float[Array, "m s"] | None:
    """What linear parts give from each of their states on, at the refined times; None without such parts."""
    system = joined(parts)
    if system is None or system.order == 0:
        return None
    nothing = jnp.zeros_like(samples.voltage_V)

    def free(state: Float[Array, " s"]) -> Float[Array, " m"]:
        alone = m.LinearSystem(system.rate_per_s, state, system.read, jnp.zeros(()), jnp.zeros(()))
        return alone.respond(samples.time_s, nothing, jnp.ones(()))

    return jax.vmap(free)(jnp.eye(system.order)).T


def _past_ahead(stage: m.Stage, place: int, samples: Samples) -> tuple[Float[Array, "m k"], m.Signal]:
    """Signals of an unknown past where the hysteresis gives them, at the refined times, and what goes into it."""
    seen = ahead(stage, place, samples)
    # How far a lagging command goes may show after what is fitted only: a kink there could not be learnt.
    at_V, fitted = seen.values[:: samples.stride], samples.weight > 0
    end_V = jnp.max(jnp.where(fitted, at_V, -jnp.inf)), jnp.min(jnp.where(fitted, at_V, jnp.inf))
    return past_columns(jnp.clip(seen.values, end_V[1], end_V[0])), seen


@kept
def fitted_past(
    stage: m.Stage, samples: Samples, coarser: Samples, left_um: Float[Array, " n"]
) -> Float[Array, " m"]:
    """What the unknown past of a run makes its hysteresis give, in um, at the refined times, shape `(m,)`.

    It is fitted, beside the other nuisance parameters as `coarser` samples show them, to what a stage leaves. All
    relays together add half the stroke at most, which is the standard deviation of the sum of all factors beforehand:
    of a past that ends with the first samples readings say little beside how the stage moved.
    """
    place = place_of_hysteresis(stage)
    if place is None:
        return jnp.zeros_like(samples.voltage_V)
    past, _ = _past_ahead(stage, place, samples)
    columns, weight = nuisance_columns(stage, coarser), samples.weight
    noise_um2 = jnp.average(project_out(columns, weight, left_um) ** 2, weights=weight)
    counts = jnp.where(weight > 0, samples.displacement_um, jnp.nan)
    stroke_um = jnp.nanmax(counts) - jnp.nanmin(counts)
    # Ahead of them is the offset.
    own, number = slice(1, 1 + past.shape[1]), past.shape[1]
    ridge = jnp.zeros(columns.shape[1]).at[own].set(noise_um2 * number / (stroke_um / 2) ** 2)
    return past @ _best_factors(columns, weight, left_um, ridge)[own]


def answered(
    stage: m.Stage,
    place: int,
    samples: Samples,
    columns: Float[Array, "m k"],
    like: m.Signal,
) -> Float[Array, "n k"]:
    """What a linear chain behind a part makes of signals at the refined times, but for factors, at the samples.

    Between these times they run as the one that they are `like` does, a smooth one in lines.
    """
    system = joined(stage.parts[place + 1 :])
    if system is not None and system.order:
        system = replace(system, offset=jnp.zeros(()))
        hold, settling_s = lines_of(like)

        def respond(one: Float[Array, " m"]) -> Float[Array, " m"]:
            return system.respond(samples.time_s, one, one[0], hold, False, settling_s)

        columns = jax.vmap(respond, 1, 1)(columns)
    return columns[:: samples.stride]


def lines_of(signal: m.Signal) -> tuple[m.Hold, Float[Array, ""] | None]:
    """How changes of a signal run between its samples: in lines, unless it is held, or settles."""
    return "zero" if signal.hold == "zero" else "first", signal.settling_s


@kept
def project_out(
    columns: Float[Array, "n k"], weight: Float[Array, " n"], values: Float[Array, " n"]
) -> Float[Array, " n"]:
    """Take the best combination of some columns off, by weighted least squares."""
    return values - columns @ _best_factors(columns, weight, values)


def _best_factors(
    columns: Float[Array, "n k"], weight: Float[Array, " n"], values: Float[Array, " n"], ridge: Any = 0.0
) -> Float[Array, " k"]:
    """Of columns, by weighted least squares; `ridge` is the precision of each beforehand, `(k,)`."""
    scale = jnp.sqrt(jnp.sum(weight[:, None] * columns**2, axis=0)) + _TINY
    scaled = columns / scale[None, :]
    weighted = weight[:, None] * scaled
    gram = scaled.T @ weighted + jnp.diag(jnp.broadcast_to(ridge / scale**2 + _TINY, scale.shape))
    return jnp.linalg.solve(gram, weighted.T @ values) / scale


def spanned(columns: np.ndarray) -> np.ndarray:
    """Orthonormal columns that span the same, shape `(n, r)`."""
    size = np.linalg.norm(columns, axis=0)
    basis, upper, _ = qr(columns[:, size > 0] / size[size > 0], mode="economic", pivoting=True)
    return np.asarray(basis[:, np.abs(np.diagonal(upper)) > _DEPENDENT])


def simulate_stage(stage: m.Stage, run: Run) -> np.ndarray:
    """Predict the displacement of a run, in um, shape `(n,)`."""
    return np.asarray(respond(stage, run.samples))[: len(run.record)]


def residual_of(stage: m.Stage, run: Run) -> np.ndarray:
    """Measurement less prediction, the run's nuisance parameters taken off, in um, shape `(n,)`."""
    samples = run.samples
    columns = nuisance_columns(stage, run.coarser.samples)
    left = project_out(columns, samples.weight, samples.displacement_um - respond(stage, samples))
    return np.asarray(left)[: len(run.record)]


def place_of_hysteresis(stage: m.Stage) -> int | None:
    """Where in the chain the hysteresis stands; None where there is none."""
    hysteretic = (n for n, part in enumerate(stage.parts) if isinstance(m.innermost(part), m.AbstractHysteresis))
    return next(hysteretic, None)


def named_parts(stage: m.Stage, *kinds: type) -> list[tuple[str, Any]]:
    """Names and parts of some kinds, in the order of the signal."""
    return [pair for pair in zip(stage.names, stage.parts, strict=True) if isinstance(pair[1], kinds)]


def as_stage(model: m.Preisach | m.Stage) -> m.Stage:
    """A model as a stage: a hysteresis alone is one of a single part."""
    return model if isinstance(model, m.Stage) else m.Stage.of(hysteresis=model)


def hysteresis_of(stage: m.Stage) -> Any:
    """The part of a stage that holds its hysteresis, with what is around it; None where there is none."""
    place = place_of_hysteresis(stage)
    return None if place is None else stage.parts[place]


def free_grid(stage: m.Stage) -> tuple[str, m.Preisach] | None:
    """Name and Preisach operator of a stage that is fitted on a grid; None where it is frozen, or of another kind."""
    law, name = hysteresis_of(stage), stage.names[place_of_hysteresis(stage) or 0]
    on_grid = isinstance(law, m.Preisach) and isinstance(law.density, m.densities.GridDensity)
    return (name, law) if on_grid and name not in stage.frozen else None


def gain_ahead(stage: m.Stage) -> float | None:
    """Voltage at the hysteresis per command, at rest; None without one, a `DataError` where it is not positive."""
    place = place_of_hysteresis(stage)
    if place is None:
        return None
    gain = float(static_gain(stage.parts[:place]))
    if not 0 < gain < math.inf:
        raise DataError(
            f"the static gain ahead of {stage.names[place]!r} is {gain:g}, expected a positive one: turn the sign of "
            "the voltage column instead",
            of_model=True,
        )
    return gain


@kept
def static_gain(parts: Sequence[Any]) -> Float[Array, ""]:
    """Gain at rest of the linear ones among some parts."""
    linear = (part.static_gain for part in parts if isinstance(part, m.AbstractLinear))
    return math.prod(linear, start=jnp.ones(()))


def joined(parts: Sequence[Any]) -> m.LinearSystem | None:
    """Linear parts as one system; None where there are none, or one of them is not linear."""
    if not parts or not all(isinstance(part, m.AbstractLinear) for part in parts):
        return None
    return reduce(m.LinearSystem.then, (part.system() for part in parts))


@kept
def ahead(stage: m.Stage, place: int, samples: Samples, rest_V: Float[Array, ""] | None = None) -> m.Signal:
    """What goes into a part after the rest before the run, or after another, at the refined times, `(m,)`."""
    signal = m.Signal(samples.voltage_V, samples.rest_V if rest_V is None else rest_V, samples.hold)
    scene = m.Scene(signal, samples.beside, samples.start.memory)
    return m.run_parts(stage.parts[:place], samples.time_s, signal, scene)


def yields_inside(stage: m.Stage) -> bool:
    """Whether a hysteresis stands inside the mechanics of a stage."""
    return any(isinstance(part, m.HystereticMechanics) for part in stage.parts)


@kept
def _after_rest(stage: m.Stage, samples: Samples, rest_V: Float[Array, ""]) -> Float[Array, " n"]:
    """Response after a rest at some command, in um, `(n,)`."""
    stage = stage.with_hold(samples.hold)
    return stage(samples.time_s, samples.voltage_V, m.Start(rest_V), samples.beside)[:: samples.stride]


def settled_samples(stage: m.Stage, run: Run, initial: str) -> np.ndarray:
    """Mark what no longer depends on a past that is `initial`, behind the lag ahead of the hysteresis.

    All of them, where less than half of those that are fitted would be left. With a hysteresis inside the mechanics,
    what hardly depends on where the whole stage was at rest before; the first half is left out at most.
    """
    place, n = place_of_hysteresis(stage), len(run.record)
    everything = np.ones(n, dtype=bool)
    if initial == "unknown" and yields_inside(stage):
        ends = (jnp.asarray(end_V / run.gain) for end_V in (run.lower_V, run.upper_V))
        low_um, high_um = (np.asarray(_after_rest(stage, run.samples, rest))[:n] for rest in ends)
        apart_um = high_um - low_um
        # What never switches is a constant, which the run's own offset takes up.
        moves = np.abs(apart_um - apart_um[-1]) > 1e-3 * np.ptp(low_um)
        last = int(np.flatnonzero(moves)[-1]) if moves.any() else -1
        return np.asarray(np.arange(n) > min(last, n // 2))
    if not place or initial != "unknown":
        return everything
    # What lags may stand anywhere when the record begins; it has forgotten that where both ends lead to the same.
    rests_V = (jnp.asarray(end_V / run.gain) for end_V in (run.lower_V, run.upper_V))
    low_V, high_V = (np.asarray(ahead(stage, place, run.samples, rest).values)[:: run.stride][:n] for rest in rests_V)
    begun = int(np.argmax(np.abs(high_V - low_V) < 1e-3 * (run.upper_V - run.lower_V)))
    settled = np.arange(n) >= begun
    settled[begun:] = known_samples(low_V[begun:], run.lower_V, run.upper_V, initial)
    return settled if 2 * (settled & run.fitted).sum() > run.fitted.sum() else everything


def range_of(stage: m.Stage) -> tuple[float, float]:
    """Commands that a stage was fitted on, in V; unlimited without a Preisach operator."""
    law, gain = m.innermost(hysteresis_of(stage)), gain_ahead(stage)
    if gain is None or not isinstance(law, m.Preisach):
        return -np.inf, np.inf
    return float(law.density.lower_V) / gain, float(law.density.upper_V) / gain


def prepare_again(
    result: FitResult[m.Stage],
    records: Sequence[Record],
    initial: Sequence[str],
    holdout: float,
    range_V: tuple[float, float],
) -> list[Run]:
    """Make the records ready on which a stage was fitted, after what was found to have gone on before them."""
    stage = result.model
    each = zip(result.records or records, initial, result.fitted_runs, strict=True)
    settings = gain_ahead(stage), stage.hold
    return [
        prepare_run(one, range_V, state, holdout, report.substeps or 1, *settings, estimated=report.has_past)
        for one, state, report in each
    ]


def prepare_program(stage: m.Stage, record: Record, initial: Initial) -> tuple[m.Stage, Run]:
    """Make a voltage program ready for a stage, and the stage for intervals that are divided already.

    A `DataError` if it leaves the range that the stage was fitted on, lacks a column that the stage depends on, or
    begins from another memory than its hysteresis can.
    """
    law = hysteresis_of(stage)
    if law is not None and initial != "negative" and not isinstance(m.innermost(law), m.Preisach):
        raise DataError(
            f"a {type(m.innermost(law)).__name__} begins at rest, with nothing remembered: state no initial memory"
        )
    range_V = range_of(stage)
    record = inside(record, *range_V)
    needed = {name for part in stage.parts if isinstance(part, m.effects.AbstractEffect) for name in part.needs}
    # What nothing depends on would only make another program of the same.
    program = replace(record, displacement_um=None, extra=record.extra if needed else {})
    needed -= {name for name, column in COLUMNS.items() if column.optional}
    missing = sorted(needed - set(columns_beside(program)))
    if missing:
        raise DataError(
            f"{record.source}: the model depends on {', '.join(missing)}: add a column of that name that varies"
        )
    run = prepare_run(program, range_V, initial, 1.0, stage.substeps, gain_ahead(stage), stage.hold)
    return stage.with_substeps(1), run
