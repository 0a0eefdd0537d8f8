"""How smooth the density is once causes are known: what they do was roughness of the density before."""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from scipy.linalg import qr

from fits.diagnosis._projector import Projector
from fits.diagnosis._regression import root_of
from fits.loop._evidence import maximise_evidence
from fits.loop._grid import EVIDENCE_LEVELS
from fits.loop._moments import Moments
from fits.loop._prior import Hyper, interpolation, roughness
from fits.stage._solve import prior_precision


def smoothed(projector: Projector, change_um: Sequence[np.ndarray]) -> Projector:
    """The same beside a density as smooth as is most probable under what causes change in each run, shape `(n,)`.

    Maximises the evidence for the columns as `solve_grid` does, from the noise as it was found, the coordinates and
    the runs' nuisance parameters free (MacKay, Neural Computation 4 (1992) 415).
    """
    regression = projector.regression
    baseline, count = regression.baseline, projector.count
    size, stroke_um = len(baseline.columns_um), baseline.stroke_um
    joined = projector.join(list(regression.rows))[:count]
    target = (projector.residual - projector.join(change_um))[:count] + joined[:, :size] @ baseline.columns_um
    others = np.concatenate([joined[:, size:], projector.own_rows[:count]], axis=1)
    scale = np.linalg.norm(others, axis=0)
    basis, _ = qr(others[:, scale > 0] / scale[scale > 0], mode="economic")
    columns = joined[:, :size] * stroke_um
    columns, target = (one - basis @ (basis.T @ one) for one in (columns, target))
    left = np.asarray(float(count - basis.shape[1]))
    moments = Moments(columns.T @ columns, columns.T @ target, np.asarray(target @ target), left)
    rough, levels = roughness(baseline.chain.levels), baseline.chain.levels
    if levels > EVIDENCE_LEVELS:
        fewer = interpolation(EVIDENCE_LEVELS, levels)
        moments, rough = moments.project(fewer), rough.project(fewer)
    start = replace(Hyper.start(), log_variance=jnp.zeros(()))
    prior = prior_precision(baseline.chain, maximise_evidence(moments, rough, start), stroke_um)
    moved = replace(regression, baseline=replace(baseline, prior=prior), root=root_of(prior))
    return Projector(moved, projector.noise, projector.roughness)
