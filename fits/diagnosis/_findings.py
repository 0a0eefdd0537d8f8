"""What was found, in the terms of its users: parameters with intervals, shares, and bounds of what was not found."""

from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from dataclasses import fields, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import stats

from fits.diagnosis._effects import Bench, Law
from fits.diagnosis._explanation import Cause, Selection
from fits.diagnosis._noise import Fault, Faults
from fits.diagnosis._prepare import Prepared
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, refit, refit_around
from fits.diagnosis._result import Bound, FoundCause
from fits.diagnosis._score import Scored, best_of
from fits.io._threads import map_in_threads
from fits.loop._result import ParameterEstimate
from fits.stage._encode import spec_of
from fits.stats._held import Held
from fits.stats._metrics import TWO_SIDED_95
from microid import Coordinates
from microid.effects import EFFECTS, AbstractEffect, Statistic, card_of

# Standard deviations from zero beyond which a run shows an effect.
_SHOWS = 2.0
# A class of effects that cannot be told apart names at most so many others.
MOST_RIVALS = 2
# The likelihood is profiled along a parameter that one standard deviation of its coordinate moves so many times as
# far to one side as to the other.
_NONLINEAR = 1.3
# The first step of a profile along the coordinate: steps double until the cost is high enough, and then halve the
# interval; how many at most, with coordinates up to which, and rounds in which all others are fitted again at each.
_STEP, _STEPS, _LARGEST, _ROUNDS = 0.5, 10, 30.0, 3
# A profile ends where the cost says so many standard deviations, within this factor.
_FAR_Z, _FAR_WITHIN = 3.0, 1.4


def causes_of(
    causes: Sequence[Cause],
    model: Refit,
    beside: Selection,
    explained: tuple[float, float],
    faults: Sequence[Fault],
    noise: Faults,
    has_time: Callable[[], bool] = lambda: True,
) -> tuple[FoundCause, ...]:
    """Describe the causes, the most important first: by what each removes of what all have `explained`.

    The latter are a part of the misfit, and a mean square in um^2. Intervals follow the likelihood as long as it
    `has_time`, and then its curvature.
    """
    found: dict[str, FoundCause] = {}
    weight: defaultdict[str, float] = defaultdict(float)
    bench, projector = beside.bench, beside.projector
    covariance, at = model.covariance(), 0
    interval_s = max(float(np.median(np.diff(one.run.record.time_s))) for one in bench.prepared)
    whole, beside_it = max(sum(cause.drop for cause in causes), 1e-300), {cause.name for cause in causes}
    for number, (cause, law, x) in enumerate(zip(causes, model.laws, model.x, strict=True)):
        block = covariance[at : at + law.size, at : at + law.size]
        at += law.size
        changed = bench.respond([[effect] for effect in law.effects(x)])
        alone = [a - b for a, b in zip(changed, bench.plain, strict=True)]
        joined = projector.join(alone)
        seen = float(np.linalg.norm(projector.off(joined)) / max(float(np.linalg.norm(joined)), 1e-300))
        rms_um, part = seen * _rms(alone, projector), cause.drop / whole
        share = part * explained[0]
        weight[cause.name] += part * explained[1]
        along = profile_likelihood(bench, projector, model, number, block, has_time)
        parameters = _parameters(law, x, block, along, interval_s)
        if cause.name in found:
            first, count = found[cause.name], [one.name for one in causes[: number + 1]].count(cause.name)
            more = (replace(one, name=f"{one.name}, number {count}") for one in parameters)
            share, rms_um = min(1.0, first.share_of_misfit + share), float(np.hypot(first.rms_um, rms_um))
            both = (*first.parameters, *more)
            found[cause.name] = replace(first, parameters=both, share_of_misfit=share, rms_um=rms_um)
            continue
        # What is named beside it is no alternative to it.
        rivals = tuple(rival.name for rival in cause.rivals[:MOST_RIVALS] if rival.name not in beside_it)
        named = described(law.form, rivals, cause.z, cause.p_family, parameters, share, rms_um)
        found[cause.name] = replace(named, given=_given(law.effects(x)[0]))
    forms: dict[Statistic, type[AbstractEffect]] = {form.statistic: form for form in EFFECTS if form.statistic}
    total = float(np.mean([n.total_um**2 for n in noise.noise]))
    for fault in faults:
        form = forms[fault.statistic]
        weight[form.name] = fault.variance_um2
        parameters = tuple(
            ParameterEstimate(name, unit, value, sd, value - TWO_SIDED_95 * sd, value + TWO_SIDED_95 * sd)
            for name, value, sd, unit in fault.parameters
        )
        chance, share = float(2 * stats.norm.sf(fault.z)), fault.variance_um2 / max(total, fault.variance_um2, 1e-300)
        found[form.name] = described(form, (), fault.z, chance, parameters, share, fault.variance_um2**0.5)
    return tuple(sorted(found.values(), key=lambda cause: -weight[cause.name]))


def with_held_gain(held: Held, causes: Sequence[FoundCause]) -> tuple[FoundCause, ...]:
    """Put the gain that a hold shows into the cause that shows there, ahead of the parameters of its fit."""
    out = []
    for cause in causes:
        if name := card_of(cause.name).held:
            low, high = (max(held.gain_per_decade + way * TWO_SIDED_95 * held.sd, 0.0) for way in (-1, 1))
            shown = ParameterEstimate(name, "1", held.gain_per_decade, held.sd, low, high)
            fitted = (replace(one, name=f"{one.name}, of the fit") for one in cause.parameters)
            cause = replace(cause, parameters=(shown, *fitted))
        out.append(cause)
    return tuple(out)


def described(
    form: type[AbstractEffect],
    rivals: tuple[str, ...],
    z: float,
    p: float,
    parameters: tuple[ParameterEstimate, ...],
    share: float,
    rms_um: float,
) -> FoundCause:
    """A cause with what its effect's card says of it."""
    card = form.fingerprint, form.experiment, form.source
    return FoundCause(form.name, form.form, rivals, float(z), p, parameters, float(min(1.0, share)), rms_um, *card)


def _given(effect: AbstractEffect) -> dict[str, float]:
    """Constants of an effect's law that are not fitted."""
    values = {one.name: getattr(effect, one.name) for one in fields(effect) if spec_of(one) is None}
    return {name: float(value) for name, value in values.items() if eqx.is_array(value) and value.ndim == 0}


def _rms(signal_um: Sequence[np.ndarray], projector: Projector) -> float:
    """Root mean square of a signal over the samples that count, in um."""
    square = sum(float(np.sum(s[mask] ** 2)) for s, mask in zip(signal_um, projector.masks, strict=True))
    return (square / projector.count) ** 0.5


def _parameters(
    law: Law,
    x: np.ndarray,
    covariance: np.ndarray,
    along: Sequence[tuple[float, np.ndarray]],
    interval_s: float,
) -> tuple[ParameterEstimate, ...]:
    """Values in their units: of each run in which the effect shows where runs differ, the others by their place.

    Intervals reach as far to either side as the profile `along` coordinates that are so many deviations away each;
    of what happens at once, no farther than to the next sample, at `interval_s`.
    """
    runs = len(law.maps) if law.form.per_run and law.each.any() else 1
    shared: list[ParameterEstimate] = []
    own: list[list[ParameterEstimate]] = []
    for run in range(runs):
        slope = np.zeros((len(law.places[run]), len(x)))
        slope[:, law.places[run]] = _slope(law.maps[run], jnp.asarray(law.vector(x, run)))
        values = law.values(x, run)
        sd = np.sqrt(np.maximum(np.diagonal(slope @ covariance @ slope.T), 0))
        below = above = sd
        for away, there in along:
            moved = law.values(there, run)
            below, above = np.maximum(below, (values - moved) / away), np.maximum(above, (moved - values) / away)
        mine: list[ParameterEstimate] = []
        for info, place in law.entries:
            differs = runs > 1 and info.path in law.form.strength
            # What went on before a run is no property of the rig.
            if info.path in law.form.history or (run and not differs):
                continue
            if law.form.rise and info.spec.unit == "s":
                # Between samples nothing shows of it.
                below[place], above[place] = np.minimum((below[place], above[place]), interval_s)
            for at in range(place.start, place.stop):
                name = info.path if place.stop - place.start == 1 else f"{info.path}[{at - place.start}]"
                value, less, more = float(values[at]), float(below[at]), float(above[at])
                low = max(value - TWO_SIDED_95 * less, info.spec.lower)
                high = min(value + TWO_SIDED_95 * more, info.spec.upper)
                name = f"{name} in run {run + 1}" if differs else name
                one = ParameterEstimate(name, info.spec.unit, value, max(less, more), low, high)
                (mine if differs else shared).append(one)
        own.append(mine)
    # At its bound a strength has no standard deviation to speak of: a run without the effect says nothing of it.
    showing = [mine for mine in own if any(abs(one.value) > _SHOWS * one.sd for one in mine)] or own
    return (*(one for mine in showing for one in mine), *shared)


def profile_likelihood(
    bench: Bench,
    projector: Projector,
    model: Refit,
    which: int,
    covariance: np.ndarray,
    has_time: Callable[[], bool] = lambda: True,
) -> list[tuple[float, np.ndarray]]:
    """Profile of the likelihood over nonlinear parameters of one law: coordinates, and how many deviations away.

    Where records hardly show a parameter, or one is near its bound, the sum of squares is no parabola, and the
    standard deviations of its curvature, `covariance` of shape `(size, size)`, promise too much. A distance is the
    root of what the place costs (Wilks, Annals of Mathematical Statistics 9 (1938) 60), but 3 if that is less.
    """
    law, x = model.laws[which], model.x[which]
    sd = np.sqrt(np.diagonal(covariance))
    nonlinear = [one for one in law.common.items() if _is_nonlinear(law, x, one[1], float(sd[one[1]]))]

    def profile(path: str, at: int, way: int) -> list[tuple[float, np.ndarray]]:
        return _profile_to(bench, projector, model, which, path, at, way, has_time)

    ways = [(path, at, way) for path, at in nonlinear for way in (-1, 1)]
    found = [end for ends in map_in_threads(profile, *zip(*ways, strict=True)) for end in ends] if ways else []
    lowest = min([model.cost, *(cost for cost, _ in found)])
    return [(max((cost - lowest) ** 0.5, _FAR_Z), there) for cost, there in found]


def _is_nonlinear(law: Law, x: np.ndarray, at: int, sd: float) -> bool:
    """Whether a parameter is far from proportional to its coordinate, within a standard deviation."""
    step = sd * (np.arange(len(x)) == at)
    below, here, above = (law.values(end, 0) for end in (x - step, x, x + step))
    less, more = float(np.abs(here - below).max()), float(np.abs(above - here).max())
    return max(less, more) > _NONLINEAR * min(less, more)


def _profile_to(
    bench: Bench,
    projector: Projector,
    model: Refit,
    which: int,
    path: str,
    at: int,
    way: int,
    has_time: Callable[[], bool],
) -> list[tuple[float, np.ndarray]]:
    """Costs and coordinates of a law with one held farther and farther to one side, and then less far again."""
    law, found = model.laws[which], list[tuple[float, np.ndarray]]()
    step, last, outside = _STEP, model, None
    inside = float(_coordinates(model, which, law)[at])
    for _ in range(_STEPS):
        if not has_time():
            break
        place = inside + way * step if outside is None else (inside + outside) / 2
        moved = np.array(_coordinates(last, which, law))
        moved[at] = place
        if law.size > 1:
            held = Law(law.effects(moved), law.remembers, (path,))
            there = refit(bench, projector, *last.with_law(which, held), _ROUNDS)
        else:
            there = refit_around(bench, projector, last, which, Law(law.effects(moved), law.remembers), _ROUNDS)
        found.append((there.cost, _coordinates(there, which, law)))
        away = max(there.cost - model.cost, 0.0) ** 0.5 / _FAR_Z
        if 1 / _FAR_WITHIN < away < _FAR_WITHIN:
            break
        if away > 1:
            outside = place
        elif abs(place) > _LARGEST:
            break
        else:
            inside, last, step = place, there, 2 * step
    return found


@eqx.filter_jit
def _slope(coordinates: Coordinates[AbstractEffect], vector: Float[Array, " k"]) -> Float[Array, "k k"]:
    return jax.jacfwd(coordinates.values)(vector)


def _coordinates(model: Refit, which: int, like: Law) -> np.ndarray:
    """Coordinates of one effect of a model, as in another law."""
    return Law(model.laws[which].effects(model.x[which]), like.remembers).start


def bounds(found: Selection, ready: Prepared, left: Sequence[Scored], named: Collection[str]) -> tuple[Bound, ...]:
    """How large each effect that was not named may still be, by the scores that are left."""
    out, blind = [], "the plain stage follows all of it in these runs, so that they cannot show it"
    for name, one in best_of(left).items():
        if name in named:
            continue
        if one.size == 0:
            out.append(Bound(name, 0.0, 1.0, np.nan, blind))
            continue
        # The largest multiple that would not have been noticed, by the size that it has in the displacement.
        raw = float(np.linalg.norm([_rms(column, found.first) for column in one.probe.signatures]))
        bound = (one.z + TWO_SIDED_95) / one.size * raw
        out.append(Bound(name, one.z, 1.0 - one.share_left, bound))
    asked = {bound.name for bound in out} | set(named)
    skipped = dict(ready.skipped).items()
    out += [Bound(name, np.nan, np.nan, np.nan, reason) for name, reason in skipped if name not in asked]
    return tuple(sorted(out, key=lambda bound: -bound.z if np.isfinite(bound.z) else 1e9))


def before_the_runs(model: Refit, least_z: float) -> list[str]:
    """Say of which causes only what moves before the runs left behind shows, and no strength in the runs."""
    return [
        f"{law.form.name.replace('_', ' ')}: what shows is what moves before the record have left behind; as the rig "
        "moved in the record itself, it may have none"
        for k, law in enumerate(model.laws)
        if law.remembers and model.strength_z(k) < least_z
    ]
