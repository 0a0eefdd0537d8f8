"""What tuning gives back, and whether a loop keeps its limits."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from fits.control._tune_problem import Figures, Goal, overshoot_pct
from microid import AbstractController, ControlledRun, Margins

_Controller = TypeVar("_Controller", bound=AbstractController)
# Tuning keeps limits to a share of 2e-3.
_TOLERANCE = 3e-3
# Figures of which a report has the largest of all references.
_HIGHEST = ("error_max_um", "overshoot_pct", "command_max_V")


@dataclass(frozen=True)
class LoopReport:
    """One plant under a tuned controller; figures of several references are the worst.

    The margins are those of the linearised loop, where the hysteresis is steepest; errors are over the samples that
    count; see `Goal` for the overshoot, and `command_step_max_V` is the largest change between samples.
    """

    margins: Margins
    error_rms_um: float
    error_max_um: float
    overshoot_pct: float
    command_min_V: float
    command_max_V: float
    command_step_max_V: float


@dataclass(frozen=True)
class Tuning(Generic[_Controller]):
    """A tuned controller, stable with every plant and within all limits, and what it is worth.

    Costs are those of the controller it began with, and of this one; see `Goal`. It is converged where nothing is
    left to gain nearby: the slope of the cost is small, or balanced by limits. There is one report per plant, the
    nominal one first; gains are before and after, in their units, by their path in the controller; remarks are what
    the user should know, one sentence each.
    """

    controller: _Controller
    cost_before_um: float
    cost_after_um: float
    converged: bool
    plants: tuple[LoopReport, ...]
    gains: dict[str, tuple[np.ndarray, np.ndarray]]
    remarks: tuple[str, ...]

    @property
    def worst(self) -> LoopReport:
        """The plant with the largest error."""
        return max(self.plants, key=lambda one: one.error_rms_um)


def reports(found: Figures) -> tuple[LoopReport, ...]:
    out = []
    for k in range(found.error_um2.shape[0]):
        one = jax.tree.map(lambda leaf, k=k: leaf[k], found)
        highest = {name: float(jnp.max(getattr(one, name))) for name in _HIGHEST}
        rms, lowest = float(jnp.max(one.error_um2)) ** 0.5, float(jnp.min(one.command_min_V))
        step = float(jnp.max(one.command_step_V))
        out.append(LoopReport(one.margins, rms, command_min_V=lowest, command_step_max_V=step, **highest))
    return tuple(out)


def passed_limits(goal: Goal, every: Sequence[Margins], runs: Sequence[ControlledRun]) -> dict[str, str]:
    """Find which limits a loop is beyond in its margins by plant, or in some runs, by the option of the command."""
    gain, phase = min(float(one.gain_margin) for one in every), min(float(one.phase_margin_deg) for one in every)
    peak, overshoot = max(float(one.sensitivity_peak) for one in every), max(map(float, map(overshoot_pct, runs)))
    worst = {
        "--gain-margin": (goal.gain_margin_min, gain, "a gain margin of {} or more", ""),
        "--phase-margin": (goal.phase_margin_min_deg, phase, "a phase margin of {} degrees or more", " degrees"),
        "--peak": (goal.sensitivity_peak_max, peak, "a peak of the sensitivity of {} or less", ""),
        "--overshoot": (goal.overshoot_max_pct, overshoot, "an overshoot of {} % or less", " %"),
    }
    out = {}
    for option, (limit, found, expected, unit) in worst.items():
        if limit is None:
            continue
        # An overshoot of nothing has no share.
        share = (found + 1) / (limit + 1) if option == "--overshoot" else found / limit
        if (1 - share if "margin" in option else share - 1) > _TOLERANCE:
            out[option] = f"expected {expected.format(f'{limit:g}')}, found {found:.4g}{unit}"
    return out
