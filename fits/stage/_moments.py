"""A whole stage as a regression: linear in the columns of its hysteresis, linearised in its other parameters."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.io._kept import kept
from fits.loop._moments import Moments
from fits.loop._run import Run, Samples
from fits.stage._chain import Chain
from fits.stage._columns import PIECE, combined, passes_linearly, pieces, propagated
from fits.stage._run import ahead, nuisance_columns, project_out, respond


@kept
def _linearised(
    chain: Chain, z: Float[Array, " p"], columns_um: Float[Array, " D"] | None, samples: Samples
) -> tuple[Float[Array, " n"], Float[Array, "n p"], Float[Array, "n k"]]:
    def response(z: Float[Array, " p"]) -> tuple[Array, Array]:
        out = respond(chain.stage(z, columns_um), samples)
        return out, out

    slope, out = jax.jacfwd(response, has_aux=True)(z)
    return out, slope, nuisance_columns(chain.stage(z, columns_um), samples)


@dataclass(frozen=True)
class RunSums:
    """What one run adds to the regression on columns and coordinates, its nuisance parameters eliminated.

    `mean` is that of the rows over the fitted samples, shape `(D + p,)`; the residual at all samples is `(n,)`.
    """

    moments: Moments
    mean: np.ndarray
    residual_um: np.ndarray


def run_sums(
    chain: Chain,
    z: Float[Array, " p"],
    columns_um: Float[Array, " D"],
    run: Run,
    free: bool = True,
    refined: bool = False,
) -> RunSums:
    """Pass one run through the regression on coordinates and, if they are `free`, columns, linearised there.

    Columns may be `refined`, followed between samples as well.
    """
    samples, size = run.samples, chain.size if free else 0
    out, slope, nuisance = linearise(chain, z, columns_um, run.coarser)
    if run.coarser is not run:
        out = np.asarray(respond(chain.stage(z, columns_um), samples))
    weight = np.asarray(samples.weight)
    residual = np.asarray(samples.displacement_um) - out
    root = np.sqrt(weight)
    known = size + slope.shape[1]
    rows = np.empty((min(len(weight), PIECE), known + nuisance.shape[1]))
    sums = Moments.empty(rows.shape[1])
    for first, columns in pieces(chain, z, run, free, refined):
        piece = slice(first, first + columns.shape[0])
        used = rows[: columns.shape[0]]
        used[:, :size], used[:, size:known], used[:, known:] = columns, slope[piece], nuisance[piece]
        target = root[piece] * (residual[piece] + columns @ np.asarray(columns_um)[:size])
        used *= root[piece, None]
        energy, count = np.asarray(target @ target), np.asarray(weight[piece].sum())
        sums = sums + Moments(used.T @ used, used.T @ target, energy, count)
    reduced, _, _ = split_moments(sums, known, 0.0)
    off = np.asarray(project_out(jnp.asarray(nuisance), samples.weight, jnp.asarray(residual)))
    return RunSums(reduced, np.asarray(sums.gram)[:known, known] / weight.sum(), off[: len(run.record)])


def linearise(
    chain: Chain, z: Float[Array, " p"], columns_um: Float[Array, " D"] | None, run: Run
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Response of a padded run, its slopes along the coordinates, and its nuisance columns."""
    out, slope, nuisance = _linearised(chain, z, columns_um, run.samples)
    return np.asarray(out), np.asarray(slope), np.asarray(nuisance)


def along(
    chain: Chain,
    z: Float[Array, " p"],
    columns_um: Float[Array, " D"] | None,
    run: Run,
    directions: Sequence[np.ndarray],
    slope: np.ndarray | None = None,
    reduce: Callable[[np.ndarray], np.ndarray] = lambda moved: moved,
) -> np.ndarray:
    """Move columns, `(D, k)`, and coordinates, `(p, k)`, to first order: changes of the displacement, shape `(n, k)`.

    Without columns the run is linearised at those that the stage has, whose grid may then differ from the chain's.
    The `slope` along the coordinates, shape `(n, p)`, may be known. Of the changes of each piece, `(samples, k)`,
    only what `reduce` makes of them is kept.
    """
    slope = linearise(chain, z, columns_um, run)[1] if slope is None else slope
    moved_um: Iterable[np.ndarray] = combined(chain, z, run, directions[0])
    if chain.place is not None and not passes_linearly(stage := chain.stage(z, columns_um), chain.place):
        # What is not linear needs all of a record at a time.
        given_um = np.asarray(ahead(stage, chain.place + 1, run.samples).values)
        around_um = given_um[:: run.samples.stride][: len(run.record)]
        whole_um = np.concatenate([*moved_um])
        whole_um = propagated(chain.coordinates, chain.place, z, run, around_um, whole_um)
        moved_um = (whole_um[first : first + PIECE] for first in range(0, len(whole_um), PIECE))
    found, first = [], 0
    for each in moved_um:
        found.append(reduce(each + slope[first : first + len(each)] @ directions[1]))
        first += len(each)
    return np.concatenate(found)


def split_moments(total: Moments, size: int, damping: float) -> tuple[Moments, np.ndarray, np.ndarray]:
    """Eliminate the last unknowns of a regression, all but the first `size`, with Marquardt's damping.

    Returns the moments of those that stay, the others at their best for each; the best of the others without them,
    shape `(p,)`; and what that loses for each of them, shape `(p, D)`.
    """
    gram, cross = np.asarray(total.gram), np.asarray(total.cross_um)
    block = gram[size:, size:]
    # What nothing depends on, such as a lag at its bound, stays where it is.
    least = max(1e-14 * float(np.trace(block)), np.finfo(float).tiny)
    block = block + damping * np.diag(np.diagonal(block)) + least * np.eye(len(block))
    answer, follow = np.linalg.solve(block, cross[size:]), np.linalg.solve(block, gram[size:, :size])
    return total.reduced(size, answer, follow), answer, follow
