"""The law of Prandtl and Ishlinskii: a sum of plays, with an inverse in closed form."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._param import param
from microid._part import AbstractHysteresis, AbstractStepper
from microid.hysteresis._base import register
from microid.hysteresis._play import _plays


@register
class PrandtlIshlinskii(AbstractHysteresis, AbstractStepper):
    r"""A proportional part and a weighted sum of plays.

    .. math:: w(t) = w_0 + b u(t) + \sum_k b_k\, p_k(t), \qquad p_k = \max(u - r_k, \min(u + r_k, p_k^{before}))

    Exact at the samples if the voltage is monotone between them. Loops are symmetric under a half turn.

    Attributes
    ----------
    slope_um_per_V
        Proportional part `b`.
    weight_um_per_V
        Weights `b_k`, shape `(K,)`.
    threshold_V
        Thresholds `r_k`, shape `(K,)`, in any order: each play moves once the voltage has turned by twice its own.
    offset_um
        Displacement at no voltage if nothing is remembered.
    """

    slope_um_per_V: Float[Array, ""] = param(unit="um/V", scale=0.1, lower=0.0)
    weight_um_per_V: Float[Array, " K"] = param(unit="um/V", scale=0.1, lower=0.0)
    threshold_V: Float[Array, " K"] = param(unit="V", scale=10.0, lower=0.0)
    offset_um: Float[Array, ""] = param(unit="um", scale=10.0, default=0.0)

    def __check_init__(self) -> None:
        """Refuse weights without thresholds."""
        if self.weight_um_per_V.shape != self.threshold_V.shape or self.threshold_V.ndim != 1:
            raise ValueError(
                f"every play has a weight and a threshold, got shapes {self.weight_um_per_V.shape} "
                f"and {self.threshold_V.shape}"
            )

    def __call__(self, voltage_V: Float[Array, " t"], start: Float[Array, " K"] | None = None) -> Float[Array, " t"]:
        """Respond to a voltage.

        Parameters
        ----------
        voltage_V
            Shape `(t,)`.
        start
            Positions of the plays in V before the first sample, shape `(K,)`; all zero, nothing remembered, by
            default.

        Returns
        -------
        Array
            Displacement in um, shape `(t,)`.
        """
        voltage = jnp.asarray(voltage_V)
        hidden = _plays(voltage, self.threshold_V, start) @ self.weight_um_per_V
        return self.offset_um + self.slope_um_per_V * voltage + hidden

    def init(
        self, before_V: Float[Array, ""], start: Float[Array, " K"] | None = None
    ) -> tuple[Float[Array, " K"], Float[Array, ""]]:
        """Positions of the plays in V, shape `(K,)`, and displacement in um, after the voltage has come to rest."""
        return self.step(jnp.zeros_like(self.threshold_V) if start is None else start, before_V)

    def step(
        self, state: Float[Array, " K"], voltage_V: Float[Array, ""]
    ) -> tuple[Float[Array, " K"], Float[Array, ""]]:
        """Positions of the plays in V, shape `(K,)`, and displacement in um, at the next sample."""
        position = jnp.clip(state, voltage_V - self.threshold_V, voltage_V + self.threshold_V)
        hidden = jnp.sum(self.weight_um_per_V * position)
        return position, self.offset_um + self.slope_um_per_V * voltage_V + hidden

    def invert(
        self, displacement_um: Float[Array, " t"], start: Float[Array, " K"] | None = None
    ) -> Float[Array, " t"]:
        """Find the voltage that gives a displacement: again a sum of plays, in closed form.

        Parameters
        ----------
        displacement_um
            Shape `(t,)`.
        start
            Positions of the plays in V before the first sample, shape `(K,)`, as some voltage has left them; all
            zero by default.

        Returns
        -------
        Array
            Voltage in V, shape `(t,)`; not finite if the slope is zero.
        """
        order = jnp.argsort(self.threshold_V)
        threshold, weight = self.threshold_V[order], self.weight_um_per_V[order]
        position = jnp.zeros_like(threshold) if start is None else start[order]
        # Slope of the curve while the first k plays move, and how far it is to where the next one begins to.
        slope = self.slope_um_per_V + jnp.concatenate([jnp.zeros_like(weight[:1]), jnp.cumsum(weight)])
        reach = threshold * slope[1:] - jnp.cumsum(weight * threshold)
        # Plays with less slack count as if they stood where this one does, those with more as they stand.
        wider = jnp.sum(weight * position) - jnp.cumsum(weight * position)
        begin = position * slope[1:] + wider
        level = jnp.asarray(displacement_um) - self.offset_um
        return level / self.slope_um_per_V - _plays(level, reach, begin) @ (weight / (slope[:-1] * slope[1:]))
