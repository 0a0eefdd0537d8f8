"""The Preisach operator: hysteresis as a density of relays (Eq. 8-11)."""

from jaxtyping import Array, Float

from microid._everett import Everett, everett
from microid._memory import Memory, Staircase, negative_saturation, remember
from microid._param import param
from microid._part import AbstractHysteresis
from microid._reversible import Reversible
from microid.densities import AbstractDensity


class Preisach(AbstractHysteresis):
    """Displacement of a piezo stack under a voltage, with its memory.

    The relays are 0/1 and the output is `offset_um` at negative saturation; with the paper's +1/-1 relays the
    output differs by a factor of two and a constant (erratum 16). Outputs are exact for the density as it is
    interpolated between its nodes, and differentiable in its parameters and in the voltage, in forward and reverse
    mode. The voltage derivative at a sample is the one of the branch on which it was reached.

    Attributes
    ----------
    density
        Density of the relays over the half-plane.
    reversible
        Density on the diagonal: the memoryless part.
    offset_um
        Reading of the sensor at negative saturation.
    """

    density: AbstractDensity
    reversible: Reversible
    offset_um: Float[Array, ""] = param(unit="um", scale=10.0)

    def __check_init__(self) -> None:
        """Refuse parts that do not share their levels."""
        if self.density.levels != self.reversible.levels:
            raise ValueError(
                f"the density has {self.density.levels} levels and the reversible part {self.reversible.levels}: "
                "they must share them"
            )

    def __call__(self, voltage_V: Float[Array, " n"], start: Staircase | None = None) -> Float[Array, " n"]:
        """Respond to a voltage.

        Parameters
        ----------
        voltage_V
            Shape `(n,)`. Relays only exist between `lower_V` and `upper_V`, so the output saturates outside.
        start
            Memory before the first sample; negative saturation by default.

        Returns
        -------
        Array
            Displacement in um, shape `(n,)`.
        """
        if start is None:
            start = negative_saturation(self.density.lower_V)
        return self.respond(remember(voltage_V, start))

    def respond(self, memory: Memory) -> Float[Array, " n"]:
        """Respond to a voltage whose memory is already known, in um, shape `(n,)`.

        The memory depends on the voltage alone: compute it once and use it for every density.
        """
        return self.offset_um + self.everett.respond(memory)

    @property
    def weights_um(self) -> Float[Array, "N N"]:
        """The weights of Eq. 9, shape `(N, N)`; see `AbstractDensity.weights_um`."""
        return self.density.weights_um

    @property
    def everett(self) -> Everett:
        """The Everett surface, the paper's Preisach function (Eq. 10), the reversible part included."""
        d = self.density
        return everett(d.nodes_um_per_V2(), self.reversible.slope_um_per_V, d.lower_V, d.upper_V)
