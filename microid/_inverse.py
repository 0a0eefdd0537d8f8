"""The exact inverse of a Preisach operator: the voltage that gives a displacement (Eq. 19-21)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from microid._everett import Everett, _window
from microid._memory import Memory, Staircase, _as_entries, negative_saturation, remember
from microid._preisach import Preisach

# Steps at most: half as many halvings leave no digit of a bracket, and Newton's steps rarely need ten.
_STEPS = 128


class Inversion(eqx.Module):
    """A voltage that makes a hysteresis follow a reference, and where it cannot.

    Attributes
    ----------
    voltage_V
        Shape `(n,)`; at an end of the range where the reference is out of reach.
    reachable
        Whether each sample of the reference can be reached, shape `(n,)`.
    lowest_um, highest_um
        The displacements that can be reached.
    end
        Memory after the last sample, from which a next reference can go on.
    """

    voltage_V: Float[Array, " n"]
    reachable: Bool[Array, " n"]
    lowest_um: Float[Array, ""]
    highest_um: Float[Array, ""]
    end: Staircase


def invert(model: Preisach, displacement_um: Float[Array, " n"], start: Staircase | None = None) -> Inversion:
    """Find the voltage whose displacement is the one wanted, sample by sample.

    Between reversals the output rises and falls with the voltage, and it returns to where it was when a loop
    closes. A reference is therefore remembered and wiped out as the voltage behind it is: its branches hang from
    the same samples, found from the reference alone. What is left is one root of a piecewise cubic per sample.

    Parameters
    ----------
    model
        Its output must rise wherever the voltage does: a density or reversible slope that is not zero.
    displacement_um
        The reference, shape `(n,)`, sensor offset included.
    start
        Memory before the first sample; negative saturation by default.

    Returns
    -------
    Inversion
        `model(voltage_V, start)` is the reference where it is reachable. Differentiable, to any order and in both
        modes, in the reference and the parameters (implicit function theorem).
    """
    if start is None:
        start = negative_saturation(model.density.lower_V)
    surface = model.everett
    before = _as_entries(start)
    already = surface.respond(before) + model.offset_um
    lowest, highest = model.offset_um, model.offset_um + surface(surface.upper_V, surface.lower_V)
    # The model's own output at an end of the range may differ from these by its last digits.
    rounding = 8 * jnp.finfo(highest.dtype).eps * jnp.maximum(jnp.abs(lowest), jnp.abs(highest))
    reachable = (displacement_um >= lowest - rounding) & (displacement_um <= highest + rounding)
    # Not clip, which halves the derivative at the ends.
    wanted = jnp.where(~reachable & (displacement_um < lowest), lowest, displacement_um)
    wanted = jnp.where(~reachable & (displacement_um > highest), highest, wanted)
    # The reference has its own staircase: the displacements at the remembered extremes.
    memory = remember(wanted, Staircase(already, start.count))
    path = _roots(surface, memory.path_V - model.offset_um, before.path_V, memory.anchor, memory.rising)
    found = Memory(path, memory.anchor, memory.rising, memory.lead)
    return Inversion(path[memory.lead :], reachable, lowest, highest, found.end())


def _rise(
    surface: Everett,
    x: Float[Array, " m"],
    x0: Float[Array, " m"],
    up: Bool[Array, " m"],
    up0: Bool[Array, " m"],
) -> Float[Array, " m"]:
    """Output at `x` less the output at the anchor `x0` of its branch."""
    here, there = surface._place(x), surface._place(x0)
    high = jnp.where(up, here[0], there[0]), jnp.where(up, here[1], there[1])
    low = jnp.where(up, there[0], here[0]), jnp.where(up, there[1], here[1])
    sign = jnp.where(up, -1.0, 1.0).astype(here[1].dtype)
    step = sign * _window(surface.window_um, *high, *low)
    return step + surface._branch(here, up) - surface._branch(there, up0)


@jax.custom_jvp
def _roots(
    surface: Everett,
    level_um: Float[Array, " m"],
    before_V: Float[Array, " lead"],
    anchor: Int[Array, " m"],
    rising: Bool[Array, " m"],
) -> Float[Array, " m"]:
    """Voltages of a path of displacements whose first entries are known."""
    lead, m = before_V.shape[0], level_um.shape[0]
    rounding_um = 2 * jnp.finfo(level_um.dtype).eps * jnp.max(jnp.abs(level_um))

    def one(k: Int[Array, ""], path: Float[Array, " m"]) -> Float[Array, " m"]:
        a = anchor[k]
        up, up0, x0 = rising[k], rising[a], path[a]
        target = level_um[k] - level_um[a]

        def rise(x: Float[Array, ""]) -> Float[Array, ""]:
            each = (v[None] for v in (x, x0, up, up0))
            return _rise(surface, *each)[0]

        def more(carry: tuple[Array, Array, Array, Array, Array]) -> Bool[Array, ""]:
            _, _, _, step, count = carry
            return (count < _STEPS) & (step != 0)

        def closer(carry: tuple[Array, Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array, Array]:
            low, high, x, last, count = carry
            value, slope = jax.jvp(rise, (x,), (jnp.ones_like(x),))
            off = value - target
            low, high = jnp.where(off <= 0, x, low), jnp.where(off >= 0, x, high)
            newton = x - off / slope
            # Newton's step, unless it leaves the bracket or goes to and fro between pieces: it is not half the last.
            good = (newton >= low) & (newton <= high) & (2 * jnp.abs(newton - x) <= jnp.abs(last))
            new = jnp.where(good, newton, (low + high) / 2)
            new = jnp.where(jnp.abs(off) <= rounding_um, x, new)
            # What is not a number must not end in the middle of the bracket.
            new = jnp.where(jnp.isnan(off), off, new)
            return low, high, new, new - x, count + 1

        low = jnp.where(up, x0, surface.lower_V)
        high = jnp.where(up, surface.upper_V, x0)
        guess = jnp.clip(path[k - 1], low, high)
        begin = (low, high, guess, 2 * (surface.upper_V - surface.lower_V), jnp.asarray(0, dtype=jnp.int32))
        return path.at[k].set(lax.while_loop(more, closer, begin)[2])

    path = jnp.zeros(m, level_um.dtype).at[:lead].set(before_V)
    return lax.fori_loop(np.int32(lead), np.int32(m), one, path)


@_roots.defjvp
def _roots_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    surface, level_um, before_V, anchor, rising = primals
    surface_dot, level_dot, before_dot, _, _ = tangents
    path = _roots(surface, level_um, before_V, anchor, rising)
    lead = before_V.shape[0]
    first = jnp.arange(path.shape[0]) < lead
    up0 = rising[anchor]

    def rise(surface: Everett, x: Array, x0: Array) -> Array:
        return _rise(surface, x, x0, rising, up0)

    one, none = jnp.ones_like(path), jnp.zeros_like(path)
    still = jax.tree.map(jnp.zeros_like, surface)
    x0 = path[anchor]
    slope = jax.jvp(rise, (surface, path, x0), (still, one, none))[1]
    slope0 = jax.jvp(rise, (surface, path, x0), (still, none, one))[1]
    moved = jax.jvp(rise, (surface, path, x0), (surface_dot, none, none))[1]
    wanted = level_dot - level_dot[anchor] - moved
    # Linear in the tangents: slope[k] du[k] + slope0[k] du[anchor[k]] = wanted[k].
    slope, slope0 = jnp.where(first, 1, slope), jnp.where(first, 0, slope0)
    wanted = jnp.where(first, jnp.pad(before_dot, (0, path.shape[0] - lead)), wanted)
    return path, _substitute(slope, slope0, anchor, wanted)


def _substitute(
    slope: Float[Array, " m"], slope0: Float[Array, " m"], anchor: Int[Array, " m"], wanted: Float[Array, " m"]
) -> Float[Array, " m"]:
    """Solve `slope[k] x[k] + slope0[k] x[anchor[k]] = wanted[k]`, linearly in `wanted`."""

    def product(x: Array) -> Array:
        return slope * x + slope0 * x[anchor]

    def solve(_: Any, rhs: Array) -> Array:
        def visit(k: Int[Array, ""], x: Array) -> Array:
            return x.at[k].set((x[k] - slope0[k] * x[anchor[k]]) / slope[k])

        return lax.fori_loop(np.int32(0), np.int32(anchor.shape[0]), visit, rhs)

    def transpose_solve(_: Any, rhs: Array) -> Array:
        last = np.int32(anchor.shape[0] - 1)

        def visit(s: Int[Array, ""], carry: tuple[Array, Array]) -> tuple[Array, Array]:
            rhs, y = carry
            k = last - s
            value = rhs[k] / slope[k]
            return rhs.at[anchor[k]].add(-slope0[k] * value), y.at[k].set(value)

        return lax.fori_loop(np.int32(0), np.int32(anchor.shape[0]), visit, (rhs, jnp.zeros_like(rhs)))[1]

    return lax.custom_linear_solve(product, wanted, solve, transpose_solve)
