"""What there is to be explained of a misfit, and which of the causes that were found are worth naming."""

from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from fits.diagnosis._explanation import Selection
from fits.diagnosis._noise import Faults, find_faults
from fits.diagnosis._prepare import Prepared
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, nothing, refit
from fits.diagnosis._residual_tests import explain_together, is_flicker, repeats_in, run_regressors
from fits.diagnosis._thresholds import THRESHOLDS, Thresholds
from fits.io._length import length
from fits.stats._compare import improvement_z, is_worse
from fits.stats._cycles import Cycles
from fits.stats._noise import Noise
from fits.stats._score_test import standard_deviations
from microid.effects import card_of

_WANDERS = (
    "the readings wander by {} beyond that noise, and with nothing that the rig did, as flicker noise of the sensor "
    "or of its surroundings does, whose power falls as one over the frequency"
)
# A share below this is hardly any.
SHOWN = 0.005


@dataclass(frozen=True)
class Misfit:
    """What causes explain of a residual and what structure is left, as sums of squares in noise variances.

    `freedom` is what chance gives the rest, and `count` the number of samples. What is no rest is `wander`, flicker
    noise of that root mean square, in noise; with no cause named, all is where the whole `wanders`.
    """

    explained: float
    rest: float
    freedom: int
    count: int
    thresholds: Thresholds = THRESHOLDS
    wander: float = 0.0
    wanders: bool = False

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
        if self.wanders:
            return rest, False
        return rest, rest > self.thresholds.rest_noise or not (weak or self.share < self.thresholds.minor_share)


def faults_beside(ready: Prepared, found: Selection) -> tuple[Selection, Faults, Faults]:
    """What was found, without bad samples that show beside it; faults beside it, and with none of it named."""
    thresholds, projector, before = ready.reading.thresholds, found.projector, ready.faults
    faults = find_faults(projector.regression, found.model.change_um, thresholds, projector.roughness)
    if not found.causes:
        # What a density explains that is rougher than its grid is no band.
        quiet = before if before.lines_um else replace(before, band=faults.band)
        return found, quiet, quiet
    beside = faults.beside(before)
    if beside.count > before.count or faults.lines_um:
        found = _anew(found, *(p.with_readings_less(faults.wrong_um) for p in (found.first, found.projector)))
    return found, beside, before


def _anew(found: Selection, first: Projector, now: Projector) -> Selection:
    """What was found, beside other noise or in other readings."""
    plain = nothing(found.bench, first)
    model = refit(found.bench, now, found.model.laws, found.model.x, 2) if found.causes else plain
    explained = max(plain.cost - model.cost, 0.0)
    return replace(found, first=first, projector=now, plain=plain, model=model, explained=explained)


def _in_noise(found: Selection, noise: tuple[Noise, ...]) -> Selection:
    """What was found, in units of other noise."""
    first = found.first.beside(noise)
    # Where all causes were left out, nothing was learnt beside them.
    return _anew(found, first, found.projector.beside(noise) if found.causes else first)


def worth_naming(
    ready: Prepared, found: Selection, noise: tuple[Noise, ...], rounded: bool
) -> tuple[Selection, Selection, Misfit, Cycles, list[str]]:
    """Leave out causes that are not worth naming beside the others, the worst first.

    Their strength may be none, they make predictions of what was held out worse, or are small and make them no
    better, are in some runs and not in others though they depend on no command, or explain a minor share of what the
    others leave: what explains the rest may explain that.
    Returns what was found, the same in the given noise, and what is said of causes that were left out.
    """
    said: list[str] = []
    while True:
        told = _in_noise(found, noise)
        misfit, repeated = _misfit(ready, told, rounded)
        doubts = [_doubt(told, name, misfit) for name in {cause.name: None for cause in found.causes}]
        if not any(doubts):
            if misfit.wander:
                said.append(_WANDERS.format(length(misfit.wander * told.first.unit_um(told.plain.residual))))
            return found, told, misfit, repeated, said
        _, name, why = min(filter(None, doubts))
        said.append(f"{name.replace('_', ' ')} is not named: {why}")
        others = tuple(cause for cause in found.causes if cause.name != name)
        found = replace(found, causes=others, model=_without(found, name))


def _doubt(found: Selection, name: str, misfit: Misfit) -> tuple[float, str, str] | None:
    """Why a cause is not worth naming beside the others, and how much so, the least first; None where it is."""
    thresholds, alone = misfit.thresholds, all(cause.name == name for cause in found.causes)
    card = card_of(name)
    laws = [k for k, cause in enumerate(found.causes) if cause.name == name]
    strength_z = max(map(found.model.strength_z, laws))
    if card.independent and not found.model.in_each_run(laws, thresholds.minor_share, thresholds.apart_z):
        return -np.inf, name, "it would be in some runs and not in others, and what depends on no command is in all"
    fewer = _without(found, name)
    explained = fewer.cost - found.model.cost
    # A hum has another phase in the next run, and nothing else is like it.
    small = explained < thresholds.rest_noise**2 * misfit.count and not card.independent
    apart_z = float(standard_deviations(explained, sum(found.model.laws[k].size for k in laws)))
    if alone and strength_z >= 1 and (not small or apart_z > thresholds.strong_z):
        return None
    before, after = (found.projector.held_out(model.change_um) for model in (fewer, found.model))
    better_z = improvement_z(before, after)
    if strength_z < 1 and better_z < thresholds.worse_z:
        return -np.inf, name, "its strength may be none, and nothing that was held out is predicted better with it"
    if not alone and is_worse(before, after, thresholds.worse_z, thresholds.model_error):
        worse = float(np.sum(after**2) - np.sum(before**2))
        return -worse, name, "what was held out is predicted worse with it than with the other causes alone"
    if small and better_z < thresholds.worse_z:
        why = "it is small beside the noise, and nothing that was held out is predicted better with it"
        return -1 / max(explained, 1e-300), name, why
    if alone:
        return None
    if small and apart_z < thresholds.apart_z:
        why = "it is small beside the noise, and the other causes alone explain as much, but for chance"
        return -1 / max(explained, 1e-300), name, why
    # Beside a rest of another kind any evidence looks large; of what one run had of its own others say nothing.
    alike = misfit.is_left_over and not (card.independent or card.per_run)
    if alike and better_z < thresholds.worse_z / 2:
        why = (
            "something else is left, and what was held out is predicted no better with it than with the other causes"
        )
        return -1 / max(explained, 1e-300), name, why
    part = replace(misfit, explained=explained).share
    # What comes as often as it may follows a part of anything.
    least = thresholds.explained_share if misfit.is_left_over and card.repeats else thresholds.minor_share
    if card.independent or part >= least:
        return None
    share = f"{100 * part:.0f} %" if part > SHOWN else "hardly any"
    return (
        part,
        name,
        f"it would explain {share} of what the other causes leave, and what makes the rest may look like that",
    )


def _without(found: Selection, name: str) -> Refit:
    """The other laws fitted anew."""
    kept = [k for k, cause in enumerate(found.causes) if cause.name != name]
    laws, x = [found.model.laws[k] for k in kept], [found.model.x[k] for k in kept]
    return refit(found.bench, found.projector, laws, x, 3) if kept else nothing(found.bench, found.projector)


def _misfit(ready: Prepared, found: Selection, rounded: bool) -> tuple[Misfit, Cycles]:
    """What there is to be explained, and what repeats itself with the position, which counts unless `rounded`."""
    regressors = run_regressors(ready.baseline.runs, ready.bench.plain)
    rest, freedom = explain_together(found.projector, found.model.basis(), found.model.residual, regressors)
    repeated = repeats_in(found.projector, found.model.residual, ready.bench.plain)
    rest = max(rest, 0.0 if rounded else repeated.drop)
    misfit = Misfit(found.explained, rest, freedom, found.first.count, ready.reading.thresholds)
    left = found.projector, found.model.basis(), found.model.residual
    if misfit.is_left_over and is_flicker(*left, regressors, misfit.thresholds):
        plain = found.first, np.zeros((len(found.plain.residual), 0)), found.plain.residual
        wanders = is_flicker(*plain, regressors, misfit.thresholds)
        misfit = replace(misfit, rest=float(freedom), wander=misfit.rest_noise, wanders=wanders)
    return misfit, repeated
