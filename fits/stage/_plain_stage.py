"""A stage of linear parts and effects around one hysteresis in NumPy: it has answered before JAX is imported.

The algorithm is that of `microid.Stage` and `fits.StageUncertainty`.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np

from fits.io._limits import Ranges, joined, measured_ranges
from fits.io._record import Record
from fits.io._threads import one_thread
from fits.loop._path import Path
from fits.loop._plain import PlainLoop, PlainModel, extremes_V
from fits.loop._plain_file import ODD, array_of, fields_of, plain_loop, read_directions, read_law
from fits.loop._prediction import Initial, Prediction, inside
from fits.loop._stepped import intervals, stepped
from fits.loop._surface import Surface
from fits.stage._declared import tools
from fits.stage._plain_parts import PlainEffect, PlainLinear, PlainPart, around, read_part, through

if TYPE_CHECKING:
    from microid._in_numpy import _NumpySignal
else:
    _NumpySignal = tools()._NumpySignal

_P = ParamSpec("_P")
_R = TypeVar("_R")
_MOST_SUBSTEPS = 1000
_STAGE = "parts", "names", "hold", "substeps", "frozen"
_UNCERTAINTY = "coordinates", "columns_um", "mean_um", "discrepancy_um", "grid"
# The imaginary part of a parameter along which derivatives are taken, in units of its coordinate: its square is lost.
_TINY = 1e-30
# Samples whose perturbations are held at a time, and perturbations that pass through effects at a time.
_PIECE, _AT_ONCE = 2048, 64


def _in_numpy(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compute in one thread, and let pass what is not finite, which is refused where it is written."""
    return one_thread(np.errstate(all="ignore")(function), with_scipy=False)


@dataclass(frozen=True)
class Directions:
    """Independent perturbations of a stage, each one standard deviation long; see `fits.StageUncertainty`.

    The free parameters are places of parts, names of fields and places in these; `coordinates` is `(k, p)` and
    `mean_um` is `(k,)`. Densities and slopes are those of `Surface.of`.
    """

    free: tuple[tuple[int, str, tuple[int, ...]], ...]
    coordinates: np.ndarray
    density: np.ndarray
    slope: np.ndarray
    range_V: tuple[float, float]
    mean_um: np.ndarray
    discrepancy_um: float


@dataclass(frozen=True)
class PlainStage(PlainModel):
    """Parts in series around a hysteresis, and what their model file says beside; see `microid.Stage`.

    The hysteresis `law` stands where the parts change from a voltage to a displacement; `hold` is `first` or `zero`.
    """

    parts: tuple[PlainPart, ...]
    law: PlainLoop
    hold: str = "first"
    substeps: int = 1
    uncertainty: Directions | None = None
    report: Mapping[str, Any] = field(default_factory=dict)

    @property
    def range_V(self) -> tuple[float, float]:
        """Range of the commands."""
        return self.static.range_V

    @property
    def static(self) -> PlainLoop:
        """The hysteresis with the static gains folded in, without effects."""
        ahead, behind = around(self.parts)
        gain, surface = float(behind.gain.real), self.law.surface
        lower_V, upper_V = (float((end / ahead.gain).real) for end in self.law.range_V)
        folded = Surface(lower_V, upper_V, gain * surface.window_um, gain * surface.branch_um)
        return PlainLoop(folded, float(behind.offset.real) + gain * self.law.offset_um)

    @cached_property
    def without_effects(self) -> "PlainStage":
        """See `PlainModel`."""
        linear = tuple(part for part in self.parts if isinstance(part, PlainLinear))
        return self if len(linear) == len(self.parts) else replace(self, parts=linear, uncertainty=None)

    @_in_numpy
    def predict_known(
        self, record: Record, initial: Initial, progress: Callable[[str], None] = lambda _: None
    ) -> Prediction:
        """See `PlainModel`."""
        record = inside(record, *self.range_V)
        sd_um = np.full(len(record), np.nan)
        if self.uncertainty is not None:
            sd_um = self._sd_um(self.uncertainty, record, initial, progress)
        moved_um = self._respond(self.parts, record, initial, self.substeps)[:: self.substeps]
        return Prediction(moved_um, sd_um, record.warnings)

    @_in_numpy
    def play(self, record: Record, initial: str) -> np.ndarray:
        """See `PlainModel`."""
        return self._respond(self.parts, record, initial, self.substeps, as_run=False)[:: self.substeps]

    @_in_numpy
    def ranges(self, program: Record, displacement_um: np.ndarray, initial: str) -> Ranges:
        """See `PlainModel`: between the samples the mechanics ring."""
        found = measured_ranges(replace(program, displacement_um=displacement_um))
        if len(program) < 2:
            return found
        mechanics = (part.values for part in self.parts if part.kind == "Mechanics")
        steps = fine_steps([values["natural_frequency_Hz"].real for values in mechanics], program)
        if steps == 1:
            return found
        between = self._respond(self.parts, program, initial, steps)
        return joined([found, {"displacement": (float(between.min()), float(between.max()))}])

    def _respond(
        self, parts: Sequence[PlainPart], record: Record, initial: Initial, steps: int, as_run: bool = True
    ) -> np.ndarray:
        """Displacement at so many steps between samples, `((n - 1) steps + 1,)`, complex where a parameter is."""
        interval_s, command_V = stepped(record, steps, self.hold, as_run)
        voltage = self._ahead(parts, interval_s, command_V)
        given = self._switched(voltage, initial)
        found = through((part for part in parts if not part.ahead), interval_s, given)
        return found.values[: (len(record) - 1) * steps + 1, 0]

    def _ahead(self, parts: Sequence[PlainPart], interval_s: np.ndarray, command_V: np.ndarray) -> _NumpySignal:
        """What the hysteresis sees of a command."""
        command = _NumpySignal(command_V[:, None], command_V[:1], self.hold)
        return through((part for part in parts if part.ahead), interval_s, command)

    def _switched(self, voltage: _NumpySignal, initial: Initial) -> _NumpySignal:
        """What the hysteresis makes of what it sees."""
        displacement = self.law.respond(np.append(voltage.before, voltage.values[:, 0]), initial)[:, None]
        return voltage._replace(values=displacement[1:], before=displacement[0])

    def _sd_um(
        self, known: Directions, record: Record, initial: Initial, progress: Callable[[str], None]
    ) -> np.ndarray:
        """Standard deviation of the displacement, `(n,)`: to first order in all perturbations."""
        slope_um = np.zeros((len(record), len(known.free)))
        for k in np.flatnonzero(np.any(known.coordinates, axis=0)):
            progress("predicting")
            slope_um[:, k] = self._slope_um(*known.free[k], record, initial)
        found, first, n = [], 0, len(record)
        for columns_um in self._columns_um(known, record, initial):
            progress(f"predicting, {100 * first // n} % done")
            own = slope_um[first : first + len(columns_um)] @ known.coordinates.T
            found.append(np.sum((columns_um + own - known.mean_um) ** 2, axis=1))
            first += len(columns_um)
        return np.sqrt(np.concatenate(found) + known.discrepancy_um**2)

    def _slope_um(self, place: int, name: str, at: tuple[int, ...], record: Record, initial: Initial) -> np.ndarray:
        """Derivative of the displacement by the coordinate of one parameter, `(n,)`."""
        part, parts = self.parts[place], list(self.parts)
        value = np.array(part.values[name], dtype=complex)
        value[at] += 1j * _TINY * part.fields[name].slope(float(value[at].real))
        parts[place] = replace(part, values={**part.values, name: value[()]})
        return np.imag(self._respond(parts, record, initial, self.substeps)[:: self.substeps]) / _TINY

    def _columns_um(self, known: Directions, record: Record, initial: Initial) -> Iterator[np.ndarray]:
        """What perturbations of the hysteresis do to the displacement, some samples at a time, `(samples, k)`."""
        interval_s, command_V = stepped(record, self.substeps, self.hold, as_run=True)
        voltage = self._ahead(self.parts, interval_s, command_V)
        voltage_V = voltage.values[:: self.substeps, 0]
        surface = Surface.of(known.density, known.slope, *known.range_V)
        pieces = Path.pieces(extremes_V(initial, *self.law.range_V), voltage_V[: len(record)], _PIECE)
        responses = (surface.respond(piece) for piece in pieces)
        behind = tuple(part for part in self.parts if not part.ahead)
        between = "zero" if voltage.hold == "zero" else "first", voltage.settling_s
        if any(isinstance(part, PlainEffect) for part in behind):
            around_um = self._switched(voltage, initial).values[:: self.substeps, 0]
            each_s = self.substeps * interval_s[:: self.substeps]
            yield from _beside(behind, each_s, around_um, responses, between)
            return
        system = around(behind)[1]
        yield from system.follow(intervals(record.time_s), responses, *between)


def _beside(
    parts: Sequence[PlainPart],
    interval_s: np.ndarray,
    around_um: np.ndarray,
    responses: Iterator[np.ndarray],
    between: tuple[str, complex | None],
) -> Iterator[np.ndarray]:
    """Pass changes of a signal, `(t,)`, on through parts to first order: what is not linear needs a whole record."""
    whole = np.concatenate(list(responses))
    count, behind = len(whole), ((0, len(around_um) - len(whole)), (0, 0))
    around_um = np.pad(around_um[:count, None], behind, mode="edge")
    for first in range(0, whole.shape[1], _AT_ONCE):
        some = np.pad(whole[:, first : first + _AT_ONCE], behind, mode="edge")
        values = around_um + 1j * _TINY * some
        found = through(parts, interval_s, _NumpySignal(values, values[0], *between)).values
        whole[:, first : first + _AT_ONCE] = np.imag(found[:count]) / _TINY
    yield from (whole[first : first + _PIECE] for first in range(0, count, _PIECE))


def fine_steps(resonances_Hz: Sequence[float], record: Record) -> int:
    """Steps between the samples of a record that show how a stage with some resonances rings."""
    # Of 16 steps in a period a sampled sine misses less than 2 % of its peak.
    wanted = 16 * float(np.median(np.diff(record.time_s))) * max(resonances_Hz, default=0.0)
    # In powers of two, so that few programs are compiled; what rings between samples that are so far apart that the
    # run has more steps in all has died away.
    return int(2 ** math.ceil(math.log2(min(max(wanted, 1.0), max((1 << 18) / len(record), 1.0)))))


def plain_model(content: Mapping[str, Any]) -> PlainModel | None:
    """The hysteresis or the stage of a model file, as `read_model_text` gives it.

    None where JAX is to take it, and to say what is wrong with it: a stage where it is not made of drivers, one
    Preisach operator on a grid, mechanics, sensors and effects that have a form in NumPy, under a command in lines or
    steps, and where anything is odd.
    """
    try:
        return _stage(content) if content["model"]["type"] == "Stage" else plain_loop(content)
    except ODD:
        return None


def _stage(content: Mapping[str, Any]) -> PlainStage | None:
    """A `PlainStage`; None, or one of the exceptions `ODD`, where it is another."""
    items, names, hold, substeps, frozen = fields_of(content["model"], "Stage", *_STAGE)
    (place,) = (k for k, item in enumerate(items) if item["type"] == "Preisach")
    parts = tuple(read_part(item) for item in (*items[:place], *items[place + 1 :]))
    stage = PlainStage(parts, read_law(items[place]), hold, substeps, report=content["fit"])
    others = [*names[:place], *names[place + 1 :]]
    fields = {f"{name}.{field}" for name, part in zip(others, parts, strict=True) for field in part.fields}
    gains = [part.system().gain.real for part in parts if isinstance(part, PlainLinear)]
    if not (
        all(part.ahead == (k < place) for k, part in enumerate(parts))
        and len({*names}) == len(names)
        and all(0 < gain < np.inf for gain in gains)
        and hold in ("first", "zero")
        and type(substeps) is int
        and 1 <= substeps <= _MOST_SUBSTEPS
        and {*frozen} <= {*names, *fields}
    ):
        return None
    known, free = content["uncertainty"], _free(others, parts, frozen)
    return stage if known is None else replace(stage, uncertainty=_directions(known, parts, free))


def _free(
    names: Sequence[str], parts: Sequence[PlainPart], frozen: Sequence[str]
) -> tuple[tuple[int, str, tuple[int, ...]], ...]:
    """Parameters that a fit has moved, in the order of its coordinates; see `fits.stage._chain.offsets_out`."""
    return tuple(
        (place, field, at)
        for place, (name, part) in enumerate(zip(names, parts, strict=True))
        for field, said in part.fields.items()
        for at in np.ndindex(said.shape)
        if not {name, f"{name}.{field}"} & {*frozen} and not field.endswith("offset_um")
    )


def _directions(
    item: Mapping[str, Any], parts: Sequence[PlainPart], free: tuple[tuple[int, str, tuple[int, ...]], ...]
) -> Directions:
    coordinates, columns, mean, discrepancy, grid = fields_of(item, "StageUncertainty", *_UNCERTAINTY)
    coordinates, columns_um = array_of(coordinates, 2, packed=True), array_of(columns, 2, packed=True)
    mean_um = array_of(mean, 1, packed=True)
    if not len(mean_um) == len(columns_um) == len(coordinates) > 0 or coordinates.shape[1] != len(free):
        raise ValueError("another shape")
    for (place, name, at), moves in zip(free, coordinates.T, strict=True):
        part = parts[place]
        if not part.fields[name].inside(float(np.asarray(part.values[name])[at])):
            raise ValueError("on a bound")
        if isinstance(part, PlainEffect) and name in part.history and np.any(moves):
            raise ValueError("something may go on from before the record")
    moved = read_directions(columns_um, grid)
    return Directions(free, coordinates, *moved, mean_um, float(array_of(discrepancy, 0)))
