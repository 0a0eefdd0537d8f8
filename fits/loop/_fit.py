"""From records to a fitted Preisach operator."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from fits.io._errors import DataError
from fits.io._given import AnyRuns, holdout_given, records_given
from fits.io._jax_setup import require_float64
from fits.io._record import Record, refuse_repeats
from fits.io._threads import one_thread
from fits.loop._choose_grid import LADDER, choose_grid, try_grid, weigh_robustly
from fits.loop._design import Grid, columns_of
from fits.loop._finer import factor_with_plays
from fits.loop._grid import Estimate, grid_estimate
from fits.loop._left_over import suggestions
from fits.loop._lost import without_lost
from fits.loop._moments import RunMean, gather, grid_of
from fits.loop._parts_agree import check_loops, left_of, predicted_um
from fits.loop._path import branches
from fits.loop._result import FitResult, FitStatus, RunReport
from fits.loop._run import (
    PAST_IS_ESTIMATED,
    Progress,
    Run,
    command_range_V,
    prepare_aside,
    prepare_run,
    prepare_runs,
    simulate_run,
)
from fits.loop._surface import Surface
from fits.loop._uncertainty import Uncertainty
from fits.loop._voltage_noise import noisy_voltages
from fits.stats._metrics import TOLD, WHITE
from fits.stats._noise import LOSSES
from microid import Preisach
from microid.densities import FAMILIES

# Families that are not grids are evaluated on at least this many levels.
_SHAPE_LEVELS = 34
# Of the speeds of two runs, from which they may tell more than a hysteresis.
_OTHER_SPEED = 5.0


@one_thread
def fit(
    records: AnyRuns,
    *,
    family: str = "grid",
    levels: int | None = None,
    holdout: float | AnyRuns = 0.2,
    initial: str = "unknown",
    loss: str = "squares",
    starts: int = 8,
    seed: int = 0,
    progress: Progress = lambda _: None,
) -> FitResult[Preisach]:
    """Fit a Preisach operator to measured voltage and displacement (Eq. 8-11).

    The weights are found by a smooth, non-negative regression whose smoothness and noise level maximise the
    evidence; the resolution is raised until blocks of the record are no longer predicted better from the others.

    A `DataError` says that the records cannot be fitted, or are not of one rig, a `FitError` that a solver failed,
    and a `RuntimeError` that JAX computes in single precision.

    Parameters
    ----------
    records
        Runs of one rig, or one: records, or what `read_table` takes. Each has its own sensor offset.
    family, levels
        Name in `microid.densities.FAMILIES`, and number of switching voltages, chosen from the data by default.
    holdout
        Fraction at the end of every run that is only predicted, or records that are.
    initial
        Memory before each run: `unknown`, `negative`, `positive` or `demagnetised`. What an unknown one adds is
        estimated beside the weights where it counts in more than a twentieth of a run's samples, or these are left
        out where no loop is left beside it.
    loss
        `squares`, or `huber`, to which outliers count less.
    starts, seed
        Number of starts, and their seed, for families whose fit is not convex.
    progress
        Told what is being done, a sentence at a time.
    """
    records, holdout = without_lost(records_given(records), holdout_given(holdout))
    fraction, aside, range_V = check_fit(records, holdout, loss, levels)
    if family not in FAMILIES:
        raise DataError(f"unknown density family {family!r}: choose one of {', '.join(sorted(FAMILIES))}")

    runs = prepare_runs(records, range_V, initial, fraction)
    if loss == "huber":
        runs = weigh_robustly(runs, progress)
    stroke, tried, trials = choose_grid(runs, levels, progress, alone=True)
    remarks = [*_remarks(runs), *(warning for record in aside for warning in record.warnings)]
    if family == "grid":
        found = grid_estimate(tried.data, tried.solution, stroke, tried.correlation, tried.discrepancy_um)
        if levels is None and tried.data.grid.levels == LADDER[-1]:
            remarks.append(f"refining still helped at {LADDER[-1]} levels, the finest tried: try 100")
    else:
        if levels is None and tried.data.grid.levels < _SHAPE_LEVELS:
            tried = try_grid(gather(grid_of(runs, _SHAPE_LEVELS), runs), runs, stroke, tried, True)
        from fits.loop._shapes import solve_shape  # its solver takes long to import

        smooth, key = tried.solution.hyper, jax.random.key(seed)
        found, agree = solve_shape(family, tried.data, runs, stroke, smooth, starts, key, progress)
        if not agree:
            remarks.append(
                f"the best two of {starts} starts ended at different fits; there may be a better one: try more starts"
            )
    if found.correlation > TOLD:
        remarks.append(correlated(found.correlation, "creep, rate, drift or a density this family cannot follow"))
    model, columns = found.model, np.asarray(columns_of(found.model))
    surface = tried.data.grid.surface(columns)
    noisy = noisy_voltages(runs, [left_of(surface, run) for run in runs])
    remarks += noisy
    # A lag would smooth a noisy voltage, and be none.
    if found.correlation > WHITE and not noisy:
        progress("looking for lags and relaxations")
        whole = [run for run in runs if not run.has_past]
        remarks += suggestions(whole, surface, stroke, tried.solution.hyper) if whole else []
    mean = tried.data.means[0]
    believed = tried.data.grid, found.factor_um, mean.response @ found.factor_um
    if family == "grid" and found.correlation <= WHITE:  # elsewhere blocks say how smooth it is, not the evidence
        progress("looking for plays between the levels")
        believed = factor_with_plays(tried.data, columns, runs, tried.solution.hyper, stroke) or believed
    progress("checking the records")

    def again(record: Record, run: Run) -> Run:
        return prepare_run(record, range_V, initial, fraction, estimated=run.has_past)

    miss, told = check_loops(runs, again, surface, stroke, tried.solution.hyper, loss == "huber")
    offsets = [mean.displacement_um - float(mean.response @ columns) for mean in tried.data.means]
    remarks += _of_speed(runs) if miss is not None and miss.far else []
    progress("comparing with the measurement")
    figures = {"noise_um": found.noise_um, "correlation_samples": found.correlation, "substeps": 1}
    reports = [_report(found, surface, offset, run, **figures) for offset, run in zip(offsets, runs, strict=True)]
    for record in aside:
        run = prepare_aside(record, range_V, initial)
        # What an estimated past adds has ended at the last sample, at the latest.
        off = float((predicted_um(surface, run) - simulate_run(surface, run))[-1])
        reports.append(_report(found, surface, off, run))
    return FitResult(
        model=_with_offset(model, offsets[0]),
        uncertainty=_uncertainty(mean, found, believed),
        status=FitStatus.CONVERGED,
        remarks=(*told, *remarks),
        runs=tuple(reports),
        misfit=miss,
        smoothness=float(np.exp(tried.solution.hyper.log_density)),
        trials=tuple(trials),
        records=tuple(records),
    )


def _of_speed(runs: Sequence[Run]) -> list[str]:
    """What to do where runs that differ in speed are far from what a hysteresis, which knows none, makes of them."""
    per_s = [np.median(np.abs(slopes[slopes != 0])) for slopes in map(_slopes_V_per_s, runs) if slopes.any()]
    if len(per_s) < 2 or max(per_s) < _OTHER_SPEED * min(per_s):
        return []
    times = max(per_s) / min(per_s)
    return [
        f"the runs differ in speed by a factor of {times:.2g}, and a hysteresis alone knows no speed: fit a "
        "whole stage to them, with driver and mechanics, or have it diagnosed"
    ]


def _slopes_V_per_s(run: Run) -> np.ndarray:
    return np.diff(run.record.voltage_V) / np.diff(run.record.time_s)


def correlated(samples: float, what: str) -> str:
    """The remark on residuals whose neighbours agree over some samples, and what may be left."""
    return (
        f"neighbouring residuals agree over {samples:.0f} samples: something other than sensor noise ({what}) is "
        "left that this model does not describe"
    )


def check_fit(
    records: Sequence[Record], holdout: float | Sequence[Record], loss: str, levels: int | None
) -> tuple[float, tuple[Record, ...], tuple[float, float]]:
    """Check what a fit is given; the fraction and the records held out, and the range of all voltages."""
    require_float64("estimation needs")
    if loss not in LOSSES:
        raise DataError(f"unknown loss {loss!r}: choose one of {', '.join(LOSSES)}")
    if levels is not None and not (isinstance(levels, int | np.integer) and 4 <= levels <= 100):
        raise DataError(
            f"levels: expected a whole number from 4 to 100, found {levels!r}; leave it out to have it found"
        )
    fraction, aside = (float(holdout), ()) if isinstance(holdout, int | float) else (0.0, tuple(holdout))
    if not 0 <= fraction <= 0.9:
        raise DataError(f"the fraction held out is {fraction:g}: choose it between 0 and 0.9")
    if not records:
        raise DataError("there is no record to fit")
    refuse_repeats([*records, *aside])
    return fraction, aside, command_range_V([*records, *aside])


def _uncertainty(mean: RunMean, found: Estimate, believed: tuple[Grid, np.ndarray, np.ndarray]) -> Uncertainty:
    """Perturbations by the columns of a factor of the covariance, and of the sensor offset alone."""
    grid, factor_um, response_um = believed
    columns = np.concatenate([factor_um.T, np.zeros((1, grid.columns))])
    # The mean displacement of a run fixes the offset: it makes up for what a perturbation does to that.
    sd = found.noise_um * (found.correlation / mean.count) ** 0.5
    offset_um, discrepancy_um = (
        jnp.asarray(np.append(-response_um, sd)),
        jnp.asarray(np.float64(found.discrepancy_um)),
    )
    return Uncertainty(jnp.asarray(columns), offset_um, discrepancy_um, grid)


def _with_offset(model: Preisach, offset_um: float) -> Preisach:
    # By NumPy: of a Python number JAX remembers that its type is weak, and compiles all anew for that.
    return eqx.tree_at(lambda m: m.offset_um, model, jnp.asarray(np.asarray(offset_um)))


def _report(found: Estimate, surface: Surface, offset_um: float, run: Run, **figures: Any) -> RunReport:
    start, count = run.start, run.of_past
    if count:
        from fits.loop._estimate_start import estimate_start  # its solver takes long to import

        samples = run.voltage_V[:count], run.displacement_um[:count]
        start = estimate_start(_with_offset(found.model, offset_um), *samples, found.noise_um)
    predicted = predicted_um(surface, run) if run.has_past else offset_um + simulate_run(surface, run)
    return RunReport.of(run, predicted, offset_um, start, **figures)


def _remarks(runs: list[Run]) -> list[str]:
    remarks = []
    for run in runs:
        remarks += list(run.record.warnings)
        unknown = int(np.sum(~(run.known | run.record.lost)))
        if run.has_past:
            remarks.append(PAST_IS_ESTIMATED.format(run.record.source))
        if unknown:
            remarks.append(
                f"{run.record.source}: the first {unknown} samples depend on what the rig went through before; "
                "they were not used for the weights, and the initial state was estimated from them"
            )
    lower, upper = min(run.lower_V for run in runs), max(run.upper_V for run in runs)
    edge = 0.02 * (upper - lower)
    anchors = np.concatenate([branches(run.path)[0][run.fitted] for run in runs])
    if np.mean((anchors > lower + edge) & (anchors < upper - edge)) < 0.01:
        remarks.append(
            "the fitted samples hold no loop smaller than the full range: what the model says about smaller loops "
            "rests on the smoothness of the density alone and its band there is too narrow; "
            "record reversals inside the range"
        )
    voltage = np.concatenate([run.record.voltage_V[run.fitted] for run in runs])
    low, high = float(voltage.min()), float(voltage.max())
    if low > lower + edge or high < upper - edge:
        remarks.append(
            f"the fitted samples only span {low:.4g} to {high:.4g} V of {lower:.4g} to {upper:.4g} V: "
            "beyond them the model is extrapolated"
        )
    return remarks
