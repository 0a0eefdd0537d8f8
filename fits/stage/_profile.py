"""Profile likelihood: how much worse the runs are explained with one parameter held, all others fitted again."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2

from fits.io._errors import DataError
from fits.io._record import Record
from fits.loop._design import Grid, columns_of
from fits.loop._prior import Hyper
from fits.loop._result import FitResult
from fits.loop._run import Run
from fits.stage._moments import Chain
from fits.stage._run import place_of_hysteresis, prepare_again, residual_of
from fits.stage._solve import Solved, prior_precision, solve_chain
from fits.stage._uncertainty import offsets_out
from microid import GridDensity, Preisach, Stage, parameter_table

# Half of the width that is looked at, in standard deviations of the quadratic approximation.
_WIDTH = 3.5


@dataclass(frozen=True)
class Profile:
    """Profile of one parameter.

    Attributes
    ----------
    name, unit
        The parameter.
    values
        Where it was held, shape `(k,)`.
    deviance
        Twice the loss of log likelihood, shape `(k,)`; a parabola where the standard deviation says all.
    lower, upper
        Ends of the 95 % interval; the last value looked at where the deviance stays below its bound.
    """

    name: str
    unit: str
    values: np.ndarray
    deviance: np.ndarray
    lower: float
    upper: float


def profile_stage(
    result: FitResult[Stage],
    records: Sequence[Record],
    name: str,
    *,
    points: int = 9,
    holdout: float = 0.2,
    initial: str = "unknown",
    progress: Callable[[str], None] = lambda _: None,
) -> Profile:
    """Hold one parameter of a fitted stage at several values and fit all others again.

    Parameters
    ----------
    result
        From `fit_stage` of the same records, with the squares as loss.
    records, holdout, initial
        As they were given there.
    name
        Of the parameter, such as `mechanics.damping_ratio`.
    points
        Number of values, evenly spread over seven standard deviations, less where a bound comes before.
    progress
        Told what is being done.

    Raises
    ------
    DataError
        If no such parameter was fitted.
    FitError
        If one of the fits fails.
    """
    names = [parameter.name for parameter in result.parameters]
    if name not in names or name.endswith("]"):
        raise DataError(f"no single parameter {name!r} was fitted: choose one of {', '.join(names)}")
    at = result[name]
    part, field = name.split(".", 1)
    spec = next(row.spec for row in parameter_table(result.model) if result.model.named(row.path) == name)
    low, high = at.value - _WIDTH * at.sd, at.value + _WIDTH * at.sd
    if low <= spec.lower:
        low = spec.lower + 0.01 * (at.value - spec.lower)
    if high >= spec.upper:
        high = spec.upper - 0.01 * (spec.upper - at.value)
    values = np.linspace(low, high, points)
    runs = prepare_again(result.model, records, initial, holdout)
    problem = _Held.of(result.model.with_substeps(1), runs, initial_hyper=Hyper.start())

    def deviance(value: float) -> float:
        progress(f"{name} = {value:.6g} {at.unit}")
        stage = problem.stage
        held = stage.swap(part, eqx.tree_at(lambda p: getattr(p, field), stage[part], jnp.asarray(value)))
        return problem.deviance(held.freeze(name))

    found = np.array([deviance(float(value)) for value in values])
    # Its square root is nearly straight.
    root = np.sign(values - at.value) * np.sqrt(np.maximum(found, 0.0))
    bound = float(chi2.ppf(0.95, 1)) ** 0.5
    lower, upper = (float(np.interp(sign * bound, root, values)) for sign in (-1, 1))
    return Profile(name, at.unit, values, found, lower, upper)


@dataclass(frozen=True)
class _Held:
    """A fit that others are compared with."""

    stage: Stage
    runs: Sequence[Run]
    solved: Solved
    stroke_um: float

    @classmethod
    def of(cls, stage: Stage, runs: Sequence[Run], initial_hyper: Hyper) -> "_Held":
        stroke = max(float(np.ptp(run.displacement_um)) for run in runs)
        chain, columns = _chain(stage)
        hyper = initial_hyper if chain.grid is not None else None
        z = np.asarray(chain.coordinates.of(stage))
        return cls(stage, runs, solve_chain(chain, z, columns, runs, hyper, stroke, "squares", _quiet), stroke)

    def deviance(self, stage: Stage) -> float:
        """Twice the loss of log posterior with the rest fitted again, the noise and the prior as they are here."""
        best = self.solved
        try:
            chain, columns = _chain(stage)
        except ValueError:
            # Nothing else may move.
            left, columns, size = [residual_of(stage, run) for run in self.runs], np.zeros(0), 0
            prior = np.zeros((0, 0))
        else:
            start = np.asarray(chain.coordinates.of(stage)), columns, self.runs, best.hyper, self.stroke_um
            solved = solve_chain(chain, *start, "squares", _quiet)
            left, columns, size = solved.residuals_um, solved.columns_um, chain.size
            prior = prior_precision(chain, best.hyper, self.stroke_um)
        variance = best.weighing.least_um**2
        misfit = best.weighing.cost_um2(self.runs, left) - best.weighing.cost_um2(self.runs, best.residuals_um)
        if size == 0:
            return misfit / variance
        return misfit / variance + float(columns @ prior @ columns - best.columns_um @ prior @ best.columns_um)


def _quiet(_: str) -> None:
    pass


def _chain(stage: Stage) -> tuple[Chain, np.ndarray]:
    place = place_of_hysteresis(stage)
    law = None if place is None else stage.parts[place]
    if (
        isinstance(law, Preisach)
        and isinstance(law.density, GridDensity)
        and stage.names[place or 0] not in stage.frozen
    ):
        density = law.density
        grid = Grid(density.lower_V, density.upper_V, density.levels)
        return Chain(offsets_out(stage, True), place, grid), np.asarray(columns_of(law))
    return Chain(offsets_out(stage, False), None, None), np.zeros(0)
