"""What a hysteresis remembers: the extremes of its input that have not been wiped out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from microid._param import _as_inexact
from microid._platform import _by_platform

_SIZE = 64


class Staircase(eqx.Module):
    """The memory at one instant: the remembered extremes of the voltage, oldest first.

    Minima stand at even places and maxima at odd ones; the last one used is the present voltage. The first is
    always the lower end of the range, where all relays are off. These are the corners of the staircase line
    between switched-on and switched-off relays, the primed values of Eq. 11.

    Attributes
    ----------
    extremes_V
        Extremes, shape `(size,)`. Places from `count` on are unused.
    count
        How many places are used.
    """

    extremes_V: Float[Array, " size"]
    count: Int[Array, ""]


def _staircase(extremes_V: Float[Array, " used"], size: int) -> Staircase:
    used = extremes_V.shape[0]
    if used > size:
        raise ValueError(f"{used} extremes do not fit into a staircase of size {size}: raise its size")
    return Staircase(jnp.pad(extremes_V, (0, size - used), mode="edge"), jnp.asarray(used, dtype=jnp.int32))


def negative_saturation(lower_V: Float[Array, ""] | float, size: int = _SIZE) -> Staircase:
    """All relays off: the voltage came up from the lower end of the range."""
    return _staircase(_as_inexact(lower_V)[None], size)


def positive_saturation(
    lower_V: Float[Array, ""] | float, upper_V: Float[Array, ""] | float, size: int = _SIZE
) -> Staircase:
    """All relays on: the voltage came down from the upper end of the range."""
    return _staircase(jnp.stack([_as_inexact(lower_V), _as_inexact(upper_V)]), size)


def demagnetised(
    lower_V: Float[Array, ""] | float,
    upper_V: Float[Array, ""] | float,
    rest_V: Float[Array, ""] | float | None = None,
    size: int = _SIZE,
) -> Staircase:
    """The state after a slowly decaying alternating voltage that comes to rest.

    Parameters
    ----------
    lower_V, upper_V
        The range the decay starts with.
    rest_V
        Where it comes to rest; the middle of the range by default.
    size
        Number of extremes; the decay has as many swings as fit.
    """
    lower, upper = _as_inexact(lower_V), _as_inexact(upper_V)
    rest = (lower + upper) / 2 if rest_V is None else jnp.asarray(rest_V, dtype=lower.dtype)
    if size < 3:
        raise ValueError(f"a demagnetised staircase needs size 3 or more for its first swing, got {size}")
    swings = (size - 1) // 2
    left = 1 - jnp.arange(swings, dtype=rest.dtype) / swings
    pairs = rest + left[:, None] * (jnp.stack([lower, upper]) - rest)[None, :]
    return _staircase(jnp.append(pairs.ravel(), rest), size)


class Memory(eqx.Module):
    """What happened along a record: for every sample, the remembered extreme its branch hangs from.

    The samples are preceded by the extremes of the starting staircase. Indices carry no derivative; the voltages
    do. Computed once per input, since it does not depend on any density.

    Attributes
    ----------
    path_V
        The starting extremes followed by the samples, shape `(size + n,)`.
    anchor
        Index into `path_V` of the extreme that each entry's branch starts at; entry 0 is the root.
    rising
        Whether the entry was reached from below.
    """

    path_V: Float[Array, " m"]
    anchor: Int[Array, " m"]
    rising: Bool[Array, " m"]
    _lead: int = eqx.field(static=True)

    @property
    def lead(self) -> int:
        """Number of entries that come before the first sample."""
        return self._lead

    def end(self, size: int | None = None) -> Staircase:
        """Return the memory after the last sample, from which a next record can start.

        Parameters
        ----------
        size
            Size of the staircase; that of the starting one by default.

        Returns
        -------
        Staircase
            If more than `size` extremes are remembered, its extremes are NaN: give the start a larger size.
        """
        size = self._lead if size is None else size
        last = jnp.asarray(self.path_V.shape[0] - 1, dtype=self.anchor.dtype)

        def back(index: Int[Array, ""], _: None) -> tuple[Int[Array, ""], Int[Array, ""]]:
            return self.anchor[index], index

        _, chain = lax.scan(back, last, None, length=size)
        count = jnp.sum(chain > 0, dtype=jnp.int32) + 1
        # Newest first along the chain, oldest first in the staircase; unused places repeat the present voltage.
        place = jnp.clip(count - 1 - jnp.arange(size, dtype=jnp.int32), min=0)
        # NaN rather than an exception: it survives jit and vmap, and cannot be overlooked in what follows.
        return Staircase(jnp.where(chain[-1] == 0, self.path_V[chain][place], jnp.nan), count)


def _as_entries(start: Staircase) -> Memory:
    """The remembered extremes as a record of their own, unused places repeating the last."""
    path = _filled(start)
    anchor, rising = _branches(path)
    return Memory(path, anchor, rising, 0)


def _filled(start: Staircase) -> Float[Array, " size"]:
    used = jnp.arange(start.extremes_V.shape[0], dtype=jnp.int32) < start.count
    tip = start.extremes_V[jnp.clip(start.count - 1, min=0)]
    return jnp.where(used, start.extremes_V, tip)


def _branches(path: Float[Array, " m"]) -> tuple[Int[Array, " m"], Bool[Array, " m"]]:
    return _by_platform(lax.stop_gradient(path), cpu=_by_stack, default=_by_lifting)


@jax.jit
def remember(voltage_V: Float[Array, " n"], start: Staircase) -> Memory:
    """Find, for every sample of a voltage, the remembered extreme that its branch hangs from.

    Rising, that is the lowest sample since the input was last above the present one; falling, the highest since
    it was last below. Reaching an old extreme wipes it out (Madelung's rules; the reduction memory of Eq. 11).

    Parameters
    ----------
    voltage_V
        The input, shape `(n,)`.
    start
        The memory before the first sample.

    Returns
    -------
    Memory
        Indices and branch directions; no derivative flows into them.

    Notes
    -----
    On a CPU one pass with a stack, some 20 ns a sample; elsewhere in parallel, by binary lifting over range
    extremes in O(n log n).
    """
    path = jnp.concatenate([_filled(start), voltage_V])
    anchor, rising = _branches(path)
    return Memory(path, anchor, rising, start.extremes_V.shape[0])


def _by_stack(path: Float[Array, " m"]) -> tuple[Int[Array, " m"], Bool[Array, " m"]]:
    n = path.shape[0]

    def visit(t: Int[Array, ""], carry: tuple[Array, ...]) -> tuple[Array, ...]:
        top, was_up, stack, anchor, rising = carry
        x, before = path[t], path[t - 1]
        # A sample that does not move belongs to its predecessor's branch.
        up = jnp.where(x == before, was_up, x > before)
        turned = up != was_up
        top = jnp.where(turned, top + 1, top)
        stack = stack.at[top].set(jnp.where(turned, t - 1, stack[top]))

        def wiped(top: Int[Array, ""]) -> Bool[Array, ""]:
            old = path[stack[top - 1]]
            return (top >= 2) & jnp.where(up, old <= x, old >= x)

        top = lax.while_loop(wiped, lambda k: k - 2, top)
        return top, up, stack, anchor.at[t].set(stack[top]), rising.at[t].set(up)

    zeros = jnp.zeros(n, dtype=jnp.int32)
    start = (jnp.asarray(0, dtype=jnp.int32), jnp.asarray(True), zeros, zeros, jnp.ones(n, dtype=bool))
    # NumPy bounds: the trip count stays static and the index int32 in both x64 modes.
    _, _, _, anchor, rising = lax.fori_loop(np.int32(1), np.int32(n), visit, start)
    return anchor, rising


def _by_lifting(path: Float[Array, " m"]) -> tuple[Int[Array, " m"], Bool[Array, " m"]]:
    sign = jnp.sign(jnp.diff(path, prepend=path[:1])).astype(jnp.int32)
    moved = jnp.where(sign != 0, jnp.arange(path.shape[0], dtype=jnp.int32), 0)
    rising = sign[lax.cummax(moved)] >= 0
    anchor = jnp.where(rising, _lowest_since_above(path), _lowest_since_above(-path))
    # The root is never wiped out: what stands above all before hangs from it, and not from a later equal.
    highest = rising & (path >= lax.cummax(path))
    # Nothing may hang from itself, NaN included: pointer jumping would never end.
    itself = anchor >= jnp.arange(path.shape[0], dtype=jnp.int32)
    return jnp.where(highest | itself, 0, anchor), rising


def _lowest_since_above(x: Float[Array, " m"]) -> Int[Array, " m"]:
    """For each entry, the index of the minimum since the last entry that was greater."""
    n = x.shape[0]
    index = jnp.arange(n, dtype=jnp.int32)
    steps = max(1, (n - 1).bit_length())
    # greatest[k][t] is the maximum, least[k][t] the index of the minimum, of the 2**k entries up to t.
    greatest, least = [x], [index]
    for k in range(steps):
        back = jnp.maximum(index - (1 << k), 0)
        greatest.append(jnp.maximum(greatest[-1], greatest[-1][back]))
        other = least[-1][back]
        least.append(jnp.where(x[other] < x[least[-1]], other, least[-1]))
    left = index - 1
    for k in reversed(range(steps)):
        # Near the start a block is clipped at 0, where the maximum includes entries already ruled out.
        skip = (left >= 0) & (greatest[k][jnp.maximum(left, 0)] <= x)
        left = jnp.where(skip, left - (1 << k), left)
    left = jnp.maximum(left, -1)
    length = index - left
    tables = jnp.stack(least)
    power = 31 - lax.clz(length)
    one = tables[power, index]
    other = tables[power, jnp.maximum(left + (1 << power), 0)]
    return jnp.where(x[other] < x[one], other, one)
