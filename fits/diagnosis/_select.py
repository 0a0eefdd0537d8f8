"""Which effects the records need: a search over sets of causes, with refits, and a backward check."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from fits.diagnosis._comparison import (
    compare_rivals,
    confusable_z,
    criterion,
    indistinguishable,
    leaders,
    model_error,
)
from fits.diagnosis._effects import Bench
from fits.diagnosis._explanation import Cause, Explanation, Search, Selection, best_of_ends, with_equals
from fits.diagnosis._forms import in_best_forms
from fits.diagnosis._joint_fit import is_smoothness_confirmed, refine, relearn_noise
from fits.diagnosis._occurrences import has_occurred
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, nothing, refit
from fits.diagnosis._score import Probe
from fits.diagnosis._thresholds import THRESHOLDS, Thresholds
from fits.stats._compare import improvement_z, is_worse
from fits.stats._score_test import standard_deviations
from microid.effects import EFFECTS, card_of

# Laws at most, as some causes come several times, sets of causes that are followed at a time, and rounds in which
# others are fitted where none of the leaders holds.
_MOST_LAWS, _BEAM, _TRIES = 8, 2, 3
_ONCE = {form.name for form in EFFECTS if not form.repeats}


def select(
    bench: Bench,
    projector: Projector,
    probes: Sequence[Probe],
    false_alarm: float,
    rng: np.random.Generator,
    progress: Callable[[str], None],
    thresholds: Thresholds = THRESHOLDS,
    has_time: Callable[[], bool] = lambda: True,
    again: int = 2,
) -> Selection:
    """Add causes one at a time until chance explains the rest, take out what became unnecessary, and refine.

    Sets of causes that explain about as much are followed side by side (beam search), as of two causes the first may
    hide behind an effect that follows part of each; the smallest information criterion decides. Where a cause passed
    for noise before, the search begins again beside less noise, so often at most.
    """
    plain = nothing(bench, projector)
    search = Search(tuple(probes), plain, false_alarm, rng, progress, thresholds, has_time)
    start = Explanation.of((), (bench, projector, plain), search)
    beam, ends = [start], []
    while beam:
        grown: dict[frozenset[str], tuple[int, Explanation]] = {}
        for one in beam:
            more = sorted(_grown(one, search, grown), key=lambda one: one.criterion)
            if one.causes:
                one.projector.release()
            if not more:
                ends.append(one)
            for place, other in enumerate(more):
                key = frozenset(other.names)
                if key not in grown or other.criterion < grown[key][1].criterion:
                    grown[key] = place, other
        ranked = sorted(grown.values(), key=lambda one: one[1].criterion)
        order = [one for _, one in ranked]
        if order and again and not beam[0].causes:
            ask = partial(search.beside, order[0].bench, model=order[0].model)
            afresh = relearn_noise(projector, order[0].projector, order[0].model, ask, thresholds)
            if afresh is not None:
                # The cause was taken for noise or roughness, too: all is asked again beside what there is of them.
                settings = probes, false_alarm, rng, progress, thresholds, has_time
                found = select(bench, afresh, *settings, again - 1)
                if found.causes and is_smoothness_confirmed(found.projector, found.model):
                    return found
        reach = confusable_z(order[0].modelled(plain), thresholds) ** 2 if order else 0.0
        # The same that is near is worth following where it is with the best further cause, which another may hide.
        most = min((one.promise for one in order), default=0.0) + reach
        near = [one for one in ranked if one[1].criterion < order[0].criterion + reach or one[1].promise < most]
        # The best of each set before the second best of any: effects of one class would take all places.
        beam = [one for _, one in sorted(near, key=lambda one: one[0])[:_BEAM]]
    best = best_of_ends(ends, plain, thresholds)
    return _refined(with_equals(best, ends, thresholds, plain), start, search)


def _grown(one: Explanation, search: Search, known: Collection[frozenset[str]]) -> list[Explanation]:
    """The same with one more cause: with each of those that explain about as much.

    None where what explains most leads to a set of causes that is `known`, as in another order.
    """
    thresholds, false_alarm = search.thresholds, search.false_alarm
    bench, projector, model = one.bench, one.projector, one.model
    taken, refused = set(one.names), set[str]()
    # Models of effects are not exact: what one leaves may look like another, above all like its confusions; where
    # another of its class explains more, like what that one is mistaken for.
    alike = taken.union(*(cause.behind for cause in one.causes))
    whole = max(search.plain.cost - model.cost, 0.0)
    explained = one.modelled(search.plain) ** 0.5
    bars = {
        scored.form: (whole**0.5 if scored.form.independent else explained)
        * model_error(scored.name, alike, thresholds)
        for scored in one.left
    }
    beyond = model.cost - projector.count + projector.freedom
    chance = thresholds.chance_z * (2 * projector.count) ** 0.5
    # What explains most of all that is left may be asked below that: it holds if then nothing but noise is left.
    asked = dict(bars)
    for scored in one.left if taken and beyond > chance else ():
        is_most = scored.drop > (1 - thresholds.minor_share) * beyond
        if is_most and model_error(scored.name, alike, thresholds) == thresholds.model_error:
            asked[scored.form] = min(bars[scored.form], thresholds.strong_z)
    # Noise that was read too low makes chance look like evidence: what is left says how low at most.
    sigma = max((model.cost / max(projector.count - projector.freedom, 1.0)) ** 0.5, 1.0)
    room = len(one.names) < thresholds.most_causes and len(one.causes) < _MOST_LAWS
    for _ in range(_TRIES if room else 0):
        closed = (taken & _ONCE) | refused
        open_ = [s for s in one.left if s.name not in closed and s.z > asked[s.form]]
        best = max(open_, key=lambda s: s.z, default=None)
        if best is None or one.family.p(best.z / sigma) >= false_alarm or not search.has_time():
            break
        if frozenset((*taken, best.name)) in known:
            break
        ahead = whole + (thresholds.most_causes - len(taken)) * best.drop
        if taken and ahead < thresholds.minor_share * (search.plain.cost - projector.count + projector.freedom):
            # With as many more that explain as much, most of the misfit would be unexplained: none would be named.
            break
        top = best.z
        search.progress(f"fitting the effects that explain most ({top:.1f} standard deviations)")
        if bench.baseline.dynamic:
            # A lag that the poles have taken over shows nothing here, but its fit begins elsewhere.
            open_ += [s for s in one.left if s.form.lag and s.name not in closed and s.z <= asked[s.form]]
        fitted = compare_rivals(
            bench, projector, model, open_, _MOST_LAWS - len(one.causes), thresholds, search.has_time
        )
        refused |= {s.name for s in leaders(open_, bench.baseline.dynamic)} - {rival.name for rival in fitted}
        found, vetoed, before = [], False, projector.held_out(model.change_um)
        for rival in [rival for rival in fitted if rival.end is not None]:
            refused.add(rival.name)
            end, drop = rival.end, model.cost - rival.refit.cost
            assert end is not None
            if rival.form.lag:
                # From the poles of the plain stage it may have come to none.
                drop = max(drop, model.cost - end[-1].cost)
            is_noise = end[-1].is_noise(end[1], thresholds.chance_z)
            alone = is_noise and not model.is_noise(projector, thresholds.chance_z)
            # What is predicted better beside a lag of none is so by the poles that were found with it.
            predicts = not rival.form.lag and improvement_z(before, rival.held_out) > thresholds.worse_z
            if not (predicts or end[-1].determined(thresholds.chance_z, False, alone)):
                continue
            # What it explains is lost where all is fitted together, or it explains less than its score promised.
            new = end[-1].laws[len(one.causes) :]
            z = float(standard_deviations(drop, sum(law.size for law in new)))
            bar = asked[rival.form] if is_noise else bars[rival.form]
            if model.cost - end[-1].cost < thresholds.minor_share * drop or z <= bar:
                continue
            if one.family.p(z / sigma) >= false_alarm or rival.criterion > one.criterion:
                continue
            if taken and is_worse(before, rival.held_out, thresholds.worse_z, thresholds.model_error):
                end = in_best_forms(*end, search.probes)
                # What had to be mended must predict better.
                if not improvement_z(before, end[1].held_out(end[-1].change_um)) > thresholds.worse_z:
                    vetoed = True
                    continue
            same = indistinguishable(rival, fitted, max(drop, 0.0), is_noise, thresholds)
            rivals = tuple(replace(other, end=None) for other in same)
            behind = tuple(other.name for other in same if other.criterion < rival.criterion)
            causes = [Cause(rival.name, z, one.family.p(z), rivals, drop / len(new), behind)] * len(new)
            found.append(Explanation.of((*one.causes, *causes), end, search))
        if found:
            return _that_every_rig_has(found, bench)
        if vetoed:
            # What explains most of the rest does so wrongly: what explains less would be named in its place.
            break
    return []


def _that_every_rig_has(found: list[Explanation], bench: Bench) -> list[Explanation]:
    """Of explanations that these records cannot tell apart, and nothing else can, the one that every rig has."""
    if any(run.held_out.any() for run in bench.baseline.runs):
        return found
    rivals = {rival.name for rival in found[0].causes[-1].rivals}
    first = [one for one in found if one.causes[-1].name in rivals and card_of(one.causes[-1].name).universal]
    return first[:1] if first and not card_of(found[0].causes[-1].name).universal else found


def _refined(best: Explanation, start: Explanation, search: Search) -> Selection:
    """The best with what became unnecessary taken out, and fitted as well as the records allow."""
    plain, tie = start.model, search.thresholds.tie
    causes, model = _backward(best.bench, best.projector, list(best.causes), best.model, tie)
    explained = plain.cost - model.cost
    bench, projector, model, finest = refine(best.bench, best.projector, model, search.has_time)
    if search.has_time():
        # One may have become unnecessary since.
        causes, model = _backward(bench, projector, causes, model, tie)
    # In the end the density is smoother and nowhere negative, which costs something by itself.
    explained = max(explained, plain.cost - model.cost, 0.0)
    scored, at = (start.left, best.left, best.family), (bench, projector, start.projector)
    return Selection(tuple(causes), model, plain, *scored, *at, explained, finest)


def _backward(
    bench: Bench, projector: Projector, causes: list[Cause], model: Refit, tie: float
) -> tuple[list[Cause], Refit]:
    """Take out what later additions made unnecessary, or made so small that it has not occurred."""
    while len(causes) > 1:
        trials = []
        for k in range(len(causes)):
            laws = [law for i, law in enumerate(model.laws) if i != k]
            without = refit(bench, projector, laws, [x for i, x in enumerate(model.x) if i != k], 3)
            trials.append((has_occurred(bench, model, k), criterion(projector, without), k, without))
        needed, least, k, without = min(trials, key=lambda t: t[:2])
        if needed and least > criterion(projector, model) + tie:
            break
        causes = [cause for i, cause in enumerate(causes) if i != k]
        model = without
    return causes, model
