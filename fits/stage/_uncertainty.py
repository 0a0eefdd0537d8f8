"""How sure the fit of a stage is: of its parameters, however coloured the noise, of predictions and of plants."""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.io._errors import DataError
from fits.io._given import AnyRuns, program_given
from fits.io._record import Record
from fits.loop._design import Grid, columns_of
from fits.loop._grid import BELIEF_LEVELS
from fits.loop._prediction import Initial, Prediction, predict_from
from fits.loop._prior import Hyper, definite, interpolation, roughness
from fits.loop._result import ParameterEstimate
from fits.loop._run import Run, initial_of
from fits.loop._uncertainty import AbstractUncertainty, Uncertainty
from fits.stage._chain import Chain, offsets_out
from fits.stage._information import marginal_information, prior_precision, scale_free
from fits.stage._moments import along, linearise
from fits.stage._run import as_stage, nuisance_columns, place_of_hysteresis, prepare_program, simulate_stage
from fits.stage._solve import Solved
from fits.stats._metrics import TWO_SIDED_95, WHITE
from fits.stats._noise import correlation_samples, fast_length, shared_square
from microid import Preisach, Stage, Staircase

# Precision, in scaled coordinates, that stands in for none.
NO_PRECISION = 1e-8


class StageUncertainty(AbstractUncertainty):
    """Independent perturbations of a stage, each one standard deviation long.

    The variance of a prediction is the sum of the squared changes under all of them, to first order; sensor noise is
    not in it. Each perturbation moves the stage's `coordinates`, shape `(k, p)`, the columns of its grid, shape
    `(k, D)`, where `D = 0` without one, and the mean of the first run by `mean_um`, which the offset makes up for.
    `discrepancy_um` is the standard deviation of the model's own error, as neighbouring residuals show it.
    """

    coordinates: Float[Array, "k p"]
    columns_um: Float[Array, "k D"]
    mean_um: Float[Array, " k"]
    discrepancy_um: Float[Array, ""]
    grid: Grid | None

    def sd_um(self, model: Preisach | Stage, run: Run) -> np.ndarray:
        stage = _stage(model)
        moved_um = self._moved(stage, run)[1]
        # What the run's nuisance parameters take up is fitted anew under each of them.
        run = run if run.fitted.any() else replace(run, fitted=run.known)
        nuisance = np.asarray(nuisance_columns(stage, run.coarser.samples))[: len(run.record)]
        return self._sd_um(moved_um - nuisance @ _factors(nuisance, run.fit_weight, moved_um))

    def predict_known(self, model: Preisach | Stage, record: Record, initial: Initial) -> Prediction:
        stage, run = prepare_program(_stage(model), record, initial)
        out_um, moved_um = self._moved(stage, run, lambda moved: self._sd_um(moved - np.asarray(self.mean_um)))
        return Prediction(out_um, moved_um, run.record.warnings)

    def _sd_um(self, moved_um: np.ndarray) -> np.ndarray:
        return np.sqrt(np.sum(moved_um**2, axis=1) + float(self.discrepancy_um) ** 2)

    def _moved(
        self, stage: Stage, run: Run, reduce: Callable[[np.ndarray], np.ndarray] = lambda moved: moved
    ) -> tuple[np.ndarray, np.ndarray]:
        """What a stage makes of a run, shape `(n,)`, and its changes under the perturbations, `(n, k)`, reduced."""
        chain = Chain.of(stage, self.grid)
        directions = np.asarray(self.columns_um).T, np.asarray(self.coordinates).T
        z = chain.coordinates.of(stage)
        out, slope, _ = linearise(chain, z, None, run)
        return out[: len(run.record)], along(chain, z, None, run, directions, slope, reduce)


def _factors(nuisance: np.ndarray, weight: np.ndarray, moved_um: np.ndarray) -> np.ndarray:
    """Of nuisance parameters, what they take up of changes by weighted least squares, shape `(columns, k)`."""
    root = np.sqrt(weight)[:, None]
    return np.linalg.lstsq(root * nuisance, root * moved_um, rcond=None)[0]


def _stage(model: Preisach | Stage) -> Stage:
    if isinstance(model, Stage):
        return model
    raise DataError("the uncertainty is that of a stage, and the model is a hysteresis: fit it again")


class Precision:
    """What a fit knows: the precision of its columns and coordinates together, and what each sample contributes."""

    def __init__(self, solved: Solved):
        self.chain, self.solved = solved.problem.chain, solved
        total = solved.weighing.total(solved.sums)
        size = self.chain.size
        self.variance = solved.weighing.least_um**2
        self.gram = np.asarray(total.gram) / self.variance
        self.prior = np.zeros_like(self.gram)
        if solved.hyper is not None:
            prior = prior_precision(self.chain, solved.hyper, solved.problem.stroke_um)
            self.prior[:size, :size] = scale_free(prior, solved.columns_um)
        self.information = marginal_information(total, size, self.prior[:size, :size], self.variance)

    @cached_property
    def answer(self) -> np.ndarray:
        """Columns of the covariance that belong to the coordinates, shape `(D + p, p)`."""
        size, count = self.chain.size, len(self.solved.z)
        whole = self.gram + self.prior
        # Coordinates that nothing is known of must not spoil those that something is known of.
        whole[np.arange(size, size + count), np.arange(size, size + count)] += NO_PRECISION
        return np.linalg.solve(whole, np.eye(size + count)[:, size:])

    @cached_property
    def influence(self) -> list[np.ndarray]:
        """How much a unit of each sample's noise moves each coordinate, per run, shape `(p, n)`."""
        directions = np.split(self.answer, [self.chain.size])
        here, out = (jnp.asarray(self.solved.z), jnp.asarray(self.solved.columns_um)), []
        for run, share in zip(self.solved.runs, self.solved.weighing.shares, strict=True):
            slope = along(self.chain, *here, run, directions)
            # What nuisance parameters take up is not learnt from.
            nuisance = np.asarray(nuisance_columns(self.solved.stage, run.coarser.samples))[: len(slope)]
            slope = (slope - nuisance @ _factors(nuisance, run.fit_weight, slope)).T
            # The other half of the weight goes to the residual that this is multiplied by.
            out.append(slope * np.sqrt(run.fit_weight) * share / self.variance)
        return out

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of the coordinates, the noise of each run as coloured as its residual is, shape `(p, p)`.

        The estimate moves by the influence of each sample times its noise, so its covariance is a double sum over
        autocovariances (the sandwich of Newey & West 1987), to which comes what is not known of the columns.
        """
        size = self.chain.size
        columns, rest = np.split(self.answer, [size])
        # What nothing is known of stays unknown, whatever the residual.
        held = columns.T @ self.prior[:size, :size] @ columns + NO_PRECISION * rest.T @ rest
        for own, one, run in zip(self.influence, self.solved.sums, self.solved.runs, strict=True):
            held = held + sandwich(own, np.sqrt(run.fit_weight) * one.residual_um, run.fitted)
        return held

    @property
    def sd(self) -> np.ndarray:
        """Standard deviations of the coordinates, shape `(p,)`."""
        return np.sqrt(np.diagonal(self.covariance))

    def uncertainty(self) -> StageUncertainty:
        """Perturbations for predictions."""
        size, count = self.chain.size, len(self.solved.z)
        own = self.prior[:size, :size]
        basis, prior = fewer_columns(self.chain.levels, own, self.solved.hyper, self.solved.problem.stroke_um)
        few = basis.shape[1]
        whole = np.zeros((size + count, few + count))
        whole[:size, :few], whole[size:, few:] = basis, np.eye(count)
        precision = whole.T @ self.gram @ whole + NO_PRECISION * np.eye(few + count)
        precision[:few, :few] += prior
        _, root = definite(precision)
        factor = np.linalg.solve(root, np.eye(len(root))) @ whole.T
        left = zip(self.solved.residuals_um, self.solved.runs, strict=True)
        shared = float(np.mean([shared_square(one[run.fitted]) for one, run in left]))
        return StageUncertainty(
            jnp.asarray(factor[:, size:]),
            jnp.asarray(factor[:, :size]),
            jnp.asarray(factor @ self.solved.sums[0].mean),
            jnp.asarray(np.float64(max(0.0, shared) ** 0.5)),
            self.chain.grid,
        )


def fewer_columns(
    levels: int, prior: np.ndarray, hyper: Hyper | None, stroke_um: float
) -> tuple[np.ndarray, np.ndarray]:
    """Columns of `BELIEF_LEVELS` in those of a grid, `(D, k)`, and the precision of their prior in 1/um^2, `(k, k)`.

    The prior is that of the coarse grid itself, as in a fit of loops: the one of the fine grid would take the kinks
    of what is read off between coarse nodes for roughness, and be too sure. A grid with no more levels, or of which
    no smoothness was estimated, keeps its own, `(D, D)`.
    """
    if hyper is None or levels <= BELIEF_LEVELS:
        return np.eye(len(prior)), prior
    coarse = np.asarray(roughness(BELIEF_LEVELS).precision(hyper)) / stroke_um**2
    return interpolation(BELIEF_LEVELS, levels), coarse


def estimates(chain: Chain, z: np.ndarray, sd: np.ndarray) -> tuple[ParameterEstimate, ...]:
    """Parameters outside the grid with standard deviations and 95 % intervals, from those of their coordinates."""
    names, value, slope = chain.parameters(z)
    ends = [np.asarray(chain.coordinates.values(jnp.asarray(z + sign * TWO_SIDED_95 * sd))) for sign in (-1, 1)]
    # Of what is hardly seen the interval alone says how wide it is: at a bound the slope vanishes.
    width = np.where(sd > 0.5, np.abs(ends[1] - ends[0]) / (2 * TWO_SIDED_95), np.abs(slope) * sd)
    return tuple(
        ParameterEstimate(name, unit, *map(float, figures))
        for (name, unit), *figures in zip(names, value, width, *ends, strict=True)
    )


def sandwich(influence: np.ndarray, residual_um: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """Covariance of `influence @ noise`, the noise having the autocovariance of a residual, shape `(p, p)`."""
    from scipy.signal import fftconvolve  # slow to import, and only a fit needs it

    left = np.where(fitted, residual_um, 0.0)
    correlation = correlation_samples([residual_um[fitted]])
    lags = 0 if correlation <= WHITE else min(len(left) - 1, int(np.ceil(6.0 * correlation)))
    size = fast_length(2 * len(left))
    auto = np.fft.irfft(np.abs(np.fft.rfft(left, size)) ** 2, size)[: lags + 1] / fitted.sum()
    # Bartlett's window keeps the covariance positive.
    kernel = auto * (1 - np.arange(lags + 1) / (lags + 1))
    moved = fftconvolve(influence, np.concatenate([kernel[:0:-1], kernel])[None], mode="same", axes=1)
    return np.asarray(influence @ moved.T)


def predict(
    model: Any,
    record: AnyRuns,
    initial: Initial | Staircase = "negative",
    *,
    uncertainty: AbstractUncertainty | None = None,
) -> Prediction:
    """Predict the displacement of a voltage program, with its uncertainty.

    The model is a `Preisach` or a `Stage`, with an `uncertainty` beside it or not, or a fit or a model file with its
    own, or the name of such a file; where there is none the standard deviations are NaN. The program is a record, or
    what `read_table` takes; its displacement, if any, is not looked at. Its `initial` memory is
    `negative`, `positive`, `demagnetised` or `unknown`, or one that a fit has estimated, the `start` of one of its
    runs, or its extremes in V, oldest first. Of an unknown one the prediction is midway between those after both ends
    of the range, and the standard deviation has that of an even distribution between the two.

    A `DataError` says that the voltage leaves the range that the model was fitted on, that a stage has an effect of
    another column, which the program lacks, or that the uncertainty is that of another kind of model.
    """
    from fits.stage._model_file import model_given  # which knows of the uncertainties here

    record = program_given(record)
    model, uncertainty = model_given(model, uncertainty)
    before = initial_of(initial)
    if uncertainty is not None:
        return uncertainty.predict(model, record, before)
    whole = as_stage(model)

    def played(state: Initial) -> Prediction:
        stage, run = prepare_program(whole, record, state)
        return Prediction(simulate_stage(stage, run), np.full(len(record), np.nan), run.record.warnings)

    return predict_from(before, played)


def draw_plants(
    model: Any, count: int, *, uncertainty: Uncertainty | StageUncertainty | None = None, seed: int = 0
) -> tuple[Stage, ...]:
    """Draw stages from the covariance of a fit.

    Model and uncertainty are as for `predict`. Of `count` stages, 1 or more, the first is the fitted one.
    All are of one structure; a hysteresis alone becomes a stage of one part. Weights and slopes that a draw would
    make negative are zero. The model's own error (`discrepancy_um`) is not in them. A `DataError` says that there is
    no uncertainty to draw from, or that it is not that of the model.
    """
    if count < 1:
        raise ValueError(f"count must be 1 or more, got {count}")
    from fits.stage._model_file import model_given  # which knows of the uncertainties here

    model, uncertainty = model_given(model, uncertainty)
    stage = as_stage(model)
    if count == 1:
        return (stage,)
    if isinstance(model, Stage) and isinstance(uncertainty, StageUncertainty):
        moves = [np.asarray(x) for x in (uncertainty.coordinates, uncertainty.columns_um, uncertainty.mean_um)]
    elif isinstance(model, Preisach) and isinstance(uncertainty, Uncertainty):
        none = np.zeros((uncertainty.columns_um.shape[0], 0))
        moves = [none, np.asarray(uncertainty.columns_um), -np.asarray(uncertainty.offset_um)]
    else:
        raise DataError(
            "the model says nothing of its uncertainty, expected one to draw plants from: fit it again, or take one"
        )
    draws = np.random.default_rng(seed).standard_normal((count - 1, len(moves[0])))
    scattered = np.concatenate([np.zeros((1, len(moves[0]))), draws])
    return tuple(_moved(stage, uncertainty.grid, *(one @ x for x in moves)) for one in scattered)


def _moved(stage: Stage, grid: Grid | None, along: np.ndarray, columns_um: np.ndarray, mean_um: float) -> Stage:
    """A stage moved in its coordinates, its columns, and in what the mean of the first run fixes."""
    if len(along):
        coordinates = offsets_out(stage, grid is not None)
        stage = coordinates(coordinates.of(stage) + jnp.asarray(along))
    place = place_of_hysteresis(stage)
    if grid is None or place is None:
        return stage
    name, law = stage.names[place], stage.parts[place]
    if not isinstance(law, Preisach):
        raise DataError(f"{name!r} is a {type(law).__name__}: take off what is around the hysteresis")
    levels = law.density.levels
    columns = np.asarray(columns_of(law)) + interpolation(grid.levels, levels) @ columns_um
    fine = Grid(law.density.lower_V, law.density.upper_V, levels)
    return stage.swap(name, fine.model(np.maximum(columns, 0.0), law.offset_um - float(mean_um)))
