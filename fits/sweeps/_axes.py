"""The rows of a sweep: grids, drawn designs and lists, crossed and zipped, made as they are needed."""

import math
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


@dataclass(frozen=True)
class Axis:
    """One parameter and how it varies, in its own unit; values that are relative multiply the nominal one.

    Where they are drawn, the distribution is `uniform` or `log`, between the first and the second number, or `normal`
    with a mean and a standard deviation.
    """

    parameter: str
    relative: bool = False
    distribution: str = "uniform"
    first: float = 0.0
    second: float = 1.0

    def quantile(self, chance: FloatArray) -> FloatArray:
        """Values at cumulative probabilities."""
        if self.distribution == "normal":
            # Within these chances it is never infinite.
            return np.asarray(self.first + self.second * ndtri(np.clip(chance, 2.0**-54, 1 - 2.0**-54)))
        log = self.distribution == "log"
        low, high = (math.log(self.first), math.log(self.second)) if log else (self.first, self.second)
        found = low + (high - low) * chance
        return np.clip(np.exp(found) if log else found, self.first, self.second)


@dataclass(frozen=True)
class Listed:
    """Axes with stated values, shape `(axes, n)`: one axis of a grid, zipped axes, or the columns of a CSV."""

    axes: tuple[Axis, ...]
    table: FloatArray

    def __len__(self) -> int:
        return self.table.shape[1]

    def at(self, place: NDArray[np.int64]) -> FloatArray:
        """Values at some places of the group, shape `(axes, n)`."""
        return np.asarray(self.table[:, place])


@dataclass(frozen=True)
class Drawn:
    """Axes that are drawn together by one of `SAMPLERS`; a `DataError` refuses a design that is too large for it."""

    axes: tuple[Axis, ...]
    method: str
    rows: int
    seed: int

    def __post_init__(self) -> None:
        if self.method == "latin_hypercube" and self.rows > _LARGEST_HYPERCUBE:
            raise DataError(
                f"design.rows: a Latin hypercube has up to {_LARGEST_HYPERCUBE:,} rows, found {self.rows:,}; choose "
                'method = "sobol" or "random".'
            )
        if self.method == "sobol" and self.rows > 2**30:
            raise DataError(f'design.rows: a Sobol design has up to 2^30 rows, found {self.rows:,}; choose "random".')
        if self.method == "sobol" and len(self.axes) > qmc.Sobol.MAXDIM:
            raise DataError(f'design.method: a Sobol design has up to {qmc.Sobol.MAXDIM} axes; choose "random".')

    def __len__(self) -> int:
        return self.rows

    def at(self, place: NDArray[np.int64]) -> FloatArray:
        """Values at some places of the group, shape `(axes, n)`."""
        chance = np.empty((len(place), len(self.axes)))
        if self.method == "latin_hypercube":
            chance[:] = _hypercube(len(self.axes), self.rows, self.seed)[place]
        else:
            for piece in np.unique(place // _PIECE).tolist():
                if self.method == "random":
                    drawn = np.random.default_rng([self.seed, piece]).random((_PIECE, len(self.axes)))
                else:
                    sampler = qmc.Sobol(len(self.axes), scramble=True, rng=np.random.default_rng(self.seed))
                    drawn = (sampler.fast_forward(piece * _PIECE) if piece else sampler).random(_PIECE)
                here = place // _PIECE == piece
                chance[here] = drawn[place[here] - piece * _PIECE]
        return np.stack([axis.quantile(chance[:, k]) for k, axis in enumerate(self.axes)])


@lru_cache(maxsize=1)
def _hypercube(dimensions: int, rows: int, seed: int) -> FloatArray:
    return np.asarray(qmc.LatinHypercube(dimensions, rng=np.random.default_rng(seed)).random(rows))


@dataclass(frozen=True)
class Plan:
    """All rows: groups crossed with each other, the last running fastest, repeated for each source such as a file."""

    groups: tuple[Listed | Drawn, ...]
    repeats: int = 1

    @property
    def axes(self) -> tuple[Axis, ...]:
        return tuple(axis for group in self.groups for axis in group.axes)

    def __len__(self) -> int:
        return self.repeats * math.prod(len(group) for group in self.groups)

    def values(self, rows: NDArray[np.int64]) -> dict[str, FloatArray]:
        """Values of all axes at some rows by parameter, shape `(n,)` each."""
        names = [axis.parameter for axis in self.axes]
        columns: list[FloatArray] = []
        for group in reversed(self.groups):
            rows, place = np.divmod(rows, len(group))
            columns = [*group.at(place), *columns]
        return dict(zip(names, columns, strict=True))

    def repeat_of(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Index of the source of each row, shape `(n,)`."""
        return rows // math.prod(len(group) for group in self.groups)
