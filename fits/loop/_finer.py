"""What a density that is finer than its grid may do to predictions: plays beside it, whose size is learnt."""

from collections.abc import Sequence

import numpy as np
import scipy

from fits.loop._design import Grid
from fits.loop._grid import BELIEF_LEVELS, EVIDENCE_LEVELS, GridSolution, non_negative
from fits.loop._moments import Data, gather, grid_of
from fits.loop._prior import Evidence, Hyper, Posterior, cholesky, interpolation, maximise_evidence, roughness
from fits.loop._run import Run

# Plays are as close together as so many levels at least.
_LEVELS = 45
# Where the evidence for plays is looked for, see `Hyper`, and where there are none.
_SOME, _NONE = 8.0, 20.0
# By so many e-folds the slope may count more beside plays, and the noise be greater, where that begins.
_MORE = (4.0, 1.0)
# In natural logarithms of the evidence, what one more unknown must be worth (Akaike).
_WORTH = 1.0


def factor_with_plays(
    data: Data, runs: Sequence[Run], solution: GridSolution, stroke_um: float
) -> tuple[Grid, np.ndarray, np.ndarray] | None:
    """Factor of the covariance of a grid's columns beside plays, in um, `(D, k)`, and its mean response, `(k,)`.

    A sum of few plays is a density of sharp ridges along the diagonal, which no smooth one follows. Here each width
    has a play of its own. None where the records, whose noise is white, are not more probable with them.
    """
    fine = data if data.grid.levels >= _LEVELS else gather(grid_of(runs, _LEVELS), runs)
    levels, hyper = fine.grid.levels, solution.hyper
    plays = play_columns(levels)
    basis = np.concatenate([interpolation(BELIEF_LEVELS, levels), plays], axis=1)
    moments = fine.total.scaled(1.0, stroke_um).project(basis)
    # As in the fit, few levels are enough to find what weighs what.
    fewer = scipy.linalg.block_diag(interpolation(EVIDENCE_LEVELS, BELIEF_LEVELS), np.eye(plays.shape[1]))
    few, rough = moments.project(fewer), roughness(EVIDENCE_LEVELS).with_plays(plays.shape[1])
    weights = [float(weight) for weight in hyper.weights]
    start = weights[0], weights[1] + _MORE[0], *weights[2:], float(hyper.log_variance) + _MORE[1], _SOME
    found = maximise_evidence(few, rough, Hyper.of(*start))
    without, evidence = Hyper.of(*weights, hyper.log_variance, _NONE), Evidence(few, rough)
    if not evidence.of(found) > evidence.of(without) + _WORTH:
        return None
    rough = roughness(BELIEF_LEVELS).with_plays(plays.shape[1])
    posterior, alone = (Posterior.of(moments, rough, one) for one in (found, without))
    factor = bounded_factor(posterior)
    if factor is None:
        return None
    # The fit is one without plays: it may be off by what they change.
    factor = stroke_um * basis @ np.concatenate([factor, (posterior.mean - alone.mean)[:, None]], axis=1)
    return fine.grid, factor, fine.means[0].response @ factor


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
