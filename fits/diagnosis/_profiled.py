"""How far the parameters of a cause may be off where records hardly show one, or one is near its bound.

There the sum of squares is no parabola, and the standard deviations of its curvature promise too much.
"""

import jax.numpy as jnp
import numpy as np

from fits.diagnosis._candidates import Bench
from fits.diagnosis._law import Law
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, refit

# A parameter that a standard deviation of its coordinate moves so many times as far to one side as to the other is
# followed: by steps that double, from the first on, until it costs too much, and then between the last two; in so
# many steps at most, and coordinates no larger than this. All others are fitted again in so many rounds.
_BENT, _STEP, _STEPS, _LARGEST, _ROUNDS = 1.3, 0.5, 10, 30.0, 3
# Standard deviations up to which the sum of squares may do what it likes: a place that costs less is as far away.
# Where that is off by less than this factor, it is far enough known.
_FAR, _ABOUT = 3.0, 1.4


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
    law, x = model.laws[which], model.x[which]
    sd = np.sqrt(np.diagonal(covariance))
    found: list[tuple[float, np.ndarray]] = []
    for path, at in law.common.items():
        if _is_bent(law, x, at, float(sd[at])):
            for way in (-1, 1):
                found += _along(bench, projector, model, which, path, at, way)
    lowest = min([model.cost, *(cost for cost, _ in found)])
    return [(max((cost - lowest) ** 0.5, _FAR), there) for cost, there in found]


def _is_bent(law: Law, x: np.ndarray, at: int, sd: float) -> bool:
    """Whether a parameter is far from proportional to its coordinate, within a standard deviation."""
    ends = [np.array(x), np.array(x), np.array(x)]
    for end, way in zip(ends, (-1, 0, 1), strict=True):
        end[at] += way * sd
    below, here, above = (np.asarray(law.maps[0].values(jnp.asarray(law.vector(end, 0)))) for end in ends)
    less, more = float(np.abs(here - below).max()), float(np.abs(above - here).max())
    return max(less, more) > _BENT * min(less, more)


def _along(
    bench: Bench, projector: Projector, model: Refit, which: int, path: str, at: int, way: int
) -> list[tuple[float, np.ndarray]]:
    """Costs and coordinates of a law with one held farther and farther to one side, and then less far again."""
    law, runs = model.laws[which], range(len(model.laws[which].maps))
    found: list[tuple[float, np.ndarray]] = []
    step, last, outside = _STEP, model, None
    inside = float(_law(model, which, law).start[at])
    for _ in range(_STEPS):
        place = inside + way * step if outside is None else (inside + outside) / 2
        moved = np.array(_law(last, which, law).start)
        moved[at] = place
        # One by itself has nothing beside it that is fitted again.
        only = sum(one.size for one in model.laws) == 1
        held = Law([law.effect(moved, run) for run in runs], law.remembers, () if only else (path,))
        laws, starts = list(last.laws), list(last.x)
        laws[which], starts[which] = held, held.start
        there = refit(bench, projector, laws, starts, 0 if only else _ROUNDS)
        found.append((there.cost, _law(there, which, law).start))
        away = max(there.cost - model.cost, 0.0) ** 0.5 / _FAR
        if 1 / _ABOUT < away < _ABOUT:
            break
        if away > 1:
            outside = place
        elif abs(place) > _LARGEST:
            break
        else:
            inside, last, step = place, there, 2 * step
    return found


def _law(model: Refit, which: int, like: Law) -> Law:
    """One law of a model in the coordinates of another."""
    law, x = model.laws[which], model.x[which]
    return Law([law.effect(x, run) for run in range(len(law.maps))], like.remembers)
