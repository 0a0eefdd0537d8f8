"""The command `microid control`: the work."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from fits.cli._compensate import parse_rig_limits
from fits.cli._files import keep_inputs, progress_to_stderr
from fits.cli._work import preisach_of
from fits.control._gains import read_gains
from fits.control._limits import passed_limits
from fits.control._make import Loop, Maker
from fits.control._setup import Setup, setup
from fits.control._tune_problem import Goal
from fits.io._atomic import finite_json, write_csv
from fits.io._errors import DataError
from fits.io._file_set import file_set
from fits.io._jax_setup import start_jax
from fits.io._limits import check_command, joined, measured_ranges, reached_in
from fits.io._read_csv import read_reference
from fits.io._record import Record, Reference
from fits.io._units import parse_columns
from fits.loop._result import FitError
from fits.report._control import control_json, describe_control
from fits.stage._draw_plants import draw_plants
from fits.stage._model_file import load_model
from microid import Stage

_PLANTS = 4
# Finer steps, of um or V, are none.
_FINEST, _LARGEST = 1e-9, 1e9
# In the order of the options that are looked at.
_LIMITS = ("gain_margin_min", "phase_margin_min_deg", "sensitivity_peak_max", "overshoot_max_pct")


def run_control(
    *,
    model: str,
    reference: str,
    out: str,
    plots: str | None,
    controller: str,
    gains: str | None,
    feedforward: Any,
    frequency: Sequence[float],
    noise: float,
    delay: int,
    resolution: float | None,
    resolution_voltage: float | None,
    limits: str | None,
    limit: Sequence[str],
    margin: float,
    initial: str,
    plants: int | None,
    overshoot: float | None,
    gain_margin: float | None,
    phase_margin: float | None,
    peak: float | None,
    effort: float,
    rate: float,
    skip: float,
    starts: int,
    seed: int,
    columns: str,
    as_json: bool,
    quiet: bool,
) -> None:
    """Do `microid control`; the options are the command's."""
    for option, value in {"--noise": noise, "--effort": effort, "--rate": rate, "--skip": skip}.items():
        if not 0 <= value <= _LARGEST:
            raise DataError(f"{option}: expected a number from 0 to {_LARGEST:g}, found {value:g}.")
    for option, step in {"--resolution": resolution, "--resolution-voltage": resolution_voltage}.items():
        if step is not None and not _FINEST <= step <= _LARGEST:
            raise DataError(f"{option}: expected {_FINEST:g} to {_LARGEST:g}, found {step:g}; leave it out for none.")
    stated = {"--gain-margin": gain_margin, "--phase-margin": phase_margin, "--peak": peak, "--overshoot": overshoot}
    for option, bound in stated.items():
        least = 0.0 if option == "--overshoot" else 1.0
        if bound is not None and not least <= bound <= _LARGEST:
            raise DataError(f"{option}: expected a number from {least:g} to {_LARGEST:g}, found {bound:g}.")
    if frequency and controller != "resonant":
        raise DataError(f"--frequency: expected --controller resonant with it, found {controller}; leave it out.")
    volts, allowed_here = parse_rig_limits(limits, limit, margin)
    start_jax()
    keep_inputs(out, [model, reference] if gains is None else [model, reference, gains])
    tell = progress_to_stderr(quiet)
    given = None if gains is None else read_gains(gains)
    loaded = load_model(model)
    known = loaded.uncertainty is not None
    plant = loaded.model if isinstance(loaded.model, Stage) else preisach_of(model, loaded)
    wanted = read_reference(reference, parse_columns(columns))
    # Entered before the work, so that a place that cannot be written to is refused before the wait.
    with file_set() as files:
        unfinished, drawings = files.file(out), files.folder(plots)
        try:
            ready = setup(plant, wanted, feedforward, initial=initial, limits_V=volts)
        except DataError as error:
            if not error.of_model:
                raise
            raise DataError(f"{model}: {error}") from error
        skipped = _skipped(wanted, ready, skip)
        count = plants or (_PLANTS if known else 1)
        held = _held(plant) if isinstance(plant, Stage) else plant
        stages = draw_plants(held, loaded.uncertainty, count, seed=seed)
        limits_of = {name: x for name, x in zip(_LIMITS, stated.values(), strict=True) if x is not None}
        goal = Goal(effort, rate, **limits_of)
        rng = np.random.default_rng(seed)
        loop = Loop(ready, [_held(one) for one in stages], noise, delay, resolution, skipped)
        tune = Maker(loop, goal, starts, seed, rng.normal(0, noise, len(wanted)) if noise else None, tell)
        try:
            made = tune.make(controller, given, frequency)
        except FitError as error:
            raise DataError(f"{model}: {error}.") from error
        every = loop.margins(made.controller)
        if not all(bool(one.stable) for one in every):
            raise DataError(
                f"{model}: the loop is unstable with these gains, its largest pole has modulus "
                f"{max(float(one.radius) for one in every):.6g}; lower --gains, or leave them out to have them tuned."
            )
        tell("run")
        heard = rng.normal(0, noise, len(wanted)) if noise else None
        asked = 1 if overshoot is None else len(loop.plants)
        played = [loop.run(made.controller, heard, resolution_voltage, k) for k in range(len(loop.plants))]
        runs, run = played[:asked], played[0]
        if not all(np.all(np.isfinite(one.error_um)) for one in played):
            raise DataError(f"{model}: the loop is unstable, its displacement has no bounds; lower --gains.")
        passed = passed_limits(goal, every, runs)
        predicted = joined(
            measured_ranges(Record(wanted.time_s, np.asarray(one.command_V), np.asarray(one.displacement_um)))
            for one in played
        )
        # Sensor noise alone makes a loop's command jump from sample to sample.
        said = check_command(
            wanted.source, predicted, reached_in(loaded.report), allowed_here, margin, spared=("slew",)
        )
        more = [*made.remarks, *said, *_judged(passed, stated, controller, given is not None)]
        names = ("time_s", "reference_um", "displacement_um", "measured_um", "command_V", "error_um")
        table = {name: np.asarray(getattr(run, name)) for name in names}
        write_csv(unfinished, table | {"time_s": wanted.time_s})
        drawn: list[Path] = []
        if drawings is not None:
            from fits.plots._control import plot_control

            drawn = plot_control(run, made.controller, loop.plants, drawings, delay=delay)
        places = [str(Path(plots) / path.name) for path in drawn] if plots else []
        about = {"controller": controller, "out": out, "plots": places}
        # Before the file is in its place: what cannot be told is not left behind either.
        summary = control_json(loop, made, run, about, [*wanted.warnings, *ready.remarks, *more])
        told = finite_json(summary) if as_json else describe_control(summary)
    click.echo(told)


def _judged(passed: dict[str, str], stated: dict[str, float | None], kind: str, given: bool) -> list[str]:
    """What is said of limits that are passed; those that were asked for are not."""
    remarks = []
    for option, words in passed.items():
        if stated[option] is None:
            remarks.append(f"a limit that tuning keeps by default is passed: {words} ({option})")
        elif given:
            raise DataError(f"{option}: {words}; choose other --gains, or leave them out to have them tuned.")
        elif kind in ("bp-pid", "cmac-pid"):
            raise DataError(f"{option}: {words} while {kind} learns; relax it, or choose pid.")
        else:
            # Tuning kept it under the noise it heard.
            remarks.append(f"in this run, under fresh noise, a limit is passed: {words} ({option})")
    return remarks


def _held(stage: Stage) -> Stage:
    return Stage(stage.parts, stage.names, "zero", stage.substeps, stage.frozen)


def _skipped(reference: Reference, ready: Setup, skip_s: float) -> int:
    count = round(skip_s / ready.interval_s)
    if count > len(reference) - 2:
        raise DataError(f"--skip: expected less than the reference's {reference.time_s[-1]:g} s, found {skip_s:g} s.")
    return count
