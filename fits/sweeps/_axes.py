"""The rows of a sweep: grids, drawn designs and lists, crossed and zipped, made as they are needed."""

import abc
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import qmc

from fits.io._errors import DataError
from fits.sweeps._types import FloatArray

SAMPLERS = ("random", "latin_hypercube", "sobol")
# Random rows are drawn in pieces of this many, each with a seed of its own, whatever the chunks are.
_PIECE = 4096
# A Latin hypercube is one permutation per axis, which must be held at once.
_LARGEST_HYPERCUBE = 10_000_000
# Within these, a normal variable is never infinite.
_TINY = 2.0**-54


@dataclass(frozen=True)
class Axis:
    """One parameter and how it varies, in the parameter's own unit.

    Attributes
    ----------
    parameter
        Name.
    relative
        Whether the values multiply the nominal one.
    values
        Of a grid or a list, or None where they are drawn.
    distribution
        `uniform`, `log` or `normal`, where they are drawn.
    first, second
        Low and high, or mean and standard deviation.
    """

    parameter: str
    relative: bool = False
    values: tuple[float, ...] | None = None
    distribution: str = "uniform"
    first: float = 0.0
    second: float = 1.0

    def quantile(self, chance: FloatArray) -> FloatArray:
        """Values at probabilities."""
        if self.distribution == "normal":
            return np.asarray(self.first + self.second * ndtri(np.clip(chance, _TINY, 1 - _TINY)))
        if self.distribution == "log":
            low, high = math.log(self.first), math.log(self.second)
            return np.clip(np.exp(low + (high - low) * chance), self.first, self.second)
        return np.clip(self.first + (self.second - self.first) * chance, self.first, self.second)


class AbstractGroup(abc.ABC):
    """Axes that run together; groups are crossed."""

    @property
    @abc.abstractmethod
    def axes(self) -> tuple[Axis, ...]:
        """Which."""

    @abc.abstractmethod
    def __len__(self) -> int: ...

    @abc.abstractmethod
    def at(self, place: NDArray[np.int64]) -> FloatArray:
        """Values at some places of the group, shape `(axes, n)`."""


class Listed(AbstractGroup):
    """Axes with stated values of one length: one axis of a grid, zipped axes, or the columns of a CSV."""

    def __init__(self, axes: Sequence[Axis], table: FloatArray):
        """Take axes and their values, shape `(axes, n)`."""
        self._axes, self._table = tuple(axes), table

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Which."""
        return self._axes

    def __len__(self) -> int:
        return self._table.shape[1]

    def at(self, place: NDArray[np.int64]) -> FloatArray:
        """Values at some places, shape `(axes, n)`."""
        return np.asarray(self._table[:, place])


class Drawn(AbstractGroup):
    """Axes that are drawn together: at random, in a Latin hypercube or as a Sobol sequence."""

    def __init__(self, axes: Sequence[Axis], method: str, rows: int, seed: int):
        """Take axes, one of `SAMPLERS`, how many rows and the seed.

        Raises
        ------
        DataError
            If the design is larger than its method can be.
        """
        self._axes, self._method, self._rows, self._seed = tuple(axes), method, rows, seed
        if method == "latin_hypercube" and rows > _LARGEST_HYPERCUBE:
            raise DataError(
                f"design.rows: a Latin hypercube has up to {_LARGEST_HYPERCUBE:,} rows, found {rows:,}; choose "
                'method = "sobol" or "random".'
            )
        if method == "sobol" and rows > 2**30:
            raise DataError(f'design.rows: a Sobol design has up to 2^30 rows, found {rows:,}; choose "random".')
        if method == "sobol" and len(axes) > qmc.Sobol.MAXDIM:
            raise DataError(f'design.method: a Sobol design has up to {qmc.Sobol.MAXDIM} axes; choose "random".')

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Which."""
        return self._axes

    def __len__(self) -> int:
        return self._rows

    def at(self, place: NDArray[np.int64]) -> FloatArray:
        """Values at some places, shape `(axes, n)`."""
        chance = np.empty((len(place), len(self._axes)))
        if self._method == "latin_hypercube":
            chance[:] = _hypercube(len(self._axes), self._rows, self._seed)[place]
        else:
            for piece in np.unique(place // _PIECE):
                here = place // _PIECE == piece
                chance[here] = self._piece(int(piece))[place[here] - piece * _PIECE]
        return np.stack([axis.quantile(chance[:, k]) for k, axis in enumerate(self._axes)])

    def _piece(self, piece: int) -> FloatArray:
        dimensions = len(self._axes)
        if self._method == "sobol":
            sampler = qmc.Sobol(dimensions, scramble=True, rng=np.random.default_rng(self._seed))
            if piece:
                sampler.fast_forward(piece * _PIECE)
            return np.asarray(sampler.random(_PIECE))
        rng = np.random.default_rng([self._seed, piece])
        return rng.random((_PIECE, dimensions))


@lru_cache(maxsize=1)
def _hypercube(dimensions: int, rows: int, seed: int) -> FloatArray:
    return np.asarray(qmc.LatinHypercube(dimensions, rng=np.random.default_rng(seed)).random(rows))


@dataclass(frozen=True)
class Plan:
    """All rows, as groups crossed with each other; the last runs fastest.

    Attributes
    ----------
    groups
        Crossed with each other and with `repeats`.
    repeats
        Rows there are by themselves, such as files: they run slowest.
    """

    groups: tuple[AbstractGroup, ...]
    repeats: int = 1

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Of all groups."""
        return tuple(axis for group in self.groups for axis in group.axes)

    def __len__(self) -> int:
        return self.repeats * math.prod(len(group) for group in self.groups)

    def values(self, rows: NDArray[np.int64]) -> dict[str, FloatArray]:
        """Values of all axes at some rows by parameter, shape `(n,)` each."""
        found: dict[str, FloatArray] = {}
        left = rows
        for group in reversed(self.groups):
            left, place = np.divmod(left, len(group))
            found |= {axis.parameter: row for axis, row in zip(group.axes, group.at(place), strict=True)}
        return {axis.parameter: found[axis.parameter] for axis in self.axes}

    def repeat_of(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Which of the rows there are by themselves, shape `(n,)`."""
        return rows // math.prod(len(group) for group in self.groups)
