"""The command `microid info`: its options, and the work."""

from collections.abc import Iterator
from math import prod
from typing import Any

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.cli import _options as options
from fits.io._errors import DataError


@click.command()
@options.model
@options.json_output
@common.in_sentences
def info(given: common.Given) -> None:
    """Say what a model file holds."""
    held = late.read_model_text(given.model)
    if not isinstance(held["model"], dict) or not isinstance(held["model"].get("type"), str):
        raise DataError(f"{given.model}: expected a model; write the file again with 'microid fit'.")
    kind, numbers = held["model"]["type"], list(_numbers(held["model"]))
    lines = [f"{kind}, written by {held['written_by']}"]
    for row in numbers:
        unit = "" if row["unit"] == "1" else row["unit"]
        size = "x".join(map(str, row["shape"])) if prod(row["shape"]) else "no"
        shown = f"{row['value']:.6g} {unit}" if "value" in row else f"{size} numbers {unit and f'in {unit}'}"
        lines.append(f"  {row['path']:34} {shown}".rstrip())
    if not given.as_json:
        lines += ["", _known_of_fit(given.model, held)]
    common.print_result(
        given, {"written_by": held["written_by"], "model": kind, "parameters": numbers, "fit": held["fit"]}, lines
    )


def _numbers(part: Any, path: str = "") -> Iterator[dict[str, Any]]:
    """Every field that holds numbers: its path, shape and unit, and the value of a single one."""
    if isinstance(part, dict) and "unit" in part:
        shape, value = [], part.get("value")
        while isinstance(value, list):
            shape.append(len(value))
            value = value[0] if value else None
        one = {"value": value} if not shape and isinstance(value, int | float) and abs(value) < 1e300 else {}
        yield {"path": path, "shape": part.get("shape", shape), "unit": str(part["unit"]), **one}
    elif isinstance(part, dict) and isinstance(part.get("parts"), list) and isinstance(part.get("names"), list):
        for name, inner in zip(part["names"], part["parts"], strict=False):
            yield from _numbers(inner, f"{path}.{name}".lstrip("."))
    elif isinstance(part, dict | list):
        for name, inner in part.items() if isinstance(part, dict) else enumerate(part):
            step = f"{path}.{name}".lstrip(".") if isinstance(part, dict) else f"{path}[{name}]"
            yield from _numbers(inner, step)


def _known_of_fit(path: str, held: dict[str, Any]) -> str:
    diagnosed = held["fit"].get("part_of") == "diagnosis"
    if held["uncertainty"] is None and not diagnosed:
        return "saved without the uncertainty of a fit, so how well it predicts is not known"
    try:
        if diagnosed:
            rows = late.parameter_lines(held["fit"].get("parameters", ()))
            return "\n".join(["written by 'microid diagnose', whose report says how well it predicts", *rows])
        return late.describe(held["fit"])
    except (LookupError, TypeError, ValueError, AttributeError):
        # The format does not say what a report holds, and the words are made for that of a fit.
        raise DataError(f"{path}: its report is not that of a fit; fit again, or add --json to see it.") from None
