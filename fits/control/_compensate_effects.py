"""The inverse of a stage with effects, by the inverse of the same stage without them."""

from collections.abc import Callable

import numpy as np

from fits.io._errors import DataError
from fits.io._record import Record, Reference
from microid import AbstractEffect, Stage, innermost

# Rounds: each leaves of the error about what an effect changes in the slope, a few percent.
_ROUNDS = 12
_DONE = 1e-9


def has_effects(stage: Stage) -> bool:
    """Whether a stage holds effects of `microid.EFFECTS`."""
    return any(isinstance(part, AbstractEffect) for part in stage.parts)


def plain_of(stage: Stage) -> Stage:
    """The same stage without effects."""
    if not has_effects(stage):
        return stage
    parts = {
        name: innermost(part)
        for name, part in zip(stage.names, stage.parts, strict=True)
        if not isinstance(part, AbstractEffect) or hasattr(part, "inner")
    }
    return Stage(tuple(parts.values()), tuple(parts), stage.hold, stage.substeps)


def follow(
    stage: Stage,
    reference: Reference | Record,
    inverse: Callable[[Reference], np.ndarray],
    response: Callable[[Stage, np.ndarray], np.ndarray],
) -> np.ndarray:
    """Find the voltage under which a stage with effects follows a reference, shape `(n,)`, in V.

    `inverse` gives the voltage by which the plain stage follows another reference, `response` the displacement of a
    stage under a voltage. A `DataError` refuses an effect that needs a column, as a temperature is.
    """
    needs = sorted({name for part in stage.parts if isinstance(part, AbstractEffect) for name in part.needs})
    if needs:
        raise DataError(
            f"the model depends on {', '.join(needs)}, which a reference does not tell; use baseline.json.",
            of_model=True,
        )
    wanted = np.asarray(reference.displacement_um)
    plain, asked = plain_of(stage), wanted
    voltage, before = np.zeros_like(wanted), np.inf
    for _ in range(_ROUNDS):
        voltage = inverse(Reference(reference.time_s, asked, reference.source))
        change = response(stage, voltage) - response(plain, voltage)
        moved = float(np.max(np.abs(wanted - change - asked)))
        if moved <= _DONE * float(np.ptp(wanted)) or moved > 0.9 * before:
            break
        asked, before = wanted - change, moved
    return voltage
