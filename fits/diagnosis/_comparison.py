"""Which of the effects that explain most explains the records best, each fitted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.diagnosis._candidates import Bench
from fits.diagnosis._joint_fit import settled
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, refit, refit_beside, relocate
from fits.diagnosis._score import Scored, rescore

# Effects that are fitted to choose among: the best by their scores, of each at most so many forms.
_LEADERS, _FORMS = 5, 2
# Scores below this share of the best are not worth a fit, or below that of an effect that the best is mistaken for.
WORTH, _CONFUSED = 0.4, 0.2
# Differences of the criterion, and standard deviations after projecting one effect off another, within which two
# effects are not told apart.
SAME, _APART = 10.0, 4.0
# Effects that the baseline follows to tell them apart, and part of what the best explains by which one that it is
# mistaken for may be behind before: the plain stage has already given way to the one and not to the other.
_NEAREST, _BEHIND = 4, 0.1
# Part of a cause's signature by which its model may be off.
INEXACT = 0.06
# An effect that makes the square of the errors in what was held out so many times larger is none, and one with
# little evidence against the rest of the misfit is one if it makes it so much smaller.
_WORSE, _BETTER, _SHOWN = 1.2, 0.85, 1.0
# Evidence that a cause must have against what else is left, in standard deviations; and what is beyond doubt: so
# many of them, and so much of what there is to be explained. A second cause may show in what was held out most.
_SURE, _PLAIN, _MOST = 3.0, 30.0, 0.5


@dataclass(frozen=True)
class Rival:
    """An effect fitted in place of a cause; its cost is that once the baseline has followed, where that was tried."""

    name: str
    refit: Refit
    criterion: float
    apart: float
    cost: float


def best_of(scores: Sequence[Scored]) -> dict[str, Scored]:
    """The highest score of each effect, the highest first."""
    found: dict[str, Scored] = {}
    for one in sorted(scores, key=lambda s: -s.z):
        found.setdefault(one.name, one)
    return found


def compare_rivals(
    bench: Bench, projector: Projector, model: Refit, scores: Sequence[Scored], explained: float, laws: int
) -> list[Rival]:
    """Fit the leaders beside what is there and explains so much, the best first; none as more than `laws`."""
    best = best_of(scores)
    top = max(one.z for one in scores)
    first = next(iter(best.values())).form
    names = [name for name, one in best.items() if one.z > (_CONFUSED if name in first.confusions else WORTH) * top][
        :_LEADERS
    ]
    fitted: dict[str, Refit] = {}
    bare = Projector(projector.regression, projector.noise)
    before = bare.ahead(model.change_um)
    for name in names:
        own = sorted((one for one in scores if one.name == name), key=lambda s: -s.z)
        tried: dict[type, int] = {}
        for one in own:
            form = one.form
            if tried.get(form, 0) >= (1 if form.strength else _FORMS) or one.z < WORTH * own[0].z:
                continue
            tried[form] = tried.get(form, 0) + 1
            found = relocate(bench, projector, refit_beside(bench, projector, model, one), len(model.laws))
            if not all(np.all(np.isfinite(change)) for change in found.change_um):
                continue
            # What does not stand out of the rest of the misfit must show in what was kept aside.
            plain = one.sure > (_SURE if one.z > 2 * INEXACT * explained else 2 * _SURE)
            most = _WORSE if plain else _BETTER
            if one.sure > _PLAIN and model.cost - found.cost > _MOST * (model.cost - projector.count):
                most = np.inf
            alone = found.is_noise(projector) and not model.is_noise(projector)
            if not found.determined(alone=alone):
                # Of what is only there, what was kept aside must show something, too.
                most = _SHOWN
            ahead = bare.ahead(found.change_um)
            if ahead > most * before or not found.determined(False, alone) or not _whole(bench, found):
                continue
            found = _counted(bench, projector, found, own, len(model.laws) + laws)
            if name not in fitted or found.criterion(projector.count) < fitted[name].criterion(projector.count):
                fitted[name] = found
    return _ranked(
        bench,
        projector,
        [Rival(name, one, one.criterion(projector.count), 0.0, one.cost) for name, one in fitted.items()],
        model.cost,
    )


def _counted(bench: Bench, projector: Projector, found: Refit, own: Sequence[Scored], most: int) -> Refit:
    """Add what happens one at a time, as a loss of samples, for as long as that pays: several look like a drift."""
    first = len(found.laws) - 1
    while found.laws[-1].form.counted and len(found.laws) < most:
        more = _one_more(bench, projector, found, own)
        if not (more.determined() and _whole(bench, more)):
            break
        if more.criterion(projector.count) > found.criterion(projector.count) - SAME:
            break
        for _ in range(first, len(more.laws)):
            # Alone it stood for all of them: each in turn is put where the others leave most.
            laws, x = ([*one[:first], *one[first + 1 :]] for one in (more.laws, more.x))
            moved = _one_more(bench, projector, refit(bench, projector, laws, x, 4), own)
            more = min(more, moved, key=lambda one: one.cost)
        found = relocate(bench, projector, more, first)
    return found


def _one_more(bench: Bench, projector: Projector, model: Refit, own: Sequence[Scored]) -> Refit:
    left = rescore(own, model.basis(), model.residual)
    more = refit_beside(bench, projector, model, max(left, key=lambda one: one.z))
    return relocate(bench, projector, more, len(model.laws))


def _ranked(bench: Bench, projector: Projector, fitted: list[Rival], before: float) -> list[Rival]:
    """Put effects in order: those about as good by what they leave once the baseline has followed each."""
    order = sorted(fitted, key=lambda one: one.criterion)
    if not order:
        return order
    drop, first = before - order[0].cost, order[0].refit.laws[-1].form

    def reach(one: Rival) -> float:
        form = one.refit.laws[-1].form
        alike = form.name in first.confusions or first.name in form.confusions
        return max(tolerance(drop) ** 2, _BEHIND * drop if alike else 0.0)

    near = [one for one in order if one.cost - order[0].cost < reach(one)][:_NEAREST]
    if len(near) < 2:
        return order
    for one in near:
        end = settled(bench, projector, one.refit)[-1]
        if not end.possible(bench):
            order.remove(one)
            continue
        order[order.index(one)] = replace(one, cost=end.cost, criterion=end.criterion(projector.count))
    return sorted(order, key=lambda one: one.criterion)


def tolerance(drop: float) -> float:
    """Standard deviations within which an effect is another that takes so much off the sum of squares."""
    return max(_APART, 2 * INEXACT * max(drop, 0.0) ** 0.5)


def _whole(bench: Bench, model: Refit) -> bool:
    """Whether what is counted in sampling intervals is nearer to one than to none in some run, for the last law."""
    law, x = model.laws[-1], model.x[-1]
    found = not law.form.counted
    for run, one in enumerate(bench.prepared):
        interval_s = float(np.median(np.diff(one.run.record.time_s)))
        effect = law.effect(x, run)
        found = found or any(abs(float(getattr(effect, name))) > interval_s / 2 for name in law.form.counted)
    return found
