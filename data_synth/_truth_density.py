"""True Preisach densities, made of shapes that no tidy class of fitted densities contains, and what is reversible."""

import functools
import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from data_synth._types import FloatArray

Family: TypeAlias = Literal["exponential", "gaussian", "lorentzian", "gamma"]


@dataclass(frozen=True)
class Ridge:
    """A ridge along the diagonal of the plane of switching values.

    In dimensionless coordinates: the bias `x = (alpha + beta) / range` from -1 to 1, counted from the middle, and the
    coercivity `c = (alpha - beta) / range` from 0 to 1. The height is `exp(skew x + bend x^2) f(c / d(x))` with the
    local width `d(x) = width exp(slope x)`.

    Attributes
    ----------
    family
        The profile f across the ridge.
    width, slope
        How wide the ridge is at the middle, and how the logarithm of the width changes along it.
    skew, bend
        How the logarithm of the height changes along it.
    """

    family: Family
    width: float
    slope: float
    skew: float
    bend: float

    def __call__(self, bias: FloatArray, coercivity: FloatArray) -> FloatArray:
        """Height at dimensionless coordinates that broadcast together."""
        s = coercivity / (self.width * np.exp(self.slope * bias))
        if self.family == "exponential":
            profile = np.exp(-s)
        elif self.family == "gaussian":
            profile = np.exp(-(s**2) / 2)
        elif self.family == "lorentzian":
            profile = 1 / (1 + s**2)
        else:  # a gamma law that is not quite zero on the diagonal
            profile = (0.2 + s) * np.exp(-1.5 * s)
        return np.exp(self.skew * bias + self.bend * bias**2) * profile


@dataclass(frozen=True)
class Bump:
    """A broad background: a Gaussian hill at a bias and coercivity, with a spread in each, all dimensionless."""

    bias: float
    coercivity: float
    bias_spread: float
    coercivity_spread: float

    def __call__(self, bias: FloatArray, coercivity: FloatArray) -> FloatArray:
        """Height at dimensionless coordinates that broadcast together."""
        x = (bias - self.bias) / self.bias_spread
        c = (coercivity - self.coercivity) / self.coercivity_spread
        return np.exp(-(x**2 + c**2) / 2)


Shape: TypeAlias = Ridge | Bump


@dataclass(frozen=True)
class Density:
    """Displacement per area of the plane of switching values, in um / V^2: a positive sum of smooth shapes.

    Attributes
    ----------
    lower_V, upper_V
        The range of the voltage, in V: the density lives where `lower_V <= beta <= alpha <= upper_V`.
    shapes, heights_um_per_V2
        The shapes, and the factor in front of each, in um / V^2.
    """

    lower_V: float
    upper_V: float
    shapes: tuple[Shape, ...]
    heights_um_per_V2: tuple[float, ...]

    @classmethod
    def from_shares(
        cls, shapes: tuple[Shape, ...], shares: tuple[float, ...], mass_um: float, lower_V: float, upper_V: float
    ) -> "Density":
        """Scale the shapes so that their integrals (um) stand in the ratio of `shares` and add up to `mass_um`."""
        total = sum(shares)
        heights = tuple(
            mass_um * share / total / (_integral(shape) * (upper_V - lower_V) ** 2 / 2)
            for shape, share in zip(shapes, shares, strict=True)
        )
        return cls(lower_V, upper_V, shapes, heights)

    def __call__(self, alpha_V: ArrayLike, beta_V: ArrayLike) -> FloatArray:
        """Density (um / V^2) at switching values (V) that broadcast together; `alpha_V >= beta_V` is not checked."""
        alpha, beta = np.asarray(alpha_V, dtype=float), np.asarray(beta_V, dtype=float)
        range_V = self.upper_V - self.lower_V
        bias = (alpha + beta - self.lower_V - self.upper_V) / range_V
        coercivity = (alpha - beta) / range_V
        density = np.zeros(np.broadcast_shapes(alpha.shape, beta.shape))
        for shape, height_um_per_V2 in zip(self.shapes, self.heights_um_per_V2, strict=True):
            density += height_um_per_V2 * shape(bias, coercivity)
        return density

    def loop_gap_um(self, voltage_V: float) -> float:
        """The gap of the major loop at a voltage (V), in um.

        It is the integral over `alpha > voltage > beta`: those relays are on while the voltage falls and off while it
        rises. Gauss-Legendre quadrature, whose nodes crowd in the corner where the ridge is.
        """
        nodes, weights = _gauss_legendre()
        above_V, below_V = self.upper_V - voltage_V, voltage_V - self.lower_V
        alpha_V = voltage_V + above_V * (nodes + 1) / 2
        beta_V = self.lower_V + below_V * (nodes + 1) / 2
        return float(weights @ self(alpha_V[:, None], beta_V) @ weights) * above_V * below_V / 4


@functools.cache
def _gauss_legendre() -> tuple[FloatArray, FloatArray]:
    nodes, weights = np.polynomial.legendre.leggauss(40)
    return nodes, weights


def _integral(shape: Shape) -> float:
    """Integral of a shape over the triangle `0 <= coercivity <= 1 - |bias|` of its dimensionless coordinates."""
    nodes, weights = _gauss_legendre()
    coercivity = (nodes + 1) / 2
    reach = 1 - coercivity
    values = shape(reach[:, None] * nodes, coercivity[:, None])
    return float((weights / 2 * reach) @ values @ weights)


@dataclass(frozen=True)
class Reversible:
    """The part of the displacement without memory: a smooth curve that rises with the voltage.

    With `x` from 0 at `lower_V` to 1 at `upper_V` it is `x + quadratic x^2 + step tanh(steepness (x - centre))`,
    shifted and scaled to go from 0 to `stroke_um`.
    """

    lower_V: float
    upper_V: float
    stroke_um: float
    quadratic: float
    step: float
    steepness: float
    centre: float

    def __call__(self, voltage_V: FloatArray) -> FloatArray:
        """Displacement (um) at voltages (V) of any shape."""
        x = (voltage_V - self.lower_V) / (self.upper_V - self.lower_V)
        bottom = self.step * math.tanh(-self.steepness * self.centre)
        top = 1 + self.quadratic + self.step * math.tanh(self.steepness * (1 - self.centre))
        curve = x + self.quadratic * x**2 + self.step * np.tanh(self.steepness * (x - self.centre))
        return self.stroke_um * (curve - bottom) / (top - bottom)
