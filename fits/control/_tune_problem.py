"""What tuning minimises, figures of many closed loops at once within their limits, and what it gives back."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from fits.io._kept import kept
from microid import Coordinates, Stage, Start
from microid.control import AbstractController, ControlledRun, Margins, margins, simulate_loop

_Controller = TypeVar("_Controller", bound=AbstractController)
# Every gain is searched for within `exp` of this of its start, to either side.
REACH = 6.0
_UNLIMITED = 1e9


@dataclass(frozen=True)
class Goal:
    r"""What a controller is tuned for: the least cost within the limits, of every plant and every reference.

    .. math:: J = \mathrm{rms}(e) + w_u\, \mathrm{rms}(u - u_{ff}) + w_{\Delta}\, \mathrm{rms}(u_k - u_{k-1})

    in um, each over all plants, references and samples that count. `effort_um_per_V` is the weight `w_u` of what the
    feedback adds to the feedforward, or to the command before the first sample, `rate_um_per_V` the weight `w_Δ` of
    the change of the command between samples, whose largest is limited by `command_step_max_V`.

    A limit of None is none. Margins and peak are those of the linearised loop of every plant; see
    `microid.control.Margins`. The overshoot is the displacement beyond the range that the reference and the rest
    before it span, in percent of that range; none where they span nothing. Limits of the command are short of where
    the controller cuts it off.
    """

    effort_um_per_V: float = 0.0
    rate_um_per_V: float = 0.0
    gain_margin_min: float | None = 2.0
    phase_margin_min_deg: float | None = 30.0
    sensitivity_peak_max: float | None = 2.0
    overshoot_max_pct: float | None = None
    command_min_V: float | None = None
    command_max_V: float | None = None
    command_step_max_V: float | None = None

    def limits(self) -> dict[str, float]:
        """All limits by name, far away where there is none: so one program does for all of them."""
        limits = {name: limit for name, limit in vars(self).items() if not name.endswith("_um_per_V")}
        nearer = {"gain_margin_min": 0.0, "phase_margin_min_deg": 1e-3, "command_min_V": -_UNLIMITED}
        return {
            name: nearer.get(name, _UNLIMITED) if limit is None else float(limit) for name, limit in limits.items()
        }

    def command_width_V(self) -> float:
        """What the excess of a command is counted in."""
        low, high = self.command_min_V, self.command_max_V
        if low is not None and high is not None:
            return float(high - low)
        return max(1.0, *(abs(float(x)) for x in (low, high) if x is not None), 1.0)


class Problem(eqx.Module):
    """A controller in the coordinates of its search, and all loops it is to close: of `p` plants and `r` references.

    The search begins at `origin`, where `stretch` is by how much a coordinate changes its parameter e-fold. The
    plants are stages with `p` values in every leaf; signals are None where there are none; `counts` says which
    samples count.
    """

    coordinates: Coordinates[Any]
    origin: Float[Array, " n"]
    stretch: Float[Array, " n"]
    plants: Stage
    slope_um_per_V: Float[Array, " p"] | None
    reference_um: Float[Array, "r t"]
    feedforward_V: Float[Array, "r t"] | None
    noise_um: Float[Array, "r t"] | None
    counts: Float[Array, " t"]
    start: Start
    weights_um_per_V: tuple[Float[Array, ""], Float[Array, ""]]
    limits: dict[str, Float[Array, ""]]
    command_width_V: Float[Array, ""]
    resolution_um: Float[Array, ""] | None
    delay: int = eqx.field(static=True)

    def controller(self, y: Float[Array, " n"]) -> Any:
        return self.coordinates(self.origin + self.stretch * REACH * jnp.tanh(y / REACH))


class Figures(eqx.Module):
    """What loops do, for `p` plants and `r` references: margins, mean squares, and extremes."""

    margins: Margins
    error_um2: Float[Array, "p r"]
    effort_V2: Float[Array, "p r"]
    rate_V2: Float[Array, "p r"]
    error_max_um: Float[Array, "p r"]
    overshoot_pct: Float[Array, "p r"]
    command_min_V: Float[Array, "p r"]
    command_max_V: Float[Array, "p r"]
    command_step_V: Float[Array, "p r"]

    @property
    def stable(self) -> Bool[Array, " p"]:
        """Whether the linearised loop of each plant is stable, and none of its runs overflows."""
        return self.margins.stable & jnp.all(jnp.isfinite(self.error_um2), axis=1)


def figures(problem: Problem, controller: Any) -> Figures:
    linear, count = controller.linear(), jnp.sum(problem.counts)
    common: dict[str, Any] = {"delay": problem.delay, "resolution_um": problem.resolution_um, "start": problem.start}

    def around(plant: Stage, slope: Float[Array, ""] | None) -> tuple[Margins, tuple[Array, ...]]:
        def along(reference: Array, ahead: Array | None, noise: Array | None) -> tuple[Array, ...]:
            run = simulate_loop(controller, plant, reference, feedforward_V=ahead, noise_um=noise, **common)
            rest = jnp.zeros((), reference.dtype) if problem.start.rest_V is None else problem.start.rest_V
            effort = run.command_V - (rest if ahead is None else ahead)
            # The first change is from the command before.
            rate = jnp.diff(run.command_V, prepend=rest if ahead is None else ahead[0])
            squares = (jnp.sum(problem.counts * x**2) / count for x in (run.error_um, effort, rate))
            largest, passed = jnp.max(problem.counts * jnp.abs(run.error_um)), overshoot_pct(run)
            return *squares, largest, passed, jnp.min(run.command_V), jnp.max(run.command_V), jnp.max(jnp.abs(rate))

        given = problem.reference_um, problem.feedforward_V, problem.noise_um
        found = eqx.filter_vmap(along, in_axes=(0, *(None if x is None else 0 for x in given[1:])))(*given)
        return margins(linear, plant, delay=problem.delay, slope_um_per_V=slope), found

    slopes = problem.slope_um_per_V
    axes = eqx.if_array(0), None if slopes is None else 0
    found, runs = eqx.filter_vmap(around, in_axes=axes)(problem.plants, slopes)
    return Figures(found, *runs)


def overshoot_pct(run: ControlledRun) -> Float[Array, ""]:
    """Displacement beyond the range of the reference and the rest before it, in percent of it; see `Goal`."""
    low = jnp.minimum(jnp.min(run.reference_um), run.displacement_um[0])
    high = jnp.maximum(jnp.max(run.reference_um), run.displacement_um[0])
    beyond = jnp.maximum(run.displacement_um - high, low - run.displacement_um)
    # A reference that covers less stands still.
    moves = high - low > 1e-6
    # Both arms are finite: a quotient by zero would leave no derivative, whichever arm is taken.
    return jnp.where(moves, 100 * jnp.maximum(jnp.max(beyond), 0) / jnp.where(moves, high - low, 1), 0)


def cost_um(problem: Problem, found: Figures) -> Float[Array, ""]:
    """The cost that `Goal` states."""
    squares = found.error_um2, found.effort_V2, found.rate_V2
    # Roots have no derivative at zero; a picometre is nothing.
    error, effort, rate = (jnp.sqrt(jnp.mean(x) + 1e-12) for x in squares)
    return error + problem.weights_um_per_V[0] * effort + problem.weights_um_per_V[1] * rate


def excess(problem: Problem, found: Figures) -> dict[str, Float[Array, "..."]]:
    """How far every limit is passed, as a share of it; negative within. Of each, one per plant or plant and run."""
    m, limits = found.margins, problem.limits
    # By how many e-folds an unstable motion grows over the record.
    out = {"stability": problem.counts.shape[0] * jnp.log(jnp.maximum(m.radius, 1e-3))}
    shares = {
        "gain_margin_min": lambda least: least / m.gain_margin - 1,
        "phase_margin_min_deg": lambda least: 1 - jnp.minimum(m.phase_margin_deg, 180) / least,
        "sensitivity_peak_max": lambda most: m.sensitivity_peak / most - 1,
        "overshoot_max_pct": lambda most: jnp.log((found.overshoot_pct + 1) / (most + 1)),
        "command_min_V": lambda least: (least - found.command_min_V) / problem.command_width_V,
        "command_max_V": lambda most: (found.command_max_V - most) / problem.command_width_V,
        "command_step_max_V": lambda most: found.command_step_V / most - 1,
    }
    out |= {name: shares[name](limit) for name, limit in limits.items()}
    # Of an unstable loop the margins mean nothing.
    margins = "gain_margin_min", "phase_margin_min_deg", "sensitivity_peak_max"
    return out | {name: jnp.where(m.stable, out[name], 1) for name in margins}


def _merit(
    y: Float[Array, " n"], args: tuple[Problem, dict[str, Array], Float[Array, ""], Float[Array, ""]]
) -> Float[Array, ""]:
    """Logarithm of the cost, and the augmented Lagrangian of the limits (Nocedal and Wright 2006, section 17.4)."""
    problem, multipliers, weight, scale = args
    found = figures(problem, problem.controller(y))
    over = excess(problem, found)
    # A long first step must not end where all is flat, from where no gradient leads back.
    total = jnp.log(cost_um(problem, found)) + jnp.sum(jnp.maximum(jnp.abs(y) - 2 * REACH, 0) ** 2)
    for name, share in over.items():
        push = jnp.maximum(share + multipliers[name] / weight, 0)
        total = total + jnp.sum(weight / 2 * push**2 - multipliers[name] ** 2 / (2 * weight))
    # Where nothing is finite, only the value is looked at: no line search stops there.
    return scale * jnp.where(jnp.isfinite(total), total, 1e9)


@kept
def judge(problem: Problem, y: Float[Array, " n"]) -> tuple[Figures, dict[str, Array], Float[Array, ""]]:
    """Figures at a place of the search, their excess over the limits, and the cost in um."""
    found = figures(problem, problem.controller(y))
    return found, excess(problem, found), cost_um(problem, found)


@kept
def descend(
    problem: Problem,
    y: Float[Array, " n"],
    over: dict[str, Array],
    multipliers: dict[str, Array],
    weight: Float[Array, ""],
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Minimise the augmented Lagrangian from a place on, whose excess is known: the place, and the gradient there."""
    # The first step is as long as the gradient: where limits are far passed, it must not leap over everything.
    pushed = [jnp.sum(jnp.maximum(weight * over[name] + multipliers[name], 0)) for name in over]
    scale = 1 / (1 + sum(pushed, start=jnp.zeros(())))
    solver: Any = optx.BFGS(rtol=1e-4, atol=1e-4)
    given = problem, multipliers, weight, scale
    # A handful of gains and thousands of samples: forwards nothing has to be kept.
    options = {"autodiff_mode": "fwd"}
    solution: Any = optx.minimise(_merit, solver, y, args=given, options=options, max_steps=80, throw=False)
    return solution.value, solution.state.f_info.grad / scale


@dataclass(frozen=True)
class LoopReport:
    """One plant under a tuned controller; figures of several references are the worst.

    The margins are those of the linearised loop, where the hysteresis is steepest; errors are over the samples that
    count; see `Goal` for the overshoot, and `command_step_max_V` is the largest change between samples.
    """

    margins: Margins
    error_rms_um: float
    error_max_um: float
    overshoot_pct: float
    command_min_V: float
    command_max_V: float
    command_step_max_V: float


@dataclass(frozen=True)
class Tuning(Generic[_Controller]):
    """A tuned controller, stable with every plant and within all limits, and what it is worth.

    Costs are those of the controller it began with, and of this one; see `Goal`. It is converged where nothing is
    left to gain nearby: the slope of the cost is small, or balanced by limits. There is one report per plant, the
    nominal one first; gains are before and after, in their units, by their path in the controller; remarks are what
    the user should know, one sentence each.
    """

    controller: _Controller
    cost_before_um: float
    cost_after_um: float
    converged: bool
    plants: tuple[LoopReport, ...]
    gains: dict[str, tuple[np.ndarray, np.ndarray]]
    remarks: tuple[str, ...]

    @property
    def worst(self) -> LoopReport:
        """The plant with the largest error."""
        return max(self.plants, key=lambda one: one.error_rms_um)


def reports(found: Figures) -> tuple[LoopReport, ...]:
    out = []
    for k in range(found.error_um2.shape[0]):
        one = jax.tree.map(lambda leaf, k=k: leaf[k], found)
        rms, lowest = float(jnp.max(one.error_um2)) ** 0.5, float(jnp.min(one.command_min_V))
        largest, passed = float(jnp.max(one.error_max_um)), float(jnp.max(one.overshoot_pct))
        highest, step = float(jnp.max(one.command_max_V)), float(jnp.max(one.command_step_V))
        out.append(LoopReport(one.margins, rms, largest, passed, lowest, highest, step))
    return tuple(out)


def passed_limits(goal: Goal, every: Sequence[Margins], runs: Sequence[ControlledRun]) -> dict[str, str]:
    """Find which limits a loop is beyond in its margins by plant, or in some runs, by the option of the command."""
    gain, phase = min(float(one.gain_margin) for one in every), min(float(one.phase_margin_deg) for one in every)
    peak, overshoot = max(float(one.sensitivity_peak) for one in every), max(map(float, map(overshoot_pct, runs)))
    worst = {
        "--gain-margin": (goal.gain_margin_min, gain, "a gain margin of {} or more", ""),
        "--phase-margin": (goal.phase_margin_min_deg, phase, "a phase margin of {} degrees or more", " degrees"),
        "--peak": (goal.sensitivity_peak_max, peak, "a peak of the sensitivity of {} or less", ""),
        "--overshoot": (goal.overshoot_max_pct, overshoot, "an overshoot of {} % or less", " %"),
    }
    out = {}
    for option, (limit, found, expected, unit) in worst.items():
        if limit is None:
            continue
        # An overshoot of nothing has no share.
        share = (found + 1) / (limit + 1) if option == "--overshoot" else found / limit
        # Tuning keeps limits to a share of 2e-3.
        if (1 - share if "margin" in option else share - 1) > 3e-3:
            out[option] = f"expected {expected.format(f'{limit:g}')}, found {found:.4g}{unit}"
    return out
