"""Ways of looking at a residual: what is left in it that noise is not, whatever its cause."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from fits.diagnosis._projector import Projector
from fits.io.columns import COLUMNS, columns_beside
from fits.loop._run import Run

_WAVES, _POWERS = 12, 4
_CYCLES = 240
# Bands of the command, from two periods in a run to half the sampling rate, and the part of its energy that counts.
_BANDS, _PLAYED = 12, 1e-8


@dataclass(frozen=True)
class View:
    """One way of looking: signals along which structure would lie, per column a list over runs."""

    name: str
    columns: tuple[tuple[np.ndarray, ...], ...]
    sentence: str


@dataclass(frozen=True)
class Seen:
    """What one way of looking shows.

    Attributes
    ----------
    view
        The way.
    drop, freedom
        Decrease of the sum of squares, in noise variances, and columns that it took.
    z, p
        Evidence in standard deviations, and probability of as much by chance, for this way alone.
    """

    view: View
    drop: float
    freedom: int
    z: float
    p: float


def views(runs: Sequence[Run], plain_um: Sequence[np.ndarray]) -> list[View]:
    """The ways of looking in which structure counts as left over, each run by itself."""
    return _joined(runs, [_of_run(run, plain) for run, plain in zip(runs, plain_um, strict=True)])


def further_views(runs: Sequence[Run]) -> list[View]:
    """Ways of looking that say more of the cause: along the command and along what was measured besides."""
    return _joined(runs, [_beside(run) for run in runs])


def _joined(runs: Sequence[Run], found: Sequence[dict[str, list[np.ndarray]]]) -> list[View]:
    kinds: dict[str, list[list[np.ndarray]]] = {}
    sizes = [len(run.record) for run in runs]
    for k, own in enumerate(found):
        for name, columns in own.items():
            for column in columns:
                kinds.setdefault(name, []).append(
                    [column if i == k else np.zeros(size) for i, size in enumerate(sizes)]
                )
    return [
        # Further columns are called by their titles.
        View(name, tuple(tuple(c) for c in columns), _SENTENCES.get(name, f"the residual goes with the {name}"))
        for name, columns in kinds.items()
    ]


_SENTENCES = {
    "time": "the residual wanders along the run",
    "position": "the residual depends on the position and the branch",
    "velocity": "the residual depends on the speed",
    "reversal": "the residual depends on the time since the command last turned",
    "cycles": "the residual repeats itself with the position",
    "jumps": "the residual jumps",
    "voltage": "the residual depends on the command and its direction",
    "frequency": "the residual goes with the command, by another factor and phase at each frequency",
    "gain": "the residual is in proportion to the displacement, by a factor that changes along the run",
}


def _of_run(run: Run, plain_um: np.ndarray) -> dict[str, list[np.ndarray]]:
    record = run.record
    n = len(record)
    time = (record.time_s - record.time_s[0]) / record.duration_s
    low, span = float(plain_um.min()), float(np.ptp(plain_um)) or 1.0
    place = (plain_um - low) / span
    rate = np.gradient(plain_um, record.time_s)
    speed = rate / (np.std(rate) + 1e-300)
    up = np.gradient(record.voltage_V) >= 0
    waves = [np.cos(np.pi * k * time) for k in range(1, _WAVES + 1)]
    found = {
        "time": waves,
        "position": [np.cos(np.pi * k * place) * side for side in (up.astype(float), 1.0 - up) for k in range(8)],
        "velocity": [
            f * np.cos(np.pi * k * place)
            for f in (speed, np.sign(speed) * np.log1p(np.abs(speed) * 10), np.abs(speed))
            for k in range(3)
        ],
        "gain": [place * wave for wave in waves],
    }
    moves = np.flatnonzero(np.diff(record.voltage_V) != 0)
    if len(moves) > 1:
        direction = np.sign(np.diff(record.voltage_V))[moves]
        turned = moves[1:][direction[1:] != direction[:-1]]
        stopped = np.flatnonzero((np.diff(record.voltage_V)[:-1] != 0) & (np.diff(record.voltage_V)[1:] == 0)) + 1
        events = np.unique(np.concatenate([[0], turned, stopped]))
        since = record.time_s - record.time_s[events[np.searchsorted(events, np.arange(n), side="right") - 1]]
        step = record.duration_s / n
        age = np.log10(1 + since / (5 * step))
        age = age / max(float(age.max()), 1e-300)
        sign = np.where(up, 1.0, -1.0)
        found["reversal"] = [sign * np.cos(np.pi * k * age) for k in range(1, _POWERS + 1)]
    edges = np.linspace(0, n, 25).astype(int)[1:-1]
    found["jumps"] = [(np.arange(n) >= edge).astype(float) for edge in edges]
    return found


def _beside(run: Run) -> dict[str, list[np.ndarray]]:
    voltage = run.record.voltage_V
    share = (voltage - voltage.min()) / (float(np.ptp(voltage)) or 1.0)
    up = np.gradient(voltage) >= 0
    found = {
        "voltage": [np.cos(np.pi * k * share) * side for side in (up.astype(float), 1.0 - up) for k in range(8)],
        "frequency": _bands(voltage),
    }
    for name, values in columns_beside(run.record).items():
        if COLUMNS[name].title:
            values = values - np.mean(values)
            found[COLUMNS[name].title] = [values, np.gradient(values), np.cumsum(values)]
    return found


def _bands(values: np.ndarray) -> list[np.ndarray]:
    """A signal in bands of its frequencies, and the same a quarter of a period later."""
    n = len(values)
    # Played forth and back, so that it has no jump at its end.
    spectrum = np.fft.rfft(np.concatenate([values, values[::-1]]) - values.mean())
    edges = np.geomspace(2, len(spectrum), _BANDS + 1).astype(int)
    total = float(np.sum(np.abs(spectrum) ** 2))
    found = []
    for low, high in itertools.pairwise(edges):
        band = np.zeros_like(spectrum)
        band[low:high] = spectrum[low:high]
        if float(np.sum(np.abs(band) ** 2)) > _PLAYED * total:
            found += [np.fft.irfft(turn * band, 2 * n)[:n] for turn in (1.0, 1j)]
    return found


def look(projector: Projector, basis: np.ndarray, residual: np.ndarray, ways: Sequence[View]) -> list[Seen]:
    """Look at a residual, in each way, beside effects whose tangent `basis` spans."""
    found = []
    for view in ways:
        joined = projector.off(np.stack([projector.join(column) for column in view.columns], axis=1))
        joined = joined - basis @ (basis.T @ joined)
        scale = np.linalg.norm(joined, axis=0) + 1e-300
        left, size, _ = np.linalg.svd(joined / scale, full_matrices=False)
        keep = size > 1e-6 * size[0]
        along = left[:, keep].T @ residual
        drop, freedom = float(along @ along), int(keep.sum())
        p = float(stats.chi2.sf(drop, freedom))
        # Fisher's root of a chi-square variable is nearly normal.
        z = float(max((2 * drop) ** 0.5 - (2 * freedom - 1) ** 0.5, 0.0))
        found.append(Seen(view, drop, freedom, z, p))
    return found


def together(
    projector: Projector, basis: np.ndarray, residual: np.ndarray, ways: Sequence[View]
) -> tuple[float, int]:
    """Decrease of the sum of squares by all ways of looking together, and the columns that it takes."""
    columns = [column for view in ways for column in view.columns]
    seen = look(projector, basis, residual, [View("together", tuple(columns), "")])[0]
    return seen.drop, seen.freedom


def cycles(projector: Projector, residual: np.ndarray, plain_um: Sequence[np.ndarray]) -> tuple[float, float, float]:
    """Strongest period of the residual in the position: period in um, evidence, decrease of the sum of squares."""
    parts = projector.split(residual)
    masks = projector.masks
    span = max(float(np.ptp(p)) for p in plain_um)
    # From a dozen periods in the stroke to some thousand: what is slower lies in the density.
    best = (0.0, 0.0, 0.0)
    for count in np.geomspace(16, 2000, _CYCLES * 8):
        drop = 0.0
        for part, mask, plain in zip(parts, masks, plain_um, strict=True):
            phase = 2 * np.pi * count * plain[mask] / span
            wave = np.exp(1j * phase)
            n = len(part)
            drop += 2 * float(np.abs(part @ wave) ** 2) / n
        if drop > best[2]:
            best = (span / count, 0.0, drop)
    freedom = 2 * len(parts)
    logs = stats.chi2.logsf(best[2], freedom) + np.log(_CYCLES * 8)
    return best[0], float(-logs), best[2]
