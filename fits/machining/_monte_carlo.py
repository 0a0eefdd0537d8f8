"""Spread of the gains when dimensions are drawn within their tolerances."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import brentq
from scipy.special import ndtr

from fits.io._errors import DataError
from fits.machining._design import Design
from fits.machining._second_order import (
    Distribution,
    SecondOrder,
    check,
    covariance,
    first_order,
    gain_at,
    inputs_of,
    nominal,
    second_order,
    setting,
    tolerances,
    twin,
)
from microid import AXES, MOTIONS, Axis, Constants, Geometry

# One compiled function serves all calls; the last piece is filled up.
_CHUNK = 65536
_QUANTILES_PCT = (0.135, 2.5, 50.0, 97.5, 99.865)
_FEWEST, _MOST = 1000, 30_000_000
# First order counts as right within this, and this many standard errors.
_AGREE, _STANDARD_ERRORS = 0.02, 3.0
_NODES = 80


@dataclass(frozen=True)
class AxisSpread:
    """How the gain of an axis spreads, in its unit.

    Attributes
    ----------
    axis, unit
        Which, and the unit of its gain: `um/um` or `rad/um`; per um of free elongation with an imposed voltage.
    nominal
        Gain at the nominal dimensions.
    mean, sd, skewness
        Of the draws.
    sd_error
        Standard error of `sd`, from the fourth moment.
    quantiles
        By percentage: 0.135, 2.5, 50, 97.5 and 99.865.
    first_order_sd
        Standard deviation from the gradient.
    second
        The expansion to second order where `flagged`, else `None`.
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
        return abs(sd - self.sd) <= _AGREE * self.sd + _STANDARD_ERRORS * self.sd_error


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

    Parameters
    ----------
    design
        Dimensions, tolerances and which of them go together. The correlation of those is that of the dimensions,
        whatever their distribution: a Gaussian copula joins them, and each keeps its own distribution.
    samples
        Number of stages drawn.
    distribution
        Of each dimension: `normal` with the tolerance as three standard deviations; `uniform` or `triangular` over
        the tolerance.
    seed
        Of the draws.
    axes
        Some of `AXES`.
    voltage
        Impose the voltage of the piezos instead of their elongation.
    progress
        Called with a sentence now and then.

    Raises
    ------
    DataError
        If there is no such axis or distribution, a tolerance is as large as its dimension, or the number of samples
        is not between 1000 and 30 million.
    """
    check(design, axes, distribution)
    if not _FEWEST <= samples <= _MOST:
        raise DataError(f"between {_FEWEST:,} and {_MOST:,} samples are needed, got {samples:,}")
    # x and y are one function of the same dimensions, and so are alpha and beta.
    different = tuple(dict.fromkeys(twin(axis) for axis in axes))
    names = tuple(dict.fromkeys(name for axis in different for name in inputs_of(axis, voltage)))
    gains = _drawn(design, different, names, samples, distribution, seed, voltage, progress)
    progress("summing up")
    spreads = {
        axis: _spread(values, design, axis, distribution, voltage)
        for axis, values in zip(different, gains, strict=True)
    }
    return MonteCarlo(
        {axis: _named(spreads[twin(axis)], axis) for axis in axes},
        samples,
        distribution,
        seed,
        voltage,
    )


def _drawn(
    design: Design,
    axes: tuple[Axis, ...],
    names: tuple[str, ...],
    samples: int,
    distribution: Distribution,
    seed: int,
    voltage: bool,
    progress: Callable[[str], None],
) -> np.ndarray:
    """Gains of the axes, shape `(axes, samples)`."""
    rng = np.random.Generator(np.random.SFC64(seed))
    together = mixing(design, names, distribution)
    scale = tolerances(design, names)
    start, step = {"normal": (0.0, 1 / 3), "uniform": (-1.0, 2.0), "triangular": (-1.0, 1.0)}[distribution]
    offset, slope = nominal(design, names) + start * scale, jnp.asarray(step * scale)
    fixed = setting(design, voltage)
    gains = np.empty((len(axes), samples))
    pending: tuple[int, Array] | None = None
    for begin in range(0, samples, _CHUNK):
        draws = draw(rng, distribution, together, len(names), _CHUNK)
        # Computed while the next are drawn.
        coming = (begin, gains_of(jnp.asarray(draws), offset, slope, axes, names, *fixed))
        if pending is not None:
            _store(gains, *pending)
        if begin * 10 // samples != (begin + _CHUNK) * 10 // samples:
            progress(f"{min(samples, begin + _CHUNK):,} of {samples:,} samples")
        pending = coming
    if pending is not None:
        _store(gains, *pending)
    if not np.isfinite(gains).all():
        raise DataError("some of the stages drawn cannot be built: lower the tolerances")
    return gains


def _store(gains: np.ndarray, begin: int, found: Array) -> None:
    part = gains[:, begin : begin + _CHUNK]
    part[:] = np.asarray(found)[:, : part.shape[1]]


@eqx.filter_jit
def gains_of(
    draws: Float[Array, "k n"],
    offset: Float[Array, " k"],
    slope: Float[Array, " k"],
    axes: tuple[Axis, ...],
    names: tuple[str, ...],
    geometry: Geometry,
    constants: Constants,
    piezo_N_per_um: Float[Array, ""] | None,
) -> Float[Array, "axes n"]:
    """Gains of some axes for many stages, whose dimensions are `offset + slope * draws`."""

    def one(draw: Array) -> Array:
        values = offset + slope * draw
        return jnp.stack([gain_at(values, axis, names, geometry, constants, piezo_N_per_um) for axis in axes])

    return jax.vmap(one, in_axes=1, out_axes=1)(draws)


def draw(
    rng: np.random.Generator,
    distribution: Distribution,
    together: tuple[list[int], np.ndarray],
    count: int,
    samples: int,
) -> np.ndarray:
    """Draws of standard normal numbers, uniform ones in [0, 1], or triangular ones in [0, 2].

    Parameters
    ----------
    rng
        Where they come from.
    distribution
        Which.
    together
        See `mixing`.
    count, samples
        Numbers of dimensions and of stages.

    Returns
    -------
    ndarray
        Shape `(count, samples)`.
    """
    if distribution == "normal":
        draws = rng.standard_normal((count, samples))
    else:
        draws = rng.random((count, samples))
        if distribution == "triangular":
            draws += rng.random((count, samples))
    rows, mix = together
    if rows:
        draws[rows] = _quantile(mix @ rng.standard_normal((len(rows), samples)), distribution)
    return draws


def _quantile(standard: np.ndarray, distribution: Distribution) -> np.ndarray:
    """Turn standard normal numbers into those of `draw`."""
    if distribution == "normal":
        return standard
    chance = ndtr(standard)
    if distribution == "uniform":
        return np.asarray(chance)
    # The tail on the upper side from its own probability, which does not lose digits.
    half = np.sqrt(2 * np.minimum(chance, ndtr(-standard)))
    return np.where(standard < 0, half, 2 - half)


def mixing(design: Design, names: tuple[str, ...], distribution: Distribution) -> tuple[list[int], np.ndarray]:
    """Rows that do not stand alone, and the matrix that makes independent normal numbers into correlated ones."""
    wanted = design.correlation(names)
    rows = np.flatnonzero((wanted != np.eye(len(names))).any(axis=1))
    block = wanted[np.ix_(rows, rows)]
    copula = np.vectorize(lambda value: _copula(value, distribution), otypes=[float])(block)
    # A matrix of normal numbers' correlations may miss being one by little where those wanted are near the limit.
    values, vectors = np.linalg.eigh(copula)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return rows.tolist(), root / np.linalg.norm(root, axis=1, keepdims=True)


def _copula(correlation: float, distribution: Distribution) -> float:
    """Correlation of normal numbers whose transforms have the one given."""
    if distribution == "normal" or abs(correlation) in (0.0, 1.0):
        return correlation
    node, weight = np.polynomial.hermite_e.hermegauss(_NODES)
    weight = weight / weight.sum()
    first = _quantile(node, distribution)
    first = first - weight @ first
    variance = weight @ first**2

    def excess(copula: float) -> float:
        second = _quantile(copula * node[:, None] + np.sqrt(1 - copula**2) * node, distribution)
        return float((weight * first) @ second @ weight / variance - correlation)

    return float(brentq(excess, -1.0, 1.0, xtol=1e-12))


def _spread(values: np.ndarray, design: Design, axis: Axis, distribution: Distribution, voltage: bool) -> AxisSpread:
    """Statistics of the values, which are used up."""
    names = inputs_of(axis, voltage)
    value, slopes = first_order(nominal(design, names), axis, names, *setting(design, voltage))
    gradient = np.asarray(slopes)
    first = float(np.sqrt(gradient @ covariance(design, names, distribution) @ gradient))
    # Sorting takes less time than finding five of the samples by partition does.
    values.sort()
    place = np.array(_QUANTILES_PCT) / 100 * (len(values) - 1)
    quantiles = np.interp(place, np.arange(len(values)), values)
    mean = float(np.mean(values))
    values -= mean
    squares = values * values
    variance = float(np.mean(squares))
    kurtosis = float(squares @ squares) / len(values) / variance**2
    sd = float(np.sqrt(variance * len(values) / (len(values) - 1)))
    spread = AxisSpread(
        axis,
        f"{MOTIONS[axis].unit}/um",
        float(value),
        mean,
        sd,
        float(squares @ values) / len(values) / variance**1.5,
        sd * float(np.sqrt((kurtosis - 1) / (4 * len(values)))),
        dict(zip(_QUANTILES_PCT, quantiles.tolist(), strict=True)),
        first,
        None,
    )
    if not spread.flagged:
        return spread
    return replace(spread, second=second_order(design, axis, distribution, voltage=voltage))


def _named(spread: AxisSpread, axis: Axis) -> AxisSpread:
    """The same spread under the name of the axis, which may be the twin of the one computed."""
    second = None if spread.second is None else replace(spread.second, axis=axis)
    return replace(spread, axis=axis, second=second)
