"""What there is to be explained of a misfit, and which of the causes that were found are worth naming."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from fits.diagnosis._prepare import Prepared
from fits.diagnosis._refit import Refit, nothing, refit
from fits.diagnosis._residual_tests import explain_together, repeats_in, run_regressors
from fits.diagnosis._select import Selection
from fits.diagnosis._thresholds import THRESHOLDS, Thresholds
from fits.stats._compare import is_worse
from fits.stats._cycles import Cycles
from fits.stats._noise import Noise
from microid.effects import card_of


@dataclass(frozen=True)
class Misfit:
    """What causes explain of a residual and what structure is left, as sums of squares in noise variances.

    `freedom` is what chance gives the rest, and `count` the number of samples.
    """

    explained: float
    rest: float
    freedom: int
    count: int
    thresholds: Thresholds = THRESHOLDS

    @property
    def total(self) -> float:
        """What there is to be explained: the rest as far as it is beyond chance."""
        beyond = self.rest - self.freedom - self.thresholds.chance_z * (2 * self.freedom) ** 0.5
        return max(self.explained + max(beyond, 0.0), 1e-300)

    @property
    def share(self) -> float:
        """Part of it that the causes explain."""
        return self.explained / self.total

    @property
    def excess(self) -> float:
        """The rest without what chance gives it."""
        return max(self.rest - self.freedom, 0.0)

    @property
    def rest_noise(self) -> float:
        """Root mean square of the rest, in noise."""
        return (self.excess / self.count) ** 0.5

    @property
    def is_left_over(self) -> bool:
        """Whether the rest is of a size that matters, and no chance."""
        improbable = bool(stats.chi2.sf(self.rest, self.freedom) < self.thresholds.rest_chance)
        return improbable and self.rest_noise > self.thresholds.rest_noise

    def unnamed(self, weak: bool) -> tuple[float, bool]:
        """Root mean square of what is left in noise, and whether that counts, where none of the causes is named.

        What is beyond chance counts, however small it is, unless nearly all of the rest is of another kind.
        """
        rest = (max(self.explained + self.excess, 0.0) / self.count) ** 0.5
        return rest, rest > self.thresholds.rest_noise or not (weak or self.share < self.thresholds.minor_share)


def _in_noise(found: Selection, noise: tuple[Noise, ...]) -> Selection:
    """What was found, in units of other noise."""
    first, now = (one.beside(noise) for one in (found.first, found.projector))
    plain = nothing(found.bench, first)
    model = refit(found.bench, now, found.model.laws, found.model.x, 2) if found.causes else plain
    explained = max(plain.cost - model.cost, 0.0)
    return replace(found, first=first, projector=now, plain=plain, model=model, explained=explained)


def worth_naming(
    ready: Prepared, found: Selection, noise: tuple[Noise, ...], rounded: bool
) -> tuple[Selection, Selection, Misfit, Cycles, list[str]]:
    """Leave out causes that are not worth naming beside the others, the worst first.

    They make predictions of what was held out worse, or explain a minor share of what the others leave: what explains
    the rest may explain that. Returns what was found, the same in the given noise, and what is said of causes that
    were left out.
    """
    said: list[str] = []
    thresholds = ready.reading.thresholds
    while True:
        told = _in_noise(found, noise)
        misfit, repeated = _misfit(ready, told, rounded)
        names = [cause.name for cause in found.causes]
        after = told.projector.held_out(told.model.change_um)
        parts: dict[str, tuple[float, list[int]]] = {}
        for name in {*names} if len({*names}) > 1 else ():
            kept = [k for k, other in enumerate(names) if other != name]
            fewer = _refit_of(told, kept, 2)
            part = replace(misfit, explained=fewer.cost - told.model.cost).share
            before = told.projector.held_out(fewer.change_um)
            if is_worse(before, after, thresholds.worse_z, thresholds.model_error):
                part = -float(np.sum(after**2) - np.sum(before**2))
            if part < 0 or (not card_of(name).independent and part < thresholds.minor_share):
                parts[name] = part, kept
        if not parts:
            return found, told, misfit, repeated, said
        name, (part, kept) = min(parts.items(), key=lambda item: item[1][0])
        why = "what was held out is predicted worse with it than with the other causes alone"
        if part >= 0:
            share = f"{100 * part:.0f} % of what the other causes leave"
            why = f"it would explain {share}, and what makes the rest may look like that"
        said.append(f"{name.replace('_', ' ')} is not named: {why}")
        found = replace(found, causes=tuple(found.causes[k] for k in kept), model=_refit_of(found, kept, 3))


def _refit_of(found: Selection, kept: Sequence[int], rounds: int) -> Refit:
    """Some of the laws fitted anew."""
    laws, x = zip(*((found.model.laws[k], found.model.x[k]) for k in kept), strict=True)
    return refit(found.bench, found.projector, laws, x, rounds)


def _misfit(ready: Prepared, found: Selection, rounded: bool) -> tuple[Misfit, Cycles]:
    """What there is to be explained, and what repeats itself with the position, which counts unless `rounded`."""
    regressors = run_regressors(ready.baseline.runs, ready.bench.plain)
    rest, freedom = explain_together(found.projector, found.model.basis(), found.model.residual, regressors)
    repeated = repeats_in(found.projector, found.model.residual, ready.bench.plain)
    rest = max(rest, 0.0 if rounded else repeated.drop)
    return Misfit(found.explained, rest, freedom, found.first.count, ready.reading.thresholds), repeated
