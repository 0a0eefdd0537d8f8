"""What moves the stage, or what the sensor stands on, whatever the command."""

import math
from typing import Literal

import numpy as np
from scipy.signal import lfilter

from data_synth._effect import POSITIVE, Situation, effect
from data_synth._types import FloatArray
from data_synth.effects._static import lag


@effect(
    "environment",
    "drift_um",
    usual=0.3,
    limit=6.0,
    draws={"time_constant_s": (5.0, 60.0)},
    between={"time_constant_s": POSITIVE},
)
def thermal_drift(
    displacement_um: FloatArray,
    run: Situation,
    *,
    drift_um: float,
    time_constant_s: float = 20.0,
    kind: Literal["room", "linear", "exponential"] = "room",
) -> FloatArray:
    """The reading drifts with the warmth of the stage, and is set to zero at the start of each run.

    - `room`: by `drift_um` (um) for each K of the room's temperature, lagged by `time_constant_s` (s). Where no
      room is modelled it is `linear`.
    - `linear`: by `drift_um` (um) each minute.
    - `exponential`: as `linear` at first, and then slower with `time_constant_s` (s), counted from the first run.
    """
    if kind == "room" and run.temperature_K is not None:
        warmth = lag(run.temperature_K, time_constant_s, run.step_s)
        return displacement_um + drift_um * (warmth - warmth[0])
    if kind == "exponential":
        decay = np.exp(-(run.start_s + run.time_s) / time_constant_s)
        return displacement_um + drift_um * (time_constant_s / 60) * (decay[0] - decay)
    return displacement_um + drift_um * run.time_s / 60


@effect(
    "environment",
    "settling_um",
    usual=0.3,
    limit=5.0,
    draws={"time_constant_s": (10.0, 100.0)},
    between={"time_constant_s": POSITIVE},
)
def mount_relaxation(
    displacement_um: FloatArray,
    run: Situation,
    *,
    settling_um: float,
    time_constant_s: float = 30.0,
    kind: Literal["exponential", "log"] = "exponential",
) -> FloatArray:
    """The sensor's mount settles since the first run began, by `settling_um` (um) in all or per decade of time.

    The reading is set to zero at the start of each run.
    """
    age = (run.start_s + run.time_s) / time_constant_s
    settled = -np.expm1(-age) if kind == "exponential" else np.log10(1 + age)
    return displacement_um + settling_um * (settled - settled[0])


@effect("environment", "share", usual=0.005, limit=0.05, needs="other_axis")
def cross_coupling(displacement_um: FloatArray, run: Situation, *, share: float) -> FloatArray:
    """A second axis takes the stage along by `share` of its own displacement, the column `other_um`."""
    assert run.other_um is not None
    return displacement_um + share * run.other_um


@effect(
    "environment",
    "amplitude_um",
    usual=0.05,
    limit=2.0,
    draws={"frequency_Hz": (6.0, 38.0), "quality": (5.0, 50.0)},
    between={"frequency_Hz": POSITIVE, "quality": POSITIVE},
)
def floor_vibration(
    displacement_um: FloatArray,
    run: Situation,
    *,
    amplitude_um: float,
    frequency_Hz: float = 20.0,
    quality: float = 20.0,
) -> FloatArray:
    """The floor shakes in a narrow band about `frequency_Hz` (Hz), with `amplitude_um` (um) rms."""
    radius = math.exp(-math.pi * frequency_Hz / quality * run.step_s)
    turn_rad = 2 * math.pi * frequency_Hz * run.step_s
    # One complex pole: white noise in, an amplitude and phase that wander at the rate of the bandwidth out.
    kicks = run.rng.standard_normal((2, len(run.time_s))) * math.sqrt(1 - radius**2)
    start = run.rng.standard_normal(2)
    pole = radius * complex(math.cos(turn_rad), math.sin(turn_rad))
    swing, _ = lfilter([1.0], [1.0, -pole], kicks[0] + 1j * kicks[1], zi=[pole * complex(*start)])
    return displacement_um + amplitude_um * swing.real


@effect(
    "environment",
    "height_um",
    usual=1.0,
    limit=20.0,
    draws={"frequency_share": (0.3, 0.7), "damping_ratio": (0.01, 0.05)},
    outside=True,
    between={"frequency_share": POSITIVE, "damping_ratio": POSITIVE},
)
def burst_disturbance(
    displacement_um: FloatArray,
    run: Situation,
    *,
    height_um: float,
    frequency_share: float = 0.5,
    damping_ratio: float = 0.02,
    bursts: int = 8,
) -> FloatArray:
    """At random instants something knocks: oscillations that decay, from about `height_um` (um).

    Their frequency is `frequency_share` of a fifth of the sampling rate: each run sees it.
    """
    rate_rad_per_s = 2 * math.pi * frequency_share * run.sample_rate_Hz / 5
    knocked_um = displacement_um.copy()
    for instant_s, height in zip(
        run.rng.uniform(0, run.duration_s, bursts), run.rng.standard_normal(bursts), strict=True
    ):
        first = int(np.searchsorted(run.time_s, instant_s))
        phase = rate_rad_per_s * (run.time_s[first:] - instant_s)
        knocked_um[first:] += height_um * height * np.exp(-damping_ratio * phase) * np.sin(phase)
    return knocked_um
