"""Voltage programs: plain functions that return uniformly sampled voltages.

Every program starts at `start_V`, where the one before it ended. It returns the samples *after* that voltage, up to
and including the last one, so programs are joined by `numpy.concatenate` and no sample stands twice. Where a program
has to begin somewhere else, a ramp leads there. All functions raise ValueError, naming the argument, for a number
that makes no sense; whether the voltages suit the stage is checked by who knows the stage.

A new program is one function here and one line in `PROGRAMS`: its keyword arguments are the keys of its TOML table.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Literal

import numpy as np

from data_synth._types import FloatArray


def _require_positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0:
            raise ValueError(f"{name} must be positive, got {value}")


def _require_count(**values: int) -> None:
    for name, value in values.items():
        if not 1 <= value <= 1_000_000:
            raise ValueError(f"{name} must be 1 to 1000000, got {value}")


def _whole(samples: float) -> int:
    # No record that anyone plots or fits is longer, but a slip of the rate asks for more than the memory holds.
    if samples > 10_000_000:
        raise ValueError(
            f"the program takes {samples:.3g} samples, more than ten million: go faster or sample slower"
        )
    return round(samples)


def _require_order(lower_V: float, upper_V: float) -> None:
    if not lower_V < upper_V:
        raise ValueError(f"lower_V must be below upper_V, got {lower_V} and {upper_V}")


def ramp(start_V: float, *, to_V: float, rate_V_per_s: float, sample_rate_Hz: float) -> FloatArray:
    """Go to `to_V` (V) in equal steps that are never faster than `rate_V_per_s`.

    An infinite rate is a jump within one sample. Nothing is returned where there is no way to go.
    """
    _require_positive(rate_V_per_s=rate_V_per_s, sample_rate_Hz=sample_rate_Hz)
    if to_V == start_V:
        return np.empty(0)
    # The small number keeps 1000.0000000001 steps from becoming 1001.
    steps = _whole(np.ceil(abs(to_V - start_V) * sample_rate_Hz / rate_V_per_s - 1e-9))
    return np.linspace(start_V, to_V, max(steps, 1) + 1)[1:]


def _visit(start_V: float, turning_V: Iterable[float], rate_V_per_s: float, sample_rate_Hz: float) -> FloatArray:
    pieces = [np.empty(0)]
    for to_V in turning_V:
        pieces.append(ramp(start_V, to_V=to_V, rate_V_per_s=rate_V_per_s, sample_rate_Hz=sample_rate_Hz))
        start_V = to_V
    return np.concatenate(pieces)


def hold(start_V: float, *, duration_s: float, sample_rate_Hz: float) -> FloatArray:
    """Stay at the voltage for `duration_s` (s)."""
    _require_positive(duration_s=duration_s, sample_rate_Hz=sample_rate_Hz)
    return np.full(_whole(duration_s * sample_rate_Hz), float(start_V))


def triangle(
    start_V: float, *, lower_V: float, upper_V: float, cycles: int, rate_V_per_s: float, sample_rate_Hz: float
) -> FloatArray:
    """Play `cycles` loops from `lower_V` to `upper_V` (V) and back, at a constant rate."""
    _require_order(lower_V, upper_V)
    _require_count(cycles=cycles)
    return _visit(start_V, [lower_V, *[upper_V, lower_V] * cycles], rate_V_per_s, sample_rate_Hz)


def sine(
    start_V: float, *, lower_V: float, upper_V: float, cycles: int, frequency_Hz: float, sample_rate_Hz: float
) -> FloatArray:
    """Play `cycles` loops from `lower_V` to `upper_V` (V) and back, as a sine.

    The frequency (Hz) is lowered to the nearest one with an even number of samples a cycle, so that both extremes
    are sampled. The ramp that leads to `lower_V` has the mean rate of the sine.
    """
    _require_order(lower_V, upper_V)
    _require_count(cycles=cycles)
    _require_positive(frequency_Hz=frequency_Hz, sample_rate_Hz=sample_rate_Hz)
    samples = 2 * max(1, _whole(np.ceil(sample_rate_Hz / (2 * frequency_Hz) - 1e-9)))
    phase = 2 * np.pi * np.arange(1, samples + 1) / samples
    cycle = lower_V + (upper_V - lower_V) * (1 - np.cos(phase)) / 2
    mean_rate_V_per_s = 2 * (upper_V - lower_V) * frequency_Hz
    way = ramp(start_V, to_V=lower_V, rate_V_per_s=mean_rate_V_per_s, sample_rate_Hz=sample_rate_Hz)
    return np.concatenate([way, np.tile(np.clip(cycle, lower_V, upper_V), cycles)])


def forc(
    start_V: float,
    *,
    reversals_V: Sequence[float],
    lower_V: float,
    upper_V: float,
    rate_V_per_s: float,
    sample_rate_Hz: float,
    side: Literal["above", "below"] = "above",
) -> FloatArray:
    """Play first-order reversal curves.

    From `above`: from `upper_V`, positive saturation, down to each reversal voltage in turn and back up. From
    `below`: the mirror image, from `lower_V` up to each reversal voltage and back down. All in V.
    """
    _require_order(lower_V, upper_V)
    for reversal_V in reversals_V:
        if not lower_V <= reversal_V <= upper_V:
            raise ValueError(f"reversals_V must lie in {lower_V} to {upper_V} V, got {reversal_V}")
    saturation_V = upper_V if side == "above" else lower_V
    turning_V = [saturation_V]
    for reversal_V in reversals_V:
        turning_V += [reversal_V, saturation_V]
    return _visit(start_V, turning_V, rate_V_per_s, sample_rate_Hz)


def nested(
    start_V: float,
    *,
    biases_V: Sequence[float],
    amplitude_V: float,
    loops: int,
    rate_V_per_s: float,
    sample_rate_Hz: float,
) -> FloatArray:
    """Play loops about each bias (V), each within the last: the amplitude decays evenly from `amplitude_V`."""
    _require_count(loops=loops)
    _require_positive(amplitude_V=amplitude_V)
    turning_V: list[float] = []
    for bias_V in biases_V:
        for amplitude in amplitude_V * np.arange(loops, 0, -1) / loops:
            turning_V += [bias_V + amplitude, bias_V - amplitude]
        turning_V.append(bias_V)
    return _visit(start_V, turning_V, rate_V_per_s, sample_rate_Hz)


def random_reversals(
    start_V: float,
    *,
    lower_V: float,
    upper_V: float,
    reversals: int,
    rate_V_per_s: float,
    sample_rate_Hz: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Turn `reversals` times at random voltages between `lower_V` and `upper_V` (V).

    From each turning point the next is drawn uniformly from what lies ahead, so every one is a true reversal.
    """
    _require_order(lower_V, upper_V)
    _require_count(reversals=reversals)
    turning_V = [float(rng.uniform(lower_V, upper_V))]
    rising = turning_V[0] < start_V
    for _ in range(reversals):
        way_V = (upper_V if rising else lower_V) - turning_V[-1]
        turning_V.append(turning_V[-1] + way_V * float(rng.random()))
        rising = not rising
    return _visit(start_V, turning_V, rate_V_per_s, sample_rate_Hz)


def chirp(
    start_V: float,
    *,
    bias_V: float,
    amplitude_V: float,
    start_Hz: float,
    stop_Hz: float,
    duration_s: float,
    rate_V_per_s: float,
    sample_rate_Hz: float,
    spacing: Literal["linear", "logarithmic"] = "linear",
) -> FloatArray:
    """Play a sine about `bias_V` (V) whose frequency moves from `start_Hz` to `stop_Hz` (Hz) in `duration_s` (s).

    The frequency moves evenly in time (`linear`), or by the same ratio in equal times (`logarithmic`). A ramp at
    `rate_V_per_s` leads to the bias; the chirp ends wherever its last sample is.
    """
    _require_positive(
        amplitude_V=amplitude_V,
        start_Hz=start_Hz,
        stop_Hz=stop_Hz,
        duration_s=duration_s,
        sample_rate_Hz=sample_rate_Hz,
    )
    if max(start_Hz, stop_Hz) > sample_rate_Hz / 2:
        raise ValueError(f"start_Hz and stop_Hz must be at most half of sample_rate_Hz, {sample_rate_Hz / 2} Hz")
    way = ramp(start_V, to_V=bias_V, rate_V_per_s=rate_V_per_s, sample_rate_Hz=sample_rate_Hz)
    time_s = np.arange(1, _whole(duration_s * sample_rate_Hz) + 1) / sample_rate_Hz
    octave = math.log(stop_Hz / start_Hz)
    # The number of cycles so far is the integral of the frequency over time.
    if spacing == "linear" or octave == 0:
        cycles = start_Hz * time_s + (stop_Hz - start_Hz) * time_s**2 / (2 * duration_s)
    else:
        cycles = start_Hz * duration_s / octave * np.expm1(octave * time_s / duration_s)
    return np.concatenate([way, bias_V + amplitude_V * np.sin(2 * np.pi * cycles)])


def multisine(
    start_V: float,
    *,
    amplitude_V: float,
    low_Hz: float,
    high_Hz: float,
    period_s: float,
    periods: int,
    sample_rate_Hz: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Play `periods` times the same sum of sines of equal amplitude and random phase about the voltage it starts at.

    The frequencies are all the multiples of `1 / period_s` from `low_Hz` to `high_Hz` (Hz); the period is rounded to
    whole samples. The sum is scaled to go as far as `amplitude_V` (V) from the start. It begins where it is closest
    to that, so that nothing jumps.
    """
    _require_positive(
        amplitude_V=amplitude_V, low_Hz=low_Hz, high_Hz=high_Hz, period_s=period_s, sample_rate_Hz=sample_rate_Hz
    )
    _require_count(periods=periods)
    samples = _whole(period_s * sample_rate_Hz)
    _whole(float(samples) * periods)
    if high_Hz >= sample_rate_Hz / 2:
        raise ValueError(f"high_Hz must be below half of sample_rate_Hz, {sample_rate_Hz / 2} Hz, got {high_Hz}")
    # The small number keeps a line that is just at the end of the band.
    orders = np.arange(samples // 2 + 1) * (sample_rate_Hz / max(samples, 1))
    lines = (orders >= low_Hz * (1 - 1e-9)) & (orders <= high_Hz * (1 + 1e-9))
    if not lines.any():
        raise ValueError(f"low_Hz to high_Hz must hold a multiple of 1 / period_s, got {low_Hz} to {high_Hz}")
    spectrum = np.where(lines, np.exp(2j * np.pi * rng.random(len(lines))), 0)
    wave = np.fft.irfft(spectrum, samples)
    wave = np.roll(wave, -1 - int(np.abs(wave).argmin()))
    return start_V + np.tile(amplitude_V * wave / np.abs(wave).max(), periods)


def steps(
    start_V: float,
    *,
    levels_V: Sequence[float],
    dwell_s: float,
    sample_rate_Hz: float,
    rate_V_per_s: float = math.inf,
) -> FloatArray:
    """Climb a staircase: go to each level (V) in turn, at once or at a rate, and stay there for `dwell_s` (s)."""
    pieces = [np.empty(0)]
    for level_V in levels_V:
        pieces.append(ramp(start_V, to_V=level_V, rate_V_per_s=rate_V_per_s, sample_rate_Hz=sample_rate_Hz))
        pieces.append(hold(level_V, duration_s=dwell_s, sample_rate_Hz=sample_rate_Hz))
        start_V = level_V
    return np.concatenate(pieces)


PROGRAMS: Mapping[str, Callable[..., FloatArray]] = MappingProxyType(
    {
        program.__name__: program
        for program in (ramp, hold, triangle, sine, forc, nested, random_reversals, chirp, multisine, steps)
    }
)
"""The programs a scenario can name, by the `kind` it names them with."""
