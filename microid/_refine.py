"""What a sampled command does between its samples: steps, lines or curves."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._linear import Hold, Times

# A sample is a corner if the signal bends so many times as much there as two and three samples on.
_CORNER = 3.0
# Sweeps of Jacobi's iteration for the bends of a spline; each halves the error at least.
_SWEEPS = 48


def refined(time_s: Times, values: Float[Array, " t"], substeps: int, hold: Hold) -> tuple[Times, Float[Array, " r"]]:
    """Divide the intervals between the samples of a command.

    Parameters
    ----------
    time_s
        Times of the samples, shape `(t,)`, or the one interval between them, shape `()`.
    values
        The command, shape `(t,)`.
    substeps
        Parts of each interval.
    hold
        How the command runs between samples, as in `Stage`.

    Returns
    -------
    time_s, values
        At `(t - 1) substeps + 1` times, shape `(r,)`.
    """
    if substeps == 1:
        return time_s, values
    if hold == "zero":
        finer = jnp.repeat(values, substeps)[: 1 - substeps]
    else:
        finer = lines(values, substeps) if hold == "first" else _curves(values, substeps)
    return time_s / substeps if time_s.ndim == 0 else lines(time_s, substeps), finer


def lines(values: Float[Array, " t"], substeps: int) -> Float[Array, " r"]:
    """Divide the lines between samples."""
    if substeps == 1:
        return values
    share = jnp.arange(substeps, dtype=values.dtype) / substeps
    inner = values[:-1, None] + jnp.diff(values)[:, None] * share[None, :]
    return jnp.append(inner.ravel(), values[-1])


def _curves(values: Float[Array, " t"], substeps: int) -> Float[Array, " r"]:
    """Divide the curves of a cubic spline through samples, which has corners where these say so.

    A spline through a step or the tip of a triangle would swing beyond them, which hysteresis would not forget; what
    bends at single samples is taken to have its corners there, without bend.
    """
    if values.shape[0] < 3:
        return lines(values, substeps)
    second = jnp.pad(jnp.diff(values, 2), 1)
    size = jnp.pad(jnp.abs(second), 3)
    count = values.shape[0]
    around = jnp.max(jnp.stack([size[at : at + count] for at in (0, 1, 5, 6)]), axis=0)
    smooth = (size[3:-3] <= _CORNER * around).at[jnp.array([0, -1])].set(False)

    def sweep(_: int, bend: Float[Array, " t"]) -> Float[Array, " t"]:
        beside = jnp.pad(bend[:-1], (1, 0)) + jnp.pad(bend[1:], (0, 1))
        return jnp.where(smooth, (6 * second - beside) / 4, 0.0)

    bend = lax.fori_loop(0, _SWEEPS, sweep, jnp.zeros_like(values))
    ahead = jnp.arange(substeps, dtype=values.dtype) / substeps
    behind = 1 - ahead
    inner = (
        values[:-1, None] * behind
        + values[1:, None] * ahead
        + bend[:-1, None] * (behind**3 - behind) / 6
        + bend[1:, None] * (ahead**3 - ahead) / 6
    )
    return jnp.append(inner.ravel(), values[-1])
