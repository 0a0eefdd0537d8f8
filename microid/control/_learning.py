"""Iterative learning: what repeats in the error of a trial is taken out before the next."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._param import _as_inexact
from microid._part import _complex
from microid._stage import Stage
from microid.control._base import AbstractLinearController
from microid.control._margins import loop_gain
from microid.control.pid import PID

_Scalar = Float[Array, ""] | float
# Where the inverse of a sampled stage is asked for at no frequency: this share of half the sampling rate.
_SLOWEST = 1e-9


class Learnt(eqx.Module):
    """What trials taught.

    Attributes
    ----------
    command_V
        Of the trial with the least error, shape `(t,)`.
    error_um
        Reference less displacement of every trial, the first included, shape `(trials + 1, t)`.
    rms_um
        Of each, shape `(trials + 1,)`.
    """

    command_V: Float[Array, " t"]
    error_um: Float[Array, "k t"]
    rms_um: Float[Array, " k"]


def learn_once(
    command_V: Float[Array, " t"],
    error_um: Float[Array, " t"],
    stage: Stage,
    interval_s: _Scalar,
    *,
    bandwidth_Hz: _Scalar,
    share: _Scalar = 0.5,
    controller: AbstractLinearController | None = None,
    delay: int = 0,
    slope_um_per_V: _Scalar | None = None,
) -> Float[Array, " t"]:
    r"""Correct a command by the error it left.

    .. math:: u_{k+1} = u_k + L e_k, \qquad L = \mu Q / P, \qquad Q = \frac{1}{1 + (f / f_b)^8}

    `P` is the sampled stage, or what a feedback loop around it makes of a feedforward, `P / (1 + C P)`; its inverse
    looks ahead, which a finished trial allows. The real filter `Q` shifts no phase. Where the stage is `P (1 + d)`,
    an error shrinks from trial to trial by `1 - μ Q (1 + d)`: what is slow vanishes as `(1 - μ)^k`, and all of it if
    the model is wrong by less than 100 % wherever `Q` lets through (Bristow, Tharayil and Alleyne 2006).

    Parameters
    ----------
    command_V, error_um
        Of the last trial, shape `(t,)`; the trial begins at rest. The record is taken to stay at its ends' values
        before and after.
    stage
        The model, of linear parts and at most one hysteresis.
    interval_s
        Between two samples.
    bandwidth_Hz
        `f_b`: up to where the model is to be trusted.
    share
        `μ`, of 0 to 1. Less: slower, and less of the noise of the trials.
    controller, delay
        The feedback, if it goes on during trials: `command_V` is then its feedforward.
    slope_um_per_V
        What stands for a hysteresis; see `margins`.

    Returns
    -------
    Array
        The next command, shape `(t,)`.

    Raises
    ------
    ValueError
        See `margins`.
    """
    numbers = (_as_inexact(x) for x in (command_V, error_um, interval_s, bandwidth_Hz, share))
    slope = None if slope_um_per_V is None else _as_inexact(slope_um_per_V)
    return _corrected(stage, controller, delay, slope, *numbers)


@eqx.filter_jit
def _corrected(
    stage: Stage,
    controller: AbstractLinearController | None,
    delay: int,
    slope_um_per_V: _Scalar | None,
    command: Float[Array, " t"],
    error: Float[Array, " t"],
    interval: Float[Array, ""],
    bandwidth: Float[Array, ""],
    share: Float[Array, ""],
) -> Float[Array, " t"]:
    n = error.shape[0]
    # What lies before and after keeps the ends of the record apart, which the transform joins.
    whole = jnp.pad(error, (n, n), mode="edge")
    frequency = jnp.maximum(jnp.fft.rfftfreq(3 * n).astype(error.dtype), _SLOWEST / 2) / interval
    path = loop_gain(PID.from_times(1.0, math.inf, 0.0, interval), stage, frequency, slope_um_per_V=slope_um_per_V)
    if controller is not None:
        turn = 2 * jnp.pi * frequency * interval
        z = lax.complex(jnp.cos(turn), jnp.sin(turn))
        path = path / (1 + controller.transfer(z) * path * z ** (-delay))
    passed = share / (1 + (frequency / bandwidth) ** 8)
    found = jnp.fft.irfft(_complex(passed) * jnp.fft.rfft(whole) / path, 3 * n)
    return command + found[n : 2 * n]


def iterative_learning(
    run: Callable[[Float[Array, " t"]], Any],
    reference_um: Float[Array, " t"],
    command_V: Float[Array, " t"],
    stage: Stage,
    interval_s: _Scalar,
    *,
    trials: int = 10,
    limits_V: tuple[_Scalar, _Scalar] | None = None,
    **filters: Any,
) -> Learnt:
    """Repeat a trajectory, and correct the command after each trial.

    Parameters
    ----------
    run
        Plays a command, shape `(t,)`, from the same rest each time and gives the displacement in um, shape `(t,)`: a
        stage, a loop whose feedforward it is, or a real bench. It is called `trials + 1` times.
    reference_um, command_V
        Wanted displacement and the first command, shape `(t,)`.
    stage, interval_s, filters
        See `learn_once`, which also says what `filters` may name.
    trials
        Number of corrections.
    limits_V
        Range to which commands are cut.

    Raises
    ------
    ValueError
        If the shapes differ, a displacement is not finite, or see `learn_once`.
    """
    reference, command = _as_inexact(reference_um), _as_inexact(command_V)
    if reference.shape != command.shape or reference.ndim != 1:
        raise ValueError(f"reference and command need one shape (t,), got {reference.shape} and {command.shape}")
    errors, commands = [], []
    for trial in range(trials + 1):
        if limits_V is not None:
            command = jnp.clip(command, *limits_V)
        error = reference - _as_inexact(run(command))
        if not bool(jnp.all(jnp.isfinite(error))):
            raise ValueError(f"the displacement of trial {trial} is not finite: lower the share or the bandwidth")
        commands.append(command)
        errors.append(error)
        if trial < trials:
            command = learn_once(command, error, stage, interval_s, **filters)
    rms = jnp.sqrt(jnp.mean(jnp.stack(errors) ** 2, axis=1))
    return Learnt(commands[int(jnp.argmin(rms))], jnp.stack(errors), rms)
