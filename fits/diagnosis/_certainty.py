"""How sure the parameters of driver and mechanics are, beside what causes and density may have taken up of them."""

from dataclasses import replace

import numpy as np

from fits.diagnosis._baseline import Baseline
from fits.diagnosis._effects import Bench
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, changes_along
from fits.loop._result import ParameterEstimate
from fits.stage._uncertainty import estimates


def stage_estimates(
    projector: Projector, model: Refit, bench: Bench, baseline: Baseline
) -> tuple[ParameterEstimate, ...]:
    """Parameters at a baseline with their intervals, effects of a model fitted beside them.

    Density, roughness and what each run has of its own are marginalised. All is linearised where the projector is.
    """
    regression, size = projector.regression, projector.regression.baseline.chain.size
    if regression.size == size:
        return ()
    rows = tuple(one[:, :size] for one in regression.rows)
    density = Projector(replace(regression, rows=rows), projector.noise, projector.roughness, projector.held)
    both = zip(regression.rows, changes_along(bench, model), strict=True)
    tangent = density.off(density.join([np.concatenate([one[:, size:], more], axis=1) for one, more in both]))
    sd = np.sqrt(np.diagonal(replace(model, tangent=tangent).covariance()))
    return estimates(baseline.chain, baseline.z, sd[: regression.size - size])
