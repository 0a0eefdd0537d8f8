"""What a command makes a stage do, between its samples as well: voltage at the piezo, displacement, derivatives."""

import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Any

import jax
import numpy as np

from fits.io._kept import kept
from fits.io._limits import Ranges, joined, measured_ranges
from fits.io._record import Record
from fits.loop._run import Run, prepare_run
from fits.stage._plain_stage import fine_steps
from fits.stage._run import as_stage, gain_ahead, place_of_hysteresis, range_of
from microid import (
    AbstractLinear,
    AbstractPart,
    Driver,
    Mechanics,
    Preisach,
    Scene,
    Signal,
    Stage,
    innermost,
    run_parts,
)


@dataclass(frozen=True)
class Prepared:
    """A run, and what a stage makes of it."""

    run: Run
    scene: Scene


def prepare(stage: Stage, run: Run) -> Prepared:
    samples = run.samples
    command = Signal(samples.voltage_V, samples.rest_V, samples.hold)
    return Prepared(run, Scene(command, samples.beside, samples.start.memory))


@kept
def _through(parts: tuple[AbstractPart, ...], time_s: Any, signal: Signal, scene: Scene) -> Signal:
    """Send a signal through parts in a row."""
    return run_parts(parts, time_s, signal, scene)


def signals(
    stage: Stage, prepared: Prepared, like: Stage | None = None, known: Sequence[Signal] = ()
) -> list[Signal]:
    """What goes into each part of a stage, and at the end what comes out.

    Those `known` of a stage `like` it are kept up to the first part that is another.
    """
    pairs = () if like is None else zip(stage.parts, like.parts, strict=False)
    same = sum(1 for _ in takewhile(lambda pair: _is_same(*pair), pairs))
    same = max(min(same, len(known) - 1), 0)
    found = [*known[: same + 1]] or [prepared.scene.command]
    for k in range(same, len(stage.parts)):
        # Neighbouring linear parts are one system from the first of them on.
        first = k
        while first > 0 and all(isinstance(part, AbstractLinear) for part in stage.parts[first - 1 : k + 1]):
            first -= 1
        found.append(_through(stage.parts[first : k + 1], prepared.run.samples.time_s, found[first], prepared.scene))
    return found


def at_samples(signal: Signal, prepared: Prepared) -> np.ndarray:
    """Values of a refined signal at the samples of its run, shape `(n,)`."""
    return np.asarray(signal.values)[:: prepared.run.samples.stride][: len(prepared.run.record)]


def _is_same(part: AbstractPart, other: AbstractPart) -> bool:
    """Whether two parts do the same."""
    if part is other:
        return True
    (one, form), (two, other_form) = jax.tree.flatten(part), jax.tree.flatten(other)
    return operator.eq(form, other_form) and all(map(np.array_equal, one, two))


def motion(
    stage: Stage, record: Record, range_V: tuple[float, float], initial: str = "unknown"
) -> tuple[Ranges, np.ndarray]:
    """Ranges of all that a command makes a stage do, between its samples as well, and the displacement at these.

    The displacement, `(n,)`, has the stage's own offset; that of the record is not looked at. `range_V` is that of
    the switching voltages, as commands.
    """
    n = len(record)
    stride = _steps(stage, record)
    # Held out as a whole, so that short commands are no error: nothing is fitted.
    run = prepare_run(record, range_V, initial, 1.0, stride, gain_ahead(stage), stage.hold)
    found = signals(stage.with_substeps(1), prepare(stage, run))
    last = (n - 1) * stride + 1
    time_s = np.asarray(run.samples.time_s)
    step_s: Any = float(time_s) if time_s.ndim == 0 else time_s[:last]
    displacement = np.asarray(found[-1].values)[:last]
    velocity = np.gradient(displacement, step_s)
    piezo = np.asarray(found[_driven(stage)].values)[:last]
    steps_s = np.diff(record.time_s)
    ranges = {
        "voltage": record.voltage_V,
        "slew": np.diff(record.voltage_V) / steps_s,
        "displacement": displacement,
        "velocity": velocity,
        "acceleration": np.gradient(velocity, step_s),
        "current": np.diff(piezo) / (step_s if np.ndim(step_s) == 0 else np.diff(step_s)),
    }
    return {name: _range(values) for name, values in ranges.items()}, displacement[::stride]


def predicted_ranges(
    model: Preisach | Stage, program: Record, displacement_um: np.ndarray, initial: str, every: bool = False
) -> Ranges:
    """What a command is, and makes a model do, between its samples too where the model rings.

    Its displacement at them, `(n,)`, is known; velocity, acceleration and current are given if `every` is asked for.
    """
    ranges = measured_ranges(replace(program, displacement_um=displacement_um))
    stage = as_stage(model)
    if len(program) < 2:
        return ranges
    range_V = range_of(stage)
    if not np.isfinite(range_V[0]):
        # No hysteresis remembers anything of it.
        range_V = _range(program.voltage_V)
    if not every and _steps(stage, program) == 1:
        return ranges
    between, _ = motion(stage, program, range_V, initial)
    return joined([between, ranges]) if every else joined([ranges, {"displacement": between["displacement"]}])


def _steps(stage: Stage, record: Record) -> int:
    """Steps between samples that show how a stage rings."""
    mechanics = (part for part in map(innermost, stage.parts) if isinstance(part, Mechanics))
    return fine_steps([float(part.natural_frequency_Hz) for part in mechanics], record)


def _driven(stage: Stage) -> int:
    """Which of the signals is the voltage at the piezo."""
    place = place_of_hysteresis(stage)
    if place is not None:
        return place
    drivers = [k for k, part in enumerate(stage.parts) if isinstance(innermost(part), Driver)]
    return drivers[-1] + 1 if drivers else 0


def _range(values: np.ndarray) -> tuple[float, float]:
    return float(np.min(values)), float(np.max(values))


def reached_by(
    stage: Stage,
    records: Sequence[Record],
    range_V: tuple[float, float],
    states: Sequence[str],
    known: Sequence[np.ndarray],
) -> tuple[Ranges, list[float]]:
    """What records have shown of a rig: the displacement as measured, its derivatives as a fitted stage has them.

    Noise would make derivatives of the measurement larger than anything the rig did. Of each record the state before
    it is given, and what does not depend on an unknown past. Displacements are as the sensor reads them in the first
    record; what it reads in each where the stage's own displacement is zero, in um, comes second.
    """
    found, offsets_um = [], []
    for record, state, sure in zip(records, states, known, strict=True):
        assert record.displacement_um is not None
        ranges, predicted = motion(stage, record, range_V, state)
        offsets_um.append(float(np.mean((record.displacement_um - predicted)[sure])))
        measured_um = record.displacement_um - offsets_um[-1] + offsets_um[0]
        found.append({**ranges, "displacement": _range(measured_um)})
    return joined(found), offsets_um
