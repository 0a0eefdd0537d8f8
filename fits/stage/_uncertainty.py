"""How sure the fit of a stage is: of its parameters, however the noise is coloured, and of its predictions."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import fft

from fits.io._errors import DataError
from fits.io._record import Record
from fits.loop._design import Grid
from fits.loop._prior import interpolation
from fits.loop._run import Run
from fits.loop._uncertainty import AbstractUncertainty, Prediction
from fits.stage._moments import Chain, RunSums, along
from fits.stage._run import prepare_program, simulate_stage
from fits.stage._solve import Solved, marginal_information, prior_precision, scale_free
from fits.stats._noise import WHITE, correlation_samples, shared_square
from microid import Preisach, Stage

# Levels on which predictions are perturbed; finer ones move no displacement.
_LEVELS = 16
# Autocovariances are trusted up to so many correlation times.
_LAGS = 6.0
# Precision, in scaled coordinates, that stands in for none.
NO_PRECISION = 1e-8


class StageUncertainty(AbstractUncertainty):
    """Independent perturbations of a stage, each one standard deviation long.

    The variance of a prediction is the sum of the squared changes under all of them, to first order; sensor noise is
    not in it.

    Attributes
    ----------
    coordinates
        Perturbations of the stage's coordinates, shape `(k, p)`.
    columns_um
        And of the columns of its grid, shape `(k, D)`; `D = 0` without one.
    mean_um
        What each does to the mean of the first run, which its offset makes up for, shape `(k,)`.
    discrepancy_um
        Standard deviation of the model's own error, as neighbouring residuals show it.
    grid
        The columns; None without a grid.
    """

    coordinates: Float[Array, "k p"]
    columns_um: Float[Array, "k D"]
    mean_um: Float[Array, " k"]
    discrepancy_um: Float[Array, ""]
    grid: Grid | None

    def sd_um(self, model: Preisach | Stage, run: Run) -> np.ndarray:
        """Standard deviation of the predicted displacement of a run, shape `(n,)`."""
        stage = _stage(model)
        chain = Chain.of(stage, self.grid)
        mean = np.asarray(self.mean_um)

        def variance(moved: np.ndarray) -> np.ndarray:
            return np.asarray(np.sum((moved - mean) ** 2, axis=1))

        directions = np.asarray(self.columns_um).T, np.asarray(self.coordinates).T
        square = along(chain, chain.coordinates.of(stage), None, run, directions, variance)
        return np.sqrt(square + float(self.discrepancy_um) ** 2)

    def predict(self, model: Preisach | Stage, record: Record, initial: str) -> Prediction:
        """Predict the displacement of a voltage program; see `fits.predict`."""
        stage, run = prepare_program(_stage(model), record, initial)
        return Prediction(simulate_stage(stage, run), self.sd_um(stage, run))


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

    def answer(self) -> np.ndarray:
        """Columns of the covariance that belong to the coordinates, shape `(D + p, p)`."""
        size, count = self.chain.size, len(self.solved.z)
        whole = self.gram + self.prior
        # Coordinates that nothing is known of must not spoil those that something is known of.
        whole[np.arange(size, size + count), np.arange(size, size + count)] += NO_PRECISION
        return np.linalg.solve(whole, np.eye(size + count)[:, size:])

    def influence(self) -> list[np.ndarray]:
        """How much a unit of each sample's noise moves each coordinate, per run, shape `(p, n)`."""
        size, answer = self.chain.size, self.answer()
        here = jnp.asarray(self.solved.z), jnp.asarray(self.solved.columns_um)
        out = []
        weighing = self.solved.weighing
        for run, share in zip(self.solved.runs, weighing.shares, strict=True):
            slope = along(self.chain, *here, run, (answer[:size], answer[size:])).T
            weight = run.fit_weight
            slope = slope - np.average(slope, axis=1, weights=weight)[:, None]
            # The other half of the weight goes to the residual that this is multiplied by.
            out.append(slope * np.sqrt(weight) * share / weighing.least_um**2)
        return out

    def covariance(self, influence: Sequence[np.ndarray]) -> np.ndarray:
        """Covariance of the coordinates, the noise of each run as coloured as its residual is, shape `(p, p)`.

        The estimate moves by the influence of each sample times its noise, so its covariance is a double sum over
        autocovariances (the sandwich of Newey & West 1987), to which comes what is not known of the columns.
        """
        size, answer = self.chain.size, self.answer()
        # What nothing is known of stays unknown, whatever the residual.
        held = (
            answer[:size].T @ self.prior[:size, :size] @ answer[:size]
            + NO_PRECISION * answer[size:].T @ answer[size:]
        )
        for own, (one, run) in zip(influence, self._pairs(), strict=True):
            held = held + sandwich(own, np.sqrt(run.fit_weight) * one.residual_um, run.fitted)
        return held

    def sd(self) -> np.ndarray:
        """Standard deviations of the coordinates, shape `(p,)`."""
        return np.sqrt(np.diagonal(self.covariance(self.influence())))

    def uncertainty(self) -> StageUncertainty:
        """Perturbations for predictions."""
        size, count, grid = self.chain.size, len(self.solved.z), self.chain.grid
        basis = np.eye(size)
        if grid is not None and grid.levels > _LEVELS:
            grid = Grid(grid.lower_V, grid.upper_V, _LEVELS)
            basis = interpolation(_LEVELS, self.chain.levels)
        whole = np.zeros((size + count, basis.shape[1] + count))
        whole[:size, : basis.shape[1]], whole[size:, basis.shape[1] :] = basis, np.eye(count)
        precision = whole.T @ (self.gram + self.prior) @ whole + NO_PRECISION * np.eye(whole.shape[1])
        root = np.linalg.cholesky(precision)
        factor = np.linalg.solve(root, np.eye(len(root)))
        shared = float(np.mean([shared_square(one.residual_um[run.fitted]) for one, run in self._pairs()]))
        mean = self.solved.sums[0].mean @ whole
        return StageUncertainty(
            jnp.asarray(factor[:, basis.shape[1] :]),
            jnp.asarray(factor[:, : basis.shape[1]]),
            jnp.asarray(factor @ mean),
            jnp.asarray(max(0.0, shared) ** 0.5),
            grid,
        )

    def _pairs(self) -> list[tuple[RunSums, Run]]:
        return list(zip(self.solved.sums, self.solved.runs, strict=True))


def sandwich(influence: np.ndarray, residual_um: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """Covariance of `influence @ noise`, the noise having the autocovariance of a residual, shape `(p, p)`."""
    left = np.where(fitted, residual_um, 0.0)
    n = len(left)
    size = fft.next_fast_len(2 * n)
    auto = fft.irfft(np.abs(fft.rfft(left, size)) ** 2, size)[:n] / fitted.sum()
    correlation = correlation_samples([residual_um[fitted]])
    lags = 0 if correlation <= WHITE else min(n - 1, int(np.ceil(_LAGS * correlation)))
    window = np.zeros(n)
    window[: lags + 1] = 1 - np.arange(lags + 1) / (lags + 1)
    kernel = np.zeros(size)
    kernel[:n] = auto * window
    kernel[size - n + 1 :] = kernel[1:n][::-1]
    spectrum = np.maximum(fft.rfft(kernel).real, 0.0)
    moved = fft.irfft(fft.rfft(influence, size, axis=1) * spectrum, size, axis=1)[:, :n]
    return np.asarray(influence @ moved.T)
