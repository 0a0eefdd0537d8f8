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
from fits.loop._run import Run
from fits.stats._compress import Compressed, compress
from microid import Staircase

# Groups of four pseudo-samples that go through the compiled regression at a time: few, so that little is padded,
# or many, where the products of many columns pay for it.
_FEW, _MANY = 256, 512
_MANY_LEVELS = 32
BLOCKS = 5


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


def blocks_of(run: Run) -> np.ndarray:
    """Number consecutive fifths of the fitted samples, -1 elsewhere, shape `(n,)`."""
    order = np.cumsum(run.fitted) - 1
    return np.where(run.fitted, order * BLOCKS // max(1, run.fitted.sum()), -1)


def grid_of(runs: Sequence[Run], levels: int) -> Grid:
    """A grid over the range of some runs, which is that of each."""
    return Grid(jnp.asarray(runs[0].lower_V), jnp.asarray(runs[0].upper_V), levels)


def gather(grid: Grid, runs: Sequence[Run]) -> Data:
    """Pass runs with displacement through the regression once."""
    centred: list[list[Moments]] = []
    means = []
    levels_V = np.linspace(float(grid.lower_V), float(grid.upper_V), grid.levels)
    for run in runs:
        path = run.path
        branches = run.voltage_V, run.displacement_um, path.anchor_V, path.rising
        sums = _sums(grid, compress(*branches, blocks_of(run), levels_V, run.weight), path.starts[0])
        total, mean = _centre(reduce(operator.add, sums))
        centred.append([total, *(_centre(part)[0] for part in sums)])
        means.append(mean)
    whole, *blocks = (reduce(operator.add, parts) for parts in zip(*centred, strict=True))
    return Data(grid, whole, tuple(blocks), tuple(means))


def _sums(grid: Grid, groups: Compressed, start: Staircase) -> list[Moments]:
    """Moments per block, with a column of ones at the end and no mean taken off."""
    size = grid.columns + 1
    sums = [Moments.empty(size) for _ in range(BLOCKS)]
    table = jnp.asarray(branch_table(grid.levels))
    length = _MANY if grid.levels > _MANY_LEVELS else _FEW
    for begin in range(0, len(groups.block), length):
        piece = slice(begin, begin + length)
        pad = (0, length - len(groups.block[piece]))
        voltage = np.pad(groups.voltage_V[piece].ravel(), (0, 4 * pad[1]), mode="edge")
        mix = np.pad(groups.mix[piece], (pad, (0, 0), (0, 0)))
        mixed, start = _regress(grid, table, jnp.asarray(voltage), start, jnp.asarray(mix))
        rows = np.asarray(mixed)
        for block in np.unique(groups.block[piece]):
            if block < 0:
                continue
            # Blocks are consecutive, so this is one slice; NumPy hands `a.T @ a` to BLAS as a rank-k update.
            which = np.flatnonzero(groups.block[piece] == block)
            part = rows[4 * which[0] : 4 * (which[-1] + 1)]
            target = groups.target_um[piece][which[0] : which[-1] + 1].ravel()
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


def _centre(sums: Moments) -> tuple[Moments, RunMean]:
    """Take the mean off, and with it the last column."""
    count = np.maximum(sums.count, 1.0)
    response, displacement = sums.gram[-1, :-1] / count, sums.cross_um[-1] / count
    centred = Moments(
        sums.gram[:-1, :-1] - count * response[:, None] * response[None, :],
        sums.cross_um[:-1] - count * response * displacement,
        sums.energy_um2 - count * displacement**2,
        sums.count,
    )
    return centred, RunMean(np.asarray(response), float(displacement), float(sums.count))
