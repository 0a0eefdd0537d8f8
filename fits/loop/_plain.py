"""The Preisach operator in NumPy: for some thousand samples it is done before JAX is imported.

The algorithm is that of `Everett`, `remember` and `invert` in `microid`. The last axis of densities, tables and
outputs counts operators that share a grid.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from fits.io._errors import DataError
from fits.io._record import Record
from fits.loop._path import Path
from fits.loop._prediction import MOST_EXTREMES, PIECE, Prediction, refuse_outside, too_deep

INITIAL_STATES = ("unknown", "negative", "positive", "demagnetised")
# Perturbations at a time, which with a few thousand samples stay in a processor's cache.
_BATCH = 32
_SWINGS = 31  # of a demagnetised state, as in `microid`
_STEPS = 128  # of a root, as in `microid`
_EPS = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Surface:
    """Everett surfaces of `k` densities; see `microid.Everett`.

    The shape of `window_um` is `(N + 1, N + 1, k)`, that of `branch_um` `(4, 2 N - 2, k)`.
    """

    lower_V: float
    upper_V: float
    window_um: np.ndarray
    branch_um: np.ndarray

    @classmethod
    def of(cls, density: np.ndarray, slope: np.ndarray, lower_V: float, upper_V: float) -> Self:
        """Integrate densities at the nodes, in um/V^2, `(N, N, k)`, and slopes on the diagonal, in um/V, `(N, k)`."""
        n = len(density)
        h, i = (upper_V - lower_V) / (n - 1), np.arange(n - 1)
        corner, side = density[np.arange(n), np.arange(n)], density[i + 1, i]
        nodes = continued(density)
        ghost = nodes[i, i + 1]
        window = h**2 * _running(_running(nodes).swapaxes(0, 1)).swapaxes(0, 1)
        # Along the diagonal: trapezoids of the rows up to it above, and of the columns of ghosts below it.
        rows = density.sum(axis=1) - (density[:, 0] + corner) / 2
        rising = _triangle(nodes, rows[:-1], rows[1:] - (corner[1:] + side) / 2)
        here = np.concatenate([ghost[:1] / 2, ghost[1:-1]]) + corner[1:-1] / 2
        none = np.zeros_like(ghost[:1])
        next_ = np.concatenate([none, ghost[1:] / 2])
        falling = _triangle(nodes.swapaxes(0, 1), np.concatenate([none, here]), next_)
        reversible = h * _pieces(slope[:-1], np.diff(slope, axis=0) / 2, np.zeros_like(slope[1:]))
        branch = np.concatenate([h**2 * rising + reversible, reversible - h**2 * falling], axis=1)
        return cls(lower_V, upper_V, window, branch)

    @property
    def intervals(self) -> int:
        """Number of intervals between levels, `N - 1`."""
        return self.branch_um.shape[1] // 2

    def place(self, voltage_V: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interval and fraction of it, at most those of the ends of the range."""
        scale = self.intervals / (self.upper_V - self.lower_V)
        x = (np.clip(voltage_V, self.lower_V, self.upper_V) - self.lower_V) * scale
        interval = np.minimum(x.astype(int), self.intervals - 1)
        return interval, x - interval

    def over(self, voltage_V: np.ndarray) -> np.ndarray:
        """Everett surfaces between all pairs of voltages, `(n, n, k)`, the higher first; see `microid.Everett`."""
        i, s = self.place(voltage_V)
        spline = np.zeros((len(i), len(self.window_um)))
        for p, part in enumerate(_basis(s)):
            spline[np.arange(len(i)), i + p] = part
        rising, falling = (self._branch(i, s, up) for up in (True, False))
        return rising[:, None] - np.einsum("ap,bq,pqk->abk", spline, spline, self.window_um, optimize=True) - falling

    def _branch(self, interval: np.ndarray, s: np.ndarray, rising: np.ndarray | bool) -> np.ndarray:
        c0, c1, c2, c3 = self.branch_um[:, np.where(rising, interval, interval + self.intervals)]
        s = s[:, None]
        return np.asarray(c0 + s * (c1 + s * (c2 + s * c3)))

    def respond(self, path: Path) -> np.ndarray:
        """Outputs along a path of voltages, zero at negative saturation (Eq. 11), in um, `(n, k)`."""
        i, s = self.place(path.values)
        up, i0, s0 = path.rising, i[path.anchor], s[path.anchor]
        a, b = np.where(up, i, i0), np.where(up, i0, i)
        left, right = _basis(np.where(up, s, s0)), _basis(np.where(up, s0, s))
        sign = np.where(up, -1.0, 1.0)
        total = np.zeros((len(i), self.window_um.shape[2]))
        for p, q in np.ndindex(3, 3):
            total += (sign * left[p] * right[q])[:, None] * self.window_um[a + p, b + q]
        return np.asarray(path.add(total) + self._branch(i, s, up))[path.lead :]


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

    def sd_um(self, pieces: Sequence[Path]) -> np.ndarray:
        """Standard deviation of the displacement along a path of voltages, in pieces, `(n,)`."""
        square = [np.full(len(piece.values) - piece.lead, self.discrepancy_um**2) for piece in pieces]
        for k in range(0, len(self.offset_um), _BATCH):
            batch = slice(k, k + _BATCH)
            surface = Surface.of(self.density[..., batch], self.slope[:, batch], *self.range_V)
            for piece, sum_um2 in zip(pieces, square, strict=True):
                sum_um2 += np.sum((surface.respond(piece) + self.offset_um[batch]) ** 2, axis=1)
        return np.sqrt(np.concatenate(square))


@dataclass(frozen=True)
class PlainLoop:
    """A hysteresis, and what its model file says beside; see `microid.Preisach` and `fits.ModelFile`."""

    surface: Surface
    offset_um: float
    uncertainty: Perturbations | None = None
    report: Mapping[str, Any] = field(default_factory=dict)

    @property
    def range_V(self) -> tuple[float, float]:
        """Range of the switching voltages."""
        return self.surface.lower_V, self.surface.upper_V

    @property
    def reach_um(self) -> tuple[float, float]:
        """Displacements at the ends of the range."""
        saturated = Path.of(*np.array(self.range_V)[:, None])
        return self.offset_um, self.offset_um + float(self.surface.respond(saturated)[0, 0])

    def predict(self, record: Record, initial: str) -> Prediction:
        """Predict the displacement of a voltage program; see `fits.predict`."""
        refuse_outside(record, *self.range_V)
        path = self._path(record.voltage_V, initial)
        sd_um = np.full(len(record), np.nan) if self.uncertainty is None else self.uncertainty.sd_um(path)
        return Prediction(self._respond(path), sd_um)

    def respond(self, voltage_V: np.ndarray, initial: str) -> np.ndarray:
        """Displacement along a voltage, `(n,)`, in um; a `DataError` where it nests too deeply."""
        return self._respond(self._path(voltage_V, initial))

    def _path(self, voltage_V: np.ndarray, initial: str) -> tuple[Path, ...]:
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
                w = np.array(_basis(s))
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


def extremes_V(initial: str, lower_V: float, upper_V: float) -> np.ndarray:
    """Extremes that a memory begins with, oldest first, by its name; see `microid.Staircase`.

    Negative saturation stands in for an unknown state, as the samples that would show the difference are not used. A
    `DataError` refuses another name.
    """
    if initial not in INITIAL_STATES:
        raise DataError(f"unknown initial state {initial!r}: choose one of {', '.join(INITIAL_STATES)}")
    if initial == "demagnetised":
        rest, left = (lower_V + upper_V) / 2, 1 - np.arange(_SWINGS) / _SWINGS
        return np.append(rest + left[:, None] * (np.array([lower_V, upper_V]) - rest), rest)
    return np.array([lower_V, upper_V] if initial == "positive" else [lower_V])


def spread(packed: np.ndarray, levels: int) -> np.ndarray:
    """Values row by row over the half-plane, `(N (N + 1) / 2, k)` to `(N, N, k)`."""
    nodes = np.zeros((levels, levels, packed.shape[1]))
    nodes[np.tril_indices(levels)] = packed
    return nodes


def continued(density: np.ndarray) -> np.ndarray:
    """Densities with the node below each diagonal triangle that makes the bilinear form linear on it, `(N, N, k)`."""
    i, nodes = np.arange(len(density) - 1), density.copy()
    nodes[i, i + 1] += density[i, i] + density[i + 1, i + 1] - density[i + 1, i]
    return nodes


def _sums(values: np.ndarray) -> np.ndarray:
    return np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])


def _running(nodes: np.ndarray) -> np.ndarray:
    """B-spline coefficients of the integral, from the first node on, of the hat functions along axis 0."""
    return _sums(nodes) - nodes[:1] / 2


def _pieces(c1: np.ndarray, c2: np.ndarray, c3: np.ndarray) -> np.ndarray:
    return np.stack([_sums(c1 + c2 + c3)[:-1], c1, c2, c3])


def _triangle(nodes: np.ndarray, here: np.ndarray, next_: np.ndarray) -> np.ndarray:
    """Integrate over `0 <= y <= x` up to `x`: cubics on every interval, in units of the step squared."""
    i = np.arange(len(nodes) - 1)
    p, q, r = nodes[i, i], nodes[i + 1, i], nodes[i, i + 1]
    return _pieces(here, (next_ - here + p) / 2, (q - p + (r - p) / 2) / 3)


def _basis(s: Any) -> tuple[Any, Any, Any]:
    return (1 - s) ** 2 / 2, 0.5 + s * (1 - s), s**2 / 2
