"""Simulation of extended stages, part by part, so that only what changed is computed and compiled."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from fits._stage_run import StageRun
from microid import AbstractEffect, AbstractPart, Scene, Signal, Stage, extend, host

TEMPERATURE, OTHER = "temperature_degC", "other_um"


def columns_of_record(run: StageRun) -> dict[str, np.ndarray]:
    """Further columns of a record under the names that effects know, shape `(n,)` each.

    A name with `temp` in it is a temperature; another one that ends in a unit of length or voltage is the second
    axis.
    """
    found: dict[str, np.ndarray] = {}
    for name, values in run.record.extra.items():
        low = name.lower()
        if np.ptp(values) == 0 or not np.all(np.isfinite(values)):
            continue
        if "temp" in low or low.endswith(("_degc", "_k", "_c")):
            found.setdefault(TEMPERATURE, values)
        elif low.endswith(("_um", "_nm", "_mm", "_m", "_v", "_mv")):
            found.setdefault(OTHER, values)
    return found


@dataclass(frozen=True)
class Prepared:
    """A run, and what a stage makes of it."""

    run: StageRun
    time_s: Any
    scene: Scene


def prepare(stage: Stage, run: StageRun) -> Prepared:
    """Build the scene of a run."""
    samples = run.samples
    command = Signal(samples.voltage_V, samples.voltage_V[0], stage.hold)
    m, n = samples.voltage_V.shape[0], len(run.record)
    columns = {}
    for name, values in columns_of_record(run).items():
        fine = np.interp(np.arange(m) / samples.stride, np.arange(n), values)
        columns[name] = jnp.asarray(fine)
    return Prepared(run, samples.time_s, Scene(command, columns, samples.start.memory))


@eqx.filter_jit
def _pass(part: AbstractPart, time_s: Any, signal: Signal, scene: Scene) -> Signal:
    return part.run(time_s, signal, scene)


def signals(stage: Stage, prepared: Prepared) -> list[Signal]:
    """What goes into each part of a stage, and at the end what comes out."""
    signal = prepared.scene.command
    found = [signal]
    for part in stage.parts:
        signal = _pass(part, prepared.time_s, signal, prepared.scene)
        found.append(signal)
    return found


def respond_again(stage: Stage, base: Stage, known: Sequence[Signal], prepared: Prepared) -> np.ndarray:
    """Response of a stage that differs from a simulated one from some part on, in um, shape `(n,)`."""
    same = 0
    while same < min(len(stage.parts), len(base.parts)) and stage.parts[same] is base.parts[same]:
        same += 1
    signal = known[same]
    for part in stage.parts[same:]:
        signal = _pass(part, prepared.time_s, signal, prepared.scene)
    return np.asarray(signal.values)[:: prepared.run.samples.stride][: len(prepared.run.record)]


def with_effects(stage: Stage, effects: Sequence[AbstractEffect]) -> Stage:
    """Put effects into a stage, those that act on a part around that part."""
    for effect in effects:
        stage = extend(stage, _rehosted(effect, stage))
    return stage


def _rehosted(effect: AbstractEffect, stage: Stage) -> AbstractEffect:
    place = host(type(effect), stage)
    return effect if place is None else replace(effect, inner=stage.parts[place])  # type: ignore[call-arg]
