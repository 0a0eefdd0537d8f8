"""The paper's error figures (Eq. 34-36)."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

# Half the width of a 95 % interval, in standard deviations.
TWO_SIDED_95 = 1.959964
# A residual whose neighbours are alike over fewer samples than this counts as white.
WHITE = 1.2
# Neighbours that are alike over more samples than this are told of; fewer are one sample in whole ones.
TOLD = 1.5
# A loop must span this fraction of the largest excursion to be measured.
_SPAN = 0.95


@dataclass(frozen=True)
class Errors:
    """Root mean square and largest absolute error of a prediction; percentages are of the measurement's range."""

    samples: int
    rms_um: float
    max_um: float
    range_um: float

    @property
    def e_rms_pct(self) -> float:
        """Root mean square error in percent of the measured range (Eq. 36)."""
        return 100 * self.rms_um / self.range_um

    @property
    def e_max_pct(self) -> float:
        """Largest error in percent of the measured range (Eq. 35)."""
        return 100 * self.max_um / self.range_um


def errors(measured_um: np.ndarray, predicted_um: np.ndarray, range_um: float | None = None) -> Errors:
    """Compare a prediction with a measurement, shape `(n,)` each, in um.

    Percentages refer to `range_um`, that of the whole run where these samples are a part of it; by default that of
    the measurement. A `ValueError` if there is nothing to compare, or the range is zero.
    """
    if range_um is None:
        range_um = float(np.ptp(measured_um)) if len(measured_um) else 0.0
    if len(measured_um) == 0 or not range_um > 0:
        raise ValueError("errors need samples, and a measurement that moves")
    off = measured_um - predicted_um
    rms, worst = float(np.sqrt(np.mean(off**2))), float(np.max(np.abs(off)))
    return Errors(len(off), rms, worst, range_um)


def loop_width_pct(voltage_V: np.ndarray, displacement_um: np.ndarray) -> float | None:
    """Width of the widest loop in percent of its height (Eq. 34), from a voltage and a displacement of shape `(n,)`.

    None where the record holds no up and down branch of the largest excursion. The paper divides by the largest
    displacement, which depends on where the sensor's zero is; here the loop's own height is meant (errata 34 and 38).
    """
    low, high = voltage_V.min(), voltage_V.max()
    span = high - low
    near_low, near_high = voltage_V <= low + (1 - _SPAN) * span / 2, voltage_V >= high - (1 - _SPAN) * span / 2
    ends = np.flatnonzero(near_low | near_high)
    at_top = near_high[ends]
    # Passages from one end of the range to the other; a loop is one and the next one back.
    passages = [(ends[k], ends[k + 1]) for k in np.flatnonzero(np.diff(at_top))]
    if len(passages) < 2:
        return None
    level = np.linspace(low + (1 - _SPAN) * span, high - (1 - _SPAN) * span, 201)
    branches = []
    for first, last in passages:
        piece = slice(first, last + 1)
        order = np.argsort(voltage_V[piece], kind="stable")
        branches.append(np.interp(level, voltage_V[piece][order], displacement_um[piece][order]))
    widths = [np.max(np.abs(one - other)) for one, other in pairwise(branches)]
    return float(100 * np.median(widths) / np.ptp(displacement_um))
