"""What happens to the static displacement, between the hysteresis and the mechanics."""

import math
from typing import Literal

import numpy as np
from scipy.signal import fftconvolve, lfilter

from data_synth._effect import POSITIVE, Situation, effect
from data_synth._types import FloatArray


def lag(signal: FloatArray, time_constant_s: float, step_s: float) -> FloatArray:
    """A first-order low-pass of what is straight between the nodes, at rest before the first."""
    decay = math.exp(-step_s / time_constant_s)
    share = (1 - decay) * time_constant_s / step_s
    return signal[0] + lfilter([1 - share, share - decay], [1.0, -decay], signal - signal[0])


@effect(
    "static",
    "share",
    usual=0.012,
    limit=0.06,
    draws={"onset_s": (0.05, 0.2), "shortest_s": (0.1, 1.0), "ratio": (5.0, 15.0)},
    between={"onset_s": POSITIVE, "shortest_s": POSITIVE, "ratio": POSITIVE},
)
def creep(
    static_um: FloatArray,
    run: Situation,
    *,
    share: float,
    kind: Literal["log", "kelvin_voigt"] = "log",
    onset_s: float = 0.1,
    shortest_s: float = 0.3,
    ratio: float = 10.0,
) -> FloatArray:
    """Every move goes on by itself.

    - `log`: a move of 1 um at t' adds `share log10(1 + (t - t') / onset_s)` um, summed over all moves.
    - `kelvin_voigt`: two elements, each adding `share` of the move with a time constant, `shortest_s` and `ratio`
      times that.
    """
    if kind == "kelvin_voigt":
        late = [lag(static_um, tau_s, run.step_s) - static_um[0] for tau_s in (shortest_s, shortest_s * ratio)]
        return static_um + share * (late[0] + late[1])
    # A move that is spread over a step counts from the middle of it.
    moves_um = np.diff(static_um)
    age_s = (np.arange(len(moves_um)) + 0.5) * run.step_s
    crept_um = fftconvolve(moves_um, share * np.log10(1 + age_s / onset_s))[: len(moves_um)]
    return static_um + np.concatenate([[0.0], crept_um])


@effect("static", "half_gap_um", usual=0.2, limit=2.0)
def backlash(static_um: FloatArray, run: Situation, *, half_gap_um: float) -> FloatArray:
    """A hard play: what follows moves when its side of a gap of twice `half_gap_um` is reached. It starts pulled."""
    place_um = float(static_um[0]) + half_gap_um
    followed = []
    for asked_um in static_um.tolist():
        place_um = min(max(place_um, asked_um - half_gap_um), asked_um + half_gap_um)
        followed.append(place_um)
    return np.array(followed)


@effect("static", "gain_per_decade", usual=0.01, limit=0.08)
def aging(static_um: FloatArray, run: Situation, *, gain_per_decade: float) -> FloatArray:
    """The gain grows with the voltage's path so far, in all runs: `1 + gain_per_decade log10(1 + cycles)`."""
    cycle_V = 2 * (run.rig.upper_V - run.rig.lower_V)
    path_V = run.path_before_V + np.cumsum(np.abs(np.diff(run.voltage_V, prepend=run.voltage_V[0])))
    return static_um * (1 + gain_per_decade * np.log10(1 + path_V / cycle_V))


@effect(
    "static",
    "gain_per_K",
    usual=0.003,
    limit=0.03,
    draws={"time_constant_s": (5.0, 30.0), "rise_K": (2.0, 8.0)},
    between={"time_constant_s": POSITIVE},
)
def thermal_gain(
    static_um: FloatArray,
    run: Situation,
    *,
    gain_per_K: float,
    time_constant_s: float = 15.0,
    rise_K: float = 4.0,
) -> FloatArray:
    """The gain follows the temperature of the stage, `1 + gain_per_K` for each K above its mean.

    The stage lags the room's temperature by `time_constant_s` (s). Where no room is modelled it heats itself: by
    `rise_K` (K) in the end if it goes through one full loop of the voltage each second, from cold in each run.
    """
    if run.temperature_K is not None:
        warmth_K = lag(run.temperature_K, time_constant_s, run.step_s)
    else:
        cycle_V = 2 * (run.rig.upper_V - run.rig.lower_V)
        swing = np.abs(np.gradient(run.voltage_V, run.step_s)) / cycle_V
        warmth_K = lag(np.concatenate([[0.0], rise_K * swing[1:]]), time_constant_s, run.step_s)
    return static_um * (1 + gain_per_K * warmth_K)
