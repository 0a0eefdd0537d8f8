"""Whether runs begin where no other loop comes by: with relays beyond the range that switch once and never again."""

import numpy as np

from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit
from fits.diagnosis._score import evidence
from fits.loop._run import VIRGIN, known_samples

# Waves over the first way, evidence from which it counts, the share of that for the best effect from which it is the
# likelier reason, and the part of the range through which the voltage goes up, and down, beside it.
_WAVES, _SURE, _NEARLY, _BOTH_WAYS = 12, 5.5, 0.8, 1.0


class VirginCurveError(Exception):
    """The first ways of the runs have to be left out."""


def is_virgin(projector: Projector, highest: float, model: Refit | None = None) -> bool:
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
    model
        Causes that are known already.
    """
    columns = virgin_columns(projector)
    if columns.shape[1] == 0:
        return False
    columns = projector.off(columns)
    if model is None:
        residual = projector.off(projector.residual)
    else:
        residual, basis = model.residual, model.basis()
        columns = columns - basis @ (basis.T @ columns)
    z, _, _ = evidence(columns, residual, False)
    return z > max(_SURE, _NEARLY * highest)


def virgin_columns(projector: Projector) -> np.ndarray:
    """Signals along which the first ways may differ from later ones, joined; none where too little is beside them."""
    runs, range_V = projector.regression.baseline.runs, projector.regression.baseline.range_V
    columns: list[np.ndarray] = []
    none = [np.zeros(len(run.record)) for run in runs]
    up_V = down_V = 0.0
    for k, run in enumerate(runs):
        voltage = run.record.voltage_V
        strict = known_samples(voltage, *range_V, VIRGIN)
        moves_V = np.diff(voltage)[(run.fitted & strict)[1:]]
        up_V, down_V = up_V + float(moves_V[moves_V > 0].sum()), down_V - float(moves_V[moves_V < 0].sum())
        first = run.fitted & ~strict
        if first.any():
            gone = np.maximum.accumulate(np.abs(voltage - voltage[0]))
            share = gone / max(float(gone[first].max()), 1e-300)
            columns += [
                projector.join([*none[:k], first * np.cos(np.pi * wave * share), *none[k + 1 :]])
                for wave in range(_WAVES)
            ]
    if not columns or min(up_V, down_V) < _BOTH_WAYS * (range_V[1] - range_V[0]):
        return np.zeros((len(projector.residual), 0))
    return np.stack(columns, axis=1)
