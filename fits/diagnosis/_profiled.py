"""How far the parameters of a cause may be off where the records hardly show one of them, as a time constant.

There the sum of squares is no parabola, and the standard deviations of its curvature promise too much.
"""

import numpy as np

from fits.diagnosis._candidates import Bench
from fits.diagnosis._law import Law
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, refit

# Standard deviation of a coordinate, in e-folds, from which on the sum of squares is followed along it: by such
# steps, so many of them at most to either side, all other coordinates fitted again in so many rounds.
_LOOSE, _STEP, _STEPS, _ROUNDS = 0.3, 0.5, 10, 3
# Standard deviations up to which it may do what it likes: a place that costs less is as far away.
_FAR = 3.0


def profiled(
    bench: Bench, projector: Projector, model: Refit, which: int, covariance: np.ndarray
) -> list[tuple[float, np.ndarray]]:
    """Coordinates of one law of a model along its loose ones, each with its distance in standard deviations.

    That is the root of what it costs (Wilks, Annals of Mathematical Statistics 9 (1938) 60), but 3 if that is less.

    Parameters
    ----------
    which
        Number of the law.
    covariance
        Of its coordinates, shape `(size, size)`.
    """
    law = model.laws[which]
    sd = np.sqrt(np.diagonal(covariance))
    found: list[tuple[float, np.ndarray]] = []
    for path, at in law.shapes.items():
        for way in (-_STEP, _STEP) if sd[at] > _LOOSE and law.size > 1 else ():
            here = model
            for _ in range(_STEPS):
                moved = np.array(_law(here, which, law).start)
                moved[at] += way
                held = Law([law.effect(moved, run) for run in range(len(law.maps))], law.remembers, (path,))
                laws, starts = list(here.laws), list(here.x)
                laws[which], starts[which] = held, held.start
                here = refit(bench, projector, laws, starts, _ROUNDS)
                found.append((here.cost, _law(here, which, law).start))
                if here.cost > model.cost + _FAR**2:
                    break
    lowest = min([model.cost, *(cost for cost, _ in found)])
    return [(max((cost - lowest) ** 0.5, _FAR), there) for cost, there in found]


def _law(model: Refit, which: int, like: Law) -> Law:
    """One law of a model in the coordinates of another."""
    law, x = model.laws[which], model.x[which]
    return Law([law.effect(x, run) for run in range(len(law.maps))], like.remembers)
