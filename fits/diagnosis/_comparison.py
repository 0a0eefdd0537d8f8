"""Which of the effects that explain most explains the records best, each fitted, and what is not told from it."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from fits.diagnosis._effects import Bench
from fits.diagnosis._joint_fit import State, fit_from_poles, fit_jointly
from fits.diagnosis._occurrences import add_occurrences, has_occurred, is_abrupt
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, refit_beside
from fits.diagnosis._relocate import relocate
from fits.diagnosis._score import Probe, Scored, best_of, score
from fits.diagnosis._thresholds import THRESHOLDS, Thresholds
from fits.io._threads import map_in_threads
from fits.stats._compare import improvement_z
from microid.effects import EFFECTS, AbstractEffect

# So many effects, the best by their scores, are fitted to choose among them, in so many forms each where they have no
# strength; the baseline is fitted again beside so many of the best.
_LEADERS, _FORMS, _NEAREST = 5, 2, 5
# So many are fitted at a time.
_TOGETHER = 2
# Scores below this share of the best are not worth a fit. The instant of an effect is not searched for, and the
# baseline not fitted again beside it, where it leaves more than the best by these shares of what that explains.
_WORTH, _PROMISING, _NEAR = 0.4, 0.5, 0.1


@dataclass(frozen=True)
class Rival:
    """An effect fitted in place of a cause; `end` is where baseline and effect have followed each other, if tried.

    What was held out counts in `criterion` and `cost`, and `held_out` are the errors in it, in noise, shape `(n,)`.
    """

    name: str
    refit: Refit
    criterion: float
    cost: float
    held_out: np.ndarray
    end: State | None = None

    @classmethod
    def of(cls, projector: Projector, found: Refit) -> "Rival":
        """The last effect that was fitted."""
        errors = projector.held_out(found.change_um)
        unseen = projector.surprise(errors)
        return cls(
            found.laws[-1].form.name, found, found.criterion(projector.count) + unseen, found.cost + unseen, errors
        )

    @property
    def fitted_cost(self) -> float:
        """Sum of squares that it leaves of what was fitted."""
        return (self.refit if self.end is None else self.end[-1]).cost

    @property
    def form(self) -> type[AbstractEffect]:
        """Which model of it."""
        return self.refit.laws[-1].form


def compare_rivals(
    bench: Bench,
    projector: Projector,
    model: Refit,
    scores: Sequence[Scored],
    laws: int,
    thresholds: Thresholds = THRESHOLDS,
    has_time: Callable[[], bool] = lambda: True,
) -> list[Rival]:
    """Fit the leaders beside what is there, while there is time, the best first; none as more than so many `laws`.

    The baseline is fitted again beside the best and those about as good: the plain stage may have given way to one
    and not to another. What does not stand out of the rest of the misfit is left out unless it predicts held-out data
    better.
    """
    before, first = projector.held_out(model.change_um), len(model.laws)
    fits, least = list[tuple[Scored, Refit]](), np.inf
    first_ones = leaders(scores, bench.baseline.dynamic)
    for some in (first_ones[k : k + _TOGETHER] for k in range(0, len(first_ones), _TOGETHER)):
        if not fits or has_time():
            # What ends far behind the best so far need not be known exactly.
            enough = least + _NEAR * max(model.cost - least, 0.0)
            settings = [(bench, projector, model, one, enough) for one in some]
            fits += zip(some, map_in_threads(refit_beside, *zip(*settings, strict=True)), strict=True)
            least = min(refit.cost for _, refit in fits)
    chance_z = thresholds.chance_z
    noise = [found for _, found in fits if found.is_noise(projector, chance_z)]
    # What ended at its bound is taken only where nothing else explains as much.
    alone = not model.is_noise(projector, chance_z) and all(found.laws[-1].at_bound(found.x[-1]) for found in noise)
    fitted: dict[type[AbstractEffect], Refit] = {}
    for one, found in fits if has_time() else ():
        if found.cost - least < _PROMISING * (model.cost - least):
            found = relocate(bench, projector, found, first)
        # From the poles of a plain stage a lag may shrink to none.
        begins_elsewhere = bench.baseline.dynamic and bool(one.form.lag)
        possible = _is_possible(projector, found, alone, thresholds) and has_occurred(bench, found)
        possible = possible and is_abrupt(bench, projector, found, thresholds)
        if not (possible or begins_elsewhere):
            continue
        stands_out = one.robust_z > thresholds.chance_z or not len(before) or begins_elsewhere
        if not (stands_out or improvement_z(before, projector.held_out(found.change_um)) >= thresholds.worse_z):
            continue
        most = first + laws if has_time() else 0
        enough = least + _NEAR * max(model.cost - least, 0.0)
        found = add_occurrences(bench, projector, model, found, scores, most, enough, thresholds)
        if one.form not in fitted or found.criterion(projector.count) < fitted[one.form].criterion(projector.count):
            fitted[one.form] = found
    rivals = [Rival.of(projector, one) for one in fitted.values()]
    without = model.cost + projector.surprise(before)
    return _ranked(bench, projector, rivals, without, [one.probe for one in scores], thresholds, has_time)


def criterion(projector: Projector, model: Refit) -> float:
    """Information criterion of what was fitted, and how improbable that makes what was held out: small is good."""
    return model.criterion(projector.count) + projector.surprise(projector.held_out(model.change_um))


def leaders(scores: Sequence[Scored], dynamic: bool) -> list[Scored]:
    """The best of those that explain most: of each effect the best of each form, or several without a strength.

    A lag beside a `dynamic` stage is always among them: its fit begins elsewhere, and the score there is not known.
    """
    best = best_of(scores)
    top = max(one.z for one in scores)
    names = [name for name, one in best.items() if one.z > _WORTH * top][:_LEADERS]
    names += [name for name, one in best.items() if dynamic and one.form.lag and name not in names]
    found = []
    for name in names:
        tried: dict[type, int] = {}
        for one in sorted((one for one in scores if one.name == name), key=lambda s: -s.z):
            most = 1 if one.form.strength else _FORMS
            if tried.get(one.form, 0) < most and one.z >= _WORTH * best[name].z:
                tried[one.form] = tried.get(one.form, 0) + 1
                found.append(one)
    return found


def _is_possible(projector: Projector, found: Refit, alone: bool, thresholds: Thresholds) -> bool:
    """Whether the records determine a strength; at a bound an effect counts only where it `alone` leaves noise."""
    if not all(np.all(np.isfinite(change)) for change in found.change_um):
        return False
    alone = alone and found.is_noise(projector, thresholds.chance_z)
    return found.determined(thresholds.chance_z, False, alone)


def _ranked(
    bench: Bench,
    projector: Projector,
    fitted: list[Rival],
    cost: float,
    asked: Sequence[Probe],
    thresholds: Thresholds,
    has_time: Callable[[], bool] = lambda: True,
) -> list[Rival]:
    """Put effects in order, the best and those about as good by what they leave once the baseline has followed.

    Without them there is a `cost`. About as good are also those that are behind the best by no more than twice what
    it gains or loses by that, as they may gain more, until one ends behind it; and those that leave as little with
    the best further effect of those `asked`. Where the time is over the best alone is fitted.
    """
    order = sorted(fitted, key=lambda one: one.criterion)
    out = list[Rival]()
    usual = max(thresholds.apart_z**2, _NEAR * (cost - order[0].cost)) if order else 0.0
    near = least = np.inf
    quiet = bool(order) and order[0].refit.is_noise(projector, thresholds.chance_z)

    @cache
    def left_ahead(place: int) -> float:
        one = order[place]
        left = score(projector, asked, one.refit.residual, one.refit.basis()).each
        return one.cost - gain_ahead(left, {one.name}, cost - one.cost, thresholds)

    def is_far(place: int) -> bool:
        far = order[place].cost - order[0].cost > near
        if far and place < _NEAREST and not quiet:
            far = left_ahead(place) - left_ahead(0) > near
        return far

    def is_shown(one: Rival) -> bool:
        return not one.form.lag or one.refit.determined(thresholds.chance_z, False, quiet)

    def ends_of(place: int, far: bool) -> tuple[list[State], list[State]]:
        """Fits from poles, and the joint one, of which there is none where it is far behind."""
        one = order[place]
        # The start of a lag is its own, however far it is from here. A lost resonance is looked for beside the best,
        # even where what it rings with passed for noise.
        on_time, shown = place == 0 or has_time(), is_shown(one)
        starts = on_time and (not quiet if one.form.lag else place == 0)
        joint = shown and on_time and place < _NEAREST and not far
        fits = [
            lambda: fit_from_poles(bench, projector, one.refit, not shown) if starts else [],
            lambda: [fit_jointly(bench, projector, one.refit)] if joint else [],
        ]
        from_poles, jointly = map_in_threads(lambda fit: fit(), fits)
        return from_poles, jointly

    places = list(range(len(order)))
    # What comes after the best is fitted two at a time.
    for some in [places[:1], *(places[k : k + _TOGETHER] for k in range(1, len(places), _TOGETHER))]:
        for place, (ends, joint) in zip(some, map_in_threads(ends_of, some, map(is_far, some)), strict=True):
            one = order[place]
            ends = ends if is_far(place) else [*ends, *joint]
            if not ends:
                if is_shown(one):
                    out.append(one)
                continue
            end = min(ends, key=lambda state: state[-1].cost)
            found = Rival.of(*end[1:])
            end[1].release()
            if not end[-1].possible(bench):
                continue
            if least == np.inf:
                near = max(usual, 2 * abs(one.cost - found.cost))
            elif found.cost > least + thresholds.apart_z**2:
                near = usual
            least = min(least, found.cost)
            out.append(replace(found, refit=one.refit, end=end))
    # Of an effect the best form counts, which may be another once the baseline has followed. A form beside which it
    # has not followed stands behind those beside which it has.
    best: dict[str, Rival] = {}
    for one in sorted(out, key=lambda one: (one.end is None, one.criterion)):
        best.setdefault(one.name, one)
    return sorted(best.values(), key=lambda one: one.criterion)


def indistinguishable(
    first: Rival, fitted: Sequence[Rival], drop: float, exact: bool, thresholds: Thresholds
) -> tuple[Rival, ...]:
    """Effects that explain the same about as well as the cause, which takes so much off the sum of squares.

    An `exact` cause leaves no more than noise, so that its model is off by little.
    """
    # What the cause explains beyond the other: no more than models of effects are off by.
    apart_z = thresholds.apart_z if exact else confusable_z(drop, thresholds)

    def is_as_good(other: Rival) -> bool:
        # Errors of what else is not simulated yet are alike for long: noise would make less of a difference.
        worse = improvement_z(other.held_out, first.held_out) > thresholds.chance_z
        return other.fitted_cost - first.fitted_cost < apart_z**2 and not worse

    return tuple(
        other
        for other in fitted
        if other is not first and (other.criterion - first.criterion < thresholds.tie or is_as_good(other))
    )


def confusable_z(drop: float, thresholds: Thresholds) -> float:
    """Standard deviations within which an effect is another that takes so much off the sum of squares."""
    return max(thresholds.apart_z, 2 * thresholds.model_error * max(drop, 0.0) ** 0.5)


def gain_ahead(left: Sequence[Scored], causes: Collection[str], explained: float, thresholds: Thresholds) -> float:
    """Decrease of the sum of squares by the best further effect that is no error of the models of these causes.

    `explained` is the decrease by the causes, and `left` are scores beside them.
    """
    bar = max(explained, 0.0) ** 0.5
    further = [
        one for one in left if one.name not in causes and one.z > bar * model_error(one.name, causes, thresholds)
    ]
    return max((one.drop for one in further), default=0.0)


def model_error(name: str, causes: Collection[str], thresholds: Thresholds) -> float:
    """Part of what some causes explain that an effect beside them must exceed, by what it is mistaken for."""
    if any(form.flexible for form in EFFECTS if form.name == name):
        return thresholds.confused_error
    own = {other for form in EFFECTS if form.name == name for other in form.confusions}
    if any(f.name in causes and (name in f.confusions or f.name in own) for f in EFFECTS):
        return thresholds.confused_error
    return thresholds.model_error
