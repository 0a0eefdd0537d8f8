"""Duhem's law in the form of Coleman and Hodgdon: the displacement pursues a curve, in proportion to its distance."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._param import param
from microid._part import AbstractHysteresis, AbstractStepper
from microid.hysteresis._base import register
from microid.hysteresis._rates import _direction, _mean_decay, _mean_ramp, _relax


@register
class Duhem(AbstractHysteresis, AbstractStepper):
    r"""Pursuit of an anhysteretic curve `f`.

    .. math:: \frac{dw}{du} = \alpha\, (f(u) - w)\, \mathrm{sgn}\, \dot u + g, \qquad f(u) = w_0 + b u + a u^2

    Between two samples the solution is a parabola and an exponential of the voltage: exact if the voltage is
    monotone there.

    Attributes
    ----------
    pursuit_per_V
        Rate `alpha`.
    slope_um_per_V
        Slope `b` of the curve at no voltage.
    curvature_um_per_V2
        Its coefficient `a` of the square.
    local_um_per_V
        Slope `g` on the curve, right after a reversal; between 0 and that of the curve.
    offset_um
        The curve at no voltage.
    """

    pursuit_per_V: Float[Array, ""] = param(unit="1/V", scale=0.1, lower=0.0)
    slope_um_per_V: Float[Array, ""] = param(unit="um/V", scale=0.1)
    curvature_um_per_V2: Float[Array, ""] = param(unit="um/V^2", scale=1e-3)
    local_um_per_V: Float[Array, ""] = param(unit="um/V", scale=0.1)
    offset_um: Float[Array, ""] = param(unit="um", scale=10.0, default=0.0)

    def __call__(self, voltage_V: Float[Array, " t"], start: Float[Array, " 2"] | None = None) -> Float[Array, " t"]:
        """Respond to a voltage.

        Parameters
        ----------
        voltage_V
            Shape `(t,)`.
        start
            Voltage in V and distance from the curve in um before the first sample, shape `(2,)`; the first sample's
            voltage, on the curve, by default.

        Returns
        -------
        Array
            Displacement in um, shape `(t,)`.
        """
        voltage = jnp.asarray(voltage_V)
        before, distance = (voltage[0], jnp.zeros_like(voltage[0])) if start is None else (start[0], start[1])
        path = jnp.concatenate([before[None], voltage])
        sign, move = _direction(path)[1:], jnp.diff(path)
        steps = self.pursuit_per_V * sign * move
        # The distance q = w - f(u) has dq/du = -alpha q sgn + (g - b - 2 a u), a line between two samples.
        lead = self.local_um_per_V - self.slope_um_per_V - 2 * self.curvature_um_per_V2 * path[:-1]
        bend = 2 * self.curvature_um_per_V2 * move
        push = move * (lead * _mean_decay(steps) - bend * _mean_ramp(steps))
        curve = self.offset_um + voltage * (self.slope_um_per_V + self.curvature_um_per_V2 * voltage)
        return curve + _relax(jnp.exp(-steps), push, distance)

    def init(
        self, before_V: Float[Array, ""], start: Float[Array, " 2"] | None = None
    ) -> tuple[Float[Array, " 2"], Float[Array, ""]]:
        """Voltage in V and distance from the curve in um, shape `(2,)`, and displacement in um, once at rest."""
        return self.step(jnp.stack([before_V, jnp.zeros_like(before_V)]) if start is None else start, before_V)

    def step(
        self, state: Float[Array, " 2"], voltage_V: Float[Array, ""]
    ) -> tuple[Float[Array, " 2"], Float[Array, ""]]:
        """Voltage in V and distance from the curve in um, shape `(2,)`, and displacement, at the next sample."""
        move = voltage_V - state[0]
        steps = self.pursuit_per_V * jnp.abs(move)
        lead = self.local_um_per_V - self.slope_um_per_V - 2 * self.curvature_um_per_V2 * state[0]
        push = move * (lead * _mean_decay(steps) - 2 * self.curvature_um_per_V2 * move * _mean_ramp(steps))
        distance = jnp.exp(-steps) * state[1] + push
        curve = self.offset_um + voltage_V * (self.slope_um_per_V + self.curvature_um_per_V2 * voltage_V)
        return jnp.stack([voltage_V, distance]), curve + distance
