"""What pulls a fit: readings that come late, or before their command, and outliers; intervals reach beyond it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize_scalar

from fits.io._errors import DataError
from fits.loop._design import columns_of
from fits.loop._misfit import Misfit, outlying
from fits.loop._result import FitResult
from fits.loop._run import Run
from fits.stage._checks import BESIDE_A_LAG
from fits.stage._columns import pieces
from fits.stage._moments import along, linearise
from fits.stage._plan import Plan
from fits.stage._run import hysteresis_of, nuisance_columns, project_out, simulate_stage
from fits.stage._solve import Problem, Solved, try_chain
from fits.stage._start import MeasuredResponse, best_shifts, measure_response, start_stages
from fits.stage._steps import hysteresis_alone
from fits.stage._uncertainty import NO_PRECISION, Precision, sandwich
from fits.stats._metrics import TWO_SIDED_95
from microid import Preisach, Stage

# It must move a parameter by so many of that one's standard deviations, too.
_MOVED_SD = 0.5
# The search for delays goes so many samples either way.
_FARTHEST_SAMPLES = 64
# The best delay of a response is narrowed in so many trials, so many of its steps to either side.
_NARROWED, _BESIDE = 6, 4.0
# What a stage leaves, in % of the stroke, that is more than creep and its like would be.
GROSS_PCT = 2.0
_HELD = (
    "a command that is held between its samples comes half a sample late: fit it in steps, or check the time stamps"
)
# In samples, where it looks like that.
_ABOUT_HALF = 0.3, 0.75
_SHIFT = "check which columns and time stamps belong together, shift the displacement by as many lines, and fit again"


@dataclass(frozen=True)
class Alternative:
    """Where the parameters of a stage come out without something, and the ends of their 95 % intervals, `(p,)`."""

    values: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, solved: Solved) -> "Alternative":
        """Read it off a solution."""
        sd, values = Precision(solved).sd, solved.problem.chain.coordinates.values
        return cls(*(np.asarray(values(jnp.asarray(solved.z + k * TWO_SIDED_95 * sd))) for k in (0, -1, 1)))

    @classmethod
    def in_unit(cls, fit: FitResult[Stage], factor: float) -> "Alternative":
        """Where a fit comes out if a unit of its times is so many s."""
        powers = np.asarray([{"s": 1.0, "Hz": -1.0}.get(p.unit, 0.0) for p in fit.parameters])
        figures = [[getattr(p, name) for p in fit.parameters] for name in ("value", "lower", "upper")]
        return cls(*(factor**powers * np.asarray(each) for each in figures))

    def widen(self, fit: FitResult[Stage], said: str, remedy: str = "") -> FitResult[Stage]:
        """Let a fit's intervals reach these, and say first what pulls it and what to do about that."""
        parameters, named = [], []
        for p, v, a, b in zip(fit.parameters, self.values, self.low, self.high, strict=True):
            sd, lower, upper = float(np.hypot(p.sd, v - p.value)), min(p.lower, float(a)), max(p.upper, float(b))
            parameters.append(replace(p, sd=sd, lower=lower, upper=upper))
            named.append(f"{p.name} {v:.5g} {p.unit}")
        listed = ", ".join(named)
        remark = f"{said}; without that the parameters would be {listed}, and the intervals reach there"
        remark += f": {remedy}" if remedy else ""
        return replace(fit, parameters=tuple(parameters), remarks=(remark, *fit.remarks))


def fit_without_outliers(plan: Plan, solved: Solved) -> tuple[list[str], Alternative] | None:
    """Fit again without outliers: the files that have some, and the parameters; None where that has no use."""
    bad = [outlying(one.residual_um, run.fitted) for one, run in zip(solved.sums, solved.runs, strict=True)]
    sources = [run.record.source for one, run in zip(bad, solved.runs, strict=True) if one.any()]
    if plan.loss != "squares" or not sources:
        return None
    runs = [replace(run, fitted=run.fitted & ~one) for run, one in zip(solved.runs, bad, strict=True)]
    plan.progress(f"fitting without the outliers of {', '.join(sources)}")
    found = try_chain(solved.onward, runs, plan.loss, plan.progress, accept_best=True)
    return None if found is None else (sources, Alternative.of(found))


@dataclass(frozen=True)
class Delay:
    """A run's delay: how much later than the stage the readings come, and its standard deviation, in s."""

    run: Run
    delay_s: float
    sd_s: float

    @property
    def samples(self) -> float:
        return self.delay_s * self.run.rate_Hz

    @property
    def seen(self) -> bool:
        """Whether it is no chance."""
        return abs(self.delay_s) > 5.0 * self.sd_s and abs(self.samples) > 0.02

    def words(self) -> str:
        sd = self.sd_s * self.run.rate_Hz
        digits = max(1, min(4, 1 - int(np.floor(np.log10(max(sd, 1e-9))))))
        size = f"{abs(self.samples):.{digits}f} +- {sd:.{digits}f} samples ({abs(self.delay_s):.3g} s)"
        way = "AFTER what the voltage asks for" if self.delay_s > 0 else "BEFORE the voltage that causes it"
        return f"the displacement comes {size} {way}"


@dataclass(frozen=True)
class WithoutDelays:
    """A fit of the same runs without their delays, and the delays of those that have one."""

    delays: tuple[Delay, ...]
    solved: Solved

    def words(self) -> str:
        """Say what the columns of the runs look like."""
        return "; ".join(f"{one.run.record.source}: {one.words()}" for one in self.delays)

    @property
    def remedy(self) -> str | None:
        """What to do where the command is perhaps held, and every run late by that."""
        low, high = _ABOUT_HALF
        return _HELD if all(low < one.samples < high for one in self.delays) else None

    @property
    def advice(self) -> str:
        """What to do where no fit stands beside them; readings that lag come late, too."""
        return (self.remedy or _SHIFT) + (BESIDE_A_LAG if max(one.delay_s for one in self.delays) > 0 else "")

    def widen(self, fit: FitResult[Stage]) -> FitResult[Stage]:
        """Name the delays, and widen intervals by what they did; a `DataError` if that leaves nothing to say."""
        other, said = Alternative.of(self.solved), self.words()
        for p, v in zip(fit.parameters, other.values, strict=True):
            if abs(v - p.value) > 0.5 * min(abs(v), abs(p.value)):
                moved = f"{p.name} would come out as {p.value:.4g} instead of {v:.4g} {p.unit}"
                raise DataError(f"{said}, and {moved}: {self.advice}")
        usual = "check columns and time stamps, or the delay of the sensor's electronics"
        return other.widen(fit, said, self.remedy or usual)


def fit_without_delays(
    plan: Plan, solved: Solved, precision: Precision | None, left: Sequence[Misfit]
) -> WithoutDelays | None:
    """Look for delays in what a fit leaves of each run, and fit again without them; None where that does not help.

    A small one shows as the derivative of the residual with respect to a delay (the score test of Rao 1948); of runs
    far from noise the frequency response is searched for larger ones, without a precision for these alone.
    """
    # Between two samples a command in steps has no place where it could be shifted to, and without a resonance to
    # measure it by a delay is part of the lag.
    if "zero" in plan.holds:
        return None
    start, strides = solved.onward, [run.stride for run in solved.runs]
    if start.least_noise_share:
        # Unless much is left, which may hide the resonance that was not found.
        gross = max(one.share_pct for one in left) > GROSS_PCT
        return fit_without_delays(plan, start.full, None, left) if gross and start.full is not None else None
    shifts = np.zeros(len(plan.records))
    far = [k for k, one in enumerate(left) if one.times_noise > 1.5]
    searched = _search(plan, solved, far)
    found: Solved | None = solved
    if searched is not None:
        shifts, start = searched
        found = _solved_with(plan, start, strides, shifts)
    elif precision is None or not any(one.seen for one in _scores(plan, solved, shifts)):
        return None
    if found is None:
        return None
    known: list[Delay] = []
    for _ in range(10):
        more = _scores(plan, found, shifts)
        known = [replace(one, delay_s=one.delay_s + shift) for one, shift in zip(more, shifts, strict=True)]
        # One at a time, the surest first: the parameters bend to a delay, which makes other runs look late, too.
        steps = [one.delay_s / one.sd_s if total.seen else 0.0 for one, total in zip(more, known, strict=True)]
        first = int(np.argmax(np.abs(steps)))
        if abs(steps[first]) <= 0.3:  # standard deviations
            break
        step = np.zeros(len(shifts))
        step[first] = more[first].delay_s
        # Where a parameter is at its bound, a line goes too far.
        for _ in range(4):  # halvings
            plan.progress(f"taking out delays of {', '.join(f'{1e3 * s:.4g}' for s in shifts + step)} ms")
            start = replace(start, z=found.z, columns_um=found.columns_um)
            again = _solved_with(plan, start, strides, shifts + step)
            if again is not None and again.weighing.noise_um[first] <= 1.01 * found.weighing.noise_um[first]:
                break
            step /= 2
        else:
            break
        assert again is not None
        shifts, found = shifts + step, again
    noises = zip(solved.weighing.noise_um, found.weighing.noise_um, strict=True)
    seen = tuple(
        one
        for one, shift, miss, (before, after) in zip(known, shifts, left, noises, strict=True)
        # Where much is left with it as without it, it is something else.
        if one.seen and shift and after < (0.4 if after > miss.noise_um * 2.0 else 1.0) * before
    )
    if not seen:
        return None
    if searched is None and precision is not None and np.max(np.abs(found.z - solved.z) / precision.sd) < _MOVED_SD:
        return None
    return WithoutDelays(seen, found)


def _solved_with(plan: Plan, start: Problem, strides: Sequence[int], shifts_s: np.ndarray) -> Solved | None:
    """Fit again with the command of each run that much later, as well as can be; None where that fails."""
    return try_chain(start, plan.shifted(shifts_s).runs(strides), plan.loss, plan.progress, accept_best=True)


def _scores(plan: Plan, solved: Solved, shifts: np.ndarray) -> list[Delay]:
    """Delays to first order beside all parameters, each run's alone; of the noise, that of the run itself counts."""
    precision = Precision(solved)
    chain, size = precision.chain, precision.chain.size
    here, stage = (jnp.asarray(solved.z), jnp.asarray(solved.columns_um)), solved.stage
    whole = precision.gram + precision.prior
    # What nothing is known of must not spoil the rest.
    whole = whole + NO_PRECISION * np.eye(len(whole))
    out = []
    for k, (run, one) in enumerate(zip(solved.runs, solved.sums, strict=True)):
        n, step, weight = len(run.record), 0.25 / run.rate_Hz, run.fit_weight
        late, early = (simulate_stage(stage, plan.run(k, run.stride, shifts[k] + sign * step)) for sign in (1, -1))
        full = np.zeros(run.samples.weight.shape[0])
        full[:n] = (late - early) / (2 * step)
        nuisance = jnp.asarray(nuisance_columns(stage, run.coarser.samples))
        late_um_per_s = np.asarray(project_out(nuisance, run.samples.weight, jnp.asarray(full)))[:n]
        worth = solved.weighing.shares[k] / precision.variance
        weighed = worth * weight * late_um_per_s
        _, slope, _ = linearise(chain, *here, run.coarser)
        border = np.concatenate([np.zeros(size), slope[:n].T @ weighed])
        for first, columns in pieces(chain, here[0], run, True):
            border[:size] += columns.T @ weighed[first : first + len(columns)]
        follow = np.linalg.solve(whole, border)
        known = float(weighed @ late_um_per_s - border @ follow)
        if not known > 1e-9 * float(weighed @ late_um_per_s):
            out.append(Delay(run, 0.0, np.inf))
            continue
        along_it = late_um_per_s - along(chain, *here, run, (follow[:size, None], follow[size:, None]))[:n, 0]
        influence = worth / known * np.sqrt(weight) * (along_it - np.average(along_it, weights=weight))
        noise = np.sqrt(weight) * one.residual_um
        sd = float(sandwich(influence[None], noise, run.fitted)[0, 0]) ** 0.5
        out.append(Delay(run, float(weighed @ one.residual_um) / known, sd))
    return out


def _search(plan: Plan, solved: Solved, far: Sequence[int]) -> tuple[np.ndarray, Problem] | None:
    """Large delays of the runs that are far from noise: shifts, and what to go on from; None where none helps."""
    # As it began: a delay bends the hysteresis of a joint fit, and the slow runs hardly feel it.
    stage, problem = solved.problem.stage, solved.onward
    law = hysteresis_of(stage) if problem.chain.size else None
    columns_um = np.asarray(columns_of(law)) if isinstance(law, Preisach) else np.zeros(0)
    start, drives = replace(problem, columns_um=columns_um), hysteresis_alone(stage, solved.runs)
    shifts, best = np.zeros(len(plan.records)), solved
    for k in far:
        response = measure_response(solved.runs[k], drives[k])
        if not len(response.frequency_Hz):
            continue
        there, found = _best_delay(plan, best, replace(start, hyper=None), response, shifts, k)
        # As likely as if it left 0.7 of the run's residual.
        if found.cost < best.cost + float(solved.runs[k].fitted.sum()) * np.log(0.7):
            best, shifts = found, there
    return (shifts, replace(start, z=best.z)) if np.any(shifts) else None


def _best_delay(
    plan: Plan, best: Solved, problem: Problem, response: MeasuredResponse, shifts: np.ndarray, k: int
) -> tuple[np.ndarray, Solved]:
    """Delay one run by what its response suggests: the shifts that leave least, and what they leave; or the best."""
    found, run = [(shifts, best)], best.runs[k]

    def cost(shift: float, start: Problem) -> float:
        plan.progress(f"{run.record.source}: trying a delay of {1e3 * shift:.4g} ms")
        there = np.r_[shifts[:k], shift, shifts[k + 1 :]]
        runs = plan.shifted(there).runs([one.stride for one in best.runs])
        one = try_chain(start, runs, plan.loss, plan.progress, rough=True)
        found.extend([(there, one)] if one is not None else [])
        return np.inf if one is None else one.cost

    step = min(1.0 / run.rate_Hz, 0.1 / response.frequency_Hz.max())
    tried = best_shifts(problem.stage, response, step * np.arange(-_FARTHEST_SAMPLES, _FARTHEST_SAMPLES + 1))
    for shift in filter(None, tried[:3]):
        turn = np.exp(2j * np.pi * response.frequency_Hz * shift)
        moved = replace(response, response=response.response * turn, sampled=None)
        for candidate in start_stages(problem.stage, [moved])[:1]:
            cost(shift, replace(problem, z=np.asarray(problem.chain.coordinates.of(candidate))))
    there, nearest = min(found, key=lambda one: one[1].cost)
    if nearest is not best:
        # A response that a hysteresis bends has its least beside the delay.
        bounds = there[k] - _BESIDE * step, there[k] + _BESIDE * step
        settings = {"maxiter": _NARROWED, "xatol": 0.1 * step}
        start = (replace(problem, z=nearest.z),)
        minimize_scalar(cost, args=start, bounds=bounds, method="bounded", options=settings)
    return min(found, key=lambda one: one[1].cost)
