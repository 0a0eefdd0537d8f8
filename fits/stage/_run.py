"""A record made ready for fitting a whole stage: padded, refined in time, and weighed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.io._columns import columns_beside
from fits.io._errors import DataError
from fits.io._record import Record
from fits.loop._run import VIRGIN, initial_state, known_samples
from fits.stage._lagging import known_behind_lag
from microid import (
    AbstractHysteresis,
    AbstractLinear,
    Hold,
    LinearSystem,
    Preisach,
    Signal,
    Stage,
    Staircase,
    Start,
    innermost,
    refined,
)

# Records are filled up to a power of two, so that those of like length share what was compiled.
_SHORTEST = 1024
# Intervals that differ by less than this from their mean, as a fraction of it, count as even.
_EVEN = 1e-6
# Extremes that a memory may hold: filtered multisines nest deeply.
_EXTREMES = 512
# A hundred arrays of so many values are 8 GB.
_MOST_STEPS = 10_000_000
# Relative size of what is too small to be seen.
_TINY = 1e-12


class Samples(eqx.Module):
    """The arrays of a run, as compiled functions take them.

    Attributes
    ----------
    time_s
        Refined times, shape `(m,)`, or the one interval between them, shape `()`.
    voltage_V
        Command at the refined times, shape `(m,)`.
    displacement_um
        Measurement, shape `(n,)`, with `m = (n - 1) stride + 1`.
    weight
        Of each measured sample in the sum of squares, 0 where it is not fitted, shape `(n,)`.
    start
        Memory and rest before the first sample.
    stride
        Refined steps per sample.
    moving
        Whether the stage may have been moving when the record began.
    beside
        Further columns at the refined times under the names of `columns_beside`, shape `(m,)`.
    """

    time_s: Float[Array, " m"] | Float[Array, ""]
    voltage_V: Float[Array, " m"]
    displacement_um: Float[Array, " n"]
    weight: Float[Array, " n"]
    start: Start
    stride: int = eqx.field(static=True)
    moving: bool = eqx.field(static=True)
    beside: dict[str, Float[Array, " m"]] = eqx.field(default_factory=dict)


@dataclass(frozen=True)
class StageRun:
    """One record for a whole stage.

    Attributes
    ----------
    record
        The measured columns.
    samples
        The same, padded.
    known
        Samples whose output does not depend on an unknown past, but for a constant, shape `(n,)`.
    fitted
        Samples that may be used for fitting, shape `(n,)`.
    """

    record: Record
    samples: Samples
    known: np.ndarray
    fitted: np.ndarray

    @property
    def displacement_um(self) -> np.ndarray:
        """Measured displacement, shape `(n,)`."""
        assert self.record.displacement_um is not None
        return self.record.displacement_um

    @property
    def held_out(self) -> np.ndarray:
        """Samples that are predicted, not fitted, shape `(n,)`."""
        return self.known & ~self.fitted

    @property
    def rate_Hz(self) -> float:
        """Sampling rate, the median if it is uneven."""
        return float(1 / np.median(np.diff(self.record.time_s)))

    def weighted(self, weight: np.ndarray) -> "StageRun":
        """Weigh the samples, shape `(n,)`; those that are not fitted stay without weight."""
        full = np.zeros(self.samples.weight.shape)
        full[: len(weight)] = weight * self.fitted
        return replace(self, samples=eqx.tree_at(lambda s: s.weight, self.samples, jnp.asarray(full)))


def prepare_stage_run(
    record: Record,
    range_V: tuple[float, float],
    initial: str,
    holdout: float,
    stride: int = 1,
    gain: float | None = 1.0,
    hold: Hold = "first",
    usable: np.ndarray | None = None,
) -> StageRun:
    """Make a record ready.

    Parameters
    ----------
    record
        Measured voltage and displacement.
    range_V
        Range of the command.
    initial
        Memory before the first sample, one of `INITIAL_STATES`, or `VIRGIN`.
    holdout
        Fraction at the end that is kept out of the fit.
    stride
        Steps into which each interval is divided.
    gain
        Static gain ahead of the hysteresis, see `gain_ahead`. None where there is no hysteresis, whose unknown past
        lasts until the voltage has been at both ends.
    hold
        How the command runs between samples, as in `Stage`.
    usable
        Which samples may be fitted, shape `(n,)`; by default all.

    Raises
    ------
    DataError
        If there is no displacement, or nothing is left to fit.
    """
    if record.displacement_um is None:
        raise DataError(f"{record.source}: a displacement column is needed here")
    if stride * len(record) > _MOST_STEPS:
        raise DataError(
            f"{record.source}: expected at most {_MOST_STEPS:,} steps, found {len(record):,} samples of {stride} "
            "substeps each; split the record, or use a model of fewer substeps"
        )
    lower, upper = range_V
    n, unknown = len(record), initial in ("unknown", VIRGIN)
    known = np.ones(n, dtype=bool) if gain is None else known_samples(record.voltage_V, lower, upper, initial)
    if unknown and gain is not None:
        known = known_behind_lag(record.voltage_V, record.displacement_um, known)
    fitted = known.copy() if usable is None else known & usable
    if holdout > 0:
        fitted[n - round(holdout * n) :] = False
    if holdout < 1 and fitted.sum() < 50:
        raise DataError(
            f"{record.source}: only {fitted.sum()} samples are left to fit, 50 are needed: the others come before "
            "the voltage has been at both ends of its range, where its unknown history still counts, or are held "
            "out; state the initial state with --initial, hold out less, or start each run with a full loop"
        )
    samples = refine(record.time_s, record.voltage_V, record.displacement_um, fitted, stride, unknown, hold)
    share = np.arange(samples.voltage_V.shape[0]) / stride
    beside = {name: jnp.asarray(np.interp(share, np.arange(n), v)) for name, v in columns_beside(record).items()}
    samples = eqx.tree_at(lambda s: s.beside, samples, beside)
    ahead = 1.0 if gain is None else gain
    memory = _roomy(initial_state(initial, ahead * lower, ahead * upper))
    return StageRun(record, eqx.tree_at(lambda s: s.start.memory, samples, memory, is_leaf=_none), known, fitted)


def _none(value: Any) -> bool:
    return value is None


def refine(
    time_s: np.ndarray,
    voltage_V: np.ndarray,
    displacement_um: np.ndarray,
    fitted: np.ndarray,
    stride: int,
    moving: bool,
    hold: Hold,
) -> Samples:
    """Fill up and refine the arrays of a record."""
    n = len(time_s)
    pad = (0, max(_SHORTEST, 1 << (n - 1).bit_length()) - n)
    step = (time_s[-1] - time_s[0]) / (n - 1)
    voltage, weight = np.pad(voltage_V, pad, mode="edge"), np.pad(fitted.astype(float), pad)
    share = np.arange((n + pad[1] - 1) * stride + 1) / stride
    _, fine_V = refined(jnp.ones(()), jnp.asarray(voltage), stride, hold)
    if np.max(np.abs(np.diff(time_s) - step)) <= _EVEN * step:
        time: Any = np.asarray(step / stride)
    else:
        longer = np.concatenate([time_s, time_s[-1] + step * np.arange(1, pad[1] + 1)])
        time = np.interp(share, np.arange(n + pad[1]), longer)
    return Samples(
        jnp.asarray(time),
        fine_V,
        jnp.asarray(np.pad(displacement_um, pad, mode="edge")),
        jnp.asarray(weight),
        Start(),
        stride,
        moving,
    )


def _roomy(start: Staircase) -> Staircase:
    pad = jnp.full(_EXTREMES - start.extremes_V.shape[0], start.extremes_V[0])
    return Staircase(jnp.concatenate([start.extremes_V, pad]), start.count)


def respond(stage: Stage, samples: Samples) -> Float[Array, " n"]:
    """Simulate a run, in um, shape `(n,)`."""
    start = samples.start if any(isinstance(innermost(part), Preisach) for part in stage.parts) else Start()
    return stage(samples.time_s, samples.voltage_V, start, samples.beside)[:: samples.stride]


def lead_ins(stage: Stage, samples: Samples) -> Float[Array, "n k"]:
    """What a run's nuisance parameters add, shape `(n, k)`: an offset in um, and how the stage moved before.

    The latter are the free motions of what follows the hysteresis, or of the whole chain without one. A voltage at
    the piezo that still settles when the record begins is not among them.
    """
    offset = jnp.ones((samples.weight.shape[0], 1))
    place = place_of_hysteresis(stage)
    system = joined(stage.parts[0 if place is None else place + 1 :])
    if not samples.moving or system is None or system.order == 0:
        return offset
    nothing = jnp.zeros_like(samples.voltage_V)

    def free(state: Float[Array, " s"]) -> Float[Array, " n"]:
        alone = LinearSystem(system.rate_per_s, state, system.read, jnp.zeros(()), jnp.zeros(()))
        return alone.respond(samples.time_s, nothing, jnp.ones(()))[:: samples.stride]

    return jnp.concatenate([offset, jax.vmap(free)(jnp.eye(system.order)).T], axis=1)


def without(
    columns: Float[Array, "n k"], weight: Float[Array, " n"], values: Float[Array, " n"]
) -> Float[Array, " n"]:
    """Take the best combination of some columns off, by weighted least squares."""
    scale = jnp.sqrt(jnp.sum(weight[:, None] * columns**2, axis=0)) + _TINY
    scaled = columns / scale[None, :]
    weighted = weight[:, None] * scaled
    gram = scaled.T @ weighted + _TINY * jnp.eye(columns.shape[1])
    return values - scaled @ jnp.linalg.solve(gram, weighted.T @ values)


@eqx.filter_jit
def _compare(stage: Stage, samples: Samples) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    out = respond(stage, samples)
    return out, without(lead_ins(stage, samples), samples.weight, samples.displacement_um - out)


def simulate_stage(stage: Stage, run: StageRun) -> np.ndarray:
    """Predict the displacement of a run, in um, shape `(n,)`."""
    return np.asarray(_compare(stage, run.samples)[0])[: len(run.record)]


def residual_of(stage: Stage, run: StageRun) -> np.ndarray:
    """Measurement less prediction, the run's nuisance parameters taken off, in um, shape `(n,)`."""
    return np.asarray(_compare(stage, run.samples)[1])[: len(run.record)]


def place_of_hysteresis(stage: Stage) -> int | None:
    """Where in the chain the hysteresis stands; None where there is none."""
    places = [n for n, part in enumerate(stage.parts) if isinstance(innermost(part), AbstractHysteresis)]
    return places[0] if places else None


def gain_ahead(stage: Stage) -> float | None:
    """Voltage at the hysteresis per command, at rest; None where there is no hysteresis.

    Raises
    ------
    DataError
        If it is not positive.
    """
    place = place_of_hysteresis(stage)
    if place is None:
        return None
    gain = math.prod(float(part.static_gain) for part in stage.parts[:place] if isinstance(part, AbstractLinear))
    if not (math.isfinite(gain) and gain > 0):
        raise DataError(
            f"the static gain ahead of {stage.names[place]!r} is {gain:g}, expected a positive one: turn the sign of "
            "the voltage column instead"
        )
    return gain


def joined(parts: Sequence[Any]) -> LinearSystem | None:
    """Linear parts as one system; None where there are none, or one of them is not linear."""
    total: LinearSystem | None = None
    for part in parts:
        if not isinstance(part, AbstractLinear):
            return None
        total = part.system() if total is None else total.then(part.system())
    return total


def ahead(stage: Stage, place: int, samples: Samples) -> Float[Array, " m"]:
    """Voltage that a part sees, at the refined times, in V, shape `(m,)`."""
    signal = Signal(samples.voltage_V, samples.voltage_V[0], stage.hold)
    for part in stage.parts[:place]:
        signal = part.run(samples.time_s, signal)
    return signal.values
