"""All that least squares needs to know of records: sums of products, per block.

Within one interval of the levels and on one branch, the response to every column is a cubic in the voltage. However
many samples fall there, four numbers carry all that they say: a visit of more than four samples is replaced by four
voltages and a 4 x 4 mixing matrix. What a fit costs then depends on the path, not on the sampling rate.
"""

import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import reduce
from itertools import pairwise
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.loop._design import Columns, Grid, Responses, branch_table, rectangles
from fits.loop._past import past_columns
from fits.loop._path import Path, branches
from fits.loop._prediction import PIECE
from fits.loop._run import Run

_SLOTS = 4
_NEGLIGIBLE = 1e-14
# Pieces of a path whose samples are grouped at a time.
_AT_ONCE = 16
# How many such parts are gone through in silence: a million samples.
_TOLD = 8
# Numbers of which responses are made at a time, 16 MB, and rows that are: these stay in a processor's cache.
_VALUES, _ROWS = 2_000_000, 512
BLOCKS = 5
# Short enough for each block to have seen all of a record: fifths of one that swings ever farther would not.
PIECES = 40


@dataclass(frozen=True)
class Compressed:
    """Groups of four voltages, in the order of the path.

    Sums of squares and products of `mix @ response(voltage_V) ~ target_um` equal those of the samples; the squares
    that no response could explain are in `residue_um2`. `block` is -1, and `mix` zero, where samples are not used;
    `count` is their number, each as often as it counts. A group is a `whole` visit, or its samples are not mixed.
    """

    voltage_V: np.ndarray
    mix: np.ndarray
    target_um: np.ndarray
    block: np.ndarray
    count: np.ndarray
    residue_um2: np.ndarray
    whole: np.ndarray

    def some(self, which: slice) -> Self:
        """Some of the groups."""
        return replace(self, **{field.name: getattr(self, field.name)[which] for field in fields(self)})

    def order(self, path: Path) -> tuple[np.ndarray, np.ndarray]:
        """Entries that are used, `(m,)`, block by block, like branches together; and where each block begins."""
        level_V = np.where(self.whole[:, None], self.voltage_V[:, 1:2], self.voltage_V).ravel()
        block = np.repeat(self.block, _SLOTS)
        order = np.lexsort((level_V, path.rising[path.lead :], block))
        bounds = np.searchsorted(block[order], np.arange(BLOCKS + 1))
        return order[bounds[0] :], bounds - bounds[0]


def compressed(run: Run, levels_V: np.ndarray, pieces: int) -> Iterator[Compressed]:
    """Group the samples of a run, some pieces of its path at a time: a long one takes no more memory than that."""
    block, many = blocks_of(run, pieces), len(run.path) if run.has_past else _AT_ONCE
    for k in range(0, len(run.path), many):
        yield _compress(run, run.path[k : k + many], slice(k * PIECE, (k + many) * PIECE), levels_V, block)


def _compress(run: Run, path: Sequence[Path], samples: slice, levels_V: np.ndarray, block: np.ndarray) -> Compressed:
    """Group samples by their branches, see `Path`, and by evenly spaced levels; see `blocks_of`."""
    voltage_V, displacement_um, block = run.voltage_V[samples], run.displacement_um[samples], block[samples]
    anchor_V, rising = branches(path)
    share = np.ones(len(voltage_V)) if run.weight is None else run.weight[samples]
    step = levels_V[1] - levels_V[0]
    cell = np.clip(((voltage_V - levels_V[0]) / step).astype(np.int64), 0, len(levels_V) - 2)
    changed = (np.diff(anchor_V) != 0) | (np.diff(rising) != 0) | (np.diff(cell) != 0) | (np.diff(block) != 0)
    first = _group_starts(np.concatenate([[True], changed]), block)
    last = np.append(first[1:], len(voltage_V)) - 1
    size = last - first + 1
    group = np.repeat(np.arange(len(first)), size)
    dense = size > _SLOTS

    # Samples as they are, the last one repeated to fill its group.
    slot = np.minimum(np.arange(_SLOTS)[None, :], size[:, None] - 1) + first[:, None]
    filled = np.arange(_SLOTS)[None, :] < size[:, None]
    voltage, target = voltage_V[slot], np.where(filled, displacement_um[slot], 0.0)
    root = np.sqrt(share)[slot] * filled
    target *= root
    mix = np.eye(_SLOTS)[None] * root[:, :, None]
    residue = np.zeros(len(first))

    # Visits of many samples: moments of the fraction of the way, then the square root of their Gram matrix.
    start, span = voltage_V[first], voltage_V[last] - voltage_V[first]
    safe = np.where(np.abs(span) <= 1e-12 * step, 1.0, span)  # it stands still
    way = (voltage_V - start[group]) / safe[group]
    powers = np.vander(way, 2 * _SLOTS - 1, increasing=True)
    powers *= share[:, None]
    moments = np.add.reduceat(powers, first)[dense]
    cross = np.add.reduceat(powers[:, :_SLOTS] * displacement_um[:, None], first)[dense]
    energy = np.add.reduceat(share * displacement_um**2, first)[dense]
    hankel = moments[:, np.arange(_SLOTS)[:, None] + np.arange(_SLOTS)[None, :]]
    # Chebyshev-Lobatto nodes, which include the ends, so that every reversal stays in the path; and the coefficients
    # of the polynomials that are 1 at one of them.
    nodes = (1 - np.cos(np.pi * np.arange(_SLOTS) / (_SLOTS - 1))) / 2
    lagrange = np.linalg.inv(np.vander(nodes, increasing=True)).T
    root, right, left = square_root(lagrange @ hankel @ lagrange.T, cross @ lagrange.T, energy)
    voltage[dense] = start[dense, None] + span[dense, None] * nodes
    mix[dense], target[dense], residue[dense] = root, right, left

    used = block[first] >= 0
    return Compressed(
        voltage_V=voltage,
        mix=np.where(used[:, None, None], mix, 0.0),
        target_um=np.where(used[:, None], target, 0.0),
        block=block[first],
        count=np.where(used, np.add.reduceat(share, first), 0.0),
        residue_um2=np.where(used, residue, 0.0),
        whole=dense,
    )


def _group_starts(visit_starts: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Keep visits of many samples whole; pack the samples of short ones together, four by four."""
    n = len(visit_starts)
    first = np.flatnonzero(visit_starts)
    dense = np.repeat(np.diff(np.append(first, n)) > _SLOTS, np.diff(np.append(first, n)))
    # A stretch of short visits ends at a dense one and at the border of a block.
    border = np.concatenate([[True], (np.diff(dense) != 0) | (np.diff(block) != 0)]) | (visit_starts & dense)
    opening = np.maximum.accumulate(np.where(border, np.arange(n), 0))
    packed = ~dense & ((np.arange(n) - opening) % _SLOTS == 0)
    return np.flatnonzero(border | packed)


def square_root(
    gram: np.ndarray, cross: np.ndarray, energy: np.ndarray, negligible: float = _NEGLIGIBLE
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Factor each `gram = root' root`, solve `root' target = cross`, and what that leaves of the energies.

    Directions that hold less than a part of the largest are dropped.
    """
    value, vector = np.linalg.eigh(gram)
    kept = value > negligible * value[:, -1:]
    scale = np.sqrt(np.where(kept, value, 0.0))
    root = scale[:, :, None] * np.swapaxes(vector, 1, 2)
    seen = np.einsum("gij,gi->gj", vector, cross)
    target = np.where(kept, seen / np.where(kept, scale, 1.0), 0.0)
    return root, target, np.maximum(energy - np.sum(target**2, axis=1), 0.0)


def zero_dimensional(value: Any) -> Any:
    """Turn what NumPy's arithmetic makes of arrays without axes back into such."""
    return np.asarray(value) if isinstance(value, float | np.generic) else value


class Moments(eqx.Module):
    """Sums over `count` samples of the products of responses, which have no dimension, and displacement.

    `gram` is of responses with responses, `cross_um` with displacement, `energy_um2` of displacement with itself.
    """

    gram: Float[Array | np.ndarray, "D D"]
    cross_um: Float[Array | np.ndarray, " D"]
    energy_um2: Float[Array | np.ndarray, ""] = eqx.field(converter=zero_dimensional)
    count: Float[Array | np.ndarray, ""] = eqx.field(converter=zero_dimensional)

    @classmethod
    def empty(cls, size: int) -> "Moments":
        """Of no sample."""
        return cls(np.zeros((size, size)), np.zeros(size), np.zeros(()), np.zeros(()))

    def __add__(self, other: "Moments") -> "Moments":
        return Moments(*map(operator.add, jax.tree.leaves(self), jax.tree.leaves(other)))

    def __sub__(self, other: "Moments") -> "Moments":
        return Moments(*map(operator.sub, jax.tree.leaves(self), jax.tree.leaves(other)))

    def scaled(self, count: Float[Array, ""] | float, unit_um: float) -> "Moments":
        """Measure displacement in `unit_um`, and count each sample as `count` independent ones."""
        cross_um, energy_um2 = self.cross_um * (count / unit_um), self.energy_um2 * (count / unit_um**2)
        return Moments(self.gram * count, cross_um, energy_um2, self.count * count)

    def project(self, basis: Float[Array | np.ndarray, "D d"]) -> "Moments":
        """Keep only combinations of columns."""
        return Moments(basis.T @ self.gram @ basis, basis.T @ self.cross_um, self.energy_um2, self.count)

    def moved(self, which: np.ndarray, by: np.ndarray) -> "Moments":
        """Move some unknowns, of these numbers, `(k,)`, by as much, and keep the others."""
        gram, cross = np.asarray(self.gram), np.asarray(self.cross_um)
        kept = np.setdiff1d(np.arange(len(cross)), which)
        energy = np.asarray(self.energy_um2) - 2 * cross[which] @ by + by @ gram[np.ix_(which, which)] @ by
        return Moments(gram[np.ix_(kept, kept)], cross[kept] - gram[np.ix_(kept, which)] @ by, energy, self.count)

    def reduced(self, size: int, answer: np.ndarray, follow: np.ndarray) -> "Moments":
        """Keep the first `size` unknowns, the others being best at `answer - follow @ first`, of the shape `(p,)`."""
        gram, cross = np.asarray(self.gram), np.asarray(self.cross_um)
        beside, energy = gram[:size, size:], np.asarray(self.energy_um2) - cross[size:] @ answer
        return Moments(gram[:size, :size] - beside @ follow, cross[:size] - beside @ answer, energy, self.count)


@dataclass(frozen=True)
class RunMean:
    """Mean response and displacement of a run: its sensor offset is `displacement_um - response @ solution`."""

    response: np.ndarray
    displacement_um: float
    count: float


@dataclass(frozen=True)
class Data:
    """Moments of all runs, over all fitted samples and over blocks of them, each from its own mean.

    A block is every fifth of so many `pieces` of every run.
    """

    grid: Grid
    total: Moments
    blocks: tuple[Moments, ...]
    means: tuple[RunMean, ...]
    pieces: int = PIECES


def blocks_of(run: Run, pieces: int) -> np.ndarray:
    """Number blocks of the fitted samples, -1 elsewhere, shape `(n,)`: each is every fifth of so many pieces."""
    order = np.cumsum(run.fitted) - 1
    return np.where(run.fitted, order * pieces // max(1, run.fitted.sum()) % BLOCKS, -1)


def grid_of(runs: Sequence[Run], levels: int) -> Grid:
    """A grid over the range of some runs, which is that of each."""
    lower_V, upper_V = (jnp.asarray(np.float64(end)) for end in (runs[0].lower_V, runs[0].upper_V))
    return Grid(lower_V, upper_V, int(levels))


def gather(
    grid: Grid,
    runs: Sequence[Run],
    pieces: int = PIECES,
    progress: Callable[[str], None] = lambda _: None,
    beside: Columns | None = None,
) -> Data:
    """Pass runs with displacement through the regression once; blocks are made of so many pieces of each run.

    Told is how far that is in long runs. Behind the columns of the grid there may be others `beside` them, of finer
    levels among which are those of the grid.
    """
    centred: list[list[Moments]] = []
    means = []
    kinds = [Columns(branch_table(grid.levels), grid.weights, rectangles), *([] if beside is None else [beside])]
    levels_V, size = np.linspace(*grid.ends_V, kinds[-1].levels), sum(kind.size for kind in kinds)
    for run in runs:
        sums = _sums(kinds, run, _told(compressed(run, levels_V, pieces), run, progress))
        total, mean = without_nuisance(reduce(operator.add, sums), size)
        centred.append([total, *(without_nuisance(part, size)[0] for part in sums)])
        means.append(mean)
    whole, *blocks = (reduce(operator.add, parts) for parts in zip(*centred, strict=True))
    return Data(grid, whole, tuple(blocks), tuple(means), pieces)


def _told(parts: Iterator[Compressed], run: Run, progress: Callable[[str], None]) -> Iterator[Compressed]:
    """Tell from time to time how many samples are done."""
    for k, part in enumerate(parts, 1):
        yield part
        if k % _TOLD == 0:
            progress(f"  {k * _AT_ONCE * PIECE:,} of {len(run.record):,} samples")


def _sums(kinds: Sequence[Columns], run: Run, parts: Iterable[Compressed]) -> list[Moments]:
    """Moments per block, with the nuisance parameters at the end: those of a past that is estimated, and ones."""
    sums: list[Moments] = []
    ends = np.cumsum([0, *(kind.size for kind in kinds)])
    before_V, length = run.extremes_V, max(_VALUES // (_SLOTS * kinds[-1].levels), 1)
    for groups in parts:
        for begin in range(0, len(groups.block), length):
            some = groups.some(slice(begin, begin + length))
            path = Path.of(before_V, some.voltage_V.ravel())
            before_V = path.end
            order, bounds = some.order(path)
            beside = _beside(run, some)
            nuisance = (some.mix @ beside).reshape(-1, beside.shape[2])[order].T
            place = (run.lower_V, run.upper_V), path, some.mix, some.whole, order
            responses = [Responses(kind, *place) for kind in kinds]
            target_um = some.target_um.ravel()[order]
            sums = sums or [Moments.empty(ends[-1] + len(nuisance))] * BLOCKS
            space = np.empty((len(sums[0].cross_um), _ROWS))
            for number, (first, stop) in enumerate(pairwise(bounds)):
                energy, count = (each[some.block == number].sum() for each in (some.residue_um2, some.count))
                gram, cross = np.zeros_like(sums[number].gram), np.zeros_like(sums[number].cross_um)
                for k in range(first, stop, _ROWS):
                    which = slice(k, min(k + _ROWS, stop))
                    rows = space[:, : which.stop - k]
                    for one, (above, below) in zip(responses, pairwise(ends), strict=True):
                        one.write(which, rows[above:below])
                    rows[ends[-1] :] = nuisance[:, which]
                    # NumPy hands `a @ a.T` to BLAS as a rank-k update.
                    gram += rows @ rows.T
                    cross += rows @ target_um[which]
                    energy += target_um[which] @ target_um[which]
                sums[number] = sums[number] + Moments(gram, cross, energy, count)
    return sums


def _beside(run: Run, groups: Compressed) -> np.ndarray:
    """Columns of the nuisance parameters, `(groups, 4, k)`."""
    ones = np.ones((*groups.voltage_V.shape, 1))
    if not run.has_past:
        return ones
    past = np.asarray(past_columns(jnp.asarray(groups.voltage_V.ravel())))
    return np.concatenate([past.reshape(*groups.voltage_V.shape, -1), ones], axis=2)


def without_nuisance(sums: Moments, size: int) -> tuple[Moments, RunMean]:
    """Eliminate a run's nuisance parameters, all unknowns but the first `size`; the last of them is its offset."""
    gram, cross = np.asarray(sums.gram), np.asarray(sums.cross_um)
    scale = np.sqrt(np.maximum(np.diagonal(gram)[size:], 1e-300))
    block = gram[size:, size:] / scale / scale[:, None]
    # A past that has ended before a block is not seen in it.
    inverse = np.linalg.pinv(block, rcond=1e-11, hermitian=True) / scale / scale[:, None]
    follow, answer = inverse @ gram[size:, :size], inverse @ cross[size:]
    return sums.reduced(size, answer, follow), RunMean(follow[-1], float(answer[-1]), float(sums.count))
