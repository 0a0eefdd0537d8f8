"""Whether what is left is noise: white, alike in all stretches, and without large values more often than chance."""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from fits.diagnosis._projector import Projector
from fits.stats._whiten import learn_noise

# Lags of neighbours, stretches of a run, and samples that a stretch needs at least.
_LAGS, _STRETCHES, _FEWEST = 20, 24, 20
# Bursts: so much more spread of the stretches' sizes than chance, about their mean, and so heavy tails of what is new
# in every sample (excess kurtosis).
_SPREAD, _HEAVY = 0.4, 1.5
# Evidence is counted up to so many standard deviations.
_MOST = 37.0


@dataclass(frozen=True)
class Irregular:
    """One way in which what is left is not noise.

    Attributes
    ----------
    name, sentence
        What it is.
    z, p
        Evidence in standard deviations, and the probability of as much by chance, of the worst run.
    """

    name: str
    sentence: str
    z: float
    p: float


def irregular(projector: Projector, residual: np.ndarray) -> tuple[tuple[Irregular, ...], bool]:
    """Test a residual, whitened and joined, run by run; and say whether it comes in bursts.

    Neighbours are compared with white noise (Ljung and Box), sizes of stretches with one another (Brown and Forsythe)
    and the tails with a normal distribution's (Anscombe and Glynn). The last two are asked of what is new in every
    sample, so that a correlation that was not learnt is not mistaken for them.
    """
    runs = len(projector.masks)
    white, even, tails = np.zeros(runs), np.zeros(runs), np.zeros(runs)
    bursts = False
    for k, part in enumerate(projector.split(residual)):
        if len(part) < _STRETCHES * _FEWEST:
            continue
        part = part - part.mean()
        n, lags = len(part), np.arange(1, _LAGS + 1)
        energy = float(part @ part)
        correlation = np.array([part[lag:] @ part[:-lag] for lag in lags]) / energy
        white[k] = stats.chi2.logsf(n * (n + 2) * np.sum(correlation**2 / (n - lags)), _LAGS)
        new = learn_noise(part, 0.0).whiten(part)[_LAGS:]
        size = np.abs(new)
        pieces = np.array_split(size, _STRETCHES)
        means = np.array([piece.mean() for piece in pieces])
        within = sum(float(np.sum((piece - mean) ** 2)) for piece, mean in zip(pieces, means, strict=True))
        between = sum(len(piece) * (mean - size.mean()) ** 2 for piece, mean in zip(pieces, means, strict=True))
        freedom = _STRETCHES - 1, len(size) - _STRETCHES
        even[k] = stats.f.logsf(between / freedom[0] / (within / freedom[1]), *freedom)
        heavy = float(stats.kurtosis(new))
        tails[k] = stats.norm.logsf(stats.kurtosistest(new).statistic) if heavy > 0 else 0.0
        stretches = np.array([np.sqrt(np.mean(piece**2)) for piece in np.array_split(part, _STRETCHES)])
        bursts |= bool(heavy > _HEAVY and stretches.std() > _SPREAD * stretches.mean())
    asked = (
        ("whiteness", "neighbouring residuals agree", white),
        ("evenness", "the residual is larger in some stretches of a run than in others", even),
        ("tails", "large residuals are more frequent than in normal noise", tails),
    )
    return tuple(Irregular(name, words, *_evidence(float(logs.min()), runs)) for name, words, logs in asked), bursts


def _evidence(log_p: float, runs: int) -> tuple[float, float]:
    """Evidence in standard deviations, and probability, where the worst of some runs was taken."""
    log_p = min(log_p + float(np.log(runs)), 0.0)
    p = float(np.exp(log_p))
    return float(np.clip(stats.norm.isf(p), 0.0, _MOST)) if p > 0 else _MOST, p
