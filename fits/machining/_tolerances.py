"""What tolerances stand for: distributions of the dimensions, their moments, and draws from them."""

from typing import Literal

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from fits.io._errors import DataError
from fits.io._jax_setup import require_float64
from fits.machining._design import Design
from fits.machining._gains import check_axes
from microid.kinetostatics import DIMENSIONS, MOTIONS, Axis

Distribution = Literal["normal", "uniform", "triangular"]
# Variance and fourth central moment for a tolerance of one; of a normal distribution it is three standard deviations.
_MOMENTS: dict[Distribution, tuple[float, float]] = {
    "normal": (1 / 9, 1 / 27),
    "uniform": (1 / 3, 1 / 5),
    "triangular": (1 / 6, 1 / 15),
}


def check(design: Design, axes: tuple[Axis, ...], distribution: str) -> None:
    """Refuse unknown axes and distributions, no tolerances at all, and draws that reach a dimension of zero."""
    require_float64("tolerances need")
    if distribution not in _MOMENTS:
        raise DataError(f"there is no distribution {distribution!r}: choose one of {', '.join(_MOMENTS)}")
    check_axes(axes or ("",))
    for axis in axes:
        names = MOTIONS[axis].dimensions
        if not any(design.tolerance[name] > 0 for name in names):
            raise DataError(
                f"{axis} does not spread without tolerances: give one of {', '.join(names)} a positive one"
            )
    # Six standard deviations of a normal distribution.
    reach = 2 if distribution == "normal" else 1
    for name, dimension in DIMENSIONS.items():
        value, tolerance, unit = float(design.geometry[name]), design.tolerance[name], dimension.unit
        if value - reach * tolerance <= 0:
            raise DataError(
                f"{name} of {value:g} {unit} with a tolerance of {tolerance:g} {unit} may come out as zero "
                f"when drawn from a {distribution} distribution: lower the tolerance below {value / reach:g} {unit}"
            )


def check_independent(design: Design, why: str) -> None:
    """Raise a `DataError` with a reason and a remedy if dimensions go together."""
    if design.together:
        names = ", ".join(design.together[0].dimensions)
        raise DataError(f"{names} go together, and {why}, or a design without `together`")


def tolerances(design: Design, names: tuple[str, ...]) -> np.ndarray:
    """Tolerances of dimensions, shape `(k,)`, in mm and rad."""
    return np.array([design.tolerance[name] for name in names])


def covariance(design: Design, names: tuple[str, ...], distribution: Distribution) -> np.ndarray:
    """Covariance of dimensions, shape `(k, k)`, in their units."""
    sd = np.sqrt(_MOMENTS[distribution][0]) * tolerances(design, names)
    return np.asarray(sd[:, None] * design.correlation(names) * sd)


def excess_fourth_moment(distribution: Distribution) -> float:
    """Fourth central moment less that of a normal distribution of the same variance, for a tolerance of one."""
    second, fourth = _MOMENTS[distribution]
    return fourth - 3 * second**2


def from_normal(standard: np.ndarray, distribution: Distribution) -> np.ndarray:
    """Turn standard normal numbers into those of a distribution with a tolerance of one."""
    if distribution == "normal":
        return standard / 3
    # The upper tail from its own probability, which does not lose digits.
    tail = ndtr(-np.abs(standard))
    return np.copysign(1 - (2 * tail if distribution == "uniform" else np.sqrt(2 * tail)), standard)


def copula_root(design: Design, names: tuple[str, ...], distribution: Distribution) -> np.ndarray:
    """Square root of the correlation of the Gaussian copula that gives dimensions their own, shape `(k, k)`."""
    wanted = design.correlation(names)
    copula = np.vectorize(lambda value: _copula(value, distribution), otypes=[float])(wanted)
    # Such a matrix may miss being a correlation by little where those wanted are near the limit.
    values, vectors = np.linalg.eigh(copula)
    root = vectors * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(root / np.linalg.norm(root, axis=1, keepdims=True))


def _copula(correlation: float, distribution: Distribution) -> float:
    """Correlation of normal numbers whose transforms have the one given."""
    if distribution == "normal" or abs(correlation) in (0.0, 1.0):
        return correlation
    node, weight = np.polynomial.hermite_e.hermegauss(80)
    weight = weight / weight.sum()
    first = from_normal(node, distribution)
    variance = weight @ first**2

    def excess(copula: float) -> float:
        second = from_normal(copula * node[:, None] + np.sqrt(1 - copula**2) * node, distribution)
        return float((weight * first) @ second @ weight / variance - correlation)

    return float(brentq(excess, -1.0, 1.0, xtol=1e-12))
