"""What happens to the command before the driver, and in it."""

import math

import numpy as np

from data_synth._effect import POSITIVE, Situation, TimeConstant, effect
from data_synth._types import FloatArray


@effect("command", "rate_V_per_s", usual=3e4, limit=1.5e3, between={"rate_V_per_s": POSITIVE})
def slew_limit(command_V: FloatArray, run: Situation, *, rate_V_per_s: float) -> FloatArray:
    """The amplifier's output goes no faster than `rate_V_per_s` (V/s): a hard limit, and it catches up later."""
    most_V = rate_V_per_s * run.step_s
    if np.abs(np.diff(command_V)).max(initial=0.0) <= most_V:
        return command_V
    now_V = float(command_V[0])
    limited_V = []
    for asked_V in command_V.tolist():
        now_V = min(max(asked_V, now_V - most_V), now_V + most_V)
        limited_V.append(now_V)
    return np.array(limited_V)


@effect("command", "missing_share", usual=0.01, limit=0.1)
def driver_saturation(command_V: FloatArray, run: Situation, *, missing_share: float) -> FloatArray:
    """The amplifier clips hard at a rail that lies `missing_share` of the range below its upper end."""
    rail_V = run.rig.upper_V - missing_share * (run.rig.upper_V - run.rig.lower_V)
    return np.minimum(command_V, rail_V)


def _at(time_constant_s: TimeConstant, voltage_V: float, ahead_V: float) -> float:
    return time_constant_s(voltage_V, ahead_V) if callable(time_constant_s) else time_constant_s


@effect("driver", "change_share", usual=0.3, limit=0.8, needs="driver")
def voltage_dependent_capacitance(
    time_constant_s: TimeConstant, run: Situation, *, change_share: float
) -> TimeConstant:
    """The time constant is `1 + change_share x` of the plant's, x from -1 at the lower voltage to 1 at the upper."""
    middle_V = (run.rig.lower_V + run.rig.upper_V) / 2
    half_V = (run.rig.upper_V - run.rig.lower_V) / 2

    def tau_s(voltage_V: float, ahead_V: float) -> float:
        return _at(time_constant_s, voltage_V, ahead_V) * (1 + change_share * (voltage_V - middle_V) / half_V)

    return tau_s


@effect("driver", "slower_share", usual=0.1, limit=0.8, needs="driver", between={"slower_share": (-1.0, 1.0)})
def driver_asymmetry(time_constant_s: TimeConstant, run: Situation, *, slower_share: float) -> TimeConstant:
    """The time constant is `1 + slower_share` of the plant's while the voltage rises, `1 - slower_share` else."""

    def tau_s(voltage_V: float, ahead_V: float) -> float:
        return _at(time_constant_s, voltage_V, ahead_V) * (1 + math.copysign(slower_share, ahead_V))

    return tau_s
