"""A stage as it is designed: dimensions with their tolerances, material, piezos and moving masses."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fits.io._errors import DataError
from fits.io._typed import nearest
from microid import kinetostatics as ks

TOLERANCE_MM = 0.02
LARGEST_ANGLE_RAD = 1.5
# Hinges and the distance between the centres of the two of a leg, which they cannot exceed.
_HINGES = (("l1", "la1", "alpha1"), ("l2", "l3", ""), ("l4", "la2", "alpha2"), ("l6", "la3", "alpha3"))
_MOST_GUIDES = 1000


@dataclass(frozen=True)
class Together:
    """Dimensions whose errors go together with a correlation of any two, -1 to 1.

    They are named as in `microid.kinetostatics.DIMENSIONS`. One offset of a wire cut, for example, shifts several
    thicknesses.
    """

    dimensions: tuple[str, ...]
    correlation: float


@dataclass(frozen=True)
class Design:
    """A stage as it is designed: what a machining error is counted from.

    The tolerance of every dimension by name is the largest error to either side, in the dimension's unit: three
    standard deviations of a normal distribution, or the half-width of a uniform or a triangular one. The level is 0
    for Euler-Bernoulli leaves between rigid blocks, 1 with elastic roots, shear and links. `guides` are the guiding
    legs of a translation in x or y, the modulus is that of all flexures, the actuation are piezos and moving masses,
    and errors of dimensions are independent but for those that go `together`.

    A `DataError` says that anything in it is impossible, beginning with its place, such as `geometry.t2`.
    """

    geometry: ks.Geometry
    tolerance: dict[str, float]
    level: int = 1
    guides: float = 4.0
    youngs_modulus_GPa: float = 206.0
    actuation: ks.Actuation = field(default_factory=ks.Actuation)
    together: tuple[Together, ...] = ()

    def __post_init__(self) -> None:
        for fault in _faults(self):
            raise DataError(fault)

    @property
    def constants(self) -> ks.Constants:
        """What enters the motion functions beside their arguments."""
        return ks.constants_of(self.geometry, self.level, 1e3 * self.youngs_modulus_GPa, self.guides)

    def with_tolerance(self, length_mm: float) -> "Design":
        """Give every length this tolerance, and every angle what an error of that size makes of it at its leg."""
        return replace(self, tolerance=uniform_tolerance(self.geometry, length_mm))

    def correlation(self, names: Sequence[str]) -> NDArray[np.float64]:
        """Correlation of the errors of some dimensions, shape `(n, n)`."""
        matrix = np.eye(len(names))
        place = {name: i for i, name in enumerate(names)}
        for group in self.together:
            for one, other in itertools.permutations((name for name in group.dimensions if name in place), 2):
                matrix[place[one], place[other]] = group.correlation
        return matrix


def paper_design(tolerance_mm: float = TOLERANCE_MM) -> Design:
    """Return the paper's stage (Table 1).

    All lengths have one tolerance. The paper gives none for angles (erratum 9), here that of a length over its leg,
    and no value for `l` (erratum 7), here 40 mm.
    """
    geometry = ks.Geometry()
    return Design(geometry, uniform_tolerance(geometry, tolerance_mm))


def uniform_tolerance(geometry: ks.Geometry, length_mm: float) -> dict[str, float]:
    """Tolerance of every dimension in its unit that goes with one of all lengths."""
    return {name: length_mm / lever_mm(geometry, name) for name in ks.DIMENSIONS}


def lever_mm(geometry: ks.Geometry, name: str) -> float:
    """Length of the leg at whose end an error of an angle is counted as a length; 1 for a length."""
    leg = ks.DIMENSIONS[name].leg
    return 1.0 if leg is None else float(geometry[leg])


def _faults(design: Design) -> Iterator[str]:
    """Sentences on what is impossible, each beginning with its place."""
    yield from _faults_of_sizes(design)
    if type(design.level) is not int or design.level not in (0, 1):
        yield f"level: expected 0 or 1, found {design.level!r}; give one of them."
    if not 0 <= design.guides <= _MOST_GUIDES:
        yield f"material.guides: expected 0 to {_MOST_GUIDES} legs, found {design.guides:g}; correct it."
    if not (math.isfinite(design.youngs_modulus_GPa) and design.youngs_modulus_GPa > 0):
        yield (
            f"material.youngs_modulus: expected more than 0 GPa, found {design.youngs_modulus_GPa:g}; give the "
            "modulus of the flexures."
        )
    for name, value in vars(design.actuation).items():
        if not (math.isfinite(value) and value > 0):
            yield f"actuation.{name}: expected a number above 0, found {float(value):g}; correct it."
    yield from _faults_of_groups(design)


def _faults_of_sizes(design: Design) -> Iterator[str]:
    for name in design.tolerance:
        if name not in ks.DIMENSIONS:
            yield f"geometry.{name}: a tolerance is given for an unknown dimension; {nearest(name, [*ks.DIMENSIONS])}"
    sizes = {name: float(design.geometry[name]) for name in ks.DIMENSIONS}
    for name, dimension in ks.DIMENSIONS.items():
        place, size, unit = f"geometry.{name}", sizes[name], dimension.unit
        if not (math.isfinite(size) and size > 0):
            yield f"{place}: expected more than 0 {unit}, found {size:g}; give the {dimension.meaning}."
        if unit == "rad" and not size < LARGEST_ANGLE_RAD:
            yield (
                f"{place}: expected an angle between 0 and {LARGEST_ANGLE_RAD} rad, found {size:g}; a bridge needs "
                "a slight inclination."
            )
        if name not in design.tolerance:
            yield f"{place}: expected a tolerance in {unit}, found none; give one."
        tolerance = design.tolerance[name]
        if not (math.isfinite(tolerance) and tolerance >= 0):
            yield f"{place}: expected a tolerance of at least 0 {unit}, found {tolerance:g}; give its size alone."
        if not tolerance < size:
            yield (
                f"{place}: expected a tolerance below the dimension, {size:g} {unit}, found {tolerance:g} {unit}; "
                "give a smaller one."
            )
    for hinge, leg, angle in _HINGES:
        run = sizes[leg] * math.cos(sizes[angle]) if angle else sizes[leg]
        # The paper's middle platform has hinges that are longer than their leg's run by 0.2 %.
        if sizes[hinge] > 1.01 * run:
            yield (
                f"geometry.{hinge}: expected a hinge no longer than its leg, which runs {run:.4g} mm along it "
                f"({leg} = {sizes[leg]:g} mm), found {sizes[hinge]:g} mm; shorten the hinge or lengthen the leg."
            )


def _faults_of_groups(design: Design) -> Iterator[str]:
    pairs: dict[frozenset[str], int] = {}
    for k, group in enumerate(design.together):
        place = f"together[{k}]"
        for name in group.dimensions:
            if name not in ks.DIMENSIONS:
                yield f"{place}.dimensions: '{name}' is no dimension; {nearest(name, [*ks.DIMENSIONS])}"
        if len(set(group.dimensions)) < max(2, len(group.dimensions)):
            yield f"{place}.dimensions: expected at least two different dimensions, found {list(group.dimensions)}."
        if not -1 <= group.correlation <= 1:
            yield (
                f"{place}.correlation: expected a number between -1 and 1, found {group.correlation:g}; correct it."
            )
        for pair in map(frozenset, itertools.combinations(group.dimensions, 2)):
            if pair in pairs:
                yield (
                    f"{place}.dimensions: the correlation of {' and '.join(sorted(pair))} is given by together"
                    f"[{pairs[pair]}] already; keep one of the two."
                )
            pairs[pair] = k
    names = sorted({name for group in design.together for name in group.dimensions})
    # Rounding may take a little from the smallest eigenvalue of a correlation matrix.
    if names and np.linalg.eigvalsh(design.correlation(names))[0] < -1e-9:
        yield (
            f"together[{len(design.together) - 1}].correlation: expected correlations that errors can have, found a "
            "matrix that is not positive semidefinite; n dimensions can all have -1 / (n - 1) at least, and two "
            "that go with a third go with each other."
        )
