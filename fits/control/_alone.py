"""What a feedforward does by itself, without feedback."""

import numpy as np

import microid as m
from fits.control._compensate import respond
from fits.control._make import Loop, Setup, setup
from fits.io._errors import DataError
from fits.io._record import Reference


def played_alone(loop: Loop, ready: Setup) -> list[np.ndarray] | None:
    """Displacement of every plant of a loop under a feedforward alone, in um, shape `(t,)`; None without one."""
    if ready.feedforward_V is None:
        return None
    command = np.clip(ready.feedforward_V, *ready.limits_V)
    return [respond(plant, ready.interval_s, command, ready.start) for plant in loop.plants]


def inverse_alone(
    model: m.Preisach | m.Stage,
    reference: Reference,
    loop: Loop,
    *,
    initial: str = "negative",
    limits_V: tuple[float, float] | None = None,
) -> list[np.ndarray] | None:
    """Displacement of every plant under the inverse of the whole model; None where it has none for a reference."""
    try:
        led = setup(model, reference, "dynamic", initial=initial, limits_V=limits_V)
    except DataError:
        return None
    return played_alone(loop, led)
