"""What a sampled command does between its samples: steps, lines or curves."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from microid._linear import Hold, Times

# A sample is a corner if the signal bends so many times as much there as at those from the first so far away to the
# last, on both sides.
_CORNER, _NEAR, _FAR = 3.0, 2, 5
# Samples on either side of which a band-limited signal is made, and the shape of Kaiser's window over them: right to
# a thousandth up to 0.44 of the sampling rate.
_REACH, _SHAPE = 16, 6.0
# Sweeps of Jacobi's iteration for the bends of a spline; each halves the error at least.
_SWEEPS = 48


def refined(time_s: Times, values: Float[Array, " t"], substeps: int, hold: Hold) -> tuple[Times, Float[Array, " r"]]:
    """Divide the intervals between the samples of a command.

    Parameters
    ----------
    time_s
        Times of the samples, shape `(t,)`, or the one interval between them, shape `()`.
    values
        The command, shape `(t,)`, in any unit.
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
        finer = _lines(values, substeps) if hold == "first" else _curves(values, substeps)
    return time_s / substeps if time_s.ndim == 0 else _lines(time_s, substeps), finer


def _lines(values: Float[Array, " t"], substeps: int) -> Float[Array, " r"]:
    """Divide the lines between samples."""
    if substeps == 1:
        return values
    share = jnp.arange(substeps, dtype=values.dtype) / substeps
    inner = values[:-1, None] + jnp.diff(values)[:, None] * share[None, :]
    return jnp.append(inner.ravel(), values[-1])


@partial(jax.jit, static_argnames="substeps")
def _curves(values: Float[Array, " t"], substeps: int) -> Float[Array, " r"]:
    """Divide the curves through samples, which have corners where these say so.

    Away from corners the signal has no frequencies beyond half the sampling rate. Near one it is a cubic spline
    without bend at the corner: what swings beyond a step or the tip of a triangle, hysteresis would not forget.
    """
    count = values.shape[0]
    if count < 3:
        return _lines(values, substeps)
    second = jnp.pad(jnp.diff(values, 2), 1)
    size = jnp.pad(jnp.abs(second), _FAR)
    apart = [sign * k for k in range(_NEAR, _FAR + 1) for sign in (-1, 1)]
    around = jnp.max(jnp.stack([size[_FAR + k : _FAR + k + count] for k in apart]), axis=0)
    smooth = (size[_FAR:-_FAR] <= _CORNER * around).at[jnp.array([0, -1])].set(False)
    ahead = jnp.arange(substeps, dtype=values.dtype)[None, :] / substeps
    # No corner within reach of either end of an interval.
    sharp = jnp.pad((~smooth).astype(values.dtype), _REACH)
    met = jnp.convolve(sharp, jnp.ones(2 * _REACH, dtype=values.dtype), mode="valid")[1:count]
    inner = jnp.where((met < 0.5)[:, None], _bandlimited(values, ahead), _spline(values, second, smooth, ahead))
    return jnp.append(inner.ravel(), values[-1])


def _bandlimited(values: Float[Array, " t"], ahead: Float[Array, "1 substeps"]) -> Float[Array, "intervals substeps"]:
    taps = np.arange(-_REACH + 1, _REACH + 1)
    distance = ahead - jnp.asarray(taps, dtype=values.dtype)[:, None]
    window = jnp.i0(_SHAPE * jnp.sqrt(jnp.maximum(1 - (distance / _REACH) ** 2, 0.0))) / np.i0(_SHAPE)
    weight = jnp.sinc(distance) * window
    weight = weight / jnp.sum(weight, axis=0, keepdims=True)
    padded, count = jnp.pad(values, _REACH, mode="edge"), values.shape[0] - 1
    near = jnp.stack([padded[_REACH + tap : _REACH + tap + count] for tap in taps.tolist()], axis=1)
    return near @ weight


def _spline(
    values: Float[Array, " t"],
    second: Float[Array, " t"],
    smooth: Bool[Array, " t"],
    ahead: Float[Array, "1 substeps"],
) -> Float[Array, "intervals substeps"]:
    def sweep(_: int, bend: Float[Array, " t"]) -> Float[Array, " t"]:
        beside = jnp.pad(bend[:-1], (1, 0)) + jnp.pad(bend[1:], (0, 1))
        return jnp.where(smooth, (6 * second - beside) / 4, 0.0)

    bend = lax.fori_loop(0, _SWEEPS, sweep, jnp.zeros_like(values))
    behind = 1 - ahead
    return (
        values[:-1, None] * behind
        + values[1:, None] * ahead
        + bend[:-1, None] * (behind**3 - behind) / 6
        + bend[1:, None] * (ahead**3 - ahead) / 6
    )
