"""What happens in a run at an instant, once or several times: a loss of samples, a jump of the zero."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from fits.diagnosis._effects import Bench, Law
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, refit, refit_beside
from fits.diagnosis._relocate import relocate
from fits.diagnosis._score import Scored, score
from fits.diagnosis._thresholds import Thresholds

# Part of a record, at its start and its end, in which nothing is said to happen in it; what takes longer than that is
# a drift.
_INSIDE = 0.02


def is_occurrence(law: Law) -> bool:
    """Whether it is one of several things that may happen in a run, each at an instant."""
    return law.form.repeats and "after_s" in law.form.__dataclass_fields__


def has_occurred(bench: Bench, model: Refit, place: int = -1) -> bool:
    """Whether what happens at an instant does so in some run, for a law: what is counted nearer to once than never.

    It must happen inside that run: what goes on from the first samples is a lag or an offset of the whole run.
    """
    law, x = model.laws[place], model.x[place]
    found = not is_occurrence(law)
    for run, one in enumerate(bench.prepared):
        interval_s, duration_s = float(np.median(np.diff(one.run.record.time_s))), one.run.record.duration_s
        effect: Any = law.effect(x, run)
        if not found:
            inside = _INSIDE * duration_s < float(effect.after_s) < (1 - _INSIDE) * duration_s
            counted = law.form.counted
            once = not counted or any(abs(float(getattr(effect, name))) > interval_s / 2 for name in counted)
            found = inside and once
    return found


def is_abrupt(bench: Bench, projector: Projector, model: Refit, thresholds: Thresholds) -> bool:
    """Whether the last effect explains more than if it took a while, where it is one that happens at once."""
    name = model.laws[-1].form.rise
    if not name:
        return True

    def left(spread: bool) -> float:
        change = []
        for run, (one, plain) in enumerate(zip(bench.prepared, bench.plain, strict=True)):
            *others, last = model.effects(run)
            took_s, longer_s = float(getattr(last, name)), _INSIDE * one.run.record.duration_s
            if spread and longer_s > took_s:
                # About the same middle.
                begun: Any = last.after_s - (longer_s - took_s) / 2  # type: ignore[attr-defined]
                last = replace(last, **{name: jnp.asarray(longer_s), "after_s": begun})
            change.append(bench.respond_in(run, [*others, last]) - plain)
        residual = projector.off(projector.residual - projector.join(change))
        return float(residual @ residual)

    # What is beyond noise may be anything, and differs by as much more.
    at_once = left(False)
    return left(True) > at_once + thresholds.chance_z**2 * max(at_once / projector.count, 1.0)


def add_occurrences(
    bench: Bench,
    projector: Projector,
    model: Refit,
    found: Refit,
    scored: Sequence[Scored],
    most: int,
    enough: float,
    thresholds: Thresholds,
) -> Refit:
    """Add occurrences of what happens at an instant while that pays, so that there are so many laws at most.

    Several losses look like a drift, which has to be told from them. Of what jumps one is added for each other run:
    many jumps follow anything, and more are asked for beside other effects. `scored` are all of these: where another
    explains more of the rest than one more jump, that is asked first. None is added where all that may be, each
    explaining as much as the last, would leave more than is `enough`; the `model` is without any.
    """
    first, form, gain = len(found.laws) - 1, found.laws[-1].form, model.cost - found.cost
    own = [one for one in scored if one.name == form.name]
    if not form.counted:
        most = min(most, first + len(bench.prepared))
    while is_occurrence(found.laws[-1]) and len(found.laws) < most:
        if found.cost - gain * (most - len(found.laws)) > enough:
            break
        asked = [one.probe for one in (own if form.counted else scored)]
        best = max(score(projector, asked, found.residual, found.basis()).each, key=lambda one: one.z)
        if best.name != form.name:
            break
        more = _one_more(bench, projector, found, own)
        if not (more.determined(thresholds.chance_z) and has_occurred(bench, more)):
            break
        if not is_abrupt(bench, projector, more, thresholds):
            break
        if more.criterion(projector.count) > found.criterion(projector.count) - thresholds.tie:
            break
        for _ in range(first, len(more.laws) if form.counted else first):
            # Alone it stood for all of them: each in turn is put where the others leave most.
            laws, x = ([*one[:first], *one[first + 1 :]] for one in (more.laws, more.x))
            moved = _one_more(bench, projector, refit(bench, projector, laws, x, 4), own)
            more = min(more, moved, key=lambda one: one.cost)
        more = relocate(bench, projector, more, first) if form.counted else more
        found, gain = more, found.cost - more.cost
    return found


def _one_more(bench: Bench, projector: Projector, model: Refit, scored: Sequence[Scored]) -> Refit:
    left = score(projector, [one.probe for one in scored], model.residual, model.basis()).each
    more = refit_beside(bench, projector, model, max(left, key=lambda one: one.z))
    return relocate(bench, projector, more, len(model.laws))
