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
    r"""A sum of components, each a bell in bias and a half-bell or exponential decay in coercivity.

    With bias `m = (alpha + beta) / 2` and coercivity `c = (alpha - beta) / 2`, both in fractions of the range,

    .. math:: \mu = \sum_k w_k \frac{1}{R^2}\, e^{-(m - m_k)^2 / 2 s_k^2}\, e^{-(c / d_k)^{p_k}}

    where `R` is the range in V. Laws of this kind, Gaussian or exponential in both directions, are the classical
    parametric densities of the Preisach literature.

    Attributes
    ----------
    weight_um
        Weight of each component, shape `(K,)`.
    bias
        Centre along the diagonal, fraction of the range, shape `(K,)`.
    spread
        Standard deviation along the diagonal, fraction of the range, shape `(K,)`.
    decay
        Decay length across the diagonal, fraction of the range, shape `(K,)`.
    shape
        Exponent of the decay: 1 is exponential, 2 is Gaussian, shape `(K,)`.
    lower_V, upper_V, levels
        The grid at whose nodes the density is taken.
    """

    family: ClassVar[str] = "mixture"
    weight_um: Float[Array, " K"] = param(unit="um", scale=10.0, lower=0.0)
    bias: Float[Array, " K"] = param(unit="1", lower=-1.0, upper=2.0)
    spread: Float[Array, " K"] = param(unit="1", scale=0.3, lower=0.02)
    decay: Float[Array, " K"] = param(unit="1", scale=0.1, lower=0.005)
    shape: Float[Array, " K"] = param(unit="1", lower=0.5, upper=4.0)
    lower_V: Float[Array, ""] = array()
    upper_V: Float[Array, ""] = array()
    levels: int = static()

    def nodes_um_per_V2(self) -> Float[Array, "N N"]:
        """Density at the nodes, shape `(N, N)`."""
        v = jnp.linspace(0.0, 1.0, self.levels).astype(self.weight_um.dtype)
        alpha, beta = jnp.meshgrid(v, v, indexing="ij")
        # On the diagonal, where the coercivity is zero, the derivative of its power need not exist.
        middle, coercivity = (alpha + beta) / 2, jnp.maximum((alpha - beta) / 2, 1e-9)

        def component(weight: Array, bias: Array, spread: Array, decay: Array, shape: Array) -> Array:
            bell = jnp.exp(-((middle - bias) ** 2) / (2 * spread**2))
            return weight * bell * jnp.exp(-((coercivity / decay) ** shape))

        each = jax.vmap(component)(self.weight_um, self.bias, self.spread, self.decay, self.shape)
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
        bias, spread, decay, shape = jax.random.split(key, 4)
        k = _COMPONENTS
        return cls(
            weight_um=jnp.full(k, 4 * stroke_um / k),
            bias=jax.random.uniform(bias, (k,), minval=0.1, maxval=0.9),
            spread=jax.random.uniform(spread, (k,), minval=0.1, maxval=0.6),
            decay=jnp.exp(jax.random.uniform(decay, (k,), minval=jnp.log(0.03), maxval=jnp.log(0.4))),
            shape=jax.random.uniform(shape, (k,), minval=0.8, maxval=2.0),
            lower_V=lower_V,
            upper_V=upper_V,
            levels=levels,
        )
