"""Regressions whose matrices are definite but for rounding, against SciPy's non-negative least squares."""

import numpy as np
import pytest
from scipy.optimize import nnls

import fits
from fits.loop._grid import non_negative
from fits.loop._moments import gather, grid_of
from fits.loop._prior import Hyper, Posterior, cholesky, definite, roughness
from fits.loop._result import FitError
from fits.loop._run import prepare_run


def indefinite(rng, size=40, below=1e-11):
    """A precision of few directions, and one that rounding has made a little less than none."""
    basis, _ = np.linalg.qr(rng.standard_normal((size, size)))
    value = np.r_[-below, np.geomspace(1e-6, 1.0, size - 1)]
    matrix = (basis * value) @ basis.T
    return (matrix + matrix.T) / 2


def test_a_precision_without_a_factor_gets_one_and_keeps_what_it_says(rng):
    precision = indefinite(rng)
    assert not np.all(np.isfinite(cholesky(precision)))
    raised, root = definite(precision)
    np.testing.assert_allclose(root @ root.T, raised, rtol=0, atol=1e-14)
    np.testing.assert_allclose(raised, precision, rtol=0, atol=1e-9)


@pytest.mark.parametrize("precision", [np.full((3, 3), np.nan), np.zeros((3, 3)), -np.eye(3)])
def test_what_is_no_precision_is_refused(precision):
    with pytest.raises(FitError):
        definite(precision)


def test_a_precision_with_a_factor_stays_as_it_is(rng):
    matrix = rng.standard_normal((30, 10))
    precision = matrix.T @ matrix
    kept, root = definite(precision)
    assert kept is precision
    np.testing.assert_array_equal(root, np.linalg.cholesky(precision))


@pytest.mark.parametrize("size", [12, 90])
def test_columns_that_may_not_be_negative_are_found_without_a_factor(rng, size):
    design = rng.standard_normal((3 * size, size))
    target = design @ np.maximum(rng.standard_normal(size), 0) + 0.3 * rng.standard_normal(3 * size)
    precision, nothing = design.T @ design, np.full((size, size), np.nan)
    mean = np.linalg.solve(precision, design.T @ target)
    columns, found = non_negative(Posterior(mean, precision, nothing))
    assert found
    np.testing.assert_allclose(columns, nnls(design, target)[0], rtol=0, atol=1e-8)


def test_bounded_columns_are_the_minimum_where_the_precision_is_all_but_singular(rng):
    # One way up holds nothing about what comes down, and hardly any noise makes all else certain.
    voltage_V = np.linspace(0.0, 100.0, 400)
    read_um = 0.1 * voltage_V + 1e-3 * voltage_V**2 + 0.05 * np.sin(voltage_V / 9) + 1e-4 * rng.standard_normal(400)
    run = prepare_run(fits.Record(np.arange(400.0), voltage_V, read_um), (0.0, 100.0), "negative", 0.0)
    data = gather(grid_of([run], 16), [run])
    hyper = Hyper.of(0.0, 0.0, 6.0, 0.0, -23.0)
    posterior = Posterior.of(data.total.scaled(1.0, float(np.ptp(read_um))), roughness(16), hyper)
    columns, found = non_negative(posterior)
    scale = np.sqrt(np.diagonal(posterior.precision))
    slope = posterior.precision @ (columns - posterior.mean) / scale
    assert found
    assert np.any(columns == 0)
    assert np.max(np.abs(slope[columns > 0])) < 1e-2
    assert np.min(slope[columns == 0]) > -1e-2
