"""Controller and stage in one scan at the controller's sample rate."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._param import _as_inexact
from microid._stage import Stage, Start
from microid.control._base import AbstractController
from microid.control._sampled import AbstractPlant, SampledStage

_Scalar = Float[Array, ""] | float


class ControlledRun(eqx.Module):
    """What happened in a closed loop, each of shape `(t,)`.

    Attributes
    ----------
    time_s
        From zero on.
    reference_um
        Wanted displacement.
    displacement_um
        True displacement at the sample, before the command changes.
    measured_um
        What the controller was given: late, noisy and rounded.
    command_V
        From this sample to the next.
    error_um
        Wanted less true displacement (Eq. 22).
    """

    time_s: Float[Array, " t"]
    reference_um: Float[Array, " t"]
    displacement_um: Float[Array, " t"]
    measured_um: Float[Array, " t"]
    command_V: Float[Array, " t"]
    error_um: Float[Array, " t"]


class _Channel(eqx.Module):
    """What lies between controller and plant."""

    resolution_um: Float[Array, ""] | None
    resolution_V: Float[Array, ""] | None
    lower_V: Float[Array, ""] | None
    upper_V: Float[Array, ""] | None


def simulate_loop(
    controller: AbstractController,
    plant: Stage | AbstractPlant,
    reference_um: Float[Array, " t"],
    *,
    feedforward_V: Float[Array, " t"] | None = None,
    noise_um: Float[Array, " t"] | None = None,
    delay: int = 0,
    resolution_um: _Scalar | None = None,
    resolution_V: _Scalar | None = None,
    limits_V: tuple[_Scalar, _Scalar] | None = None,
    start: Start | None = None,
) -> ControlledRun:
    """Run a closed loop.

    At every sample the displacement is read, the controller chooses a command, and the stage is under it until the
    next sample; so a stage without inertia answers one sample late. A pure function: use `eqx.filter_vmap` over
    controllers, plants or noise, and `eqx.filter_grad` through it.

    Parameters
    ----------
    controller
        Its `interval_s` is the interval of the loop.
    plant
        A stage, see `SampledStage`, or anything else that steps.
    reference_um
        Wanted displacement, shape `(t,)`.
    feedforward_V
        Command without feedback, shape `(t,)`, from `invert_stage` for example; none by default.
    noise_um
        Added to the reading of each sample, shape `(t,)`.
    delay
        How many samples old the reading is that the controller is given. Before the first it is that at rest.
    resolution_um, resolution_V
        Steps to which readings and commands are rounded. Derivatives pass as if they were not.
    limits_V
        What the amplifier cuts off, if the controller does not.
    start
        How the stage stood before: at rest under 0 V by default. There the reference is taken to have been where the
        stage stood, and the feedforward, if there is one, to have kept it there.

    Returns
    -------
    ControlledRun
        Not finite from where an unstable loop overflows.

    Raises
    ------
    ValueError
        If signals differ in shape, the delay is negative, or a part of the stage cannot be stepped.
    """
    reference = _as_inexact(reference_um)
    given = {"feedforward_V": feedforward_V, "noise_um": noise_um}
    if reference.ndim != 1:
        raise ValueError(
            f"reference_um must have one axis, got shape {reference.shape}: use eqx.filter_vmap for more"
        )
    for name, signal in given.items():
        if signal is not None and jnp.shape(signal) != reference.shape:
            raise ValueError(
                f"{name} must have the shape {reference.shape} of the reference, got {jnp.shape(signal)}"
            )
    if delay < 0:
        raise ValueError(f"delay must be a number of samples, 0 or more, got {delay}")
    low, high = (None, None) if limits_V is None else limits_V
    rounding = (resolution_um, resolution_V, low, high)
    channel = _Channel(*(None if value is None else _as_inexact(value) for value in rounding))
    signals = {name: None if signal is None else _as_inexact(signal) for name, signal in given.items()}
    return _run(controller, plant, reference, signals, channel, delay, Start() if start is None else start)


@eqx.filter_jit
def _run(
    controller: AbstractController,
    plant: Stage | AbstractPlant,
    reference: Float[Array, " t"],
    signals: dict[str, Any],
    channel: _Channel,
    delay: int,
    start: Start,
) -> ControlledRun:
    zeros = jnp.zeros_like(reference)
    feedforward, noise = (zeros if signals[name] is None else signals[name] for name in ("feedforward_V", "noise_um"))
    plant = SampledStage(plant, controller.interval_s) if isinstance(plant, Stage) else plant
    rest_V = None if signals["feedforward_V"] is not None else start.rest_V
    carry = _rest(controller, plant, delay, start, zeros[0] if rest_V is None else rest_V)

    def visit(carry: Any, now: tuple[Array, Array, Array]) -> tuple[Any, tuple[Array, ...]]:
        return _once(controller, plant, channel, carry, *now)

    _, (displacement, measured, command) = lax.scan(visit, carry, (reference, feedforward, noise))
    time_s = controller.interval_s * jnp.arange(reference.shape[0], dtype=reference.dtype)
    return ControlledRun(time_s, reference, displacement, measured, command, reference - displacement)


def _rest(
    controller: AbstractController, plant: AbstractPlant, delay: int, start: Start, feedback_V: Float[Array, ""]
) -> Any:
    """States of controller and plant, the displacement, and the readings on their way, all at rest."""
    state, displacement = plant.init(start)
    return controller.init(displacement, feedback_V), state, displacement, (displacement,) * delay


def _once(
    controller: AbstractController,
    plant: AbstractPlant,
    channel: _Channel,
    carry: Any,
    reference: Float[Array, ""],
    feedforward: Float[Array, ""],
    noise: Float[Array, ""],
) -> tuple[Any, tuple[Array, Array, Array]]:
    """One sample: read, decide, move."""
    control, state, displacement, late = carry
    late = [*late, _rounded(displacement + noise, channel.resolution_um)]
    measured = late[0]
    control, command = controller.step(control, reference, measured, feedforward)
    command = _rounded(command, channel.resolution_V)
    if channel.lower_V is not None:
        command = jnp.clip(command, channel.lower_V, channel.upper_V)
    state, after = plant.step(state, command)
    return (control, state, after, tuple(late[1:])), (displacement, measured, command)


def _rounded(value: Float[Array, ""], step: Float[Array, ""] | None) -> Float[Array, ""]:
    if step is None:
        return value
    return value + lax.stop_gradient(step * jnp.round(value / step) - value)
