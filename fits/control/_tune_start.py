"""Where the tuning of a controller begins: the ultimate point of a loop, and the rules of Ziegler and Nichols."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import brentq

from fits.io._errors import DataError
from fits.io._kept import kept
from fits.stage._model_file import AnyModel, model_given
from fits.stage._run import as_stage, place_of_hysteresis
from microid import Preisach, Stage
from microid.control import PID, loop_gain, margins
from microid.hysteresis import PrandtlIshlinskii


@dataclass(frozen=True)
class UltimatePoint:
    """The gain of a proportional controller with which a loop oscillates for ever, and the period of that."""

    gain_V_per_um: float
    period_s: float


def steepest_slope(stage: Stage) -> float | None:
    """Slope of a stage's hysteresis where it is steepest, in um/V: there the loop is least stable.

    That of a `Preisach` is found on its major loop, that of a `PrandtlIshlinskii` in closed form. None for a stage
    that is linear; a `DataError` says that the hysteresis is another one.
    """
    place = place_of_hysteresis(stage)
    if place is None:
        return None
    law = stage.parts[place]
    if isinstance(law, PrandtlIshlinskii):
        return float(law.slope_um_per_V + np.sum(np.asarray(law.weight_um_per_V)))
    if not isinstance(law, Preisach):
        raise DataError(
            f"{stage.names[place]!r} is a {type(law).__name__}, which has no form for single samples: "
            "control a stage with a Preisach or a PrandtlIshlinskii hysteresis"
        )
    return float(_compiled_slope(law, fine=64))


def major_loop_slope(law: Preisach, fine: int) -> Float[Array, ""]:
    """Slope in um/V of a hysteresis where it is steepest on its major loop, of so many voltages per level."""
    rise = jnp.linspace(law.density.lower_V, law.density.upper_V, fine * law.density.levels)
    output = law(jnp.append(rise, rise[::-1]))
    return jnp.max(jnp.abs(jnp.diff(output))) / (rise[1] - rise[0])


_compiled_slope = kept(major_loop_slope)


def slope_array(stage: Stage) -> Float[Array, ""] | None:
    """The same as an array: compiled functions take a bare number for a constant, and are made again for each."""
    slope = steepest_slope(stage)
    return None if slope is None else jnp.asarray(slope)


def ultimate_point(stage: Stage, interval_s: float, *, delay: int = 0) -> UltimatePoint:
    """Find the ultimate point of a stage: where its sampled response, delay included, is real and most negative.

    The stage has linear parts and at most one hysteresis, for which its steepest slope stands. There are `interval_s`
    between two samples of the controller, whose readings are `delay` samples old. A `DataError` says that the stage
    moves down for a voltage that goes up, or does not move at all.
    """
    unit, slope = PID.from_times(1.0, jnp.inf, 0.0, interval_s), slope_array(stage)

    def response(frequency_Hz: np.ndarray) -> np.ndarray:
        return np.asarray(loop_gain(unit, stage, jnp.asarray(frequency_Hz), delay=delay, slope_um_per_V=slope))

    nyquist = 0.5 / interval_s
    grid = nyquist * np.logspace(-5, 0, 4001)
    whole = response(grid)
    if not (np.all(np.isfinite(whole)) and whole[0].real > 0):
        raise DataError(
            f"the stage gives {whole[0].real:.3g} um/V at rest, expected a positive gain: turn the sign of a column"
        )
    candidates = [(grid[-1], whole[-1].real)]
    for k in np.flatnonzero(np.diff(np.sign(whole[:-1].imag))):
        crossing = brentq(lambda frequency: response(np.array([frequency]))[0].imag, grid[k], grid[k + 1])
        candidates.append((crossing, response(np.array([crossing]))[0].real))
    frequency, depth = min(candidates, key=lambda one: one[1])
    if not depth < 0:
        raise DataError("no gain makes this loop oscillate: state its interval and the delay of the sensor")
    return UltimatePoint(float(-1 / depth), float(1 / frequency))


def stages_given(plants: Any) -> list[Stage]:
    """Plants as stages: one or several models, fits of them, or names of their files."""
    each = plants if isinstance(plants, list | tuple) else [plants]
    return [as_stage(model_given(one)[0]) for one in each]


def relay_start(plants: AnyModel | Sequence[AnyModel], interval_s: float, *, delay: int = 0) -> PID:
    """Find a PID controller to start from: the rules of Ziegler and Nichols (1942), made safe.

    They give `0.6 K_u`, `P_u / 2` and `P_u / 8` for the gain and the times of integral and derivative, from the gain
    and the period at which a relay experiment would see the loop oscillate; here they come from the model. Stages
    with a light resonance are unstable under them, so the gains are halved until every plant has a gain margin of 2.

    There are `interval_s` between two samples of the controller, whose readings are `delay` samples old. Of several
    plants the first gives the ultimate point. The controller has no limits, and a filter of a tenth of the
    derivative's time. A `DataError` says that a plant is no model, that the first moves down for a voltage that goes
    up, or does not move, or that no gains are small enough.
    """
    stages = stages_given(plants)
    point = ultimate_point(stages[0], interval_s, delay=delay)
    given = [(stage, slope_array(stage)) for stage in stages]
    gain, integral_s, derivative_s = 0.6 * point.gain_V_per_um, point.period_s / 2, point.period_s / 8
    # Ever smaller gains reach the margin on any stage that is stable by itself.
    for _ in range(60):
        pid = PID.from_times(gain, integral_s, derivative_s, interval_s, filter_s=derivative_s / 10)
        found = [margins(pid, stage, delay=delay, slope_um_per_V=slope) for stage, slope in given]
        if all(bool(one.stable) and float(one.gain_margin) >= 2 for one in found):
            return pid
        gain /= 2
    raise DataError("no gains were small enough for a stable loop: the stage itself is not stable")
