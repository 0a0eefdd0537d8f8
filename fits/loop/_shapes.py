"""Fitting densities with few or tangled parameters: Powell's dogleg from several starts."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, PRNGKeyArray

from fits.loop._design import columns_of
from fits.loop._grid import Estimate
from fits.loop._moments import Data, square_root
from fits.loop._prior import Hyper, roughness
from fits.loop._result import FitError, FitStatus
from fits.loop._run import Progress, Run, simulate_run
from fits.stats._noise import correlation_samples, shared_square
from microid import Coordinates, Preisach, Reversible
from microid.densities import FAMILIES

# Steps at a time; every start gets these, the leading ones are followed while their cost falls.
_STEPS = 60
_TIMES = 12
_ROUNDS = 4


class _Problem(eqx.Module):
    """The data as a short regression: `scale (root @ columns - target)`, in noise standard deviations."""

    root: Float[Array, "D D"]
    target: Float[Array, " D"]
    scale: Float[Array, ""]
    slopes: Float[Array, "s N"]
    precision: Float[Array, ""]
    coordinates: Coordinates[Preisach]
    stroke_um: Float[Array, ""]


def _residual(z: Float[Array, " k"], problem: _Problem) -> Float[Array, " m"]:
    model = problem.coordinates(z)
    columns = columns_of(model) / problem.stroke_um
    slopes = columns[-model.reversible.levels :]
    misfit = problem.scale * (problem.root @ columns - problem.target)
    return jnp.concatenate([misfit, problem.slopes @ slopes, jnp.sqrt(problem.precision) * z])


@eqx.filter_jit
def _descend(problem: _Problem, start: Float[Array, " k"]) -> tuple[Float[Array, " k"], Float[Array, ""]]:
    """Go some steps down from a start; returns where that leads and the cost there."""
    solver: Any = optx.Dogleg(rtol=1e-8, atol=1e-8)
    solution: Any = optx.least_squares(_residual, solver, start, args=problem, max_steps=_STEPS, throw=False)
    return solution.value, jnp.sum(_residual(solution.value, problem) ** 2) / 2


def _follow(problem: _Problem, z: Float[Array, " k"]) -> tuple[Float[Array, " k"], float]:
    cost = float("inf")
    for _ in range(_TIMES):
        z, lower = _descend(problem, z)
        settled = not float(lower) < cost - 0.05  # a tenth of what noise does
        cost = float(lower)
        if settled:
            break
    return z, cost


@eqx.filter_jit
def _laplace(
    problem: _Problem, z: Float[Array, " k"]
) -> tuple[Float[Array, "D k"], Float[Array, ""], Float[Array, ""]]:
    """Factor of the covariance of the columns, number of coordinates the data determine, Newton decrement."""
    jacobian = jax.jacfwd(_residual)(z, problem)
    root = jnp.linalg.cholesky(jacobian.T @ jacobian)
    inverse = jax.scipy.linalg.solve_triangular(root, jnp.eye(z.shape[0]), lower=True)
    determined = z.shape[0] - problem.precision * jnp.sum(inverse**2)
    columns = jax.jacfwd(lambda z: columns_of(problem.coordinates(z)))(z)
    slope = jacobian.T @ _residual(z, problem)
    return columns @ inverse.T, determined, jnp.linalg.norm(inverse @ slope)


def solve_shape(
    family: str,
    data: Data,
    runs: Sequence[Run],
    stroke_um: float,
    hyper: Hyper,
    starts: int,
    key: PRNGKeyArray,
    progress: Progress,
) -> tuple[Estimate, bool]:
    """Fit one of `microid.densities.FAMILIES` that is not linear in its parameters, on a record's moments alone.

    The weight that holds the coordinates near zero is chosen by the evidence (MacKay's fixed point), and the noise is
    what this family leaves, which may be more than the grid's, in `hyper`. Returns the best of all starts, and
    whether the two best ended at the same cost. A `FitError` if no start ends finite, or the best is not stationary.
    """
    grid = data.grid
    moments = data.total.scaled(1.0, stroke_um)
    variance = float(np.exp(hyper.log_variance))

    def draw(key: PRNGKeyArray) -> Preisach:
        half = jnp.asarray(stroke_um / 2)
        density = FAMILIES[family].start(grid.lower_V, grid.upper_V, grid.levels, half, key)
        slope = jnp.full(grid.levels, half / grid.range_V)
        return Preisach(density, Reversible(slope, grid.lower_V, grid.upper_V), jnp.asarray(0.0))

    keys = jax.random.split(key, starts)
    coordinates = Coordinates(draw(keys[0]), free=lambda info: info.path != "offset_um")
    gram, cross, energy = (np.asarray(x)[None] for x in (moments.gram, moments.cross_um, moments.energy_um2))
    root, target = (jnp.asarray(x[0]) for x in square_root(gram, cross, energy, negligible=1e-13)[:2])
    rough = roughness(grid.levels).reversible[grid.weights :, grid.weights :]
    values, vectors = np.linalg.eigh(rough * np.exp(hyper.log_reversible))
    slopes = jnp.asarray(np.sqrt(np.maximum(values, 0))[:, None] * vectors.T)
    unit = jnp.asarray(1.0)
    # Starts race on a coarse scale: at the grid's own noise, most would crawl along narrow valleys.
    scale = jnp.asarray(1 / max(variance, 3e-3**2) ** 0.5)
    problem = _Problem(root, target, scale, slopes, unit, coordinates, jnp.asarray(stroke_um))

    ends = []
    for number, one in enumerate(keys):
        progress(f"{family}: start {number + 1} of {starts}")
        end, cost = _descend(problem, coordinates.of(draw(one)))
        ends.append((end, float(cost)))
    # Narrow valleys cost many steps: only those that lead the race go through them.
    ends = sorted((end for end in ends if np.isfinite(end[1])), key=lambda end: end[1])[:2]
    if not ends:
        raise FitError(FitStatus.NONFINITE)
    for number, (end, _) in enumerate(ends):
        progress(f"{family}: following start {number + 1} of {len(ends)}")
        ends[number] = _follow(problem, end)
    costs = [cost for _, cost in ends]
    best = int(np.argmin(costs))
    agree = max(costs) < costs[best] + 2.0  # in units of the noise

    z, count = ends[best][0], float(moments.count)
    precision, determined = 1.0, 0.0
    for number in range(_ROUNDS):
        progress(f"{family}: weighing the prior, round {number + 1} of {_ROUNDS}")
        model = coordinates(z)
        off = [run.weighed(run.displacement_um - simulate_run(model, run))[run.fitted] for run in runs]
        off = [o - o.mean() for o in off]
        variance = sum(float(np.sum(o**2)) for o in off) / stroke_um**2 / max(count - determined, 1)
        correlation = correlation_samples(off)
        weights = jnp.asarray((variance * correlation) ** -0.5), jnp.asarray(precision)
        problem = eqx.tree_at(lambda p: (p.scale, p.precision), problem, weights)
        z, _ = _follow(problem, z)
        factor, known, distance = _laplace(problem, z)
        determined = float(known)
        precision = max(determined, 1e-3) / float(jnp.sum(z**2))
    # In standard deviations per parameter that the data determine.
    if not float(distance) < 0.2 * max(determined, 1) ** 0.5:
        raise FitError(FitStatus.NOT_STATIONARY)
    shared = sum(shared_square(o) * len(o) for o in off) / sum(len(o) for o in off)
    estimate = Estimate(
        model=coordinates(z),
        factor_um=np.asarray(factor),
        noise_um=variance**0.5 * stroke_um,
        correlation=correlation,
        discrepancy_um=max(0.0, shared) ** 0.5,
    )
    return estimate, agree
