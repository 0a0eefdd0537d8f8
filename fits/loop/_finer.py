"""What a density that is finer than its grid may do to predictions: plays beside it, whose size is learnt."""

from collections.abc import Sequence

import numpy as np
import scipy

from fits.loop._design import Columns, Grid, branches_of
from fits.loop._grid import EVIDENCE_LEVELS, non_negative
from fits.loop._moments import Data, gather, grid_of
from fits.loop._prior import Evidence, Hyper, Posterior, cholesky, interpolation, maximise_evidence, reread, roughness
from fits.loop._run import Run

# Plays are a third as far apart as levels of the smooth density beside them at most.
_FINER = 3
# Where the evidence for plays is looked for, see `Hyper`, and where there are none.
_SOME, _NONE = 10.0, 20.0
# By so many e-folds the noise is greater where that begins: a first step is along the noise, which is known best.
_MORE = 1.0
# In natural logarithms of the evidence, what one more unknown must be worth (Akaike).
_WORTH = 1.0


def factor_with_plays(
    fitted: Data, columns_um: np.ndarray, runs: Sequence[Run], hyper: Hyper, stroke_um: float
) -> tuple[Grid, np.ndarray, np.ndarray] | None:
    """Factor of the covariance of a grid's columns beside plays, in um, `(D, k)`, and its mean response, `(k,)`.

    A sum of few plays is a density of sharp ridges along the diagonal, which no smooth one follows. Here each width
    has a play of its own, about as many as the fit had levels, and 46 at least; `columns_um` and `hyper` are what
    that fit found. None where the records, whose noise is white, are not more probable with them.
    """
    finer = max(_FINER, round((fitted.grid.levels - 1) / (EVIDENCE_LEVELS - 1)))
    levels = finer * (EVIDENCE_LEVELS - 1) + 1
    # The levels of the smooth density are among those of the plays: on these it is exactly what it is on its own.
    grid, plays = grid_of(runs, levels), play_columns(levels)
    beside = Columns(branches_of(plays, levels), plays.shape[1], ridges)
    data = gather(grid_of(runs, EVIDENCE_LEVELS), runs, 1, beside=beside)
    moments, rough = data.total.scaled(1.0, stroke_um), roughness(EVIDENCE_LEVELS).with_plays(plays.shape[1])
    start = Hyper.of(*hyper.weights, hyper.log_variance + _MORE, _SOME)
    without = Hyper.of(*hyper.weights, hyper.log_variance, _NONE)
    found, evidence = maximise_evidence(moments, rough, start), Evidence(moments, rough)
    if not evidence.of(found) > evidence.of(without) + _WORTH:
        return None
    posterior = Posterior.of(moments, rough, found)
    factor = bounded_factor(posterior)
    if factor is None:
        return None
    smooth = interpolation(EVIDENCE_LEVELS, levels)
    # The fit is one without plays: it may be off by what is different with them.
    fit = reread(columns_um[:, None], fitted.grid.levels, levels)[:, 0]
    columns = np.concatenate([smooth, plays], axis=1) @ np.c_[factor, posterior.mean] * stroke_um
    response = data.means[0].response @ np.c_[factor, posterior.mean] * stroke_um
    columns[:, -1] -= fit
    response[-1] -= fitted.means[0].response @ columns_um
    return grid, columns, response


def bounded_factor(posterior: Posterior) -> np.ndarray | None:
    """Factor of the covariance among non-negative columns, `(D, D)`, roughly; None where there is no mode.

    Where a bound holds and the posterior falls off as `exp(-slope x)` beyond, a column stays as near as `1 / slope`.
    """
    columns, found = non_negative(posterior)
    if not found:
        return None
    slope = np.where(columns == 0, np.maximum(posterior.precision @ (columns - posterior.mean), 0.0), 0.0)
    root = cholesky(posterior.precision + np.diag(slope**2))
    return np.asarray(scipy.linalg.solve_triangular(root, np.eye(len(root)), lower=True).T)


def play_columns(levels: int) -> np.ndarray:
    """Columns of plays as wide as the diagonals of a grid, of a slope of 1 per range each, `(D, levels - 2)`."""
    i, j = np.tril_indices(levels)
    plays = np.zeros((len(i) + levels, levels))
    plays[np.arange(len(i)), i - j] = levels - 1
    return plays[:, 1:-1]


def ridges(high: np.ndarray, low: np.ndarray, out: np.ndarray) -> None:
    """Write what plays add on a rectangle, `(levels - 2, m)`; see `Columns`."""
    n = len(high)
    for k in range(1, n - 1):
        np.einsum("im,im->m", high[k:], low[: n - k], out=out[k - 1])
    # What the nodes under the diagonal triangles take off beside the diagonal, see `rectangles`.
    out[0] -= np.einsum("im,im->m", high[:-1], low[1:])
    out *= n - 1
