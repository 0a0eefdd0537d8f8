"""The command `microid control`: the work."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from fits._atomic import atomic_path, write_csv
from fits._cli_compensate import _limits
from fits._cli_files import keep_inputs, new_folder, progress_to_stderr
from fits._cli_jax import start_jax
from fits._cli_work import preisach_of
from fits._control_make import GAINS, Loop, Maker
from fits._control_report import control_json, describe_control
from fits._control_setup import Setup, setup
from fits._draw_plants import draw_plants
from fits._errors import DataError
from fits._model_file import load_model
from fits._read_csv import read_reference
from fits._record import Reference
from fits._result import FitError
from fits._tune_problem import Goal
from fits._units import parse_columns
from microid import Stage

_PLANTS = 4


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
    initial: str,
    plants: int | None,
    overshoot: float | None,
    gain_margin: float,
    phase_margin: float,
    peak: float,
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
        if not (math.isfinite(value) and value >= 0):
            raise DataError(f"{option}: expected a number that is not negative, found {value:g}.")
    for option, step in {"--resolution": resolution, "--resolution-voltage": resolution_voltage}.items():
        if step is not None and not (math.isfinite(step) and step > 0):
            raise DataError(f"{option}: expected a number above 0, found {step:g}; leave it out for none.")
    bounds = {"--gain-margin": gain_margin, "--phase-margin": phase_margin, "--peak": peak, "--overshoot": overshoot}
    for option, bound in bounds.items():
        least = 0.0 if option == "--overshoot" else 1.0
        if bound is not None and not (math.isfinite(bound) and bound >= least):
            raise DataError(f"{option}: expected a number of {least:g} or more, found {bound:g}.")
    if frequency and controller != "resonant":
        raise DataError(f"--frequency: expected --controller resonant with it, found {controller}; leave it out.")
    start_jax()
    keep_inputs(out, [model, reference])
    tell = progress_to_stderr(quiet)
    given = None if gains is None else _given_gains(gains)
    loaded = load_model(model)
    known = loaded.uncertainty is not None
    plant = loaded.model if isinstance(loaded.model, Stage) else preisach_of(model, loaded)
    wanted = read_reference(reference, parse_columns(columns))
    # Entered before the work, so that a place that cannot be written to is refused before the wait.
    with atomic_path(out) as unfinished, new_folder(plots) as drawings:
        try:
            ready = setup(plant, wanted, feedforward, initial=initial, limits_V=_limits(limits))
        except DataError as error:
            raise DataError(f"{model}: {error}") from error
        skipped = _skipped(wanted, ready, skip)
        count = plants or (_PLANTS if known else 1)
        held = _held(plant) if isinstance(plant, Stage) else plant
        stages = draw_plants(held, loaded.uncertainty, count, seed=seed)
        goal = Goal(effort, rate, gain_margin, phase_margin, peak, overshoot)
        rng = np.random.default_rng(seed)
        loop = Loop(ready, [_held(one) for one in stages], noise, delay, resolution, skipped)
        tune = Maker(loop, goal, starts, seed, rng.normal(0, noise, len(wanted)) if noise else None, tell)
        try:
            made, tuning, more = tune.make(controller, given, frequency)
        except FitError as error:
            raise DataError(f"{model}: {error}.") from error
        every = loop.margins(made)
        if not all(bool(one.stable) for one in every):
            raise DataError(
                f"{model}: the loop is unstable with these gains, its largest pole has modulus "
                f"{max(float(one.radius) for one in every):.6g}; lower --gains, or leave them out to have them tuned."
            )
        tell("run")
        run = loop.run(made, rng.normal(0, noise, len(wanted)) if noise else None, resolution_voltage)
        if not np.all(np.isfinite(run.error_um)):
            raise DataError(f"{model}: the loop is unstable, its displacement has no bounds; lower --gains.")
        names = ("time_s", "reference_um", "displacement_um", "measured_um", "command_V", "error_um")
        table = {name: np.asarray(getattr(run, name)) for name in names}
        write_csv(unfinished, table | {"time_s": wanted.time_s})
        drawn: list[Path] = []
        if drawings is not None:
            from fits._plot_control import plot_control

            drawn = plot_control(run, made, loop.plants, drawings(), delay=delay)
    places = [str(Path(plots) / path.name) for path in drawn] if plots else []
    remarks = [*wanted.warnings, *ready.remarks, *more]
    about = {"controller": controller, "out": out, "plots": places}
    summary = control_json(loop, made, tuning, run, about, remarks)
    click.echo(json.dumps(summary, indent=1, allow_nan=False) if as_json else describe_control(summary))


def _held(stage: Stage) -> Stage:
    return Stage(stage.parts, stage.names, "zero", stage.substeps, stage.frozen)


def _skipped(reference: Reference, ready: Setup, skip_s: float) -> int:
    count = round(skip_s / ready.interval_s)
    if count > len(reference) - 2:
        raise DataError(f"--skip: expected less than the reference's {reference.time_s[-1]:g} s, found {skip_s:g} s.")
    return count


def _given_gains(text: str) -> dict[str, float]:
    """Gains from the command line, or from a JSON file."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) == len(GAINS):
        found = dict(zip(GAINS, values, strict=True))
    elif values:
        raise DataError(f"--gains: expected three numbers KP,KI,KD or a file, found {len(values)}: '{text}'.")
    else:
        try:
            content = json.loads(Path(text).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise DataError(
                f"--gains: expected KP,KI,KD or a JSON file of gains, found '{text}' ({error}); write three numbers."
            ) from error
        content = content.get("gains", content) if isinstance(content, dict) else {}
        found = {}
        for name in GAINS:
            value = content.get(name, content.get(f"pid.{name}"))
            if not isinstance(value, int | float) or isinstance(value, bool):
                raise DataError(f"{text}: expected the key {name} with a number, found {value!r}; add it.")
            found[name] = float(value)
    for name, value in found.items():
        if not (math.isfinite(value) and value >= 0):
            raise DataError(f"--gains: expected {name} of 0 or more, found {value:g}.")
    return found
