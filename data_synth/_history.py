"""What is played before a record starts, so that the stage remembers what the scenario says."""

import numpy as np

from data_synth._types import FloatArray, Initial

_DECAY_TURNS = 120


def initial_history(initial: Initial, lower_V: float, upper_V: float, rng: np.random.Generator) -> FloatArray:
    """Turning points of the voltage before the record, shape (k,), in V; the record starts where they end.

    Every history begins with a full sweep, which wipes out whatever was played earlier. Nothing else is needed:
    hysteresis without creep remembers turning points only.

    - `negative`: ends at `lower_V`, the lower end of the major loop.
    - `positive`: ends at `upper_V`, its upper end.
    - `demagnetised`: the voltage alternates about the middle and decays to it in 120 turns.
    - `random`: between 5 and 30 random voltages. It never reaches a CSV: a record can start in a state unknown to
      its reader.

    Source: I. Mayergoyz, Mathematical Models of Hysteresis (1991), chapter 1 (wiping-out property).
    """
    sweep_V = [lower_V, upper_V]
    if initial == "negative":
        history_V = [*sweep_V, lower_V]
    elif initial == "positive":
        history_V = sweep_V
    elif initial == "demagnetised":
        middle_V, half_V = (lower_V + upper_V) / 2, (upper_V - lower_V) / 2
        turns = np.arange(_DECAY_TURNS + 1)
        decay_V = middle_V + half_V * (1 - turns / _DECAY_TURNS) * (-1.0) ** turns
        history_V = [lower_V, *decay_V.tolist()]
    else:
        history_V = [*sweep_V, *rng.uniform(lower_V, upper_V, int(rng.integers(5, 31))).tolist()]
    return np.array(history_V)
