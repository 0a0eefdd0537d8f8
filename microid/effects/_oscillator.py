"""A mass on a spring with a force that depends on where the mass is, and was."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._linear import LinearSystem, Times
from microid._part import AbstractPart, Signal, innermost
from microid._plant import Mechanics

_PIECE, _CORRECTIONS = 256, 2
# From the displacement before, the one now and a state, to the force and the next state.
Law = Callable[[Array, Array, Any], tuple[Array, Any]]


def _propagators(
    system: LinearSystem, time_s: Times, count: int, settling_s: Float[Array, ""] | None = None
) -> tuple[Float[Array, "k n n"], Float[Array, "k n"]]:
    """Matrix of every interval, and what its states lose by an input that rises by one, in a line or settling."""
    intervals, n = count - 1, system.order
    time = lax.stop_gradient(time_s).astype(system.rest.dtype)

    def even(interval: Array) -> tuple[Array, Array]:
        step, taken = (x[..., 0] for x in system.advance(interval[None], "first", settling_s))
        return jnp.broadcast_to(step, (intervals, n, n)), jnp.broadcast_to(taken, (intervals, n))

    def uneven(interval: Array) -> tuple[Array, Array]:
        pieces = -(-intervals // _PIECE)
        filled = jnp.pad(interval, (0, pieces * _PIECE - intervals), mode="edge").reshape(pieces, _PIECE)
        every = lax.map(lambda piece: system.advance(piece, "first", settling_s), filled)
        step, taken = (jnp.moveaxis(x, -1, 1).reshape(-1, *x.shape[1:-1])[:intervals] for x in every)
        return step, taken

    if time.ndim == 0:
        return even(time)
    interval = jnp.diff(time)
    mean = (time[-1] - time[0]) / intervals
    rounding = 4 * jnp.finfo(time.dtype).eps * jnp.maximum(jnp.abs(time[0]), jnp.abs(time[-1]))
    return lax.cond(jnp.max(jnp.abs(interval - mean)) <= rounding, lambda _: even(mean), uneven, interval)


def _forces_um(
    mechanics: Mechanics, time_s: Times, signal: Signal, law: Law, before_um: Float[Array, ""], state: Any
) -> Float[Array, " t"]:
    """Forces on the mass along a record, each as the piezo's displacement that would balance it, shape `(t,)`.

    Parameters
    ----------
    mechanics
        Mass, spring and damper.
    time_s, signal
        See `AbstractPart.run`.
    law
        The force, in um of the piezo's displacement.
    before_um
        The force at rest before the first sample.
    state
        State of the law there.

    Notes
    -----
    The linear part is exact from sample to sample; the force runs in a line over each interval, and its end is found
    by two of Newton's steps, also where it is stiff. That is an error of second order in the interval.
    """
    if signal.values.shape[0] == 1:
        return before_um[None]
    gain = mechanics.gain
    system, count = mechanics.system(), signal.values.shape[0]
    step, taken = _propagators(system, time_s, count)
    behind = taken if signal.settling_s is None else _propagators(system, time_s, count, signal.settling_s)[1]
    driven = behind * jnp.diff(signal.values)[:, None]

    def visit(carry: tuple[Any, ...], now: tuple[Array, ...]) -> tuple[tuple[Any, ...], Array]:
        place, speed, moved, force, memory = carry
        matrix, loss, lost, level = now
        free_place = matrix[0, 0] * place + matrix[0, 1] * speed - lost[0]
        free_speed = matrix[1, 0] * place + matrix[1, 1] * speed - lost[1]

        def under(later: Array) -> Array:
            return gain * (level - later + free_place + loss[0] * (later - force))

        def asked(later: Array) -> Array:
            return law(moved, under(later), memory)[0]

        later = force
        for _ in range(_CORRECTIONS):
            found, slope = jax.jvp(asked, (later,), (jnp.ones_like(later),))
            later = later + (found - later) / (1 - slope)
        kept = law(moved, under(later), memory)[1]
        place, speed = free_place + loss[0] * (later - force), free_speed + loss[1] * (later - force)
        return (place, speed, under(later), later, kept), later

    first = signal.values[0]
    rest = gain * (signal.before - before_um)
    start = (signal.before - first, jnp.zeros_like(first), rest, before_um, state)
    _, forces = lax.scan(visit, start, (step, taken, driven, signal.values[1:]))
    return jnp.concatenate([before_um[None], forces])


def _braked(
    inner: AbstractPart, time_s: Times, signal: Signal, start: Any, taken_um: Float[Array, " t"], before_um: Array
) -> Signal:
    """Pass a signal on through mechanics that forces, which run in lines, take something from; see `_forces_um`."""
    if signal.settling_s is None:
        return inner.run(time_s, signal.with_values(signal.values - taken_um, signal.before - before_um), start)
    # The signal settles within each interval, and the forces do not.
    given = inner.run(time_s, signal, start)
    less = innermost(inner).run(time_s, Signal(taken_um, before_um, "first"))
    return given.with_values(given.values - less.values, given.before - less.before)
