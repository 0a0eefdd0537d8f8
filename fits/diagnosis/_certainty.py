"""How sure stages are, beside what causes and density may have taken up: of their parameters, and of predictions."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import jax.numpy as jnp
import numpy as np

from fits.diagnosis._baseline import Baseline, with_effects
from fits.diagnosis._effects import Bench
from fits.diagnosis._extension import shared_effects
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import STEP, Refit
from fits.diagnosis._result import FoundCause
from fits.loop._prior import definite
from fits.loop._result import ParameterEstimate
from fits.stage._chain import Chain
from fits.stage._information import scale_free
from fits.stage._run import place_of_hysteresis
from fits.stage._uncertainty import NO_PRECISION, StageUncertainty, estimates, fewer_columns
from fits.stats._noise import shared_square
from microid import Preisach, Stage
from microid.effects import card_of

# Of central differences along coordinates.
_STEP = 1e-4


class Certainty:
    """What runs say of a plain stage with the effects of a model beside it; all is linearised where the projector is.

    Unknowns are columns of the density, coordinates of the stage, and those of the effects, in this order.
    """

    def __init__(self, projector: Projector, model: Refit, bench: Bench, baseline: Baseline):
        self.projector, self.model, self.baseline = projector, model, baseline
        both = zip(projector.regression.rows, _changes_along(bench, model), strict=True)
        self.rows = [np.concatenate(pair, axis=1) for pair in both]

    def parameters(self, causes: Sequence[FoundCause] = ()) -> tuple[ParameterEstimate, ...]:
        """Parameters of the stage with their intervals, and behind them those of causes that a model can hold."""
        own = self.projector.regression.size - self.baseline.chain.size
        fitted = estimates(self.baseline.chain, self.baseline.z, self._sd[:own]) if own else ()
        modelled = [cause for cause in causes if not card_of(cause.name).statistic]
        beside = (replace(one, name=f"{cause.name}.{one.name}") for cause in modelled for one in cause.parameters)
        return (*fitted, *beside)

    @cached_property
    def _sd(self) -> np.ndarray:
        """Standard deviations of coordinates of the stage and of the effects, density and roughness marginalised."""
        projector, size = self.projector, self.baseline.chain.size
        rows = tuple(one[:, :size] for one in projector.regression.rows)
        density = Projector(
            replace(projector.regression, rows=rows), projector.noise, projector.roughness, projector.held
        )
        tangent = density.off(density.join([one[:, size:] for one in self.rows]))
        return np.sqrt(np.diagonal(replace(self.model, tangent=tangent).covariance()))

    def predictions(
        self, stage: Stage, residuals_um: Sequence[np.ndarray], own: bool = True
    ) -> StageUncertainty | None:
        """Perturbations of a stage that the model's effects were put into, for the band of its predictions.

        Those that each run has of its `own` may have been left out.

        What neighbouring samples share of its residuals in the runs is the model's own error. There are none where an
        effect is around the hysteresis, through which columns do not pass in proportion, or without any coordinate.
        """
        baseline = self.baseline
        place, grid = place_of_hysteresis(stage), baseline.chain.grid
        assert grid is not None
        if (
            place is None
            or not isinstance(stage.parts[place], Preisach)
            or not self.rows[0].shape[1] > baseline.chain.size
        ):
            return None
        size, others = baseline.chain.size, self.rows[0].shape[1] - baseline.chain.size
        known = scale_free(baseline.prior, baseline.columns_um)
        basis, prior = fewer_columns(grid.levels, known, baseline.hyper, baseline.stroke_um)
        few = basis.shape[1]
        whole = np.zeros((size + others, few + others))
        whole[:size, :few], whole[size:, few:] = basis, np.eye(others)
        joined = self.projector.bare.join([one @ whole for one in self.rows])
        nuisance = np.linalg.qr(self.projector.bare.nuisance_rows)[0]
        joined = joined - nuisance @ (nuisance.T @ joined)
        precision = joined.T @ joined + NO_PRECISION * np.eye(few + others)
        precision[:few, :few] += prior
        factor = np.linalg.inv(definite(precision)[1]) @ whole.T
        # As much wider as those of the parameters, where what is left stays alike for a while.
        columns_um, moves = factor[:, :size], factor[:, size:]
        moves = moves * np.maximum(self._sd / np.maximum(np.linalg.norm(moves, axis=0), 1e-300), 1.0)
        mean = self.rows[0][baseline.runs[0].fitted].mean(axis=0)
        left = [one[run.fitted] for one, run in zip(residuals_um, baseline.runs, strict=False)]
        return StageUncertainty(
            jnp.asarray(moves @ self._into(stage, own).T),
            jnp.asarray(columns_um),
            jnp.asarray(np.concatenate([columns_um, moves], axis=1) @ mean),
            jnp.asarray(max(0.0, float(np.mean([shared_square(one) for one in left]))) ** 0.5),
            grid,
        )

    def _into(self, stage: Stage, own: bool) -> np.ndarray:
        """Derivatives of an extended stage's coordinates along those of plain stage and effects, shape `(p, k)`."""
        baseline, model = self.baseline, self.model
        stops = np.cumsum([len(baseline.z), *(law.size for law in model.laws)])
        runs = len(baseline.runs)
        chain = Chain.of(stage, baseline.chain.grid)

        def coordinates(moved: np.ndarray) -> np.ndarray:
            dz, *dx = np.split(moved, stops[:-1])
            there = replace(model, x=tuple(x + d for x, d in zip(model.x, dx, strict=True)))
            moved_stage = with_effects(baseline.moved(dz, 0.0).stage, shared_effects(there, runs, own=own))
            return np.asarray(chain.coordinates.of(moved_stage.with_substeps(stage.substeps)))

        out = [(coordinates(step) - coordinates(-step)) / (2 * _STEP) for step in _STEP * np.eye(int(stops[-1]))]
        # A strength at its bound stays there.
        return np.nan_to_num(np.stack(out, axis=1), nan=0.0, posinf=0.0, neginf=0.0)


def _changes_along(bench: Bench, model: Refit) -> list[np.ndarray]:
    """Derivatives of what effects change along all their coordinates, per run, in um, shape `(n, k)`."""
    counts = [law.size for law in model.laws]
    out = [np.empty((len(um), sum(counts))) for um in model.change_um]
    for k, step in enumerate(STEP * np.eye(sum(counts))):
        moves = zip(model.x, np.split(step, np.cumsum(counts)[:-1]), strict=True)
        there = replace(model, x=tuple(x + move for x, move in moves))
        for run, columns in enumerate(out):
            moved = bench.respond_in(run, there.effects(run)) - bench.plain[run]
            columns[:, k] = (moved - model.change_um[run]) / STEP
    return out
