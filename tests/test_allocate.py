"""Allocation of tolerances: against Lagrange's closed form, the optimality conditions and random trials."""

from dataclasses import replace

import numpy as np
import pytest
from _gain_formulas import ARGUMENTS, TABLE_1, TWINS, gains, slopes

import fits
from fits.io._errors import DataError
from fits.machining import _allocate
from fits.machining._allocate import AllocationError, allocate
from fits.machining._design import Together, paper_design

WIDE_MM = (1e-5, 0.35)
LEGS = {"alpha1": 9.0, "alpha2": 9.0, "alpha3": 14.0}


def effects(axis, names):
    """Relative derivatives in percent per mm or rad, of any sign."""
    own = ARGUMENTS[TWINS[axis]]
    by_name = dict(zip(own, 100 * slopes(TWINS[axis], TABLE_1, own) / gains(axis, TABLE_1), strict=True))
    return np.array([by_name.get(name, 0.0) for name in names])


def error_pct(axis, tolerance, limit):
    names = list(tolerance)
    parts = np.abs(effects(axis, names)) * np.array([tolerance[name] for name in names])
    return np.linalg.norm(parts) if limit == "three_sigma" else parts.sum()


def price(found, before, cost):
    return sum(cost.get(name, 1.0) * before[name] / found[name] for name in found)


@pytest.mark.parametrize("limit", ["three_sigma", "worst_case"])
@pytest.mark.parametrize("axis", ["x", pytest.param("z", marks=pytest.mark.study)])
def test_one_axis_has_lagranges_closed_form(rng, axis, limit):
    stage, budget = paper_design(), rng.uniform(0.2, 0.6)
    names = ARGUMENTS[axis]
    cost = dict(zip(names, rng.uniform(0.5, 5, len(names)), strict=True))
    found = allocate(stage, {axis: budget}, cost, limit=limit, bounds_mm=(1e-6, 5.0), curvature_share=np.inf)
    # Cost c T0 / T and error (sum (s T)^p)^(1/p): T is as (c T0 / s^p)^(1 / (p + 1)).
    power = 2 if limit == "three_sigma" else 1
    size = np.abs(effects(axis, names))
    shape = np.array([cost[n] * stage.tolerance[n] for n in names])
    shape = (shape / size**power) ** (1 / (power + 1))
    wanted = shape * budget / np.sum((size * shape) ** power) ** (1 / power)
    np.testing.assert_allclose([found.design.tolerance[n] for n in names], wanted, rtol=1e-5)
    assert found.names == tuple(names)
    assert found.active == (axis,)
    assert found.error_pct[axis] == pytest.approx(budget, rel=1e-7)
    # A budget larger by one percent lets all tolerances grow by one percent.
    assert found.multipliers[axis] == pytest.approx(1, abs=1e-4)
    assert found.cost == pytest.approx(price(dict(zip(names, wanted, strict=True)), stage.tolerance, cost), rel=1e-7)
    assert found.cost_before == pytest.approx(sum(cost.values()))
    kept = set(stage.tolerance) - set(names)
    assert {n: found.design.tolerance[n] for n in kept} == {n: stage.tolerance[n] for n in kept}


@pytest.mark.parametrize(
    ("limit", "most_mm"), [pytest.param("three_sigma", 0.06, marks=pytest.mark.study), ("worst_case", 0.02)]
)
@pytest.mark.study
def test_several_axes_meet_the_optimality_conditions(rng, limit, most_mm):
    """With bounds that hold some tolerances; slopes by finite differences of NumPy's formulas."""
    stage = paper_design()
    budget = {"x": 0.7, "y": 0.6, "z": 0.8, "alpha": 0.7, "gamma": 0.5}
    budget = {axis: value * rng.uniform(0.9, 1.1) for axis, value in budget.items()}
    # Those that cost most and least end at the bounds.
    ends = {"la3": 20.0, "l3": 20.0, "l5": 20.0}, {"R": 1e-4, "l1": 1e-4}
    cost = {name: rng.uniform(0.3, 3) for name in stage.tolerance} | ends[0] | ends[1]
    found = allocate(stage, budget, cost, limit=limit, bounds_mm=(0.003, most_mm), curvature_share=np.inf)
    names = list(found.names)
    tolerance = {n: found.design.tolerance[n] for n in names}
    length = np.array([tolerance[n] * LEGS.get(n, 1.0) for n in names])
    assert np.all((length > 0.003 * (1 - 1e-9)) & (length < most_mm * (1 + 1e-9)))
    for axis, value in budget.items():
        assert error_pct(axis, tolerance, limit) <= value * (1 + 1e-6)
        assert found.error_pct[axis] == pytest.approx(error_pct(axis, tolerance, limit), rel=1e-9)
    tight = {axis for axis in budget if error_pct(axis, tolerance, limit) > budget[axis] * (1 - 1e-6)}
    assert set(found.active) == tight
    assert found.cost == pytest.approx(price(tolerance, stage.tolerance, cost), rel=1e-9)

    def change(function):
        step = 1e-6
        sides = [[function({**tolerance, n: tolerance[n] * np.exp(s)}) for s in (step, -step)] for n in names]
        return np.array([(np.log(up) - np.log(down)) / (2 * step) for up, down in sides])

    slope = change(lambda t: price(t, stage.tolerance, cost))
    for axis, weight in found.multipliers.items():
        assert weight >= 0
        slope = slope + weight * change(lambda t, axis=axis: error_pct(axis, t, limit))
    low, high = length < 0.003 * (1 + 1e-6), length > most_mm * (1 - 1e-6)
    assert {*ends[0]} <= {n for n, at in zip(names, high, strict=True) if at}
    assert {*ends[1]} <= {n for n, at in zip(names, low, strict=True) if at}
    np.testing.assert_allclose(slope[~low & ~high], 0, atol=1e-4)
    assert np.all(slope[low] > -1e-4)
    assert np.all(slope[high] < 1e-4)

    for size in 10 ** rng.uniform(-4, 0, 500):
        trial = {n: tolerance[n] * np.exp(size * rng.normal()) for n in names}
        # The largest tolerances of this shape that are allowed.
        grow = min(budget[axis] / error_pct(axis, trial, limit) for axis in budget)
        trial = {n: np.clip(grow * trial[n] * LEGS.get(n, 1), 0.003, most_mm) / LEGS.get(n, 1) for n in names}
        if all(error_pct(axis, trial, limit) <= budget[axis] for axis in budget):
            assert price(trial, stage.tolerance, cost) > found.cost * (1 - 1e-6)


def test_a_budget_that_binds_nothing_gives_up_all_tolerances():
    found = allocate(paper_design(), {"x": 90.0}, bounds_mm=(0.001, 0.1))
    for name in ARGUMENTS["x"]:
        assert found.design.tolerance[name] * LEGS.get(name, 1.0) == pytest.approx(0.1)
    assert found.active == ()
    assert found.multipliers == {}
    assert found.cost == pytest.approx(7 * 0.02 / 0.1)


def test_the_lower_budget_stands_for_both_of_two_alike_axes():
    both = allocate(paper_design(), {"x": 1.0, "y": 0.5}, bounds_mm=WIDE_MM)
    one = allocate(paper_design(), {"y": 0.5}, bounds_mm=WIDE_MM)
    assert both.active == ("y",)
    assert both.design.tolerance == one.design.tolerance
    assert both.error_pct == pytest.approx({"x": 0.5, "y": 0.5})


def test_a_budget_out_of_reach_is_refused_with_the_smallest_error():
    smallest = error_pct("z", {n: 0.004 / LEGS.get(n, 1.0) for n in ARGUMENTS["z"]}, "worst_case")
    with pytest.raises(DataError, match=rf"z: an error of 0.1 % is out of reach, the smallest is {smallest:.3g} % "):
        allocate(paper_design(), {"x": 2.0, "z": 0.1}, limit="worst_case", bounds_mm=(0.004, 0.1))


@pytest.mark.parametrize("given", ["start", "nan"])
def test_a_solver_that_fails_gives_no_answer(monkeypatch, given):
    def stop(function, start, **_):
        from scipy.optimize import OptimizeResult

        return OptimizeResult(x=start if given == "start" else start * np.nan, success=True)

    monkeypatch.setattr(_allocate, "minimize", stop)
    with pytest.raises(AllocationError):
        allocate(paper_design(), {"z": 0.5})


def test_correlated_dimensions_are_allocated_for_the_worst_case_only():
    stage = replace(paper_design(), together=(Together(("t1", "t2"), 0.9),))
    with pytest.raises(DataError, match="t1, t2 go together, and three standard deviations"):
        allocate(stage, {"x": 1.0})
    found = allocate(stage, {"x": 1.0}, limit="worst_case")
    assert found.design.together == stage.together


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"budget_pct": {}}, "choose some of x, y, z"),
        ({"budget_pct": {"w": 1.0}}, "no axis 'w'"),
        ({"budget_pct": {"x": 0.0}}, "budget of x is a positive number, got 0"),
        ({"budget_pct": {"x": np.nan}}, "budget of x is a positive number, got nan"),
        ({"cost": {"t2": -1.0}}, "cost of t2 is a positive number, got -1"),
        ({"cost": {"t9": 1.0}}, "no dimension 't9'"),
        ({"limit": "best"}, "no limit 'best': choose one of three_sigma, worst_case"),
        ({"bounds_mm": (0.1, 0.01)}, "positive and in order, got 0.1 and 0.01 mm"),
        ({"bounds_mm": (0.0, 0.01)}, "positive and in order, got 0 and 0.01 mm"),
    ],
)
def test_what_makes_no_sense_is_refused(change, told):
    with pytest.raises(DataError, match=told):
        allocate(**({"design": paper_design(), "budget_pct": {"x": 1.0}} | change))


def test_a_tolerance_of_zero_has_no_cost():
    stage = paper_design()
    stage = replace(stage, tolerance={**stage.tolerance, "l3": 0.0})
    with pytest.raises(DataError, match="cost of l3 at its present tolerance of zero is infinite"):
        allocate(stage, {"x": 1.0})


@pytest.mark.study
def test_what_is_allocated_keeps_to_the_budget_in_a_draw():
    """Also where a slope nearly vanishes, as that of alpha1 does."""
    found = fits.allocate(fits.paper_design(), {"x": 1.0, "gamma": 1.0})
    study = fits.monte_carlo(found.design, 200_000, seed=1, axes=("x", "gamma"))
    for spread in study.axes.values():
        assert 3 * spread.relative_sd_pct == pytest.approx(1.0, rel=0.03)
