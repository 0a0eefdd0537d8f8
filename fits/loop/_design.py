"""The Preisach operator as a linear regression: one column per weight and slope."""

from functools import lru_cache
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
        """The Everett surface of a solution in um, `(D,)`."""
        return Surface.of(*self.densities(columns_um[:, None]), *self.ends_V)

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
    reach = _reach(x, n, jnp)
    # A branch adds or takes off the rectangle between its anchor and the present voltage (see microid.Everett).
    high = jnp.where(up, -reach, reach[anchor])
    low = jnp.where(up, reach[anchor], reach)
    total = forest_sum(_rectangles(high, low, jnp).at[0].set(0), anchor)[memory.lead :]

    x, rising = x[memory.lead :], memory.rising[memory.lead :]
    cell = jnp.clip(x.astype(jnp.int32), 0, n - 2)
    s = (x - cell.astype(x.dtype))[:, None]
    c0, c1, c2, c3 = table[:, jnp.where(rising, cell, cell + (n - 1))]
    branch = c0 + s * (c1 + s * (c2 + s * c3))
    return branch + jnp.pad(total, ((0, 0), (0, n))), memory.end()


def responses(grid: Grid, table: np.ndarray, path: Path) -> np.ndarray:
    """The same as `design` in NumPy, which compiles nothing, along a path: shape `(n, D)`."""
    n, (lower, upper) = grid.levels, grid.ends_V
    x = np.clip((path.values - lower) / (upper - lower), 0, 1) * (n - 1)
    reach, up = _reach(x, n, np), path.rising[:, None]
    before = reach[path.anchor]
    total = path.add(_rectangles(np.where(up, -reach, before), np.where(up, before, reach), np))[path.lead :]

    x = x[path.lead :]
    cell = np.minimum(x.astype(np.int64), n - 2)
    powers, branch = np.vander(x - cell, 4, increasing=True), np.where(path.rising[path.lead :], cell, cell + (n - 1))
    out = np.empty((len(x), grid.columns))
    for one in np.unique(branch):
        here = branch == one
        out[here] = powers[here] @ table[:, one]
    out[:, : grid.weights] += total
    return out


def _reach(x: Any, n: int, xp: Any) -> Any:
    """Integral of each hat function up to `x` levels, `(m,)`, in units of the range, shape `(m, N)`; by `xp`."""
    nodes = xp.arange(n, dtype=x.dtype)[None, :]
    z = xp.clip(x[:, None] - nodes, -1, 1)
    rise = xp.where(z < 0, (z + 1) ** 2 / 2, 1 - (1 - z) ** 2 / 2)
    # Of the first there is only the half within the range.
    return (rise - xp.where(nodes == 0, 0.5, 0.0)) / (n - 1)


def _rectangles(high: Any, low: Any, xp: Any) -> Any:
    """Products of the two, `(m, N)`, along all pairs `(i, j <= i)`, packed row by row, shape `(m, p)`; by `xp`.

    The nodes under the diagonal triangles continue the three corners linearly: what they would add goes to those.
    """
    n = high.shape[1]
    i, j = np.tril_indices(n)
    ghost = xp.pad(high[:, :-1] * low[:, 1:], ((0, 0), (1, 1)))
    # Column k + 1 holds ghost k; the first and last are zero.
    after = np.where(i == j, i + 1, 0)
    before = np.where(i == j, i, 0)
    beside = np.where(i == j + 1, i, 0)
    return high[:, i] * low[:, j] + ghost[:, after] + ghost[:, before] - ghost[:, beside]


@lru_cache(maxsize=16)
def branch_table(levels: int) -> np.ndarray:
    """Branch polynomials of every column, shape `(4, 2 (levels - 1), D)`."""
    size = levels * (levels + 1) // 2
    tables = []
    # Some at a time, as each has a window of its own.
    for k in range(0, size + levels, 256):
        unit = np.eye(size + levels, min(256, size + levels - k), -k)
        tables.append(Surface.of(spread(unit[:size], levels), unit[size:], 0.0, 1.0).branch_um)
    return np.concatenate(tables, axis=2)
