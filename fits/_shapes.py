"""Fitting densities with few or tangled parameters: Levenberg-Marquardt from several starts."""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, PRNGKeyArray
from optimistix import RESULTS

from fits._design import columns_of
from fits._moments import Data, Moments
from fits._prior import Hyper, roughness
from microid import FAMILIES, Coordinates, Preisach, Reversible

_STEPS = 400
_ROUNDS = 3
# Starts whose cost comes this close to the best one's agree with it, in units of the noise.
_AGREE = 2.0
# Directions of the data that hold less than this fraction of its largest are rounding.
_DUST = 1e-13


@dataclass(frozen=True)
class ShapeSolution:
    """A fitted density of any family.

    Attributes
    ----------
    model
        The best of all starts, in um.
    factor_um
        Factor of the covariance of its columns (Laplace), shape `(D, k)`.
    result
        Status of the solver at the best start.
    agreeing
        Number of starts that ended as well as the best one.
    starts
        Number of starts.
    gradient
        Largest derivative of the cost that is left, per coordinate.
    """

    model: Preisach
    factor_um: Float[Array, "D k"]
    result: RESULTS
    agreeing: int
    starts: int
    gradient: float


class _Problem(eqx.Module):
    """The data as a short regression: `root @ columns ~ target`, in noise standard deviations."""

    root: Float[Array, "D D"]
    target: Float[Array, " D"]
    slopes: Float[Array, "s N"]
    coordinates: Coordinates[Preisach]
    stroke_um: Float[Array, ""]


def _residual(
    z: Float[Array, " k"], args: tuple[_Problem, Float[Array, ""]]
) -> tuple[Float[Array, " D"], Float[Array, " s"], Float[Array, " k"]]:
    problem, precision = args
    model = problem.coordinates(z)
    columns = columns_of(model) / problem.stroke_um
    slopes = columns[-model.reversible.levels :]
    return problem.root @ columns - problem.target, problem.slopes @ slopes, jnp.sqrt(precision) * z


@eqx.filter_jit
def _solve(
    problem: _Problem, start: Float[Array, " k"], precision: Float[Array, ""]
) -> tuple[Float[Array, " k"], RESULTS, Float[Array, ""], Float[Array, ""]]:
    solver = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6)
    args = (problem, precision)
    solution = optx.least_squares(_residual, solver, start, args=args, max_steps=_STEPS, throw=False)

    def cost(z: Float[Array, " k"]) -> Float[Array, ""]:
        return sum(jnp.sum(r**2) / 2 for r in _residual(z, args))

    value, gradient = jax.value_and_grad(cost)(solution.value)
    return solution.value, solution.result, value, jnp.max(jnp.abs(gradient))


@eqx.filter_jit
def _laplace(
    problem: _Problem, z: Float[Array, " k"], precision: Float[Array, ""]
) -> tuple[Float[Array, "D k"], Float[Array, ""]]:
    """Factor of the covariance of the columns, and the precision that the coordinates' spread calls for."""

    def stacked(z: Float[Array, " k"]) -> Float[Array, " m"]:
        return jnp.concatenate(_residual(z, (problem, precision)))

    jacobian = jax.jacfwd(stacked)(z)
    curvature = jacobian.T @ jacobian
    root = jnp.linalg.cholesky(curvature)
    inverse = jax.scipy.linalg.solve_triangular(root, jnp.eye(z.shape[0]), lower=True)
    determined = z.shape[0] - precision * jnp.sum(inverse**2)
    columns = jax.jacfwd(lambda z: columns_of(problem.coordinates(z)))(z)
    return columns @ inverse.T, jnp.maximum(determined, 1e-3) / jnp.sum(z**2)


def solve_shape(
    family: str,
    data: Data,
    stroke_um: float,
    correlation: float,
    hyper: Hyper,
    starts: int,
    key: PRNGKeyArray,
    progress: Callable[[str], None],
) -> ShapeSolution:
    """Fit a family that is not linear in its parameters.

    The record enters through its moments only, so that a start costs milliseconds whatever the record's length.
    The weight that holds the coordinates near zero is chosen by the evidence (MacKay's fixed point).

    Parameters
    ----------
    family
        Name in `microid.FAMILIES`.
    data
        Moments of the runs.
    stroke_um
        Displacement that the relays account for, roughly.
    correlation
        Samples that are worth one independent one.
    hyper
        Noise, and smoothness of the reversible part, as the grid found them.
    starts
        Number of starts.
    key
        Draws the starts.
    progress
        Told what is being done.
    """
    grid = data.grid
    moments = data.total.scaled(1 / correlation, stroke_um)
    variance = jnp.exp(hyper.log_variance)

    def draw(key: PRNGKeyArray) -> Preisach:
        half = jnp.asarray(stroke_um / 2)
        density = FAMILIES[family].start(grid.lower_V, grid.upper_V, grid.levels, half, key)
        slope = jnp.full(grid.levels, half / grid.range_V)
        return Preisach(density, Reversible(slope, grid.lower_V, grid.upper_V), jnp.asarray(0.0))

    keys = jax.random.split(key, starts)
    coordinates = Coordinates(draw(keys[0]), free=lambda info: info.path != "offset_um")
    root, target = _square_root(moments, variance)
    rough = roughness(grid.levels).reversible[grid.weights :, grid.weights :]
    values, vectors = jnp.linalg.eigh(rough * jnp.exp(hyper.log_reversible))
    slopes = jnp.sqrt(jnp.maximum(values, 0))[:, None] * vectors.T
    problem = _Problem(root, target, slopes, coordinates, jnp.asarray(stroke_um))

    precision = jnp.asarray(1.0)
    ends = []
    for number, one in enumerate(keys):
        progress(f"{family}: start {number + 1} of {starts}")
        ends.append(_solve(problem, coordinates.of(draw(one)), precision))
    costs = jnp.stack([end[2] for end in ends])
    best = int(jnp.nanargmin(costs)) if bool(jnp.any(jnp.isfinite(costs))) else 0
    agreeing = int(jnp.sum(costs < costs[best] + _AGREE))
    z, result, _, gradient = ends[best]
    factor = jnp.zeros((grid.columns, 0))
    for number in range(_ROUNDS):
        progress(f"{family}: weighing the prior, round {number + 1} of {_ROUNDS}")
        factor, precision = _laplace(problem, z, precision)
        z, result, _, gradient = _solve(problem, z, precision)
    factor, _ = _laplace(problem, z, precision)
    return ShapeSolution(coordinates(z), factor, result, agreeing, starts, float(gradient))


@eqx.filter_jit
def _square_root(moments: Moments, variance: Float[Array, ""]) -> tuple[Float[Array, "D D"], Float[Array, " D"]]:
    """Factor the moments: `root' root` is the Gram matrix over the variance, `root' target` the cross products."""
    value, vector = jnp.linalg.eigh(moments.gram / variance)
    kept = value > _DUST * value[-1]
    scale = jnp.sqrt(jnp.where(kept, value, 0))
    seen = vector.T @ moments.cross_um / variance
    return scale[:, None] * vector.T, jnp.where(kept, seen / jnp.where(kept, scale, 1), 0)
