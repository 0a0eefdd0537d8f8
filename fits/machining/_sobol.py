"""Shares of the variance of a gain, globally: Sobol indices, which hold where first order fails."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.special import ndtri

from fits.io._errors import DataError
from fits.machining._design import Design
from fits.machining._gains import gain_model, gains_of_many, inputs_of, once_per_function, twin
from fits.machining._tolerances import Distribution, check, check_independent, from_normal, tolerances
from microid.kinetostatics import AXES, Axis

_FEWEST_SAMPLES, _MOST_SAMPLES = 256, 2**20


@dataclass(frozen=True)
class SobolIndices:
    """What part of the variance of the gain of an axis comes from which of the `k` dimensions that it depends on.

    `first` is the part that a dimension explains by itself, `total` the part that would not be there without it, with
    all its interactions, shape `(k,)`. Confidence intervals, shape `(k, 2)`, are by bootstrap; points that fill the
    space evenly err less than independent ones, so these are on the safe side. So many `evaluations` of a stage it
    took.
    """

    axis: Axis
    names: tuple[str, ...]
    first: np.ndarray
    total: np.ndarray
    first_interval: np.ndarray
    total_interval: np.ndarray
    confidence: float
    evaluations: int


def sobol(
    design: Design,
    samples: int = 2**14,
    distribution: Distribution = "normal",
    *,
    seed: int = 0,
    axes: tuple[Axis, ...] = AXES,
    voltage: bool = False,
    confidence: float = 0.95,
    resamples: int = 400,
) -> dict[Axis, SobolIndices]:
    """Sobol indices of the gains over the tolerances, by the estimators of Saltelli et al. (2010).

    The number of samples is a power of two; each costs two evaluations and one more per dimension. Intervals have the
    confidence given, by a bootstrap of so many resamples; of the other arguments see `monte_carlo`. A `DataError`
    says that dimensions go together, for then the variance has no unique parts; that there is no such axis or
    distribution, that a tolerance is as large as its dimension, or that the number of samples is not a power of two.
    """
    check(design, axes, distribution)
    check_independent(design, "the variance has no unique parts for correlated dimensions: use monte_carlo")
    if samples.bit_count() != 1 or not _FEWEST_SAMPLES <= samples <= _MOST_SAMPLES:
        raise DataError(
            f"the number of samples is a power of two from {_FEWEST_SAMPLES} to {_MOST_SAMPLES}, got {samples}"
        )
    if not 0 < confidence < 1 or resamples < 100:
        raise DataError("intervals need a confidence between 0 and 1 and at least 100 resamples")

    def of_axis(axis: Axis) -> SobolIndices:
        names = inputs_of(axis, voltage)
        model, scale = gain_model(design, voltage), tolerances(design, names)[:, None]

        def gain(points: np.ndarray) -> np.ndarray:
            errors = scale * from_normal(ndtri(points.T), distribution)
            return np.asarray(gains_of_many(model, errors, (twin(axis),), names)[0])

        outputs = outputs_of(gain, len(names), samples, seed)
        found = *indices(*outputs), *intervals(*outputs, confidence, resamples, seed)
        return SobolIndices(axis, names, *found, confidence, samples * (2 + len(names)))

    return once_per_function(axes, of_axis)


def outputs_of(
    function: Callable[[np.ndarray], np.ndarray], count: int, samples: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Evaluate a function of points in the unit cube, shape `(samples, count)`, where the indices need it.

    At two independent sets of points of a scrambled Sobol sequence, and at the first with one coordinate after the
    other taken from the second, shape `(count, samples)`; less the mean of the first two.
    """
    first, second = np.hsplit(stats.qmc.Sobol(2 * count, seed=seed, bits=64).random(samples), 2)
    both = [function(first), function(second)]
    swapped = np.stack([function(np.where(np.arange(count) == i, second, first)) for i in range(count)])
    mean = np.mean(both)
    return both[0] - mean, both[1] - mean, swapped - mean


def indices(first: np.ndarray, second: np.ndarray, swapped: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First-order and total indices, each of shape `(k,)`; see `outputs_of`."""
    outputs = {"f_A": first[None], "f_B": second[None], "f_AB": swapped[:, None]}
    found = stats.sobol_indices(func=outputs, n=len(first))
    return np.ravel(found.first_order), np.ravel(found.total_order)


def intervals(
    first: np.ndarray, second: np.ndarray, swapped: np.ndarray, confidence: float, resamples: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Bootstrap percentiles of the same indices, each of shape `(k, 2)`."""
    # SciPy's own bootstrap holds all resamples and a jackknife in memory, GBs of it. The sums in the indices are
    # linear in the samples, so that here a resample is a row of weights.
    rng = np.random.default_rng(seed)
    samples, count = len(first), len(swapped)
    parts = [first + second, first**2 + second**2, *(second * (swapped - first)), *((first - swapped) ** 2)]
    columns = np.stack(parts, axis=1) / (2 * samples)
    sums = np.stack(
        [np.bincount(rng.integers(samples, size=samples), minlength=samples) @ columns for _ in range(resamples)]
    )
    variance = (sums[:, 1] - sums[:, 0] ** 2)[:, None]
    ends = [(1 - confidence) / 2, (1 + confidence) / 2]
    main, total = 2 * sums[:, 2 : 2 + count] / variance, sums[:, 2 + count :] / variance
    return np.quantile(main, ends, axis=0).T, np.quantile(total, ends, axis=0).T
