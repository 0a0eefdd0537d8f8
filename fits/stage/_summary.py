"""A solution of the joint fit put into the terms of its user."""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from fits.io._limits import measured_ranges
from fits.loop._result import FitStatus, RunReport
from fits.stage._checks import compare_gains, coordinates_slope
from fits.stage._result import ParameterEstimate, StageFit
from fits.stage._run import StageRun, residual_of, simulate_stage
from fits.stage._solve import Solved
from fits.stage._uncertainty import Precision
from fits.stats._identifiability import unseen_directions
from fits.stats._metrics import Errors, errors, loop_width_pct
from microid import Coordinates, Stage, Staircase

# Half the width of a 95 % interval, in standard deviations.
_NORMAL = 1.959964
# A residual less correlated than this counts as white.
_WHITE = 1.2
# A coordinate, of the order of 1, that is known no better than this is hardly seen.
_UNSEEN = 0.5


def summarise(
    stage: Stage,
    coordinates: Coordinates[Stage],
    solved: Solved,
    precision: Precision,
    held: Sequence[StageRun],
) -> StageFit:
    """Put a solution into words and figures.

    Parameters
    ----------
    stage
        The solution.
    coordinates
        Of its parameters outside the grid.
    solved
        Where the fit ended.
    precision
        What it knows.
    held
        Runs that were not fitted.

    Raises
    ------
    DataError
        If the runs turn out not to be of one rig.
    """
    remarks = compare_gains(stage, solved.runs, refuse=True)
    strides = tuple(run.samples.stride for run in solved.runs)
    covariance = precision.covariance(precision.influence())
    sd = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    names = [
        (stage.named(info.path) + _index(info.shape, place), info.spec.unit)
        for info in coordinates.table
        for place in range(int(np.prod(info.shape)))
    ]
    value, slope = coordinates_slope(coordinates, solved.z)
    ends = [np.asarray(coordinates.values(jnp.asarray(solved.z + sign * _NORMAL * sd))) for sign in (-1, 1)]
    # Of what is hardly seen the interval alone says how wide it is: at a bound the slope vanishes.
    width = np.where(sd > _UNSEEN, np.abs(ends[1] - ends[0]) / (2 * _NORMAL), np.abs(slope) * sd)
    parameters = tuple(
        ParameterEstimate(name, unit, *map(float, figures))
        for (name, unit), *figures in zip(names, value, width, *ends, strict=True)
    )
    unseen = unseen_directions(precision.information, [name for name, _ in names], slope / value)
    for run, correlation in zip(solved.runs, solved.weighing.correlation, strict=True):
        if correlation > _WHITE:
            remarks.append(
                f"{run.record.source}: neighbouring residuals agree over {correlation:.0f} samples: something other "
                "than sensor noise (creep, rate, a second mode, drift) is left that this model does not describe"
            )
    reports = [_report(stage, run) for run in (*solved.runs, *held)]
    return StageFit(
        model=_with_offset(stage, reports[0].offset_um).with_substeps(max(strides)),
        uncertainty=precision.uncertainty(),
        status=FitStatus.CONVERGED,
        remarks=(*remarks, *unseen),
        parameters=parameters,
        correlation=covariance / np.maximum(np.outer(sd, sd), 1e-300),
        unseen=unseen,
        noise_um=solved.weighing.noise_um,
        correlation_samples=solved.weighing.correlation,
        substeps=strides,
        runs=tuple(reports),
    )


def _index(shape: tuple[int, ...], place: int) -> str:
    return "" if shape == () else str(list(map(int, np.unravel_index(place, shape))))


def _with_offset(stage: Stage, offset_um: float) -> Stage:
    """Put a sensor's offset where the stage has room for one."""
    for name, part in zip(stage.names, stage.parts, strict=True):
        if hasattr(part, "offset_um"):
            return stage.swap(name, eqx.tree_at(lambda p: p.offset_um, part, part.offset_um + offset_um))
    return stage


def _report(stage: Stage, run: StageRun) -> RunReport:
    measured, fitted = run.displacement_um, run.fitted
    # A run that was only predicted still has an offset of its own.
    run = run if run.fitted.any() else replace(run, fitted=run.known).weighted(run.known)
    predicted = measured - residual_of(stage, run)
    offset = float(np.mean((predicted - simulate_stage(stage, run))[run.fitted]))
    range_um = float(np.ptp(measured[run.known]))

    def compare(samples: np.ndarray) -> Errors | None:
        return errors(measured[samples], predicted[samples], range_um) if samples.any() and range_um > 0 else None

    voltage = run.record.voltage_V[run.known]
    start = run.samples.start.memory
    return RunReport(
        source=run.record.source,
        offset_um=offset,
        in_sample=compare(fitted),
        held_out=compare(run.known & ~fitted),
        unknown=int(np.sum(~run.known)),
        start=Staircase(start.extremes_V, start.count),
        loop_measured_pct=loop_width_pct(voltage, measured[run.known]),
        loop_model_pct=loop_width_pct(voltage, predicted[run.known]),
        reached=measured_ranges(run.record),
    )
