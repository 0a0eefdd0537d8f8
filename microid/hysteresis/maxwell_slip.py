"""Maxwell-slip: springs that slide once they are stretched too far."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._param import param
from microid._part import AbstractHysteresis, AbstractStepper
from microid.hysteresis._base import register
from microid.hysteresis._play import _plays


@register
class MaxwellSlip(AbstractHysteresis, AbstractStepper):
    r"""A proportional part less a sum of elements that stick, then slip.

    .. math:: w = w_0 + b u - \sum_k s_k, \qquad \dot s_k = b_k \dot u \text{ while } |s_k| < c_k

    Exact at the samples if the voltage is monotone between them.

    Attributes
    ----------
    slope_um_per_V
        Proportional part `b`, the slope of the curve while all elements slip. Not less than the sum of the
        stiffnesses, or the displacement would fall after a reversal to higher voltages.
    stiffness_um_per_V
        Slopes `b_k` of the elements while they stick, shape `(K,)`.
    limit_um
        What they give while they slip, `c_k`, shape `(K,)`.
    offset_um
        Displacement at no voltage with all elements relaxed.
    """

    slope_um_per_V: Float[Array, ""] = param(unit="um/V", scale=0.1, lower=0.0)
    stiffness_um_per_V: Float[Array, " K"] = param(unit="um/V", scale=0.1, lower=1e-9)
    limit_um: Float[Array, " K"] = param(unit="um", lower=0.0)
    offset_um: Float[Array, ""] = param(unit="um", scale=10.0, default=0.0)

    def __check_init__(self) -> None:
        """Refuse stiffnesses without limits."""
        if self.stiffness_um_per_V.shape != self.limit_um.shape or self.limit_um.ndim != 1:
            raise ValueError(
                f"every element has a stiffness and a limit, got shapes {self.stiffness_um_per_V.shape} "
                f"and {self.limit_um.shape}"
            )

    def __call__(self, voltage_V: Float[Array, " t"], start: Float[Array, " K"] | None = None) -> Float[Array, " t"]:
        """Respond to a voltage.

        Parameters
        ----------
        voltage_V
            Shape `(t,)`.
        start
            What the elements were relaxed at, in V, before the first sample, shape `(K,)`; all 0 V by default.

        Returns
        -------
        Array
            Displacement in um, shape `(t,)`.
        """
        voltage = jnp.asarray(voltage_V)
        # An element is stretched by as much as its play lags behind.
        stretch = voltage[:, None] - _plays(voltage, self.limit_um / self.stiffness_um_per_V, start)
        return self.offset_um + self.slope_um_per_V * voltage - stretch @ self.stiffness_um_per_V

    def init(
        self, before_V: Float[Array, ""], start: Float[Array, " K"] | None = None
    ) -> tuple[Float[Array, " K"], Float[Array, ""]]:
        """What the elements are relaxed at, in V, shape `(K,)`, and displacement in um, once at rest."""
        return self.step(jnp.zeros_like(self.limit_um) if start is None else start, before_V)

    def step(
        self, state: Float[Array, " K"], voltage_V: Float[Array, ""]
    ) -> tuple[Float[Array, " K"], Float[Array, ""]]:
        """What the elements are relaxed at, in V, shape `(K,)`, and displacement in um, at the next sample."""
        reach = self.limit_um / self.stiffness_um_per_V
        relaxed = jnp.clip(state, voltage_V - reach, voltage_V + reach)
        held = jnp.sum(self.stiffness_um_per_V * (voltage_V - relaxed))
        return relaxed, self.offset_um + self.slope_um_per_V * voltage_V - held
