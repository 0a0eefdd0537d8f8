"""Everett surfaces in NumPy, and what is read off them; see `microid.Everett`."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from fits.loop._path import Path

# Numbers of a coefficient that are computed at a time: few enough to stay in a processor's cache.
_VALUES = 65_536


@dataclass(frozen=True)
class Visits:
    """Stretches of a path that lie on one branch and between two levels, along which every output is a cubic.

    Of each visit there is the interval between levels, whether it is `rising`, and the place of its anchor among the
    `turns`: the path of those entries alone from which branches hang. Each sample has the `fraction` of the interval
    where it is, and the number of its visit. Visits that come back, with all that is remembered the same, are one.
    """

    interval: np.ndarray
    rising: np.ndarray
    anchor: np.ndarray
    turns: Path
    fraction: np.ndarray
    of_sample: np.ndarray

    @classmethod
    def of(cls, surface: "Surface", path: Path) -> Self:
        """Divide what follows the lead of a path."""
        interval, fraction = surface.place(path.values[path.lead :])
        anchor, rising = path.anchor[path.lead :], path.rising[path.lead :]
        begins = np.ones(len(interval), dtype=bool)
        begins[1:] = (np.diff(interval) != 0) | (np.diff(anchor) != 0) | (rising[1:] != rising[:-1])
        first = np.flatnonzero(begins)
        turns, where = path.turns
        at = _alike(turns)[where[path.lead :][first]]
        key = (at * surface.intervals + interval[first]) * 2 + rising[first]
        _, one, number = np.unique(key, return_index=True, return_inverse=True)
        which = first[one]
        return cls(interval[which], rising[which], at[one], turns, fraction, number[np.cumsum(begins) - 1])


def _alike(turns: Path) -> np.ndarray:
    """The first entry before which, and in which, all that is remembered is the same, for each entry, `(n,)`."""
    first: dict[tuple[float, int], int] = {}
    found: list[int] = []
    for k, (value, anchor) in enumerate(zip(turns.values.tolist(), turns.anchor.tolist(), strict=True)):
        found.append(first.setdefault((value, found[anchor] if anchor < k else -1), k))
    return np.array(found)


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
        """Interval and fraction of it, at most those of the ends of the range; complex voltages have one, too."""
        scale = self.intervals / (self.upper_V - self.lower_V)
        x = (np.clip(voltage_V, self.lower_V, self.upper_V) - self.lower_V) * scale
        interval = np.minimum(x.real.astype(int), self.intervals - 1)
        return interval, x - interval

    def over(self, voltage_V: np.ndarray) -> np.ndarray:
        """Everett surfaces between all pairs of voltages, `(n, n, k)`, the higher first; see `microid.Everett`."""
        i, s = self.place(voltage_V)
        spline = np.zeros((len(i), len(self.window_um)))
        for p, part in enumerate(basis(s)):
            spline[np.arange(len(i)), i + p] = part
        rising, falling = (self._branch(i, s, up) for up in (True, False))
        return rising[:, None] - np.einsum("ap,bq,pqk->abk", spline, spline, self.window_um, optimize=True) - falling

    def respond(self, path: Path) -> np.ndarray:
        """Outputs along a path of voltages, zero at negative saturation (Eq. 11), in um, `(n, k)`."""
        visits = Visits.of(self, path)
        cubics = np.concatenate([part for _, part in self.cubics(visits)])
        c0, c1, c2, c3 = np.moveaxis(cubics[visits.of_sample], 1, 0)
        s = visits.fraction[:, None]
        return np.asarray(c0 + s * (c1 + s * (c2 + s * c3)))

    def cubics(self, visits: Visits) -> Iterator[tuple[slice, np.ndarray]]:
        """Outputs along visits, some at a time, by powers of the fraction of the interval, `(visits, 4, k)`."""
        turns, columns = visits.turns, self.window_um.shape[2]
        i, s = self.place(turns.values)
        square = self._squares(i, turns.rising, i[turns.anchor], s[turns.anchor])
        total = turns.add(square[0] + s[:, None] * (square[1] + s[:, None] * square[2]))
        for first in range(0, len(visits.interval), length := max(_VALUES // columns, 1)):
            which = slice(first, first + length)
            interval, up, anchor = visits.interval[which], visits.rising[which], visits.anchor[which]
            out = self.branch_um[:, np.where(up, interval, interval + self.intervals)].astype(s.dtype, copy=False)
            for power, one in enumerate(self._squares(interval, up, i[anchor], s[anchor])):
                out[power] += one
            out[0] += total[anchor]
            yield which, np.moveaxis(out, 0, 1)

    def _squares(self, i: np.ndarray, up: np.ndarray, i0: np.ndarray, s0: np.ndarray) -> list[np.ndarray]:
        """What branches from places in intervals to others add, by powers of the fraction of the latter, `(n, k)`."""
        spline = []
        for p in range(3):
            one: Any = 0.0
            for q, part in enumerate(basis(s0)):
                a, b = np.where(up, i + p, i0 + q), np.where(up, i0 + q, i + p)
                one = one + np.where(up, -part, part)[:, None] * self.window_um[a, b]
            spline.append(one)
        g0, g1, g2 = spline
        return [(g0 + g1) / 2, g1 - g0, (g0 + g2) / 2 - g1]

    def _branch(self, interval: np.ndarray, s: np.ndarray, rising: bool) -> np.ndarray:
        c0, c1, c2, c3 = self.branch_um[:, interval if rising else interval + self.intervals]
        s = s[:, None]
        return np.asarray(c0 + s * (c1 + s * (c2 + s * c3)))


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


def basis(s: Any) -> tuple[Any, Any, Any]:
    return (1 - s) ** 2 / 2, 0.5 + s * (1 - s), s**2 / 2
