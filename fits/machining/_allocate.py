"""Which tolerances to tighten, and which to give up, so that the pose keeps to its budget at the least cost."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import NonlinearConstraint, minimize, nnls

from fits.io._errors import DataError
from fits.io._quantity import FloatArray
from fits.machining._design import Design, lever_mm
from fits.machining._gains import gain_model, gradient, hessian, inputs_of, twin
from fits.machining._tolerances import check, check_independent, tolerances
from microid.kinetostatics import DIMENSIONS, Axis

Limit = Literal["three_sigma", "worst_case"]
_POWERS: dict[Limit, int] = {"three_sigma": 2, "worst_case": 1}
# Of the logarithms of errors over budgets, and of the optimality conditions, whose terms are parts of the cost.
_SLACK, _STATIONARY = 1e-7, 1e-5


class AllocationError(RuntimeError):
    """The cheapest tolerances were not found; there is no answer to give."""


@dataclass(frozen=True)
class Allocation:
    """The cheapest tolerances that keep to a budget.

    The design has the new tolerances; `names` are the dimensions whose tolerances were chosen, and those on which no
    axis of the budget depends keep theirs. The costs are sums over the former, with the new tolerances and the old
    ones; `error_pct` is the first-order error of each axis of the budget, in percent of its output. The budgets of
    `active` axes are used up, and `multipliers` say by how many percent the cost falls when one grows by one percent.
    Of two axes that are one function of the same dimensions, the one with the lower budget stands for both.
    """

    design: Design
    names: tuple[str, ...]
    cost: float
    cost_before: float
    error_pct: dict[Axis, float]
    active: tuple[Axis, ...]
    multipliers: dict[Axis, float]
    limit: Limit


def allocate(
    design: Design,
    budget_pct: Mapping[Axis, float],
    cost: Mapping[str, float] | None = None,
    *,
    limit: Limit = "three_sigma",
    bounds_mm: tuple[float, float] = (0.001, 0.1),
    voltage: bool = False,
    curvature_share: float = 0.05,
) -> Allocation:
    r"""Choose the tolerances that cost least and keep the error of each axis within its budget.

    The cost of a dimension is in inverse proportion to its tolerance. In the logarithms of the tolerances both the
    cost :math:`\sum c_i T_{0i} / T_i` and the errors, :math:`\sum |s_i| T_i` or :math:`\sqrt{\sum s_i^2 T_i^2}` with
    relative derivatives s, are convex, so that the minimum is the only one. Where a slope nearly vanishes the first
    order would let a tolerance grow without a price; `curvature_share` stops it.

    The budget is the largest error of the output by axis, in percent of the output; the cost is by dimension, at the
    present tolerance, and one for those not named. What keeps to the budget are `three_sigma` of independent normal
    errors, whose tolerances are three standard deviations, or the `worst_case`, all errors at their tolerances with
    the worst signs. Bounds are the smallest and largest tolerance of a length; of an angle, at the end of its leg.
    With `voltage` the voltage of the piezos is imposed instead of their elongation. No tolerance goes beyond where
    the second order of its dimension alone takes `curvature_share` of a budget.

    A `DataError` says that a budget, cost or bound makes no sense, that dimensions go together and three standard
    deviations are asked for, or that a budget is out of reach, with the smallest error within reach; an
    `AllocationError` that the solver fails.
    """
    cost = cost or {}
    check(design, tuple(budget_pct), "normal")
    if limit not in _POWERS:
        raise DataError(f"there is no limit {limit!r}: choose one of {', '.join(_POWERS)}")
    if limit == "three_sigma":
        why = "three standard deviations are allocated to independent dimensions only: choose the worst_case"
        check_independent(design, why)
    for what, given in (("budget", budget_pct), ("cost", cost)):
        for name, value in given.items():
            if not (np.isfinite(value) and value > 0):
                raise DataError(f"the {what} of {name} is a positive number, got {value}")
    for name in cost:
        if name not in DIMENSIONS:
            raise DataError(f"there is no dimension {name!r}: choose some of {', '.join(DIMENSIONS)}")
    low_mm, high_mm = bounds_mm
    if not 0 < low_mm < high_mm < np.inf:
        raise DataError(f"the bounds of tolerances are positive and in order, got {low_mm:g} and {high_mm:g} mm")
    # Of axes that are one function of the same dimensions, the one with the lower budget.
    one_by_one = {twin(axis): [other for other in budget_pct if twin(other) == twin(axis)] for axis in budget_pct}
    axes = tuple(min(alike, key=budget_pct.__getitem__) for alike in one_by_one.values())
    names = tuple(dict.fromkeys(name for axis in axes for name in inputs_of(axis, voltage)))
    tolerance = tolerances(design, names)
    if not np.all(tolerance > 0):
        name = names[int(np.argmin(tolerance))]
        raise DataError(f"the cost of {name} at its present tolerance of zero is infinite: give it a positive one")
    price = np.array([cost.get(name, 1.0) for name in names])
    lever = np.array([lever_mm(design.geometry, name) for name in names])
    lower, upper = (np.log(bound / lever / tolerance) for bound in bounds_mm)
    model, (first, second) = gain_model(design, voltage), np.empty((2, len(axes), len(names)))
    # Derivatives with respect to each dimension alone, in percent of the gain per mm or rad.
    for k, axis in enumerate(axes):
        gain, slopes = gradient(model, twin(axis), names)
        first[k], second[k] = 100 * slopes / gain, 100 * np.diagonal(hessian(model, twin(axis), names)) / gain
    budget = np.array([[budget_pct[axis]] for axis in axes])
    # Where the second order of a dimension alone comes to its share of a budget.
    curved = np.sqrt(2 * curvature_share * budget / np.maximum(np.abs(second), 1e-300)).min(axis=0)
    upper = np.maximum(lower, np.minimum(upper, np.log(curved / tolerance)))
    problem = _Problem(price, first * tolerance / budget, lower, upper, _POWERS[limit])
    for axis, excess in zip(axes, problem.excess(lower), strict=True):
        if excess > 0:
            raise DataError(
                f"{axis}: an error of {budget_pct[axis]:g} % is out of reach, the smallest is "
                f"{budget_pct[axis] * np.exp(excess):.3g} % with tolerances of {low_mm:g} mm: raise the budget or "
                "allow smaller tolerances"
            )
    logarithm, weights = problem.solve()
    found = dict(zip(names, (tolerance * np.exp(logarithm)).tolist(), strict=True))
    shares = np.exp(problem.excess(logarithm)).tolist()
    reached = {twin(axis): share * budget_pct[axis] for axis, share in zip(axes, shares, strict=True)}
    chosen = replace(design, tolerance={**design.tolerance, **found})
    costs = float(price @ np.exp(-logarithm)), float(price.sum())
    error_pct = {axis: reached[twin(axis)] for axis in budget_pct}
    multipliers = {axes[i]: weight for i, weight in weights.items()}
    return Allocation(chosen, names, *costs, error_pct, tuple(multipliers), multipliers, limit)


@dataclass(frozen=True)
class _Problem:
    """In the logarithms of tolerances over the present ones; errors are in budgets."""

    price: FloatArray
    effect: FloatArray
    lower: FloatArray
    upper: FloatArray
    power: int

    def terms(self, logarithm: FloatArray) -> FloatArray:
        return (np.abs(self.effect) * np.exp(logarithm)) ** self.power

    def excess(self, logarithm: FloatArray) -> FloatArray:
        """Logarithm of each error over its budget."""
        return np.log(self.terms(logarithm).sum(axis=1)) / self.power

    def shares(self, logarithm: FloatArray) -> FloatArray:
        """Derivative of `excess`."""
        terms = self.terms(logarithm)
        return terms / terms.sum(axis=1, keepdims=True)

    def log_cost(self, logarithm: FloatArray) -> tuple[float, FloatArray]:
        each = self.price * np.exp(-logarithm)
        return float(np.log(each.sum())), -each / each.sum()

    def solve(self) -> tuple[FloatArray, dict[int, float]]:
        """The minimum, and the multipliers of the constraints that hold it."""
        # All tolerances alike, as large as the worst error lets them be.
        start = np.full_like(self.lower, -max(self.excess(np.zeros_like(self.lower))))
        solved = minimize(
            self.log_cost,
            np.clip(start, self.lower, self.upper),
            jac=True,
            method="SLSQP",
            bounds=list(zip(self.lower, self.upper, strict=True)),
            constraints=NonlinearConstraint(self.excess, -np.inf, 0.0, jac=self.shares),
            options={"ftol": 1e-15, "maxiter": 500},
        )
        found = np.clip(solved.x, self.lower, self.upper)
        excess = self.excess(found)
        if not np.all(np.isfinite(found)) or np.max(excess) > _SLACK:
            raise AllocationError("the solver did not find tolerances within the budget")
        # Not the solver's word, but the optimality conditions: budgets and bounds balance the slope of the cost.
        tight = np.flatnonzero(excess > -_SLACK)
        low, high = (np.flatnonzero(np.abs(found - bound) < _SLACK) for bound in (self.lower, self.upper))
        sides = np.eye(len(found))
        columns = np.vstack([self.shares(found)[tight], -sides[low], sides[high]])
        weights, residual = nnls(columns.T, -self.log_cost(found)[1])
        if not residual < _STATIONARY:
            raise AllocationError(
                f"the solver stopped before the cheapest tolerances: {residual:.1g} of the cost is not balanced"
            )
        return found, dict(zip(tight.tolist(), weights[: len(tight)].tolist(), strict=True))
