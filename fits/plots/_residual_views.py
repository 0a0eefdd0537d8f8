"""A residual against the variable that shows an effect best."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np
from scipy import signal

from fits.diagnosis._result import RunView
from microid.effects import View

_BINS = 36
# Fewer samples than this make no mean.
_FEWEST_IN_MEAN = 4
# Takes a variable or a residual from a run.
_Of = Callable[[RunView], np.ndarray]


@dataclass(frozen=True)
class Curve:
    """One curve of a view: `low` and `high` hold the middle 80 % of the samples."""

    x: np.ndarray
    y: np.ndarray
    low: np.ndarray | None = None
    high: np.ndarray | None = None
    downwards: bool = False


@dataclass(frozen=True)
class ResidualView:
    """A residual against one variable.

    `look` makes curves of a residual of runs; a `ValueError` where the runs, or none at all, do not allow it. `per`
    follows the unit of the length. The first axis is `logarithmic`, or both are of a `spectrum`.
    """

    look: Callable[[Sequence[RunView], _Of], list[Curve]]
    x_label: str
    caption: str
    y_label: str = "residual"
    per: str = ""
    logarithmic: bool = False
    spectrum: bool = False


def _binned(x: np.ndarray, y: np.ndarray, downwards: bool = False, even: bool = True) -> Curve:
    """Means over even stretches of `x`, or over equally many samples."""
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    if x.size < _FEWEST_IN_MEAN * 3 or np.ptp(x) == 0:
        raise ValueError("too few samples")
    steps = np.linspace(0, 1, _BINS + 1)
    edges = np.linspace(x.min(), x.max(), _BINS + 1) if even else np.unique(np.quantile(x, steps))
    place = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    rows = []
    for k in range(len(edges) - 1):
        inside = place == k
        if np.count_nonzero(inside) >= _FEWEST_IN_MEAN:
            low, high = np.quantile(y[inside], [0.1, 0.9])
            rows.append((np.mean(x[inside]), np.mean(y[inside]), low, high))
    if len(rows) < 3:
        raise ValueError("too few samples")
    middle, mean, low, high = np.array(rows).T
    return Curve(middle, mean, None, None, True) if downwards else Curve(middle, mean, low, high)


def _together(runs: Sequence[RunView], of: _Of) -> np.ndarray:
    return np.concatenate([np.ravel(of(run)) for run in runs])


def _over(x: _Of, even: bool = True) -> Callable[[Sequence[RunView], _Of], list[Curve]]:
    """Look at a residual against a variable of each sample."""
    return lambda runs, of: [_binned(_together(runs, x), _together(runs, of), even=even)]


def _over_voltage(runs: Sequence[RunView], of: _Of) -> list[Curve]:
    x, y = _together(runs, attrgetter("voltage_V")), _together(runs, of)
    up = _together(runs, lambda run: _last_move(run)[0]) >= 0
    # What was fitted may go one way only.
    ways = [(part, downwards) for part, downwards in ((up, False), (~up, True)) if np.count_nonzero(part) > _BINS]
    if not ways:
        raise ValueError("too few samples")
    return [_binned(x[part], y[part], downwards) for part, downwards in ways]


def _last_move(run: RunView) -> tuple[np.ndarray, np.ndarray]:
    """Direction of the last move of the voltage, and the sample at which it last started, stopped or turned."""
    step = np.diff(run.voltage_V, prepend=run.voltage_V[:1])
    sign = np.sign(np.where(np.abs(step) > 1e-6 * (np.ptp(run.voltage_V) or 1.0), step, 0.0))  # less is none
    index = np.arange(sign.size)
    moved = np.maximum.accumulate(np.where(sign != 0, index, 0))
    changed = np.concatenate([[0.0], np.diff(sign)]) != 0
    began = np.maximum.accumulate(np.where(changed, index, 0))
    return sign[moved], began


def _since_move(runs: Sequence[RunView], of: _Of) -> list[Curve]:
    direction = _together(runs, lambda run: _last_move(run)[0])
    since_s = _together(runs, lambda run: run.time_s - run.time_s[_last_move(run)[1]])
    kept = (since_s > 0) & (direction != 0)
    if np.count_nonzero(kept) < _BINS or since_s[kept].max() < 10 * since_s[kept].min():
        raise ValueError("the voltage never goes on for long")
    change = _together(runs, lambda run: _since_event(run, of(run)))
    found = _binned(np.log10(since_s[kept]), (direction * change)[kept])
    return [replace(found, x=10**found.x)]


def _since_event(run: RunView, residual: np.ndarray) -> np.ndarray:
    """Change of a residual since the voltage last started, stopped or turned: from the mean of three samples on."""
    begins = np.unique(_last_move(run)[1])
    out = np.array(residual, dtype=float)
    for begin, end in zip(begins, [*begins[1:], out.size], strict=True):
        out[begin:end] -= np.mean(out[begin : min(begin + 3, end)])
    return out


def _over_time(runs: Sequence[RunView], of: _Of) -> list[Curve]:
    longest = max(runs, key=lambda run: run.time_s[-1] - run.time_s[0] if run.time_s.size else 0.0)
    return [_binned(longest.time_s, of(longest))]


def _spectrum(runs: Sequence[RunView], of: _Of) -> list[Curve]:
    finest = max(
        runs, key=lambda run: run.time_s.size / (np.median(np.diff(run.time_s)) if run.time_s.size > 2 else 1)
    )
    if finest.time_s.size < 64:
        raise ValueError("too few samples")
    rate_Hz = 1 / float(np.median(np.diff(finest.time_s)))
    values = np.nan_to_num(of(finest))
    frequency_Hz, density = signal.welch(values, rate_Hz, nperseg=min(4096, values.size // 2))
    frequency_Hz, density = frequency_Hz[1:], density[1:]
    # Peaks are what is looked for, so that each even stretch of the logarithm shows its largest.
    edges = np.geomspace(frequency_Hz[0], frequency_Hz[-1] * 1.0001, 400)
    place = np.searchsorted(edges, frequency_Hz, side="right")
    kept = [np.flatnonzero(place == k) for k in np.unique(place)]
    top = np.array([inside[np.argmax(density[inside])] for inside in kept])
    return [Curve(frequency_Hz[top], np.sqrt(np.maximum(density[top], 1e-30)))]


_BAND = "Lines are means, and the shaded bands hold the middle 80 % of the samples."

VIEWS: dict[View, ResidualView] = {
    "voltage": ResidualView(
        _over_voltage,
        "voltage (V)",
        f"Solid while the voltage rises or last rose, dashed while it falls or last fell. {_BAND}",
    ),
    "position": ResidualView(_over(attrgetter("measured_um")), "measured displacement (µm)", _BAND),
    "velocity": ResidualView(
        _over(lambda run: np.gradient(run.voltage_V, run.time_s), even=False), "rate of the voltage (V/s)", _BAND
    ),
    "frequency": ResidualView(
        _spectrum,
        "frequency (Hz)",
        "Spectrum of the residual of the most finely sampled run; of each narrow band the largest value is drawn.",
        "residual density",
        per="/√Hz",
        logarithmic=True,
        spectrum=True,
    ),
    "time": ResidualView(_over_time, "time (s)", f"The longest run. {_BAND}"),
    "since_move": ResidualView(
        _since_move,
        "time since the last event (s)",
        "How the residual changes after the voltage starts, stops or turns; positive in the direction of the last "
        f"move. {_BAND}",
        "change of the residual",
        logarithmic=True,
    ),
}
