"""Where the fit of a stage begins: poles read off a measured frequency response, so that nobody has to guess them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy

from fits.loop._run import Run
from fits.stage._run import named_parts
from microid import AbstractLinear, Driver, Mechanics, Stage

_LINES = 6
# Logarithms of poles nearer than this are the same.
_SAME = 0.05
# Lines of a response that are kept, spread evenly over the logarithm of the frequency and around the largest.
_MOST_LINES = 240
# Damping ratio of a mode that takes up little of the lag, and the part of the lag that is little.
_LIGHT, _LITTLE = 0.03, 0.3
# Lags that are no longer than this are none: a driver has some.
_SHORTEST_s = 1e-8


@dataclass(frozen=True)
class Sampled:
    """A drive and what it made of the displacement, in um, shape `(n,)` each, at even intervals."""

    rate_Hz: float
    drive: np.ndarray
    displacement: np.ndarray


@dataclass(frozen=True)
class MeasuredResponse:
    """Complex response to what the hysteresis alone would give, and its coherence, shape `(f,)` each.

    Where it is known what it was read off, that is `sampled`.
    """

    frequency_Hz: np.ndarray
    response: np.ndarray
    coherence: np.ndarray
    sampled: Sampled | None = None


def measure_response(run: Run, drive: np.ndarray) -> MeasuredResponse:
    """Frequency response (Welch) from a drive, `(n,)`, to the displacement, over the samples that are fitted."""
    which = np.flatnonzero(run.fitted)
    piece = slice(which[0], which[-1] + 1)
    time = run.record.time_s[piece]
    even = np.linspace(time[0], time[-1], len(time))
    x, y = (np.interp(even, time, values[piece]) for values in (drive, run.displacement_um))
    rate, length = (len(time) - 1) / (time[-1] - time[0]), max(64, 2 * len(time) // 9)  # eight segments
    settings: dict[str, Any] = {"fs": rate, "nperseg": min(length, len(time)), "detrend": "linear"}
    frequency, cross = scipy.signal.csd(x, y, **settings)
    power, out = scipy.signal.welch(x, **settings)[1], scipy.signal.welch(y, **settings)[1]
    with np.errstate(invalid="ignore", divide="ignore"):
        response, coherence = cross / power, np.abs(cross) ** 2 / (power * out)
    # The lines next to zero hold what the trend leaves.
    usable = (np.arange(len(frequency)) >= 2) & np.isfinite(coherence) & (response != 0)
    # Noise alone seems to follow by a third at many lines: less counts only where there is nothing better.
    seen = usable & (coherence > 0.7)
    if seen.sum() < _LINES:
        seen = usable & (coherence > 0.3)
    kept = _thinned(frequency, np.abs(response), np.flatnonzero(seen))
    coherence = np.minimum(coherence, 1 - 1e-9)
    return MeasuredResponse(frequency[kept], response[kept], coherence[kept], Sampled(rate, x, y))


def _thinned(frequency: np.ndarray, size: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Keep some lines of many: spread over the logarithm of the frequency, and the largest, where poles show."""
    if len(seen) <= _MOST_LINES:
        return seen
    spread = np.searchsorted(frequency[seen], np.geomspace(frequency[seen[0]], frequency[seen[-1]], _MOST_LINES // 2))
    largest = np.argsort(-size[seen])[: _MOST_LINES // 2]
    return seen[np.unique(np.concatenate([np.minimum(spread, len(seen) - 1), largest]))]


def start_stages(stage: Stage, responses: Sequence[MeasuredResponse]) -> list[Stage]:
    """Find poles that explain measured frequency responses, each of which has a gain of its own.

    Drivers and mechanics that are not frozen are replaced; other linear parts are taken as they are. Returns distinct
    candidates, the best first; the stage itself where the responses say nothing.
    """
    moved = _moved(stage)
    found = _poles(stage, moved, responses, [isinstance(stage[name], Driver) for name in moved])
    if found is None:
        return [stage]
    problem, ends = found
    best = [other for x in ends[:1] for other in problem.exchanged(x)]
    return [problem.applied(stage, moved, x) for x in [*ends, *best]]


def start_lagging(stage: Stage, responses: Sequence[MeasuredResponse]) -> list[tuple[Stage, float]]:
    """The same for a stage whose reading lags behind it, each with the time constant of that lag in s.

    A response does not tell which of two lags lies ahead of the hysteresis: those of reading and driver are given
    both ways. Nothing where the responses say nothing.
    """
    moved = _moved(stage)
    drivers = [*(isinstance(stage[name], Driver) for name in moved), True]
    found = _poles(stage, moved, responses, drivers)
    if found is None:
        return []
    problem, ends = found
    places = np.cumsum([1 if driver else 2 for driver in drivers]) - 1
    swaps = [[at, -1] for at, driver in zip(places, drivers, strict=True) if driver]
    swapped = []
    for x in ends:
        for swap in swaps[::-1]:
            other = x.copy()
            other[swap] = x[swap[::-1]]
            swapped.append(other)
    return [(problem.applied(stage, moved, x), float(np.exp(x[-1]))) for x in _distinct(swapped, _SAME)]


def with_lag_elsewhere(stage: Stage) -> list[Stage]:
    """The same stage with all but a little of its lag in the driver, or in the damping of its mode, if it was not.

    Below the resonance a driver and a damped mode delay alike. None unless both are there, and free.
    """
    drivers, modes = named_parts(stage, Driver), named_parts(stage, Mechanics)
    if len(drivers) != 1 or len(modes) != 1 or not {drivers[0][0], modes[0][0]} <= {*_moved(stage)}:
        return []
    (name, driver), (place, mode) = drivers[0], modes[0]
    per_damping_s = 1 / (np.pi * float(mode.natural_frequency_Hz))
    ahead_s, behind_s = float(driver.time_constant_s), float(mode.damping_ratio) * per_damping_s
    little_s, found = max(min(_LIGHT * per_damping_s, _LITTLE * (ahead_s + behind_s)), _SHORTEST_s), list[Stage]()
    if little_s > _LITTLE * (ahead_s + behind_s):
        return found
    for here_s, there_s in ((ahead_s + behind_s - little_s, little_s), (little_s, ahead_s + behind_s - little_s)):
        if here_s > ahead_s / 2 and there_s > behind_s / 2:
            continue
        other = stage.swap(name, replace(driver, time_constant_s=jnp.asarray(here_s)))
        found.append(other.swap(place, replace(mode, damping_ratio=jnp.asarray(there_s / per_damping_s))))
    return found


def _moved(stage: Stage) -> list[str]:
    """Drivers and mechanics whose poles are free."""
    return [name for name, _ in named_parts(stage, Driver, Mechanics) if name not in stage.frozen]


def _poles(
    stage: Stage, moved: Sequence[str], responses: Sequence[MeasuredResponse], drivers: list[bool]
) -> tuple["_LogResponse", list[np.ndarray]] | None:
    """Distinct poles of lags and mechanics that explain responses, the best first; None where those say nothing."""
    responses = [one for one in responses if len(one.frequency_Hz) >= _LINES]
    if not moved or not responses:
        return None
    fixed = [part for name, part in named_parts(stage, AbstractLinear) if name not in moved]
    problem, found = _LogResponse.of(responses, drivers, fixed), list[tuple[float, np.ndarray]]()
    # Candidates may be too alike, in the logarithms of their poles, to refine both, or to keep both.
    ranked, (low, high) = problem.ranked()[1][:200], problem.bounds()
    for x in _distinct(ranked, 0.5)[:4]:
        start = np.clip(x, low, high)
        end: Any = scipy.optimize.least_squares(problem.misfit, start, bounds=(low, high), max_nfev=200)
        found.append((float(end.cost), end.x))
    found.sort(key=lambda item: item[0])
    ends = [x for _, x in found]
    sampled = [one.sampled for one in responses if one.sampled is not None]
    if sampled:
        ends = [problem.refined_in_time([*ends, *_distinct(ranked, 0.2)], sampled, fixed), *ends]
    return problem, _distinct(ends, _SAME)[:3]


def best_shifts(stage: Stage, response: MeasuredResponse, shifts_s: np.ndarray) -> list[float]:
    """Order delays, the best first, by how well they and some poles explain a response; of neighbours the best."""
    parts = [part for _, part in named_parts(stage, Driver, Mechanics)]
    if not parts or len(response.frequency_Hz) < _LINES:
        return []
    problem = _LogResponse.of([response], [isinstance(part, Driver) for part in parts], [])
    turns = np.exp(2j * np.pi * np.outer(shifts_s, problem.frequency_Hz))
    cost = np.array([replace(problem, measured=problem.measured * turn).ranked()[0][0] for turn in turns])
    low = np.flatnonzero((cost <= np.r_[np.inf, cost[:-1]]) & (cost <= np.r_[cost[1:], np.inf]))
    return [float(shifts_s[k]) for k in low[np.argsort(cost[low])]]


def _distinct(points: Sequence[np.ndarray] | np.ndarray, apart: float) -> list[np.ndarray]:
    every, kept = np.array(points), list[int]()
    near = np.max(np.abs(every[:, None] - every), axis=2) <= apart
    for k, beside in enumerate(near):
        if not beside[kept].any():
            kept.append(k)
    return [every[k] for k in kept]


@dataclass(frozen=True)
class _LogResponse:
    """Measured and modelled responses compared by their logarithms, in which poles far away still pull.

    Coordinates are logarithms: of a driver's time constant, of a mechanics' natural frequency and damping ratio.
    """

    frequency_Hz: np.ndarray
    measured: np.ndarray
    weight: np.ndarray
    run: np.ndarray
    drivers: list[bool]

    @classmethod
    def of(
        cls, responses: Sequence[MeasuredResponse], drivers: list[bool], fixed: Sequence[AbstractLinear]
    ) -> "_LogResponse":
        frequency = np.concatenate([one.frequency_Hz for one in responses])
        measured = np.concatenate([one.response for one in responses])
        coherence = np.concatenate([one.coherence for one in responses])
        for part in fixed:
            response = np.asarray(part.frequency_response(jnp.asarray(frequency)))
            measured = measured * float(part.static_gain) / response
        # The variance of the logarithm of a response is proportional to (1 - coherence) / coherence.
        # However coherent a line is, the estimate leaks from its neighbours.
        weight = np.minimum(np.sqrt(coherence / (1 - coherence)), 30.0)
        run = np.repeat(np.arange(len(responses)), [len(one.frequency_Hz) for one in responses])
        return cls(frequency, measured, weight, run, drivers)

    def misfit(self, x: np.ndarray) -> np.ndarray:
        """Weighted real and imaginary parts of the logarithm of measured over modelled, shape `(2 f,)`."""
        off = self._off(np.prod([self._inverse(part) for part in self._split(x)], axis=0))
        return np.concatenate([off.real, off.imag])

    def _split(self, x: np.ndarray) -> list[np.ndarray]:
        return np.split(x, np.cumsum([1 if driver else 2 for driver in self.drivers])[:-1])

    def _inverse(self, x: np.ndarray) -> np.ndarray:
        """One over the response of one part, whose coordinates are along the last axis, shape `(..., f)`."""
        turns = 2j * np.pi * self.frequency_Hz
        if x.shape[-1] == 1:
            return 1 + turns * np.exp(x)
        s = turns / (2 * np.pi * np.exp(x[..., :1]))
        return 1 + s * (s + 2 * np.exp(x[..., 1:]))

    def _off(self, inverse: np.ndarray) -> np.ndarray:
        # The logarithm of a product of ratios wraps; that of each ratio's deviation from one gain rarely does.
        ratio = self.measured * inverse
        off = np.log(np.abs(ratio)) + 1j * np.angle(ratio)
        for number in range(self.run.max() + 1):
            which = self.run == number
            share = self.weight[which] ** 2
            # Gains are positive: only their size is free.
            off[..., which] -= (off[..., which].real @ share / np.sum(share))[..., None]
        return off * self.weight

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Poles beyond these leave nothing in the band, and those within their ends something."""
        low, high = np.log(self.frequency_Hz.min() / 30), np.log(self.frequency_Hz.max() * 30)
        radian = np.log(2 * np.pi)
        driver, mechanics = [(-radian - high, -radian - low)], [(low, high), (np.log(1e-4), np.log(1e2))]
        pairs = [pair for one in self.drivers for pair in (driver if one else mechanics)]
        return np.array([pair[0] for pair in pairs]), np.array([pair[1] for pair in pairs])

    def ranked(self) -> tuple[np.ndarray, np.ndarray]:
        """All combinations of some poles for each part, the best first: their misfits and their coordinates."""
        low, high = float(self.frequency_Hz.min()), float(self.frequency_Hz.max())
        size = np.abs(self.measured) * np.minimum(self.weight, 1)
        peaks = np.flatnonzero((size[1:-1] > size[:-2]) & (size[1:-1] > size[2:])) + 1
        highest = self.frequency_Hz[peaks[np.argsort(-size[peaks])][:3]]
        natural = np.concatenate([highest, np.geomspace(max(low, high / 100), 2 * high, 24)])
        constants = np.log(np.geomspace(0.02, 50, 8) / (2 * np.pi * high))[:, None]
        poles = np.log(list(product(natural, (0.005, 0.03, 0.15, 0.7))))
        points, inverse = np.zeros((1, 0)), np.ones((1, len(self.frequency_Hz)), dtype=complex)
        for driver in self.drivers:
            more = constants if driver else poles
            inverse = (inverse[:, None] * self._inverse(more)[None]).reshape(-1, inverse.shape[1])
            points = np.concatenate([np.repeat(points, len(more), axis=0), np.tile(more, (len(points), 1))], axis=1)
        cost = np.sum(np.abs(self._off(inverse)) ** 2, axis=1)
        order = np.argsort(cost)
        return cost[order], points[order]

    def refined_in_time(
        self, points: Sequence[np.ndarray], sampled: Sequence[Sampled], fixed: Sequence[AbstractLinear]
    ) -> np.ndarray:
        """The best of some poles by what they leave of the displacement, and what follows from there.

        Where one short sweep passes a resonance that rings for long, its lines lie in few segments and lean to it.
        """
        spectra = []
        for one in sampled:
            frequency = np.fft.rfftfreq(2 * len(one.drive), 1 / one.rate_Hz)
            spectrum = np.fft.rfft(one.drive - one.drive[0], 2 * len(one.drive))
            for part in fixed:
                spectrum = spectrum * np.asarray(part.frequency_response(jnp.asarray(frequency)))
            spectra.append((replace(self, frequency_Hz=frequency), spectrum))

        def left_um(x: np.ndarray) -> np.ndarray:
            left = []
            for (problem, spectrum), one in zip(spectra, sampled, strict=True):
                inverse = np.prod([problem._inverse(part) for part in self._split(x)], axis=0)
                moved = np.fft.irfft(spectrum / inverse)[: len(one.drive)]
                moved, measured = moved - moved.mean(), one.displacement - one.displacement.mean()
                gain = max(float(moved @ measured) / max(float(moved @ moved), 1e-300), 0.0)
                left.append(measured - gain * moved)
            return np.concatenate(left)

        low, high = self.bounds()
        points = [np.clip(x, low, high) for x in points]
        best = min(points, key=lambda x: float(np.sum(left_um(x) ** 2)))
        scale = max(float(np.std(left_um(best))), 1e-300)
        end: Any = scipy.optimize.least_squares(lambda x: left_um(x) / scale, best, bounds=(low, high), max_nfev=50)
        found: np.ndarray = end.x
        return found

    def exchanged(self, x: np.ndarray) -> list[np.ndarray]:
        """The same poles in other places: a response does not tell which real pole lies ahead of the hysteresis."""
        parts = self._split(x)
        if self.drivers != [True, False] or parts[1][1] <= 0:
            return []
        rate, damping = 2 * np.pi * np.exp(parts[1][0]), np.exp(parts[1][1])
        spread = rate * np.sqrt(damping**2 - 1)
        poles = [np.exp(-parts[0][0]), rate * damping - spread, rate * damping + spread]
        others = []
        for k in (1, 2):
            one, two = poles[:k] + poles[k + 1 :]
            natural = np.log(np.sqrt(one * two) / (2 * np.pi)), np.log((one + two) / (2 * np.sqrt(one * two)))
            others.append(np.array([-np.log(poles[k]), *natural]))
        return others

    def applied(self, stage: Stage, names: Sequence[str], x: np.ndarray) -> Stage:
        for name, pole in zip(names, self._split(np.exp(x)), strict=False):
            part: Any = stage[name]
            made: Any = Driver if isinstance(part, Driver) else Mechanics
            stage = stage.swap(name, made(*(jnp.asarray(value) for value in pole), part.gain))
        return stage
