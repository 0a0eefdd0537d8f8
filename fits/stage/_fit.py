"""From slow and fast records to a whole fitted stage, in the terms of its user."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np

import microid as m
from fits.io._errors import DataError
from fits.io._given import AnyRuns, holdout_given, records_given
from fits.io._record import Record
from fits.io._threads import one_thread
from fits.loop._fit import correlated
from fits.loop._lost import without_lost
from fits.loop._misfit import misfits, remarks_on, worst
from fits.loop._result import FitResult, FitStatus, RunReport
from fits.loop._run import PAST_IS_ESTIMATED, Progress, Run
from fits.stage._before import memory_before
from fits.stage._began import prepare_asides
from fits.stage._checks import check_gains, implausible, refuse_undersampled
from fits.stage._delay import GROSS_PCT, Alternative, fit_without_delays, fit_without_outliers
from fits.stage._run import (
    residual_of,
    settled_samples,
    simulate_stage,
    yields_inside,
)
from fits.stage._solve import Solved
from fits.stage._solve_stage import solve_with_pasts
from fits.stage._uncertainty import Precision, estimates
from fits.stats._metrics import TOLD


@one_thread
def fit_stage(
    records: AnyRuns,
    *,
    stage: m.Stage | None = None,
    levels: int | None = None,
    holdout: float | AnyRuns = 0.2,
    initial: str | Sequence[str] = "unknown",
    loss: str = "squares",
    progress: Progress = lambda _: None,
) -> FitResult[m.Stage]:
    """Fit driver, hysteresis and mechanics jointly to slow and fast runs of one rig.

    The slow runs give a first hysteresis, what the fast ones make of it a frequency response, and that the poles to
    start from. Then all runs are fitted together: the hysteresis is a smooth non-negative regression as in `fit`,
    solved for exactly while the other parameters follow damped Gauss-Newton steps.

    A `DataError` says that the records cannot be fitted, do not show the dynamics, or are not of one rig; other
    errors are those of `fit`.

    Parameters
    ----------
    records
        Runs of one rig, at whatever rates, as for `fit`. Each has its own sensor offset.
    stage
        What is fitted: all its parameters that are not frozen. A `Preisach` operator on a grid is fitted as `fit`
        does, whatever its present values; drivers and mechanics start from the data; other parts start from their
        present values. A stage with another law of hysteresis, or with one inside its mechanics
        (`HystereticMechanics`), starts from its present values altogether, by damped Gauss-Newton steps; the steps
        between samples are chosen, and what its memory was before is the law's own default. By default the stage of
        `default_stage`.
    levels
        Number of switching voltages; chosen from the slow runs by default.
    initial
        Memory before each run: `unknown`, `negative`, `positive` or `demagnetised`. One for all holds for records
        that are held out, too; theirs is unknown where each fitted run has its own. What an unknown one adds is
        estimated beside the rest where it counts in more than a twentieth of a run's samples, or more is left of a
        run that begins at an end of the range, and samples hold loops within what has been reached; it is left out
        elsewhere. What is left beside an estimated past in spite of that counts for less. With a hysteresis inside
        the mechanics all but `unknown` mean at rest; after an unknown past, such as a steady state, the samples are
        left out that depend on where the stage was at rest before.
    holdout, loss, progress
        See `fit`, as for what is returned.
    """
    records, holdout = without_lost(records_given(records), holdout_given(holdout))
    found = solve_with_pasts(records, stage, levels, holdout, initial, loss, progress)
    solved, runs = found.solved, found.solved.runs
    left, simplified = misfits(runs, solved.residuals_um), solved.problem.least_noise_share > 0
    progress("looking for delays")
    undelayed = fit_without_delays(found.plan, solved, found.precision, left)
    # What is sampled too slowly may look late; a delay is believed that leaves little else.
    if undelayed is None or any(one.far for one in misfits(undelayed.solved.runs, undelayed.solved.residuals_um)):
        refuse_undersampled(solved.stage, runs, left)
    if undelayed is not None and (found.failure is not None or simplified):
        raise DataError(f"{undelayed.words()}, and no fit was found with that: {undelayed.advice}")
    if found.failure is not None:
        raise found.failure
    gross = worst(left)
    if simplified and gross.share_pct > GROSS_PCT:
        raise DataError(
            f"{gross.source}: neither a lag nor a resonance explains what moves in it: {gross.share_pct:.3g} % of "
            f"its stroke stay unexplained, {gross.times_noise:.3g} times the sensor's noise; check columns, time "
            "stamps and sampling rate, or fit the hysteresis alone"
        )
    progress("comparing with the measurement")
    aside = () if isinstance(holdout, int | float) else tuple(holdout)
    before, stage = initial if isinstance(initial, str) else "unknown", solved.stage
    held = prepare_asides(stage, aside, found.plan.range_V, before, max(run.stride for run in runs))
    if yields_inside(stage):
        held = [replace(run, known=run.known & settled_samples(stage, run, before)) for run in held]
    summary = summarise(found.precision, held)
    if undelayed is not None:
        summary = undelayed.widen(summary)
    outliers = fit_without_outliers(found.plan, solved)
    if outliers is not None:
        summary = outliers[1].widen(summary, f"{', '.join(outliers[0])}: outliers pull this fit")
    unit = implausible(summary.parameters, [record.source for record in records])
    if unit is not None:
        remedy = "name the right one among the columns, as in time_s=NAME[ms]"
        summary = Alternative.in_unit(summary, unit[1]).widen(summary, unit[0], remedy)
    pasts = [run.record.source for run in (*runs, *held) if run.has_past]
    said = [PAST_IS_ESTIMATED.format(", ".join(pasts))] if pasts else []
    summary = replace(summary, remarks=(*solved.problem.remarks, *said, *summary.remarks))
    return completed(summary, solved, (*records, *aside), loss)


def completed(found: FitResult[m.Stage], solved: Solved, records: Sequence[Record], loss: str) -> FitResult[m.Stage]:
    """Add how far a fit is from noise, and say first what is wrong with its runs and records."""
    odd = remarks_on(solved.runs, solved.residuals_um, robust=loss == "huber")
    notes = [warning for record in records for warning in record.warnings]
    told = tuple(dict.fromkeys((*odd, *notes, *found.remarks)))
    return replace(found, misfit=worst(misfits(solved.runs, solved.residuals_um)), remarks=told)


def summarise(precision: Precision, held: Sequence[Run]) -> FitResult[m.Stage]:
    """Put the fit of a stage, and held-out runs, into figures; a `DataError` if the runs are not of one rig."""
    solved, stage = precision.solved, precision.solved.stage
    remarks = check_gains(stage, solved.runs, refuse=True)
    covariance = precision.covariance
    sd = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    names, value, slope = precision.chain.parameters(solved.z)
    unseen = unseen_directions(
        precision.information, [name for name, _ in names], slope / np.where(value == 0, np.inf, value)
    )
    reports = []
    weighing = solved.weighing
    for run, noise_um, correlation in zip(solved.runs, weighing.noise_um, weighing.correlation, strict=True):
        figures = {"noise_um": noise_um, "correlation_samples": correlation, "substeps": run.stride}
        reports.append(_report(stage, run, **figures))
        if correlation > TOLD:
            remarks.append(f"{run.record.source}: {correlated(correlation, 'creep, rate, a second mode, drift')}")
    reports += [_report(stage, run) for run in held]
    return FitResult(
        model=_with_offset(stage, reports[0].offset_um).with_substeps(max(run.stride for run in solved.runs)),
        uncertainty=precision.uncertainty(),
        status=FitStatus.CONVERGED,
        remarks=(*remarks, *unseen),
        runs=tuple(reports),
        smoothness=None if solved.hyper is None else float(np.exp(solved.hyper.log_density)),
        parameters=estimates(precision.chain, solved.z, sd),
        correlation=covariance / np.maximum(np.outer(sd, sd), 1e-300),
        unseen=unseen,
        records=tuple(run.record for run in solved.runs),
    )


def _with_offset(stage: m.Stage, offset_um: float) -> m.Stage:
    """Put a sensor's offset where the stage has room for one: ahead of a yielding spring it would load that."""
    for place, (name, part) in enumerate(zip(stage.names, stage.parts, strict=True)):
        behind = stage.parts[place + 1 :]
        if hasattr(part, "offset_um") and not any(isinstance(one, m.HystereticMechanics) for one in behind):
            gain = math.prod(float(one.static_gain) for one in behind if isinstance(one, m.AbstractLinear))
            return stage.swap(name, eqx.tree_at(lambda p: p.offset_um, part, part.offset_um + offset_um / gain))
    return stage


def _report(stage: m.Stage, run: Run, **figures: Any) -> RunReport:
    # A run that was only predicted still has an offset of its own.
    counted = run if run.fitted.any() else replace(run, fitted=run.known)
    predicted, alone = run.displacement_um - residual_of(stage, counted), simulate_stage(stage, counted)
    # What an estimated past adds is nothing once it counts no more, at the last sample at the latest.
    settled = counted.fitted & (np.arange(len(alone)) >= run.of_past) if run.has_past else counted.fitted
    offset = float(np.mean((predicted - alone)[settled])) if settled.any() else float((predicted - alone)[-1])
    noise = float(np.std((run.displacement_um - predicted)[counted.fitted]))
    return RunReport.of(run, predicted, offset, memory_before(stage, run, alone + offset, noise), **figures)


def unseen_directions(information: np.ndarray, names: Sequence[str], relative: np.ndarray) -> tuple[str, ...]:
    """Name the combinations of parameters that the data leave open, one sentence each, in the order of ignorance.

    `information` is the precision of the coordinates, `relative` the change of each parameter's logarithm per one.
    """
    values, vectors = np.linalg.eigh(information)
    # Coordinates are scaled to be of the order of 1.
    return tuple(_sentence(vector * relative, names) for vector in vectors.T[values <= 1])


def _sentence(direction: np.ndarray, names: Sequence[str]) -> str:
    # A parameter at its bound does not move with its coordinate.
    direction = np.where(np.isfinite(direction), direction, 0.0)
    size = np.abs(direction)
    moved = [k for k in np.argsort(-size, kind="stable") if size[k] > 0.15 * size.max()]  # others are faint
    if not moved:
        return f"some combination of {', '.join(names)} is not seen in these runs"
    if len(moved) == 1:
        return f"{names[moved[0]]} is not seen in these runs"
    exponents = direction[moved] / direction[moved[0]]
    if len(moved) == 2 and abs(abs(exponents[1]) - 1) < 0.1:
        one, other = names[moved[0]], names[moved[1]]
        # Along the direction one rises as the other falls, or with it: their product, or ratio, stays.
        joint = f"{one} * {other}" if exponents[1] < 0 else f"{one} / {other}"
        return f"only {joint} is seen, not each"
    listed = f"{', '.join(names[k] for k in moved[:-1])} and {names[moved[-1]]}"
    return f"of {listed} only {len(moved) - 1} combinations are seen, not each"
