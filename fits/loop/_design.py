"""The Preisach operator as a linear regression: one column per weight and slope."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.loop._path import Path
from fits.loop._surface import Surface, spread
from microid import Preisach, Reversible, Staircase, forest_sum, remember
from microid.densities import GridDensity, node_areas


class Grid(eqx.Module):
    """The columns of the regression on `N` levels, in units where the voltage range is 1.

    The first `N (N + 1) / 2` columns are densities of 1 at one node each, packed row by row; the last `N` are slopes
    of 1 at one level each. In these units the columns of all rigs look alike, so scales and priors need no unit.
    """

    lower_V: Float[Array, ""]
    upper_V: Float[Array, ""]
    levels: int = eqx.field(static=True)

    @property
    def weights(self) -> int:
        """Number of weights."""
        return self.levels * (self.levels + 1) // 2

    @property
    def columns(self) -> int:
        """Number of weights and slopes together, `D`."""
        return self.weights + self.levels

    @property
    def range_V(self) -> Float[Array, ""]:
        """Width of the range."""
        return self.upper_V - self.lower_V

    def nodes(self, packed: Float[Array, " p"]) -> Float[Array, "N N"]:
        """Spread packed values over the half-plane, shape `(N, N)`."""
        zeros = jnp.zeros((self.levels, self.levels), packed.dtype)
        return zeros.at[np.tril_indices(self.levels)].set(packed)

    @property
    def ends_V(self) -> tuple[float, float]:
        """Ends of the range."""
        return float(self.lower_V), float(self.upper_V)

    def densities(self, columns_um: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Densities and slopes of solutions in um, `(D, k)`, as `Surface.of` takes them."""
        lower, upper = self.ends_V
        nodes = spread(columns_um[: self.weights], self.levels) / (upper - lower) ** 2
        return nodes, columns_um[self.weights :] / (upper - lower)

    def surface(self, columns_um: np.ndarray) -> Surface:
        """The Everett surface of a solution in um, `(D,)`, or those of several, `(D, k)`."""
        return Surface.of(*self.densities(columns_um.reshape(len(columns_um), -1)), *self.ends_V)

    @eqx.filter_jit
    def model(
        self, columns_um: Float[Array | np.ndarray, " D"], offset_um: Float[Array | np.ndarray, ""]
    ) -> Preisach:
        """Turn a solution, in um, into a model."""
        columns = jnp.asarray(columns_um)
        weights, slopes = columns[: self.weights], columns[self.weights :]
        packed = weights * node_areas(self.levels)[np.tril_indices(self.levels)]
        density = GridDensity(packed, self.lower_V, self.upper_V)
        reversible = Reversible(slopes / self.range_V, self.lower_V, self.upper_V)
        return Preisach(density, reversible, jnp.asarray(offset_um))


@eqx.filter_jit
def columns_of(model: Preisach) -> Float[Array, " D"]:
    """Read the columns of any family's model, in um: the inverse of `Grid.model` where the family is a grid."""
    range_V = model.density.upper_V - model.density.lower_V
    nodes = model.density.nodes_um_per_V2() * range_V**2
    weights = nodes[np.tril_indices(model.density.levels)]
    return jnp.concatenate([weights, model.reversible.slope_um_per_V * range_V])


@dataclass(frozen=True)
class Columns:
    """Columns of the regression on some levels, as `Responses` computes them.

    `table` are their branch polynomials, `(4, 2 (levels - 1), D)`; so many as `remembering` come first that do, and
    `products` writes what these add on rectangles, `(p, m)`, from integrals of hat functions along their sides, which
    are `(levels, m)`.
    """

    table: np.ndarray
    remembering: int
    products: Callable[[np.ndarray, np.ndarray, np.ndarray], None]

    @property
    def levels(self) -> int:
        """Number of levels."""
        return self.table.shape[1] // 2 + 1

    @property
    def size(self) -> int:
        """Number of columns, `D`."""
        return self.table.shape[2]


def design(
    grid: Grid, table: Float[Array, "4 k D"], voltage_V: Float[Array, " n"], start: Staircase
) -> tuple[Float[Array, "n D"], Staircase]:
    """Respond with every column alone, shape `(n, D)`, dimensionless; and the memory after the last sample.

    `table` holds the columns' branch polynomials, from `branch_table`; `start` is the memory before the first sample.
    """
    n = grid.levels
    memory = remember(voltage_V, start)
    x = jnp.clip((memory.path_V - grid.lower_V) / grid.range_V, 0, 1) * (n - 1)
    up, anchor = memory.rising[:, None], memory.anchor
    reach = _reach(x[:, None], jnp.arange(n, dtype=x.dtype)[None, :], jnp)
    # A branch adds or takes off the rectangle between its anchor and the present voltage (see microid.Everett).
    high = jnp.where(up, -reach, reach[anchor])
    low = jnp.where(up, reach[anchor], reach)
    total = forest_sum(_rectangles(high, low).at[0].set(0), anchor)[memory.lead :]

    x, rising = x[memory.lead :], memory.rising[memory.lead :]
    cell = jnp.clip(x.astype(jnp.int32), 0, n - 2)
    s = (x - cell.astype(x.dtype))[:, None]
    c0, c1, c2, c3 = table[:, jnp.where(rising, cell, cell + (n - 1))]
    branch = c0 + s * (c1 + s * (c2 + s * c3))
    return branch + jnp.pad(total, ((0, 0), (0, n))), memory.end()


class Responses:
    """Responses along a path of every column alone, in NumPy, which compiles nothing.

    Entries behind the lead are four to a group, and mixed by `mix`, `(g, 4, 4)`; of the `4 g` mixtures those are
    meant that are in the `order`, `(m,)`. A group is a `whole` visit, one branch between two levels, or is not mixed:
    then only the diagonal counts. What is mixed are the few numbers that all columns are made of.
    """

    def __init__(
        self,
        columns: Columns,
        ends_V: tuple[float, float],
        path: Path,
        mix: np.ndarray,
        whole: np.ndarray,
        order: np.ndarray,
    ):
        n, (lower, upper), lead = columns.levels, ends_V, path.lead
        nodes, scale = np.arange(float(n))[:, None], (n - 1) / (upper - lower)
        turns, at = path.turns
        turn = _reach((np.clip(turns.values, lower, upper) - lower) * scale, nodes, np)
        up, before = turns.rising, turn[:, turns.anchor]
        sides = np.where(up, -turn, before), np.where(up, before, turn)
        remembered = np.empty((columns.remembering, len(up)))
        columns.products(*sides, remembered)
        remembered = turns.add(remembered.T.copy()).T.copy()

        # Of a visit the second entry says where it is: it is nowhere near the ends.
        entry = lead + 4 * np.arange(len(mix))[:, None] + np.where(whole[:, None], 1, np.arange(4))
        x = (np.clip(path.values, lower, upper) - lower) * scale
        cell = np.minimum(x[entry].astype(np.int64), n - 2)
        powers = np.vander((x[lead:].reshape(-1, 1, 4) - cell[:, :, None]).ravel(), 4, increasing=True)
        way = np.einsum("gab,gabk->kga", mix, powers.reshape(*mix.shape, 4)).reshape(4, -1)[:, order]
        cell, up, anchor = cell.ravel()[order], *(each[entry.ravel()[order]] for each in (path.rising, at))
        # As `_reach` has it, of powers of the way through the cell.
        reach, k = (nodes < cell) * way[0], np.arange(len(order))
        reach[cell, k], reach[cell + 1, k] = way[0] / 2 + way[1] - way[2] / 2, way[2] / 2
        reach[0] -= way[0] / 2
        reach /= n - 1
        before = turn[:, anchor]

        self._columns, self._remembered, self._anchor = columns, remembered, anchor
        self._way, self._branch = way, np.where(up, 0, n - 1) + cell
        # A branch adds or takes off the rectangle between its anchor and the present voltage (see microid.Everett).
        self._sides = np.where(up, -reach, before), np.where(up, before, reach)

    def write(self, which: slice, out: np.ndarray) -> None:
        """Write those of some mixtures into an array, `(D, l)`."""
        way, branch, size = self._way[:, which], self._branch[which], self._columns.remembering
        high, low = self._sides
        self._columns.products(high[:, which], low[:, which], out[:size])
        out[:size] += self._remembered[:, self._anchor[which]] * way[0]
        out[size:] = 0.0
        begins = np.flatnonzero(np.diff(branch, prepend=-1))
        for first, stop in pairwise([*begins, len(branch)]):
            out[:, first:stop] += self._columns.table[:, branch[first]].T @ way[:, first:stop]


def _reach(x: Any, nodes: Any, xp: Any) -> Any:
    """Integral of the hat function of each of all nodes up to `x`, both in levels, in units of the range; by `xp`."""
    z = xp.clip(x - nodes, -1, 1)
    rise = xp.where(z < 0, (z + 1) ** 2 / 2, 1 - (1 - z) ** 2 / 2)
    # Of the first there is only the half within the range.
    return (rise - xp.where(nodes == 0, 0.5, 0.0)) / (nodes.size - 1)


def _rectangles(high: Array, low: Array) -> Array:
    """Products of the two, `(m, N)`, along all pairs `(i, j <= i)`, packed row by row, shape `(m, p)`.

    The nodes under the diagonal triangles continue the three corners linearly: what they would add goes to those.
    """
    n = high.shape[1]
    i, j = np.tril_indices(n)
    ghost = jnp.pad(high[:, :-1] * low[:, 1:], ((0, 0), (1, 1)))
    # Column k + 1 holds ghost k; the first and last are zero.
    after = np.where(i == j, i + 1, 0)
    before = np.where(i == j, i, 0)
    beside = np.where(i == j + 1, i, 0)
    return high[:, i] * low[:, j] + ghost[:, after] + ghost[:, before] - ghost[:, beside]


def rectangles(high: np.ndarray, low: np.ndarray, out: np.ndarray) -> None:
    """The same in NumPy, of `(N, m)`, into an array, `(p, m)`."""
    n = len(high)
    first = np.arange(n) * np.arange(1, n + 1) // 2
    corner = first + np.arange(n)
    for i in range(n):
        np.multiply(high[i], low[: i + 1], out=out[first[i] : first[i] + i + 1])
    ghost = high[:-1] * low[1:]
    out[corner[:-1]] += ghost
    out[corner[1:]] += ghost
    out[corner[1:] - 1] -= ghost


@lru_cache(maxsize=16)
def branch_table(levels: int) -> np.ndarray:
    """Branch polynomials of every column, shape `(4, 2 (levels - 1), D)`."""
    size = levels * (levels + 3) // 2
    # Some at a time, as each has a window of its own.
    units = (np.eye(size, min(256, size - k), -k) for k in range(0, size, 256))
    return np.concatenate([branches_of(unit, levels) for unit in units], axis=2)


def branches_of(columns: np.ndarray, levels: int) -> np.ndarray:
    """Branch polynomials of combinations of columns, `(D, k)`, shape `(4, 2 (levels - 1), k)`."""
    density, slope = np.split(columns, [levels * (levels + 1) // 2])
    return Surface.of(spread(density, levels), slope, 0.0, 1.0).branch_um
