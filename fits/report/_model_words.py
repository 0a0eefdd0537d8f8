"""A model file in words: its numbers with their units, and what is known of its fit."""

from collections.abc import Iterator
from math import hypot, prod
from typing import Any

from fits.io._errors import DataError
from fits.loop._line_words import line_name, phase_deg, with_amplitudes
from fits.loop._report_words import describe, parameter_lines

# Numbers that are listed; of more, the range is.
_FEW = 8


def model_numbers(part: Any, path: str = "") -> Iterator[dict[str, Any]]:
    """Every field that holds numbers: its path, shape and unit, its value, or the range of many and a few of them."""
    if isinstance(part, dict) and "unit" in part:
        shape, value = [], part.get("value")
        while isinstance(value, list):
            shape.append(len(value))
            value = value[0] if value else None
        many = _flat(part.get("value")) if shape else []
        one: dict[str, Any] = {"lowest": min(many), "highest": max(many)} if many else {}
        one |= {"values": many} if 0 < len(many) <= _FEW else {}
        one |= {"value": value} if not shape and isinstance(value, int | float) and abs(value) < 1e300 else {}
        yield {"path": path, "shape": part.get("shape", shape), "unit": str(part["unit"]), **one}
    elif isinstance(part, dict) and isinstance(part.get("parts"), list) and isinstance(part.get("names"), list):
        for name, inner in zip(part["names"], part["parts"], strict=False):
            yield from model_numbers(inner, f"{path}.{name}".lstrip("."))
    elif isinstance(part, dict | list):
        for name, inner in part.items() if isinstance(part, dict) else enumerate(part):
            step = f"{path}.{name}".lstrip(".") if isinstance(part, dict) else f"{path}[{name}]"
            yield from model_numbers(inner, step)


def _flat(value: Any) -> list[float]:
    """The numbers of an array; none where it holds anything else, or what has no finite size."""
    if isinstance(value, list):
        parts = [_flat(one) for one in value]
        return [one for part in parts for one in part] if all(parts) else []
    return [value] if isinstance(value, int | float) and abs(value) < 1e300 else []


def model_kind(path: str, held: dict[str, Any]) -> str:
    """The class of a model that `read_model_text` reads; a `DataError` where there is none."""
    if not isinstance(held["model"], dict) or not isinstance(held["model"].get("type"), str):
        raise DataError(f"{path}: expected a model; write the file again with 'microid fit'.")
    return str(held["model"]["type"])


def model_words(path: str, held: dict[str, Any]) -> str:
    """Put what `read_model_text` reads into words; a `DataError` where the report is not that of a fit."""
    lines = [f"{model_kind(path, held)}, written by {held['written_by']}"]
    rows = list(_shown(list(model_numbers(held["model"]))))
    width = max((len(name) for name, _ in rows), default=0)
    lines += [f"  {name:{width}}  {shown}".rstrip() for name, shown in rows]
    return "\n".join([*lines, "", _known_of_fit(path, held)])


def _shown(numbers: list[dict[str, Any]]) -> Iterator[tuple[str, str]]:
    """Names and values of what `model_numbers` gives; of lines amplitudes and phases, for cosines and sines."""
    known = {row["path"]: row for row in numbers}
    for row in numbers:
        part, _, name = row["path"].rpartition(".")
        other = known.get(f"{part}.{'sine_um' if name == 'cosine_um' else 'cosine_um'}", {})
        if (
            name in ("cosine_um", "sine_um")
            and "values" in row
            and len(other.get("values", ())) == len(row["values"])
        ):
            base_Hz = known.get(f"{part}.frequency_Hz", {}).get("value")
            pairs = zip(row["values"], other["values"], strict=True) if name == "cosine_um" else ()
            for place, (cosine, sine) in enumerate(pairs):
                turned = f", phase {phase_deg(cosine, sine):.0f} degrees" if cosine or sine else ""
                yield f"{part} {line_name(place, base_Hz)}", f"{hypot(cosine, sine):.6g} {row['unit']}{turned}"
        else:
            yield row["path"], _in_words(row)


def _in_words(row: dict[str, Any]) -> str:
    unit = "" if row["unit"] == "1" else row["unit"]
    size = "x".join(map(str, row["shape"])) if prod(row["shape"]) else "no"
    if "value" in row:
        return f"{row['value']:.6g} {unit}"
    if "lowest" in row:
        return f"{size} numbers from {row['lowest']:.4g} to {row['highest']:.4g} {unit}"
    return f"{size} numbers {unit and f'in {unit}'}"


def _known_of_fit(path: str, held: dict[str, Any]) -> str:
    diagnosed = held["fit"].get("part_of") == "diagnosis"
    if held["uncertainty"] is None and not diagnosed:
        return "saved without the uncertainty of a fit, so how well it predicts is not known"
    try:
        if diagnosed:
            rows = parameter_lines(with_amplitudes(held["fit"].get("parameters", ())))
            seen = f" from {', '.join(held['fit']['sources'])}" if held["fit"].get("sources") else ""
            return "\n".join([f"written by 'microid diagnose'{seen}, whose report says how well it predicts", *rows])
        return f"{_fitted_to(held['fit']['runs'])}\n\n{describe(held['fit'])}"
    except (LookupError, TypeError, ValueError, AttributeError):
        # The format does not say what a report holds, and the words are made for that of a fit.
        raise DataError(f"{path}: its report is not that of a fit; fit again, or add --json to see it.") from None


def _fitted_to(runs: list[dict[str, Any]]) -> str:
    """Which runs the model is of, and which were only predicted."""
    fitted = [run["source"] or "a run without a name" for run in runs if run["in_sample"]]
    aside = [run["source"] or "a run without a name" for run in runs if not run["in_sample"]]
    only = f"; {', '.join(aside)} only predicted" if aside else ""
    return f"fitted to {', '.join(fitted)}{only}"
