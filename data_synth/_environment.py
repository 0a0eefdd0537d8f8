"""What is around the stage, and may be measured with it: the room's temperature and a second axis."""

import math
from dataclasses import dataclass

import numpy as np

from data_synth._types import FloatArray

_MEAN_C = 22.0
_LINES = 4
_MOVES = 12


@dataclass(frozen=True)
class TemperatureSettings:
    """The table `[temperature]`: a room whose temperature wanders, whether or not the stage minds.

    Attributes
    ----------
    column
        Whether the CSV has a column `temperature_C`.
    wander_K
        Root mean square of the wandering, in K.
    noise_K
        Standard deviation of the thermometer's noise, in K.
    """

    column: bool = True
    wander_K: float = 0.5
    noise_K: float = 0.002

    def __post_init__(self) -> None:
        """Raise ValueError for a room that cannot be."""
        for name in ("wander_K", "noise_K"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must be zero or positive, got {getattr(self, name)}")

    def draw(self, rng: np.random.Generator) -> "Room":
        """Draw how the temperature wanders: slow lines with periods of 20 to 400 s."""
        periods_s = np.exp(rng.uniform(math.log(20), math.log(400), _LINES))
        # Slow lines are the stronger ones.
        heights = periods_s ** rng.uniform(0.3, 0.8)
        heights_K = heights * self.wander_K * math.sqrt(2) / np.sqrt(np.sum(heights**2))
        return Room(self, periods_s, heights_K, rng.uniform(0, 2 * math.pi, _LINES))


@dataclass(frozen=True, eq=False)
class Room:
    """A room as it is: the lines of its temperature."""

    settings: TemperatureSettings
    periods_s: FloatArray
    heights_K: FloatArray
    phases_rad: FloatArray

    def above_mean_K(self, clock_s: FloatArray) -> FloatArray:
        """Temperature above its mean, shape (n,), in K, at times (s) since the first run began."""
        above_K = np.zeros(len(clock_s))
        for period_s, height_K, phase_rad in zip(self.periods_s, self.heights_K, self.phases_rad, strict=True):
            above_K += height_K * np.sin(2 * math.pi * clock_s / period_s + phase_rad)
        return above_K

    def read_C(self, clock_s: FloatArray, rng: np.random.Generator) -> FloatArray:
        """What the thermometer shows, shape (n,), in degrees Celsius, to the millikelvin."""
        noise_K = self.settings.noise_K * rng.standard_normal(len(clock_s))
        return np.round(_MEAN_C + self.above_mean_K(clock_s) + noise_K, 3)


@dataclass(frozen=True)
class OtherAxisSettings:
    """The table `[other_axis]`: a second axis that goes its own ways, whether or not the stage minds.

    Attributes
    ----------
    column
        Whether the CSV has a column `other_um`.
    stroke_um
        The range of its displacement, in um.
    noise_um
        Standard deviation of its sensor's noise, in um.
    """

    column: bool = True
    stroke_um: float = 30.0
    noise_um: float = 0.03

    def __post_init__(self) -> None:
        """Raise ValueError for an axis that cannot be."""
        for name in ("stroke_um", "noise_um"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must be zero or positive, got {getattr(self, name)}")

    def displacement_um(self, time_s: FloatArray, duration_s: float, rng: np.random.Generator) -> FloatArray:
        """Smooth moves between random places with rests between, at times (s) of a run, shape (n,), in um."""
        bounds_s = np.sort(rng.uniform(0, duration_s, 2 * _MOVES)).reshape(_MOVES, 2)
        places_um = rng.uniform(0, self.stroke_um, _MOVES + 1)
        displacement_um = np.full(len(time_s), places_um[0])
        for (from_s, to_s), way_um in zip(bounds_s, np.diff(places_um), strict=True):
            x = np.clip((time_s - from_s) / (to_s - from_s), 0, 1)
            displacement_um += way_um * x**2 * (3 - 2 * x)
        return displacement_um

    def read_um(self, displacement_um: FloatArray, rng: np.random.Generator) -> FloatArray:
        """What its sensor shows, shape (n,), in um."""
        return np.round(displacement_um + self.noise_um * rng.standard_normal(len(displacement_um)), 5)
