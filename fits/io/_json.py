"""Results as values that strict JSON can hold, and as tables of text."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any


def strict(value: Any) -> Any:
    """Turn dataclasses into tables, arrays into lists, and numbers that are not finite into None."""
    if is_dataclass(value):
        return {each.name: strict(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, Mapping):
        return {name: strict(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [strict(each) for each in value]
    if hasattr(value, "tolist"):  # of NumPy or JAX
        return strict(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def columns(rows: Sequence[Sequence[str]], side: str = "<") -> list[str]:
    """Align the cells of a table, the first of each row to the left and all others to a side, `<` or `>`."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    sides = ["<", *side * (len(widths) - 1)]
    return ["  ".join(f"{c:{s}{w}}" for c, s, w in zip(row, sides, widths, strict=True)).rstrip() for row in rows]
