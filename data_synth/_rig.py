"""A rig: one stage on the virtual bench, with its hysteresis drawn at random."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from scipy.optimize import brentq

from data_synth._plays import PlayShape, PlaySum
from data_synth._relays import RelayGrid
from data_synth._truth_density import Bump, Density, Family, Reversible, Ridge, Shape
from data_synth._types import Hysteresis

Kind: TypeAlias = Literal["relays", "plays"]

# The widest gap of the major loop over the irreversible stroke: every family of shapes can be made to have these.
_LOWEST_RATIO, _HIGHEST_RATIO = 0.18, 0.42


@dataclass(frozen=True)
class Rig:
    """One stage, exactly as it is.

    Attributes
    ----------
    kind
        Whether its hysteresis is a sum of relays or of plays.
    lower_V, upper_V
        The range of the voltage, in V.
    stroke_um
        The displacement from `lower_V` to `upper_V`, in um.
    reversible_share
        The part of the stroke that has no memory.
    loop_width
        The widest gap of the major loop over the stroke (the paper's Eq. 34).
    relays
        N, the number of relays along one side of their grid; not used by plays.
    reversible, irreversible
        The two parts whose sum is the displacement.
    """

    kind: Kind
    lower_V: float
    upper_V: float
    stroke_um: float
    reversible_share: float
    loop_width: float
    relays: int
    reversible: Reversible
    irreversible: Density | PlayShape

    def hysteresis(self) -> Hysteresis:
        """Make the operator of the irreversible part, in negative saturation."""
        if isinstance(self.irreversible, PlayShape):
            return PlaySum(self.irreversible)
        return RelayGrid(self.irreversible, self.relays)


def random_rig(
    rng: np.random.Generator,
    *,
    kind: Kind | None = None,
    lower_V: float = 0.0,
    upper_V: float = 120.0,
    stroke_um: float | None = None,
    reversible_share: float | None = None,
    loop_width: float | None = None,
    relays: int = 2000,
    plays: int = 400,
    roughness: float = 1.0,
) -> Rig:
    """Draw a rig. What is None is drawn too.

    Parameters
    ----------
    rng
        Source of randomness.
    kind
        Sort of hysteresis.
    lower_V, upper_V
        The range of the voltage, in V.
    stroke_um
        The displacement over the range, in um; drawn from 10 to 100 um.
    reversible_share
        The part of the stroke that has no memory; drawn from 0.5 to 0.8.
    loop_width
        The widest gap of the major loop over the stroke; drawn from 0.08 to 0.20.
    relays
        The number of relays along one side of their grid.
    plays
        The number of play operators.
    roughness
        How irregular the play operators are: 1 for radii and weights at random, 0 for radii evenly apart and weights
        on a smooth curve, as close to a continuous density as their number allows.

    Raises
    ------
    ValueError
        If no hysteresis of this share of the stroke has a loop this wide.
    """
    kind = kind or ("relays" if rng.random() < 0.5 else "plays")
    if stroke_um is None:
        stroke_um = float(rng.uniform(10, 100))
    if reversible_share is None:
        low, high = 0.2, 0.5
        if loop_width is not None:
            low = max(low, loop_width / _HIGHEST_RATIO)
            high = max(low, min(high, loop_width / _LOWEST_RATIO))
        reversible_share = 1 - float(rng.uniform(low, high))
    share = 1 - reversible_share
    if loop_width is None:
        low, high = max(0.08, _LOWEST_RATIO * share), min(0.20, _HIGHEST_RATIO * share)
        loop_width = float(rng.uniform(low, max(low, high)))
    reversible = _random_reversible(rng, lower_V, upper_V, stroke_um * reversible_share)
    mass_um, gap_um = stroke_um * share, stroke_um * loop_width
    irreversible: Density | PlayShape
    if kind == "relays":
        irreversible = _random_density(rng, lower_V, upper_V, mass_um, gap_um)
    else:
        irreversible = _random_plays(rng, lower_V, upper_V, mass_um, gap_um, plays, roughness)
    return Rig(
        kind=kind,
        lower_V=lower_V,
        upper_V=upper_V,
        stroke_um=stroke_um,
        reversible_share=reversible_share,
        loop_width=loop_width,
        relays=relays,
        reversible=reversible,
        irreversible=irreversible,
    )


def _random_reversible(rng: np.random.Generator, lower_V: float, upper_V: float, stroke_um: float) -> Reversible:
    # The slope is at least 1 - 0.6 - 0.3: the curve always rises.
    steepness = float(rng.uniform(1, 4))
    return Reversible(
        lower_V,
        upper_V,
        stroke_um,
        quadratic=float(rng.uniform(-0.3, 0.3)),
        step=float(rng.uniform(-0.3, 0.3)) / steepness,
        steepness=steepness,
        centre=float(rng.uniform(0.2, 0.8)),
    )


def _random_density(
    rng: np.random.Generator, lower_V: float, upper_V: float, mass_um: float, gap_um: float
) -> Density:
    """Two ridges of different families and a bump, as wide as the loop asks for."""
    families: list[Family] = ["exponential", "gaussian", "lorentzian", "gamma"]
    ridges = [
        Ridge(
            family=families[int(k)],
            width=float(rng.uniform(0.7, 1.4)),
            slope=float(rng.uniform(-0.5, 0.5)),
            skew=float(rng.uniform(-0.8, 0.8)),
            bend=float(rng.uniform(-0.6, 0.6)),
        )
        for k in rng.choice(len(families), size=2, replace=False)
    ]
    bump = Bump(
        bias=float(rng.uniform(-0.4, 0.4)),
        coercivity=float(rng.uniform(0.1, 0.4)),
        bias_spread=float(rng.uniform(0.2, 0.5)),
        coercivity_spread=float(rng.uniform(0.1, 0.3)),
    )
    background = float(rng.uniform(0.03, 0.10))
    first = float(rng.uniform(0.5, 0.85)) * (1 - background)
    shares = (first, 1 - background - first, background)
    voltages_V = np.linspace(lower_V, upper_V, 25)[1:-1]

    def widened(log_scale: float) -> Density:
        shapes: tuple[Shape, ...] = (
            *(replace(ridge, width=ridge.width * math.exp(log_scale)) for ridge in ridges),
            bump,
        )
        return Density.from_shares(shapes, shares, mass_um, lower_V, upper_V)

    def excess_um(log_scale: float) -> float:
        density = widened(log_scale)
        return max(density.loop_gap_um(float(voltage_V)) for voltage_V in voltages_V) - gap_um

    return widened(_root(excess_um, math.log(0.01), math.log(3), gap_um / mass_um))


def _random_plays(
    rng: np.random.Generator,
    lower_V: float,
    upper_V: float,
    mass_um: float,
    gap_um: float,
    plays: int,
    roughness: float,
) -> PlayShape:
    """Random radii, and random weights that fall (rarely: rise) with them as fast as the loop asks for."""
    half_V = (upper_V - lower_V) / 2
    # One radius somewhere in each of equal cells: random, but without the big holes that pure chance leaves.
    radii_V = half_V * 0.98 * (np.arange(plays) + 0.5 + roughness * (rng.random(plays) - 0.5)) / plays
    factors = 1 + roughness * (rng.gamma(4.0, size=plays) / 4 - 1)

    def tilted(growth: float) -> PlayShape:
        weights = factors * np.exp(growth * radii_V / half_V)
        shape = PlayShape(lower_V, upper_V, tuple(radii_V.tolist()), tuple(weights.tolist()))
        scaled = weights * (mass_um / shape.stroke_um)
        return replace(shape, weights_um_per_V=tuple(scaled.tolist()))

    def excess_um(growth: float) -> float:
        return tilted(growth).loop_gap_um - gap_um

    return tilted(_root(excess_um, -100.0, 3.0, gap_um / mass_um))


def _root(excess: Callable[[float], float], low: float, high: float, ratio: float) -> float:
    if not excess(low) < 0 < excess(high):
        raise ValueError(
            f"loop_width must be between about {_LOWEST_RATIO} and {_HIGHEST_RATIO} of the irreversible share "
            f"of the stroke, 1 - reversible_share, got {ratio:.3g} of it"
        )
    return float(brentq(excess, low, high, xtol=1e-9))
