"""The command `microid budget`: the work."""

import math
import re
from pathlib import Path

import click

import microid as m
from fits.cli._sensitivity import _keep_apart
from fits.cli._work import preisach_of
from fits.control._compensate_stage import static_equivalent
from fits.io._atomic import finite_json
from fits.io._errors import DataError
from fits.io._file_set import file_set
from fits.io._jax_setup import start_jax
from fits.io._units import parse_columns
from fits.machining._budget import Measures, budget
from fits.machining._design import paper_design
from fits.machining._design_file import read_design
from fits.machining._idle import idle_noise, read_idle
from fits.report._budget import budget_json, describe_budget
from fits.stage._model_file import load_model

# What stands for the paper's stage instead of a file.
_PAPER = "paper"
_ARM = re.compile(r"\s*([0-9.eE+-]+)\s*(mm|m)\s*")


def run_budget(
    *,
    stage: str,
    model: str,
    idle: str,
    axis: str,
    model_measures: Measures,
    arm: str | None,
    zeroed: bool,
    columns: str,
    json_file: str | None,
    plots: str | None,
) -> None:
    """Do `microid budget`; the options are the command's."""
    start_jax()
    printed = json_file == "-"
    out = None if printed else json_file
    for what, path in {"STAGE.toml": stage, "MODEL.json": model, "IDLE.csv": idle}.items():
        _keep_apart({what: None if path == _PAPER else path, "--json": out})
    arm_mm = None if arm is None else _arm_mm(arm)
    if arm_mm is None and model_measures in m.AXES and m.MOTIONS[model_measures].unit == "rad":
        raise DataError(
            f"--model-measures {model_measures}: expected the arm at which a displacement is a rotation, found none; "
            "add --arm, such as --arm 50mm."
        )
    with file_set() as files:
        # Entered before the work, so that a place that cannot be written to is refused before the wait.
        unfinished = None if out is None else files.file(out)
        drawings = files.folder(plots)
        design = paper_design() if stage == _PAPER else read_design(stage)
        noise = idle_noise(read_idle(idle, parse_columns(columns)))
        law = _law(model)
        axes = tuple(name for name in m.AXES if axis in (name, "all"))
        found = budget(design, law, noise, axes, measures=model_measures, arm_mm=arm_mm, zeroed=zeroed)
        text = finite_json(budget_json(found))
        drawn: list[Path] = []
        if drawings is not None:
            from fits.plots._budget import plot_budget

            drawn = plot_budget(found, drawings)
        if unfinished is not None:
            unfinished.write_text(f"{text}\n", encoding="utf-8")
    if printed:
        click.echo(text)
        return
    places = [("json", out), *(("plot", str(Path(plots or "") / path.name)) for path in drawn)]
    written = [f"{what:5}  {place}" for what, place in places if place is not None]
    click.echo("\n".join([describe_budget(found), *([""] if written else []), *written]))


def _law(path: str) -> m.Preisach:
    """The hysteresis of a model file, as slow voltages see it."""
    loaded = load_model(path)
    if not isinstance(loaded.model, m.Stage):
        return preisach_of(path, loaded)
    try:
        return static_equivalent(loaded.model)
    except DataError as error:
        if not error.of_model:
            raise
        raise DataError(f"{path}: {error}") from error


def _arm_mm(text: str) -> float:
    """Read an arm such as 50mm or 0.05m."""
    found = _ARM.fullmatch(text)
    try:
        number = float(found[1]) if found else math.nan
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number > 0):
        raise DataError(f"--arm: expected a length above 0 with its unit, found '{text}'; write one such as 50mm.")
    return number if found and found[2] == "mm" else 1e3 * number
