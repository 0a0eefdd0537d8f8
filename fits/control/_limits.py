"""Limits of a closed loop: which are kept, and what is said of those that are not."""

from collections.abc import Sequence

import numpy as np

from fits.control._tune_problem import Goal, NO_RANGE_um
from microid import ControlledRun, Margins

# Tuning keeps limits to a share of 2e-3.
_TOLERANCE = 3e-3


def overshoot_pct(run: ControlledRun) -> float:
    """Displacement beyond the range of the reference and the rest before it, in percent of it; see `Goal`."""
    wanted, moved = np.asarray(run.reference_um), np.asarray(run.displacement_um)
    low, high = min(wanted.min(), moved[0]), max(wanted.max(), moved[0])
    if high - low <= NO_RANGE_um:
        return 0.0
    return float(100 * max(moved.max() - high, low - moved.min(), 0.0) / (high - low))


def passed_limits(goal: Goal, every: Sequence[Margins], runs: Sequence[ControlledRun]) -> dict[str, str]:
    """Find which limits a loop is beyond, with what was expected and found, by the option of the command.

    Parameters
    ----------
    goal
        With the limits.
    every, runs
        Margins and a run of each plant.
    """
    worst = {
        "--gain-margin": min(float(one.gain_margin) for one in every),
        "--phase-margin": min(float(one.phase_margin_deg) for one in every),
        "--peak": max(float(one.sensitivity_peak) for one in every),
        "--overshoot": max(map(overshoot_pct, runs)),
    }
    words = {
        "--gain-margin": (goal.gain_margin_min, "a gain margin of {} or more", ""),
        "--phase-margin": (goal.phase_margin_min_deg, "a phase margin of {} degrees or more", " degrees"),
        "--peak": (goal.sensitivity_peak_max, "a peak of the sensitivity of {} or less", ""),
        "--overshoot": (goal.overshoot_max_pct, "an overshoot of {} % or less", " %"),
    }
    out = {}
    for option, (limit, expected, unit) in words.items():
        if limit is None:
            continue
        found = worst[option]
        if option == "--overshoot":
            beyond = (found + 1) / (limit + 1) - 1
        else:
            beyond = found / limit - 1 if option == "--peak" else 1 - found / limit
        if beyond > _TOLERANCE:
            out[option] = f"expected {expected.format(f'{limit:g}')}, found {found:.4g}{unit}"
    return out
