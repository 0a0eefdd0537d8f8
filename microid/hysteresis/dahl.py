"""Dahl's law of friction: a state that approaches its limits exponentially."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._param import param
from microid._part import AbstractHysteresis, AbstractStepper
from microid.hysteresis._base import register
from microid.hysteresis._rates import _direction, _mean_decay, _relax


@register
class Dahl(AbstractHysteresis, AbstractStepper):
    r"""A proportional part less Dahl's friction of exponent one.

    .. math:: w = w_0 + b u - c z, \qquad \frac{dz}{du} = \frac{1 - z\, \mathrm{sgn}\, \dot u}{v}

    Between two samples the state is an exponential of the voltage: exact if the voltage is monotone there.

    Attributes
    ----------
    slope_um_per_V
        Proportional part `b`. Not less than `c / v`, or the displacement would fall right after a reversal.
    amplitude_um
        Half the width of a large loop, `c`.
    length_V
        Change of voltage `v` in which the state comes closer to its limit by a factor of e.
    offset_um
        Displacement at no voltage with the state at zero.
    """

    slope_um_per_V: Float[Array, ""] = param(unit="um/V", scale=0.1, lower=0.0)
    amplitude_um: Float[Array, ""] = param(unit="um", lower=0.0)
    length_V: Float[Array, ""] = param(unit="V", scale=10.0, lower=1e-6)
    offset_um: Float[Array, ""] = param(unit="um", scale=10.0, default=0.0)

    def __call__(self, voltage_V: Float[Array, " t"], start: Float[Array, " 2"] | None = None) -> Float[Array, " t"]:
        """Respond to a voltage.

        Parameters
        ----------
        voltage_V
            Shape `(t,)`.
        start
            Voltage in V and state `z`, from -1 to 1, before the first sample, shape `(2,)`; the first sample's
            voltage and 0 by default.

        Returns
        -------
        Array
            Displacement in um, shape `(t,)`.
        """
        voltage = jnp.asarray(voltage_V)
        before, state = (voltage[0], jnp.zeros_like(voltage[0])) if start is None else (start[0], start[1])
        path = jnp.concatenate([before[None], voltage])
        sign, move = _direction(path)[1:], jnp.diff(path)
        steps = sign * move / self.length_V
        state = _relax(jnp.exp(-steps), move / self.length_V * _mean_decay(steps), state)
        return self.offset_um + self.slope_um_per_V * voltage - self.amplitude_um * state

    def init(
        self, before_V: Float[Array, ""], start: Float[Array, " 2"] | None = None
    ) -> tuple[Float[Array, " 2"], Float[Array, ""]]:
        """Voltage in V and state `z`, shape `(2,)`, and displacement in um, after the voltage has come to rest."""
        return self.step(jnp.stack([before_V, jnp.zeros_like(before_V)]) if start is None else start, before_V)

    def step(
        self, state: Float[Array, " 2"], voltage_V: Float[Array, ""]
    ) -> tuple[Float[Array, " 2"], Float[Array, ""]]:
        """Voltage in V and state `z`, shape `(2,)`, and displacement in um, at the next sample."""
        move = voltage_V - state[0]
        steps = jnp.abs(move) / self.length_V
        z = jnp.exp(-steps) * state[1] + move / self.length_V * _mean_decay(steps)
        displacement = self.offset_um + self.slope_um_per_V * voltage_V - self.amplitude_um * z
        return jnp.stack([voltage_V, z]), displacement
