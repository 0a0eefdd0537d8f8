"""Which effects the records need: forward selection with refits, and a backward check."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.diagnosis._comparison import (
    SAME,
    WORTH,
    Rival,
    choose_cause,
    compare_rivals,
    indistinguishable,
    model_error,
)
from fits.diagnosis._effects import Bench
from fits.diagnosis._joint_fit import fit_jointly, is_smoothness_confirmed, refine, relearn_noise
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, nothing, refit
from fits.diagnosis._score import Family, Probe, Scored, best_of, rescore, score
from microid import EFFECTS
from microid.effects import card_of

# Causes that are sought, at most, and laws in all, as some causes come several times.
_MOST_CAUSES, _MOST_LAWS = 4, 8
# Part of what a cause explains by itself that must be left of it once all is fitted together.
_LEFT_JOINTLY = 0.3


@dataclass(frozen=True)
class Cause:
    """An effect that the records need.

    `z` is the evidence for it when it was found, in standard deviations, `p_family` the probability of as much
    evidence for any effect by chance, and `drop` the decrease of the sum of squares, in noise variances. `rivals` are
    the effects that explain the same about as well, the best first.
    """

    name: str
    z: float
    p_family: float
    rivals: tuple[Rival, ...]
    drop: float


@dataclass(frozen=True)
class Selection:
    """What forward selection found: the `causes` in that order, and the `model` with all of them fitted together.

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
    again: int = 2,
) -> Selection:
    """Add effects one at a time until chance explains the rest, take out what became unnecessary, and refine.

    Where a cause passed for noise before, selection begins again beside less noise, so often at most.
    """
    plain = model = nothing(bench, projector)
    first_bench, first_projector = bench, projector
    scores = left = score(projector, probes, plain.residual)
    family = Family(scores, rng)
    causes: list[Cause] = []
    refused: set[str] = set()
    refused_at_bound: set[str] = set()
    once = {form.name for form in EFFECTS if not form.repeats}
    while len({cause.name for cause in causes}) < _MOST_CAUSES and len(causes) < _MOST_LAWS:
        taken = {cause.name for cause in causes}
        # Models of effects are not exact: what one leaves may look like another, above all like its confusions.
        whole = max(plain.cost - model.cost, 0.0)
        independent = sum(cause.drop for cause in causes if card_of(cause.name).independent)
        explained = max(whole - independent, 0.0) ** 0.5
        bars = {
            one.form: (whole**0.5 if one.form.independent else explained) * model_error(one, taken) for one in left
        }
        open_ = [one for one in left if one.name not in (taken & once) | refused and one.z > bars[one.form]]
        if not open_:
            break
        top = max(one.z for one in open_)
        # Noise that was read too low makes chance look like evidence: what is left says how low at most.
        sigma = max((model.cost / max(projector.count - projector.freedom, 1.0)) ** 0.5, 1.0)
        if family.p(top / sigma) >= false_alarm:
            break
        progress(f"fitting the effects that explain most ({top:.1f} standard deviations)")
        fitted = compare_rivals(bench, projector, model, open_, explained, _MOST_LAWS - len(causes))
        if not fitted:
            refused |= {one.name for one in open_ if one.z > WORTH * top}
            continue
        first, beside = choose_cause(bench, projector, probes, model, fitted, best_of(open_), taken & once)
        drop = model.cost - first.refit.cost
        rivals = indistinguishable(first, fitted, max(drop, 0.0), beside[-1].is_noise(beside[1]))
        universal = next((rival for rival in rivals if rival.form.universal and not first.form.universal), None)
        if universal is not None and not any(run.held_out.any() for run in bench.baseline.runs):
            # Of effects that these records cannot tell apart, and nothing else can, the one that every rig has.
            rivals = (replace(first, apart=universal.apart), *(rival for rival in rivals if rival is not universal))
            first, beside = universal, fit_jointly(bench, projector, universal.refit)
        alone = beside[-1].is_noise(beside[1]) and not model.is_noise(projector)
        if not beside[-1].determined(False, alone) or model.cost - beside[-1].cost < _LEFT_JOINTLY * drop:
            # Its strength is not determined, or what it explains is lost where all is fitted together.
            refused.add(first.name)
            refused_at_bound |= {first.name} if beside[-1].laws[-1].at_bound(beside[-1].x[-1]) else set()
            continue
        z = max(drop, 0.0) ** 0.5
        if family.p(z / sigma) >= false_alarm or z <= bars[first.form]:
            # It explains less than its score promised.
            refused.add(first.name)
            continue
        bench, projector, model = beside
        # What took this cause's place, at its bound, is asked about once more.
        refused, refused_at_bound = refused - refused_at_bound, set()
        candidates = [column for probe in probes for column in probe.signatures]
        afresh = relearn_noise(first_projector, projector, model, candidates) if again else None
        if afresh is not None:
            # The cause was taken for noise or roughness, too: all is asked again beside what there is of them.
            found = select(first_bench, afresh, probes, false_alarm, rng, progress, again - 1)
            if found.causes and is_smoothness_confirmed(found.projector, found.model):
                return found
            again = 0
        new = len(model.laws) - len(causes)
        causes += [Cause(first.name, z, family.p(z), rivals, drop / new)] * new
        left = rescore(score(projector, probes, model.residual), model.basis(), model.residual)
        family = Family(left, rng)
    causes, model = _backward(bench, projector, causes, model)
    explained = plain.cost - model.cost
    bench, projector, model, finest = refine(bench, projector, model)
    # One may have become unnecessary since.
    causes, model = _backward(bench, projector, causes, model)
    # In the end the density is smoother and nowhere negative, which costs something by itself.
    explained = max(explained, plain.cost - model.cost, 0.0)
    at = bench, projector, first_projector
    return Selection(tuple(causes), model, plain, scores, left, family, *at, explained, finest)


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
