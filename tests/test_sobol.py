"""Sobol indices: against functions whose indices are known, and against conditional means by quadrature."""

from dataclasses import replace

import numpy as np
import pytest
from _gain_formulas import ARGUMENTS, TABLE_1, gains, slopes
from SALib.analyze import sobol as salib_analysis
from SALib.sample import sobol as salib_sample
from scipy.optimize import brentq

from fits.io._errors import DataError
from fits.machining._design import Together, paper_design
from fits.machining._sobol import indices, intervals, outputs_of, sobol


def ishigami(x, a=7.0, b=0.1):
    return np.sin(x[0]) + a * np.sin(x[1]) ** 2 + b * x[2] ** 4 * np.sin(x[0])


def ishigami_indices(a=7.0, b=0.1):
    """Ishigami and Homma (1990)."""
    one = (1 + b * np.pi**4 / 5) ** 2 / 2
    two = a**2 / 8
    both = b**2 * np.pi**8 * (1 / 18 - 1 / 50)
    whole = one + two + both
    return np.array([one, two, 0]) / whole, np.array([one + both, two, both]) / whole


def test_indices_of_a_known_function(seed):
    outputs = outputs_of(lambda points: ishigami(np.pi * (2 * points.T - 1)), 3, 2**13, seed)
    for found, wanted in zip(indices(*outputs), ishigami_indices(), strict=True):
        np.testing.assert_allclose(found, wanted, atol=0.02)
    for ends, wanted in zip(intervals(*outputs, 0.99, 300, seed), ishigami_indices(), strict=True):
        assert np.all(ends[:, 0] <= ends[:, 1])
        width = np.maximum(ends[:, 1] - ends[:, 0], 1e-3)
        assert np.all(wanted > ends[:, 0] - width / 2)
        assert np.all(wanted < ends[:, 1] + width / 2)


def test_intervals_cover_as_often_as_they_say(rng):
    """For independent points, which the bootstrap is made for."""
    first, total = ishigami_indices()
    inside = []
    for _ in range(60):
        one, two = rng.uniform(-np.pi, np.pi, (2, 3, 1000))
        swapped = np.stack([np.where(np.arange(3)[:, None] == i, two, one) for i in range(3)])
        mean = ishigami(one).mean()
        outputs = ishigami(one) - mean, ishigami(two) - mean, np.stack([ishigami(s) for s in swapped]) - mean
        ends = intervals(*outputs, 0.9, 200, int(rng.integers(2**31)))
        inside.append([(e[:, 0] <= w) & (w <= e[:, 1]) for e, w in zip(ends, (first, total), strict=True)])
    # At this size they cover 88 to 90 %, near 53 of 60; fewer than 38 come once in a million studies.
    assert np.all(np.sum(inside, axis=0) >= 38)


@pytest.mark.parametrize("law", ["normal", "uniform"])
def test_where_first_order_fails_the_indices_hold(seed, rng, law):
    """The thickness t1 has no derivative in x with these guides, and yet a part in its variance."""
    guides = brentq(lambda n: slopes("x", TABLE_1, ["t1"], guides=n)[0], 4, 12)
    half = dict.fromkeys(ARGUMENTS["x"], 0.0) | {"t1": 0.25, "t2": 0.03, "la1": 0.2}
    made = paper_design()
    stage = replace(made, guides=guides, tolerance=dict.fromkeys(made.tolerance, 0.0) | half)
    found = sobol(stage, 2**13, law, seed=seed, axes=("x", "y"))
    assert found["y"].names == tuple(ARGUMENTS["x"])
    assert found["y"].axis == "y"
    assert found["x"].evaluations == 2**13 * 9
    np.testing.assert_array_equal(found["x"].total, found["y"].total)

    local = (slopes("x", TABLE_1, list(half), guides=guides) * list(half.values())) ** 2
    assert local[1] / local.sum() < 1e-12

    # A product of quadratures over the three dimensions that vary.
    if law == "normal":
        node, weight = np.polynomial.hermite_e.hermegauss(24)
        node = node / 3
    else:
        node, weight = np.polynomial.legendre.leggauss(24)
    weight = weight / weight.sum()
    axes = np.meshgrid(node, node, node, indexing="ij")
    vary = ["t1", "t2", "la1"]
    grid = gains("x", TABLE_1 | {n: TABLE_1[n] + half[n] * a for n, a in zip(vary, axes, strict=True)}, 1, guides)

    def mean(values, *over):
        for axis in sorted(over, reverse=True):
            values = np.tensordot(values, weight, (axis, 0))
        return values

    def spread(values):
        every = range(values.ndim)
        return mean(values**2, *every) - mean(values, *every) ** 2

    whole = spread(grid)
    for i, name in enumerate(vary):
        others = [k for k in range(3) if k != i]
        place = found["x"].names.index(name)
        first, total = spread(mean(grid, *others)) / whole, 1 - spread(mean(grid, i)) / whole
        assert found["x"].first[place] == pytest.approx(first, abs=0.03)
        assert found["x"].total[place] == pytest.approx(total, abs=0.03)
        assert found["x"].total_interval[place, 0] - 0.02 < total < found["x"].total_interval[place, 1] + 0.02
    t1 = found["x"].names.index("t1")
    assert found["x"].total[t1] > 0.05
    np.testing.assert_allclose(found["x"].total[[0, 3, 5, 6]], 0, atol=1e-12)


def test_nearly_linear_gains_have_the_shares_of_first_order(seed):
    stage = paper_design()
    found = sobol(stage, 2**12, seed=seed, axes=("z",))["z"]
    share = (slopes("z", TABLE_1, ARGUMENTS["z"]) * [stage.tolerance[n] for n in ARGUMENTS["z"]]) ** 2
    np.testing.assert_allclose(found.first, share / share.sum(), atol=0.01)
    np.testing.assert_allclose(found.total, share / share.sum(), atol=0.01)


@pytest.mark.parametrize(("axis", "law"), [("x", "normal"), ("gamma", "uniform")])
def test_indices_are_those_of_salib(seed, axis, law):
    """SALib draws its own points and analyses gains in plain NumPy; tolerances so wide that dimensions interact."""
    stage, names = paper_design(), ARGUMENTS[axis]
    half = {name: 0.2 * TABLE_1[name] for name in names}
    stage = replace(stage, tolerance=stage.tolerance | half)
    found = sobol(stage, 2**13, law, seed=seed, axes=(axis,))[axis]
    spread = [
        [TABLE_1[n], half[n] / 3] if law == "normal" else [TABLE_1[n] - half[n], TABLE_1[n] + half[n]] for n in names
    ]
    kind = {"normal": "norm", "uniform": "unif"}[law]
    problem = {"num_vars": len(names), "names": names, "bounds": spread, "dists": [kind] * len(names)}
    drawn = salib_sample.sample(problem, 2**13, calc_second_order=False, seed=seed)
    outputs = gains(axis, TABLE_1 | dict(zip(names, drawn.T, strict=True)))
    peer = salib_analysis.analyze(problem, outputs, calc_second_order=False, seed=seed)
    np.testing.assert_allclose(found.first, peer["S1"], atol=0.01)
    np.testing.assert_allclose(found.total, peer["ST"], atol=0.01)
    for ends, half_width in ((found.first_interval, peer["S1_conf"]), (found.total_interval, peer["ST_conf"])):
        # Widths of two bootstraps of 400 and 100 resamples.
        np.testing.assert_allclose(np.ptp(ends, axis=1) / 2, half_width, rtol=0.5, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"samples": 1000}, "power of two from 256"),
        ({"samples": 64}, "power of two from 256"),
        ({"resamples": 10}, "at least 100 resamples"),
        ({"confidence": 95}, "between 0 and 1"),
        ({"axes": ("w",)}, "no axis 'w'"),
    ],
)
def test_what_makes_no_sense_is_refused(change, told):
    with pytest.raises(DataError, match=told):
        sobol(paper_design(), **change)


def test_correlated_designs_have_no_unique_shares():
    stage = replace(paper_design(), together=(Together(("t1", "t2"), 0.9),))
    with pytest.raises(DataError, match="t1, t2 go together, and the variance has no unique parts"):
        sobol(stage)
