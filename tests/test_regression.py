"""The regression behind a fit, against dense algebra, SciPy and the model itself."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.optimize import minimize, nnls, rosen, rosen_der
from scipy.stats import multivariate_normal

import fits
from fits.loop._design import Grid, columns_of
from fits.loop._finer import play_columns
from fits.loop._moments import gather
from fits.loop._prior import Evidence, Hyper, Posterior, interpolation, maximise_evidence, roughness
from fits.loop._run import prepare_run, simulate_run
from fits.stats._bfgs import minimise
from fits.stats._noise import correlation_samples, shared_square
from fits.stats._nonnegative import minimise_nonnegative, pivot_nonnegative

LEVELS = 6


def _record(rng, n=700, lower_V=-10.0, upper_V=90.0):
    turns = np.concatenate([[lower_V, upper_V], rng.uniform(lower_V, upper_V, 30), [lower_V]])
    voltage_V = np.interp(np.linspace(0, len(turns) - 1, n), np.arange(len(turns)), turns)
    return fits.Record(np.arange(n) * 0.01, voltage_V, voltage_V * 0.3 + rng.normal(0, 0.1, n))


@pytest.fixture
def problem(rng):
    runs = [prepare_run(_record(rng), (-10.0, 90.0), "negative", 0.0) for _ in range(2)]
    grid = Grid(jnp.asarray(-10.0), jnp.asarray(90.0), LEVELS)
    return grid, runs, gather(grid, runs)


def _dense(grid, runs):
    """Responses of every column alone, as the model itself gives them, each run from its mean."""
    blocks = []
    for run in runs:
        columns = [simulate_run(grid.model(np.eye(grid.columns)[k], np.zeros(())), run) for k in range(grid.columns)]
        response = np.stack(columns, axis=1)
        blocks.append(response - response.mean(axis=0))
    return np.concatenate(blocks)


def test_moments_of_the_compressed_record_are_those_of_all_samples(problem):
    grid, runs, data = problem
    dense = _dense(grid, runs)
    target = np.concatenate([run.displacement_um - run.displacement_um.mean() for run in runs])
    np.testing.assert_allclose(data.total.gram, dense.T @ dense, rtol=0, atol=1e-10 * len(dense))
    np.testing.assert_allclose(data.total.cross_um, dense.T @ target, rtol=0, atol=1e-10 * np.abs(target).sum())
    np.testing.assert_allclose(float(data.total.energy_um2), target @ target, rtol=1e-12)
    assert float(data.total.count) == len(target)


def test_blocks_of_as_many_pieces_are_consecutive_fifths(problem):
    grid, runs, _ = problem
    data = gather(grid, runs, pieces=5)
    counts = [float(block.count) for block in data.blocks]
    assert counts == [2 * 140.0] * 5
    one = runs[0].displacement_um[:140], runs[1].displacement_um[:140]
    np.testing.assert_allclose(float(data.blocks[0].energy_um2), sum(np.sum((y - y.mean()) ** 2) for y in one))


def test_columns_are_read_back_from_a_model(rng):
    grid = Grid(jnp.asarray(-3.0), jnp.asarray(7.0), LEVELS)
    columns = rng.uniform(0, 1, grid.columns)
    np.testing.assert_allclose(columns_of(grid.model(columns, np.zeros(()))), columns, rtol=1e-13)


def test_evidence_is_the_density_of_the_data_under_the_prior(rng):
    grid = Grid(jnp.zeros(()), jnp.ones(()), 4)
    run = prepare_run(_record(rng, 60, 0.0, 1.0), (0.0, 1.0), "negative", 0.0)
    data = gather(grid, [run])
    design, target = _dense(grid, [run]), run.displacement_um - run.displacement_um.mean()
    rough = roughness(4)
    evidence = Evidence(data.total, rough)

    def cost(*smooth, variance):
        prior = rough.precision(Hyper.of(*smooth, variance))
        covariance = np.exp(variance) * np.eye(len(target)) + design @ np.linalg.solve(prior, design.T)
        ours = evidence.value(np.array([*smooth, variance]))
        weak = np.sum(((np.array(smooth) - [-12.0, np.log(1e-2), 2.0, np.log(1e-2)]) / 6.0) ** 2) / 2
        return ours - weak, -multivariate_normal(np.zeros(len(target)), covariance).logpdf(target)

    points = ((-3.0, -1.0, -4.0, -2.0, -1.0), (1.0, -2.0, 0.5, -1.0, -3.0), (-5.0, 1.0, 0.0, 2.0, 0.0))
    pairs = [cost(*point[:-1], variance=point[-1]) for point in points]
    gaps = [ours - exact for ours, exact in pairs]
    np.testing.assert_allclose(gaps, gaps[0], rtol=0, atol=1e-6)
    assert abs(pairs[0][1] - pairs[1][1]) > 1  # the points differ, so agreement means something

    found = maximise_evidence(data.total, rough, Hyper.start())
    best = evidence.value(np.array([*found.weights, found.log_variance]))
    exact = minimize(evidence.value, points[0], method="Nelder-Mead", options={"maxiter": 4000})
    assert best <= exact.fun + 0.02


@pytest.mark.parametrize(
    "start", [None, Hyper.of(16.8, 1.0, 6.8, 4.7, -12.3), Hyper.of(-12.0, 0.0, 10.0, 6.0, -14.0)]
)
def test_noise_far_above_the_start_and_smoothness_that_counts_for_all_or_nothing_hide_no_evidence(rng, start):
    grid = Grid(jnp.asarray(-10.0), jnp.asarray(90.0), 16)
    record = _record(rng)
    shaken = np.where(rng.random(700) < 0.03, 40 * rng.choice([-1.0, 1.0], 700), 0.0)
    run = prepare_run(
        fits.Record(record.time_s, record.voltage_V, record.displacement_um + shaken), (-10, 90), "negative", 0
    )
    data, rough = gather(grid, [run]).total.scaled(1.0, 30.0), roughness(16)
    found, evidence = maximise_evidence(data, rough, start), Evidence(data, rough)
    # The noise is what is there, and nothing else is more probable, wherever it is looked for.
    assert np.exp(float(found.log_variance) / 2) == pytest.approx(np.std(shaken) / 30, rel=0.2)
    others = [np.array([*rng.uniform((-12, -5, -5, -5), (4, 3, 9, 6)), rng.uniform(-5, -1)]) for _ in range(6)]
    exact = [minimize(evidence.value, one, jac=evidence.slope, method="L-BFGS-B").fun for one in others]
    assert -evidence.of(found) <= np.nanmin(exact) + 1.0


def test_slope_of_the_evidence_is_that_of_its_values(problem):
    _, _, data = problem
    evidence, step = Evidence(data.total, roughness(LEVELS)), 1e-3
    for logs in ((-3.0, -1.0, -4.0, -2.0, -1.0), (2.0, -2.0, 3.0, 1.0, -3.0)):
        ahead, behind = ([evidence.value(logs + sign * step * unit) for unit in np.eye(5)] for sign in (1, -1))
        slope = (np.array(ahead) - behind) / (2 * step)
        np.testing.assert_allclose(evidence.slope(np.array(logs)), slope, rtol=1e-4, atol=1e-3)
    # And so it is beside plays, whose weight is the last.
    plays = play_columns(LEVELS)
    both = data.total.project(np.concatenate([np.eye(len(plays)), plays], axis=1))
    evidence, logs = Evidence(both, roughness(LEVELS).with_plays(plays.shape[1])), (-3.0, -1.0, -4.0, -2.0, -1.0, 3.0)
    ahead, behind = ([evidence.value(logs + sign * step * unit) for unit in np.eye(6)] for sign in (1, -1))
    slope = (np.array(ahead) - behind) / (2 * step)
    np.testing.assert_allclose(evidence.slope(np.array(logs)), slope, rtol=1e-4, atol=1e-3)


def test_quasi_newton_steps_find_the_bottom_of_a_valley_and_come_back_from_where_nothing_is_finite():
    def both(x):
        return rosen(x) if np.all(np.abs(x) < 3) else np.nan, rosen_der(x)

    found = minimise(both, np.array([-1.2, 1.0, 0.5]), 1e-9, 1e-9, 500)
    np.testing.assert_allclose(found, 1.0, rtol=0, atol=1e-6)
    few = minimise(both, np.array([-1.2, 1.0, 0.5]), 1e-9, 1e-9, 20)
    assert rosen([-1.2, 1.0, 0.5]) > rosen(few) > 1e-3


def test_posterior_is_that_of_dense_bayesian_regression(problem):
    grid, runs, data = problem
    hyper = Hyper.of(-2.0, -1.0, -3.0, -1.0, -4.0)
    rough = roughness(LEVELS)
    posterior = Posterior.of(data.total, rough, hyper)
    design = _dense(grid, runs)
    target = np.concatenate([run.displacement_um - run.displacement_um.mean() for run in runs])
    precision = design.T @ design * np.exp(4.0) + np.asarray(rough.precision(hyper))
    covariance = np.linalg.inv(precision)
    np.testing.assert_allclose(posterior.mean, covariance @ design.T @ target * np.exp(4.0), rtol=1e-6, atol=1e-8)
    factor = np.asarray(posterior.factor())
    np.testing.assert_allclose(factor @ factor.T, covariance, rtol=1e-5, atol=1e-9 * covariance.max())


def test_roughness_is_the_weighted_integral_of_squared_curvature_and_slope():
    # A quadratic has constant second derivatives: 2a, 2c and b along the two axes and mixed.
    n, (a, b, c) = 40, (1.3, -0.7, 0.4)
    v = np.linspace(0, 1, n)
    alpha, beta = (w[np.tril_indices(n)] for w in np.meshgrid(v, v, indexing="ij"))
    columns = np.concatenate([a * alpha**2 + b * alpha * beta + c * beta**2, 2 * v**2])
    rough = roughness(n)
    # Lines of equal distance from the diagonal get shorter with it; curvature counts by its square.
    area = quad(lambda x: (1 - x) * ((x + 0.05) / 0.35) ** 2, 0, 1)[0]
    curvature = ((2 * a) ** 2 + 2 * b**2 + (2 * c) ** 2) * area
    np.testing.assert_allclose(columns @ rough.density @ columns, curvature, rtol=0.15)
    # Along the diagonal both thresholds move.
    slope, _ = dblquad(
        lambda low, high: ((2 * a + b) * high + (b + 2 * c) * low) ** 2 * ((high - low + 0.05) / 0.35) ** 2,
        *(0, 1, 0, lambda high: high),
    )
    np.testing.assert_allclose(columns @ rough.along @ columns, slope, rtol=0.15)
    steep, _ = dblquad(
        lambda low, high: (
            ((2 * a * high + b * low) ** 2 + (b * high + 2 * c * low) ** 2) * ((high - low + 0.05) / 0.35) ** 2
        ),
        *(0, 1, 0, lambda high: high),
    )
    np.testing.assert_allclose(columns @ rough.slope @ columns, steep, rtol=0.15)
    np.testing.assert_allclose(columns @ rough.reversible @ columns, 16.0, rtol=0.1)
    straight = np.concatenate([3 + 2 * alpha - beta, 1 - v])
    for form in (rough.density, rough.reversible):
        assert abs(straight @ form @ straight) < 1e-6
    plays = np.concatenate([np.exp(-((alpha - beta) ** 2)), 1 - v])
    assert abs(plays @ rough.along @ plays) < 1e-6


def test_interpolated_columns_respond_as_the_coarse_ones_where_the_grids_share_nodes(rng):
    coarse, fine = (Grid(jnp.zeros(()), jnp.ones(()), n) for n in (5, 9))
    columns = rng.uniform(0, 1, coarse.columns)
    run = prepare_run(_record(rng, 300, 0.0, 1.0), (0.0, 1.0), "negative", 0.0)
    one = simulate_run(coarse.model(columns, np.zeros(())), run)
    other = simulate_run(fine.model(interpolation(5, 9) @ columns, np.zeros(())), run)
    np.testing.assert_allclose(one, other, rtol=0, atol=0.02 * np.ptp(one))


def traced(hessian, linear, start, atol, most_steps):
    return minimise_nonnegative(*map(jnp.asarray, (hessian, linear, start)), atol, most_steps)


@pytest.mark.parametrize("solve", [traced, pivot_nonnegative])
@pytest.mark.parametrize("condition", [1e1, 1e6, 1e10])
def test_block_pivoting_finds_the_minimum_that_nnls_finds(rng, condition, solve):
    size = 40
    rotation = np.linalg.qr(rng.normal(size=(size, size)))[0]
    root = rotation * np.geomspace(1, condition**-0.5, size) @ rotation.T
    hessian = root.T @ root
    target = rng.normal(size=size)
    linear = root.T @ target

    def cost(y, _):
        return y @ (hessian @ y) / 2 - linear @ y

    found, success = solve(hessian, -linear, rng.normal(size=size), 1e-8, 400)
    assert success
    exact, _ = nnls(root, target, maxiter=10000)
    y = np.asarray(found)
    assert np.all(y >= 0)
    assert np.any(y == 0)
    np.testing.assert_allclose(cost(y, None), cost(exact, None), rtol=1e-7)
    gradient = hessian @ y - linear
    assert np.all(gradient > -1e-6)
    assert np.all(np.abs(gradient[y > 0]) < 1e-6)


@pytest.mark.parametrize("solve", [traced, pivot_nonnegative])
def test_block_pivoting_says_when_it_ran_out_of_steps_or_there_is_no_minimum(rng, solve):
    root = rng.normal(size=(30, 30))
    hessian, linear = root.T @ root, -root.T @ rng.normal(size=30)
    assert not solve(hessian, linear, np.zeros(30), 1e-10, 1)[1]
    assert solve(hessian, linear, np.zeros(30), 1e-10, 400)[1]
    assert not solve(-hessian, linear, np.ones(30), 1e-10, 400)[1]


@pytest.mark.parametrize("memory", [0.0, 0.6, 0.9])
def test_correlation_time_of_an_autoregression(rng, memory):
    n = 200_000
    noise = rng.normal(size=n)
    series = np.empty(n)
    series[0] = noise[0]
    for k in range(1, n):
        series[k] = memory * series[k - 1] + noise[k]
    found = correlation_samples([series[: n // 2], series[n // 2 :]])
    np.testing.assert_allclose(found, (1 + memory) / (1 - memory), rtol=0.15)
    # Autocovariance at lag k is memory**k / (1 - memory**2).
    shared = np.mean(memory ** np.arange(1, 11)) / (1 - memory**2)
    np.testing.assert_allclose(shared_square(series), shared, rtol=0.1, atol=0.01)
