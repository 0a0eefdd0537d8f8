"""A record made ready for fitting: which samples count, what it began from, and the arrays that models take."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import microid as m
from fits.io._errors import DataError
from fits.io._record import Record
from fits.io.columns import columns_beside
from fits.loop._design import Grid, columns_of
from fits.loop._known import SOME, known_samples, pasts_to_estimate
from fits.loop._past import past_columns
from fits.loop._path import Path
from fits.loop._plain import extremes_V, path_of
from fits.loop._prediction import Initial
from fits.loop._stepped import even_interval_s, refuse_many_steps
from fits.loop._surface import Surface

# Room for the extremes of a memory, and along the runs of a stage: filtered multisines nest deeply.
_EXTREMES, _EXTREMES_OF_STAGE = 64, 512
# Samples that a run must leave to fit.
_FEWEST = 50
# Samples that a shorter run is padded to, so that runs of many lengths share what is compiled.
_SHORTEST = 4096
# Part of the way to it by which peaks of smooth commands miss their highest.
_ALMOST = 1e-2
# Said of runs whose past is.
PAST_IS_ESTIMATED = "{}: what the rig went through before is unknown and estimated beside the rest"
# Steps between samples that show derivatives well enough.
_FEW_STEPS = 4
Progress = Callable[[str], None]  # told what is being done, a sentence at a time


class Samples(eqx.Module):
    """A run of `n` samples, padded, with `m = (n - 1) stride + 1` steps.

    `time_s` is the one interval between steps where they are even. `weight` is that of each sample in the sum of
    squares, 0 where it is not fitted. The stage rested under `rest_V` before; `moving` says whether it may have been
    moving when the record began, and `has_past` whether the unknown memory of its hysteresis is estimated. Between
    samples the command runs as `hold` says, whatever that of a stage is. `beside` holds further columns under the
    names of `columns_beside`.
    """

    time_s: Float[Array, " m"] | Float[Array, ""]
    voltage_V: Float[Array, " m"]
    displacement_um: Float[Array, " n"]
    weight: Float[Array, " n"]
    rest_V: Float[Array, ""]
    start: m.Start
    stride: int = eqx.field(static=True)
    moving: bool = eqx.field(static=True)
    has_past: bool = eqx.field(static=True)
    hold: m.Hold = eqx.field(static=True)
    beside: dict[str, Float[Array, " m"]] = eqx.field(default_factory=dict)


def staircase(extremes_V: np.ndarray, size: int) -> m.Staircase:
    """A memory of some extremes, shape `(used,)`, with room for so many at least."""
    used = len(extremes_V)
    extremes_V = np.pad(extremes_V, (0, max(0, size - used)), mode="edge")
    return m.Staircase(jnp.asarray(extremes_V), jnp.asarray(np.int32(used)))


@eqx.filter_jit
def _refined(voltage_V: Float[Array, " n"], stride: int, hold: m.Hold) -> Float[Array, " m"]:
    return m.refined(jnp.ones(()), voltage_V, stride, hold)[1]


@dataclass(frozen=True)
class Run:
    """A record for the fit of a hysteresis or of a whole stage.

    The switching voltages range from `lower_V` to `upper_V`; `gain` is the voltage at the hysteresis per command, at
    rest, and `start` the memory before the first sample. Samples are `known` whose output does not depend on an
    unknown past, but for a constant, and `fitted` those of them that are not held out, shape `(n,)`; `weight` is that
    of each in the sum of squares, None where all count alike. For a stage the intervals are divided into `stride`
    steps, between samples the command runs as `hold` says (see `Stage`), and the stage may have been `moving` when
    the record began. It `has_past` where its unknown memory is estimated, so that all samples are known ones. Samples
    that the record has `lost` are neither known nor fitted.
    """

    record: Record
    lower_V: float
    upper_V: float
    start: m.Staircase
    known: np.ndarray
    fitted: np.ndarray
    weight: np.ndarray | None = None
    gain: float = 1.0
    stride: int = 1
    hold: m.Hold = "first"
    moving: bool = False
    has_past: bool = False

    @property
    def displacement_um(self) -> np.ndarray:
        """Measured displacement, shape `(n,)`; a `DataError` where there is none."""
        if self.record.displacement_um is None:
            raise DataError(f"{self.record.source}: a displacement column is needed here")
        return self.record.displacement_um

    @property
    def voltage_V(self) -> np.ndarray:
        """Voltage at the hysteresis if nothing ahead of it lagged, shape `(n,)`."""
        return self.gain * self.record.voltage_V

    @property
    def held_out(self) -> np.ndarray:
        """Samples that are predicted, not fitted, shape `(n,)`."""
        return self.known & ~self.fitted

    @property
    def rate_Hz(self) -> float:
        """Sampling rate, the median if it is uneven."""
        return float(1 / np.median(np.diff(self.record.time_s)))

    @property
    def fit_weight(self) -> np.ndarray:
        """What each sample counts in the sum of squares, 0 where it is not fitted, shape `(n,)`."""
        return self.fitted.astype(float) if self.weight is None else self.weight * self.fitted

    @property
    def extremes_V(self) -> np.ndarray:
        """Extremes of the memory before the first sample, oldest first."""
        return np.asarray(self.start.extremes_V)[: int(self.start.count)]

    @cached_property
    def of_past(self) -> int:
        """Samples up to the last whose output depends on an unknown past, be that estimated or not."""
        known = self.been_at_both if self.has_past else self.known | self.record.lost
        return 0 if known.all() else int(np.flatnonzero(~known)[-1]) + 1

    @cached_property
    def been_at_both(self) -> np.ndarray:
        """Samples after the voltage has been at both of its own extremes."""
        far_V = self.upper_V - self.lower_V
        return known_samples(self.voltage_V, self.lower_V - far_V, self.upper_V + far_V)

    @cached_property
    def coarser(self) -> "Run":
        """The same in few steps: enough for derivatives, which are directions to move in."""
        return self if self.stride <= _FEW_STEPS else replace(self, stride=_FEW_STEPS)

    @cached_property
    def path(self) -> tuple[Path, ...]:
        """The voltage followed by the memory, as the fit of a hysteresis alone needs it, in pieces of one length."""
        return path_of(self.extremes_V, self.voltage_V)

    @cached_property
    def samples(self) -> Samples:
        """The run padded and refined in time, as the fit of a stage needs it; a displacement it lacks is zero."""
        record, stride = self.record, self.stride
        refuse_many_steps(record, stride)
        n, time_s = len(record), record.time_s
        pad = (0, max(_SHORTEST, 1 << (n - 1).bit_length()) - n)
        step = even_interval_s(time_s)
        share = np.arange((n + pad[1] - 1) * stride + 1) / stride
        voltage = jnp.asarray(np.pad(record.voltage_V, pad, mode="edge"))
        if step is not None:
            time: Any = np.asarray(step / stride)
        else:
            more_s = np.diff(time_s).mean() * np.arange(1, pad[1] + 1)
            longer = np.concatenate([time_s, time_s[-1] + more_s])
            time = np.interp(share, np.arange(n + pad[1]), longer)
        measured = np.zeros(n) if record.displacement_um is None else record.displacement_um
        beside = {name: np.interp(share, np.arange(n), v) for name, v in columns_beside(record).items()}
        return Samples(
            time_s=jnp.asarray(time),
            voltage_V=_refined(voltage, stride, self.hold),
            displacement_um=jnp.asarray(np.pad(measured, pad, mode="edge")),
            weight=jnp.asarray(np.pad(self.fit_weight, pad)),
            rest_V=(rest_V := jnp.asarray(record.voltage_V[0] + record.charged_V)),
            start=m.Start(rest_V, staircase(self.extremes_V, _EXTREMES_OF_STAGE)),
            stride=stride,
            moving=self.moving,
            has_past=self.has_past,
            hold=self.hold,
            beside={name: jnp.asarray(values) for name, values in beside.items()},
        )

    def weighed(self, residual_um: np.ndarray) -> np.ndarray:
        """Make a residual as large as it counts, shape `(n,)`."""
        return residual_um if self.weight is None else np.sqrt(self.weight) * residual_um

    def without_nuisance(self, values: np.ndarray, among: np.ndarray) -> np.ndarray:
        """Take off the run's offset, and what its unknown past adds, fitted to some of the samples, shape `(n,)`."""
        weight = np.ones(len(values)) if self.weight is None else self.weight
        if not self.has_past:
            return values - float(np.average(values[among], weights=weight[among]))
        columns = np.asarray(past_columns(jnp.asarray(self.voltage_V)))
        columns = np.concatenate([np.ones((len(values), 1)), columns], axis=1)
        root = np.sqrt(weight[among])
        return values - columns @ np.linalg.lstsq(root[:, None] * columns[among], root * values[among], rcond=None)[0]


def prepare_run(
    record: Record,
    range_V: tuple[float, float],
    initial: Initial,
    holdout: float,
    stride: int = 1,
    gain: float | None = 1.0,
    hold: m.Hold = "first",
    usable: np.ndarray | None = None,
    estimated: bool = False,
) -> Run:
    """Make a record ready whose command stays in a range; a `DataError` if nothing of it is left to fit.

    The memory before the first sample is `initial`, one of `INITIAL_STATES` or extremes; a fraction at the end is
    held out. `gain` is None for a stage without a hysteresis, which no past is unknown of. Samples that are not
    `usable` are not known ones, shape `(n,)`; nor are those with an unknown past, unless that is `estimated`: then
    less is held out where the run goes farther at its end than before. For the others see `Run`.
    """
    n, (lower, upper) = len(record), range_V
    known = np.ones(n, dtype=bool) if gain is None else known_samples(record.voltage_V, lower, upper, initial)
    unknown = initial == "unknown"
    has_past = estimated and unknown and gain is not None
    if has_past:
        known = np.ones(n, dtype=bool)
    known = (known if usable is None else known & usable) & ~record.lost
    fitted = known.copy()
    if holdout > 0:
        first = n - round(holdout * n)
        if has_past and holdout < 1 and (reached := _as_far_as_it_goes(record.voltage_V)) > first:
            # Its past is learnt on the way there.
            first = (reached + n) // 2
        fitted[first:] = False
    if holdout < 1 and fitted.sum() < _FEWEST:
        raise DataError(
            f"{record.source}: only {fitted.sum()} samples are left to fit, {_FEWEST} are needed: the others come "
            "before the voltage has been at an end of its range, where its unknown history still counts, or are held "
            "out; state the initial state, hold out less, or start each run with a full loop"
        )
    ahead = 1.0 if gain is None else gain
    lower, upper = ahead * lower, ahead * upper
    start = initial_state(record.before_V if unknown and record.before_V else initial, lower, upper)
    return Run(record, lower, upper, start, known, fitted, None, ahead, stride, hold, unknown, has_past)


def prepare_runs(records: Sequence[Record], range_V: tuple[float, float], initial: str, holdout: float) -> list[Run]:
    """Make the records of a hysteresis alone ready, errors of `prepare_run`; see `pasts_to_estimate`."""
    unknown = initial == "unknown"
    pasts = pasts_to_estimate(records, range_V, holdout, SOME) if unknown else (False,) * len(records)
    pairs = zip(records, pasts, strict=True)
    return [prepare_run(one, range_V, initial, holdout, estimated=past) for one, past in pairs]


def prepare_aside(
    record: Record, range_V: tuple[float, float], initial: Initial, least: float | None = 0.0, **settings: Any
) -> Run:
    """Make a record ready that is predicted as a whole; for stride, gain and hold see `prepare_run`.

    An unknown past is estimated as `pasts_to_estimate` says, by default wherever samples depend on it.
    """
    past = initial == "unknown" and pasts_to_estimate([record], range_V, 0.0, least)[0]
    return prepare_run(record, range_V, initial, 1.0, estimated=past, **settings)


def _as_far_as_it_goes(voltage_V: np.ndarray) -> int:
    """Samples until a run has gone, but for a little of the way, as far both ways from where it began as it will."""
    gone_V = voltage_V - voltage_V[0]
    there = np.maximum.accumulate(gone_V) >= (1 - _ALMOST) * gone_V.max()
    there &= np.minimum.accumulate(gone_V) <= (1 - _ALMOST) * gone_V.min()
    return int(np.argmax(there)) + 1


def command_range_V(records: Sequence[Record]) -> tuple[float, float]:
    """Range of the commands of all records."""
    voltages = [record.voltage_V for record in records]
    return min(float(v.min()) for v in voltages), max(float(v.max()) for v in voltages)


def initial_state(initial: Initial, lower_V: float, upper_V: float) -> m.Staircase:
    """Make the memory before a record from its name, or its extremes."""
    return staircase(extremes_V(initial, lower_V, upper_V), _EXTREMES)


def initial_of(given: Initial | m.Staircase) -> Initial:
    """A memory as it is given in Python: by its name, or as that before a run of a fit."""
    if isinstance(given, m.Staircase):
        return tuple(np.asarray(given.extremes_V)[: int(given.count)].tolist())
    return given


def simulate_run(model: m.Preisach | Surface, run: Run) -> np.ndarray:
    """Predict the displacement of a run by a hysteresis alone, in um, shape `(n,)`; a surface has no offset."""
    surface, offset_um = (model, 0.0) if isinstance(model, Surface) else (surface_of(model), float(model.offset_um))
    return offset_um + np.concatenate([surface.respond(piece)[:, 0] for piece in run.path])


def surface_of(model: m.Preisach) -> Surface:
    """The Everett surface of a hysteresis of any family, without its offset."""
    grid = Grid(model.density.lower_V, model.density.upper_V, model.density.levels)
    return grid.surface(np.asarray(columns_of(model)))
