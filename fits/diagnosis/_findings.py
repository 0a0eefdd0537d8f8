"""What was found, in the terms of its users: parameters with intervals, shares, and bounds of what was not found."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import stats

from fits.diagnosis._candidates import Bench
from fits.diagnosis._comparison import best_of
from fits.diagnosis._faults import Fault, Faults
from fits.diagnosis._law import Law
from fits.diagnosis._profiled import profiled
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit
from fits.diagnosis._result import Bound, EffectParameter, FoundCause
from fits.diagnosis._score import Scored
from fits.diagnosis._select import Cause, Selection
from microid import EFFECTS

if TYPE_CHECKING:
    from fits.diagnosis._prepare import Prepared

_TWO_SIDED = 1.96
# Standard deviations from zero beyond which a run shows an effect.
_SHOWS = 2.0
# A class of effects that cannot be told apart names at most so many others.
_OTHERS = 2


def causes_of(
    causes: Sequence[Cause],
    model: Refit,
    projector: Projector,
    bench: Bench,
    misfit: float,
    faults: Sequence[Fault],
    noise: Faults,
) -> tuple[FoundCause, ...]:
    """Describe the causes, the most important first: by the misfit that each removes."""
    found: list[FoundCause] = []
    weight: dict[str, float] = {}
    told: dict[str, int] = {}
    covariance, at = model.covariance(), 0
    total = float(np.mean([n.total_um**2 for n in projector.noise]))
    runs = len(bench.prepared)
    for number, (cause, law, x) in enumerate(zip(causes, model.laws, model.x, strict=True)):
        own = covariance[at : at + law.size, at : at + law.size]
        at += law.size
        form = law.form
        changed = [[law.effect(x, run)] for run in range(runs)]
        alone = [a - b for a, b in zip(bench.respond(changed), bench.plain, strict=True)]
        joined = projector.join(alone)
        seen = float(np.linalg.norm(projector.off(joined)) / max(float(np.linalg.norm(joined)), 1e-300))
        rms = seen * _rms(alone, projector)
        told[cause.name] = count = told.get(cause.name, 0) + 1
        weight[cause.name] = weight.get(cause.name, 0.0) + cause.drop / projector.count * total
        along = profiled(bench, projector, model, number, own)
        parameters = _parameters(law, x, own, along)
        if count > 1:
            again = next(k for k, one in enumerate(found) if one.name == cause.name)
            found[again] = _joined(found[again], parameters, count, cause.drop / misfit, rms)
            continue
        found.append(
            FoundCause(
                cause.name,
                form.form,
                tuple(rival.name for rival in cause.rivals[:_OTHERS]),
                cause.z,
                cause.p_family,
                parameters,
                float(min(1.0, cause.drop / misfit)),
                rms,
                form.fingerprint,
                form.experiment,
                form.source,
            )
        )
    by_name = {form.name: form for form in EFFECTS}
    total = float(np.mean([n.total_um**2 for n in noise.noise]))
    for fault in faults:
        form = by_name[fault.name]
        weight[fault.name] = fault.variance_um2
        parameters = tuple(
            EffectParameter(name, value, sd, unit, value - _TWO_SIDED * sd, value + _TWO_SIDED * sd)
            for name, value, sd, unit in fault.parameters
        )
        found.append(
            FoundCause(
                fault.name,
                form.form,
                (),
                float(fault.z),
                float(2 * stats.norm.sf(fault.z)),
                parameters,
                float(min(1.0, fault.variance_um2 / max(total, fault.variance_um2, 1e-300))),
                fault.variance_um2**0.5,
                form.fingerprint,
                form.experiment,
                form.source,
            )
        )
    return tuple(sorted(found, key=lambda cause: -weight[cause.name]))


def _rms(signal_um: Sequence[np.ndarray], projector: Projector) -> float:
    """Root mean square of a signal over the samples that count, in um."""
    square = sum(float(np.sum(s[mask] ** 2)) for s, mask in zip(signal_um, projector.masks, strict=True))
    return (square / projector.count) ** 0.5


def _joined(
    first: FoundCause, more: Sequence[EffectParameter], count: int, share: float, rms_um: float
) -> FoundCause:
    """One cause for several of its kind."""
    return replace(
        first,
        parameters=(*first.parameters, *(replace(one, name=f"{one.name}, number {count}") for one in more)),
        share_of_misfit=float(min(1.0, first.share_of_misfit + share)),
        rms_um=float(np.hypot(first.rms_um, rms_um)),
    )


def _parameters(
    law: Law, x: np.ndarray, covariance: np.ndarray, along: Sequence[tuple[float, np.ndarray]]
) -> tuple[EffectParameter, ...]:
    """Values in their units: of each run in which the effect shows where runs differ, the others by their place.

    They reach as far, to either side, as the coordinates `along` which the law was followed, each so many standard
    deviations away.
    """
    runs = len(law.maps) if law.form.per_run and law.each.any() else 1
    shared: list[EffectParameter] = []
    own: list[list[EffectParameter]] = []
    for run in range(runs):
        slope = np.asarray(jax.jacfwd(lambda v, run=run: law.maps[run].values(_vector(law, v, run)))(jnp.asarray(x)))
        values = np.asarray(law.maps[run].values(jnp.asarray(law.vector(x, run))))
        sd = np.sqrt(np.maximum(np.diagonal(slope @ covariance @ slope.T), 0))
        below = above = sd
        for away, there in along:
            moved = np.asarray(law.maps[run].values(jnp.asarray(law.vector(there, run))))
            below, above = np.maximum(below, (values - moved) / away), np.maximum(above, (moved - values) / away)
        at, mine = 0, []
        for info in law.maps[run].table:
            size = int(np.prod(info.shape)) if info.shape else 1
            differs = runs > 1 and info.path in law.form.strength
            # What went on before a run is no property of the rig.
            for k in range(size if info.path not in law.form.history else 0):
                name = info.path if size == 1 else f"{info.path}[{k}]"
                value, less, more = float(values[at + k]), float(below[at + k]), float(above[at + k])
                low, high = value - _TWO_SIDED * less, value + _TWO_SIDED * more
                one = EffectParameter(
                    f"{name} in run {run + 1}" if differs else name,
                    value,
                    max(less, more),
                    info.spec.unit,
                    max(low, info.spec.lower),
                    min(high, info.spec.upper),
                )
                if differs:
                    mine.append(one)
                elif run == 0:
                    shared.append(one)
            at += size
        own.append(mine)
    # At its bound a strength has no standard deviation to speak of: a run without the effect says nothing of it.
    showing = [mine for mine in own if any(abs(one.value) > _SHOWS * one.sd for one in mine)] or own
    return (*(one for mine in showing for one in mine), *shared)


def _vector(law: Law, x: Float[Array, " k"], run: int) -> Float[Array, " c"]:
    if not law.each.any():
        return x
    shared, own = int(np.sum(~law.each)), int(np.sum(law.each))
    full = jnp.zeros(len(law.each))
    full = full.at[np.flatnonzero(~law.each)].set(x[:shared])
    return full.at[np.flatnonzero(law.each)].set(x[shared + run * own : shared + (run + 1) * own])


def bounds(found: Selection, ready: "Prepared", left: Sequence[Scored], named: Collection[str]) -> tuple[Bound, ...]:
    """How large each effect that was not named may still be, by the scores that are left."""
    out = []
    for name, one in best_of(left).items():
        if name in named:
            continue
        size = float(np.linalg.norm(one.columns))
        if size == 0:
            reason = "the plain stage follows all of it in these runs, so that they cannot show it"
            out.append(Bound(name, 0.0, 1.0, float("nan"), reason))
            continue
        # The largest multiple that would not have been noticed, by the size that it has in the displacement.
        raw = float(np.linalg.norm([_rms(column, found.first) for column in one.probe.signatures]))
        bound = (one.z + _TWO_SIDED) / size * raw
        out.append(Bound(name, one.z, 1.0 - one.share_left, bound))
    asked = {bound.name for bound in out} | set(named)
    for name, reason in dict(ready.skipped).items():
        if name not in asked:
            out.append(Bound(name, float("nan"), float("nan"), float("nan"), reason))
    return tuple(sorted(out, key=lambda bound: -bound.z if np.isfinite(bound.z) else 1e9))
