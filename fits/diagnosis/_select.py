"""Which effects the records need: forward selection with refits, a backward check, and what cannot be told apart."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.diagnosis._candidates import Bench, Probe
from fits.diagnosis._comparison import INEXACT, SAME, WORTH, Rival, best_of, compare_rivals, tolerance
from fits.diagnosis._joint_fit import (
    Settled,
    bounded,
    confirmed,
    finely,
    released,
    renewed,
    resmoothed,
    settled,
    smoother,
    stronger,
)
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, nothing, refit, refit_beside
from fits.diagnosis._score import Family, Scored, rescore, score
from fits.diagnosis._virgin import VirginCurveError, is_virgin
from microid import EFFECTS

# Causes that are sought, at most, and laws in all, as some causes come several times.
_MOST, _LAWS = 4, 8
# Effects that the command has no part in: their residuals show no dependence on it.
_ALONE = ("mains_hum",)
# Effects that every piezo has.
_USUAL = ("creep",)
# Standard deviations beyond which effects are told apart if one of them leaves no more than noise.
_CLEAR = 5.0
# Part of a cause's signature by which its model may be off along its confusions, and along any column of the records:
# what is slow in both agrees by chance.
_CONFUSED, _COLUMN = 0.6, 0.15
# Part of what a cause explains by itself that must be left of it once all is fitted together.
_REAL = 0.3
# Scores above this share of the best may be those of the cause, if so much of what it explains is left for another.
_NEAR, _FURTHER = 0.95, 0.15


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
    explained
        What they take off the sum of squares beside a baseline that may do all that it may without them.
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
    explained: float = 0.0
    finest: bool = False

    @property
    def left_um(self) -> float:
        """Root mean square of what baseline and causes leave."""
        noise_um2 = float(np.mean([noise.total_um**2 for noise in self.projector.noise]))
        return (noise_um2 * self.model.cost / max(self.projector.count - self.projector.freedom, 1.0)) ** 0.5


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
    """Add effects one at a time until chance explains the rest; where they passed for noise, begin again so often.

    Raises
    ------
    VirginCurveError
        If the state before the runs was `guessed`, and a wrong guess explains what is left.
    """
    plain = model = nothing(bench, projector)
    scores = left = score(projector, probes, plain.residual)
    family = Family(scores, rng)
    causes: list[Cause] = []
    refused: set[str] = set()
    stood_in: set[str] = set()
    first_bench, first_projector = bench, projector
    once = {form.name for form in EFFECTS if not form.repeats}
    while len({cause.name for cause in causes}) < _MOST and len(causes) < _LAWS:
        taken = {cause.name for cause in causes}
        # Models of effects are not exact: what one leaves may look like another, above all like its confusions.
        whole = max(plain.cost - model.cost, 0.0)
        alone = sum(cause.drop for cause in causes if cause.name in _ALONE)
        explained = max(whole - alone, 0.0) ** 0.5
        bars = {one.form: (whole**0.5 if one.name in _ALONE else explained) * _inexact(one, taken) for one in left}
        open_ = [one for one in left if one.name not in (taken & once) | refused and one.z > bars[one.form]]
        if not open_:
            break
        top = max(one.z for one in open_)
        # Noise that was read too low makes chance look like evidence: what is left says how low at most.
        sigma = max((model.cost / max(projector.count - projector.freedom, 1.0)) ** 0.5, 1.0)
        if family.p(top / sigma) >= false_alarm:
            break
        if guessed and causes and is_virgin(projector, top, model):
            raise VirginCurveError
        progress(f"fitting the effects that explain most ({top:.1f} standard deviations)")
        fitted = compare_rivals(bench, projector, model, open_, explained, _LAWS - len(causes))
        if not fitted:
            refused |= {one.name for one in open_ if one.z > WORTH * top}
            continue
        first, beside = _leader(bench, projector, probes, model, fitted, best_of(open_), taken & once)
        drop = model.cost - first.refit.cost
        rivals = _rivals(first, fitted, max(drop, 0.0), beside[-1].is_noise(beside[1]))
        usual = next((rival for rival in rivals if rival.name in _USUAL and first.name not in _USUAL), None)
        if usual is not None and not any(run.held_out.any() for run in bench.baseline.runs):
            # Of effects that these records cannot tell apart, and nothing else can, the one that every rig has.
            rivals = (replace(first, apart=usual.apart), *(rival for rival in rivals if rival is not usual))
            first, beside = usual, settled(bench, projector, usual.refit)
        alone = beside[-1].is_noise(beside[1]) and not model.is_noise(projector)
        if not beside[-1].determined(False, alone) or model.cost - beside[-1].cost < _REAL * drop:
            # Its strength is anybody's guess, or what it explains is out of reach where all is fitted together.
            refused.add(first.name)
            stood_in |= {first.name} if beside[-1].laws[-1].pinned(beside[-1].x[-1]) else set()
            continue
        z = max(drop, 0.0) ** 0.5
        if family.p(z / sigma) >= false_alarm or z <= bars[first.refit.laws[-1].form]:
            # It explains less than its score promised.
            refused.add(first.name)
            continue
        bench, projector, model = beside
        # What stood in for this cause, as strong or as short as can be, has not been asked about itself.
        refused, stood_in = refused - stood_in, set()
        afresh = renewed(first_projector, projector, model) if again else None
        if afresh is not None:
            # The cause was taken for noise or roughness, too: all is asked again beside what there is of them.
            found = select(first_bench, afresh, probes, false_alarm, rng, progress, guessed, again - 1)
            if found.causes and confirmed(found.projector, found.model):
                return found
            again = 0
        new = len(model.laws) - len(causes)
        causes += [Cause(first.name, z, family.p(z), rivals, drop / new)] * new
        basis = model.basis()
        left = rescore(score(projector, probes, model.residual), basis, model.residual)
        family = Family(left, rng)
    causes, model = _backward(bench, projector, causes, model)
    explained = plain.cost - model.cost
    bench, projector, model = resmoothed(*smoother(*stronger(bench, projector, model)))
    model, finest = finely(bench, projector, model)
    # What is asked of the causes from here on is asked as they were fitted.
    bench = Bench(bench.baseline, finest=True) if finest else bench
    bench, projector, model = bounded(*released(bench, projector, model, finest), finest)
    # One may have come to nothing since.
    causes, model = _backward(bench, projector, causes, model)
    # In the end the density is smoother and nowhere negative, which costs something by itself.
    explained = max(explained, plain.cost - model.cost, 0.0)
    at = bench, projector, first_projector
    return Selection(tuple(causes), model, plain, scores, left, family, *at, explained, finest)


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
        if pair < cost - SAME:
            best, chosen, cost = one, trial, pair
    return best, chosen


def _rivals(first: Rival, fitted: Sequence[Rival], drop: float, exact: bool) -> tuple[Rival, ...]:
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


def _inexact(one: Scored, causes: Collection[str]) -> float:
    """Part of what some causes explain that an effect beside them must exceed, by what it is mistaken for."""
    if any(f.name in causes and (one.name in f.confusions or f.name in one.form.confusions) for f in EFFECTS):
        return _CONFUSED
    return _COLUMN if one.form.needs else INEXACT


def _backward(bench: Bench, projector: Projector, causes: list[Cause], model: Refit) -> tuple[list[Cause], Refit]:
    """Take out what later additions made unnecessary."""
    while len(causes) > 1:
        trials = []
        for k in range(len(causes)):
            laws = [law for i, law in enumerate(model.laws) if i != k]
            without = refit(bench, projector, laws, [x for i, x in enumerate(model.x) if i != k], 3)
            trials.append((without.criterion(projector.count), k, without))
        criterion, k, without = min(trials, key=lambda t: t[0])
        if criterion > model.criterion(projector.count) + SAME:
            break
        causes = [cause for i, cause in enumerate(causes) if i != k]
        model = without
    return causes, model
