"""The second truth of `hidden`: a stage that differs from every library of models in kind, not only in numbers."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from data_synth._strength import EffectSettings

Truth: TypeAlias = Literal["first", "second"]

_PLAYS = (24, 60)
_CORRELATIONS = (0.5, 0.9)
_RMS_PER_NOISE = (0.5, 1.0)
_SPECTRA = 1000


@dataclass(frozen=True)
class Second:
    """What the second truth has in place of the first one's.

    Attributes
    ----------
    plays
        The number of play operators, whose radii and weights are at random.
    correlation
        Of the sensor's noise from one sample to the next.
    effects
        The stage's own ways: a relaxation spectrum and a gain that depends on the amplitude.
    """

    plays: int
    correlation: float
    effects: tuple[EffectSettings, ...]


def second_truth(rng: np.random.Generator) -> Second:
    """Draw the second truth: both of the stage's own ways are 0.5 to 1 times as strong as the noise."""
    plays = int(rng.integers(_PLAYS[0], _PLAYS[1] + 1))
    correlation = float(rng.uniform(*_CORRELATIONS))
    spectrum = int(rng.integers(_SPECTRA))
    relaxed, gained = rng.uniform(*_RMS_PER_NOISE, 2).tolist()
    own = (
        EffectSettings("relaxation_spectrum", {"spectrum": spectrum}, relaxed),
        EffectSettings("amplitude_dependent_gain", {}, gained),
    )
    return Second(plays, correlation, own)
