"""Regressions whose matrices are definite but for rounding, against SciPy's non-negative least squares."""

import numpy as np
import pytest
from scipy.optimize import nnls

from fits.loop._grid import non_negative
from fits.loop._prior import Posterior, cholesky, definite
from fits.loop._result import FitError


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
