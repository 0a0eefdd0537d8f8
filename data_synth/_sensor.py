"""The displacement sensor: offset, noise, and a last digit."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from data_synth._types import FloatArray


@dataclass(frozen=True)
class Sensor:
    """What the sensor adds to the displacement.

    Attributes
    ----------
    noise_um
        Standard deviation of additive Gaussian noise, in um.
    quantum_um
        Its last digit, in um: readings are whole multiples of it. 0 for none.
    offset_um
        What it shows where the displacement is zero, in um.
    correlation
        Of the noise of neighbouring samples: 0 for white noise; otherwise it is autoregressive of order one.
    """

    noise_um: float = 0.0
    quantum_um: float = 0.0
    offset_um: float = 0.0
    correlation: float = 0.0

    def __post_init__(self) -> None:
        """Raise ValueError for a value that no sensor has."""
        for name in ("noise_um", "quantum_um"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be zero or positive, got {value}")
        if not math.isfinite(self.offset_um):
            raise ValueError(f"offset_um must be finite, got {self.offset_um}")
        if not 0 <= self.correlation < 1:
            raise ValueError(f"correlation must be zero or positive, and below 1, got {self.correlation}")

    def read(self, displacement_um: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Read displacements, shape (n,), in um. To record the noise alone, read a constant."""
        noise = rng.standard_normal(len(displacement_um))
        if self.correlation > 0:
            # The first sample is as any other: the noise has gone on since long before.
            noise[1:] *= math.sqrt(1 - self.correlation**2)
            noise = lfilter([1.0], [1.0, -self.correlation], noise)
        reading_um = displacement_um + self.offset_um + self.noise_um * noise
        if self.quantum_um == 0:
            return reading_um
        # Twelve decimals undo the rounding of the product (12.345000000000001); adding zero undoes -0.0.
        return np.round(np.round(reading_um / self.quantum_um) * self.quantum_um, 12) + 0.0
