"""Commands drawn piece by piece, within the limits of a rig."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.io._record import Record

# Share of a program that its first full loop takes, unless the rig is slower.
_LOOP = 0.12
# Samples of the shortest period that is still seen.
PER_PERIOD = 12


Samples = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Limits:
    """What a rig can do.

    Attributes
    ----------
    lower_V, upper_V
        Range of the command.
    fastest_V_per_s
        Largest rate of the command.
    interval_s
        Time between two samples.
    duration_s
        Length of the program, at most.
    resonance_Hz
        Of the stage; None where it is not known.
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

    @property
    def highest_Hz(self) -> float:
        """The highest frequency of interest, about three times the resonance, that the samples show."""
        seen = 1 / (PER_PERIOD * self.interval_s)
        return seen if self.resonance_Hz is None else min(3 * self.resonance_Hz, 3 * seen)

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
        pace = 2 * limits.span_V / (_LOOP * limits.duration_s)
        for end_V in (limits.upper_V, limits.lower_V):
            self.to(end_V, pace)
            # Long enough that a sample is taken there.
            self.rest(limits.interval_s)

    @property
    def left_s(self) -> float:
        """What is left of the duration."""
        return max(self.limits.duration_s - self._time_s[-1], 0.0)

    @property
    def now_V(self) -> float:
        """Where the command is."""
        return self._voltage_V[-1]

    def to(self, voltage_V: float, rate_V_per_s: float = np.inf) -> None:
        """Go to a voltage, at a rate or as fast as the rig can."""
        voltage_V = self.limits.inside(voltage_V)
        way = abs(voltage_V - self.now_V)
        if way > 0:
            self._time_s.append(self._time_s[-1] + way / min(rate_V_per_s, self.limits.fastest_V_per_s))
            self._voltage_V.append(voltage_V)

    def within(self, voltage_V: float, duration_s: float) -> None:
        """Go to a voltage in a time, or as fast as the rig can."""
        self.to(voltage_V, abs(self.limits.inside(voltage_V) - self.now_V) / max(duration_s, 1e-12))

    def rest(self, duration_s: float) -> None:
        """Stay."""
        self._time_s.append(self._time_s[-1] + duration_s)
        self._voltage_V.append(self.now_V)

    def chirp(self, amplitude_V: float, start_Hz: float, stop_Hz: float, duration_s: float) -> None:
        """Swing about the present voltage with a rising frequency, as far as range and rate allow, and come back."""
        limits, bias = self.limits, self.now_V
        time = np.arange(1, max(int(duration_s / limits.interval_s), 1)) * limits.interval_s
        # The frequency rises exponentially.
        growth = np.log(stop_Hz / start_Hz) / duration_s
        phase = 2 * np.pi * start_Hz * np.expm1(growth * time) / growth
        rate = 2 * np.pi * start_Hz * np.exp(growth * time)
        amplitude_V = min(amplitude_V, bias - limits.lower_V, limits.upper_V - bias)
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
            voltage = _slowed(voltage, most * (1 - 1e-9))
        return time, np.clip(voltage, limits.lower_V, limits.upper_V)


def _slowed(voltage_V: np.ndarray, most_V: float) -> np.ndarray:
    out, now = [], float(voltage_V[0])
    for wanted in voltage_V.tolist():
        now += min(max(wanted - now, -most_V), most_V)
        out.append(now)
    return np.asarray(out)


def repeated(limits: Limits, samples: Samples, times: int) -> Samples:
    """A program over and over, and between as fast from its end to its beginning as the rig can."""
    _, voltage_V = samples
    back = int(np.ceil(abs(voltage_V[0] - voltage_V[-1]) / (limits.fastest_V_per_s * limits.interval_s)))
    way_V = np.linspace(voltage_V[-1], voltage_V[0], max(back, 1) + 1)[1:-1]
    whole_V = np.concatenate([np.tile(np.concatenate([voltage_V, way_V]), times - 1), voltage_V])
    return limits.interval_s * np.arange(len(whole_V)), whole_V
