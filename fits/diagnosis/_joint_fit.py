"""Causes and the baseline fitted to each other: where both belong, beside what noise and roughness there is."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from fits.diagnosis._baseline import Baseline
from fits.diagnosis._candidates import Bench
from fits.diagnosis._evaluate import simulate
from fits.diagnosis._faults import find_faults
from fits.diagnosis._law import Law
from fits.diagnosis._projector import Projector, learn_roughness
from fits.diagnosis._refit import Refit, refit, relocate
from fits.diagnosis._regression import regress
from fits.diagnosis._smoothness import smoothed
from fits.diagnosis._tangent import passed

# Simulations that differ by more than this, in all samples together, in noise, are not the same.
_OFF = 1.0
# Multiple of a strength that is tried, and the gain in chi-square for which it is taken.
_LARGER, _BETTER = 1.5, 10.0
# Part of its bound from which what ended there is tried again, and rounds in which the baseline follows that first.
_WEAKER, _FIRST = 0.8, 2
# Further rounds in which baseline and causes follow each other, at most.
_AGAIN = 8
# Rounds beside a density whose zeros stay, and standard deviations below which a coordinate has not moved.
_BOUNDED, _MOVED = 4, 0.1
# Derivative of all samples along a coordinate, in noise, that does not show, and what a change must change in them to
# be seen; the distance to its scale is halved at most so often for that.
_ASLEEP, _AWAKE, _HALVES = 1.0, 5.0, 16
# A sum of squares that grows by this factor there is that of a fit gone astray.
_ASTRAY = 1.5
# Noise or roughness that falls by less than this factor is the same.
_LESS = 0.8
# Factor of the prior's precision from which on what a cause does was taken for roughness of the density.
_SMOOTHER = 1000.0

Settled: TypeAlias = tuple[Bench, Projector, Refit]


def settled(bench: Bench, projector: Projector, model: Refit) -> Settled:
    """Let baseline and causes follow each other, unless that makes it worse by more than what is next to nothing.

    Where the baseline has to move far, what its tangent says of an effect that it nearly follows is better than true.
    """
    moved = settle(bench, projector, relocate(bench, projector, model))
    awake = _awoken(projector, moved[-1])
    if awake is not None:
        there = _at(awake, projector, moved[-1])
        trial = settle(*there, refit(*there, moved[-1].laws, moved[-1].x, 4))
        moved = trial if trial[-1].cost < moved[-1].cost else moved
    if moved[-1].cost > model.cost + _BETTER:
        # A baseline that moved without the roughness beyond its grid may have moved away.
        here = refit(bench, projector, model.laws, model.x, 4)
        moved = moved if moved[-1].cost < here.cost else (bench, projector, here)
    return moved


def settle(
    bench: Bench, projector: Projector, model: Refit, rounds: Sequence[int] = (4, 2)
) -> tuple[Bench, Projector, Refit]:
    """Let the baseline follow what effects leave, and fit those again beside it.

    A baseline fitted without them may be far from where it belongs, farther than its tangent reaches: it goes on
    following for as long as that pays.
    """
    for count in rounds:
        bench, projector = _follow(bench, projector, model)
        model = refit(bench, projector, model.laws, model.x, count)
    for _ in range(_AGAIN if model.laws else 0):
        there, beside = _follow(bench, projector, model)
        moved = refit(there, beside, model.laws, model.x, rounds[-1])
        if moved.cost > model.cost - _BETTER:
            break
        bench, projector, model = there, beside, moved
    return bench, projector, model


def stronger(bench: Bench, projector: Projector, model: Refit) -> Settled:
    """Try effects that level off at larger strengths, from where a baseline that has taken part of one lets it go."""
    for k in range(len(model.laws)):
        while (form := model.laws[k].form).finite and form.strength:
            here = [model.laws[k].effect(model.x[k], run) for run in range(len(bench.prepared))]
            more = [replace(one, **{name: _LARGER * getattr(one, name) for name in form.strength}) for one in here]
            law = Law(more, model.laws[k].remembers)
            laws, x = list(model.laws), list(model.x)
            laws[k], x[k] = law, law.start
            trial = settle(bench, projector, refit(bench, projector, laws, x, 0))
            if trial[-1].cost > model.cost - _BETTER:
                break
            bench, projector, model = trial
    return bench, projector, model


def released(bench: Bench, projector: Projector, model: Refit, finest: bool) -> Settled:
    """Try weaker what is as strong as can be, the baseline following before it is fitted, unless that is worse.

    Along a valley that a driver and its capacitance share, a fit may run into the bound, where it has no derivative.
    """
    for k, law in enumerate(model.laws):
        if not (law.form.strength and law.pinned(model.x[k])):
            continue
        effects = [law.effect(model.x[k], run) for run in range(len(law.maps))]
        less = [replace(one, **{name: _WEAKER * getattr(one, name) for name in law.form.strength}) for one in effects]
        laws, x = list(model.laws), list(model.x)
        laws[k] = Law(less, law.remembers)
        x[k] = laws[k].start
        trial = bench, projector, refit(bench, projector, laws, x, 0)
        for _ in range(_FIRST):
            there = _follow(*trial, finest)
            trial = *there, refit(*there, laws, x, 0)
        trial = *there, refit(*there, laws, x, 4)
        if trial[-1].cost < model.cost:
            bench, projector, model = trial
    return bench, projector, model


def bounded(bench: Bench, projector: Projector, model: Refit, finest: bool) -> Settled:
    """Fit the causes again beside a density that is nowhere negative.

    A tangent takes for free what cannot become less than nothing, and there a cause may hide: a play in relays
    without width, a rail in those beyond it.
    """
    for _ in range(_BOUNDED if model.laws else 0):
        moved = _follow(bench, projector, model, finest)
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
        if np.all(np.abs(np.concatenate(model.x) - before) <= _MOVED * sd):
            break
    return bench, projector, model


def _follow(bench: Bench, projector: Projector, model: Refit, finest: bool = False) -> tuple[Bench, Projector]:
    """Move the baseline to where the causes leave it."""
    # What roughness beyond the grid would explain is not put into the grid.
    bare = Projector(projector.regression, projector.noise)
    return _at(bare.move(bare.residual - bare.join(model.change_um)), projector, model, finest)


def _at(baseline: Baseline, projector: Projector, model: Refit, finest: bool = False) -> tuple[Bench, Projector]:
    effects = [model.effects(run) for run in range(len(baseline.runs))]
    # What is finer than the grid hardly changes, but where derivatives go through effects.
    plain = not any(projector.regression.through) and not any(map(passed, effects))
    regression = regress(baseline, projector.regression.finer if plain else None, effects)
    return Bench(regression.baseline, finest=finest), Projector(regression, projector.noise, projector.roughness)


def _awoken(projector: Projector, model: Refit) -> Baseline | None:
    """The baseline with coordinates that no longer show, as of a driver without delay, brought back until they do.

    An effect that is not simulated may drive them there, and no tangent leads back.
    """
    regression = projector.regression
    baseline, columns = regression.baseline, regression.baseline.chain.size
    shown = np.linalg.norm(projector.join([rows[:, columns:] for rows in regression.rows]), axis=0)
    if not model.laws or np.all(shown > _ASLEEP):
        return None
    back = np.where(shown > _ASLEEP, 0.0, -baseline.z)
    plain = [run.displacement_um - left for run, left in zip(baseline.runs, regression.residuals, strict=True)]
    for k in range(1, _HALVES):
        there = baseline.moved(back * (1 - 0.5**k), 0.0)
        off = [simulate(there.stage, run) - one for run, one in zip(baseline.fine, plain, strict=True)]
        if float(np.linalg.norm(projector.join(off))) > _AWAKE:
            return there
    return None


def smoother(bench: Bench, projector: Projector, model: Refit) -> Settled:
    """Fit the causes again where beside them the density is smoother than was thought without them."""
    if not model.laws or not any(projector.roughness):
        return bench, projector, model
    bare = Projector(projector.regression, projector.noise)
    rough = learn_roughness(bare, (), model.change_um)
    if not any(new < _LESS * old for new, old in zip(rough, projector.roughness, strict=True)):
        return bench, projector, model
    less = tuple(map(min, rough, projector.roughness))
    return settled(bench, Projector(projector.regression, projector.noise, less), model)


def resmoothed(bench: Bench, projector: Projector, model: Refit) -> Settled:
    """Fit the causes again beside a density as smooth as it is beside them, unless that predicts worse."""
    if not model.laws:
        return bench, projector, model
    afresh = smoothed(projector, model.change_um)
    if not _stiffness(afresh) > _SMOOTHER * _stiffness(projector):
        # What the causes leave is no roughness.
        return bench, projector, model
    moved = settled(Bench(afresh.regression.baseline), afresh, model)
    before, after = (
        Projector(there.regression, there.noise).ahead(one.change_um)
        for there, one in ((projector, model), moved[1:])
    )
    return (bench, projector, model) if after > before else moved


def finely(bench: Bench, projector: Projector, model: Refit) -> tuple[Refit, bool]:
    """Fit the causes again with many steps between samples, where few are off by more than chance."""
    if not model.laws:
        return model, False
    finer = Bench(bench.baseline, finest=True)
    better = refit(finer, projector, model.laws, model.x, 0)
    off = [a - b for a, b in zip(better.change_um, model.change_um, strict=True)]
    if float(np.linalg.norm(projector.join(off))) < _OFF:
        return model, False
    return refit(finer, projector, model.laws, model.x, 4), True


def renewed(first: Projector, projector: Projector, model: Refit) -> Projector | None:
    """The projector without causes, with noise and smoothness as they are beside them, where either was misjudged."""
    found = find_faults(projector.regression, model.change_um).noise
    less = [new.total_um < _LESS * old.total_um for new, old in zip(found, projector.noise, strict=True)]
    noise = tuple(found) if any(less) else projector.noise
    beside = smoothed(Projector(projector.regression, noise, projector.roughness), model.change_um)
    is_smoother = _stiffness(beside) > _SMOOTHER * _stiffness(first)
    if not is_smoother:
        return Projector(first.regression, noise, first.roughness) if any(less) else None
    smooth = beside.regression
    baseline = replace(first.regression.baseline, prior=smooth.baseline.prior)
    return Projector(replace(first.regression, baseline=baseline, root=smooth.root), noise, first.roughness)


def confirmed(projector: Projector, model: Refit) -> bool:
    """Whether beside the causes that a smoother density led to, the density is as smooth."""
    return bool(_SMOOTHER * _stiffness(smoothed(projector, model.change_um)) > _stiffness(projector))


def _stiffness(projector: Projector) -> float:
    """Of the density alone: the reversible slope, in other units, would drown it."""
    baseline = projector.regression.baseline
    weights = baseline.chain.size - baseline.chain.levels
    return float(np.trace(baseline.prior[:weights, :weights]))
