"""Two degrees of freedom: the inverse of a stage for what is known, feedback for what is not."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._inverse_stage import invert_stage
from microid._memory import Staircase
from microid._param import _as_inexact
from microid._stage import Stage, Start

_Scalar = Float[Array, ""] | float
# So many equal lags make a step smooth enough for the inverse of a driver and a mass: four derivatives.
_LAGS = 4


class TwoDegrees(eqx.Module):
    """What a loop with two degrees of freedom is given.

    Attributes
    ----------
    target_um
        The reference as the reference model leaves it, shape `(t,)`.
    feedforward_V
        Command to be held from sample to sample, by the inverse of the stage, shape `(t,)`.
    expected_um
        What the stage makes of it by the model, shape `(t,)`: the reference for the feedback, which then answers to
        nothing but what the model does not know.
    start
        At rest under the first command.
    """

    target_um: Float[Array, " t"]
    feedforward_V: Float[Array, " t"]
    expected_um: Float[Array, " t"]
    start: Start


def two_degrees(
    stage: Stage,
    interval_s: _Scalar,
    reference_um: Float[Array, " t"],
    memory: Staircase | None = None,
    *,
    lag_s: _Scalar = 0.0,
    limits_V: tuple[_Scalar, _Scalar] | None = None,
) -> TwoDegrees:
    r"""Design feedforward and the reference that goes with it.

    .. math:: x_{k} = a x_{k-1} + (1 - a) r_k, \qquad a = e^{-T / \tau} \quad \text{four times in a row}

    The command of `invert_stage` runs in lines; held, each takes the mean of its line. With a perfect model the
    feedback has nothing to do, so it may be tuned for disturbances alone.

    Parameters
    ----------
    stage
        See `invert_stage`.
    interval_s
        Between two samples of the controller.
    reference_um
        Wanted displacement, shape `(t,)`, at rest at first. Steps need a reference model.
    memory
        Of the hysteresis, before the stage came to rest where the reference begins; negative saturation by default.
    lag_s
        Time constant `τ` of the reference model, which has no overshoot; none by default.
    limits_V
        Range to which the command is cut.

    Returns
    -------
    TwoDegrees
        For `simulate_loop(controller, plant, expected_um, feedforward_V=..., start=...)`.

    Raises
    ------
    ValueError
        See `invert_stage`.
    """
    reference, interval = _as_inexact(reference_um), _as_inexact(interval_s)
    limits = None if limits_V is None else (_as_inexact(limits_V[0]), _as_inexact(limits_V[1]))
    return _design(stage, interval, reference, memory, _as_inexact(lag_s), limits)


@eqx.filter_jit
def _design(
    stage: Stage,
    interval_s: Float[Array, ""],
    reference: Float[Array, " t"],
    memory: Staircase | None,
    lag_s: Float[Array, ""],
    limits_V: tuple[_Scalar, _Scalar] | None,
) -> TwoDegrees:
    # The quotient of zeros is nowhere looked at; its derivative would be.
    keep = jnp.where(lag_s > 0, jnp.exp(-interval_s / jnp.where(lag_s > 0, lag_s, 1)), 0)

    def visit(before: Array, value: Array) -> tuple[Array, Array]:
        lags = []
        for k in range(_LAGS):
            value = keep * before[k] + (1 - keep) * value
            lags.append(value)
        return jnp.stack(lags), value

    _, target = lax.scan(visit, jnp.full(_LAGS, reference[0]), reference)
    lines = invert_stage(stage, interval_s, target, memory).voltage_V
    held = jnp.append((lines[:-1] + lines[1:]) / 2, lines[-1])
    if limits_V is not None:
        held = jnp.clip(held, *limits_V)
    start = Start(lines[0] if limits_V is None else jnp.clip(lines[0], *limits_V), memory)
    steps = Stage(stage.parts, stage.names, "zero", stage.substeps, stage.frozen)
    return TwoDegrees(target, held, steps(interval_s, held, start), start)
