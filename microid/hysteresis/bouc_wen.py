"""The law of Bouc and Wen."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._param import param
from microid._part import AbstractHysteresis, AbstractStepper
from microid.hysteresis._base import register


@register
class BoucWen(AbstractHysteresis, AbstractStepper):
    r"""A proportional part less the state of Bouc and Wen.

    .. math:: w = w_0 + b u - h, \qquad
        \frac{dh}{du} = A - |h|^n \left(\gamma + \beta\, \mathrm{sgn}(h \dot u)\right)

    with `h` in um, in the form used for piezos since Low and Guo. There is no closed form for all `n`: the state is
    integrated in the voltage, by `substeps` steps of the classical fourth-order Runge-Kutta rule per sample.
    The error falls with their fourth power where `h` does not change its sign; at a change of sign, with their
    power `n + 1`.

    Attributes
    ----------
    slope_um_per_V
        Proportional part `b`. Not less than `A`, or the displacement would fall right after a reversal.
    stiffness_um_per_V
        Slope `A` of the state at zero.
    beta, gamma
        Shape of the loops, in um/V per um to the power `n`; `beta + gamma > 0` bounds the state, `beta >= |gamma|`
        makes it lose work.
    exponent
        `n`, one or more: how sharply the state bends.
    offset_um
        Displacement at no voltage with the state at zero.
    substeps
        Steps of integration per sample.
    """

    slope_um_per_V: Float[Array, ""] = param(unit="um/V", scale=0.1, lower=0.0)
    stiffness_um_per_V: Float[Array, ""] = param(unit="um/V", scale=0.1, lower=0.0)
    beta: Float[Array, ""] = param(unit="um^(1-n)/V", scale=0.1)
    gamma: Float[Array, ""] = param(unit="um^(1-n)/V", scale=0.1)
    exponent: Float[Array, ""] = param(unit="1", lower=1.0, default=1.0)
    offset_um: Float[Array, ""] = param(unit="um", scale=10.0, default=0.0)
    substeps: int = eqx.field(static=True, default=8)

    def __call__(self, voltage_V: Float[Array, " t"], start: Float[Array, " 2"] | None = None) -> Float[Array, " t"]:
        """Respond to a voltage.

        Parameters
        ----------
        voltage_V
            Shape `(t,)`.
        start
            Voltage in V and state `h` in um before the first sample, shape `(2,)`; the first sample's voltage and 0
            by default.

        Returns
        -------
        Array
            Displacement in um, shape `(t,)`.
        """
        voltage = jnp.asarray(voltage_V)
        before, state = (voltage[0], jnp.zeros_like(voltage[0])) if start is None else (start[0], start[1])
        moves = jnp.diff(voltage, prepend=before[None])

        def visit(h: Array, move: Array) -> tuple[Array, Array]:
            h = self._follow(h, move)
            return h, h

        state = lax.scan(visit, state, moves)[1]
        return self.offset_um + self.slope_um_per_V * voltage - state

    def init(
        self, before_V: Float[Array, ""], start: Float[Array, " 2"] | None = None
    ) -> tuple[Float[Array, " 2"], Float[Array, ""]]:
        """Voltage in V and state `h` in um, shape `(2,)`, and displacement in um, once at rest."""
        return self.step(jnp.stack([before_V, jnp.zeros_like(before_V)]) if start is None else start, before_V)

    def step(
        self, state: Float[Array, " 2"], voltage_V: Float[Array, ""]
    ) -> tuple[Float[Array, " 2"], Float[Array, ""]]:
        """Voltage in V and state `h` in um, shape `(2,)`, and displacement in um, at the next sample."""
        h = self._follow(state[1], voltage_V - state[0])
        return jnp.stack([voltage_V, h]), self.offset_um + self.slope_um_per_V * voltage_V - h

    def _follow(self, h: Float[Array, ""], move_V: Float[Array, ""]) -> Float[Array, ""]:
        """The state `h` in um after the voltage has moved."""
        move, sign = move_V / self.substeps, jnp.sign(move_V)

        def rate(h: Array) -> Array:
            size = jnp.abs(h)
            # The logarithm has no derivative at zero, where the power has.
            at_zero = size == 0
            power = jnp.where(at_zero, 0, jnp.exp(self.exponent * jnp.log(jnp.where(at_zero, 1, size))))
            return self.stiffness_um_per_V - power * (self.gamma + self.beta * jnp.sign(h) * sign)

        def step(_: Array, h: Array) -> Array:
            k1 = rate(h)
            k2 = rate(h + move * k1 / 2)
            k3 = rate(h + move * k2 / 2)
            return h + move * (k1 + 2 * k2 + 2 * k3 + rate(h + move * k3)) / 6

        return lax.fori_loop(0, self.substeps, step, h)
