"""Which effects the records need: forward selection with refits, a backward check, and what cannot be told apart."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.diagnosis._candidates import Bench, Probe
from fits.diagnosis._faults import find_faults
from fits.diagnosis._noise import Noise
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, nothing, refit, refit_beside
from fits.diagnosis._regression import regress
from fits.diagnosis._score import Family, Scored, rescore, score
from microid import EFFECTS

# Effects that are fitted to choose among: the best by their scores, of each at most so many forms.
_LEADERS, _FORMS = 5, 2
# Causes that are sought, at most, and laws in all, as some causes come several times.
_MOST, _LAWS = 4, 6
# Differences of the criterion, and standard deviations after projecting one effect off another, within which two
# effects are not told apart.
_SAME, _APART = 10.0, 4.0
# Part of a cause's signature by which its model may be off, and by which it may be off along its confusions.
_INEXACT, _CONFUSED = 0.06, 0.6
# An effect that makes the square of the errors in what was held out so many times larger is none.
_WORSE = 1.2
# Evidence that a cause must have against what else is left, in standard deviations.
_SURE = 3.0
# Noise that falls by less than this factor is the same.
_LESS = 0.8
# Scores below this share of the best are not worth a fit.
_WORTH = 0.4


@dataclass(frozen=True)
class Rival:
    """An effect fitted in place of a cause."""

    name: str
    refit: Refit
    criterion: float
    apart: float


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
    """

    causes: tuple[Cause, ...]
    model: Refit
    plain: Refit
    scores: tuple[Scored, ...]
    left: tuple[Scored, ...]
    family: Family
    bench: Bench
    projector: Projector


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
    again: int = 2,
) -> Selection:
    """Add effects one at a time until chance explains the rest; where they are less noise, begin again so often."""
    plain = model = nothing(bench, projector)
    scores = left = score(projector, probes, plain.residual)
    family = Family(scores, rng)
    causes: list[Cause] = []
    first_bench, first_regression = bench, projector.regression
    once = {form.name for form in EFFECTS if not form.repeats}
    while len({cause.name for cause in causes}) < _MOST and len(causes) < _LAWS:
        taken = {cause.name for cause in causes}
        # Models of effects are not exact: what one leaves may look like another, above all like its confusions.
        explained = max(plain.cost - model.cost, 0.0) ** 0.5
        open_ = [
            one
            for one in left
            if one.name not in taken & once
            and one.sure > _SURE
            and one.z > explained * (_CONFUSED if _confusable(one, taken) else _INEXACT)
        ]
        if not open_:
            break
        top = max(one.z for one in open_)
        p = family.p(top)
        if p >= false_alarm:
            break
        progress(f"fitting the effects that explain most ({top:.1f} standard deviations)")
        rivals = _contest(bench, projector, model, open_, top)
        if not rivals:
            break
        first = rivals[0]
        drop = model.cost - first.refit.cost
        settled = settle(bench, projector, first.refit)
        if settled[-1].cost > first.refit.cost:
            # A baseline that moved without the roughness beyond its grid may have moved away.
            settled = bench, projector, refit(bench, projector, first.refit.laws, first.refit.x, 4)
        if not settled[-1].determined():
            # Beside a baseline that has followed, its strength is anybody's guess.
            break
        bench, projector, model = settled
        quieter = _quieter(projector, model) if again else None
        if quieter is not None:
            # The cause was taken for noise, too: all is asked again beside what noise there is.
            afresh = Projector(first_regression, quieter, projector.roughness)
            return select(first_bench, afresh, probes, false_alarm, rng, progress, again - 1)
        z = max(drop, 0.0) ** 0.5
        causes.append(Cause(first.name, z, family.p(z), tuple(rivals[1:]), drop))
        basis = model.basis()
        left = rescore(score(projector, probes, model.residual), basis, model.residual)
        family = Family(left, rng)
    causes, model = _backward(bench, projector, causes, model)
    return Selection(tuple(causes), model, plain, scores, left, family, bench, projector)


def settle(
    bench: Bench, projector: Projector, model: Refit, rounds: Sequence[int] = (4, 2)
) -> tuple[Bench, Projector, Refit]:
    """Let the baseline follow what effects leave, and fit those again beside it.

    A baseline fitted without them may be far from where it belongs, farther than its tangent reaches.
    """
    for count in rounds:
        # What roughness beyond the grid would explain is not put into the grid.
        bare = Projector(projector.regression, projector.noise)
        moved = bare.move(bare.residual - bare.join(model.change_um))
        regression = regress(moved, projector.regression.finer)
        bench = Bench(regression.baseline)
        projector = Projector(regression, projector.noise, projector.roughness)
        model = refit(bench, projector, model.laws, model.x, count)
    return bench, projector, model


def _quieter(projector: Projector, model: Refit) -> tuple[Noise, ...] | None:
    """The noise of the runs beside the causes, where there is less of it than was thought."""
    regression = projector.regression
    left = tuple(r - change for r, change in zip(regression.residuals, model.change_um, strict=True))
    found = find_faults(replace(regression, residuals=left)).noise
    less = [new.total_um < _LESS * old.total_um for new, old in zip(found, projector.noise, strict=True)]
    return tuple(found) if any(less) else None


def _confusable(one: Scored, causes: Collection[str]) -> bool:
    """Whether an effect is mistaken for one of some others, by what is known of them."""
    own = set(type(one.probe.effects[0]).confusions)
    return any(form.name in causes and (one.name in form.confusions or form.name in own) for form in EFFECTS)


def _contest(bench: Bench, projector: Projector, model: Refit, scores: Sequence[Scored], top: float) -> list[Rival]:
    """Fit the leaders beside what is there already: the best, then those not told apart from it."""
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
            if bare.ahead(found.change_um) > _WORSE * before or not found.determined():
                continue
            if name not in fitted or found.criterion(projector.count) < fitted[name].criterion(projector.count):
                fitted[name] = found
    order = sorted(fitted, key=lambda name: fitted[name].criterion(projector.count))
    if not order:
        return []
    best = fitted[order[0]]
    rivals = [Rival(order[0], best, best.criterion(projector.count), 0.0)]
    for name in order[1:]:
        other = fitted[name]
        worse = other.criterion(projector.count) - rivals[0].criterion
        # What the best explains beyond the other, and the other's change that the best cannot follow.
        apart = max(other.cost - best.cost, 0.0) ** 0.5
        if worse < _SAME or apart < _APART:
            rivals.append(Rival(name, other, other.criterion(projector.count), apart))
    return rivals


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
