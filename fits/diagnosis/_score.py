"""Score tests: how much of what the baseline leaves lies along each effect that it lacks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from fits.diagnosis._candidates import Probe
from fits.diagnosis._projector import Projector

_DRAWS = 2000
# Share of a signature that must be left for the records to show it at all.
_BLIND = 0.003


@dataclass(frozen=True)
class Scored:
    """One probe, asked.

    Attributes
    ----------
    probe
        What was asked about.
    columns
        Its signatures off the baseline's tangent, whitened and joined, shape `(rows, k)`.
    z
        Evidence, in standard deviations.
    coefficients
        Best multiples of the signatures, shape `(k,)`.
    drop
        Decrease of the sum of squares, in noise variances.
    share_left
        Norm of the projected signatures over that of the raw ones.
    """

    probe: Probe
    columns: np.ndarray
    z: float
    coefficients: np.ndarray
    drop: float
    share_left: float

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.probe.name


def score(projector: Projector, probe: Probe, residual: np.ndarray) -> Scored:
    """Ask about one probe; `residual` is joined and off the tangent already."""
    joined = np.stack([projector.join(column) for column in probe.signatures], axis=1)
    raw = np.linalg.norm(joined)
    columns = projector.off(joined)
    z, coefficients, drop = evidence(columns, residual, probe.positive)
    left = float(np.linalg.norm(columns) / raw) if raw > 0 else 0.0
    if left < _BLIND:
        # What the baseline follows but for rounding cannot be asked about.
        return Scored(probe, np.zeros_like(columns), 0.0, np.zeros_like(coefficients), 0.0, left)
    return Scored(probe, columns, z, coefficients, drop, left)


def rescore(scored: Scored, basis: np.ndarray, residual: np.ndarray) -> Scored:
    """Ask again beside effects that are fitted already; `basis` spans their tangent, off the baseline's."""
    columns = scored.columns - basis @ (basis.T @ scored.columns)
    z, coefficients, drop = evidence(columns, residual, scored.probe.positive)
    raw = np.linalg.norm(scored.columns) / max(scored.share_left, 1e-300)
    left = float(np.linalg.norm(columns) / raw) if raw > 0 else 0.0
    return Scored(scored.probe, columns, z, coefficients, drop, left)


def evidence(columns: np.ndarray, residual: np.ndarray, positive: bool) -> tuple[float, np.ndarray, float]:
    """Standard deviations, coefficients, and decrease of the sum of squares."""
    gram, cross = columns.T @ columns, columns.T @ residual
    return _evidence(gram, cross, positive)


def _evidence(gram: np.ndarray, cross: np.ndarray, positive: bool) -> tuple[float, np.ndarray, float]:
    k = len(cross)
    scale = np.sqrt(np.diagonal(gram)) + 1e-300
    normal = gram / scale[:, None] / scale[None, :]
    coefficients = np.linalg.pinv(normal, rcond=1e-10, hermitian=True) @ (cross / scale) / scale
    if positive and k == 1 and coefficients[0] < 0:
        return 0.0, np.zeros(1), 0.0
    drop = float(coefficients @ cross)
    return max(drop - (k - 1), 0.0) ** 0.5, coefficients, drop


class Family:
    """The largest evidence of all probes, where there is no effect: by simulation."""

    def __init__(self, scored: Sequence[Scored], rng: np.random.Generator):
        columns = np.concatenate([one.columns for one in scored], axis=1)
        scale = np.linalg.norm(columns, axis=0) + 1e-300
        columns = columns / scale
        gram = columns.T @ columns
        value, vector = np.linalg.eigh(gram)
        factor = vector * np.sqrt(np.maximum(value, 0))
        draws = factor @ rng.standard_normal((len(value), _DRAWS))
        at, largest = 0, np.zeros(_DRAWS)
        self.tests = 0
        for one in scored:
            stop = at + one.columns.shape[1]
            own, cross = gram[at:stop, at:stop], draws[at:stop]
            k = stop - at
            if k == 1:
                z = cross[0] if one.probe.positive else np.abs(cross[0])
            else:
                drop = np.einsum("ij,ij->j", cross, np.linalg.pinv(own, rcond=1e-10, hermitian=True) @ cross)
                z = np.sqrt(np.maximum(drop - (k - 1), 0))
            largest = np.maximum(largest, z)
            at = stop
        self.largest = np.sort(largest)

    def p(self, z: float) -> float:
        """Probability that chance alone gives any effect as much evidence."""
        above = float(np.mean(self.largest >= z))
        if above * _DRAWS >= 20:
            return above
        # Beyond what was drawn, the tail of as many independent tests as agree where it was.
        edge = float(self.largest[-20])
        tests = 20 / _DRAWS / (2 * stats.norm.sf(edge))
        return float(min(1.0, tests * 2 * stats.norm.sf(z)))
