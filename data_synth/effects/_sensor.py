"""What the sensor and its electronics do to the displacement."""

import math

import numpy as np
from scipy.signal import lfilter

from data_synth._effect import POSITIVE, Situation, effect
from data_synth._types import FloatArray
from data_synth.effects._static import lag


@effect("sensor", "delay_s", usual=2e-4, limit=2e-2)
def transport_delay(reading_um: FloatArray, run: Situation, *, delay_s: float) -> FloatArray:
    """The reading is what the displacement was `delay_s` (s) ago."""
    return np.interp(run.time_s - delay_s, run.time_s, reading_um)


@effect("sensor", "time_constant_s", usual=2e-4, limit=2e-2, between={"time_constant_s": POSITIVE})
def sensor_lowpass(reading_um: FloatArray, run: Situation, *, time_constant_s: float) -> FloatArray:
    """The sensor's electronics are a first-order low-pass of `time_constant_s` (s)."""
    return lag(reading_um, time_constant_s, run.step_s)


@effect("sensor", "amplitude_um", usual=0.1, limit=2.0, draws={"cubic_share": (0.1, 0.9)})
def sensor_nonlinearity(
    reading_um: FloatArray, run: Situation, *, amplitude_um: float, cubic_share: float = 0.5
) -> FloatArray:
    """The scale is bent: `amplitude_um` (um) at the end of the stroke, in a cubic and, for the rest, a parabola."""
    half_um = run.rig.stroke_um / 2
    away = (reading_um - half_um) / half_um
    return reading_um + amplitude_um * ((1 - cubic_share) * away**2 + cubic_share * away**3)


@effect("sensor", "amplitude_um", usual=0.05, limit=1.0, between={"mains_Hz": POSITIVE})
def mains_hum(reading_um: FloatArray, run: Situation, *, amplitude_um: float, mains_Hz: float = 50.0) -> FloatArray:
    """Lines at the mains' frequency, which is not quite `mains_Hz` (Hz), and at twice and three times it."""
    true_Hz = mains_Hz * (1 + run.rng.uniform(-1e-3, 1e-3))
    phases = run.rng.uniform(0, 2 * math.pi, 3)
    hum = sum(
        height * np.sin(2 * math.pi * order * true_Hz * run.time_s + phase)
        for order, height, phase in zip((1, 2, 3), (1.0, 0.3, 0.4), phases, strict=True)
    )
    return reading_um + amplitude_um * hum


@effect(
    "sensor",
    "amplitude_um",
    usual=0.05,
    limit=2.0,
    draws={"period_um": (1.0, 2.5)},
    between={"period_um": POSITIVE},
)
def cyclic_error(
    reading_um: FloatArray, run: Situation, *, amplitude_um: float, period_um: float = 0.316
) -> FloatArray:
    """An interferometer's error: a sine of the position with `period_um` (um)."""
    return reading_um + amplitude_um * np.sin(2 * math.pi * reading_um / period_um)


@effect("sensor", "shift_um", usual=0.3, limit=5.0)
def zero_shift(reading_um: FloatArray, run: Situation, *, shift_um: float, jumps: int = 1) -> FloatArray:
    """Something slips: the zero of the reading jumps by `shift_um` (um) at so many random instants of a run."""
    instants_s = np.sort(run.rng.uniform(0.05, 0.95, jumps)) * run.duration_s
    return reading_um + shift_um * np.searchsorted(instants_s, run.time_s)


@effect("sensor", "gain", usual=0.01, limit=0.3, outside=True, between={"correlations": POSITIVE})
def wandering_gain(reading_um: FloatArray, run: Situation, *, gain: float, correlations: float = 10.0) -> FloatArray:
    """The sensor's gain wanders at random by `gain` rms, and forgets its value `correlations` times in a run."""
    decay = math.exp(-run.step_s * correlations / max(run.duration_s, run.step_s))
    kicks = run.rng.standard_normal(len(run.time_s)) * math.sqrt(1 - decay**2)
    wander, _ = lfilter([1.0], [1.0, -decay], kicks, zi=[decay * run.rng.standard_normal()])
    return reading_um * (1 + gain * wander)
