"""Names for the types that every module shares."""

from typing import Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
"""An array of float64. Shapes are in the docstrings: this package needs nothing but NumPy and SciPy."""

Initial: TypeAlias = Literal["negative", "positive", "demagnetised", "random"]
"""What the stage remembers when a record starts."""


class Hysteresis(Protocol):
    """An operator with memory: it is played voltages and answers with displacements."""

    def play(self, voltage_V: FloatArray) -> FloatArray:
        """Play voltages, shape (n,), in V. The memory stays for the next call.

        Returns the irreversible displacement, shape (n,), in um: zero in negative saturation.
        """
        ...

    def glide(self, voltage_V: FloatArray) -> FloatArray:
        """Play voltages, shape (n,), in V, that only rise or only fall, also from the ones before.

        The voltage is taken to move without a jump, and the displacement that is returned, shape (n,), in um, has
        none either.
        """
        ...
