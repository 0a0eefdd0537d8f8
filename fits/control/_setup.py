"""A model and a reference made ready for a closed loop: interval, feedforward, limits, and how the stage stands."""

from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax.numpy as jnp
import numpy as np

from fits.control._compensate import compensate
from fits.io._errors import DataError
from fits.io._record import Reference
from fits.loop._run import initial_state
from fits.stage._run import as_stage, place_of_hysteresis, range_of
from microid import Preisach, SampledStage, Stage, Start, two_degrees

Feedforward = Literal["none", "static", "dynamic"]

_FEWEST = 16


@dataclass(frozen=True)
class Setup:
    """What a loop needs beside its stage and controller, at rest where the reference begins; signals `(t,)`."""

    interval_s: float
    reference_um: np.ndarray
    feedforward_V: np.ndarray | None
    limits_V: tuple[float, float]
    start: Start
    static_V: np.ndarray  # would hold the stage at the reference
    remarks: tuple[str, ...]


def setup(
    model: Preisach | Stage,
    reference: Reference,
    feedforward: Feedforward = "static",
    *,
    initial: str = "negative",
    limits_V: tuple[float, float] | None = None,
) -> Setup:
    """Make a model and a reference ready for a closed loop, in which a hysteresis is a stage of one part.

    The feedforward is none, the inverse of the hysteresis alone, or that of the whole stage; limits are by default
    those of the model. A `DataError` says that the times are uneven or too few, that the stage cannot be stepped or
    inverted, or that the limits are not within the model's range.
    """
    stage = as_stage(model).with_hold("zero")
    interval = _interval_s(reference)
    try:
        sampled = SampledStage(stage, interval)
    except ValueError as error:
        raise DataError(f"the model cannot be stepped from sample to sample: {error}", of_model=True) from error
    wanted, remarks = np.asarray(reference.displacement_um), list[str]()
    place = place_of_hysteresis(stage)
    if place is None:
        memory, limits = None, (-np.inf, np.inf) if limits_V is None else limits_V
        gain, offset = float(stage.static_gain), float(sampled.init(Start(jnp.asarray(0.0)))[1])
        if not (np.isfinite(gain) and gain > 0):
            raise DataError(
                f"the stage gives {gain:g} um/V at rest, expected a positive one; turn the sign of a column",
                of_model=True,
            )
        static_V = ahead_V = (wanted - offset) / gain
        if feedforward == "dynamic":
            try:
                ahead_V = np.asarray(two_degrees(stage, interval, jnp.asarray(wanted)).feedforward_V)
            except ValueError as error:
                raise DataError(f"the model has no dynamic inverse: {error}", of_model=True) from error
        if feedforward != "none" and not np.array_equal(np.clip(ahead_V, *limits), ahead_V):
            remarks.append("the feedforward was cut to the limits")
        ahead_V = np.clip(ahead_V, *limits)
    else:
        law = stage.parts[place]
        if not isinstance(law, Preisach):
            raise DataError(
                f"{stage.names[place]!r} is a {type(law).__name__}, expected a Preisach hysteresis; fit one",
                of_model=True,
            )
        invert = partial(compensate, stage, reference, initial, clip=True, limits_V=limits_V)
        found = invert(way="static")
        static_V = ahead_V = found.voltage_V
        memory = initial_state(initial, float(law.density.lower_V), float(law.density.upper_V))
        limits = range_of(stage) if limits_V is None else limits_V
        if found.clipped.any():
            remarks.append(f"{int(found.clipped.sum())} samples of the reference are out of reach within the limits")
        if feedforward == "dynamic":
            if isinstance(model, Preisach) or len(stage.parts) == 1:
                raise DataError(
                    "expected a model with mechanics for --feedforward dynamic, found a hysteresis alone",
                    of_model=True,
                )
            led = invert(way="dynamic")
            ahead_V, remarks = led.voltage_V, [*remarks, *led.remarks]
    start = Start(jnp.asarray(float(ahead_V[0])), memory)
    fed_V = None if feedforward == "none" else ahead_V
    return Setup(interval, wanted, fed_V, limits, start, static_V, tuple(remarks))


def _interval_s(reference: Reference) -> float:
    if len(reference) < _FEWEST:
        raise DataError(
            f"{reference.source}: expected {_FEWEST} samples or more, found {len(reference)}; sample it more finely"
        )
    steps = np.diff(reference.time_s)
    interval = float(steps.mean())
    worst = int(np.argmax(np.abs(steps - interval)))
    if abs(steps[worst] - interval) > 1e-3 * interval:
        raise DataError(
            f"{reference.source}: expected even times, as of a controller, found a step of {steps[worst]:.6g} s "
            f"at sample {worst + 2} where the mean is {interval:.6g} s; resample the reference"
        )
    return interval
