"""Simulation of extended stages, part by part, so that only what changed is computed and compiled."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jax.extend.backend import get_backend

from fits.io._record import Record
from fits.loop._run import Run
from fits.stage._motion import Prepared, pass_signal, prepare, programs, signals
from microid import AbstractEffect, Signal, Stage, extend, host

# Samples of all records, and number of programs of some 7 MB each, from which on programs make room for each other.
_LONG, _MANY = 20_000, 500


def simulate(stage: Stage, run: Run) -> np.ndarray:
    """Response of a stage to a run that is refined already, in um, shape `(n,)`."""
    values = signals(stage.with_substeps(1), prepare(stage, run))[-1].values
    return np.asarray(values)[:: run.samples.stride][: len(run.record)]


def along_curves(run: Run) -> Run:
    """The same run, its command along curves between the samples."""
    return replace(run, hold="smooth")


def respond_again(stage: Stage, base: Stage, known: Sequence[Signal], prepared: Prepared) -> np.ndarray:
    """Response of a stage that differs from a simulated one from some part on, in um, shape `(n,)`."""
    same = 0
    while same < min(len(stage.parts), len(base.parts)) and stage.parts[same] is base.parts[same]:
        same += 1
    signal = known[same]
    for part in stage.parts[same:]:
        signal = pass_signal(part, prepared.time_s, signal, prepared.scene)
    return np.asarray(signal.values)[:: prepared.run.samples.stride][: len(prepared.run.record)]


def with_effects(stage: Stage, effects: Sequence[AbstractEffect]) -> Stage:
    """Put effects into a stage, those that act on a part around that part."""
    for effect in effects:
        stage = extend(stage, _rehosted(effect, stage))
    return stage


def _rehosted(effect: AbstractEffect, stage: Stage) -> AbstractEffect:
    place = host(type(effect), stage)
    return effect if place is None else replace(effect, inner=stage.parts[place])  # type: ignore[call-arg]


def drop_programs(records: Sequence[Record]) -> None:
    """Give back the memory of the programs that simulate parts, where records are long or programs are many.

    A program is compiled for runs of one length, those of short runs serve the next diagnosis as well; and several
    hundred of them take as much memory as long records do. What else the process has compiled stays.
    """
    if sum(len(record) for record in records) >= _LONG or len(get_backend().live_executables()) > _MANY:
        programs.drop()
