"""From records to a fitted Preisach operator, and to what a rig must have been through before its record."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from fits.io._errors import DataError
from fits.io._given import AnyRuns, holdout_given, records_given
from fits.io._jax_setup import require_float64
from fits.io._record import Record, refuse_repeats
from fits.loop._choose_grid import LADDER, choose_grid, try_grid, weigh_robustly
from fits.loop._design import columns_of
from fits.loop._grid import Estimate, grid_estimate
from fits.loop._left_over import suggestions
from fits.loop._moments import Data, gather, grid_of
from fits.loop._parts_agree import check_loops
from fits.loop._result import FitResult, FitStatus, RunReport
from fits.loop._run import Progress, Run, command_range_V, prepare_run, resized, simulate_run
from fits.loop._shapes import solve_shape
from fits.loop._uncertainty import Uncertainty
from fits.stats._metrics import WHITE
from fits.stats._noise import LOSSES
from microid import FAMILIES, Preisach, Staircase

# Families that are not grids are evaluated on at least this many levels.
_SHAPE_LEVELS = 34
# Pairs of extremes that stand for the unknown history, and samples that are compared.
_PAIRS = 6
_SAMPLES = 1024
_SIZE = 64


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
        Name in `microid.FAMILIES`, and number of switching voltages, chosen from the data by default.
    holdout
        Fraction at the end of every run that is only predicted, or records that are.
    initial
        Memory before each run: `unknown`, `negative`, `positive` or `demagnetised`.
    loss
        `squares`, or `huber`, to which outliers count less.
    starts, seed
        Number of starts, and their seed, for families whose fit is not convex.
    progress
        Told what is being done, a sentence at a time.
    """
    records = records_given(records)
    fraction, aside, range_V = check_fit(records, holdout_given(holdout), loss)
    if family not in FAMILIES:
        raise DataError(f"unknown density family {family!r}: choose one of {', '.join(sorted(FAMILIES))}")
    if levels is not None and not 4 <= levels <= 100:
        raise DataError(f"{levels} levels were asked for: choose between 4 and 100")

    def prepare(record: Record) -> Run:
        return prepare_run(record, range_V, initial, fraction)

    runs = [prepare(record) for record in records]
    if loss == "huber":
        runs = weigh_robustly(runs, progress)
    stroke, tried, trials = choose_grid(runs, levels, progress, alone=True)
    remarks = [*_remarks(runs), *(warning for record in aside for warning in record.warnings)]
    if family == "grid":
        found = grid_estimate(tried.data, tried.solution, stroke, tried.correlation, tried.discrepancy_um)
        if levels is None and tried.data.grid.levels == LADDER[-1]:
            remarks.append(f"refining still helped at {LADDER[-1]} levels, the finest tried: try --levels 100")
    else:
        if levels is None and tried.data.grid.levels < _SHAPE_LEVELS:
            tried = try_grid(gather(grid_of(runs, _SHAPE_LEVELS), runs), runs, stroke, tried.solution.hyper, True)
        smooth, key = tried.solution.hyper, jax.random.key(seed)
        found, agree = solve_shape(family, tried.data, runs, stroke, smooth, starts, key, progress)
        if not agree:
            remarks.append(
                f"the best two of {starts} starts ended at different fits; there may be a better one: raise --starts"
            )
    if found.correlation > WHITE:
        remarks.append(correlated(found.correlation, "creep, rate, drift or a density this family cannot follow"))
    model = found.model
    if found.correlation > WHITE:
        progress("looking for lags and relaxations")
        remarks += suggestions(runs, model, stroke, tried.solution.hyper)
    progress("checking the records")
    miss, told = check_loops(runs, prepare, model, stroke, tried.solution.hyper, loss == "huber")
    columns = np.asarray(columns_of(model))
    offsets = [mean.displacement_um - float(mean.response @ columns) for mean in tried.data.means]
    progress("comparing with the measurement")
    figures = {"noise_um": found.noise_um, "correlation_samples": found.correlation, "substeps": 1}
    reports = [_report(model, offset, run, found, **figures) for offset, run in zip(offsets, runs, strict=True)]
    for record in aside:
        run = prepare_run(record, range_V, initial, holdout=1.0)
        off = float(np.mean((run.displacement_um - simulate_run(model, run))[run.known]))
        reports.append(_report(model, off, run, found))
    return FitResult(
        model=_with_offset(model, offsets[0]),
        uncertainty=_uncertainty(tried.data, found),
        status=FitStatus.CONVERGED,
        remarks=(*told, *remarks),
        runs=tuple(reports),
        misfit=miss,
        smoothness=float(np.exp(tried.solution.hyper.log_density)),
        trials=tuple(trials),
    )


def correlated(samples: float, what: str) -> str:
    """The remark on residuals whose neighbours agree over some samples, and what may be left."""
    return (
        f"neighbouring residuals agree over {samples:.0f} samples: something other than sensor noise ({what}) is "
        "left that this model does not describe"
    )


def check_fit(
    records: Sequence[Record], holdout: float | Sequence[Record], loss: str
) -> tuple[float, tuple[Record, ...], tuple[float, float]]:
    """Check what a fit is given; the fraction and the records held out, and the range of all voltages."""
    require_float64("estimation needs")
    if loss not in LOSSES:
        raise DataError(f"unknown loss {loss!r}: choose one of {', '.join(LOSSES)}")
    fraction, aside = (float(holdout), ()) if isinstance(holdout, int | float) else (0.0, tuple(holdout))
    if not 0 <= fraction <= 0.9:
        raise DataError(f"the fraction held out is {fraction:g}: choose it between 0 and 0.9")
    if not records:
        raise DataError("there is no record to fit")
    refuse_repeats([*records, *aside])
    return fraction, aside, command_range_V([*records, *aside])


def _uncertainty(data: Data, found: Estimate) -> Uncertainty:
    """Perturbations by the columns of a factor of the covariance, and of the sensor offset alone."""
    mean, grid = data.means[0], data.grid
    columns = jnp.concatenate([found.factor_um.T, jnp.zeros((1, grid.columns))])
    # The mean displacement of a run fixes the offset: it makes up for what a perturbation does to that.
    moved = -(jnp.asarray(mean.response) @ found.factor_um)
    sd = found.noise_um * (found.correlation / mean.count) ** 0.5
    return Uncertainty(columns, jnp.append(moved, sd), jnp.asarray(found.discrepancy_um), grid)


def _with_offset(model: Preisach, offset_um: float) -> Preisach:
    return eqx.tree_at(lambda m: m.offset_um, model, jnp.asarray(offset_um))


def _report(model: Preisach, offset_um: float, run: Run, found: Estimate, **figures: Any) -> RunReport:
    model = _with_offset(model, offset_um)
    start = run.start if run.known.all() else estimate_start(model, run, found.noise_um)
    return RunReport.of(run, simulate_run(model, run), offset_um, start, **figures)


def _remarks(runs: list[Run]) -> list[str]:
    remarks = []
    for run in runs:
        remarks += list(run.record.warnings)
        lost = int(np.sum(~run.known))
        if lost:
            remarks.append(
                f"{run.record.source}: the first {lost} samples depend on what the rig went through before; "
                "they were not used for the weights, and the initial state was estimated from them"
            )
    lower, upper = min(run.lower_V for run in runs), max(run.upper_V for run in runs)
    edge = 0.02 * (upper - lower)
    anchors = np.concatenate([run.path.anchor_V[run.fitted] for run in runs])
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


def _staircase(z: Float[Array, "2 pairs_1"], model: Preisach, first_V: Float[Array, ""]) -> Staircase:
    """Extremes that close in on the first sample, by the shares of the way that the coordinates stand for."""
    below, above = jax.nn.softmax(z[0]), jax.nn.softmax(z[1])
    low, high = model.density.lower_V, model.density.upper_V
    minima = low + (first_V - low) * jnp.cumsum(below)[:-1]
    maxima = high - (high - first_V) * jnp.cumsum(above)[:-1]
    inner = jnp.stack([maxima, minima], axis=1).ravel()
    extremes = jnp.concatenate([low[None], inner, first_V[None]])
    return resized(Staircase(extremes, jnp.asarray(len(extremes), dtype=jnp.int32)), _SIZE)


def _residual(
    z: Float[Array, "2 pairs_1"], args: tuple[Preisach, Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]
) -> Float[Array, " m"]:
    model, voltage_V, displacement_um, weight = args
    start = _staircase(z, model, voltage_V[0])
    # A faint pull towards an even decay decides what the samples leave open.
    return jnp.concatenate([weight * (model(voltage_V, start) - displacement_um), 1e-2 * z.ravel()])


@eqx.filter_jit
def _solve(args: tuple[Preisach, Array, Array, Array]) -> Staircase:
    solver: Any = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6)
    start = jnp.zeros((2, _PAIRS + 1))
    solution: Any = optx.least_squares(_residual, solver, start, args=args, max_steps=100, throw=False)
    return _staircase(solution.value, args[0], args[1][0])


def estimate_start(model: Preisach, run: Run, noise_um: float) -> Staircase:
    """Fit the memory before the first sample to the samples that depend on it; the model has this run's offset.

    The output is differentiable in the remembered extremes as it is in any voltage, so the extremes themselves are
    the unknowns (Levenberg-Marquardt on `2 x 7` shares of the way from the ends of the range to the first sample).
    """
    keep = np.arange(np.flatnonzero(~run.known)[-1] + 1)
    # Thinned out evenly; the extremes of the path must stay, as they make the memory.
    if len(keep) > _SAMPLES:
        voltage = run.voltage_V[keep]
        turns = 1 + np.flatnonzero(np.diff(np.sign(np.diff(voltage))) != 0)
        even = np.linspace(0, len(keep) - 1, max(2, _SAMPLES - len(turns))).astype(np.int64)
        keep = np.unique(np.concatenate([even, turns]))[: 2 * _SAMPLES]
    pad = (0, 2 * _SAMPLES - len(keep))
    voltage = np.pad(run.voltage_V[keep], pad, mode="edge")
    displacement, weight = (np.pad(x, pad) for x in (run.displacement_um[keep], np.full(len(keep), 1 / noise_um)))
    return _solve((model, jnp.asarray(voltage), jnp.asarray(displacement), jnp.asarray(weight)))
