"""Which effects the records need: a search over sets of causes, with refits, and a backward check."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.diagnosis._comparison import (
    Rival,
    compare_rivals,
    confusable_z,
    criterion,
    gain_ahead,
    has_occurred,
    indistinguishable,
    leaders,
    model_error,
)
from fits.diagnosis._effects import Bench
from fits.diagnosis._joint_fit import State, is_smoothness_confirmed, refine, relearn_noise
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, nothing, refit
from fits.diagnosis._score import Family, Probe, Scored, score
from fits.diagnosis._thresholds import THRESHOLDS, Thresholds
from fits.stats._compare import improvement_z, is_worse
from fits.stats._score_test import standard_deviations
from microid.effects import EFFECTS, card_of

# Laws at most, as some causes come several times, sets of causes that are followed at a time, and rounds in which
# others are fitted where none of the leaders holds.
_MOST_LAWS, _BEAM, _TRIES = 8, 2, 3
# The farthest that a standard deviation in coordinates is taken at its word.
_FARTHEST = 3.0
_ONCE = {form.name for form in EFFECTS if not form.repeats}


@dataclass(frozen=True)
class Cause:
    """An effect that the records need.

    `z` is the evidence for it when it was found, in standard deviations, `p_family` the probability of as much
    evidence for any effect by chance, and `drop` the decrease of the sum of squares, in noise variances. `rivals` are
    the effects that explain the same about as well, the best first, and `behind` names those that do so better.
    """

    name: str
    z: float
    p_family: float
    rivals: tuple[Rival, ...]
    drop: float
    behind: tuple[str, ...] = ()


@dataclass(frozen=True)
class Selection:
    """What the search found: the `causes` in the order in which they were found, and the `model` with all of them.

    `plain` is the baseline without them. `scores` are those of all probes at the baseline, `left` those beside the
    causes, and `family` gives the chance of the largest. `bench` and `projector` are of the baseline as it is beside
    the causes, `first` of the one without them. `explained` is what the causes take off the sum of squares beside a
    baseline that may do all that it may without them; `finest` says whether they were simulated with many steps in
    the end.
    """

    causes: tuple[Cause, ...]
    model: Refit
    plain: Refit
    scores: tuple[Scored, ...]
    left: tuple[Scored, ...]
    family: Family
    bench: Bench
    projector: Projector
    first: Projector
    explained: float = 0.0
    finest: bool = False


@dataclass(frozen=True)
class Search:
    """What every set of causes is judged by."""

    probes: tuple[Probe, ...]
    plain: Refit
    false_alarm: float
    rng: np.random.Generator
    progress: Callable[[str], None]
    thresholds: Thresholds
    has_time: Callable[[], bool]

    @property
    def candidates(self) -> list[tuple[np.ndarray, ...]]:
        """The signatures of all effects."""
        return [column for probe in self.probes for column in probe.signatures]


@dataclass(frozen=True)
class Explanation:
    """A set of causes, and baseline and causes fitted to each other.

    `left` are the scores beside them. The smaller the `criterion`, the better; `promise` is what the best further
    cause would leave of it.
    """

    causes: tuple[Cause, ...]
    bench: Bench
    projector: Projector
    model: Refit
    left: tuple[Scored, ...]
    family: Family
    criterion: float
    promise: float

    @classmethod
    def of(cls, causes: Sequence[Cause], state: State, search: Search) -> "Explanation":
        """Ask for all effects beside these causes."""
        bench, projector, model = state
        scores = score(projector, search.probes, model.residual, model.basis())
        names, explained = {cause.name for cause in causes}, search.plain.cost - model.cost
        ahead = gain_ahead(scores.each, names, explained, search.thresholds)
        family, left = Family(scores, search.rng), criterion(projector, model)
        if causes:
            projector.release()
        return cls(tuple(causes), bench, projector, model, scores.each, family, left, left - ahead)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the causes, in the order in which they were found, each once."""
        return tuple(dict.fromkeys(cause.name for cause in self.causes))

    @property
    def near_bound(self) -> bool:
        """Whether a cause may, within a standard deviation, be as large as such an effect can be."""
        sd = np.minimum(np.sqrt(np.diagonal(self.model.covariance(robust=False))), _FARTHEST)
        each = np.split(sd, np.cumsum([law.size for law in self.model.laws], dtype=int))[:-1]
        moved = zip(self.model.laws, self.model.x, each, strict=True)
        return any(law.at_bound(x + way * own) for law, x, own in moved for way in (-1, 0, 1))


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
            more = sorted(_grown(one, search), key=lambda one: one.criterion)
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
            afresh = relearn_noise(projector, order[0].projector, order[0].model, search.candidates, thresholds)
            if afresh is not None:
                # The cause was taken for noise or roughness, too: all is asked again beside what there is of them.
                settings = probes, false_alarm, rng, progress, thresholds, has_time
                found = select(bench, afresh, *settings, again - 1)
                if found.causes and is_smoothness_confirmed(found.projector, found.model):
                    return found
        reach = confusable_z(plain.cost - order[0].model.cost, thresholds) ** 2 if order else 0.0
        # The same that is near is worth following where it is with the best further cause, which another may hide.
        most = min((one.promise for one in order), default=0.0) + reach
        near = [one for one in ranked if one[1].criterion < order[0].criterion + reach or one[1].promise < most]
        # The best of each set before the second best of any: effects of one class would take all places.
        beam = [one for _, one in sorted(near, key=lambda one: one[0])[:_BEAM]]
    best = _best(ends, plain, thresholds)
    return _refined(_with_equals(best, ends, thresholds, plain), start, search)


def _best(ends: Sequence[Explanation], plain: Refit, thresholds: Thresholds) -> Explanation:
    """The explanation of the smallest criterion; of those that are not told apart, one with no cause near a bound."""
    ends = [one for one in ends if not any(_adds_little(one, other, plain, thresholds) for other in ends)]
    first = min(ends, key=lambda one: one.criterion)
    reach = confusable_z(plain.cost - first.model.cost, thresholds) ** 2
    return min(ends, key=lambda one: (one.criterion > first.criterion + reach, one.near_bound, one.criterion))


def _adds_little(one: Explanation, other: Explanation, plain: Refit, thresholds: Thresholds) -> bool:
    """Whether one has the causes of another and some that explain no more than the models of those are off by."""
    if not other.causes or not set(other.names) < set(one.names):
        return False
    further = set(one.names) - set(other.names)
    alike = {*other.names}.union(*(cause.behind for cause in other.causes))
    off = max(model_error(name, alike, thresholds) for name in further)
    explained, gained = plain.cost - other.model.cost, other.model.cost - one.model.cost
    return gained <= off**2 * max(explained, 0.0)


def _grown(one: Explanation, search: Search) -> list[Explanation]:
    """The same with one more cause: with each of those that explain about as much."""
    thresholds, false_alarm = search.thresholds, search.false_alarm
    bench, projector, model = one.bench, one.projector, one.model
    taken, refused = set(one.names), set[str]()
    # Models of effects are not exact: what one leaves may look like another, above all like its confusions; where
    # another of its class explains more, like what that one is mistaken for.
    alike = taken.union(*(cause.behind for cause in one.causes))
    whole = max(search.plain.cost - model.cost, 0.0)
    independent = sum(cause.drop for cause in one.causes if card_of(cause.name).independent)
    explained = max(whole - independent, 0.0) ** 0.5
    bars = {
        scored.form: (whole**0.5 if scored.form.independent else explained)
        * model_error(scored.name, alike, thresholds)
        for scored in one.left
    }
    # Noise that was read too low makes chance look like evidence: what is left says how low at most.
    sigma = max((model.cost / max(projector.count - projector.freedom, 1.0)) ** 0.5, 1.0)
    room = len(one.names) < thresholds.most_causes and len(one.causes) < _MOST_LAWS
    for _ in range(_TRIES if room else 0):
        closed = (taken & _ONCE) | refused
        open_ = [s for s in one.left if s.name not in closed and s.z > bars[s.form]]
        top = max((s.z for s in open_), default=0.0)
        if not open_ or one.family.p(top / sigma) >= false_alarm or not search.has_time():
            break
        search.progress(f"fitting the effects that explain most ({top:.1f} standard deviations)")
        if bench.baseline.dynamic:
            # A lag that the poles have taken over shows nothing here, but its fit begins elsewhere.
            open_ += [s for s in one.left if s.form.lag and s.name not in closed and s.z <= bars[s.form]]
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
            predicts = improvement_z(before, rival.held_out) > thresholds.worse_z
            if not (predicts or end[-1].determined(thresholds.determined_z, False, alone)):
                continue
            # What it explains is lost where all is fitted together, or it explains less than its score promised.
            new = end[-1].laws[len(one.causes) :]
            z = float(standard_deviations(drop, sum(law.size for law in new)))
            if model.cost - end[-1].cost < thresholds.minor_share * drop or z <= bars[rival.form]:
                continue
            if one.family.p(z / sigma) >= false_alarm or rival.criterion > one.criterion:
                continue
            if taken and is_worse(before, rival.held_out, thresholds.worse_z, thresholds.model_error):
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


def _with_equals(best: Explanation, ends: Sequence[Explanation], thresholds: Thresholds, plain: Refit) -> Explanation:
    """The best, and with each of its causes the effects that explain as much in its place in the end.

    Those that explain less there, whatever was put beside them, are none of them.
    """
    least = best.criterion + confusable_z(plain.cost - best.model.cost, thresholds) ** 2
    causes = []
    for at, cause in enumerate(best.causes):
        before = {other.name for other in best.causes[:at]}
        reached: dict[str, float] = {}
        equals: dict[str, Rival] = {}
        for end in (end for end in ends if end is not best):
            first = {other.name for other in end.causes[: at + 1]}
            if before < first and len(first) == len(before) + 1:
                (name,) = first - before
                reached[name] = min(reached.get(name, np.inf), end.criterion)
            instead = {*end.names} - ({*best.names} - {cause.name})
            if len(instead) == 1 and len(end.names) == len(best.names) and end.criterion <= least:
                (name,) = instead
                found = end.model.with_last([other.name for other in end.causes].index(name))
                equals[name] = Rival.of(end.projector, found)
        rivals = {rival.name: rival for rival in cause.rivals if not reached.get(rival.name, -np.inf) > least}
        more = {name: rival for name, rival in equals.items() if name not in {*rivals, *best.names}}
        causes.append(replace(cause, rivals=(*rivals.values(), *more.values())))
    return replace(best, causes=tuple(causes))


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
