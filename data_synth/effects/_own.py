"""What a stage of the second truth does of its own accord: no effect to find, and in no library of models."""

import numpy as np

from data_synth._effect import POSITIVE, Situation, effect
from data_synth._plant import monotone_runs
from data_synth._types import FloatArray
from data_synth.effects._static import lag

TERMS = 8
"""Exponential terms of the relaxation."""


def spectrum_of(spectrum: int, shortest_s: float, longest_s: float) -> tuple[FloatArray, FloatArray]:
    """Time constants (s), one at random in each equal part of the decades, and weights that add up to one, (8,)."""
    rng = np.random.default_rng(spectrum)
    times_s = shortest_s * (longest_s / shortest_s) ** ((np.arange(TERMS) + rng.random(TERMS)) / TERMS)
    weights = rng.exponential(size=TERMS)
    return times_s, weights / weights.sum()


@effect(
    "static",
    "share",
    usual=0.005,
    limit=0.2,
    draws={"shortest_s": (2e-3, 1e-2), "longest_s": (20.0, 100.0)},
    own=True,
    between={"shortest_s": POSITIVE, "longest_s": POSITIVE},
)
def relaxation_spectrum(
    static_um: FloatArray,
    run: Situation,
    *,
    share: float,
    spectrum: int = 0,
    shortest_s: float = 5e-3,
    longest_s: float = 50.0,
) -> FloatArray:
    """Every move is followed by `share` of it in the end, in eight exponential terms of random weights.

    Their time constants lie between `shortest_s` and `longest_s`; `spectrum` is the seed of both.
    """
    late_um = np.zeros(len(static_um))
    for time_s, weight in zip(*spectrum_of(spectrum, shortest_s, longest_s), strict=True):
        late_um += weight * (lag(static_um, time_s, run.step_s) - static_um[0])
    return static_um + share * late_um


def swing_of(voltage_V: FloatArray, reach_V: float, lower_V: float, upper_V: float) -> FloatArray:
    """How far the voltage has lately moved to and fro, shape (N,): 0 for small moves, 0.5 to 1 for large ones.

    It is the range between two marks, an upper and a lower one, over `reach_V` (V). The voltage pushes the marks, and
    they come back to it as it travels, by a factor of e over a way of `reach_V`: it does not depend on the rate.
    Before the first sample the voltage came from `upper_V` to `lower_V`, and from there.
    """
    before_V = np.array([lower_V, voltage_V[0]])
    last_V, above_V, below_V = upper_V, 0.0, 0.0
    parts_V = []
    for path_V in monotone_runs(np.concatenate([before_V, voltage_V]), upper_V):
        fade = np.exp(-np.abs(path_V - last_V) / reach_V)
        # The mark that the voltage leaves behind, and the one that it comes near to or pushes.
        left_V, met_V = (below_V, above_V) if path_V[-1] > last_V else (above_V, below_V)
        behind_V = reach_V + (left_V - reach_V) * fade
        ahead_V = np.maximum((met_V + reach_V) * fade - reach_V, 0.0)
        parts_V.append(behind_V + ahead_V)
        below_V, above_V = (behind_V[-1], ahead_V[-1]) if path_V[-1] > last_V else (ahead_V[-1], behind_V[-1])
        last_V = float(path_V[-1])
    return np.concatenate(parts_V)[len(before_V) :] / reach_V


@effect(
    "static",
    "gain",
    usual=0.01,
    limit=0.3,
    draws={"reach_share": (0.1, 0.5)},
    own=True,
    between={"reach_share": POSITIVE},
)
def amplitude_dependent_gain(
    static_um: FloatArray, run: Situation, *, gain: float, reach_share: float = 0.25
) -> FloatArray:
    """Large moves have more gain than small ones: by `gain` where they are large against `reach_share` of the range.

    How large they are is `swing_of` the voltage.
    """
    lower_V, upper_V = run.rig.lower_V, run.rig.upper_V
    return static_um * (1 + gain * swing_of(run.voltage_V, reach_share * (upper_V - lower_V), lower_V, upper_V))
