"""Other instants of what happened at one, which a fit's small steps do not reach."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from fits.diagnosis._effects import Bench, Law
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, fit_laws, in_order, refit

# Part of the shortest record by which another instant is tried at first, and how often others are tried.
_FIRST_SHIFT, _MOVES = 0.05, 24
# Gain in chi-square that pays, and the part of what is beyond noise.
_PAYS, _PART = 1.0, 0.01


def relocate(bench: Bench, projector: Projector, model: Refit, first: int = 0) -> Refit:
    """Search for better instants of what happened at one, beyond a fit's steps, in laws from the `first` on.

    The sum of squares over the instant is jagged where the stage rings, and a rise that is too long keeps to itself:
    better ones are tried on both sides, nearer and nearer, and in the middle of a rise.
    """
    at = [k for k in range(first, len(model.laws)) if hasattr(model.laws[k].effect(model.x[k], 0), "after_s")]
    if not at:
        return model
    # So far some may only have been followed along their tangent, or beside another baseline.
    model = refit(bench, projector, model.laws, model.x, 2)
    step_s = _FIRST_SHIFT * min(one.run.record.duration_s for one in bench.prepared)
    least_s = min(float(np.median(np.diff(one.run.record.time_s))) for one in bench.prepared)
    for _ in range(_MOVES):
        if step_s <= least_s:
            break
        ways = [(k, way) for k in at for way in (-step_s, *[0.0] * bool(model.laws[k].form.rise), step_s)]
        tried = [_moved(bench, projector, model, k, way, least_s) for k, way in ways]
        best = min(tried, key=lambda one: one.cost)
        better = refit(bench, projector, best.laws, best.x, 2) if best.cost < model.cost else model
        # Where other coordinates still creep, any step would seem to pay.
        pays = max(_PAYS, _PART * (model.cost - projector.count))
        step_s = step_s if better.cost < model.cost - pays else step_s / 2
        model = min(better, model, key=lambda one: one.cost)
    return model


def _moved(bench: Bench, projector: Projector, model: Refit, k: int, way_s: float, least_s: float) -> Refit:
    """Fit a law at another instant, and at once from there; all others stay, and follow along their tangent."""
    here: list[Any] = [model.laws[k].effect(model.x[k], run) for run in range(len(bench.prepared))]
    if rise := model.laws[k].form.rise:
        at_once, half_s = {rise: jnp.asarray(least_s)}, [float(getattr(one, rise) - least_s) / 2 for one in here]
        here = [replace(one, after_s=one.after_s + more, **at_once) for one, more in zip(here, half_s, strict=True)]
    later = [replace(one, after_s=jnp.maximum(one.after_s + way_s, least_s)) for one in here]
    laws, x = model.with_law(k, Law(later, model.laws[k].remembers))
    order = [*(i for i in range(len(laws)) if i != k), k]
    owner = np.repeat(np.arange(len(laws)), [law.size for law in model.laws])
    basis = replace(model, tangent=model.tangent[:, owner != k]).basis()
    ordered = [laws[i] for i in order], [x[i] for i in order]
    # What is no better after the first round is not followed.
    found = fit_laws(bench, projector, *ordered, len(laws) - 1, basis, 2, model.cost)
    return in_order(found, order)
