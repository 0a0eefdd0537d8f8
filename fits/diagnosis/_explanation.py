"""Explanations: sets of causes fitted to each other, and which of them the records bear out best."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.diagnosis._comparison import Rival, confusable_z, gain_ahead, model_error
from fits.diagnosis._effects import Bench
from fits.diagnosis._joint_fit import State
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, nothing
from fits.diagnosis._residual_tests import period_of, repeats_in
from fits.diagnosis._score import Family, Probe, Scored, applicable, probes_of, scales_of, score
from fits.diagnosis._thresholds import Thresholds
from fits.stage._solve import Problem
from fits.stats._compare import is_worse
from fits.stats._noise import quantum_um
from microid.effects import EFFECTS, card_of

# The farthest that a standard deviation in coordinates is taken at its word.
_FARTHEST = 3.0


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

    @property
    def left_um(self) -> float:
        """What the plain stage leaves, root mean square."""
        return self.first.unit_um(self.plain.residual) * (self.plain.cost / self.first.count) ** 0.5

    def plain_instead(self, thresholds: Thresholds) -> Problem | None:
        """Where the plain stage is, if it has gone there beside effects that explain little at that place."""
        baseline = self.projector.regression.baseline
        if not self.causes or baseline.problem is None:
            return None
        there = nothing(self.bench, self.projector).cost
        if there - self.model.cost > thresholds.minor_share * (self.plain.cost - self.model.cost):
            return None
        return replace(baseline.problem, z=baseline.z, columns_um=baseline.columns_um)


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

    def beside(self, bench: Bench, projector: Projector, model: Refit) -> tuple[Probe, ...]:
        """All probes beside a model, those of a period in the position where its effects put that."""
        taken = {law.form.name for law in model.laws}
        forms = [form for form in EFFECTS if form.origin and form.name not in taken]
        forms = [form for form in forms if taken and applicable(bench.baseline, form) is None]
        if not forms:
            return self.probes
        readings_um = [run.displacement_um for run in bench.baseline.runs]
        left = projector.residual - projector.join(model.change_um)
        found = period_of(
            repeats_in(projector, projector.off(left), readings_um),
            max(map(quantum_um, readings_um)),
            self.thresholds,
        )
        if found is None:
            return self.probes
        # Where the stage goes beside these effects, and not without.
        there = Bench(projector.move(left), model.change_um)
        scales = scales_of(there, min(noise.total_um for noise in projector.noise), found)
        have = [model.effects(run) for run in range(len(readings_um))]
        more = [probe for form in forms for probe in probes_of(there, form, scales, None, have)]
        return (*(probe for probe in self.probes if probe.form not in forms), *more)


@dataclass(frozen=True)
class Explanation:
    """A set of causes, and baseline and causes fitted to each other.

    `left` are the scores beside them, and `held_out` the errors in what was held out, in noise, shape `(n,)`. The
    smaller the `criterion`, the better; `promise` is what the best further cause would leave of it.
    """

    causes: tuple[Cause, ...]
    bench: Bench
    projector: Projector
    model: Refit
    left: tuple[Scored, ...]
    family: Family
    criterion: float
    promise: float
    held_out: np.ndarray

    @classmethod
    def of(cls, causes: Sequence[Cause], state: State, search: Search) -> "Explanation":
        """Ask for all effects beside these causes."""
        bench, projector, model = state
        scores = score(projector, search.beside(bench, projector, model), model.residual, model.basis())
        names, explained = {cause.name for cause in causes}, search.plain.cost - model.cost
        ahead = gain_ahead(scores.each, names, explained, search.thresholds)
        held = projector.held_out(model.change_um)
        left = model.criterion(projector.count) + projector.surprise(held)
        if causes:
            projector.release()
        family = Family(scores, search.rng)
        return cls(tuple(causes), bench, projector, model, scores.each, family, left, left - ahead, held)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the causes, in the order in which they were found, each once."""
        return tuple(dict.fromkeys(cause.name for cause in self.causes))

    def modelled(self, plain: Refit) -> float:
        """Decrease of the sum of squares by causes that others may be mistaken for, as their models are not exact."""
        independent = sum(cause.drop for cause in self.causes if card_of(cause.name).independent)
        return max(plain.cost - self.model.cost - independent, 0.0)

    @property
    def near_bound(self) -> bool:
        """Whether a cause may, within a standard deviation, be as large as such an effect can be."""
        sd = np.minimum(np.sqrt(np.diagonal(self.model.covariance(robust=False))), _FARTHEST)
        each = np.split(sd, np.cumsum([law.size for law in self.model.laws], dtype=int))[:-1]
        moved = zip(self.model.laws, self.model.x, each, strict=True)
        return any(law.at_bound(x + way * own) for law, x, own in moved for way in (-1, 0, 1))


def best_of_ends(ends: Sequence[Explanation], plain: Refit, thresholds: Thresholds) -> Explanation:
    """The explanation of the smallest criterion.

    Of those that are not told apart by that, one with no cause near a bound, and that predicts what was held out no
    worse than another.
    """
    ends = [one for one in ends if not any(_adds_little(one, other, plain, thresholds) for other in ends)]
    first = min(ends, key=lambda one: one.criterion)
    most = first.criterion + confusable_z(first.modelled(plain), thresholds) ** 2
    near = [one for one in ends if one.criterion <= most]

    def is_outdone(one: Explanation) -> bool:
        return any(
            is_worse(other.held_out, one.held_out, thresholds.worse_z, thresholds.model_error) for other in near
        )

    return min(near, key=lambda one: (one.near_bound, is_outdone(one), one.criterion))


def _adds_little(one: Explanation, other: Explanation, plain: Refit, thresholds: Thresholds) -> bool:
    """Whether one has the causes of another and some that explain no more than the models of those are off by."""
    if not other.causes or not set(other.names) < set(one.names):
        return False
    further = set(one.names) - set(other.names)
    alike = {*other.names}.union(*(cause.behind for cause in other.causes))
    off = max(model_error(name, alike, thresholds) for name in further)
    return other.model.cost - one.model.cost <= off**2 * other.modelled(plain)


def with_equals(best: Explanation, ends: Sequence[Explanation], thresholds: Thresholds, plain: Refit) -> Explanation:
    """The best, and with each of its causes the effects that explain as much in its place in the end.

    Those that explain less there, whatever was put beside them, are none of them.
    """
    least = best.criterion + confusable_z(best.modelled(plain), thresholds) ** 2
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
