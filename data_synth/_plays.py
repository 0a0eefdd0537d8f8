"""Hysteresis as an explicit sum of play (backlash) operators: the Prandtl-Ishlinskii model."""

from dataclasses import dataclass

import numpy as np

from data_synth._types import FloatArray


@dataclass(frozen=True)
class PlayShape:
    """The radii and weights of a sum of play operators.

    Attributes
    ----------
    lower_V, upper_V
        The range of the voltage, in V.
    radii_V
        Half of each operator's backlash, shape (m,), in V, below half of the range.
    weights_um_per_V
        Displacement per voltage of each operator as it moves, shape (m,), in um / V.
    """

    lower_V: float
    upper_V: float
    radii_V: tuple[float, ...]
    weights_um_per_V: tuple[float, ...]

    @property
    def stroke_um(self) -> float:
        """The displacement from `lower_V` to `upper_V`, in um: each operator loses its backlash."""
        moved_V = self.upper_V - self.lower_V - 2 * np.array(self.radii_V)
        return float(moved_V @ np.array(self.weights_um_per_V))

    @property
    def loop_gap_um(self) -> float:
        """The widest gap of the major loop, in um; for plays it is at the middle voltage."""
        radii_V = np.array(self.radii_V)
        gap_V = np.minimum(2 * radii_V, self.upper_V - self.lower_V - 2 * radii_V)
        return float(gap_V @ np.array(self.weights_um_per_V))


class PlaySum:
    """The sum of play operators, each a piston dragged by the voltage with backlash of twice its radius.

    Source: M. Brokate and J. Sprekels, Hysteresis and Phase Transitions (1996), chapter 2: the play of radius r
    follows `z[t] = max(u[t] - r, min(u[t] + r, z[t-1]))`.
    """

    def __init__(self, shape: PlayShape) -> None:
        self._radii_V = np.array(shape.radii_V)
        self._weights_um_per_V = np.array(shape.weights_um_per_V)
        self._lowest_V = shape.lower_V + self._radii_V
        self._play_V = self._lowest_V.copy()

    def play(self, voltage_V: FloatArray) -> FloatArray:
        """Play voltages, shape (n,), in V; the operators keep their states for the next call.

        Returns the sum above its value in negative saturation, shape (n,), in um.
        """
        displacement_um = np.empty(len(voltage_V))
        for sample, voltage in enumerate(voltage_V.tolist()):
            self._play_V = np.maximum(voltage - self._radii_V, np.minimum(voltage + self._radii_V, self._play_V))
            displacement_um[sample] = (self._play_V - self._lowest_V) @ self._weights_um_per_V
        return displacement_um

    def glide(self, voltage_V: FloatArray) -> FloatArray:
        """Play voltages, shape (n,), in V, that only rise or only fall, also from the ones before.

        Then each operator's state follows from its first state and the voltage now. Returns the same as `play`.
        """
        line_V = voltage_V[:, None]
        plays_V = np.maximum(line_V - self._radii_V, np.minimum(line_V + self._radii_V, self._play_V))
        self._play_V = plays_V[-1]
        return (plays_V - self._lowest_V) @ self._weights_um_per_V
