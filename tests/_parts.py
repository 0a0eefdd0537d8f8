"""Effects and parts by themselves, and equations of motion by SciPy."""

import jax.numpy as jnp
import numpy as np
from _models import compiled
from scipy import integrate

from microid import effects as fx
from microid._part import Scene, Signal

BY_NAME = {(effect.name, effect.form): effect for effect in fx.EFFECTS}


@compiled
def run(effect, time_s, given, scene):
    return effect.run(time_s, given, scene).values


def through(effect, time_s, values, before=None, hold="first", **beside):
    """Run one part by itself."""
    values = jnp.asarray(values)
    given = Signal(values, values[0] if before is None else jnp.asarray(before), hold)
    scene = Scene(given, {name: jnp.asarray(column) for name, column in beside.items()})
    return np.asarray(run(effect, jnp.asarray(time_s), given, scene))


def wander(rng, n, lowest, highest):
    """A path in lines between random levels."""
    knots = np.linspace(0, n - 1, 12)
    return np.interp(np.arange(n), knots, rng.uniform(lowest, highest, 12))


def uneven(rng, n, interval_s):
    return np.concatenate([[0], np.cumsum(interval_s * rng.uniform(0.6, 1.4, n - 1))])


def motion(time, push, right_hand, start):
    """Solve an equation of motion under a push in lines, from sample to sample."""
    found, state = [start], start
    for k in range(len(time) - 1):
        rise = (push[k + 1] - push[k]) / (time[k + 1] - time[k])
        answer = integrate.solve_ivp(
            lambda t, y, k=k, rise=rise: right_hand(y, push[k] + rise * (t - time[k])),
            (time[k], time[k + 1]),
            state,
            rtol=1e-9,
            atol=1e-11,
        )
        state = answer.y[:, -1]
        found.append(state)
    return np.array(found)
