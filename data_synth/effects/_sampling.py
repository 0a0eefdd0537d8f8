"""What happens to the instants at which samples are taken, while the CSV says that all is even."""

import numpy as np

from data_synth._effect import Situation, effect
from data_synth._types import FloatArray


@effect("sampling", "rate_share", usual=2e-4, limit=5e-3)
def clock_mismatch(instants_s: FloatArray, run: Situation, *, rate_share: float) -> FloatArray:
    """The generator's clock runs ahead: the reading is of an instant later by `rate_share` of the time so far."""
    return instants_s * (1 + rate_share)


@effect("sampling", "lost", usual=2.0, limit=30.0, between={"lost": (0.0, 40.0)})
def dropped_samples(instants_s: FloatArray, run: Situation, *, lost: float) -> FloatArray:
    """In each run `lost` samples are lost at random, and the time stamps go on evenly.

    Every later reading is of an instant one sample later. A fraction moves the last loss towards the run's end.
    """
    period_s = 1 / run.sample_rate_Hz
    places = run.rng.uniform(0.05, 0.95, 64)
    whole = int(lost)
    places[whole] = 1 - (lost - whole) * (1 - places[whole])
    first = np.ceil(places[: whole + 1] * len(instants_s))
    sample = np.arange(len(instants_s))
    return instants_s + period_s * np.searchsorted(np.sort(first), sample, side="right")


@effect("sampling", "jitter_s", usual=1e-4, limit=2e-3)
def timestamp_jitter(instants_s: FloatArray, run: Situation, *, jitter_s: float) -> FloatArray:
    """Samples are taken early or late by `jitter_s` (s) rms, but never by as much as half of a period."""
    late_s = jitter_s * run.rng.standard_normal(len(instants_s))
    most_s = 0.49 / run.sample_rate_Hz
    return instants_s + np.clip(late_s, -most_s, most_s)
