"""Causes and the baseline fitted to each other by turns, beside what noise and roughness there is."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np

from fits.diagnosis._baseline import Baseline, simulate
from fits.diagnosis._discrepancy import learn_roughness, smoothed, with_discrepancy
from fits.diagnosis._effects import Bench, Law, scaled
from fits.diagnosis._noise import find_faults
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, refit
from fits.diagnosis._regression import regress, saturating
from fits.diagnosis._relocate import relocate
from fits.diagnosis._score import Probe
from fits.diagnosis._thresholds import Thresholds
from fits.io._threads import map_in_threads
from fits.stage._run import named_parts
from fits.stage._start import measure_response, start_lagging, start_stages
from fits.stage._steps import hysteresis_alone
from fits.stats._compare import improvement_z
from microid import Mechanics, Stage
from microid.effects import AbstractEffect

# Simulations that differ by more than this, in all samples together, in noise, are not the same.
_LARGEST_DIFFERENCE = 1.0
# Multiple of a strength that is tried, and the gain in chi-square for which it is taken.
_LARGER, _BETTER = 1.5, 10.0
# What ended at its bound is tried again from this part of it.
_WEAKER = 0.8
# Of places where a fit may begin so many are followed.
_STARTS = 2
# Logarithm of the ratio of two natural frequencies from which on they are not the same resonance, and the damping
# ratio below which one shows clearly.
_ELSEWHERE, _CLEAR = 0.3, 0.3
# Rounds in which the baseline follows that first.
_FIRST = 2
# Further rounds in which baseline and causes follow each other, at most.
_AGAIN = 8
# Rounds beside a density whose zeros stay.
_BOUNDED = 4
# A coordinate that moves by less than this, in standard deviations, has not moved.
_MOVED_SD = 0.1
# A derivative of all samples along a coordinate below this, in noise, does not show.
_INSENSITIVE = 1.0
# A change of all samples above this, in noise, is seen; the distance to the coordinate's scale is halved at most so
# often for that.
_SEEN_CHANGE, _HALVES = 5.0, 16
# A sum of squares that grows by this factor there is that of a fit gone astray.
_ASTRAY = 1.5
# Noise or roughness that falls by less than this factor is the same.
_LESS = 0.8
# Factor of the prior's precision from which on what a cause does was taken for roughness of the density.
_SMOOTHER = 1000.0
State: TypeAlias = tuple[Bench, Projector, Refit]


def fit_jointly(bench: Bench, projector: Projector, model: Refit) -> State:
    """Let baseline and causes follow each other, unless that makes it worse by more than what is next to nothing.

    Where the baseline has to move far, its tangent says too much of an effect that it nearly follows.
    """
    moved = alternate(bench, projector, relocate(bench, projector, model))
    sensitive = _made_sensitive(projector, moved[-1])
    if sensitive is not None:
        there = _linearised_at(sensitive, projector, moved[-1])
        trial = alternate(*there, refit(*there, moved[-1].laws, moved[-1].x, 4))
        moved = trial if trial[-1].cost < moved[-1].cost else moved
    if moved[-1].cost > model.cost + _BETTER:
        # A baseline that moved without the roughness beyond its grid may have moved away.
        here = refit(bench, projector, model.laws, model.x, 4)
        moved = moved if moved[-1].cost < here.cost else (bench, projector, here)
    return moved


def fit_from_poles(bench: Bench, projector: Projector, model: Refit, better: bool = False) -> list[State]:
    """Fit the last effect jointly from poles that explain the responses of the runs together with it.

    A plain stage without a lag may have bent its own poles too far for a way back from there. Any other effect is
    fitted so only where the responses show a resonance far from that of the baseline, which has lost it. Where it
    must be `better`, a start is followed only if it leaves less than the model does.
    """
    baseline, law = bench.baseline, model.laws[-1]
    if not baseline.dynamic:
        return []
    drives = hysteresis_alone(baseline.stage, baseline.runs)
    # A lag is found with the poles, any other effect is taken off the readings.
    shown = replace(model, laws=model.laws[:-1], x=model.x[:-1]) if law.form.lag else model
    others_um = [bench.respond_in(run, shown.effects(run)) - plain for run, plain in enumerate(bench.plain)]
    cleaned = [
        replace(run, record=replace(run.record, displacement_um=run.displacement_um - um))
        for run, um in zip(baseline.runs, others_um, strict=True)
    ]
    responses, effects = list(map(measure_response, cleaned, drives)), law.effects(model.x[-1])
    found = list[tuple[Stage, list[AbstractEffect]]]()
    if law.form.lag:
        for stage, lag_s in start_lagging(baseline.stage, responses):
            found.append((stage, [replace(one, **{law.form.lag: jnp.asarray(lag_s)}) for one in effects]))
    else:
        away = (one for one in start_stages(baseline.stage, responses) if _resonates_elsewhere(one, baseline.stage))
        found = [(stage, effects) for stage in away]

    def begin(stage: Stage, begun: list[AbstractEffect]) -> State:
        there = replace(baseline, z=np.asarray(baseline.chain.coordinates.of(stage)))
        laws, x = model.with_law(len(model.laws) - 1, Law(begun, law.remembers))
        here = refit(bench, projector, laws, x, 0)
        state = _linearised_at(there, projector, here)
        return *state, refit(*state, laws, x, 4)

    starts = map_in_threads(begin, *zip(*found, strict=True)) if found else []
    starts = [state for state in starts if not better or state[-1].cost < model.cost - _BETTER]
    best = sorted(starts, key=lambda state: state[-1].cost)[:_STARTS]
    return map_in_threads(lambda state: alternate(*state), best)


def _resonates_elsewhere(stage: Stage, other: Stage) -> bool:
    """Whether a clear resonance of one is far from any that another has there."""
    pairs = zip(named_parts(stage, Mechanics), named_parts(other, Mechanics), strict=True)
    return any(
        float(one.damping_ratio) < _CLEAR
        and abs(float(jnp.log(one.natural_frequency_Hz / two.natural_frequency_Hz))) > _ELSEWHERE
        for (_, one), (_, two) in pairs
    )


def alternate(bench: Bench, projector: Projector, model: Refit, rounds: Sequence[int] = (4, 2)) -> State:
    """Fit the baseline to what effects leave, and effects beside it, by turns.

    A baseline fitted without them may be far from where it belongs, farther than its linearisation reaches: it goes
    on for as long as that pays.
    """
    for count in rounds:
        bench, projector = _follow(projector, model)
        model = refit(bench, projector, model.laws, model.x, count)
    for _ in range(_AGAIN if model.laws else 0):
        there, beside = _follow(projector, model)
        moved = refit(there, beside, model.laws, model.x, rounds[-1])
        if moved.cost > model.cost - _BETTER:
            break
        bench, projector, model = there, beside, moved
    return bench, projector, model


def refine(
    bench: Bench, projector: Projector, model: Refit, has_time: Callable[[], bool]
) -> tuple[Bench, Projector, Refit, bool]:
    """Refit the causes that were selected where the fits on the way were coarse, and say whether steps are many now.

    In turn: larger strengths, a density as rough and as smooth as it is beside the causes, many steps between
    samples, strengths that ended at a bound, and a density that is nowhere negative. Where it no longer `has_time`,
    only the steps and the density are seen to.
    """
    state = bench, projector, model
    for improved in (try_larger_strengths, relearn_roughness, relearn_smoothness):
        state = improved(*state) if has_time() else state
    model, finest = refine_steps(*state)
    # What is asked of the causes from here on is asked as they were fitted.
    bench, projector = Bench(state[0].baseline, model.change_um, finest=True) if finest else state[0], state[1]
    inside = leave_bounds(bench, projector, model, finest) if has_time() else (bench, projector, model)
    return *keep_density_positive(*inside, finest, has_time), finest


def try_larger_strengths(bench: Bench, projector: Projector, model: Refit) -> State:
    """Try effects that saturate at larger strengths: a baseline that has taken part of one hardly gives it up."""
    for k in range(len(model.laws)):
        while (form := model.laws[k].form).finite and form.strength:
            laws, x = model.with_law(k, scaled(model.laws[k], model.x[k], _LARGER))
            trial = alternate(bench, projector, refit(bench, projector, laws, x, 0))
            if trial[-1].cost > model.cost - _BETTER:
                break
            bench, projector, model = trial
    return bench, projector, model


def relearn_roughness(bench: Bench, projector: Projector, model: Refit) -> State:
    """Fit the causes again where beside them the density is less rough than was learnt without them."""
    if not model.laws or not any(projector.roughness):
        return bench, projector, model
    rough = learn_roughness(projector.bare, (), model.change_um)
    if not any(new < _LESS * old for new, old in zip(rough, projector.roughness, strict=True)):
        return bench, projector, model
    less = tuple(map(min, rough, projector.roughness))
    return fit_jointly(bench, projector.beside(roughness=less), model)


def relearn_smoothness(bench: Bench, projector: Projector, model: Refit) -> State:
    """Fit the causes again beside a density as smooth as it is beside them, unless that predicts worse."""
    if not model.laws:
        return bench, projector, model
    afresh = smoothed(projector, model.change_um)
    if not _prior_precision(afresh) > _SMOOTHER * _prior_precision(projector):
        # What the causes leave is no roughness.
        return bench, projector, model
    moved = fit_jointly(Bench(afresh.regression.baseline, model.change_um), afresh, model)
    before, after = (at.held_out(one.change_um) for at, one in ((projector, model), moved[1:]))
    return (bench, projector, model) if improvement_z(before, after) < 0 else moved


def refine_steps(bench: Bench, projector: Projector, model: Refit) -> tuple[Refit, bool]:
    """Fit the causes again with many steps between samples, where few are off by more than chance."""
    if not model.laws:
        return model, False
    finer = Bench(bench.baseline, model.change_um, finest=True)
    better = refit(finer, projector, model.laws, model.x, 0)
    off = [a - b for a, b in zip(better.change_um, model.change_um, strict=True)]
    if float(np.linalg.norm(projector.join(off))) < _LARGEST_DIFFERENCE:
        return model, False
    return refit(finer, projector, model.laws, model.x, 4), True


def leave_bounds(bench: Bench, projector: Projector, model: Refit, finest: bool) -> State:
    """Try weaker what ended at a bound, the baseline following before it is fitted, unless that is worse.

    Along a valley that a driver and its capacitance share, a fit may run into the bound, where it has no derivative.
    """
    for k, law in enumerate(model.laws):
        if not (law.form.strength and law.at_bound(model.x[k])):
            continue
        laws, x = model.with_law(k, scaled(law, model.x[k], _WEAKER))
        trial = bench, projector, refit(bench, projector, laws, x, 0)
        for _ in range(_FIRST):
            there = _follow(*trial[1:], finest)
            trial = *there, refit(*there, laws, x, 0)
        trial = *there, refit(*there, laws, x, 4)
        if trial[-1].cost < model.cost:
            bench, projector, model = trial
    return bench, projector, model


def keep_density_positive(
    bench: Bench, projector: Projector, model: Refit, finest: bool, has_time: Callable[[], bool] = lambda: True
) -> State:
    """Fit the causes again beside a density that is nowhere negative, once if it no longer `has_time`.

    A linearised density may take less than nothing, and there a cause may hide: a play in relays without width, a
    rail in those beyond it.
    """
    for number in range(_BOUNDED if model.laws else 0):
        if number and not has_time():
            break
        moved = _follow(projector, model, finest)
        columns_um, regression = moved[0].baseline.columns_um, moved[1].regression
        free = np.concatenate([columns_um > 0, np.ones(regression.size - len(columns_um), dtype=bool)])
        if free.all():
            break
        last = bench, projector, model
        bench, projector = moved
        rows = tuple(np.where(free, one, 0.0) for one in regression.rows)
        held = Projector(replace(regression, rows=rows), projector.noise, projector.roughness)
        before, model = np.concatenate(model.x), refit(bench, held, model.laws, model.x, 4)
        if not model.cost < _ASTRAY * last[-1].cost:
            return last
        sd = np.sqrt(np.diagonal(model.covariance()))
        if np.all(np.abs(np.concatenate(model.x) - before) <= _MOVED_SD * sd):
            break
    return bench, projector, model


def relearn_noise(
    first: Projector,
    projector: Projector,
    model: Refit,
    ask: Callable[[Projector], Sequence[Probe]],
    thresholds: Thresholds,
) -> Projector | None:
    """The projector without causes, with noise and smoothness as they are beside them, where either was misjudged.

    Noise is that of the sensor, and what neither the causes explain nor any effect that is asked for beside that.
    """
    sensor = find_faults(projector.regression, model.change_um, thresholds).noise
    beside = projector.beside(sensor)
    candidates = [column for probe in ask(beside) for column in probe.signatures]
    found = with_discrepancy(beside, candidates, model.change_um)
    less = [new.total_um < _LESS * old.total_um for new, old in zip(found, projector.noise, strict=True)]
    noise = found if any(less) else projector.noise
    beside = smoothed(projector.beside(noise), model.change_um)
    is_smoother = _prior_precision(beside) > _SMOOTHER * _prior_precision(first)
    if not is_smoother:
        return first.beside(noise) if any(less) else None
    smooth = beside.regression
    baseline = replace(first.regression.baseline, prior=smooth.baseline.prior)
    regression = replace(first.regression, baseline=baseline, root=smooth.root)
    return Projector(regression, noise, first.roughness, first.held)


def is_smoothness_confirmed(projector: Projector, model: Refit) -> bool:
    """Whether beside the causes that a smoother density led to, the density is as smooth."""
    return bool(_SMOOTHER * _prior_precision(smoothed(projector, model.change_um)) > _prior_precision(projector))


def _follow(projector: Projector, model: Refit, finest: bool = False) -> tuple[Bench, Projector]:
    """Move the baseline to where the causes leave it."""
    moved = projector.move(projector.residual - projector.join(model.change_um))
    return _linearised_at(moved, projector, model, finest)


def _linearised_at(
    baseline: Baseline, projector: Projector, model: Refit, finest: bool = False
) -> tuple[Bench, Projector]:
    effects = [model.effects(run) for run in range(len(baseline.runs))]
    # What is finer than the grid hardly changes, but where derivatives go through effects.
    plain = not any(projector.regression.saturating) and not any(map(saturating, effects))
    regression = regress(baseline, projector.regression.finer if plain else None, effects)
    there = Projector(regression, projector.noise, projector.roughness).bounded(model.change_um)
    return Bench(regression.baseline, model.change_um, finest=finest), there


def _made_sensitive(projector: Projector, model: Refit) -> Baseline | None:
    """The baseline with coordinates that no longer matter, as of a driver without delay, moved until they do.

    An effect that is not simulated may drive them there, and no derivative leads back.
    """
    regression = projector.regression
    baseline, columns = regression.baseline, regression.baseline.chain.size
    shown = np.linalg.norm(projector.join([rows[:, columns:] for rows in regression.rows]), axis=0)
    if not model.laws or np.all(shown > _INSENSITIVE):
        return None
    back = np.where(shown > _INSENSITIVE, 0.0, -baseline.z)
    plain = [run.displacement_um - left for run, left in zip(baseline.runs, regression.residuals, strict=True)]
    for k in range(1, _HALVES):
        there = baseline.moved(back * (1 - 0.5**k), 0.0)
        off = [simulate(there.stage, run) - one for run, one in zip(baseline.fine, plain, strict=True)]
        if float(np.linalg.norm(projector.join(off))) > _SEEN_CHANGE:
            return there
    return None


def _prior_precision(projector: Projector) -> float:
    """Of the density alone: the reversible slope, in other units, would outweigh it."""
    baseline = projector.regression.baseline
    weights = baseline.chain.size - baseline.chain.levels
    return float(np.trace(baseline.prior[:weights, :weights]))
