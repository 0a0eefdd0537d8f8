"""What data and priors say of the columns of a hysteresis and the coordinates of a stage, as precisions."""

import numpy as np

from fits.loop._moments import Moments
from fits.loop._prior import Hyper, definite, roughness
from fits.stage._chain import Chain


def prior_precision(chain: Chain, hyper: Hyper | None, stroke_um: float) -> np.ndarray:
    """Precision of the columns before the data, in 1/um^2, shape `(D, D)`; zero where they are given."""
    if hyper is None:
        return np.zeros((chain.size, chain.size))
    return np.asarray(roughness(chain.levels).precision(hyper)) / stroke_um**2


def scale_free(prior: np.ndarray, columns_um: np.ndarray) -> np.ndarray:
    """Take off what a prior says of the scale of all columns together, which is for the data to say; `(D, D)`."""
    pull = prior @ columns_um
    return prior - np.outer(pull, pull) / max(float(columns_um @ pull), 1e-300)


def marginal_information(total: Moments, size: int, prior: np.ndarray | None, variance: float) -> np.ndarray:
    """Precision of the coordinates, whatever the first `size` unknowns, the columns, may be, shape `(p, p)`."""
    gram = np.asarray(total.gram) / variance
    if size == 0 or prior is None:
        return gram
    _, root = definite(gram[:size, :size] + prior)
    half = np.linalg.solve(root, gram[:size, size:])
    return gram[size:, size:] - half.T @ half
