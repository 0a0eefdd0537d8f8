"""What happens within the hysteresis: its past, its rate, and its answer to itself."""

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from scipy.signal import lfilter

from data_synth._effect import POSITIVE, Situation, effect
from data_synth._types import FloatArray

Operator: TypeAlias = Callable[[FloatArray], FloatArray]

_PASSES = 4
_CLOSE_UM = 5e-4


@effect("history", "depth", usual=0.5, limit=1.0)
def initial_state(history_V: FloatArray, run: Situation, *, depth: float, turns: int = 12) -> FloatArray:
    """Before the run the voltage wandered: `turns` random turning points, as far from its start as `depth` lets.

    At a depth of 1 they lie anywhere in the range. A run that starts at the lower voltage is in saturation there,
    whatever was played before: the effect is seen in runs with a `start_V` only.
    """
    start_V = float(history_V[-1])
    wandering_V = run.rng.uniform(run.rig.lower_V, run.rig.upper_V, turns)
    return np.concatenate([history_V, start_V + depth * (wandering_V - start_V), [start_V]])


@effect(
    "hysteresis",
    "lag_V",
    usual=0.2,
    limit=3.0,
    draws={"rate_V_per_s": (2.0, 20.0)},
    between={"rate_V_per_s": POSITIVE},
)
def rate_dependence(operate: Operator, run: Situation, *, lag_V: float, rate_V_per_s: float = 5.0) -> Operator:
    """Domain walls need an overvoltage `lag_V asinh(v' / rate_V_per_s)` to move as fast as the voltage v does.

    It is Eyring's law of thermally activated motion: nothing where the voltage rests, and 2.3 `lag_V` more with
    each decade of the rate.
    """

    def lagging(path_V: FloatArray) -> FloatArray:
        speed_V_per_s = np.gradient(path_V, run.step_s)
        return operate(path_V - lag_V * np.arcsinh(speed_V_per_s / rate_V_per_s))

    return lagging


@effect("hysteresis", "feedback_V_per_um", usual=0.05, limit=0.8)
def accommodation(operate: Operator, run: Situation, *, feedback_V_per_um: float) -> Operator:
    """Moving hysteresis: what has switched adds `feedback_V_per_um` to the voltage that switches.

    The operator is asked again until each sample agrees with its own answer. The answers draw together by the
    feedback times the slope of the loop, a few hundredths, with each pass; what is left is a relay or so at turns.

    Source: E. Della Torre, Magnetic Hysteresis (1999), chapter 4 (moving Preisach model).
    """

    def moving(path_V: FloatArray) -> FloatArray:
        centre_um = run.rig.stroke_um * (1 - run.rig.reversible_share) / 2
        answer_um = operate(path_V)
        for _ in range(_PASSES):
            last_um = answer_um
            effective_V = path_V + feedback_V_per_um * (last_um - centre_um)
            answer_um = operate(np.clip(effective_V, run.rig.lower_V, run.rig.upper_V))
            if np.abs(answer_um - last_um).max() < _CLOSE_UM:
                break
        return answer_um

    return moving


@effect(
    "hysteresis",
    "amplitude_um",
    usual=0.2,
    limit=10.0,
    draws={"length_V": (5.0, 40.0)},
    between={"length_V": POSITIVE},
)
def bouc_wen_hysteresis(
    operate: Operator, run: Situation, *, amplitude_um: float, length_V: float = 20.0, bend: float = 1.5
) -> Operator:
    """A part that follows a curve of the voltage behind, on a way of `length_V`, and remembers no reversal for long.

    It is Duhem's law with a curve `tanh(bend s)`, `s` going from -1 to 1 over the range: `dy/dv` is the distance from
    the curve over `length_V`, up and down. `amplitude_um` is what the curve is multiplied with. The run starts where
    it comes down from the upper end of the range.

    Source: B. D. Coleman, M. L. Hodgdon, Int. J. Eng. Sci. 24 (1986) 897.
    """

    def beside(path_V: FloatArray) -> FloatArray:
        middle_V, half_V = (run.rig.upper_V + run.rig.lower_V) / 2, (run.rig.upper_V - run.rig.lower_V) / 2
        curve = np.tanh(bend * (path_V - middle_V) / half_V)
        behind = np.empty(len(path_V))
        behind[0] = curve[0] + bend * length_V / half_V * (1 - curve[0] ** 2)
        way = np.maximum(np.abs(np.diff(path_V)) / length_V, 1e-12)
        # The curve is a line over the voltage between two steps.
        left, since = np.exp(-way), -np.expm1(-way) / way
        for k, rise in enumerate(np.diff(curve)):
            behind[k + 1] = curve[k + 1] + (behind[k] - curve[k]) * left[k] - rise * since[k]
        return operate(path_V) + amplitude_um * behind

    return beside


@effect(
    "hysteresis",
    "share",
    usual=0.05,
    limit=1.0,
    draws={"time_constant_s": (0.5, 10.0)},
    outside=True,
    between={"time_constant_s": POSITIVE},
)
def memory_loss(operate: Operator, run: Situation, *, share: float, time_constant_s: float = 3.0) -> Operator:
    """The hysteresis forgets: a `share` of it leaks away towards the middle of the loop, with a time constant (s)."""

    def fading(path_V: FloatArray) -> FloatArray:
        answer_um = operate(path_V)
        grid_V = np.linspace(run.rig.lower_V, run.rig.upper_V, 500)
        up_um, down_um = np.split(operate(np.concatenate([grid_V, grid_V[::-1]])), 2)
        remembered_um = answer_um - np.interp(path_V, grid_V, (up_um + down_um[::-1]) / 2)
        decay = math.exp(-run.step_s / time_constant_s)
        leaked_um, _ = lfilter([1 - decay], [1.0, -decay], remembered_um, zi=[decay * remembered_um[0]])
        return answer_um - share * leaked_um

    return fading
