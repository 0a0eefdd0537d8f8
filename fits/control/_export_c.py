"""A fitted model as C for a controller: the hysteresis and its exact inverse, one sample at a time."""

import os
import re
import textwrap
from collections.abc import Iterable
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from fits.control._follow import within_range
from fits.io._errors import DataError
from fits.io._file_set import file_set
from fits.io._version import written_by
from fits.loop._plain import PlainLoop

TEMPLATES = Path(__file__).with_name("templates")


def export_c(
    model: Any,
    folder: str | os.PathLike[str],
    name: str = "compensator",
    *,
    size: int = 128,
    limits_V: tuple[float, float] | None = None,
) -> list[Path]:
    """Write a header and a source in C99 that do what `model` and `microid.invert` do, sample by sample.

    The model is a `Preisach`; or a `Stage`, of which it is what slow commands see, a fit or a model file of one, or
    the name of such a file. The C needs no library, allocates nothing, loops a bounded number of times and computes
    in double precision. It holds `8 ((N + 1)**2 + 8 (N - 1))` bytes of constants for `N` levels; a state takes 16
    bytes per extreme. The paths of `name.h` and `name.c` come back; the folder is made if need be, and the name
    stands before every name.

    The size is the extremes that a state remembers, two per nested loop. Where more are needed the smallest swing is
    dropped and the status says so: outputs are then off by no more than that swing until a wider loop wipes it out.
    Limits are the lowest and highest voltage that the inverse may give; the range of the model by default.

    A `DataError` says that the name is not one in C, the size is too small, the limits are not in the model's range,
    or a file cannot be written.
    """
    require_name(name)
    return write_texts(folder, controller_texts(model, name, size, limits_V))


def require_name(name: str) -> None:
    """Refuse what cannot begin names in C."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,30}", name):
        raise DataError(
            f"name: expected a letter and then up to 30 letters, digits or underscores, found '{name}'; rename it."
        )


def controller_texts(model: Any, name: str, size: int, limits_V: tuple[float, float] | None = None) -> dict[str, str]:
    """What `export_c` writes, by the names of the files."""
    if not 8 <= size <= 65_536:
        raise DataError(f"memory: expected 8 to 65536 extremes, found {size}; 128 suit most references.")
    if not isinstance(model, PlainLoop):
        # With JAX, which a model in NumPy does without.
        from fits.control._compensate import plain_loop_of, static_equivalent
        from fits.stage._model_file import model_given

        model = plain_loop_of(static_equivalent(model_given(model)[0]))
    fields = _fields(model, name, size, within_range(model.range_V, limits_V))
    return {f"{name}.{ending}": filled(f"controller.{ending}", fields) for ending in ("h", "c")}


def filled(template: str, fields: dict[str, str]) -> str:
    """Fill the blanks of a template in C."""
    return Template((TEMPLATES / template).read_text(encoding="utf-8")).substitute(fields)


def write_texts(folder: str | os.PathLike[str], texts: dict[str, str]) -> list[Path]:
    """Write texts into a folder, all or none; their paths come back."""
    with file_set() as files:
        place = files.folder(folder)
        for file, text in texts.items():
            (place / file).write_bytes(text.encode())
    return [Path(folder) / file for file in texts]


def _fields(law: PlainLoop, name: str, size: int, limits_V: tuple[float, float]) -> dict[str, str]:
    surface, (lower, upper), (lowest, highest) = law.surface, law.range_V, law.reach_um
    window, branch = surface.window_um.ravel(), surface.branch_um[..., 0]
    if not np.isfinite([*window, *branch.ravel(), lower, upper, lowest]).all():
        raise DataError("the model holds numbers that are not finite, which no controller can use; fit it again.")
    n = surface.intervals
    return {
        "name": name,
        "NAME": name.upper(),
        "provenance": f"Written by {written_by()} from a model with {n + 1} levels; do not edit, export again.",
        "lower_V": repr(lower),
        "upper_V": repr(upper),
        "lowest_V": repr(limits_V[0]),
        "highest_V": repr(limits_V[1]),
        "lowest_um": repr(lowest),
        "highest_um": repr(highest),
        "rounding_um": repr(2 * float(np.finfo(float).eps) * max(abs(lowest), abs(highest))),
        "size": str(size),
        "swings": str(min(31, (size - 4) // 2)),  # at most those of a demagnetised staircase in `microid`
        "intervals": str(n),
        "per_V": repr(n / (upper - lower)),
        "window_um": lines_of(window, 4),
        "rising_um": _rows(branch[:, :n]),
        "falling_um": _rows(branch[:, n:]),
    }


def lines_of(values: Iterable[float], indent: int) -> str:
    """Write constants with as many digits as reading them back exactly takes."""
    text = ", ".join(repr(float(value)) for value in values)
    return textwrap.indent(textwrap.fill(f"{text},", 118 - indent, break_on_hyphens=False), " " * indent)


def _rows(cubics: np.ndarray) -> str:
    return "\n".join(f"        {{{', '.join(repr(float(c)) for c in cubic)}}}," for cubic in cubics.T)
