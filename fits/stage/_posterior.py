"""For those who do not trust a standard deviation: draws from a posterior by NUTS, and the profile likelihood."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from fits.io._errors import DataError
from fits.io._record import Record
from fits.loop._design import Grid, columns_of
from fits.loop._prior import Hyper
from fits.loop._result import FitResult
from fits.loop._run import Progress, Run, Samples, command_range_V
from fits.stage._began import weights_beside_pasts
from fits.stage._chain import offsets_out
from fits.stage._information import prior_precision
from fits.stage._run import (
    free_grid,
    nuisance_columns,
    prepare_again,
    project_out,
    range_of,
    residual_of,
    respond,
)
from fits.stage._solve import Problem, Solved, Weighing, solve_chain
from microid import Coordinates, Stage, parameter_table

# Half of the width that is looked at, in standard deviations of the quadratic approximation.
_WIDTH = 3.5


@dataclass(frozen=True)
class Draws:
    """Draws from a posterior: names of the parameters, and values in their units, shape `(draws, p)`.

    `divergences` are trajectories that went astray; more than a few mean that the draws are not to be trusted.
    """

    names: tuple[str, ...]
    values: np.ndarray
    divergences: int


def _potential(
    data: tuple[Coordinates[Stage], list[Samples], list[Float[Array, ""]]], z: Float[Array, " p"]
) -> Float[Array, ""]:
    """Minus the logarithm of the likelihood."""
    coordinates, runs, precision = data
    stage, total = coordinates(z), jnp.zeros(())
    for samples, share in zip(runs, precision, strict=True):
        left = samples.displacement_um - respond(stage, samples)
        off = project_out(nuisance_columns(stage, samples), samples.weight, left)
        total = total + share * jnp.sum(samples.weight * off**2) / 2
    return total


def sample_posterior(
    result: FitResult[Stage],
    records: Sequence[Record],
    *,
    draws: int = 1000,
    warmup: int = 500,
    seed: int = 0,
    holdout: float = 0.2,
    initial: str = "unknown",
) -> Draws:
    """Draw from the posterior of the parameters, flat in the solver's coordinates, the hysteresis as it was fitted.

    Needs numpyro: `pip install -c constraints.txt ".[posterior]"`; a `DataError` says that it is not installed. The
    sampler starts from a result of `fit_stage`; records, holdout and initial memory are those that were given there.
    `warmup` steps adapt it before the draws.
    """
    try:
        from numpyro.infer import MCMC, NUTS
    except ImportError:
        raise DataError('the posterior needs numpyro: pip install -c constraints.txt ".[posterior]"') from None
    stage = result.model.with_substeps(1)
    runs = _runs(result, records, initial, holdout)
    weighing = Weighing.of(runs, [residual_of(stage, run) for run in runs])
    precision = [
        jnp.asarray(1 / (noise**2 * correlation))
        for noise, correlation in zip(weighing.noise_um, weighing.correlation, strict=True)
    ]
    coordinates = offsets_out(stage, True)
    data = coordinates, [run.samples for run in runs], precision
    kernel = NUTS(potential_fn=eqx.Partial(_potential, data), dense_mass=True)
    sampler = MCMC(kernel, num_warmup=warmup, num_samples=draws, progress_bar=False)
    # The sampler's own arithmetic mixes precisions.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        sampler.run(jax.random.key(seed), init_params=coordinates.of(stage), extra_fields=("diverging",))
        z = sampler.get_samples()
        lost = int(np.sum(np.asarray(sampler.get_extra_fields()["diverging"])))
    values = np.asarray(jax.vmap(coordinates.values)(z))
    return Draws(tuple(parameter.name for parameter in result.parameters), values, lost)


@dataclass(frozen=True)
class Profile:
    """Profile of one parameter.

    The `deviance` is twice the loss of log likelihood at the `values` where it was held, shape `(k,)` both: a
    parabola where the standard deviation says all. `lower` and `upper` are the ends of the 95 % interval, or the last
    value looked at where the deviance stays below its bound. All but the deviance, which has none, are in `unit`.
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
    progress: Progress = lambda _: None,
) -> Profile:
    """Hold one parameter of a fitted stage at several values and fit all others again.

    The result is from `fit_stage`, with the squares as loss; records, holdout and initial memory are those that were
    given there. The values of the parameter, such as `mechanics.damping_ratio`, are evenly spread over seven standard
    deviations, less where a bound comes before. `progress` is told what is being done.

    A `DataError` says that no such parameter was fitted, a `FitError` that one of the fits failed.
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
    runs = _runs(result, records, initial, holdout)
    fitted = result.model.with_substeps(1)
    stroke_um = max(float(np.ptp(run.displacement_um)) for run in runs)
    best = _solved(fitted, runs, stroke_um)

    def deviance(value: float) -> float:
        progress(f"{name} = {value:.6g} {at.unit}")
        held = fitted.swap(part, eqx.tree_at(lambda p: getattr(p, field), fitted[part], jnp.asarray(value)))
        return _deviance(best, held.freeze(name))

    found = np.array([deviance(float(value)) for value in values])
    # Its square root is nearly straight.
    root = np.sign(values - at.value) * np.sqrt(np.maximum(found, 0.0))
    bound = float(scipy.stats.chi2.ppf(0.95, 1)) ** 0.5
    lower, upper = (float(np.interp(sign * bound, root, values)) for sign in (-1, 1))
    return Profile(name, at.unit, values, found, lower, upper)


def _runs(result: FitResult[Stage], records: Sequence[Record], initial: str, holdout: float) -> list[Run]:
    """Make the runs of a result ready, of which samples beside an unknown past count as they did in the fit."""
    range_V = range_of(result.model)
    if not np.isfinite(range_V[0]):
        range_V = command_range_V(records)
    runs = prepare_again(result, records, [initial] * len(records), holdout, range_V)
    stage = result.model.with_substeps(1)
    weights = weights_beside_pasts(runs, [residual_of(stage, run) for run in runs])
    return [replace(run, weight=weight) for run, weight in zip(runs, weights, strict=True)]


def _solved(stage: Stage, runs: list[Run], stroke_um: float, like: Solved | None = None) -> Solved:
    """Fit what is free of a stage, noise and smoothness as in another solution; a `ValueError` where nothing is."""
    fitted = free_grid(stage)
    if fitted is None:
        problem = Problem.of(stage, None, np.zeros(0), None, stroke_um)
    else:
        law = fitted[1]
        grid = Grid(law.density.lower_V, law.density.upper_V, law.density.levels)
        hyper = Hyper.start() if like is None else like.hyper
        problem = Problem.of(stage, grid, np.asarray(columns_of(law)), hyper, stroke_um)
    return solve_chain(problem, runs, "squares", lambda _: None, like=like)


def _deviance(best: Solved, stage: Stage) -> float:
    """Twice the loss of log posterior with the rest of a stage fitted again, noise and prior as they are at best."""
    runs, stroke_um = best.runs, best.problem.stroke_um
    try:
        solved = _solved(stage, runs, stroke_um, best)
    except ValueError:
        # Nothing else may move.
        left, columns = [residual_of(stage, run) for run in runs], np.zeros(0)
    else:
        left, columns = solved.residuals_um, solved.columns_um
    misfit = best.weighing.cost_um2(runs, left) - best.weighing.cost_um2(runs, best.residuals_um)
    deviance = misfit / best.weighing.least_um**2
    if not len(columns):
        return deviance
    prior = prior_precision(best.problem.chain, best.hyper, stroke_um)
    return deviance + float(columns @ prior @ columns - best.columns_um @ prior @ best.columns_um)
