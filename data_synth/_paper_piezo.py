"""The piezo of the paper's stage: a sum of plays with a loop as wide as the paper's, and an uneven slope."""

import functools
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from data_synth._types import FloatArray


@dataclass(frozen=True)
class PaperPiezo:
    """Elongation over voltage: a curve without memory, and play operators (Prandtl-Ishlinskii).

    The loop of a play sum is symmetric; the curve beneath it makes it the asymmetric one of the paper's Fig. 6. The
    plays' weights fall exponentially with their radii, just as fast as the width of the loop asks for.

    Attributes
    ----------
    upper_V
        Highest voltage; the lowest is zero.
    stroke_um
        Elongation at `upper_V`: 40.7 um, by erratum 38.
    loop_width
        Widest gap of the major loop over the stroke (Eq. 34).
    reversible_share
        Part of the stroke that the curve without memory makes up.
    quadratic
        Of that curve, `x + quadratic x²` over the share `x` of the range: the more negative, the steeper at first.
    plays
        Number of plays.
    """

    upper_V: float = 120.0
    stroke_um: float = 40.7
    loop_width: float = 0.1283
    reversible_share: float = 0.66
    quadratic: float = -0.286
    plays: int = 40

    @functools.cached_property
    def radii_V(self) -> FloatArray:
        """Half of each play's backlash, shape `(plays,)`; close together at small radii, for small loops."""
        return 0.49 * self.upper_V * ((np.arange(self.plays) + 0.5) / self.plays) ** 2

    @functools.cached_property
    def weights_um_per_V(self) -> FloatArray:
        """Elongation per voltage of each play as it moves, shape `(plays,)`.

        Raises
        ------
        ValueError
            If plays of this share of the stroke cannot make a loop this wide.
        """
        radii_V = self.radii_V
        cells_V, moved_V = np.gradient(radii_V), self.upper_V - 2 * radii_V
        gap_V = np.minimum(2 * radii_V, moved_V)

        def weights(fall: float) -> FloatArray:
            shape = cells_V * np.exp(-fall * radii_V / self.upper_V)
            return self.stroke_um * (1 - self.reversible_share) * shape / float(shape @ moved_V)

        def excess(fall: float) -> float:
            return float(gap_V @ weights(fall)) / self.stroke_um - self.loop_width

        if not excess(100.0) < 0 < excess(-10.0):
            raise ValueError(
                f"plays of {1 - self.reversible_share:g} of the stroke have no loop of {self.loop_width:g} of it"
            )
        return weights(float(brentq(excess, -10.0, 100.0, xtol=1e-10)))

    def rest(self, voltage_V: float) -> tuple[float, FloatArray]:
        """Elongation in um and states of the plays, shape `(plays,)`, at a voltage after a full sweep from above.

        There a loop upwards closes where it began.
        """
        _, play_V = self.glide(np.array([self.upper_V]), self.radii_V)
        rest_um, play_V = self.glide(np.array([voltage_V]), play_V)
        return float(rest_um[-1]), play_V

    def glide(self, voltage_V: FloatArray, play_V: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Follow voltages that only rise or only fall, also from the ones before.

        Parameters
        ----------
        voltage_V
            Shape `(..., n)`.
        play_V
            States of the plays before, shape `(..., plays)`.

        Returns
        -------
        tuple
            Elongations in um, shape `(..., n)`, zero at 0 V after a full sweep down, where the states are `radii_V`;
            and the states after the last.
        """
        line_V, radii_V = voltage_V[..., None], self.radii_V
        plays_V = np.minimum(np.maximum(play_V[..., None, :], line_V - radii_V), line_V + radii_V)
        share = voltage_V / self.upper_V
        curve_um = (
            self.stroke_um * self.reversible_share / (1 + self.quadratic) * share * (1 + self.quadratic * share)
        )
        return curve_um + (plays_V - radii_V) @ self.weights_um_per_V, plays_V[..., -1, :]
