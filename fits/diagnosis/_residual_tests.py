"""Tests of a residual without any effect in mind: what it depends on, and whether it is noise."""

import itertools
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from fits.diagnosis._projector import Projector
from fits.diagnosis._result import Test
from fits.diagnosis._thresholds import THRESHOLDS, Thresholds
from fits.io.columns import COLUMNS, columns_beside
from fits.loop._run import Run
from fits.stats._cycles import Cycles, cycles
from fits.stats._flicker import Flicker
from fits.stats._noise import learn_noise
from fits.stats._score_test import standard_deviations

_WAVES = 12
# Bands of the command, from two periods in a run to half the sampling rate, and the part of its energy that counts.
_BANDS, _PLAYED = 12, 1e-8
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
# Lags of neighbours, stretches of a run, and samples that a stretch needs at least.
_LAGS, _STRETCHES, _FEWEST_IN_STRETCH = 20, 24, 20
# What goes along the run, whatever the rig does, and the chance below which what goes with the rig is no noise.
_ALONG_THE_RUN, _CHANCE = ("time", "gain", "jumps"), 1e-3
# Evidence is counted up to so many standard deviations.
_LARGEST_Z = 37.0


@dataclass(frozen=True)
class Regressors:
    """Regressors along which structure would lie, per column a list over runs, and what that would mean."""

    name: str
    columns: tuple[tuple[np.ndarray, ...], ...]
    sentence: str


@dataclass(frozen=True)
class Explained:
    """What regressors explain: the decrease of the sum of squares in noise variances, and the columns that it takes.

    `z` is the evidence in standard deviations, `p` the probability of as much by chance.
    """

    regressors: Regressors
    drop: float
    freedom: int
    z: float
    p: float


def run_regressors(runs: Sequence[Run], plain_um: Sequence[np.ndarray]) -> list[Regressors]:
    """Regressors whose structure counts as left over, each run by itself."""
    return _joined(runs, [_of_run(run, plain) for run, plain in zip(runs, plain_um, strict=True)])


def further_regressors(runs: Sequence[Run]) -> list[Regressors]:
    """Regressors that say more of the cause: along the command and along what was measured besides."""
    return _joined(runs, [_beside(run) for run in runs])


def _joined(runs: Sequence[Run], found: Sequence[dict[str, list[np.ndarray]]]) -> list[Regressors]:
    kinds = defaultdict[str, list[tuple[np.ndarray, ...]]](list)
    nothing = [np.zeros(len(run.record)) for run in runs]
    for k, own in enumerate(found):
        for name, columns in own.items():
            kinds[name] += [(*nothing[:k], column, *nothing[k + 1 :]) for column in columns]
    # Further columns are called by their titles.
    return [
        Regressors(name, tuple(columns), _SENTENCES.get(name, f"the residual goes with the {name}"))
        for name, columns in kinds.items()
    ]


def _of_run(run: Run, plain_um: np.ndarray) -> dict[str, list[np.ndarray]]:
    record = run.record
    n = len(record)
    time = (record.time_s - record.time_s[0]) / record.duration_s
    place = (plain_um - plain_um.min()) / (float(np.ptp(plain_um)) or 1.0)
    rate = np.gradient(plain_um, record.time_s)
    speed = rate / (np.std(rate) + 1e-300)
    up = np.gradient(record.voltage_V) >= 0
    speeds = speed, np.sign(speed) * np.log1p(np.abs(speed) * 10), np.abs(speed)
    waves = [np.cos(np.pi * k * time) for k in range(1, _WAVES + 1)]
    found = {
        "time": waves,
        "position": [np.cos(np.pi * k * place) * side for side in (up.astype(float), 1.0 - up) for k in range(8)],
        "velocity": [one * np.cos(np.pi * k * place) for one in speeds for k in range(3)],
        "gain": [place * wave for wave in waves],
    }
    direction = np.sign(np.diff(record.voltage_V))
    moves = np.flatnonzero(direction)
    if len(moves) > 1:
        turned = moves[1:][np.diff(direction[moves]) != 0]
        stopped = np.flatnonzero((direction[:-1] != 0) & (direction[1:] == 0)) + 1
        events = np.unique(np.concatenate([[0], turned, stopped]))
        since = record.time_s - record.time_s[events[np.searchsorted(events, np.arange(n), side="right") - 1]]
        age = np.log10(1 + since / (5 * (record.duration_s / n)))
        age = age / max(float(age.max()), 1e-300)
        sign = np.where(up, 1.0, -1.0)
        found["reversal"] = [sign * np.cos(np.pi * k * age) for k in range(1, 5)]
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


def explain(
    projector: Projector, basis: np.ndarray, residual: np.ndarray, groups: Sequence[Regressors]
) -> list[Explained]:
    """Regress a residual on each, beside effects whose tangent `basis` spans."""
    found = []
    for regressors in groups:
        along = _along(projector, basis, regressors).T @ residual
        drop, freedom = float(along @ along), len(along)
        p, z = float(stats.chi2.sf(drop, freedom)), float(standard_deviations(drop, freedom))
        found.append(Explained(regressors, drop, freedom, z, p))
    return found


def explain_together(
    projector: Projector, basis: np.ndarray, residual: np.ndarray, groups: Sequence[Regressors]
) -> tuple[float, int]:
    """Decrease of the sum of squares by all regressors together, and the columns that it takes."""
    columns = tuple(column for regressors in groups for column in regressors.columns)
    (seen,) = explain(projector, basis, residual, [Regressors("together", columns, "")])
    return seen.drop, seen.freedom


def is_flicker(
    projector: Projector,
    basis: np.ndarray,
    residual: np.ndarray,
    groups: Sequence[Regressors],
    thresholds: Thresholds = THRESHOLDS,
) -> bool:
    """Whether flicker noise makes what is left, which then goes with nothing that the rig does.

    What regressors explain of such noise is a weighted sum of squares, whose chance is that of one with the same mean
    and variance (Satterthwaite, Biometrics Bulletin 2 (1946) 110). Along the run noise may wander a little faster.
    """
    parts = projector.split(residual)
    noise, stops = list(map(Flicker.of, parts)), np.cumsum([len(part) for part in parts])
    if min(one.chance(part) for one, part in zip(noise, parts, strict=True)) < _CHANCE:
        return False
    for regressors in groups:
        along = _along(projector, basis, regressors)
        drop = float(np.sum((along.T @ residual) ** 2))
        spread = along[stops[-1] :].T @ along[stops[-1] :]
        for one, each in zip(noise, np.split(along[: stops[-1]], stops[:-1]), strict=True):
            spread = spread + each.T @ one.passed(each)
        mean, square = float(np.trace(spread)), float(np.sum(spread**2))
        chance = stats.chi2.sf(drop * mean / square, mean**2 / square)
        if chance < (thresholds.rest_chance if regressors.name in _ALONG_THE_RUN else _CHANCE):
            return False
    return True


def _along(projector: Projector, basis: np.ndarray, regressors: Regressors) -> np.ndarray:
    """Orthonormal columns that span regressors, off the tangent of a baseline and of effects."""
    joined = projector.off(np.stack([projector.join(column) for column in regressors.columns], axis=1))
    joined -= basis @ (basis.T @ joined)
    scale = np.linalg.norm(joined, axis=0) + 1e-300
    left, size, _ = np.linalg.svd(joined / scale, full_matrices=False)
    return np.asarray(left[:, size > 1e-6 * size[0]])


def repeats_in(projector: Projector, residual: np.ndarray, plain_um: Sequence[np.ndarray]) -> Cycles:
    """The strongest period of a joined residual in the position; see `cycles`."""
    positions = [plain[mask] for mask, plain in zip(projector.masks, plain_um, strict=True)]
    return cycles(projector.split(residual), positions)


def period_of(repeated: Cycles, step_um: float, thresholds: Thresholds = THRESHOLDS) -> float | None:
    """The period, in um, if it is none of chance nor of the rounding of readings to multiples of `step_um`."""
    # Of two waves the second may be that of the rounding.
    off = [abs(repeated.period_um / (waves * step_um) - 1) for waves in (1, 2) if step_um > 0]
    rounding = min(off, default=np.inf) < thresholds.model_error
    return repeated.period_um if repeated.z > thresholds.cycles and not rounding else None


def irregular(
    projector: Projector, residual: np.ndarray, thresholds: Thresholds = THRESHOLDS
) -> tuple[tuple[Test, ...], bool]:
    """Test a residual, whitened and joined, run by run; and say whether it comes in bursts.

    Neighbours are compared with white noise (Ljung and Box), sizes of stretches with one another (Brown and Forsythe)
    and the tails with a normal distribution's (Anscombe and Glynn). The last two are asked of what is new in every
    sample, so that a correlation that was not learnt is not mistaken for them.
    """
    runs = len(projector.masks)
    white, even, tails = np.zeros(runs), np.zeros(runs), np.zeros(runs)
    bursts = False
    for k, part in enumerate(projector.split(residual)):
        if len(part) < _STRETCHES * _FEWEST_IN_STRETCH:
            continue
        part = part - part.mean()
        n, lags = len(part), np.arange(1, _LAGS + 1)
        energy = float(part @ part)
        correlation = np.array([part[lag:] @ part[:-lag] for lag in lags]) / energy
        white[k] = stats.chi2.logsf(n * (n + 2) * np.sum(correlation**2 / (n - lags)), _LAGS)
        new = learn_noise(part, 0.0).whiten(part)[_LAGS:]
        size = np.abs(new)
        pieces = np.array_split(size, _STRETCHES)
        even[k] = stats.f.logsf(stats.f_oneway(*pieces).statistic, _STRETCHES - 1, len(size) - _STRETCHES)
        heavy = float(stats.kurtosis(new))
        tails[k] = stats.norm.logsf(stats.kurtosistest(new).statistic) if heavy > 0 else 0.0
        sizes = np.array([np.sqrt(np.mean(piece**2)) for piece in np.array_split(part, _STRETCHES)])
        spread = float(sizes.std() / sizes.mean())
        bursts |= heavy > thresholds.burst_kurtosis and spread > thresholds.burst_spread
    larger = "the residual is larger in some stretches of a run than in others"
    return (
        Test.of("whiteness", *_evidence(white), 0.0, "neighbouring residuals agree"),
        Test.of("evenness", *_evidence(even), 0.0, larger),
        Test.of("tails", *_evidence(tails), 0.0, "large residuals are more frequent than in normal noise"),
    ), bursts


def _evidence(logs: np.ndarray) -> tuple[float, float]:
    """Evidence of the worst of some runs in standard deviations, and its probability, by logarithms of each."""
    p = float(np.exp(min(float(logs.min()) + float(np.log(len(logs))), 0.0)))
    return float(np.clip(stats.norm.isf(p), 0.0, _LARGEST_Z)) if p > 0 else _LARGEST_Z, p
