"""Parameters that are words or whole numbers: a word goes through a sweep as its place among those that may be."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fits.io._errors import DataError, shown
from fits.machining._design import nearest
from fits.sweeps._types import FloatArray, Output, Parameter


def choice(name: str, words: Sequence[str], nominal: str) -> Parameter:
    """A parameter that is one of some words."""
    return Parameter(name, "1", float(words.index(nominal)), 0.0, len(words) - 1.0, tuple(words))


def code_of(found: Any, parameter: Parameter, place: str) -> float:
    """Place of a word among those of its parameter, or a `DataError` that begins with its place in the sweep."""
    if not isinstance(found, str) or found not in parameter.words:
        raise DataError(
            f"{place}: expected one of {', '.join(parameter.words)}, found {shown(found)}; "
            f"{nearest(str(found), parameter.words)}"
        )
    return float(parameter.words.index(found))


def check_plain(parameter: Parameter, values: FloatArray | None, relative: bool, place: str) -> None:
    """Refuse factors, draws (no values) and fractions where they make no sense."""
    if not (parameter.words or parameter.whole):
        return
    what = "a choice of words" if parameter.words else "a whole number"
    if relative:
        raise DataError(f"{place}.relative: {parameter.name} is {what}, which no factor changes; give values.")
    if values is None:
        raise DataError(f"{place}: {parameter.name} is {what}, which is not drawn; give values.")
    broken = values[values != np.round(values)]
    if len(broken):
        raise DataError(f"{place}: {parameter.name} is {what}, found {broken[0]:g}; give whole values.")


def kept_as(parameter: Parameter, relative: bool) -> Output:
    """How the values of an axis are kept: numbers in their unit, or words."""
    widest = max(map(len, parameter.words), default=0)
    dtype = f"U{widest}" if widest else "f8"
    return Output(parameter.name, "1" if relative else parameter.unit, "swept", dtype=dtype)


def spelt(parameter: Parameter, values: FloatArray) -> NDArray[Any]:
    """Values as they are kept: words for their places, numbers as they are."""
    return np.array(parameter.words)[values.astype(int)] if parameter.words else values


def chosen(values: Mapping[str, FloatArray], name: str, words: Sequence[str], nominal: str, count: int) -> list[str]:
    """The word of each row, the nominal one where it does not vary."""
    return [words[int(code)] for code in values[name]] if name in values else [nominal] * count
