"""Spread of the gains: against formulas in NumPy and draws of NumPy's own."""

from dataclasses import replace

import numpy as np
import pytest
from _gain_formulas import ARGUMENTS, TABLE_1, TWINS, curvatures, gains, sizes, slopes
from scipy import stats
from scipy.optimize import brentq

from fits.io._errors import DataError
from fits.machining._design import Together, paper_design
from fits.machining._gains import gain_model, gains_of_many
from fits.machining._monte_carlo import monte_carlo, second_order
from fits.machining._tolerances import copula_root, from_normal
from microid import kinetostatics as ks

LAWS = {
    "normal": lambda half: stats.norm(0, half / 3),
    "uniform": lambda half: stats.uniform(-half, 2 * half),
    "triangular": lambda half: stats.triang(0.5, -half, 2 * half),
}
ALL = ("x", "z", "alpha", "gamma")


def design(together=(), guides=4.0, level=1, **tolerance):
    """The paper's, with every tolerance zero but those given; all 0.02 mm if none is."""
    made = replace(paper_design(), together=together, guides=guides, level=level)
    return replace(made, tolerance=dict.fromkeys(made.tolerance, 0.0) | tolerance) if tolerance else made


def drawn(rng, stage, law, count):
    """Dimensions by NumPy and SciPy, those that go together by a common part of normal numbers."""
    return {
        name: TABLE_1[name] + (LAWS[law](half).rvs(count, random_state=rng) if half else 0.0)
        for name, half in stage.tolerance.items()
    }


def moments(values):
    off = values - values.mean()
    sd = off.std()
    kurtosis = np.mean(off**4) / sd**4
    return values.mean(), sd, np.mean(off**3) / sd**3, sd * np.sqrt((kurtosis - 1) / 4 / len(values))


def balanced_guides(t1=0.8):
    """Number of guiding legs where a thicker hinge of the bridge leaves the gain of x as it is."""
    return brentq(lambda guides: slopes("x", sizes(t1=t1), ["t1"], guides=guides)[0], 4, 12)


@pytest.mark.parametrize(("level", "voltage"), [(1, False), (0, True)])
def test_gains_are_those_of_the_formulas(rng, level, voltage):
    stage = design(level=level, guides=rng.uniform(3, 8))
    names = tuple(ks.DIMENSIONS) if voltage else tuple({name: 0 for own in ARGUMENTS.values() for name in own})
    noise = rng.uniform(-1, 1, (len(names), 500))
    centre = np.array([TABLE_1[name] for name in names])
    values = dict(zip(names, centre[:, None] * (1 + 0.05 * noise), strict=True))
    found = gains_of_many(gain_model(stage, voltage), 0.05 * centre[:, None] * noise, ALL, names)
    for axis, ours in zip(ALL, found, strict=True):
        expected = gains(axis, TABLE_1 | values, level, stage.guides, 50.0 if voltage else None)
        np.testing.assert_allclose(ours, expected, rtol=1e-11)


@pytest.mark.parametrize("law", LAWS)
def test_statistics_are_those_of_a_study_in_numpy(rng, seed, law):
    stage, count = design(), 200_000
    study = monte_carlo(stage, count, law, seed=seed)
    values = drawn(rng, stage, law, count)
    for axis, spread in study.axes.items():
        expected = gains(axis, values)
        mean, sd, skewness, error = moments(expected)
        assert spread.nominal == pytest.approx(gains(axis, TABLE_1), rel=1e-12)
        assert abs(spread.mean - mean) < 6 * sd * np.sqrt(2 / count)
        assert abs(spread.sd - sd) < 6 * error * np.sqrt(2)
        assert spread.sd_error == pytest.approx(error, rel=0.05)
        assert abs(spread.skewness - skewness) < 6 * np.sqrt(2 * 15 / count)
        for percent, quantile in spread.quantiles.items():
            # Parts of the study below: binomial, and its own order statistic errs as much.
            part = np.mean(expected <= quantile)
            assert (
                abs(part - percent / 100) < 6 * np.sqrt(2 * percent / 100 * (1 - percent / 100) / count) + 2 / count
            )
        assert spread.relative_sd_pct == pytest.approx(100 * sd / spread.nominal, rel=0.02)
        assert not spread.flagged
        assert spread.second is None
        assert spread.explained
        assert spread.first_order_sd == pytest.approx(sd, rel=0.02)


def test_an_imposed_voltage_spreads_the_gain_by_its_stiffness_too(rng, seed):
    stage, count = design(), 100_000
    study = monte_carlo(stage, count, seed=seed, axes=("x", "gamma"), voltage=True)
    values = drawn(rng, stage, "normal", count)
    for axis, spread in study.axes.items():
        _, sd, _, error = moments(gains(axis, values, piezo=50.0))
        assert abs(spread.sd - sd) < 6 * error * np.sqrt(2)
        assert abs(spread.first_order_sd - sd) < 0.02 * sd


def test_a_wire_cut_shifts_all_thicknesses(rng, seed):
    alike = {name: 0.02 for name in ("t1", "t2", "t4", "t6", "t7")}
    stage = design((Together(tuple(alike), 1.0),), **alike)
    study = monte_carlo(stage, 100_000, seed=seed)
    shift = rng.normal(0, 0.02 / 3, 100_000)
    values = TABLE_1 | {name: TABLE_1[name] + shift for name in alike}
    for axis, spread in study.axes.items():
        _, sd, _, error = moments(gains(axis, values))
        assert abs(spread.sd - sd) < 6 * error * np.sqrt(2)
        first = abs(slopes(TWINS[axis], TABLE_1, list(alike)).sum()) * 0.02 / 3
        assert spread.first_order_sd == pytest.approx(first, rel=1e-9)
    alone = monte_carlo(design(**alike), 100_000, seed=seed).axes["x"]
    assert study.axes["x"].sd > 1.2 * alone.sd


@pytest.mark.parametrize("law", LAWS)
def test_draws_keep_their_law_and_take_the_correlation(rng, law):
    correlation = rng.uniform(-0.4, 0.95)
    stage = design((Together(("t1", "l1", "t2"), correlation), Together(("la1", "l3"), -0.7)))
    names = ("l1", "t1", "la1", "l2", "t2", "l3")
    count = 100_000
    found = from_normal(copula_root(stage, names, law) @ rng.standard_normal((len(names), count)), law)
    assert found.shape == (6, count)
    for row in found:
        assert stats.kstest(row[:20_000], LAWS[law](1.0).cdf).pvalue > 1e-6
    wanted = np.eye(6)
    for group, value in (((1, 0, 4), correlation), ((2, 5), -0.7)):
        for i in group:
            for j in group:
                wanted[i, j] = 1.0 if i == j else value
    # Of a sample of normal numbers; less for other laws but for the tails of a product.
    error = (1 - wanted**2) / np.sqrt(count) + 1e-12
    assert np.all(np.abs(np.corrcoef(found) - wanted) < 7 * error + 1e-4)


def test_the_copula_of_uniform_numbers_is_known():
    stage = design((Together(("t1", "t2"), 0.6),))
    root = copula_root(stage, ("t1", "t2", "l1"), "uniform")
    assert (root @ root.T)[0, 1] == pytest.approx(2 * np.sin(np.pi * 0.6 / 6), abs=1e-5)
    np.testing.assert_allclose(root[2], [0, 0, 1], atol=1e-15)
    np.testing.assert_array_equal(copula_root(design(), ("t1", "t2"), "uniform"), np.eye(2))


@pytest.mark.parametrize("law", LAWS)
def test_where_first_order_fails_second_order_explains(seed, law):
    guides = balanced_guides()
    assert 7 < guides < 9
    spread = monte_carlo(design(guides=guides, t1=0.05), 100_000, law, seed=seed, axes=("y",)).axes["y"]
    assert spread.first_order_sd < 1e-6 * spread.sd
    assert spread.flagged
    assert spread.explained
    bend = curvatures("x", TABLE_1, ["t1"], guides=guides)[0, 0]
    second, fourth = (LAWS[law](0.05).moment(order) for order in (2, 4))
    assert spread.second.axis == "y"
    assert spread.second.sd == pytest.approx(abs(bend) / 2 * np.sqrt(fourth - second**2), rel=1e-6)
    assert spread.second.mean_shift == pytest.approx(bend / 2 * second, rel=1e-6)
    assert spread.second.second_order_share == pytest.approx(1, abs=1e-9)
    assert spread.mean - spread.nominal == pytest.approx(spread.second.mean_shift, rel=0.05)


@pytest.mark.parametrize(("axis", "voltage"), [("x", False), ("gamma", True)])
def test_second_derivatives_are_those_of_the_formulas(axis, voltage):
    stage = design()
    found = second_order(stage, axis, voltage=voltage)
    piezo = 50.0 if voltage else None
    names = ARGUMENTS[axis] + (["l4", "h", "d"] if voltage else [])
    assert found.names == tuple(names)
    scale = np.abs(gains(axis, TABLE_1, piezo=piezo) / np.array([TABLE_1[n] for n in names]))
    by_one, by_two = (f(axis, TABLE_1, names, piezo=piezo) for f in (slopes, curvatures))
    np.testing.assert_allclose(found.gradient / scale, by_one / scale, atol=1e-11)
    bend_scale = np.outer(scale, scale) / found.gain
    np.testing.assert_allclose(found.hessian / bend_scale, by_two / bend_scale, atol=1e-6)
    sd = np.array([stage.tolerance[n] for n in names]) / 3
    assert found.first_order_sd == pytest.approx(np.linalg.norm(by_one * sd), rel=1e-10)
    np.testing.assert_allclose(found.pairs, (by_two * np.outer(sd, sd)) ** 2 / 2, rtol=1e-4, atol=1e-13)


@pytest.mark.parametrize("law", ["normal", "uniform", "triangular", "correlated"])
def test_second_order_is_exact_for_quadratic_gains(rng, law):
    """Its moments are those of the quadratic function itself under draws."""
    together = (Together(("t1", "t2", "l1"), 0.8),) if law == "correlated" else ()
    half = {"t1": 0.3, "t2": 0.2, "l1": 0.5}
    stage, law = design(together, 8.0, **half), "normal" if law == "correlated" else law
    found = second_order(stage, "x", law)
    count, names = 1_000_000, list(half)
    off = np.stack([LAWS[law](half[n]).rvs(count, random_state=rng) for n in names])
    if together:
        root = np.linalg.cholesky(0.2 * np.eye(3) + 0.8)
        off = np.array(list(half.values()))[:, None] / 3 * (root @ rng.standard_normal((3, count)))
    g, h = (f("x", TABLE_1, names, guides=8.0) for f in (slopes, curvatures))
    mean, sd, _, error = moments(g @ off + np.einsum("in,ij,jn->n", off, h, off) / 2)
    assert abs(found.mean_shift - mean) < 6 * sd / np.sqrt(count)
    assert abs(found.sd - sd) < 6 * error
    assert abs(found.sd - found.first_order_sd) > 6 * error


def test_new_designs_are_not_compiled_again(monkeypatch, seed):
    """Compiled functions do not look the gain up once more."""
    monte_carlo(design(), 1000, axes=("z",))

    def fail(*_):
        raise AssertionError("traced again")

    monkeypatch.setattr(ks, "gain", fail)
    other = replace(paper_design(0.03), geometry=ks.Geometry(t4_mm=0.9, alpha2_rad=0.07), guides=6)
    told = []
    study = monte_carlo(other, 150_000, "normal", seed=seed, axes=("z",), progress=told.append)
    assert study.axes["z"].nominal == pytest.approx(gains("z", sizes(t4=0.9, alpha2=0.07)), rel=1e-12)
    assert any("150,000" in line for line in told)


def test_seeds_replay_and_twins_agree(seed):
    first, again = (monte_carlo(design(), 1234, seed=seed, axes=("y", "x")) for _ in range(2))
    assert first == again
    assert list(first.axes) == ["y", "x"]
    assert replace(first.axes["y"], axis="x") == first.axes["x"]
    assert monte_carlo(design(), 1234, seed=seed + 1, axes=("y", "x")) != first


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda: monte_carlo(design(), 10), "between 1,000 and 30,000,000 samples"),
        (lambda: monte_carlo(design(), distribution="cauchy"), "no distribution 'cauchy'"),
        (lambda: monte_carlo(design(), axes=("q",)), "no axis 'q'"),
        (lambda: monte_carlo(design(), axes=()), "choose some of x, y"),
        (lambda: monte_carlo(design(t1=0.02), axes=("z",)), "z does not spread"),
        (lambda: monte_carlo(design(t1=0.5), axes=("x",)), "t1 of 0.8 mm with a tolerance of 0.5 mm .* below 0.4 mm"),
        (lambda: second_order(design(), "w"), "no axis 'w'"),
    ],
)
def test_what_cannot_be_drawn_is_refused(change, told):
    with pytest.raises(DataError, match=told):
        change()
