"""Which model files of stages do without JAX."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fits.loop._plain import PlainModel
from fits.loop._plain_file import ODD, array_of, fields_of, plain_loop, read_directions, read_law
from fits.stage._plain_parts import PlainPart, declared, kinds
from fits.stage._plain_stage import Directions, PlainStage

_MOST_SUBSTEPS = 1000
_STAGE = "parts", "names", "hold", "substeps", "frozen"
_UNCERTAINTY = "coordinates", "columns_um", "mean_um", "discrepancy_um", "grid"


def plain_model(content: Mapping[str, Any]) -> PlainModel | None:
    """The hysteresis or the stage of a model file, as `read_model_text` gives it.

    None where JAX is to take it, and to say what is wrong with it: a stage where it is not made of drivers, one
    Preisach operator on a grid, mechanics and sensors, under a command in lines or steps, and where anything is odd.
    """
    try:
        return _stage(content) if content["model"]["type"] == "Stage" else plain_loop(content)
    except ODD:
        return None


def _stage(content: Mapping[str, Any]) -> PlainStage | None:
    """A `PlainStage`; None, or one of the exceptions `ODD`, where it is another."""
    items, names, hold, substeps, frozen = fields_of(content["model"], "Stage", *_STAGE)
    (place,) = (k for k, item in enumerate(items) if item["type"] == "Preisach")
    parts = tuple(_part(item) for item in (*items[:place], *items[place + 1 :]))
    stage = PlainStage(parts, read_law(items[place]), hold, substeps, report=content["fit"])
    others = [*names[:place], *names[place + 1 :]]
    fields = {f"{name}.{field}" for name, part in zip(others, parts, strict=True) for field in part.fields}
    gains = [part.system().gain.real for part in parts]
    if not (
        all(part.ahead == (k < place) for k, part in enumerate(parts))
        and len({*names}) == len(names)
        and all(0 < gain < np.inf for gain in gains)
        and hold in ("first", "zero")
        and type(substeps) is int
        and 1 <= substeps <= _MOST_SUBSTEPS
        and {*frozen} <= {*names, *fields}
    ):
        return None
    known, free = content["uncertainty"], _free(others, parts, frozen)
    return stage if known is None else replace(stage, uncertainty=_directions(known, parts, free))


def _part(item: Mapping[str, Any]) -> PlainPart:
    if item["type"] not in kinds():
        raise ValueError("another part")
    fields = declared()[item["type"]]
    values = zip(fields.items(), fields_of(item, item["type"], *fields), strict=True)
    return PlainPart(
        item["type"], {name: float(array_of(value, 0, said.unit, said.lower)) for (name, said), value in values}
    )


def _free(names: Sequence[str], parts: Sequence[PlainPart], frozen: Sequence[str]) -> tuple[tuple[int, str], ...]:
    """Parameters that a fit has moved, in the order of its coordinates; see `fits.stage._moments.offsets_out`."""
    return tuple(
        (place, field)
        for place, (name, part) in enumerate(zip(names, parts, strict=True))
        for field in part.fields
        if not {name, f"{name}.{field}"} & {*frozen} and not field.endswith("offset_um")
    )


def _directions(item: Mapping[str, Any], parts: Sequence[PlainPart], free: tuple[tuple[int, str], ...]) -> Directions:
    coordinates, columns, mean, discrepancy, grid = fields_of(item, "StageUncertainty", *_UNCERTAINTY)
    coordinates, columns_um = array_of(coordinates, 2, packed=True), array_of(columns, 2, packed=True)
    mean_um = array_of(mean, 1, packed=True)
    if not len(mean_um) == len(columns_um) == len(coordinates) > 0 or coordinates.shape[1] != len(free):
        raise ValueError("another shape")
    if not all(parts[place].fields[name].inside(parts[place].values[name].real) for place, name in free):
        raise ValueError("on a bound")
    moved = read_directions(columns_um, grid)
    return Directions(free, coordinates, *moved, mean_um, float(array_of(discrepancy, 0)))
