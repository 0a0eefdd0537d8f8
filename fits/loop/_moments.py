"""All that least squares needs to know of records: sums of products, per block."""

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.loop._design import Grid, branch_table, design
from fits.loop._past import past_columns
from fits.loop._run import Run
from fits.stats._compress import Compressed, compress
from microid import Staircase

# Groups of four pseudo-samples that go through the compiled regression at a time: few, so that little is padded,
# or many, where the products of many columns pay for it.
_FEW, _MANY = 256, 512
_MANY_LEVELS = 32
BLOCKS = 5
# Squares below which a column is nothing, and parts of the largest below which a combination of columns is.
_TINY, _SHOWN = 1e-300, 1e-11


def _zero_dimensional(value: Any) -> Any:
    """Turn what NumPy's arithmetic makes of arrays without axes back into such."""
    return np.asarray(value) if isinstance(value, float | np.generic) else value


class Moments(eqx.Module):
    """Sums over `count` samples of the products of responses, which have no dimension, and displacement.

    `gram` is of responses with responses, `cross_um` with displacement, `energy_um2` of displacement with itself.
    """

    gram: Float[Array | np.ndarray, "D D"]
    cross_um: Float[Array | np.ndarray, " D"]
    energy_um2: Float[Array | np.ndarray, ""] = eqx.field(converter=_zero_dimensional)
    count: Float[Array | np.ndarray, ""] = eqx.field(converter=_zero_dimensional)

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
        return Moments(
            self.gram * count,
            self.cross_um * (count / unit_um),
            self.energy_um2 * (count / unit_um**2),
            self.count * count,
        )

    def project(self, basis: Float[Array | np.ndarray, "D d"]) -> "Moments":
        """Keep only combinations of columns."""
        return Moments(basis.T @ self.gram @ basis, basis.T @ self.cross_um, self.energy_um2, self.count)


@dataclass(frozen=True)
class RunMean:
    """Mean response and displacement of a run: its sensor offset is `displacement_um - response @ solution`."""

    response: np.ndarray
    displacement_um: float
    count: float


@dataclass(frozen=True)
class Data:
    """Moments of all runs, over all fitted samples and over fifths of every run's, each from its own mean."""

    grid: Grid
    total: Moments
    blocks: tuple[Moments, ...]
    means: tuple[RunMean, ...]


def blocks_of(run: Run, pieces: int = BLOCKS) -> np.ndarray:
    """Number fifths of the fitted samples, -1 elsewhere, shape `(n,)`: each is every fifth of so many pieces."""
    order = np.cumsum(run.fitted) - 1
    return np.where(run.fitted, order * pieces // max(1, run.fitted.sum()) % BLOCKS, -1)


def grid_of(runs: Sequence[Run], levels: int) -> Grid:
    """A grid over the range of some runs, which is that of each."""
    return Grid(jnp.asarray(runs[0].lower_V), jnp.asarray(runs[0].upper_V), levels)


def gather(grid: Grid, runs: Sequence[Run], pieces: int = BLOCKS) -> Data:
    """Pass runs with displacement through the regression once; blocks are made of so many pieces of each run."""
    centred: list[list[Moments]] = []
    means = []
    levels_V = np.linspace(float(grid.lower_V), float(grid.upper_V), grid.levels)
    for run in runs:
        path = run.path
        branches = run.voltage_V, run.displacement_um, path.anchor_V, path.rising
        groups = compress(*branches, blocks_of(run, pieces), levels_V, run.weight)
        past = np.zeros((groups.voltage_V.size, 0))
        if run.has_past:
            past = np.asarray(past_columns(jnp.asarray(groups.voltage_V.ravel())))
        sums = _sums(grid, groups, path.starts[0], past.reshape(*groups.voltage_V.shape, past.shape[1]))
        total, mean = _without_nuisance(reduce(operator.add, sums), grid.columns)
        centred.append([total, *(_without_nuisance(part, grid.columns)[0] for part in sums)])
        means.append(mean)
    whole, *blocks = (reduce(operator.add, parts) for parts in zip(*centred, strict=True))
    return Data(grid, whole, tuple(blocks), tuple(means))


def _sums(grid: Grid, groups: Compressed, start: Staircase, past: np.ndarray) -> list[Moments]:
    """Moments per block, with the nuisance parameters at the end: columns of a past, `(groups, 4, k)`, and ones."""
    size = grid.columns + past.shape[2] + 1
    sums = [Moments.empty(size) for _ in range(BLOCKS)]
    table = jnp.asarray(branch_table(grid.levels))
    length = _MANY if grid.levels > _MANY_LEVELS else _FEW
    for begin in range(0, len(groups.block), length):
        piece = slice(begin, begin + length)
        pad = (0, length - len(groups.block[piece]))
        voltage = np.pad(groups.voltage_V[piece].ravel(), (0, 4 * pad[1]), mode="edge")
        mix = np.pad(groups.mix[piece], (pad, (0, 0), (0, 0)))
        mixed, start = _regress(grid, table, jnp.asarray(voltage), start, jnp.asarray(mix))
        beside = np.einsum("gij,gjk->gik", groups.mix[piece], past[piece]).reshape(
            4 * len(past[piece]), past.shape[2]
        )
        rows = np.asarray(mixed)[: len(beside)]
        rows = np.concatenate([rows[:, :-1], beside, rows[:, -1:]], axis=1)
        for block in np.unique(groups.block[piece]):
            if block < 0:
                continue
            which = groups.block[piece] == block
            # NumPy hands `a.T @ a` to BLAS as a rank-k update.
            part = rows[np.repeat(which, 4)]
            target = groups.target_um[piece][which].ravel()
            energy = target @ target + groups.residue_um2[piece][which].sum()
            count = np.asarray(groups.count[piece][which].sum(), dtype=float)
            sums[block] = sums[block] + Moments(part.T @ part, target @ part, energy, count)
    return sums


@eqx.filter_jit
def _regress(
    grid: Grid,
    table: Float[Array, "4 k D"],
    voltage_V: Float[Array, " n"],
    start: Staircase,
    mix: Float[Array, "groups 4 4"],
) -> tuple[Float[Array, "n E"], Staircase]:
    response, end = design(grid, table, voltage_V, start)
    response = jnp.concatenate([response, jnp.ones_like(response[:, :1])], axis=1)
    mixed = jnp.einsum("gij,gjd->gid", mix, response.reshape(*mix.shape[:2], -1))
    return mixed.reshape(response.shape), end


def _without_nuisance(sums: Moments, size: int) -> tuple[Moments, RunMean]:
    """Eliminate a run's nuisance parameters, all unknowns but the first `size`; the last of them is its offset."""
    gram, cross = np.asarray(sums.gram), np.asarray(sums.cross_um)
    scale = np.sqrt(np.maximum(np.diagonal(gram)[size:], _TINY))
    block = gram[size:, size:] / scale / scale[:, None]
    # A past that has ended before a block is not seen in it.
    inverse = np.linalg.pinv(block, rcond=_SHOWN, hermitian=True) / scale / scale[:, None]
    follow, answer = inverse @ gram[size:, :size], inverse @ cross[size:]
    reduced = Moments(
        gram[:size, :size] - gram[:size, size:] @ follow,
        cross[:size] - gram[:size, size:] @ answer,
        sums.energy_um2 - cross[size:] @ answer,
        sums.count,
    )
    return reduced, RunMean(follow[-1], float(answer[-1]), float(sums.count))
