"""The Preisach operator in NumPy: for some thousand samples it is done before JAX is imported.

The algorithm is that of `Everett`, `remember` and `invert` in `microid`. The last axis of densities, tables and
outputs counts operators that share a grid.
"""

import abc
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fits.io._errors import DataError
from fits.io._limits import Ranges, measured_ranges
from fits.io._record import Record
from fits.loop._path import Path
from fits.loop._prediction import MOST_EXTREMES, PIECE, Initial, Prediction, inside, predict_from, too_deep
from fits.loop._surface import Surface, Visits, basis

INITIAL_STATES = ("unknown", "negative", "positive", "demagnetised")
_SWINGS = 31  # of a demagnetised state, as in `microid`
_STEPS = 128  # of a root, as in `microid`
_EPS = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Perturbations:
    """Independent perturbations of a hysteresis, each one standard deviation long; see `fits.Uncertainty`.

    Densities and slopes are those of `Surface.of`.
    """

    density: np.ndarray
    slope: np.ndarray
    range_V: tuple[float, float]
    offset_um: np.ndarray
    discrepancy_um: float

    def sd_um(self, pieces: Sequence[Path], progress: Callable[[str], None] = lambda _: None) -> np.ndarray:
        """Standard deviation of the displacement along a path of voltages, in pieces, `(n,)`."""
        surface, found = Surface.of(self.density, self.slope, *self.range_V), []
        for k, piece in enumerate(pieces):
            progress(f"predicting, {100 * k // len(pieces)} % done")
            found.append(self._sd_um(surface, Visits.of(surface, piece)))
        return np.concatenate(found)

    def _sd_um(self, surface: Surface, visits: Visits) -> np.ndarray:
        """The square root of a polynomial of the sixth degree for each visit: the sum of squared cubics."""
        square = np.zeros((len(visits.interval), 7))
        square[:, 0] = self.discrepancy_um**2
        for which, cubics in surface.cubics(visits):
            cubics[:, 0] += self.offset_um
            products = cubics @ np.moveaxis(cubics, 1, 2)
            for power, other in np.ndindex(4, 4):
                square[which, power + other] += products[:, power, other]
        coefficients, s = square[visits.of_sample], visits.fraction
        total = coefficients[:, 6]
        for power in range(5, -1, -1):
            total = total * s + coefficients[:, power]
        return np.sqrt(np.maximum(total, 0.0))


class PlainModel(abc.ABC):
    """A model that does without JAX; its `uncertainty` may be None, and `report` is that of its file."""

    uncertainty: Any
    report: Mapping[str, Any]

    @property
    @abc.abstractmethod
    def static(self) -> "PlainLoop":
        """The hysteresis between command and sensor, as slow commands see it."""

    @property
    @abc.abstractmethod
    def without_effects(self) -> "PlainModel":
        """The same model without effects of `microid.effects.EFFECTS`; itself where it has none."""

    def predict(
        self, record: Record, initial: Initial, progress: Callable[[str], None] = lambda _: None
    ) -> Prediction:
        """Predict the displacement of a voltage program; see `fits.predict`."""
        return predict_from(initial, lambda state: self.predict_known(record, state, progress))

    @abc.abstractmethod
    def predict_known(
        self, record: Record, initial: Initial, progress: Callable[[str], None] = lambda _: None
    ) -> Prediction:
        """The same from a memory that is known."""

    @abc.abstractmethod
    def play(self, record: Record, initial: str) -> np.ndarray:
        """Displacement under the voltage of a record, `(n,)`, in um; a `DataError` where it nests too deeply."""

    @abc.abstractmethod
    def ranges(self, program: Record, displacement_um: np.ndarray, initial: str) -> Ranges:
        """What a command is, and makes the model do, whose displacement at the samples, `(n,)`, is known."""


@dataclass(frozen=True)
class PlainLoop(PlainModel):
    """A hysteresis, and what its model file says beside; see `microid.Preisach` and `fits.ModelFile`."""

    surface: Surface
    offset_um: float
    uncertainty: Perturbations | None = None
    report: Mapping[str, Any] = field(default_factory=dict)

    @property
    def static(self) -> "PlainLoop":
        """The hysteresis itself."""
        return self

    @property
    def without_effects(self) -> "PlainLoop":
        """It has none."""
        return self

    @property
    def range_V(self) -> tuple[float, float]:
        """Range of the switching voltages."""
        return self.surface.lower_V, self.surface.upper_V

    @property
    def reach_um(self) -> tuple[float, float]:
        """Displacements at the ends of the range."""
        saturated = Path.of(*np.array(self.range_V)[:, None])
        return self.offset_um, self.offset_um + float(self.surface.respond(saturated)[0, 0])

    def predict_known(
        self, record: Record, initial: Initial, progress: Callable[[str], None] = lambda _: None
    ) -> Prediction:
        """See `PlainModel`."""
        record = inside(record, *self.range_V)
        path = self._path(record.voltage_V, initial)
        sd_um = np.full(len(record), np.nan)
        if self.uncertainty is not None:
            sd_um = self.uncertainty.sd_um(path, progress)
        return Prediction(self._respond(path), sd_um, record.warnings)

    def play(self, record: Record, initial: str) -> np.ndarray:
        """See `PlainModel`."""
        return self.respond(record.voltage_V, initial)

    def ranges(self, program: Record, displacement_um: np.ndarray, initial: str) -> Ranges:
        """See `PlainModel`: a hysteresis does nothing between the samples."""
        return measured_ranges(replace(program, displacement_um=displacement_um))

    def respond(self, voltage_V: np.ndarray, initial: Initial) -> np.ndarray:
        """Displacement along a voltage, `(n,)`, in um; a `DataError` where it nests too deeply."""
        return self._respond(self._path(voltage_V, initial))

    def _path(self, voltage_V: np.ndarray, initial: Initial) -> tuple[Path, ...]:
        return path_of(extremes_V(initial, *self.range_V), voltage_V)

    def _respond(self, path: tuple[Path, ...]) -> np.ndarray:
        return self.offset_um + np.concatenate([self.surface.respond(piece)[:, 0] for piece in path])

    def invert(self, wanted_um: np.ndarray, initial: str) -> tuple[np.ndarray, float, float]:
        """Voltage whose displacement is the one wanted, `(n,)`, and the ends of what can be reached, in um."""
        before, (lowest, highest) = extremes_V(initial, *self.range_V), self.reach_um
        already = self.offset_um + self.surface.respond(Path.of(before[:0], before))[:, 0]
        rounding = 8 * _EPS * max(abs(lowest), abs(highest))
        within = (wanted_um >= lowest - rounding) & (wanted_um <= highest + rounding)
        # The reference has its own memory: the displacements at the remembered extremes.
        path = Path.of(already, np.where(within, wanted_um, np.clip(wanted_um, lowest, highest)))
        return self._roots(path, before)[path.lead :], lowest, highest

    def _roots(self, path: Path, before_V: np.ndarray) -> np.ndarray:
        """Voltages of a path of displacements whose first entries are known: Newton's steps in a bracket."""
        surface, n = self.surface, self.surface.intervals
        lower, upper = surface.lower_V, surface.upper_V
        scale, window = n / (upper - lower), surface.window_um[..., 0]
        branches = surface.branch_um[..., 0].T.tolist()
        level = (path.values - self.offset_um).tolist()
        rounding = 2 * _EPS * max(map(abs, level))
        anchors, rising = path.anchor.tolist(), path.rising.tolist()
        voltage, spline, begins, of = before_V.tolist(), list[float](), 0.0, (-1, True)
        for k in range(path.lead, len(level)):
            a, up = anchors[k], rising[k]
            x0 = voltage[a]
            if of != (a, up):
                # What all points of a branch have in common: a spline in one voltage, and what it begins with.
                of, y = (a, up), (x0 - lower) * scale
                i = min(int(y), n - 1)
                s = y - i
                w = np.array(basis(s))
                spline = (-(window[:, i : i + 3] @ w) if up else w @ window[i : i + 3]).tolist()
                c0, c1, c2, c3 = branches[i if rising[a] else i + n]
                begins = c0 + s * (c1 + s * (c2 + s * c3))
            target = level[k] - level[a]
            low, high = (x0, upper) if up else (lower, x0)
            x = min(max(voltage[k - 1], low), high)
            step = 2 * (upper - lower)
            for _ in range(_STEPS):
                y = (x - lower) * scale
                i = min(int(y), n - 1)
                s = y - i
                c0, c1, c2, c3 = branches[i if up else i + n]
                g0, g1, g2 = spline[i : i + 3]
                off = (1 - s) ** 2 / 2 * g0 + (0.5 + s * (1 - s)) * g1 + s**2 / 2 * g2
                off += c0 + s * (c1 + s * (c2 + s * c3)) - begins
                off -= target
                if abs(off) <= rounding:
                    break
                low, high = (x, high) if off < 0 else (low, x)
                slope = ((s - 1) * g0 + (1 - 2 * s) * g1 + s * g2 + c1 + s * (2 * c2 + s * 3 * c3)) * scale
                new = x - off / slope if slope else np.inf
                # Newton's step, unless it leaves the bracket or is not half the last.
                if not (low <= new <= high and 2 * abs(new - x) <= abs(step)):
                    new = (low + high) / 2
                x, step = new, new - x
                if step == 0:
                    break
            voltage.append(x)
        return np.array(voltage)


def path_of(before_V: np.ndarray, voltage_V: np.ndarray) -> tuple[Path, ...]:
    """A voltage followed by the memory, in pieces of one length; a `DataError` where it nests too deeply."""
    pieces = tuple(Path.pieces(before_V, voltage_V, PIECE))
    if max(piece.depth[-1] for piece in pieces) >= MOST_EXTREMES:
        raise too_deep()
    return pieces


def extremes_V(initial: Initial, lower_V: float, upper_V: float) -> np.ndarray:
    """Extremes that a memory begins with, oldest first, by its name or as they are; see `microid.Staircase`.

    Negative saturation stands in for an unknown state, as the samples that would show the difference are not used. A
    `DataError` refuses another name.
    """
    if not isinstance(initial, str):
        return np.clip(initial, lower_V, upper_V)
    if initial not in INITIAL_STATES:
        raise DataError(f"unknown initial state {initial!r}: choose one of {', '.join(INITIAL_STATES)}")
    if initial == "demagnetised":
        rest, left = (lower_V + upper_V) / 2, 1 - np.arange(_SWINGS) / _SWINGS
        return np.append(rest + left[:, None] * (np.array([lower_V, upper_V]) - rest), rest)
    return np.array([lower_V, upper_V] if initial == "positive" else [lower_V])


def memory_named(name: str, report: Mapping[str, Any]) -> Initial:
    """A memory by its name: a state, or a fitted run, whose estimated memory it begins with.

    The `report` is that of a model file. A `DataError` says what it can be.
    """
    if name in INITIAL_STATES:
        return name
    runs = report.get("runs", ())
    for run in runs:
        if run["source"] in (name, os.path.basename(name)):
            return tuple(map(float, run["start_extremes_V"]))
    fitted = f", or a run of the fit ({', '.join(run['source'] for run in runs)})" if runs else ""
    raise DataError(
        f"initial memory: expected one of {', '.join(INITIAL_STATES)}{fitted}, found '{name}'; name one of these"
    )
