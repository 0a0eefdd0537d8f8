"""Controllers tuned by differentiating through the closed loop, for all plants that a fit leaves possible."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from fits.control._tune_problem import REACH, Figures, Goal, Problem, Tuning, descend, judge, reports
from fits.control._tune_start import stages_given, steepest_slope
from fits.io._errors import DataError
from fits.io._length import length
from fits.loop._result import FitError, FitStatus
from fits.stage._model_file import AnyModel
from microid import Coordinates, ParameterInfo, Stage, Start, parameter_table
from microid.control import AbstractController

_Controller = TypeVar("_Controller", bound=AbstractController)

# Limits are kept to this share; the search stops where it moves no gain by more than this.
_TOLERANCE, _SMALLEST_MOVE = 2e-3, 1e-2


@dataclass(frozen=True)
class _End:
    y: Any
    gradient: np.ndarray
    figures: Figures
    over: dict[str, np.ndarray]
    cost_um: float
    settled: bool

    @property
    def kept(self) -> bool:
        return bool(np.all(np.asarray(self.figures.stable))) and _worst(self.over)[0] <= _TOLERANCE

    @property
    def converged(self) -> bool:
        # Per e-fold of a gain, such a relative change of the cost counts as none.
        return self.settled and bool(np.max(np.abs(self.gradient)) < 2e-2)


def tune_controller(
    controller: _Controller,
    plants: AnyModel | Sequence[AnyModel],
    reference_um: ArrayLike,
    *,
    goal: Goal | None = None,
    feedforward_V: ArrayLike | None = None,
    noise_um: ArrayLike | None = None,
    delay: int = 0,
    resolution_um: float | None = None,
    start: Start | None = None,
    skip: int = 0,
    free: Sequence[str] | None = None,
    starts: int = 2,
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
) -> Tuning[_Controller]:
    """Tune a controller on models, by the derivatives of whole closed loops.

    Gains are searched for in their logarithm (a BFGS method within an augmented Lagrangian for the limits), from the
    controller that is given and from places drawn around it. The best that was found within all limits comes back.

    The search begins with the controller, whose loop must be stable with every plant; see `relay_start`. `BPPID` and
    `CMACPID` have the margins of the PID controller that they are at first. Plants are one stage, or several of one
    structure, as from `draw_plants`; the first is the nominal one. There are one or several references, shape `(t,)`
    or `(r, t)`, with the feedforward and the noise of each, or of all, in the same shapes; none by default. The same
    noise is used throughout. See `Goal` for cost and limits, and `microid.control.simulate_loop` for delay,
    resolution and start. The first `skip` samples do not count.

    Parameters that move are those of the paths in `free`, such as `"pid"` or `"integral_V_per_um_s"`; by default
    gains: what cannot be negative, is not zero and is no time. There are so many places to search from, drawn by the
    seed, and `progress` is told of each.

    A `DataError` says that plants differ in structure, signals in shape, or that there is nothing to tune; a
    `FitError` that the loop is unstable at the start, that no place within all limits was found, or none better than
    the start, although that is not an optimum.
    """
    stages = stages_given(plants)
    resolution = None if resolution_um is None else jnp.asarray(float(resolution_um))
    fixed = {"start": start or Start(), "delay": delay, "resolution_um": resolution}
    signals = {"feedforward_V": feedforward_V, "noise_um": noise_um}
    problem = _problem(controller, stages, goal or Goal(), reference_um, signals, skip, free, **fixed)
    origin = jnp.zeros_like(problem.origin)
    figures, over, cost = judge(problem, origin)
    if not np.all(np.asarray(figures.stable)):
        which = np.flatnonzero(~np.asarray(figures.stable)) + 1
        detail = f"at the start, with plant {', '.join(map(str, which))} of {len(stages)}"
        raise FitError(FitStatus.UNSTABLE, detail, "tuning")
    progress(f"start: cost {length(float(cost), 4)}, {_excess_in_words(over)}")
    first = _worst(over)
    rng, ends = np.random.default_rng(seed), []
    for number in range(starts):
        end = _search(problem, origin if number == 0 else _stable_place(problem, rng))
        progress(f"search {number + 1} of {starts}: cost {length(end.cost_um, 4)}, {_excess_in_words(end.over)}")
        ends.append(end)
    kept = [end for end in ends if end.kept]
    if not kept:
        nearest = min(ends, key=lambda end: _worst(end.over)[0])
        raise FitError(FitStatus.LIMITS, _excess_in_words(nearest.over), "tuning")
    best = min(kept, key=lambda end: end.cost_um)
    remarks = []
    if first[0] > _TOLERANCE:
        remarks.append(
            f"the controller at the start was beyond a limit ({_excess_in_words(over)}), so its cost is no bound"
        )
    elif best.cost_um > float(cost) * (1 - 1e-9) or float(jnp.max(jnp.abs(best.y))) < _TOLERANCE:
        if not best.converged or best.cost_um > float(cost) * (1 + _TOLERANCE):
            detail = "no search found better gains than those at the start"
            raise FitError(FitStatus.NOT_STATIONARY, detail, "tuning")
        remarks.append("the gains at the start were already as good as any near them")
    if not best.converged:
        remarks.append("the search stopped before the slope of the cost was nothing: other starts may do better")
    remarks += _remarks(problem, best, ends)
    tuned = problem.controller(best.y)
    before, after = parameter_values(controller), parameter_values(tuned)
    gains = {row.path: (before[row.path], after[row.path]) for row in problem.coordinates.table}
    return Tuning(tuned, float(cost), best.cost_um, best.converged, reports(best.figures), gains, tuple(remarks))


def _problem(
    controller: Any,
    stages: Sequence[Stage],
    goal: Goal,
    reference_um: ArrayLike,
    signals: dict[str, ArrayLike | None],
    skip: int,
    free: Sequence[str] | None,
    **fixed: Any,
) -> Problem:
    if len({jax.tree.structure(one) for one in stages}) != 1:
        raise DataError("expected one plant or more, all of the same parts in the same order")
    reference = np.atleast_2d(np.asarray(reference_um, dtype=float))
    for name, signal in signals.items():
        row = None if signal is None else np.asarray(signal, dtype=float)
        if row is not None and row.shape not in (reference.shape, reference.shape[1:]):
            raise DataError(f"{name} has shape {row.shape}, expected {reference.shape} or one row of it")
        fixed[name] = None if row is None else jnp.asarray(np.broadcast_to(row, reference.shape))
    if not 0 <= skip < reference.shape[1]:
        raise DataError(f"skip: expected a number of samples below {reference.shape[1]}, found {skip}")
    values = parameter_values(controller)
    coordinates = Coordinates(controller, lambda row: _moves(row, values[row.path], free))
    for name in free or ():
        if not any(_below(row.path, name) for row in coordinates.table):
            raise DataError(f"there is no parameter {name!r} to tune: choose some of {', '.join(values)}")
    origin = coordinates.of(controller)
    steps = jax.jvp(coordinates.values, (origin,), (jnp.ones_like(origin),))[1]
    now = jnp.abs(coordinates.values(origin))
    stretch = jnp.where(now > 0, now, 1) / steps
    slopes = [steepest_slope(stage) for stage in stages]
    return Problem(
        coordinates,
        origin,
        stretch,
        jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *stages),
        None if slopes[0] is None else jnp.asarray(np.asarray(slopes, dtype=float)),
        jnp.asarray(reference),
        counts=jnp.asarray((np.arange(reference.shape[1]) >= skip).astype(float)),
        weights_um_per_V=(jnp.asarray(float(goal.effort_um_per_V)), jnp.asarray(float(goal.rate_um_per_V))),
        limits={name: jnp.asarray(limit) for name, limit in goal.limits().items()},
        command_width_V=jnp.asarray(goal.command_width_V()),
        **fixed,
    )


def parameter_values(model: Any) -> dict[str, np.ndarray]:
    """The parameters of a controller or a stage by their path, in their units."""
    leaves = jax.tree_util.tree_flatten_with_path(model)[0]
    found = {jax.tree_util.keystr(path).lstrip("."): leaf for path, leaf in leaves}
    return {row.path: np.asarray(found[row.path]) for row in parameter_table(model)}


def _moves(row: ParameterInfo, value: np.ndarray, free: Sequence[str] | None) -> bool:
    if free is not None:
        return any(_below(row.path, name) for name in free)
    # What is on its bound stands infinitely far away in the search; 1e-6 of the scale is where it is put.
    gain = row.spec.lower == 0 and row.spec.unit != "s"
    return bool(gain and np.all(value > 2e-6 * row.spec.scale))


def _below(path: str, name: str) -> bool:
    return path == name or path.startswith((f"{name}.", f"{name}["))


def _stable_place(problem: Problem, rng: np.random.Generator) -> Any:
    """A place drawn around the start, drawn nearer until all loops are stable."""
    y = jnp.asarray(rng.normal(0, 1.0, problem.origin.shape))
    for _ in range(8):
        if np.all(np.asarray(judge(problem, y)[0].stable)):
            return y
        y = y / 2
    return jnp.zeros_like(y)


def _search(problem: Problem, y: Any) -> _End:
    over = judge(problem, y)[1]
    multipliers = {name: jnp.zeros_like(share) for name, share in over.items()}
    weight, worst, settled = 10.0, np.inf, False
    for _ in range(12):
        moved, gradient = descend(problem, y, over, multipliers, jnp.asarray(weight))
        figures, over, cost = judge(problem, moved)
        distance, y = float(jnp.max(jnp.abs(moved - y))), moved
        now = _worst(over)[0]
        pressed = any(bool(jnp.any(one > 0)) for one in multipliers.values())
        # Without a limit that presses, nothing changes from here on.
        settled = (now <= 0 and not pressed) or (now <= _TOLERANCE and distance < _SMALLEST_MOVE)
        if settled or not np.isfinite(now):
            break
        multipliers = {name: jnp.maximum(one + weight * over[name], 0) for name, one in multipliers.items()}
        weight = min(weight * (4.0 if now > worst / 2 else 1.0), 1e6)
        worst = max(now, 0.0)
    return _End(y, np.asarray(gradient), figures, {k: np.asarray(v) for k, v in over.items()}, float(cost), settled)


def _worst(over: dict[str, Any]) -> tuple[float, str]:
    """The largest excess and its limit."""
    found = max((float(np.max(share)), name) for name, share in over.items())
    return found if np.isfinite(found[0]) else (np.inf, found[1])


def _excess_in_words(over: dict[str, Any]) -> str:
    share, name = _worst(over)
    # That of the overshoot is a logarithm.
    passed = np.expm1(share) if name == "overshoot_max_pct" else share
    return "within all limits" if share <= _TOLERANCE else f"{name} passed by {100 * passed:.3g} %"


def _remarks(problem: Problem, best: _End, ends: Sequence[_End]) -> Iterator[str]:
    alike = sum(end.kept and end.cost_um <= 1.01 * best.cost_um for end in ends)
    if len(ends) > 1 and alike < len(ends):
        yield f"{alike} of {len(ends)} searches ended within 1 % of the best cost: the others at worse optima"
    rows = problem.coordinates.table
    ends_of_rows = np.cumsum([int(np.prod(row.shape)) for row in rows])
    for row, moved in zip(rows, np.split(np.abs(np.asarray(best.y)), ends_of_rows[:-1]), strict=True):
        if np.any(moved > 0.8 * REACH):
            name = row.path.removeprefix("pid.")
            yield f"{name} is at the edge of what is searched: it hardly matters, or the start was far off"
    pressing = [name for name, share in best.over.items() if np.max(share) > -_TOLERANCE]
    if pressing:
        yield f"at its limit, which is kept to {100 * _TOLERANCE:g} %: {', '.join(pressing)}"
