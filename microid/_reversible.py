"""The memoryless part of the response: relay density concentrated on the diagonal."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._param import array, param


class Reversible(eqx.Module):
    """A smooth, monotone, memoryless curve: most of a real piezo's stroke.

    Relays with `alpha = beta` switch without a loop. Their density along the diagonal is the slope of the curve,
    piecewise linear between evenly spaced voltages and never negative.

    Attributes
    ----------
    slope_um_per_V
        Slope at the levels, shape `(N,)`.
    lower_V, upper_V
        Range of the levels; the curve is flat beyond.
    """

    slope_um_per_V: Float[Array, " N"] = param(unit="um/V", scale=0.1, lower=0.0)
    lower_V: Float[Array, ""] = array()
    upper_V: Float[Array, ""] = array()

    def __check_init__(self) -> None:
        """Refuse a curve without an interval."""
        if self.slope_um_per_V.ndim != 1 or self.slope_um_per_V.shape[0] < 2:
            raise ValueError("a reversible curve needs the slope at two levels or more")

    @property
    def levels(self) -> int:
        """Number of levels."""
        return self.slope_um_per_V.shape[0]

    def __call__(self, voltage_V: Float[Array, "..."]) -> Float[Array, "..."]:
        """Displacement, zero at the lower end of the range, in um."""
        n = self.levels - 1
        step = (self.upper_V - self.lower_V) / n
        voltage = jnp.asarray(voltage_V, dtype=self.lower_V.dtype)
        # Not clip: it halves the derivative at the ends of the range.
        capped = jnp.where(voltage > self.upper_V, self.upper_V, voltage)
        x = (jnp.where(voltage < self.lower_V, self.lower_V, capped) - self.lower_V) / step
        i = jnp.clip(jnp.floor(x).astype(jnp.int32), 0, n - 1)
        s = x - i.astype(x.dtype)
        slope, rise = self.slope_um_per_V[:-1], jnp.diff(self.slope_um_per_V)
        before = jnp.concatenate([jnp.zeros(1, slope.dtype), jnp.cumsum(slope + rise / 2)])
        return step * (before[i] + s * (slope[i] + s * rise[i] / 2))
