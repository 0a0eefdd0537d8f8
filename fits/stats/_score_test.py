"""Score tests: the evidence for signatures in what a fit leaves, whose multiples may have a sign."""

import numpy as np
from scipy import special

# Samples that are taken to err alike.
BLOCK = 25
# A decrease beyond which the probability of as much by chance is that of the tail's first term: less than rounding.
_FAR = 1000.0


def squares(columns: np.ndarray) -> np.ndarray:
    """Sum of squares of every column, shape `(k,)`."""
    return np.einsum("ij,ij->j", columns, columns)


def standard_deviations(drop: np.ndarray | float, freedom: np.ndarray | float) -> np.ndarray:
    """Standard deviations of a normal variable that chance exceeds as seldom as `drop` by so many squares of them.

    `freedom` is the number of coefficients that the decrease took, which broadcasts against `drop`.
    """
    half, x = np.asarray(freedom) / 2, np.maximum(drop, 0.0) / 2
    shape = np.maximum(half, 0.5)
    with np.errstate(divide="ignore"):
        log_p = np.where(
            2 * x < _FAR,
            np.log(special.gammaincc(shape, np.minimum(x, _FAR / 2))),
            (shape - 1) * np.log(np.maximum(x, 1.0)) - x - special.gammaln(shape),
        )
    return np.where(half > 0, np.maximum(-special.ndtri_exp(log_p - np.log(2.0)), 0.0), 0.0)


def robust_z(along: np.ndarray, residual: np.ndarray) -> float:
    """Size of a fitted signal over the standard deviation that blocks of what is left of the residual give it."""
    products = along * (residual - along)
    blocks = np.add.reduceat(products, np.arange(0, len(products), BLOCK))
    return float(along @ along / max(float(np.linalg.norm(blocks)), 1e-300)) if np.any(along) else 0.0


def evidence(
    columns: np.ndarray, residual: np.ndarray, positive: bool, most: float = np.inf
) -> tuple[float, np.ndarray, float]:
    """Standard deviations, coefficients up to `most` where they are positive, and decrease of the sum of squares."""
    gram = columns.T @ columns
    # What shows nowhere has no multiple: rounding over nothing would be one.
    scale = np.where(np.diagonal(gram) > 0, np.sqrt(np.diagonal(gram)), 1.0)
    normal, cross = gram / scale[:, None] / scale[None, :], (columns.T @ residual / scale)[:, None]
    multiples = best_multiples(normal, cross, positive, most * scale)
    z, drop = evidence_of(normal, cross, multiples)
    return float(z[0]), multiples[:, 0] / scale, float(drop[0])


def best_multiples(gram: np.ndarray, cross: np.ndarray, positive: bool, most: np.ndarray) -> np.ndarray:
    """Best multiples of signatures, whose `gram` has a diagonal of ones and zeros, shape `(k, draws)`.

    Where none may be negative, one at a time is put where the others leave it (coordinate descent): signatures of
    different runs have little in common.
    """
    if not positive:
        return np.linalg.pinv(gram, rcond=1e-10, hermitian=True) @ cross
    found = np.zeros_like(cross)
    for _ in range(30 if len(gram) > 1 else 1):
        for k, row in enumerate(gram):
            found[k] = np.clip(found[k] + cross[k] - row @ found, 0.0, most[k]) if row[k] > 0 else 0.0
    return found


def evidence_of(gram: np.ndarray, cross: np.ndarray, multiples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations and decreases: chance takes a square of them for each signature in use."""
    drop = np.einsum("ij,ij->j", multiples, 2 * cross - gram @ multiples)
    return standard_deviations(drop, np.count_nonzero(multiples, axis=0)), drop
