"""The Everett surface of a piecewise-linear density, exactly: the paper's Preisach function (Eq. 10)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from microid._forest import forest_sum
from microid._memory import Memory
from microid._platform import _by_platform

# A quadratic B-spline has three pieces; its tensor product a window of three by three coefficients.
_WINDOW = 3


class Everett(eqx.Module):
    """Piecewise polynomials from which every output of a Preisach operator is read.

    With levels `lo = v_0 < ... < v_{N-1} = hi` a step `h` apart, the density is bilinear between the nodes above
    the diagonal and linear on the triangles along it. Its integral over `[lo, a] x [lo, b]` is then a tensor
    product of quadratic splines, and the triangles add cubics in one variable, so nothing is approximated.

    Attributes
    ----------
    lower_V, upper_V
        Range of the switching voltages.
    window_um
        Spline coefficients of the double integral of the density, shape `((N + 1)**2,)`, row by row.
    branch_um
        Cubics in one variable, shape `(4, 2 (N - 1))`: powers of the fraction of an interval; the first half for
        rising samples, the second for falling ones.
    """

    lower_V: Float[Array, ""]
    upper_V: Float[Array, ""]
    window_um: Float[Array, " q"]
    branch_um: Float[Array, "4 k"]

    @property
    def intervals(self) -> int:
        """Number of intervals between levels, `N - 1`."""
        return self.branch_um.shape[1] // 2

    def __call__(self, high_V: Float[Array, "..."], low_V: Float[Array, "..."]) -> Float[Array, "..."]:
        """Displacement lost when the voltage falls from a saturating `high_V` to `low_V` (Eq. 10), in um.

        That is the density integrated over the triangle `low <= beta <= alpha <= high`, the part on the diagonal
        included. Zero where `low_V >= high_V`.
        """
        high, low = (jnp.asarray(v, dtype=self.window_um.dtype) for v in (high_V, low_V))
        high, low = jnp.broadcast_arrays(high, jnp.minimum(low, high))
        a, b = self._place(high.ravel()), self._place(low.ravel())
        up, down = jnp.ones_like(a[0], dtype=bool), jnp.zeros_like(a[0], dtype=bool)
        # E = V(a) - Q(a, b) + L(b); the branch polynomials are V + r for rising and r - L for falling samples.
        lost = self._branch(a, up) - _window(self.window_um, *a, *b) - self._branch(b, down)
        return lost.reshape(high.shape)

    # Compiled by itself, so that it is traced once for all programs that it is part of.
    @eqx.filter_jit
    def respond(self, memory: Memory) -> Float[Array, " n"]:
        """Output along a record, zero at negative saturation (Eq. 11), in um."""
        place = self._place(memory.path_V)
        total = forest_sum(self._steps(place, memory), memory.anchor)
        return (total + self._branch(place, memory.rising))[memory.lead :]

    def _steps(self, place: tuple[Int[Array, " m"], Float[Array, " m"]], memory: Memory) -> Float[Array, " m"]:
        """What each entry of a record adds to the output of the one that its branch hangs from."""
        interval, fraction = place
        a0, b0 = interval[memory.anchor], fraction[memory.anchor]
        up = memory.rising
        high = jnp.where(up, interval, a0), jnp.where(up, fraction, b0)
        low = jnp.where(up, a0, interval), jnp.where(up, b0, fraction)
        sign = jnp.where(up, -1.0, 1.0).astype(fraction.dtype)
        return (sign * _window(self.window_um, *high, *low)).at[0].set(0)

    def _place(self, voltage_V: Float[Array, " n"]) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
        """Interval and fraction of it; beyond the range there are no relays, so the voltage saturates."""
        n = self.intervals
        # Not clip: it halves the derivative of a sample that stands exactly at the end of the range. And not after
        # scaling, which rounds: such a sample could come to lie beyond the end and lose its derivative.
        capped = jnp.where(voltage_V > self.upper_V, self.upper_V, voltage_V)
        inside = jnp.where(voltage_V < self.lower_V, self.lower_V, capped)
        x = (inside - self.lower_V) * (n / (self.upper_V - self.lower_V))
        interval = jnp.clip(lax.stop_gradient(x).astype(jnp.int32), 0, n - 1)
        return interval, x - interval.astype(x.dtype)

    def _branch(
        self, place: tuple[Int[Array, " n"], Float[Array, " n"]], rising: Bool[Array, " n"]
    ) -> Float[Array, " n"]:
        interval, s = place
        c0, c1, c2, c3 = (
            _pick(row, jnp.where(rising, interval, interval + self.intervals)) for row in self.branch_um
        )
        return c0 + s * (c1 + s * (c2 + s * c3))


@eqx.filter_jit
def everett(
    density_um_per_V2: Float[Array, "N N"],
    reversible_um_per_V: Float[Array, " N"],
    lower_V: Float[Array, ""],
    upper_V: Float[Array, ""],
) -> Everett:
    """Integrate a density given at its nodes, and a reversible slope given at the same levels.

    Parameters
    ----------
    density_um_per_V2
        Density at `(alpha_i, beta_j)`, zero for `j > i`, shape `(N, N)`.
    reversible_um_per_V
        Density on the diagonal: slope of the memoryless part, shape `(N,)`.
    lower_V, upper_V
        Range of the `N` evenly spaced levels.

    Returns
    -------
    Everett
        Linear in both densities.
    """
    n = density_um_per_V2.shape[0]
    h = (upper_V - lower_V) / (n - 1)
    corner = jnp.diagonal(density_um_per_V2)
    # The node below each diagonal triangle that makes the bilinear form linear on it.
    ghost = corner[:-1] + corner[1:] - jnp.diagonal(density_um_per_V2, -1)
    nodes = density_um_per_V2 + jnp.diag(ghost, 1)
    window = _running(_running(h**2 * nodes.T).T)
    # Along the diagonal: trapezoids of the rows up to it above, and of the columns of ghosts below it.
    rows = jnp.sum(density_um_per_V2, axis=1) - (density_um_per_V2[:, 0] + corner) / 2
    side = jnp.diagonal(density_um_per_V2, -1)
    rising = _triangle(nodes, rows[:-1], rows[1:] - (corner[1:] + side) / 2)
    inner = jnp.arange(n - 1) > 0
    before = jnp.pad(ghost, (1, 0))[:-1] - jnp.pad(ghost[:1] / 2, (1, n - 2))[: n - 1]
    falling = _triangle(nodes.T, jnp.where(inner, before + corner[:-1] / 2, 0), jnp.where(inner, ghost / 2, 0))
    slope = reversible_um_per_V[:-1]
    reversible = h * _pieces(slope, jnp.diff(reversible_um_per_V) / 2, jnp.zeros_like(slope))
    branch = jnp.concatenate([h**2 * rising + reversible, reversible - h**2 * falling], axis=1)
    return Everett(lower_V, upper_V, window.ravel(), branch)


def _sums(values: Float[Array, " k *more"]) -> Float[Array, " k+1 *more"]:
    """Running sums along axis 0, from zero on; a scan compiles and runs several times faster than `cumsum`."""

    def add(total: Array, value: Array) -> tuple[Array, Array]:
        return total + value, total + value

    zero = jnp.zeros_like(values[0])
    return jnp.concatenate([zero[None], lax.scan(add, zero, values)[1]])


def _running(nodes: Float[Array, "N k"]) -> Float[Array, "N+1 k"]:
    """B-spline coefficients of the integral, from the first node on, of the hat functions along axis 0."""

    def add(total: Array, value: Array) -> tuple[Array, Array]:
        return total + value, total

    # Nothing behind the loop: XLA would compute that anew for every sample that reads a coefficient.
    return lax.scan(add, -nodes[0] / 2, jnp.pad(nodes, ((0, 1), (0, 0))))[1]


def _pieces(c1: Float[Array, " k"], c2: Float[Array, " k"], c3: Float[Array, " k"]) -> Float[Array, "4 k"]:
    return jnp.stack([_sums(c1 + c2 + c3)[:-1], c1, c2, c3])


def _triangle(nodes: Float[Array, "N N"], here: Float[Array, " k"], next_: Float[Array, " k"]) -> Float[Array, "4 k"]:
    """Integrate over `0 <= y <= x` up to `x`: cubics on every interval, in units of the step squared.

    `here` and `next_` are the integrals along `y`, up to interval `i`, in the rows `x = i` and `x = i + 1`.
    """
    p = jnp.diagonal(nodes)[:-1]
    q, r = jnp.diagonal(nodes, -1) - p, jnp.diagonal(nodes, 1) - p
    return _pieces(here, (next_ - here + p) / 2, (q + r / 2) / 3)


def _pick(table: Float[Array, " q"], index: Int[Array, " n"]) -> Float[Array, " n"]:
    return table.at[index].get(mode="promise_in_bounds")


def _basis(s: Float[Array, " *n"]) -> tuple[Float[Array, " *n"], ...]:
    return (1 - s) ** 2 / 2, 0.5 + s * (1 - s), s**2 / 2


def _slope(s: Float[Array, " *n"]) -> tuple[Float[Array, " *n"], ...]:
    return s - 1, 1 - 2 * s, s


@jax.custom_jvp
def _window(
    table: Float[Array, " q"],
    i: Int[Array, " n"],
    s: Float[Array, " n"],
    j: Int[Array, " n"],
    t: Float[Array, " n"],
) -> Float[Array, " n"]:
    """Evaluate the tensor-product quadratic spline in cell `(i, j)` at the fractions `(s, t)`."""
    return _contract(table, i, j, _basis(s), _basis(t))


def _contract(table: Array, i: Array, j: Array, left: tuple[Array, ...], right: tuple[Array, ...]) -> Array:
    width = round(table.shape[0] ** 0.5)
    # Three coefficients of a row at a time: single ones take twice as long.
    numbers = lax.GatherDimensionNumbers(offset_dims=(1,), collapsed_slice_dims=(), start_index_map=(0,))
    total = jnp.zeros_like(left[0])
    for p in range(_WINDOW):
        first = (i * width + j + p * width)[:, None]
        row = lax.gather(table, first, numbers, (_WINDOW,), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)
        total = total + left[p] * sum(right[c] * row[:, c] for c in range(_WINDOW))
    return total


@_window.defjvp
def _window_jvp(
    primals: tuple[Array, Array, Array, Array, Array], tangents: tuple[Array, Array, Array, Array, Array]
) -> tuple[Array, Array]:
    table, i, s, j, t = primals
    table_dot, _, s_dot, _, t_dot = tangents
    left, right = _basis(s), _basis(t)
    out = _contract(table, i, j, left, right)
    slope = _contract(table, i, j, _slope(s), right) * s_dot + _contract(table, i, j, left, _slope(t)) * t_dot
    return out, slope + _linear(table_dot, i, s, j, t)


def _linear(table: Array, *place: Array) -> Array:
    """The same as `_window`, as a linear function of the table, whose transpose is one pass on a CPU."""

    def read(table: Array, i: Array, s: Array, j: Array, t: Array) -> Array:
        return _contract(table, i, j, _basis(s), _basis(t))

    def residual(both: tuple[Array, Array]) -> tuple[Array, Array]:
        return both[0], both[1] - read(both[0], *place)

    def solve(_: object, both: tuple[Array, Array]) -> tuple[Array, Array]:
        return both[0], both[1] + read(both[0], *place)

    def transpose_solve(_: object, both: tuple[Array, Array]) -> tuple[Array, Array]:
        return both[0] + _by_platform(*place, *both, cpu=_gather_back, default=_scatter), both[1]

    # The implicit form has a cheap transpose, as that of `forest_sum`; what is solved for must be linear, zeros too.
    none = jnp.broadcast_to(0 * table[0], place[1].shape)
    same, read_off = lax.custom_linear_solve(residual, (table, none), solve, transpose_solve)
    # JAX takes no cotangent for a symbolic zero there, which that of an output without use would be.
    return read_off + 0 * same[0]


def _gather_back(i: Array, s: Array, j: Array, t: Array, table: Array, cotangent: Array) -> Array:
    """Add up what reads each coefficient of a table, `(q,)`: first for each cell alone, whose nine lie together."""
    width, none = round(table.shape[0] ** 0.5), np.int32(0)
    cells = width - _WINDOW + 1

    def visit(k: Int[Array, ""], total: Array) -> Array:
        left, right = jnp.stack(_basis(s[k])) * cotangent[k], jnp.stack(_basis(t[k]))
        more, at = (left[:, None] * right[None, :]).reshape(1, -1), (i[k] * cells + j[k], none)
        return lax.dynamic_update_slice(total, lax.dynamic_slice(total, at, more.shape) + more, at)

    start = jnp.zeros((cells**2, _WINDOW**2), table.dtype)
    total = lax.fori_loop(none, np.int32(s.shape[0]), visit, start).reshape(cells, cells, -1)
    out = jnp.zeros((width, width), table.dtype)
    for k, (p, q) in enumerate(np.ndindex(_WINDOW, _WINDOW)):
        out = out.at[p : p + cells, q : q + cells].add(total[:, :, k])
    return out.ravel()


def _scatter(i: Array, s: Array, j: Array, t: Array, table: Array, cotangent: Array) -> Array:
    """The same for what computes many numbers at once: one scatter of windows."""
    width = round(table.shape[0] ** 0.5)
    numbers = lax.ScatterDimensionNumbers((1, 2), (), (0, 1))
    windows = jnp.stack([jnp.stack(_basis(t), axis=-1) * (a * cotangent)[:, None] for a in _basis(s)], axis=1)
    mode = lax.GatherScatterMode.PROMISE_IN_BOUNDS
    zeros = jnp.zeros((width, width), table.dtype)
    return lax.scatter_add(zeros, jnp.stack([i, j], axis=-1), windows, numbers, mode=mode).ravel()
