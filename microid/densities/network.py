"""A small neural network: the paper identifies its Preisach model with one."""

from typing import ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from microid._param import array, param, static
from microid.densities._base import AbstractDensity, register


@register
class NetworkDensity(AbstractDensity):
    """A multilayer perceptron of bias and coercivity, made positive by a softplus.

    The paper trains a network to give the Preisach function; here it gives the density, so that the function is
    consistent (non-negative loops, wiping-out) whatever the weights are.

    Attributes
    ----------
    network
        Two hidden layers of `tanh`; weights are dimensionless.
    scale_um
        Displacement that the output of the network is counted in.
    lower_V, upper_V, levels
        The grid at whose nodes the density is taken.
    """

    family: ClassVar[str] = "network"
    network: eqx.nn.MLP = param(unit="1")
    scale_um: Float[Array, ""] = array()
    lower_V: Float[Array, ""] = array()
    upper_V: Float[Array, ""] = array()
    levels: int = static()

    def nodes_um_per_V2(self) -> Float[Array, "N N"]:
        """Density at the nodes, shape `(N, N)`."""
        v = jnp.linspace(-1.0, 1.0, self.levels).astype(self.scale_um.dtype)
        alpha, beta = jnp.meshgrid(v, v, indexing="ij")
        # Most of a piezo's density lies close to the diagonal: the root spreads that region out.
        inputs = jnp.stack([alpha + beta, 2 * jnp.sqrt(jnp.maximum(alpha - beta, 0) / 2) - 1], axis=-1)
        outputs = jax.vmap(jax.vmap(self.network))(inputs)
        return jnp.tril(jax.nn.softplus(outputs)) * self.scale_um / (self.upper_V - self.lower_V) ** 2

    @classmethod
    def start(
        cls,
        lower_V: Float[Array, ""],
        upper_V: Float[Array, ""],
        levels: int,
        stroke_um: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> Self:
        """Draw the weights at random."""
        network = eqx.nn.MLP(2, "scalar", width_size=8, depth=2, activation=jnp.tanh, key=key)
        return cls(network, stroke_um, lower_V, upper_V, levels)
