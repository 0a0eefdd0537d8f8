"""The inverse of a whole stage: the command that makes it follow a smooth reference (Section 3.2 with Eq. 12-17)."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from microid._inverse import invert
from microid._linear import Times
from microid._memory import Staircase
from microid._part import AbstractLinear, AbstractPart
from microid._plant import Driver, Lag, Mechanics
from microid._preisach import Preisach
from microid._stage import Stage

# A spline ends in one cubic through its first or last three samples, and needs a fourth to be determined.
_FEWEST = 4


class StageInversion(eqx.Module):
    """A command that makes a stage follow a reference, and where it cannot.

    Attributes
    ----------
    voltage_V
        Command, shape `(n,)`, to be joined by lines.
    piezo_voltage_V
        Voltage wanted at the piezo, shape `(n,)`; within the hysteresis' range.
    piezo_displacement_um
        Displacement wanted of the piezo, shape `(n,)`.
    reachable
        Whether the piezo can give it, shape `(n,)`.
    """

    voltage_V: Float[Array, " n"]
    piezo_voltage_V: Float[Array, " n"]
    piezo_displacement_um: Float[Array, " n"]
    reachable: Bool[Array, " n"]


def invert_stage(
    stage: Stage, time_s: Times, reference_um: Float[Array, " n"], start: Staircase | None = None
) -> StageInversion:
    r"""Find the command under which a stage follows a reference: driver, hysteresis and mechanics undone, last first.

    .. math::

        w_{pzt} = (r + 2 \zeta \dot r / \omega + \ddot r / \omega^2) / \lambda, \quad
        u_{pzt} = H^{-1}(w_{pzt}), \quad u_{in} = (u_{pzt} + \tau \dot u_{pzt}) / k

    Parameters
    ----------
    stage
        Made of `Driver`, `Piezo` or `Preisach`, `Lag`, `Mechanics`, `Sensor`, and linear parts without states.
    time_s
        Increasing times, shape `(n,)`, or the one interval between all samples, shape `()`. No derivative flows
        into them.
    reference_um
        Displacement wanted, shape `(n,)`, sensor offset included. It must be smooth on the scale of the samples,
        and begin at rest, as the stage does.
    start
        Memory of the hysteresis before the first sample; negative saturation by default.

    Returns
    -------
    StageInversion
        Differentiable in the reference and in the parameters.

    Raises
    ------
    ValueError
        If a part has no inverse here, or there are fewer than four samples.

    Notes
    -----
    Derivatives are those of the cubic splines through the samples. Played in lines, the command leaves an error that
    falls with the square of the interval, since neither the lines nor the samples meet the extremes between them.
    Solving the driver's response to lines for the command, sample by sample, is stable but rings for as long as its
    time constant after every wiped-out loop, where the command must jump.
    """
    place = _piezo(stage)
    displacement = piezo_demand(stage, time_s, reference_um)
    piezo = stage.parts[place]
    if isinstance(piezo, Preisach):
        found = invert(piezo, displacement, start)
        voltage, reachable = found.voltage_V, found.reachable
    else:
        voltage = _undo(stage.names[place], piezo, time_s, displacement)
        reachable = jnp.ones(voltage.shape, dtype=bool)
    return StageInversion(driver_command(stage, time_s, voltage), voltage, displacement, reachable)


def piezo_demand(stage: Stage, time_s: Times, reference_um: Float[Array, " n"]) -> Float[Array, " n"]:
    """Find what the piezo must give for the stage to follow a reference: all parts behind it, undone.

    Parameters
    ----------
    stage, time_s, reference_um
        See `invert_stage`.

    Returns
    -------
    Array
        Displacement in um, shape `(n,)`.

    Raises
    ------
    ValueError
        See `invert_stage`.
    """
    signal = reference_um
    for k in reversed(range(_piezo(stage) + 1, len(stage.parts))):
        signal = _undo(stage.names[k], stage.parts[k], time_s, signal)
    return signal


def driver_command(stage: Stage, time_s: Times, piezo_voltage_V: Float[Array, " n"]) -> Float[Array, " n"]:
    """Find the command that brings a voltage to the piezo: all parts ahead of it, undone.

    Parameters
    ----------
    stage, time_s
        See `invert_stage`.
    piezo_voltage_V
        Shape `(n,)`. It may have corners.

    Returns
    -------
    Array
        Command in V, shape `(n,)`.

    Raises
    ------
    ValueError
        See `invert_stage`.
    """
    signal = piezo_voltage_V
    for k in reversed(range(_piezo(stage))):
        signal = _undo(stage.names[k], stage.parts[k], time_s, signal)
    return signal


def _piezo(stage: Stage) -> int:
    """Place of the one part that turns a voltage into a displacement."""
    return next(k for k, part in enumerate(stage.parts) if part.takes != part.gives)


def _undo(name: str, part: AbstractPart, time_s: Times, signal: Float[Array, " n"]) -> Float[Array, " n"]:
    if isinstance(part, Driver | Lag):
        slope, _ = _derivatives(time_s, signal)
        return (signal + part.time_constant_s * slope) / part.static_gain
    if isinstance(part, Mechanics):
        slope, bend = _derivatives(time_s, signal)
        rate = 2 * jnp.pi * part.natural_frequency_Hz
        return (signal + (2 * part.damping_ratio * slope + bend / rate) / rate) / part.gain
    if isinstance(part, AbstractLinear) and part.system().order == 0:
        system = part.system()
        return (signal - system.offset) / system.gain
    raise ValueError(f"{name!r} is a {type(part).__name__}, which has no inverse here: take it out of the stage")


def _derivatives(time_s: Times, signal: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """First and second derivatives at the knots of the cubic spline whose end pieces run over two intervals."""
    n = signal.shape[0]
    if n < _FEWEST:
        raise ValueError(f"derivatives need {_FEWEST} samples or more, got {n}")
    time = lax.stop_gradient(jnp.asarray(time_s))
    interval = jnp.broadcast_to(time, (n - 1,)) if time.ndim == 0 else jnp.diff(time)
    mean = jnp.mean(interval)
    # In units of the mean interval, so that the equations have coefficients near one.
    h = (interval / mean).astype(signal.dtype)
    rise = jnp.diff(signal) / h
    left, right = h[:-1], h[1:]
    middle = 2 * (left + right)
    # The first bend is left + (left - right) h0 / h1 of its neighbours, and so is the last, backwards.
    middle = middle.at[0].add(left[0] * (1 + left[0] / right[0]))
    above = right.at[0].add(-left[0] * left[0] / right[0])
    middle = middle.at[-1].add(right[-1] * (1 + right[-1] / left[-1]))
    below = left.at[-1].add(-right[-1] * right[-1] / left[-1])
    inner = lax.linalg.tridiagonal_solve(
        below.at[0].set(0), middle, above.at[-1].set(0), 6 * jnp.diff(rise)[:, None]
    )[:, 0]
    first = inner[0] + (inner[0] - inner[1]) * left[0] / right[0]
    last = inner[-1] + (inner[-1] - inner[-2]) * right[-1] / left[-1]
    bend = jnp.concatenate([first[None], inner, last[None]])
    slope = rise - h * (2 * bend[:-1] + bend[1:]) / 6
    end = rise[-1] + h[-1] * (bend[-2] + 2 * bend[-1]) / 6
    scale = mean.astype(signal.dtype)
    return jnp.append(slope, end) / scale, bend / scale**2
