"""A few smooth bumps: the density in some dozens of numbers."""

from typing import ClassVar, Self

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from microid._param import array, param, static
from microid.densities._base import AbstractDensity, register

_COMPONENTS = 4


@register
class MixtureDensity(AbstractDensity):
    r"""A sum of components, each a bell in bias and another in coercivity.

    With bias `m = (alpha + beta) / 2` and coercivity `c = (alpha - beta) / 2`, both in fractions of the range,

    .. math:: \mu = \sum_k w_k \frac{1}{R^2}\, e^{-(m - m_k)^2 / 2 s_k^2}\, e^{-(c - c_k)^2 / 2 d_k^2}

    where `R` is the range in V. Laws of this kind are the classical parametric densities of the Preisach
    literature. A bell whose centre lies at a negative coercivity shows its flank only, much like an exponential.

    Attributes
    ----------
    weight_um
        Weight of each component, shape `(K,)`.
    bias
        Centre along the diagonal, fraction of the range, shape `(K,)`.
    spread
        Standard deviation along the diagonal, fraction of the range, shape `(K,)`.
    coercivity
        Centre across the diagonal, fraction of the range, shape `(K,)`.
    width
        Standard deviation across the diagonal, fraction of the range, shape `(K,)`.
    lower_V, upper_V, levels
        The grid at whose nodes the density is taken.
    """

    family: ClassVar[str] = "mixture"
    weight_um: Float[Array, " K"] = param(unit="um", scale=10.0, lower=0.0)
    bias: Float[Array, " K"] = param(unit="1", lower=-1.0, upper=2.0)
    spread: Float[Array, " K"] = param(unit="1", scale=0.3, lower=0.02)
    coercivity: Float[Array, " K"] = param(unit="1", lower=-0.5, upper=0.5)
    width: Float[Array, " K"] = param(unit="1", scale=0.1, lower=0.01)
    lower_V: Float[Array, ""] = array()
    upper_V: Float[Array, ""] = array()
    levels: int = static()

    def nodes_um_per_V2(self) -> Float[Array, "N N"]:
        """Density at the nodes, shape `(N, N)`."""
        v = jnp.linspace(0.0, 1.0, self.levels).astype(self.weight_um.dtype)
        alpha, beta = jnp.meshgrid(v, v, indexing="ij")
        middle, half = (alpha + beta) / 2, (alpha - beta) / 2

        def component(weight: Array, bias: Array, spread: Array, coercivity: Array, width: Array) -> Array:
            along, across = (middle - bias) / spread, (half - coercivity) / width
            return weight * jnp.exp(-(along**2 + across**2) / 2)

        each = jax.vmap(component)(self.weight_um, self.bias, self.spread, self.coercivity, self.width)
        return jnp.tril(jnp.sum(each, axis=0)) / (self.upper_V - self.lower_V) ** 2

    @classmethod
    def start(
        cls,
        lower_V: Float[Array, ""],
        upper_V: Float[Array, ""],
        levels: int,
        stroke_um: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> Self:
        """Draw centres and widths at random."""
        bias, spread, coercivity, width = jax.random.split(key, 4)
        k = _COMPONENTS
        return cls(
            weight_um=jnp.full(k, 4 * stroke_um / k),
            bias=jax.random.uniform(bias, (k,), minval=0.1, maxval=0.9),
            spread=jax.random.uniform(spread, (k,), minval=0.1, maxval=0.6),
            coercivity=jax.random.uniform(coercivity, (k,), minval=-0.1, maxval=0.2),
            width=jnp.exp(jax.random.uniform(width, (k,), minval=jnp.log(0.03), maxval=jnp.log(0.4))),
            lower_V=lower_V,
            upper_V=upper_V,
            levels=levels,
        )
