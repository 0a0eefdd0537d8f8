"""What happens to the readings as they are written down."""

import numpy as np

from data_synth._effect import POSITIVE, Situation, effect
from data_synth._types import FloatArray


@effect("reading", "step_um", usual=0.1, limit=5.0, between={"step_um": POSITIVE})
def quantisation(reading_um: FloatArray, run: Situation, *, step_um: float) -> FloatArray:
    """Readings are whole multiples of `step_um` (um)."""
    return np.round(np.round(reading_um / step_um) * step_um, 9) + 0.0


@effect("reading", "height_um", usual=3.0, limit=100.0, draws={"share": (3e-4, 2e-3)})
def outliers(reading_um: FloatArray, run: Situation, *, height_um: float, share: float = 1e-3) -> FloatArray:
    """A `share` of the readings, and at least two of each run, are off by about `height_um` (um), up or down."""
    count = min(max(2, round(share * len(reading_um))), len(reading_um))
    places = run.rng.choice(len(reading_um), count, replace=False)
    signs = run.rng.choice([-1.0, 1.0], count)
    spiky_um = reading_um.copy()
    # Whole nanometres: the last digit of the reading does not give them away.
    spiky_um[places] += np.round(height_um * signs * run.rng.uniform(0.5, 1.5, count), 3)
    return np.round(spiky_um, 9) + 0.0


@effect("reading", "share", usual=0.01, limit=0.1, between={"share": (0.0, 1.0)})
def repeated_readings(reading_um: FloatArray, run: Situation, *, share: float) -> FloatArray:
    """A `share` of the samples is lost, and what was read last is written down again, to the last digit."""
    lost = run.rng.random(len(reading_um)) < share
    lost[0] = False
    return reading_um[np.maximum.accumulate(np.where(lost, 0, np.arange(len(reading_um))))]
