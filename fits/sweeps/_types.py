"""What a sweep is made of: parameters that go in, outputs that come out, and the job between them."""

import abc
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
SCHEMA = "microid.sweep/1"
PENDING, DONE, FAILED = 0, 1, 2
STATUS_WORDS = ("pending", "done", "failed")


@dataclass(frozen=True)
class Parameter:
    """Something a sweep may vary.

    Attributes
    ----------
    name
        With its unit as suffix, such as `mechanics.natural_frequency_Hz`.
    unit
        `"1"` where there is none.
    nominal
        What it is where the sweep says nothing; NaN for an array, which can only be varied relative to itself.
    lower, upper
        Bounds. A row outside fails with a reason.
    words
        Those it may be, where it is a choice: its values are places among them.
    whole
        Whether it is a whole number.
    """

    name: str
    unit: str
    nominal: float
    lower: float = -math.inf
    upper: float = math.inf
    words: tuple[str, ...] = ()
    whole: bool = False

    @property
    def range_words(self) -> str:
        """Its bounds and unit in words."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.lower:g} to {self.upper:g}{unit}"


@dataclass(frozen=True)
class Output:
    """One number, text or trace per row.

    Attributes
    ----------
    name, unit, meaning
        The name ends in the unit.
    dims
        Axes beside that of the rows, by name and length.
    dtype
        `"f8"`, `"i4"`, or a text of fixed width such as `"U80"`.
    """

    name: str
    unit: str
    meaning: str
    dims: tuple[tuple[str, int], ...] = ()
    dtype: str = "f8"

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one row."""
        return tuple(length for _, length in self.dims)

    @property
    def bytes_per_row(self) -> int:
        """On disk, before compression."""
        return int(np.dtype(self.dtype).itemsize * math.prod(self.shape))


@dataclass(frozen=True)
class Rows:
    """Some rows of a sweep, or what came of them.

    Attributes
    ----------
    outputs
        By name, shape `(n, ...)`.
    reasons
        Why a row failed, empty where it did not, `n` of them.
    """

    outputs: dict[str, NDArray[Any]]
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Facts:
    """What is known of a job before it runs.

    Attributes
    ----------
    parameters
        All that may be varied.
    outputs
        All that comes out.
    block
        Rows that one device computes together. A row's numbers may depend on its place in the block, and on nothing
        else of the rows beside it.
    sources
        Names of the rows there are by themselves, such as files; without them only the axes make rows.
    coordinates
        Values along the outputs' own axes: name to axis, unit and values.
    alone
        Whether rows go one by one, on one device whatever the number of devices.
    """

    parameters: tuple[Parameter, ...]
    outputs: tuple[Output, ...]
    block: int
    sources: tuple[str, ...] = ()
    coordinates: Mapping[str, tuple[str, str, FloatArray]] = field(default_factory=dict)
    alone: bool = False


class AbstractJob(abc.ABC):
    """What is done with each row. Rows go through in blocks of one size, the last one filled up.

    With several local devices as many blocks go through at once, one on each device.
    """

    @property
    @abc.abstractmethod
    def facts(self) -> Facts:
        """What is known before it runs."""

    @abc.abstractmethod
    def compute(
        self, values: Mapping[str, FloatArray], rows: NDArray[np.int64], sources: NDArray[np.int64], seed: int
    ) -> Rows:
        """Compute one block on each device, `n` rows in all.

        Parameters
        ----------
        values
            Swept parameters by name, in their own units, shape `(n,)`. Relative ones are factors.
        rows
            Their numbers in the sweep, shape `(n,)`; numbers of filling are repeated.
        sources
            Which of `facts.sources` each has, shape `(n,)`.
        seed
            Of the sweep.
        """
