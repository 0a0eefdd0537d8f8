"""Mechanics whose spring has a memory: hysteresis inside the equation of motion, not ahead of it."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._linear import Times
from microid._part import AbstractHysteresis, AbstractPart, AbstractStepper, Signal
from microid._plant import Mechanics
from microid.control._hysteresis_step import _step_form
from microid.effects._oscillator import _braked, _forces_um

# Newton's steps to the displacement at rest, on a curve that rises everywhere.
_STEPS = 8


class HystereticMechanics(AbstractPart):
    r"""Mass and damper on a spring that yields by a law of hysteresis `H` of the mass's own displacement.

    .. math:: \ddot y + 2 \zeta \omega \dot y + \omega^2 \left(y - H[y]\right) = \omega^2 \lambda w

    The law takes the displacement in um where it takes a voltage elsewhere, so that its slopes in um/V are in um/um
    here. With a `BoucWen` of slope zero, `-H` is its state and the equation is that of the Bouc-Wen benchmark (Noel
    and Schoukens 2016): `omega**2 = k / m`, and `h = z / k`. With a `PrandtlIshlinskii` or a `Preisach` the spring is
    softest for large moves; with a `Dahl` or a `MaxwellSlip` of slope zero it is a spring beside friction.

    Attributes
    ----------
    inner
        Natural frequency, damping ratio and gain without the law.
    law
        A hysteresis that has a form for single samples: all of `microid.hysteresis.LAWS`, and `Preisach`.

    Notes
    -----
    The linear part is exact from sample to sample, and the law's force runs in a line over each interval: an error of
    second order in the interval. `Stage.substeps` divides it.
    """

    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    inner: Mechanics
    law: AbstractHysteresis

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Pass a piezo's displacement on, from rest under its value before the first sample.

        Before that the law was in its own default state, at no displacement.
        """
        stepper: AbstractStepper = _step_form("law", self.law)
        gain = self.inner.gain

        wanted = gain * signal.before

        def excess_um(rest: Float[Array, ""]) -> Float[Array, ""]:
            return rest - stepper.init(rest, None)[1] - wanted

        def newton(rest: Float[Array, ""], _: None) -> tuple[Float[Array, ""], None]:
            off, slope = jax.jvp(excess_um, (rest,), (jnp.ones_like(rest),))
            return rest - off / slope, None

        rest_um, _ = lax.scan(newton, wanted, None, length=_STEPS)
        memory, yields = stepper.init(rest_um, None)

        def force(_: Array, there: Array, memory: Any) -> tuple[Array, Any]:
            memory, yields = stepper.step(memory, there)
            return -yields / gain, memory

        before = -yields / gain
        taken = _forces_um(self.inner, time_s, signal, force, before, memory)
        return _braked(self.inner, time_s, signal, start, taken, before)
