"""How the gains spread with dimensions within their tolerances: drawn, and expanded to second order."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fits.io._errors import DataError
from fits.machining._design import Design
from fits.machining._gains import gain_model, gains_of_many, gradient, hessian, inputs_of, once_per_function, twin
from fits.machining._tolerances import (
    Distribution,
    check,
    copula_root,
    covariance,
    excess_fourth_moment,
    from_normal,
    tolerances,
)
from microid.kinetostatics import AXES, MOTIONS, Axis

# One compiled function serves all calls; the last piece is filled up.
_CHUNK = 65536
_QUANTILES_PCT = (0.135, 2.5, 50.0, 97.5, 99.865)
_FEWEST_SAMPLES, _MOST_SAMPLES = 1000, 30_000_000


@dataclass(frozen=True)
class SecondOrder:
    """Spread of the gain of an axis as a quadratic function of the errors of the `k` dimensions that it depends on.

    The unit of the gain is `um/um` or `rad/um`; per um of free elongation with `voltage`. It is that at the nominal
    dimensions, with its derivatives per mm or rad, `gradient` of shape `(k,)` and `hessian` of `(k, k)`. The standard
    deviation of first order is from the gradient alone; the mean is shifted against the gain at the nominal
    dimensions. `pairs` is what each pair adds to the variance at second order, shape `(k, k)`; the sum of all counts,
    and two equal halves of a pair stand at either side of the diagonal.
    """

    axis: Axis
    unit: str
    distribution: Distribution
    voltage: bool
    names: tuple[str, ...]
    gain: float
    gradient: np.ndarray
    hessian: np.ndarray
    first_order_sd: float
    mean_shift: float
    pairs: np.ndarray

    @property
    def sd(self) -> float:
        """Standard deviation at second order, in the unit of the gain."""
        return float(np.sqrt(max(0.0, self.first_order_sd**2 + self.pairs.sum())))

    @property
    def second_order_share(self) -> float:
        """Part of the variance that the gradient does not give."""
        return float(self.pairs.sum() / (self.first_order_sd**2 + self.pairs.sum()))


def second_order(
    design: Design, axis: Axis, distribution: Distribution = "normal", *, voltage: bool = False
) -> SecondOrder:
    r"""Expand the gain of an axis to second order in the dimensions' errors; see `monte_carlo` for the arguments.

    With the covariance :math:`\Sigma`, gradient g and Hessian H, the mean shifts by :math:`\tfrac12 \mathrm{tr} H
    \Sigma` and the variance is

    .. math::

        g^T \Sigma g + \tfrac12 \mathrm{tr} H \Sigma H \Sigma + \tfrac14 \sum_i H_{ii}^2 (\mu_{4i} - 3 \sigma_i^4)

    for independent dimensions of any symmetric distribution with fourth moments :math:`\mu_4`, and for correlated
    normal ones. Correlated dimensions that are not normal have joint fourth moments that this leaves out. Third
    derivatives add to the variance at the same power of the tolerances unless the gradient vanishes; they are left
    out, too. A `DataError` says that there is no such axis or distribution, or a tolerance as large as its dimension.
    """
    check(design, (axis,), distribution)
    names = inputs_of(axis, voltage)
    at = gain_model(design, voltage), twin(axis), names
    value, slopes, bends = (np.asarray(found) for found in (*gradient(*at), hessian(*at)))
    sigma = covariance(design, names, distribution)
    bent = bends @ sigma
    tails = np.diag(bends) ** 2 * excess_fourth_moment(distribution) * tolerances(design, names) ** 4 / 4
    first_order_sd, mean_shift = float(np.sqrt(slopes @ sigma @ slopes)), float(np.trace(bent) / 2)
    pairs, unit = bent * bent.T / 2 + np.diag(tails), f"{MOTIONS[axis].unit}/um"
    at_nominal = float(value), slopes, bends
    return SecondOrder(axis, unit, distribution, voltage, names, *at_nominal, first_order_sd, mean_shift, pairs)


@dataclass(frozen=True)
class AxisSpread:
    """How the gain of an axis spreads, in um/um or rad/um; per um of free elongation with a fixed voltage.

    After the gain at the nominal dimensions come statistics of the draws: `mean`; standard deviation `sd` with its
    standard error, from the fourth moment; `skewness`, without a unit; and quantiles by percentage: 0.135, 2.5, 50,
    97.5 and 99.865. The standard deviation of first order is from the gradient, and the expansion to second order is
    there where `flagged`, else `None`.
    """

    axis: Axis
    unit: str
    nominal: float
    mean: float
    sd: float
    skewness: float
    sd_error: float
    quantiles: dict[float, float]
    first_order_sd: float
    second: SecondOrder | None

    @property
    def relative_sd_pct(self) -> float:
        """Standard deviation in percent of the nominal gain."""
        return 100 * self.sd / abs(self.nominal)

    @property
    def flagged(self) -> bool:
        """Whether the first order is off by more than 2 % and three standard errors."""
        return not self.agrees(self.first_order_sd)

    @property
    def explained(self) -> bool:
        """Whether the first order agrees, or else the second."""
        return self.second is None or self.agrees(self.second.sd)

    def agrees(self, sd: float) -> bool:
        """Whether a standard deviation is within 2 % and three standard errors of that of the draws."""
        return abs(sd - self.sd) <= 0.02 * self.sd + 3 * self.sd_error


@dataclass(frozen=True)
class MonteCarlo:
    """Spreads of all axes asked for, and how they were drawn."""

    axes: dict[Axis, AxisSpread]
    samples: int
    distribution: Distribution
    seed: int
    voltage: bool


def monte_carlo(
    design: Design,
    samples: int = 1_000_000,
    distribution: Distribution = "normal",
    *,
    seed: int = 0,
    axes: tuple[Axis, ...] = AXES,
    voltage: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> MonteCarlo:
    """Draw the dimensions within their tolerances and evaluate the gains.

    Each dimension is `normal`, with the tolerance as three standard deviations, or `uniform` or `triangular` over the
    tolerance. The correlation of those that go together is that of the dimensions, whatever their distribution: a
    Gaussian copula joins them, and each keeps its own distribution. From 1000 to 30 million stages are drawn, by the
    seed; with `voltage` the voltage of the piezos is imposed instead of their elongation. `progress` is called with a
    sentence now and then.

    A `DataError` says that there is no such axis or distribution, that a tolerance is as large as its dimension, or
    that the number of samples is out of bounds.
    """
    check(design, axes, distribution)
    if not _FEWEST_SAMPLES <= samples <= _MOST_SAMPLES:
        raise DataError(f"between {_FEWEST_SAMPLES:,} and {_MOST_SAMPLES:,} samples are needed, got {samples:,}")
    different = tuple(dict.fromkeys(twin(axis) for axis in axes))
    names = tuple(dict.fromkeys(name for axis in different for name in inputs_of(axis, voltage)))
    model, scale = gain_model(design, voltage), tolerances(design, names)[:, None]
    root = copula_root(design, names, distribution)
    rng = np.random.Generator(np.random.SFC64(seed))
    gains, coming = np.empty((len(different), samples)), None
    for begin in range(0, samples, _CHUNK):
        standard = rng.standard_normal((len(names), _CHUNK))
        errors = scale * from_normal(root @ standard if design.together else standard, distribution)
        # Computed while the next are drawn.
        before, coming = coming, gains_of_many(model, errors, different, names)
        if begin:
            gains[:, begin - _CHUNK : begin] = before
        if begin * 10 // samples != (begin + _CHUNK) * 10 // samples:
            progress(f"{min(samples, begin + _CHUNK):,} of {samples:,} samples")
    gains[:, begin:] = np.asarray(coming)[:, : samples - begin]
    if not np.isfinite(gains).all():
        raise DataError("some of the stages drawn cannot be built: lower the tolerances")
    progress("summing up")
    gains_of = dict(zip(different, gains, strict=True))
    spreads = once_per_function(axes, lambda axis: _spread(gains_of[twin(axis)], design, axis, distribution, voltage))
    for axis, spread in spreads.items():
        if spread.flagged:
            spreads[axis] = replace(spread, second=second_order(design, axis, distribution, voltage=voltage))
    return MonteCarlo(spreads, samples, distribution, seed, voltage)


def _spread(values: np.ndarray, design: Design, axis: Axis, distribution: Distribution, voltage: bool) -> AxisSpread:
    """Statistics of the gains of one axis, shape `(samples,)`."""
    names = inputs_of(axis, voltage)
    value, slopes = (np.asarray(found) for found in gradient(gain_model(design, voltage), twin(axis), names))
    # Sorting takes less time than finding five of the samples by partition does.
    quantiles = np.quantile(np.sort(values), np.array(_QUANTILES_PCT) / 100)
    mean, sd = float(values.mean()), float(values.std(ddof=1))
    off = (values - mean) / sd
    squares = off * off
    kurtosis = float(squares @ squares) / len(off)
    skewness = float(squares @ off) / len(off)
    sd_error = sd * float(np.sqrt((kurtosis - 1) / (4 * len(values))))
    first_order_sd = float(np.sqrt(slopes @ covariance(design, names, distribution) @ slopes))
    by_pct, unit = dict(zip(_QUANTILES_PCT, quantiles.tolist(), strict=True)), f"{MOTIONS[axis].unit}/um"
    return AxisSpread(axis, unit, float(value), mean, sd, skewness, sd_error, by_pct, first_order_sd, None)
