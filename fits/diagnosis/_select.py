"""Which effects the records need: forward selection with refits, a backward check, and what cannot be told apart."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.diagnosis._candidates import Bench, Probe
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, nothing, refit, refit_beside
from fits.diagnosis._score import Family, Scored, rescore, score
from fits.diagnosis._settle import Settled, bounded, finely, quieter, settled, smoother, stronger
from fits.diagnosis._unswept import FirstWaysError, unswept
from microid import EFFECTS

# Effects that are fitted to choose among: the best by their scores, of each at most so many forms.
_LEADERS, _FORMS = 5, 2
# Causes that are sought, at most, and laws in all, as some causes come several times.
_MOST, _LAWS = 4, 6
# Effects that every piezo has.
_USUAL = ("creep",)
# Differences of the criterion, and standard deviations after projecting one effect off another, within which two
# effects are not told apart.
_SAME, _APART = 10.0, 4.0
# Standard deviations beyond which effects are told apart if one of them leaves no more than noise, which varies by
# so many standard deviations.
_CLEAR, _CHANCE = 8.0, 3.0
# Effects that the baseline follows to tell them apart.
_NEAREST = 4
# Part of a cause's signature by which its model may be off, and by which it may be off along its confusions.
_INEXACT, _CONFUSED = 0.06, 0.6
# An effect that makes the square of the errors in what was held out so many times larger is none, and one with
# little evidence against the rest of the misfit is one if it makes it so much smaller.
_WORSE, _BETTER = 1.2, 0.85
# Part of what a cause explains by itself that must be left of it once all is fitted together.
_REAL = 0.3
# Evidence that a cause must have against what else is left, in standard deviations.
_SURE = 3.0
# Scores above this share of the best may be those of the cause, if so much of what it explains is left for another.
_NEAR, _FURTHER = 0.95, 0.15
# Scores below this share of the best are not worth a fit.
_WORTH = 0.4


@dataclass(frozen=True)
class Rival:
    """An effect fitted in place of a cause; its cost is that once the baseline has followed, where that was tried."""

    name: str
    refit: Refit
    criterion: float
    apart: float
    cost: float


@dataclass(frozen=True)
class Cause:
    """An effect that the records need.

    Attributes
    ----------
    name
        Name of the effect.
    z
        Evidence for it when it was found, in standard deviations.
    p_family
        Probability of as much evidence for any effect by chance.
    rivals
        Effects that explain the same about as well, the best first.
    drop
        Decrease of the sum of squares, in noise variances, when it was found.
    """

    name: str
    z: float
    p_family: float
    rivals: tuple[Rival, ...]
    drop: float


@dataclass(frozen=True)
class Selection:
    """What forward selection found.

    Attributes
    ----------
    causes
        In the order found.
    model
        All of them fitted together.
    plain
        The baseline without them.
    scores
        Of all probes, at the baseline.
    left
        Of all probes, beside the causes.
    family
        Chance of the largest score.
    bench, projector
        Of the baseline as it is beside the causes.
    finest
        Whether the causes were simulated with many steps between samples in the end.
    first
        Projector of the baseline without them.
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
    finest: bool = False


def best_of(scores: Sequence[Scored]) -> dict[str, Scored]:
    """The highest score of each effect, the highest first."""
    found: dict[str, Scored] = {}
    for one in sorted(scores, key=lambda s: -s.z):
        found.setdefault(one.name, one)
    return found


def select(
    bench: Bench,
    projector: Projector,
    probes: Sequence[Probe],
    false_alarm: float,
    rng: np.random.Generator,
    progress: Callable[[str], None],
    guessed: bool = False,
    again: int = 2,
) -> Selection:
    """Add effects one at a time until chance explains the rest; where they are less noise, begin again so often.

    Raises
    ------
    FirstWaysError
        If the state before the runs was `guessed`, and a wrong guess explains what is left.
    """
    plain = model = nothing(bench, projector)
    scores = left = score(projector, probes, plain.residual)
    family = Family(scores, rng)
    causes: list[Cause] = []
    refused: set[str] = set()
    first_bench, first_projector = bench, projector
    once = {form.name for form in EFFECTS if not form.repeats}
    while len({cause.name for cause in causes}) < _MOST and len(causes) < _LAWS:
        taken = {cause.name for cause in causes}
        # Models of effects are not exact: what one leaves may look like another, above all like its confusions.
        explained = max(plain.cost - model.cost, 0.0) ** 0.5
        open_ = [
            one
            for one in left
            if one.name not in (taken & once) | refused
            and one.z > explained * (_CONFUSED if _confusable(one, taken) else _INEXACT)
        ]
        if not open_:
            break
        top = max(one.z for one in open_)
        # Noise that was read too low makes chance look like evidence: what is left says how low at most.
        sigma = max((model.cost / max(projector.count - projector.freedom, 1.0)) ** 0.5, 1.0)
        if family.p(top / sigma) >= false_alarm:
            break
        if guessed and causes and unswept(projector, top, model):
            raise FirstWaysError
        progress(f"fitting the effects that explain most ({top:.1f} standard deviations)")
        fitted = _contest(bench, projector, model, open_, top, explained)
        if not fitted:
            refused |= {one.name for one in open_ if one.z > _WORTH * top}
            continue
        first, beside = _leader(bench, projector, probes, model, fitted, best_of(open_), taken & once)
        drop = model.cost - first.refit.cost
        exact = first.cost < projector.count - projector.freedom + _CHANCE * (2 * projector.count) ** 0.5
        rivals = _rivals(first, fitted, max(drop, 0.0), exact)
        usual = next((rival for rival in rivals if rival.name in _USUAL and first.name not in _USUAL), None)
        if usual is not None and not any(run.held_out.any() for run in bench.baseline.runs):
            # Of effects that these records cannot tell apart, and nothing else can, the one that every rig has.
            rivals = (replace(first, apart=usual.apart), *(rival for rival in rivals if rival is not usual))
            first, beside = usual, settled(bench, projector, usual.refit)
        if not beside[-1].determined() or model.cost - beside[-1].cost < _REAL * drop:
            # Its strength is anybody's guess, or what it explains is out of reach where all is fitted together.
            refused.add(first.name)
            continue
        z = max(drop, 0.0) ** 0.5
        if family.p(z / sigma) >= false_alarm:
            refused.add(first.name)
            continue
        bench, projector, model = beside
        less = quieter(projector, model) if again else None
        if less is not None:
            # The cause was taken for noise, too: all is asked again beside what noise there is.
            afresh = Projector(first_projector.regression, less, projector.roughness)
            return select(first_bench, afresh, probes, false_alarm, rng, progress, guessed, again - 1)
        causes.append(Cause(first.name, z, family.p(z), rivals, drop))
        basis = model.basis()
        left = rescore(score(projector, probes, model.residual), basis, model.residual)
        family = Family(left, rng)
    causes, model = _backward(bench, projector, causes, model)
    bench, projector, model = smoother(*stronger(bench, projector, model))
    model, finest = finely(bench, projector, model)
    bench, projector, model = bounded(bench, projector, model, finest)
    return Selection(tuple(causes), model, plain, scores, left, family, bench, projector, first_projector, finest)


def _leader(
    bench: Bench,
    projector: Projector,
    probes: Sequence[Probe],
    model: Refit,
    fitted: Sequence[Rival],
    scores: Mapping[str, Scored],
    closed: Collection[str],
) -> tuple[Rival, Settled]:
    """Choose the cause: the best, or among those about as good the one beside which another explains most.

    Where two causes act, one that is neither may follow part of each and come first. None comes twice of those
    that are `closed`.
    """
    best, chosen = fitted[0], settled(bench, projector, fitted[0].refit)
    highest = max(scores[one.name].z for one in fitted)
    near = [one for one in fitted if scores[one.name].z > _NEAR * highest]

    def further(one: Rival, at: Settled) -> tuple[float, float]:
        there, beside, own = at
        basis = own.basis()
        left = rescore(score(beside, probes, own.residual), basis, own.residual)
        others = [other for other in left if other.name != one.name and other.name not in closed]
        if not others:
            return 0.0, own.cost
        next_ = max(others, key=lambda other: other.z)
        _, _, pair = settled(there, beside, refit_beside(there, beside, own, next_))
        return next_.z, min(own.cost, pair.cost)

    if len(near) < 2 or best not in near:
        return best, chosen
    left, cost = further(best, chosen)
    if left < _FURTHER * max(model.cost - chosen[-1].cost, 0.0) ** 0.5:
        return best, chosen
    for one in near:
        if one is best:
            continue
        trial = settled(bench, projector, one.refit)
        _, pair = further(one, trial)
        if pair < cost - _SAME:
            best, chosen, cost = one, trial, pair
    return best, chosen


def _rivals(first: Rival, fitted: Sequence[Rival], drop: float, exact: bool) -> tuple[Rival, ...]:
    """Effects that explain the same about as well as the cause, which takes so much off the sum of squares."""
    found = []
    # A model that leaves no more than noise is off by little.
    most = min(_tolerance(drop), _CLEAR) if exact else _tolerance(drop)
    for other in fitted:
        # What the cause explains beyond the other: no more than models of effects are off by.
        apart = max(other.cost - first.cost, 0.0) ** 0.5
        if other is not first and (other.criterion - first.criterion < _SAME or apart < most):
            found.append(replace(other, apart=apart))
    return tuple(found)


def _confusable(one: Scored, causes: Collection[str]) -> bool:
    """Whether an effect is mistaken for one of some others, by what is known of them."""
    own = set(type(one.probe.effects[0]).confusions)
    return any(form.name in causes and (one.name in form.confusions or form.name in own) for form in EFFECTS)


def _contest(
    bench: Bench, projector: Projector, model: Refit, scores: Sequence[Scored], top: float, explained: float
) -> list[Rival]:
    """Fit the leaders beside what is there already, the best first."""
    names = [name for name, one in best_of(scores).items() if one.z > _WORTH * top][:_LEADERS]
    fitted: dict[str, Refit] = {}
    bare = Projector(projector.regression, projector.noise)
    before = bare.ahead(model.change_um)
    for name in names:
        own = sorted((one for one in scores if one.name == name), key=lambda s: -s.z)
        tried: dict[type, int] = {}
        for one in own:
            form = type(one.probe.effects[0])
            if tried.get(form, 0) >= (1 if form.strength else _FORMS) or one.z < _WORTH * own[0].z:
                continue
            tried[form] = tried.get(form, 0) + 1
            found = refit_beside(bench, projector, model, one)
            if not all(np.all(np.isfinite(change)) for change in found.change_um):
                continue
            # What does not stand out of the rest of the misfit must show in what was kept aside.
            plain = one.sure > (_SURE if one.z > 2 * _INEXACT * explained else 2 * _SURE)
            most = _WORSE if plain else _BETTER
            if bare.ahead(found.change_um) > most * before or not found.determined() or not _whole(bench, found):
                continue
            if name not in fitted or found.criterion(projector.count) < fitted[name].criterion(projector.count):
                fitted[name] = found
    return _ranked(
        bench,
        projector,
        [Rival(name, one, one.criterion(projector.count), 0.0, one.cost) for name, one in fitted.items()],
        model.cost,
    )


def _ranked(bench: Bench, projector: Projector, fitted: list[Rival], before: float) -> list[Rival]:
    """Put effects in order: those about as good by what they leave once the baseline has followed each."""
    order = sorted(fitted, key=lambda one: one.criterion)
    if not order:
        return order
    most = _tolerance(before - order[0].cost) ** 2
    near = [one for one in order if one.cost - order[0].cost < most][:_NEAREST]
    if len(near) < 2:
        return order
    for one in near:
        end = settled(bench, projector, one.refit)[-1]
        order[order.index(one)] = replace(one, cost=end.cost, criterion=end.criterion(projector.count))
    return sorted(order, key=lambda one: one.criterion)


def _tolerance(drop: float) -> float:
    """Standard deviations within which an effect is another that takes so much off the sum of squares."""
    return max(_APART, 2 * _INEXACT * max(drop, 0.0) ** 0.5)


def _whole(bench: Bench, model: Refit) -> bool:
    """Whether what is counted in sampling intervals is nearer to one than to none in some run, for the last law."""
    law, x = model.laws[-1], model.x[-1]
    found = not law.form.counted
    for run, one in enumerate(bench.prepared):
        interval_s = float(np.median(np.diff(one.run.record.time_s)))
        effect = law.effect(x, run)
        found = found or any(abs(float(getattr(effect, name))) > interval_s / 2 for name in law.form.counted)
    return found


def _backward(bench: Bench, projector: Projector, causes: list[Cause], model: Refit) -> tuple[list[Cause], Refit]:
    """Take out what later additions made unnecessary."""
    while len(causes) > 1:
        trials = []
        for k in range(len(causes)):
            laws = [law for i, law in enumerate(model.laws) if i != k]
            without = refit(bench, projector, laws, [x for i, x in enumerate(model.x) if i != k], 3)
            trials.append((without.criterion(projector.count), k, without))
        criterion, k, without = min(trials, key=lambda t: t[0])
        if criterion > model.criterion(projector.count) + _SAME:
            break
        causes = [cause for i, cause in enumerate(causes) if i != k]
        model = without
    return causes, model
