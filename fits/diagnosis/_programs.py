"""Voltage programs that a next experiment is chosen from, drawn piece by piece within the limits of a rig."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np

from fits.io._record import Record

# Samples of the shortest period that is still seen.
_PER_PERIOD = 12
Samples = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Limits:
    """What a rig can do: range and rate of the command, time between samples, and duration of a program, at most.

    `resonance_Hz` is that of the stage; None where it is not known.
    """

    lower_V: float
    upper_V: float
    fastest_V_per_s: float
    interval_s: float
    duration_s: float
    resonance_Hz: float | None = None

    @property
    def span_V(self) -> float:
        """Range of the command."""
        return self.upper_V - self.lower_V

    @property
    def count(self) -> int:
        """Samples of a program."""
        return int(np.floor(self.duration_s / self.interval_s * (1 + 1e-12))) + 1

    def inside(self, voltage_V: float) -> float:
        """The nearest voltage within the range."""
        return float(np.clip(voltage_V, self.lower_V, self.upper_V))


def limits_of(
    records: Sequence[Record], range_V: tuple[float, float], resonance_Hz: float | None, duration_s: float | None
) -> Limits:
    """Read off records what the rig can do; the duration is that of the longest unless it is given."""
    fastest = max(float(np.max(np.abs(np.diff(r.voltage_V) / np.diff(r.time_s)))) for r in records)
    interval = min(float(np.median(np.diff(r.time_s))) for r in records)
    longest = max(r.duration_s for r in records)
    return Limits(*range_V, fastest, interval, longest if duration_s is None else duration_s, resonance_Hz)


def paces(limits: Limits, most: int) -> tuple[Limits, ...]:
    """The whole duration, as finely as so many samples allow, and the finest sampling for as long as they last."""
    slow = replace(limits, interval_s=max(limits.interval_s, limits.duration_s / (most - 1)))
    if slow.interval_s < 1.5 * limits.interval_s:
        return (slow,)
    return slow, replace(limits, duration_s=(most - 1) * limits.interval_s)


class Path:
    """A command drawn piece by piece, which starts at the lower voltage with a full loop.

    What lies beyond the duration is cut off; where less is drawn, the last voltage is held.
    """

    def __init__(self, limits: Limits):
        self.limits = limits
        self._time_s, self._voltage_V = [0.0], [limits.lower_V]
        # The loop takes no more of a program, unless the rig is slower.
        pace = 2 * limits.span_V / (0.12 * limits.duration_s)
        for end_V in (limits.upper_V, limits.lower_V):
            self.to(end_V, pace)
            # Long enough that a sample is taken there.
            self.rest(limits.interval_s)

    @property
    def left_s(self) -> float:
        """What is left of the duration."""
        return max(self.limits.duration_s - self._time_s[-1], 0.0)

    def to(self, voltage_V: float, rate_V_per_s: float = np.inf) -> None:
        """Go to a voltage, at a rate or as fast as the rig can."""
        voltage_V = self.limits.inside(voltage_V)
        way = abs(voltage_V - self._voltage_V[-1])
        if way > 0:
            self._time_s.append(self._time_s[-1] + way / min(rate_V_per_s, self.limits.fastest_V_per_s))
            self._voltage_V.append(voltage_V)

    def within(self, voltage_V: float, duration_s: float) -> None:
        """Go to a voltage in a time, or as fast as the rig can."""
        self.to(voltage_V, abs(self.limits.inside(voltage_V) - self._voltage_V[-1]) / max(duration_s, 1e-12))

    def rest(self, duration_s: float) -> None:
        """Stay."""
        self._time_s.append(self._time_s[-1] + duration_s)
        self._voltage_V.append(self._voltage_V[-1])

    def chirp(self, amplitude_V: float, start_Hz: float, stop_Hz: float, duration_s: float) -> None:
        """Swing about the present voltage with a rising frequency, as far as range and rate allow, and come back."""
        limits, bias = self.limits, self._voltage_V[-1]
        amplitude_V = min(amplitude_V, bias - limits.lower_V, limits.upper_V - bias)
        time = np.arange(1, max(int(duration_s / limits.interval_s), 1)) * limits.interval_s
        # The frequency rises exponentially.
        growth = np.log(stop_Hz / start_Hz) / duration_s
        phase = 2 * np.pi * start_Hz * np.expm1(growth * time) / growth
        rate = 2 * np.pi * start_Hz * np.exp(growth * time)
        swing = np.minimum(amplitude_V, 0.95 * limits.fastest_V_per_s / rate) * np.sin(phase)
        self._time_s.extend((self._time_s[-1] + time).tolist())
        self._voltage_V.extend((bias + swing).tolist())
        self.to(bias)

    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Times and command, shape `(n,)`, in even steps that the rig can follow."""
        limits = self.limits
        time = limits.interval_s * np.arange(limits.count)
        voltage = np.interp(time, self._time_s, self._voltage_V)
        most = limits.fastest_V_per_s * limits.interval_s
        if np.max(np.abs(np.diff(voltage)), initial=0.0) > most:
            most *= 1 - 1e-9
            followed = accumulate(voltage.tolist(), lambda now, wanted: now + min(max(wanted - now, -most), most))
            voltage = np.array(list(followed))
        return time, np.clip(voltage, limits.lower_V, limits.upper_V)


def repeated(limits: Limits, samples: Samples, times: int) -> Samples:
    """A program over and over, and between as fast from its end to its beginning as the rig can."""
    _, voltage_V = samples
    back = int(np.ceil(abs(voltage_V[0] - voltage_V[-1]) / (limits.fastest_V_per_s * limits.interval_s)))
    way_V = np.linspace(voltage_V[-1], voltage_V[0], max(back, 1) + 1)[1:-1]
    whole_V = np.concatenate([np.tile(np.concatenate([voltage_V, way_V]), times - 1), voltage_V])
    return limits.interval_s * np.arange(len(whole_V)), whole_V


def staircase(path: Path, low_V: float, high_V: float, decades: float) -> None:
    """Levels up and down, held for times that are spread over some decades, long ones among short ones."""
    levels = np.r_[np.linspace(low_V, high_V, 5), np.linspace(high_V, low_V, 5)[1:]]
    holds = np.logspace(-decades, 0, len(levels))[[4, 0, 6, 2, 8, 1, 7, 3, 5]]
    travel = float(np.abs(np.diff(np.r_[path.limits.lower_V, levels])).sum()) / path.limits.fastest_V_per_s
    free = max(path.left_s - travel, 0.0)
    for level, hold in zip(levels, holds / holds.sum(), strict=True):
        path.to(float(level))
        path.rest(free * hold)


def chirps(path: Path, bias_V: float, spread_V: float, amplitude_V: float, stop_Hz: float) -> None:
    """Chirps of three amplitudes at three biases each, from a thirtieth of the highest frequency."""
    biases = [path.limits.inside(bias_V + shift * spread_V) for shift in (-1, 0, 1)]
    approach = 0.03 * path.left_s
    each = path.left_s / 9 - approach / 3 - 2 * amplitude_V / path.limits.fastest_V_per_s
    for bias in biases:
        path.within(bias, approach)
        for share in (0.25, 1.0, 0.5):
            path.chirp(share * amplitude_V, stop_Hz / 30, stop_Hz, max(each, 2 * path.limits.interval_s))


def multirate(path: Path, low_V: float, high_V: float, decades: float) -> None:
    """The same loop at five rates, which are spread over some decades."""
    path.within(low_V, 0.02 * path.limits.duration_s)
    ratios = np.logspace(0, -decades, 5)
    # Quick loops are repeated, to take a tenth of the slowest one.
    counts = [max(1, round(0.1 / ratio)) for ratio in ratios]
    slowest = path.left_s / float(np.sum(ratios * counts))
    for ratio, count in zip(ratios, counts, strict=True):
        half = max(ratio * slowest / 2, _PER_PERIOD / 2 * path.limits.interval_s)
        for _ in range(count):
            path.within(high_V, half)
            path.within(low_V, half)


def minor_loops(path: Path, bias_V: float, amplitude_V: float) -> None:
    """Ten minor loops about a bias that is reached from below, and ten after it is reached from above."""
    low, high = path.limits.inside(bias_V - amplitude_V), path.limits.inside(bias_V + amplitude_V)
    approach = path.limits.span_V / (0.06 * path.left_s)
    half = 0.9 * path.left_s / 40
    for end, first, second in ((path.limits.lower_V, high, low), (path.limits.upper_V, low, high)):
        path.to(end, approach)
        for _ in range(10):
            path.within(first, half)
            path.within(second, half)


def repeat_after_wait(path: Path, low_V: float, high_V: float, wait_s: float) -> None:
    """The same loop and hold twice, with a rest at the lower voltage between."""
    wait_s = min(wait_s, 0.8 * path.left_s)
    each = (path.left_s - wait_s) / 2
    for last in (False, True):
        path.within(high_V, 0.2 * each)
        path.rest(0.3 * each)
        path.within(low_V, 0.15 * each)
        path.within((low_V + high_V) / 2, 0.1 * each)
        path.rest(0.15 * each)
        path.within(path.limits.lower_V, 0.1 * each)
        if not last:
            path.rest(wait_s)


def steps(path: Path, base_V: float, height_V: float, decade: float) -> None:
    """Steps of three heights from a voltage near the bottom, over and over, with edges as fast as the rig.

    Each level is held for `10**decade` seconds, and four samples at least.
    """
    path.within(base_V, 0.03 * path.limits.duration_s)
    dwell_s = max(10.0**decade, 4 * path.limits.interval_s)
    heights = (height_V, height_V / 4, height_V / 2)
    for k in range(int(path.left_s / dwell_s) + 1):
        path.to(base_V + (heights[k // 2 % 3] if k % 2 == 0 else 0.0))
        path.rest(dwell_s)


def burst(path: Path, amplitude_V: float, burst_s: float, period_s: float) -> None:
    """A slow loop, hard driving about the middle for some time, and the same loop twice again."""
    burst_s = min(burst_s, 0.6 * path.left_s)
    loop = (path.left_s - burst_s) / 3.2
    middle = (path.limits.lower_V + path.limits.upper_V) / 2
    half = max(period_s / 2, _PER_PERIOD / 2 * path.limits.interval_s, 2 * amplitude_V / path.limits.fastest_V_per_s)
    for k in range(3):
        path.within(path.limits.upper_V, loop / 2)
        path.within(path.limits.lower_V, loop / 2)
        if k == 0:
            for _ in range(int(burst_s / (2 * half))):
                path.within(middle + amplitude_V, half)
                path.within(middle - amplitude_V, half)
            path.within(path.limits.lower_V, 0.05 * loop)


@dataclass(frozen=True)
class Program:
    """One program of the menu: `play` draws a path by parameters.

    `lower`, `upper` and `start` are of the parameters, in that order, shape `(k,)`; `words` say what it is made of.
    """

    words: str
    play: Callable[..., None]
    limits: Limits
    lower: np.ndarray
    upper: np.ndarray
    start: np.ndarray

    def samples(self, parameters: np.ndarray) -> Samples:
        """Times and command at parameters, which are brought into their limits."""
        path = Path(self.limits)
        self.play(path, *np.clip(parameters, self.lower, self.upper).tolist())
        return path.samples()


def menu(limits: Limits, most: int) -> tuple[Program, ...]:
    """All programs that fit into the limits, with so many samples at most."""
    found = []
    for pace in paces(limits, most):
        # Fewer samples decide nothing.
        if pace.count < 200 or 2 * pace.span_V / pace.fastest_V_per_s > 0.5 * pace.duration_s:
            continue
        # What is fast is only seen finely, what is slow only in the whole time, and the same loop at several rates in
        # both.
        fine = pace.interval_s < 1.5 * limits.interval_s
        whole = pace.duration_s > 0.7 * limits.duration_s
        for words, play, table in _entries(pace):
            if play is multirate or (fine if play in (chirps, steps) else whole):
                lower, start, upper = np.array(table).T
                found.append(Program(words, play, pace, lower, upper, np.clip(start, lower, upper)))
    return tuple(found)


def _entries(limits: Limits) -> list[tuple[str, Callable[..., None], list[np.ndarray | tuple[float, ...]]]]:
    """Words, function, and of each parameter the least, the first and the largest value."""
    low, span, whole = limits.lower_V, limits.span_V, limits.duration_s
    places = ((0.0, 0.1, 0.4), (0.2, 0.5, 0.8), (0.6, 0.95, 1.0), (0.0, 0.5, 1.0))
    bottom, bias, top, anywhere = low + span * np.array(places)
    swing, height = span * np.array([[0.05, 0.15, 0.5], [0.1, 0.5, 0.9]])
    spread, amplitude, burst_amplitude = span * np.array([[0.0, 0.3, 0.4], [0.02, 0.1, 0.4], [0.2, 0.45, 0.5]])
    approach, wait, hard = whole * np.array([[0.01, 0.03, 0.2], [0.05, 0.3, 0.7], [0.05, 0.3, 0.5]])
    shortest_s = _PER_PERIOD * limits.interval_s
    seen_Hz = 1 / shortest_s
    # The highest frequency of interest, about three times the resonance, that the samples show.
    highest_Hz = seen_Hz if limits.resonance_Hz is None else min(3 * limits.resonance_Hz, 3 * seen_Hz)
    stop = highest_Hz * np.array([0.2, 0.9, 1.0])
    period = shortest_s * np.array([2.0, 2.0, 40.0])
    # Steps let the stage ring, as long as a period or so, or move on before it has begun to.
    ringing = float(np.log10(1 / limits.resonance_Hz if limits.resonance_Hz else 0.0125 * whole))
    shortest, longest = float(np.log10(4 * limits.interval_s)), max(ringing + 1, float(np.log10(0.05 * whole)))
    quick = "fast steps of three heights near the bottom"
    return [
        ("a rest after one loop", Path.within, [anywhere, approach]),
        ("a staircase up and down with long and short holds", staircase, [bottom, top, (0.3, 1.5, 2.5)]),
        ("chirps of three amplitudes at three biases", chirps, [bias, spread, amplitude, stop]),
        ("the same loop at five rates over two decades", multirate, [bottom, top, (1.0, 2.0, 2.3)]),
        ("a minor loop ten times from below and ten times from above", minor_loops, [bias, swing]),
        ("the same pattern before and after a wait", repeat_after_wait, [bottom, top, wait]),
        (quick, steps, [bottom, height, (shortest, ringing, longest)]),
        (f"{quick} in quick succession", steps, [bottom, height, (shortest, max(ringing - 1, shortest), longest)]),
        ("a slow loop before and twice after a burst of hard driving", burst, [burst_amplitude, hard, period]),
    ]
