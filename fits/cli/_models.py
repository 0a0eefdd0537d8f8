"""What the commands share: models in files, and limits of the rig."""

import math
from collections.abc import Sequence

from fits.cli import _late as late
from fits.io._errors import DataError


def stage_or_preisach(path: str, loaded: "late.ModelFile") -> "late.Preisach | late.Stage":
    """Return the stage or the hysteresis that a model file holds; a `DataError` where it holds neither."""
    if isinstance(loaded.model, late.Preisach | late.Stage):
        return loaded.model
    raise DataError(f"{path}: expected a Preisach model, found a {type(loaded.model).__name__}; fit one first.")


def hysteresis(model: "late.Preisach | late.Stage") -> "late.Preisach":
    """The hysteresis of a model, as slow voltages see it."""
    return late.static_equivalent(model) if isinstance(model, late.Stage) else model


def predicted_by(path: str, loaded: "late.ModelFile", program: "late.Record", initial: str) -> "late.Prediction":
    """Predict with whatever model a file holds; without an uncertainty the standard deviations are NaN."""
    model = stage_or_preisach(path, loaded)
    if loaded.uncertainty is None and isinstance(model, late.Preisach):
        raise DataError(f"{path}: the file lacks the uncertainty of its model; fit again.")
    return late.predict(model, loaded.uncertainty, program, initial)


def parse_rig_limits(
    volts: str | None, limit: Sequence[str], margin: float
) -> tuple[tuple[float, float] | None, dict[str, tuple[float, float]]]:
    """Read `--limits`, `--limit` and `--margin`: the range of the command in V, and what else is stated."""
    stated = late.parse_limits(limit)
    late.allowed({}, stated, margin)
    both = parse_limits_V(volts)
    if "voltage" in stated and both is not None:
        raise DataError("--limit voltage: --limits states that already; leave one of them out.")
    return both or stated.get("voltage"), stated


def parse_limits_V(text: str | None) -> tuple[float, float] | None:
    """Read `--limits`: two voltages, or None."""
    if text is None:
        return None
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        raise DataError(
            f"--limits: expected two voltages such as 0,100, found '{text}'; write LOW,HIGH in V."
        ) from None
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise DataError(
            f"--limits: expected two finite voltages, the lower one first, found '{text}'; write LOW,HIGH in V."
        )
    return low, high
