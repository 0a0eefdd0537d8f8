"""The Preisach operator in NumPy: for some thousand samples it is done before JAX is imported.

The algorithm is that of `Everett`, `remember` and `invert` in `microid`. The last axis of densities, tables and
outputs counts operators that share a grid.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np

from fits.io._errors import DataError
from fits.io._record import Record
from fits.loop._prediction import MOST_EXTREMES, PIECE, Prediction, refuse_outside, too_deep

INITIAL_STATES = ("unknown", "negative", "positive", "demagnetised")
# Perturbations at a time, which with a few thousand samples stay in a processor's cache.
_BATCH = 32
_SWINGS = 31  # of a demagnetised state, as in `microid`
_STEPS = 128  # of a root, as in `microid`
_EPS = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Path:
    """Extremes of the memory to begin with, `lead` of them, and what follows; see `microid.Memory`.

    A branch to each entry hangs from its anchor, and is rising or not. `depth` counts the anchors back to the first.
    """

    values: np.ndarray
    anchor: np.ndarray
    rising: np.ndarray
    depth: np.ndarray
    lead: int = 0

    @classmethod
    def of(cls, before: np.ndarray, then: Sequence[float] | np.ndarray = ()) -> Self:
        """Find the extreme that each branch hangs from, in one pass with a stack (Madelung's rules)."""
        values = np.append(before, then)
        path = values.tolist()
        anchor, rising, depth = [0], [True], [0]
        stack, up, last = [0], True, path[0]
        for t, x in enumerate(path[1:], 1):
            # An entry that does not move belongs to the branch of the one before it.
            if x != last and (x > last) != up:
                up = not up
                stack.append(t - 1)
            while len(stack) > 2 and (path[stack[-2]] <= x if up else path[stack[-2]] >= x):
                del stack[-2:]
            anchor.append(stack[-1])
            rising.append(up)
            depth.append(depth[stack[-1]] + 1)
            last = x
        return cls(values, np.array(anchor), np.array(rising), np.array(depth), len(before))

    @cached_property
    def levels(self) -> list[np.ndarray]:
        """Entries whose anchor is not the first, by their depth: each adds to one of the level before."""
        order = np.argsort(self.depth, kind="stable")
        return np.split(order, np.searchsorted(self.depth[order], np.arange(2, self.depth.max() + 1)))[1:]


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
        # The node below each diagonal triangle that makes the bilinear form linear on it.
        ghost = corner[:-1] + corner[1:] - side
        nodes = density.copy()
        nodes[i, i + 1] += ghost
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
        total[0] = 0.0
        for rows in path.levels:
            total[rows] += total[path.anchor[rows]]
        c0, c1, c2, c3 = self.branch_um[:, np.where(up, i, i + self.intervals)]
        s = s[:, None]
        return np.asarray(total + (c0 + s * (c1 + s * (c2 + s * c3))))[path.lead :]


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

    def sd_um(self, path: Path) -> np.ndarray:
        """Standard deviation of the displacement along a path of voltages, `(n,)`."""
        square = np.full(len(path.values) - path.lead, self.discrepancy_um**2)
        for k in range(0, len(self.offset_um), _BATCH):
            batch = slice(k, k + _BATCH)
            surface = Surface.of(self.density[..., batch], self.slope[:, batch], *self.range_V)
            square += np.sum((surface.respond(path) + self.offset_um[batch]) ** 2, axis=1)
        return np.sqrt(square)


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
        return Prediction(self.offset_um + self.surface.respond(path)[:, 0], sd_um)

    def respond(self, voltage_V: np.ndarray, initial: str) -> np.ndarray:
        """Displacement along a voltage, `(n,)`, in um; a `DataError` where it nests too deeply."""
        return self.offset_um + self.surface.respond(self._path(voltage_V, initial))[:, 0]

    def _path(self, voltage_V: np.ndarray, initial: str) -> Path:
        path = Path.of(extremes_V(initial, *self.range_V), voltage_V)
        depth = path.depth[path.lead :]
        if max(depth[PIECE - 1 :: PIECE].max(initial=0), depth[-1]) >= MOST_EXTREMES:
            raise too_deep()
        return path

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
