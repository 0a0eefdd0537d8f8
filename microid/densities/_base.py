"""What a Preisach density is to the rest of the package: values at the nodes of a grid."""

import abc
from typing import TYPE_CHECKING, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray


class AbstractDensity(eqx.Module):
    """A smooth, non-negative density of relays over the half-plane `alpha >= beta`.

    A family says what its density is at the nodes of `levels` evenly spaced switching voltages. In between it is
    bilinear (linear on the triangles along the diagonal), and every output computed from that is exact. To add a
    family, put one file with one final subclass into `microid/densities/`.

    Attributes
    ----------
    family
        Name of the family, that of its file.
    lower_V, upper_V
        Range of the switching voltages; outside it there are no relays.
    levels
        Number `N` of switching voltages.
    """

    family: eqx.AbstractClassVar[str]
    if TYPE_CHECKING:
        # A checker takes abstract fields for fields of a dataclass and complains of their order in every family.
        @property
        def lower_V(self) -> Float[Array, ""]: ...
        @property
        def upper_V(self) -> Float[Array, ""]: ...
        @property
        def levels(self) -> int: ...
    else:
        lower_V: eqx.AbstractVar[Float[Array, ""]]
        upper_V: eqx.AbstractVar[Float[Array, ""]]
        levels: eqx.AbstractVar[int]

    @abc.abstractmethod
    def nodes_um_per_V2(self) -> Float[Array, "N N"]:
        """Density at `(alpha_i, beta_j)`: shape `(N, N)`, zero for `j > i`."""

    @classmethod
    @abc.abstractmethod
    def start(
        cls,
        lower_V: Float[Array, ""],
        upper_V: Float[Array, ""],
        levels: int,
        stroke_um: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> Self:
        """Draw a density from which a fit can start.

        Parameters
        ----------
        lower_V, upper_V, levels
            The grid.
        stroke_um
            Displacement that all relays together should roughly account for.
        key
            Families that are fitted from several starts draw differing ones.
        """

    @property
    def levels_V(self) -> Float[Array, " N"]:
        """The switching voltages, shape `(N,)`."""
        return jnp.linspace(self.lower_V, self.upper_V, self.levels)

    @property
    def weights_um(self) -> Float[Array, "N N"]:
        """The weights of Eq. 9: displacement of the relays around `(alpha_i, beta_j)`, shape `(N, N)`.

        With relays that give 0 or 1 their sum is the irreversible stroke. Zero for `j > i`: only the
        `N (N + 1) / 2` with `j <= i` exist (erratum 15).
        """
        nodes = self.nodes_um_per_V2()
        return nodes * node_areas(self.levels).astype(nodes.dtype) * (self.upper_V - self.lower_V) ** 2

    def __call__(self, alpha_V: Float[Array, "..."], beta_V: Float[Array, "..."]) -> Float[Array, "..."]:
        """Evaluate the density, in um/V^2; zero outside the range and for `alpha < beta`."""
        dtype = self.lower_V.dtype
        alpha, beta = jnp.broadcast_arrays(jnp.asarray(alpha_V, dtype=dtype), jnp.asarray(beta_V, dtype=dtype))
        n = self.levels - 1
        scale = n / (self.upper_V - self.lower_V)
        x, y = (alpha - self.lower_V) * scale, (beta - self.lower_V) * scale
        i = jnp.clip(jnp.floor(x).astype(jnp.int32), 0, n - 1)
        j = jnp.clip(jnp.floor(y).astype(jnp.int32), 0, n - 1)
        s, t = x - i.astype(x.dtype), y - j.astype(y.dtype)
        nodes = self.nodes_um_per_V2()
        low, high, side = nodes[i, j], nodes[i + 1, j + 1], nodes[i + 1, j]
        # On a diagonal triangle the fourth corner is the one that makes the form linear.
        fourth = jnp.where(i == j, low + high - side, nodes[i, j + 1])
        value = (1 - s) * ((1 - t) * low + t * fourth) + s * ((1 - t) * side + t * high)
        inside = (beta >= self.lower_V) & (alpha <= self.upper_V) & (alpha >= beta)
        return jnp.where(inside, value, 0)


def node_areas(levels: int) -> np.ndarray:
    """Integrate the interpolating function of each node over the half-plane, in units of the range squared.

    Shape `(levels, levels)`; zero above the diagonal.
    """
    edge = np.ones(levels)
    edge[[0, -1]] = 1 / 2
    area = np.tril(edge[:, None] * edge, -1)
    # A cell on the diagonal is a triangle: a third of a half goes to each of its nodes, not a quarter of a square.
    area -= np.diag(np.full(levels - 1, 1 / 4 - 1 / 6), -1)
    inner = np.full(levels, 2 / 6 + 1 / 4)
    inner[[0, -1]] = 1 / 6
    return (area + np.diag(inner)) / (levels - 1) ** 2


FAMILIES: dict[str, type[AbstractDensity]] = {}
"""Every family of densities, by its name."""


def register(cls: type[AbstractDensity]) -> type[AbstractDensity]:
    """Enter a family under its name; used as a decorator by the file that defines it.

    Raises
    ------
    ValueError
        If the name is taken, or differs from the file's.
    """
    name: str = getattr(cls, "family", "")
    module = cls.__module__.rpartition(".")[2]
    if name != module:
        raise ValueError(f"{cls.__name__}.family is {name!r}, but its file is called {module!r}: give both one name")
    if name in FAMILIES:
        raise ValueError(f"the density family {name!r} is defined twice")
    FAMILIES[name] = cls
    return cls
