"""Whether runs begin where no other loop comes by: with relays beyond the range that switch once and never again."""

from collections.abc import Sequence

import numpy as np

from fits._run import UNSWEPT, known_samples
from fits.diagnosis._baseline import Baseline
from fits.diagnosis._projector import Projector
from fits.diagnosis._score import evidence
from fits.diagnosis._structure import View

# Waves over the first way, evidence from which it counts, the share of that for the best effect from which it is the
# likelier reason, and the part of the range through which the voltage goes up, and down, beside it.
_WAVES, _SURE, _NEARLY, _BOTH_WAYS = 12, 5.5, 0.8, 1.0


def unswept(projector: Projector, highest: float) -> bool:
    """Whether the first ways of the runs explain about as much as anything else.

    A stage that was at rest since it was made, or demagnetised, begins on a curve of its own. What it lacks of a
    loop depends on nothing but how far the voltage has come.

    Parameters
    ----------
    projector
        Of a baseline fitted to runs whose state before is unknown, and taken for saturated where they begin at an end
        of the range.
    highest
        Evidence for the best of all effects, in standard deviations.
    """
    view = _first_ways(projector.regression.baseline)
    if view is None:
        return False
    joined = projector.off(np.stack([projector.join(column) for column in view.columns], axis=1))
    z, _, _ = evidence(joined, projector.off(projector.residual), False)
    return z > max(_SURE, _NEARLY * highest)


def _first_ways(baseline: Baseline) -> View | None:
    """Signals along which the first ways may differ from later ones, where there is enough beside them."""
    columns: list[tuple[np.ndarray, ...]] = []
    none = [np.zeros(len(run.record)) for run in baseline.runs]
    up_V = down_V = 0.0
    for k, run in enumerate(baseline.runs):
        voltage = run.record.voltage_V
        strict = known_samples(voltage, *baseline.range_V, UNSWEPT)
        moves_V = np.diff(voltage)[(run.fitted & strict)[1:]]
        up_V, down_V = up_V + float(moves_V[moves_V > 0].sum()), down_V - float(moves_V[moves_V < 0].sum())
        first = run.fitted & ~strict
        if first.any():
            gone = np.maximum.accumulate(np.abs(voltage - voltage[0]))
            share = gone / max(float(gone[first].max()), 1e-300)
            columns += [_only(none, k, first * np.cos(np.pi * wave * share)) for wave in range(_WAVES)]
    span_V = baseline.range_V[1] - baseline.range_V[0]
    if not columns or min(up_V, down_V) < _BOTH_WAYS * span_V:
        return None
    return View("first way", tuple(columns), "the first way differs from later ones")


def _only(none: Sequence[np.ndarray], k: int, values: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(values if i == k else zero for i, zero in enumerate(none))
