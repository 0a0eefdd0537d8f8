"""One weight per pair of switching voltages: the paper's own parametrisation (Eq. 9)."""

from typing import ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from microid._param import array, param
from microid.densities._base import AbstractDensity, node_areas, register


@register
class GridDensity(AbstractDensity):
    """A density with a free, non-negative weight at each of the `N (N + 1) / 2` nodes.

    Attributes
    ----------
    packed_um
        The weights of Eq. 9 row by row (`alpha` outer, `beta <= alpha` inner), shape `(N (N + 1) / 2,)`.
    lower_V, upper_V
        Range of the switching voltages.
    """

    family: ClassVar[str] = "grid"
    packed_um: Float[Array, " p"] = param(unit="um", scale=0.1, lower=0.0)
    lower_V: Float[Array, ""] = array()
    upper_V: Float[Array, ""] = array()

    def __check_init__(self) -> None:
        """Refuse a number of weights that fills no triangle."""
        size = self.packed_um.shape[0]
        if self.levels < 2 or self.levels * (self.levels + 1) // 2 != size:
            raise ValueError(f"{size} weights fill no triangle: N levels have N (N + 1) / 2, and N is at least 2")

    @property
    def levels(self) -> int:
        """Number of switching voltages."""
        return (round((8 * self.packed_um.shape[0] + 1) ** 0.5) - 1) // 2

    def nodes_um_per_V2(self) -> Float[Array, "N N"]:
        """Density at the nodes, shape `(N, N)`."""
        n = self.levels
        areas = node_areas(n)[np.tril_indices(n)].astype(self.packed_um.dtype)
        # A gather from a list that ends in a zero is faster than a scatter.
        place = np.full((n, n), len(areas))
        place[np.tril_indices(n)] = np.arange(len(areas))
        return jnp.append(self.packed_um / areas, 0)[place] / (self.upper_V - self.lower_V) ** 2

    @classmethod
    def start(
        cls,
        lower_V: Float[Array, ""],
        upper_V: Float[Array, ""],
        levels: int,
        stroke_um: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> Self:
        """Spread the stroke evenly over the half-plane; the fit is convex, so the key is not used."""
        areas = node_areas(levels)[np.tril_indices(levels)]
        return cls(stroke_um * (areas / areas.sum()), lower_V, upper_V)
