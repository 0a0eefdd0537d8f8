"""What the commands share: models in files, and limits of the rig."""

import math
from collections.abc import Sequence

from fits.io._errors import DataError
from fits.io._limits import Ranges, allowed, parse_limits
from fits.io._record import Record
from fits.loop._uncertainty import Prediction
from fits.stage._model_file import ModelFile
from fits.stage._uncertainty import predict
from microid import Preisach, Stage


def stage_or_preisach(path: str, loaded: ModelFile) -> Preisach | Stage:
    """Return the stage or the hysteresis that a model file holds; a `DataError` where it holds neither."""
    if isinstance(loaded.model, Preisach | Stage):
        return loaded.model
    raise DataError(f"{path}: expected a Preisach model, found a {type(loaded.model).__name__}; fit one first.")


def predicted_by(path: str, loaded: ModelFile, program: Record, initial: str) -> Prediction:
    """Predict with whatever model a file holds; without an uncertainty the standard deviations are NaN."""
    model = stage_or_preisach(path, loaded)
    if loaded.uncertainty is None and isinstance(model, Preisach):
        raise DataError(f"{path}: the file lacks the uncertainty of its model; fit again.")
    return predict(model, loaded.uncertainty, program, initial)


def parse_rig_limits(
    volts: str | None, limit: Sequence[str], margin: float
) -> tuple[tuple[float, float] | None, Ranges]:
    """Read `--limits`, `--limit` and `--margin`: the range of the command in V, and what else is stated."""
    stated = parse_limits(limit)
    allowed({}, stated, margin)
    both = parse_limits_V(volts)
    if "voltage" not in stated:
        return both, stated
    if both is not None:
        raise DataError("--limit voltage: --limits states that already; leave one of them out.")
    return stated["voltage"], stated


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
