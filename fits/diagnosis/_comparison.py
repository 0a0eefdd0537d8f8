"""Which of the effects that explain most explains the records best, each fitted, and what is not told from it."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.diagnosis._effects import Bench
from fits.diagnosis._joint_fit import State, fit_jointly
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, refit, refit_beside, relocate
from fits.diagnosis._score import Probe, Scored, best_of, rescore, score
from microid import EFFECTS, AbstractEffect

# So many effects, the best by their scores, are fitted to choose among them.
_LEADERS = 5
# An effect without a strength is fitted in so many of its forms at most.
_FORMS = 2
# Scores below this share of the best are not worth a fit.
WORTH = 0.4
# The same for an effect that the best is mistaken for.
_OF_CONFUSED = 0.2
# Difference of the information criterion below which two effects are not told apart.
SAME = 10.0
# The same in standard deviations, after projecting one effect off another.
_APART = 4.0
# The baseline is fitted again beside so many of the best effects at most.
_NEAREST = 4
# Part of the explained sum of squares by which an effect that the best is mistaken for may be behind before that: the
# plain stage has already given way to the one and not to the other.
_BEHIND_SHARE = 0.1
# Part of a cause's signature by which its model may be off.
MODEL_ERROR = 0.06
# The same along its confusions.
_CONFUSED_ERROR = 0.6
# The same along a column of the records: what is slow in both agrees by chance.
_COLUMN_ERROR = 0.15
# An effect with clear evidence may raise the squared error of what was held out by this factor at most.
_WORSE = 1.2
# An effect with little evidence against the rest of the misfit must lower it to this share.
_BETTER = 0.85
# An effect whose strength is not determined must not raise it.
_NOT_WORSE = 1.0
# Evidence against the rest of the misfit, in standard deviations, that is clear.
_SURE_Z = 3.0
# A cause with so much evidence, that explains so much of what there is to be explained, needs none from what was held
# out: a second cause may show most there.
_PLAIN_Z, _PLAIN_SHARE = 30.0, 0.5
# Standard deviations beyond which effects are told apart if one of them leaves no more than noise.
_CLEAR = 5.0
# Effects whose score is above this share of the best may be the cause instead.
_NEAR_BEST = 0.95
# They are looked into where yet another effect shows beside the best by more than this share of what that explains.
_LEFT_SHARE = 0.15


@dataclass(frozen=True)
class Rival:
    """An effect fitted in place of a cause; its cost is that once the baseline has followed, where that was tried."""

    name: str
    refit: Refit
    criterion: float
    apart: float
    cost: float

    @property
    def form(self) -> type[AbstractEffect]:
        """Which model of it."""
        return self.refit.laws[-1].form


def compare_rivals(
    bench: Bench, projector: Projector, model: Refit, scores: Sequence[Scored], explained: float, laws: int
) -> list[Rival]:
    """Fit the leaders beside what is there and explains so much, the best first; none as more than `laws`."""
    best = best_of(scores)
    top = max(one.z for one in scores)
    first = next(iter(best.values())).form
    worth = {name: (_OF_CONFUSED if name in first.confusions else WORTH) * top for name in best}
    names = [name for name, one in best.items() if one.z > worth[name]][:_LEADERS]
    fitted: dict[str, Refit] = {}
    bare = projector.bare
    before = bare.held_out_error(model.change_um)
    for name in names:
        scored = sorted((one for one in scores if one.name == name), key=lambda s: -s.z)
        tried: dict[type, int] = {}
        for one in scored:
            form = one.form
            if tried.get(form, 0) >= (1 if form.strength else _FORMS) or one.z < WORTH * scored[0].z:
                continue
            tried[form] = tried.get(form, 0) + 1
            found = relocate(bench, projector, refit_beside(bench, projector, model, one), len(model.laws))
            if not all(np.all(np.isfinite(change)) for change in found.change_um):
                continue
            # What does not stand out of the rest of the misfit must show in what was kept aside.
            plain = one.robust_z > (_SURE_Z if one.z > 2 * MODEL_ERROR * explained else 2 * _SURE_Z)
            most = _WORSE if plain else _BETTER
            if one.robust_z > _PLAIN_Z and model.cost - found.cost > _PLAIN_SHARE * (model.cost - projector.count):
                most = np.inf
            alone = found.is_noise(projector) and not model.is_noise(projector)
            if not found.determined(alone=alone):
                # Of what is only there, what was kept aside must show something, too.
                most = _NOT_WORSE
            if (
                bare.held_out_error(found.change_um) > most * before
                or not found.determined(False, alone)
                or not _has_occurred(bench, found)
            ):
                continue
            found = _add_occurrences(bench, projector, found, scored, len(model.laws) + laws)
            if name not in fitted or found.criterion(projector.count) < fitted[name].criterion(projector.count):
                fitted[name] = found
    rivals = [Rival(name, one, one.criterion(projector.count), 0.0, one.cost) for name, one in fitted.items()]
    return _ranked(bench, projector, rivals, model.cost)


def _add_occurrences(bench: Bench, projector: Projector, found: Refit, scored: Sequence[Scored], most: int) -> Refit:
    """Add occurrences of what is counted, as a loss of samples, while that pays: several look like a drift."""
    first = len(found.laws) - 1
    while found.laws[-1].form.counted and len(found.laws) < most:
        more = _one_more(bench, projector, found, scored)
        if not (more.determined() and _has_occurred(bench, more)):
            break
        if more.criterion(projector.count) > found.criterion(projector.count) - SAME:
            break
        for _ in range(first, len(more.laws)):
            # Alone it stood for all of them: each in turn is put where the others leave most.
            laws, x = ([*one[:first], *one[first + 1 :]] for one in (more.laws, more.x))
            moved = _one_more(bench, projector, refit(bench, projector, laws, x, 4), scored)
            more = min(more, moved, key=lambda one: one.cost)
        found = relocate(bench, projector, more, first)
    return found


def _one_more(bench: Bench, projector: Projector, model: Refit, scored: Sequence[Scored]) -> Refit:
    left = rescore(scored, model.basis(), model.residual)
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
        return max(tolerance(drop) ** 2, _BEHIND_SHARE * drop if alike else 0.0)

    near = [one for one in order if one.cost - order[0].cost < reach(one)][:_NEAREST]
    if len(near) < 2:
        return order
    for one in near:
        end = fit_jointly(bench, projector, one.refit)[-1]
        if not end.possible(bench):
            order.remove(one)
            continue
        order[order.index(one)] = replace(one, cost=end.cost, criterion=end.criterion(projector.count))
    return sorted(order, key=lambda one: one.criterion)


def _has_occurred(bench: Bench, model: Refit) -> bool:
    """Whether what is counted in sampling intervals is nearer to one than to none in some run, for the last law."""
    law, x = model.laws[-1], model.x[-1]
    found = not law.form.counted
    for run, one in enumerate(bench.prepared):
        interval_s = float(np.median(np.diff(one.run.record.time_s)))
        effect = law.effect(x, run)
        found = found or any(abs(float(getattr(effect, name))) > interval_s / 2 for name in law.form.counted)
    return found


def choose_cause(
    bench: Bench,
    projector: Projector,
    probes: Sequence[Probe],
    model: Refit,
    fitted: Sequence[Rival],
    scores: Mapping[str, Scored],
    closed: Collection[str],
) -> tuple[Rival, State]:
    """Choose the cause: the best, or among those about as good the one beside which another explains most.

    Where two causes act, one that is neither may follow part of each and come first. None comes twice of those that
    are `closed`.
    """
    best, chosen = fitted[0], fit_jointly(bench, projector, fitted[0].refit)
    highest = max(scores[one.name].z for one in fitted)
    near = [one for one in fitted if scores[one.name].z > _NEAR_BEST * highest]

    def further(one: Rival, at: State) -> tuple[float, float]:
        there, beside, own = at
        basis = own.basis()
        left = rescore(score(beside, probes, own.residual), basis, own.residual)
        others = [other for other in left if other.name != one.name and other.name not in closed]
        if not others:
            return 0.0, own.cost
        next_ = max(others, key=lambda other: other.z)
        _, _, pair = fit_jointly(there, beside, refit_beside(there, beside, own, next_))
        return next_.z, min(own.cost, pair.cost)

    if len(near) < 2 or best not in near:
        return best, chosen
    left, cost = further(best, chosen)
    if left < _LEFT_SHARE * max(model.cost - chosen[-1].cost, 0.0) ** 0.5:
        return best, chosen
    for one in near:
        if one is best:
            continue
        trial = fit_jointly(bench, projector, one.refit)
        _, pair = further(one, trial)
        if pair < cost - SAME:
            best, chosen, cost = one, trial, pair
    return best, chosen


def indistinguishable(first: Rival, fitted: Sequence[Rival], drop: float, exact: bool) -> tuple[Rival, ...]:
    """Effects that explain the same about as well as the cause, which takes so much off the sum of squares."""
    found = []
    # A model that leaves no more than noise is off by little.
    most = min(tolerance(drop), _CLEAR) if exact else tolerance(drop)
    for other in fitted:
        # What the cause explains beyond the other: no more than models of effects are off by.
        apart = max(other.cost - first.cost, 0.0) ** 0.5
        if other is not first and (other.criterion - first.criterion < SAME or apart < most):
            found.append(replace(other, apart=apart))
    return tuple(found)


def tolerance(drop: float) -> float:
    """Standard deviations within which an effect is another that takes so much off the sum of squares."""
    return max(_APART, 2 * MODEL_ERROR * max(drop, 0.0) ** 0.5)


def model_error(one: Scored, causes: Collection[str]) -> float:
    """Part of what some causes explain that an effect beside them must exceed, by what it is mistaken for."""
    if any(f.name in causes and (one.name in f.confusions or f.name in one.form.confusions) for f in EFFECTS):
        return _CONFUSED_ERROR
    return _COLUMN_ERROR if one.form.needs else MODEL_ERROR
