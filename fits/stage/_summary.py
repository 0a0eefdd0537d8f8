"""A solution of the joint fit put into the terms of its user."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from fits.loop._result import FitResult, FitStatus, ParameterEstimate, RunReport
from fits.loop._run import Run
from fits.stage._checks import check_gains
from fits.stage._run import residual_of, simulate_stage
from fits.stage._uncertainty import Precision
from fits.stats._identifiability import unseen_directions
from fits.stats._metrics import TWO_SIDED_95
from fits.stats._noise import WHITE
from microid import Stage

# A coordinate, of the order of 1, that is known no better than this is hardly seen.
_UNSEEN_SD = 0.5


def summarise(precision: Precision, held: Sequence[Run]) -> FitResult[Stage]:
    """Put the fit of a stage, and runs that were held out, into words and figures.

    A `DataError` if the runs turn out not to be of one rig.
    """
    coordinates, solved, stage = precision.chain.coordinates, precision.solved, precision.solved.stage
    remarks = check_gains(stage, solved.runs, refuse=True)
    covariance = precision.covariance(precision.influence())
    sd = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    names, value, slope = solved.parameters()
    ends = [np.asarray(coordinates.values(jnp.asarray(solved.z + sign * TWO_SIDED_95 * sd))) for sign in (-1, 1)]
    # Of what is hardly seen the interval alone says how wide it is: at a bound the slope vanishes.
    width = np.where(sd > _UNSEEN_SD, np.abs(ends[1] - ends[0]) / (2 * TWO_SIDED_95), np.abs(slope) * sd)
    parameters = tuple(
        ParameterEstimate(name, unit, *map(float, figures))
        for (name, unit), *figures in zip(names, value, width, *ends, strict=True)
    )
    unseen = unseen_directions(precision.information, [name for name, _ in names], slope / value)
    reports = []
    weighing = solved.weighing
    for run, noise_um, correlation in zip(solved.runs, weighing.noise_um, weighing.correlation, strict=True):
        figures = {"noise_um": noise_um, "correlation_samples": correlation, "substeps": run.stride}
        reports.append(_report(stage, run, **figures))
        if correlation > WHITE:
            remarks.append(
                f"{run.record.source}: neighbouring residuals agree over {correlation:.0f} samples: something other "
                "than sensor noise (creep, rate, a second mode, drift) is left that this model does not describe"
            )
    reports += [_report(stage, run) for run in held]
    return FitResult(
        model=_with_offset(stage, reports[0].offset_um).with_substeps(max(run.stride for run in solved.runs)),
        uncertainty=precision.uncertainty(),
        status=FitStatus.CONVERGED,
        remarks=(*remarks, *unseen),
        runs=tuple(reports),
        smoothness=None if solved.hyper is None else float(np.exp(solved.hyper.log_density)),
        parameters=parameters,
        correlation=covariance / np.maximum(np.outer(sd, sd), 1e-300),
        unseen=unseen,
    )


def _with_offset(stage: Stage, offset_um: float) -> Stage:
    """Put a sensor's offset where the stage has room for one."""
    for name, part in zip(stage.names, stage.parts, strict=True):
        if hasattr(part, "offset_um"):
            return stage.swap(name, eqx.tree_at(lambda p: p.offset_um, part, part.offset_um + offset_um))
    return stage


def _report(stage: Stage, run: Run, **figures: Any) -> RunReport:
    # A run that was only predicted still has an offset of its own.
    counted = run if run.fitted.any() else replace(run, fitted=run.known)
    predicted = run.displacement_um - residual_of(stage, counted)
    offset = float(np.mean((predicted - simulate_stage(stage, counted))[counted.fitted]))
    return RunReport.of(run, predicted, offset, run.start, **figures)
