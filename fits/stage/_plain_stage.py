"""A stage of linear parts around one hysteresis in NumPy, and its model file: it has answered before JAX is imported.

The algorithm is that of `microid.Stage` and `fits.StageUncertainty`.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any

import numpy as np

from fits.io._limits import Ranges, joined, measured_ranges
from fits.io._record import Record
from fits.loop._path import Path
from fits.loop._plain import PlainLoop, PlainModel, extremes_V
from fits.loop._plain_file import ODD, array_of, fields_of, plain_loop, read_directions, read_law
from fits.loop._prediction import Prediction, refuse_outside
from fits.loop._stepped import intervals, stepped
from fits.loop._surface import Surface
from fits.stage._plain_linear import SYSTEMS, Linear, PlainPart, declared

_MOST_SUBSTEPS = 1000
_STAGE = "parts", "names", "hold", "substeps", "frozen"
_UNCERTAINTY = "coordinates", "columns_um", "mean_um", "discrepancy_um", "grid"
# The imaginary part of a parameter along which derivatives are taken, in units of its coordinate: its square is lost.
_TINY = 1e-30
# Samples whose perturbations are held at a time.
_PIECE = 2048


@dataclass(frozen=True)
class Directions:
    """Independent perturbations of a stage, each one standard deviation long; see `fits.StageUncertainty`.

    The free parameters are places of parts and names of fields; `coordinates` is `(k, p)` and `mean_um` is `(k,)`.
    Densities and slopes are those of `Surface.of`.
    """

    free: tuple[tuple[int, str], ...]
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
        """The hysteresis with the static gains folded in."""
        ahead, behind = _around(self.parts)
        gain, surface = float(behind.gain.real), self.law.surface
        lower_V, upper_V = (float((end / ahead.gain).real) for end in self.law.range_V)
        folded = Surface(lower_V, upper_V, gain * surface.window_um, gain * surface.branch_um)
        return PlainLoop(folded, float(behind.offset.real) + gain * self.law.offset_um)

    # What is not finite is refused where it is written.
    @np.errstate(all="ignore")
    def predict(self, record: Record, initial: str, progress: Callable[[str], None] = lambda _: None) -> Prediction:
        """See `PlainModel`."""
        refuse_outside(record, *self.range_V)
        sd_um = np.full(len(record), np.nan)
        if self.uncertainty is not None:
            sd_um = self._sd_um(self.uncertainty, record, initial, progress)
        return Prediction(self._respond(self.parts, record, initial, self.substeps)[:: self.substeps], sd_um)

    @np.errstate(all="ignore")
    def play(self, record: Record, initial: str) -> np.ndarray:
        """See `PlainModel`."""
        return self._respond(self.parts, record, initial, self.substeps, as_run=False)[:: self.substeps]

    @np.errstate(all="ignore")
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
        self, parts: Sequence[PlainPart], record: Record, initial: str, steps: int, as_run: bool = True
    ) -> np.ndarray:
        """Displacement at so many steps between samples, `((n - 1) steps + 1,)`, complex where a parameter is."""
        ahead, behind = _around(parts)
        interval_s, command_V = stepped(record, steps, self.hold, as_run)
        voltage, before, hold = _through(ahead, interval_s, command_V, command_V[0], self.hold)
        displacement = self.law.respond(np.append(before, voltage), initial)
        found, _, _ = _through(behind, interval_s, displacement[1:], displacement[0], hold)
        return found[: (len(record) - 1) * steps + 1]

    def _sd_um(self, known: Directions, record: Record, initial: str, progress: Callable[[str], None]) -> np.ndarray:
        """Standard deviation of the displacement, `(n,)`: to first order in all perturbations."""
        slope_um = np.empty((len(record), len(known.free)))
        for k, (place, name) in enumerate(known.free):
            progress("predicting")
            slope_um[:, k] = self._slope_um(place, name, record, initial)
        found, first, n = [], 0, len(record)
        for columns_um in self._columns_um(known, record, initial):
            progress(f"predicting, {100 * first // n} % done")
            own = slope_um[first : first + len(columns_um)] @ known.coordinates.T
            found.append(np.sum((columns_um + own - known.mean_um) ** 2, axis=1))
            first += len(columns_um)
        return np.sqrt(np.concatenate(found) + known.discrepancy_um**2)

    def _slope_um(self, place: int, name: str, record: Record, initial: str) -> np.ndarray:
        """Derivative of the displacement by the coordinate of one parameter, `(n,)`."""
        part, parts = self.parts[place], list(self.parts)
        value = part.values[name]
        moved = value + 1j * _TINY * part.fields[name].slope(value.real)
        parts[place] = replace(part, values={**part.values, name: moved})
        return np.imag(self._respond(parts, record, initial, self.substeps)[:: self.substeps]) / _TINY

    def _columns_um(self, known: Directions, record: Record, initial: str) -> Iterator[np.ndarray]:
        """What perturbations of the hysteresis do to the displacement, some samples at a time, `(samples, k)`."""
        ahead, behind = _around(self.parts)
        interval_s, command_V = stepped(record, self.substeps, self.hold, as_run=True)
        voltage_V, _, _ = _through(ahead, interval_s, command_V, command_V[0], self.hold)
        surface = Surface.of(known.density, known.slope, *known.range_V)
        between_s = intervals(record.time_s)
        if len(between_s) > 1:
            # The state before the first sample is one of rest, which no interval changes.
            between_s = np.append(between_s[:1], between_s)
        states, last, first = np.zeros((len(behind.rest), len(known.mean_um))), None, 0
        for piece in Path.pieces(
            extremes_V(initial, *self.law.range_V), voltage_V[:: self.substeps][: len(record)], _PIECE
        ):
            response = surface.respond(piece)
            # At rest before the first sample.
            change = np.diff(response, axis=0, prepend=response[:1] if last is None else last)
            each = between_s if len(between_s) == 1 else between_s[first : first + len(response)]
            moved, states = behind.move(each, change, states, "first")
            yield behind.gain * response + moved
            last, first = response[-1:], first + len(response)


def fine_steps(resonances_Hz: Sequence[float], record: Record) -> int:
    """Steps between the samples of a record that show how a stage with some resonances rings."""
    # Of 16 steps in a period a sampled sine misses less than 2 % of its peak.
    wanted = 16 * float(np.median(np.diff(record.time_s))) * max(resonances_Hz, default=0.0)
    # In powers of two, so that few programs are compiled; what rings between samples that are so far apart that the
    # run has more steps in all has died away.
    return int(2 ** math.ceil(math.log2(min(max(wanted, 1.0), max((1 << 18) / len(record), 1.0)))))


def _around(parts: Sequence[PlainPart]) -> tuple[Linear, Linear]:
    """What stands ahead of the hysteresis and behind it, as one system each."""
    ahead, behind = (
        reduce(Linear.then, (part.system() for part in parts if part.ahead == first), Linear.memoryless(1.0))
        for first in (True, False)
    )
    return ahead, behind


def _through(
    system: Linear, interval_s: np.ndarray, values: np.ndarray, before: complex, hold: str
) -> tuple[np.ndarray, complex, str]:
    """Pass a signal, `(t,)`, through a system at rest: what comes out, what did before, and how it runs between."""
    found = system.respond(interval_s, values[:, None], np.array([before]), hold)[:, 0]
    if len(system.rest):
        # Behind a step even what comes out of an inertia may have a corner.
        hold = "first" if hold == "zero" else "smooth"
    return found, system.offset + system.gain * before, hold


def plain_model(content: Mapping[str, Any]) -> PlainModel | None:
    """The hysteresis or the stage of a model file, as `read_model_text` gives it.

    None where JAX is to take it, and to say what is wrong with it: a stage where it is not made of drivers, one
    Preisach operator on a grid, mechanics and sensors, under a command in lines or steps, and where anything is odd.
    """
    try:
        return _stage(content) if content["model"]["type"] == "Stage" else plain_loop(content)
    except ODD:
        return None


def _stage(content: Mapping[str, Any]) -> PlainStage | None:
    """A `PlainStage`; None, or one of the exceptions `ODD`, where it is another."""
    items, names, hold, substeps, frozen = fields_of(content["model"], "Stage", *_STAGE)
    (place,) = (k for k, item in enumerate(items) if item["type"] == "Preisach")
    parts = tuple(_part(item) for item in (*items[:place], *items[place + 1 :]))
    stage = PlainStage(parts, read_law(items[place]), hold, substeps, report=content["fit"])
    others = [*names[:place], *names[place + 1 :]]
    fields = {f"{name}.{field}" for name, part in zip(others, parts, strict=True) for field in part.fields}
    gains = [part.system().gain.real for part in parts]
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


def _part(item: Mapping[str, Any]) -> PlainPart:
    if item["type"] not in SYSTEMS:
        raise ValueError("another part")
    fields = declared()[item["type"]]
    values = zip(fields.items(), fields_of(item, item["type"], *fields), strict=True)
    return PlainPart(
        item["type"], {name: float(array_of(value, 0, said.unit, said.lower)) for (name, said), value in values}
    )


def _free(names: Sequence[str], parts: Sequence[PlainPart], frozen: Sequence[str]) -> tuple[tuple[int, str], ...]:
    """Parameters that a fit has moved, in the order of its coordinates; see `fits.stage._moments.offsets_out`."""
    return tuple(
        (place, field)
        for place, (name, part) in enumerate(zip(names, parts, strict=True))
        for field in part.fields
        if not {name, f"{name}.{field}"} & {*frozen} and not field.endswith("offset_um")
    )


def _directions(item: Mapping[str, Any], parts: Sequence[PlainPart], free: tuple[tuple[int, str], ...]) -> Directions:
    coordinates, columns, mean, discrepancy, grid = fields_of(item, "StageUncertainty", *_UNCERTAINTY)
    coordinates, columns_um = array_of(coordinates, 2, packed=True), array_of(columns, 2, packed=True)
    mean_um = array_of(mean, 1, packed=True)
    if not len(mean_um) == len(columns_um) == len(coordinates) > 0 or coordinates.shape[1] != len(free):
        raise ValueError("another shape")
    if not all(parts[place].fields[name].inside(parts[place].values[name].real) for place, name in free):
        raise ValueError("on a bound")
    moved = read_directions(columns_um, grid)
    return Directions(free, coordinates, *moved, mean_um, float(array_of(discrepancy, 0)))
