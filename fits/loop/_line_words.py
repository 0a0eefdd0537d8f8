"""Cosines and sines of lines in a spectrum, as amplitudes and phases."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from fits.stats._metrics import TWO_SIDED_95

# The part a parameter is of, whether it is a cosine, its place among the multiples of a line, and of which run it is.
_ENTRY = re.compile(r"(.*\.)(co)?sine_um(\[\d+\])?(.*)")


def amplitude(cosine: tuple[float, float], sine: tuple[float, float]) -> tuple[float, float]:
    """Amplitude of a line and the standard deviation along it, from those of its cosine and its sine.

    That of no line is the larger of the two.
    """
    size = math.hypot(cosine[0], sine[0])
    sds = cosine[1], sine[1]
    return size, math.hypot(cosine[0] * sds[0], sine[0] * sds[1]) / size if size > 0 else max(sds)


def phase_deg(cosine: float, sine: float) -> float:
    """Phase `p` of `amplitude * cos(angle - p)`, in degrees."""
    return math.degrees(math.atan2(sine, cosine))


def with_amplitudes(parameters: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Parameters of a report, with the amplitude of each line in the place of its cosine and without its sine."""
    known = {one["name"]: one for one in parameters}
    out: list[Mapping[str, Any]] = []
    for one in parameters:
        part, cosine, place, where = found.groups("") if (found := _ENTRY.fullmatch(one["name"])) else ("",) * 4
        other = known.get(f"{part}{'' if cosine else 'co'}sine_um{place}{where}")
        if not found or other is None:
            out.append(one)
        elif cosine:
            base = known.get(f"{part}frequency_Hz", {}).get("value")
            line = f"{part}amplitude {line_name(int(place.strip('[]') or 0), base)}{where}"
            pairs = [(each["value"], each["sd"]) for each in (one, other)]
            out.append({"name": line, "unit": one["unit"]} | _estimate(*pairs))
    return out


def _estimate(cosine: tuple[float | None, float | None], sine: tuple[float | None, float | None]) -> dict[str, Any]:
    """Amplitude, standard deviation and 95 % interval of a line; None for what is not known."""
    if None in (*cosine, *sine):
        return dict.fromkeys(("value", "sd", "lower", "upper"))
    size, sd = amplitude(cosine, sine)  # type: ignore[arg-type]
    return {"value": size, "sd": sd, "lower": max(size - TWO_SIDED_95 * sd, 0.0), "upper": size + TWO_SIDED_95 * sd}


def line_name(place: int, base_Hz: float | None) -> str:
    """Where a line is that stands at a place, from 0, among the multiples of a frequency."""
    return f"of line {place + 1}" if base_Hz is None else f"at {(place + 1) * base_Hz:.5g} Hz"
