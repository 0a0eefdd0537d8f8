"""Stages as they may be, for all that a fit knows: what a robust controller has to do with."""

import jax.numpy as jnp
import numpy as np

from fits.io._errors import DataError
from fits.loop._design import Grid, columns_of
from fits.loop._prior import interpolation
from fits.loop._uncertainty import Uncertainty
from fits.stage._moments import offsets_out
from fits.stage._run import place_of_hysteresis
from fits.stage._uncertainty import StageUncertainty
from microid import Preisach, Stage


def draw_plants(
    model: Preisach | Stage, uncertainty: Uncertainty | StageUncertainty | None, count: int, *, seed: int = 0
) -> tuple[Stage, ...]:
    """Draw stages from the covariance of a fit.

    Parameters
    ----------
    model, uncertainty
        From a fit or a model file.
    count
        How many stages in all, 1 or more; the first is the fitted one.
    seed
        Of the draws.

    Returns
    -------
    tuple of Stage
        All of one structure; a hysteresis alone becomes a stage of one part. Weights and slopes that a draw would
        make negative are zero. The model's own error (`discrepancy_um`) is not in them.

    Raises
    ------
    DataError
        If there is no uncertainty to draw from, or it is not that of the model.
    """
    if count < 1:
        raise ValueError(f"count must be 1 or more, got {count}")
    stage = model if isinstance(model, Stage) else Stage.of(hysteresis=model)
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
    law = stage.parts[place]
    if not isinstance(law, Preisach):
        raise DataError(f"{stage.names[place]!r} is a {type(law).__name__}: take off what is around the hysteresis")
    levels = law.density.levels
    columns = np.asarray(columns_of(law)) + interpolation(grid.levels, levels) @ columns_um
    fine = Grid(law.density.lower_V, law.density.upper_V, levels)
    return stage.swap(stage.names[place], fine.model(np.maximum(columns, 0.0), law.offset_um - float(mean_um)))
