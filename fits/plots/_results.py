"""The picture that stands for a result: what its `plot()` gives back."""

from functools import singledispatch
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from fits.control._compensate import gains_of
from fits.diagnosis._result import Diagnosis
from fits.io._record import Record, Reference
from fits.loop._result import FitResult
from fits.machining._budget import Budget
from fits.machining._sensitivity import SensitivityReport
from fits.plots import _style as style
from fits.plots._diagnosis import residual_figure
from fits.plots._fit import linear_gain, linear_parts
from fits.plots._machining import budget_bars, tornado
from fits.stage._checks import speed_Hz
from microid import Mechanics, Stage

# Ends of the smaller loops inside the largest one, as parts of the range.
_LOOPS = ((0.0, 1.0), (0.0, 0.7), (0.2, 0.7), (0.0, 0.0))


def drawn(result: object) -> Figure:
    """Draw a result in the style of all pictures."""
    return style.styled(picture_of(result))


@singledispatch
def picture_of(result: object) -> Figure:
    """Draw a result; what is registered here has a picture."""
    raise TypeError(f"there is no picture of a {type(result).__name__}")


@picture_of.register(Record)
@picture_of.register(Reference)
def _(result: Record | Reference) -> Figure:
    """What was commanded and what was measured, over the time."""
    named = {"voltage (V)": getattr(result, "voltage_V", None), "displacement (µm)": result.displacement_um}
    known = {name: values for name, values in named.items() if values is not None}
    picture, grid = style.panels(style.WIDE_in, 0.6 + 1.4 * len(known), len(known), 1, sharex=True, squeeze=False)
    for axes, (name, values) in zip(grid[:, 0], known.items(), strict=True):
        style.curve(axes, result.time_s, values, **style.MODEL)
        style.label(axes, "", name)
    style.label(grid[-1, 0], "time (s)", grid[-1, 0].get_ylabel())
    return picture


picture_of.register(SensitivityReport, tornado)
picture_of.register(Budget, budget_bars)


@picture_of.register
def _(result: Diagnosis) -> Figure:
    picture = residual_figure(result)
    style.legend(picture, picture.axes[:1])
    return picture


@picture_of.register(FitResult)
def _(result: FitResult[Any]) -> Figure:
    """Loops of the fitted hysteresis over the slowest run, and of a stage the gain of its linear parts."""
    law, stage = result.hysteresis, result.model if isinstance(result.model, Stage) else None
    width_in, columns = (style.WIDE_in, 2) if stage else (style.NARROW_in, 1)
    picture, grid = style.panels(width_in, 2.8, 1, columns, squeeze=False)
    low, high = float(law.density.lower_V), float(law.density.upper_V)
    ends = low + (high - low) * np.ravel(_LOOPS)
    voltage = np.concatenate([np.linspace(a, b, 200) for a, b in pairwise(ends)])
    if result.records:
        slowest = min(range(len(result.records)), key=lambda k: speed_Hz(result.records[k]))
        record, offset_um = result.records[slowest], result.runs[slowest].offset_um - result.runs[0].offset_um
        ahead, behind, rest_um = gains_of(stage) if stage else (1.0, 1.0, 0.0)
        assert record.displacement_um is not None
        seen_um = (record.displacement_um - offset_um - rest_um) / behind
        style.curve(grid[0, 0], ahead * record.voltage_V, seen_um, "measured", **style.MEASURED)
    slow_um = np.asarray(eqx.filter_jit(law)(jnp.asarray(voltage)))
    style.curve(grid[0, 0], voltage, slow_um, "model", **style.MODEL)
    if result.records:
        style.legend(picture, grid[0, :1])
    style.label(grid[0, 0], "voltage (V)", "displacement (µm)", "hysteresis, slowly")
    if stage:
        resonances = [float(part.natural_frequency_Hz) for part in stage.parts if isinstance(part, Mechanics)]
        frequency_Hz = max(resonances, default=100.0) * np.logspace(-2, 1, 600)
        grid[0, 1].loglog(frequency_Hz, np.abs(linear_gain(stage, frequency_Hz)), **style.MODEL)
        style.label(grid[0, 1], "frequency (Hz)", "gain over that at rest", linear_parts(stage))
    return picture
