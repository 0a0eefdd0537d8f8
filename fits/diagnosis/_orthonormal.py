"""Orthonormal columns that span others, and what is left of signals off them."""

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpstrf

from fits.io._threads import map_in_threads

# Part of a column, in squares, below which what the others leave of it is rounding.
SHOWN = 1e-9
# Signals that are projected at once.
AT_ONCE = 64


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """Orthonormal columns that span others, shape `(rows, k)`, without those that the others make up.

    By a pivoted Cholesky factor of their Gram matrix, twice: the first time rounding leaves them a little askew.
    """
    for _ in range(2):
        gram = columns.T @ columns
        scale = 1 / (np.sqrt(np.diagonal(gram)) + 1e-300)
        columns = columns @ (scale[:, None] * inverse_root(scale[:, None] * gram * scale))
    return columns


def take_off(joined: np.ndarray, basis: np.ndarray) -> None:
    """Project joined signals off orthonormal columns, in place and many at once: of long records they fill memory."""

    def take(at: int) -> None:
        columns = joined[:, at : at + AT_ONCE]
        columns -= basis @ (basis.T @ columns)

    map_in_threads(take, range(0, joined.shape[1], AT_ONCE))


def inverse_root(gram: np.ndarray) -> np.ndarray:
    """Matrix that makes columns of a Gram matrix orthonormal, shape `(k, rank)`, without what others make up."""
    if len(gram) == 0:
        return gram
    factor, pivots, rank, _ = dpstrf(gram, tol=SHOWN, lower=1)
    out = np.zeros((len(gram), rank))
    out[pivots[:rank] - 1] = solve_triangular(np.tril(factor)[:rank, :rank], np.eye(rank), lower=True).T
    return out
