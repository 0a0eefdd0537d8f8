"""Causes in another form of the same effect, which may explain more once further causes are beside them."""

from collections.abc import Sequence

from fits.diagnosis._effects import Bench
from fits.diagnosis._joint_fit import State, fit_jointly
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, in_order, nothing, refit, refit_beside
from fits.diagnosis._score import Probe, score


def in_best_forms(bench: Bench, projector: Projector, model: Refit, probes: Sequence[Probe]) -> State:
    """The same causes, each in that form of its effect which explains most beside the others."""
    best = model
    for k in range(len(model.laws)):
        order = [*(i for i in range(len(best.laws)) if i != k), k]
        others = [one for one in probes if one.name == best.laws[k].form.name and one.form is not best.laws[k].form]
        if not others:
            continue
        laws, x = [best.laws[i] for i in order[:-1]], [best.x[i] for i in order[:-1]]
        fewer = refit(bench, projector, laws, x, 3) if laws else nothing(bench, projector)
        left = sorted(score(projector, others, fewer.residual, fewer.basis()).each, key=lambda one: one.z)
        # Of each form the best.
        for one in {scored.form: scored for scored in left}.values():
            found = in_order(refit_beside(bench, projector, fewer, one, best.cost), order)
            if found.criterion(projector.count) < best.criterion(projector.count):
                best = found
    return (bench, projector, model) if best is model else fit_jointly(bench, projector, best)
