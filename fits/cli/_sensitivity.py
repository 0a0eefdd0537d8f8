"""The command `microid sensitivity`: the work."""

import dataclasses
import math
import os
import re
from pathlib import Path

import click

import microid as m
from fits.io._atomic import finite_json
from fits.io._errors import DataError
from fits.io._file_set import file_set
from fits.io._jax_setup import start_jax
from fits.machining._claims import describe_claims, paper_claims
from fits.machining._design import Design, paper_design
from fits.machining._design_file import design_text, read_design
from fits.machining._sensitivity import sensitivities
from fits.report._sensitivity import describe_sensitivity, sensitivity_json

_TOLERANCE = re.compile(r"\s*([0-9.eE+-]+)\s*(mm|um|µm|μm)\s*")


def run_sensitivity(
    *,
    stage: str | None,
    axis: str,
    tolerance: str | None,
    level: int | None,
    voltage: bool,
    json_file: str | None,
    plots: str | None,
    write_stage: str | None,
) -> None:
    """Do `microid sensitivity`; the options are the command's."""
    start_jax()
    printed = json_file == "-"
    out = None if printed else json_file
    _keep_apart({"STAGE.toml": stage, "--json": out, "--write-stage": write_stage})
    design = _design(stage, tolerance, level)
    axes = tuple(name for name in m.AXES if axis in (name, "all"))
    with file_set() as files:
        # Entered before the work, so that a place that cannot be written to is refused before the wait.
        unfinished = None if out is None else files.file(out)
        unfinished_stage = None if write_stage is None else files.file(write_stage)
        drawings = files.folder(plots)
        report = sensitivities(design, axes)
        text = finite_json(sensitivity_json(report))
        claims = [] if stage or printed else [claim for claim in paper_claims(design) if {*claim.axes} & {*axes}]
        drawn: list[Path] = []
        if drawings is not None:
            from fits.plots._sensitivity import plot_sensitivity

            drawn = plot_sensitivity(design, report, drawings)
        if unfinished is not None:
            unfinished.write_text(f"{text}\n", encoding="utf-8")
        if unfinished_stage is not None:
            unfinished_stage.write_text(design_text(design), encoding="utf-8")
    if printed:
        click.echo(text)
        return
    lines = [describe_sensitivity(report, voltage)]
    if claims:
        lines += ["", describe_claims(claims)]
    places = [
        ("json", out),
        ("stage", write_stage),
        *(("plot", str(Path(plots or "") / path.name)) for path in drawn),
    ]
    written = [f"{what:5}  {place}" for what, place in places if place is not None]
    click.echo("\n".join([*lines, *([""] if written else []), *written]))


def _design(stage: str | None, tolerance: str | None, level: int | None) -> Design:
    """The stage that is asked about."""
    design = paper_design() if stage in (None, "paper") else read_design(stage)
    if tolerance is not None:
        length_mm = _length_mm(tolerance)
        try:
            design = design.with_tolerance(length_mm)
        except DataError as error:
            raise DataError(f"--tolerance {tolerance}: {error}") from None
    return design if level is None else dataclasses.replace(design, level=level)


def _length_mm(text: str) -> float:
    """Read a tolerance such as 0.02mm or 20um."""
    found = _TOLERANCE.fullmatch(text)
    try:
        number = float(found[1]) if found else math.nan
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number > 0):
        raise DataError(
            f"--tolerance: expected a length above 0 with its unit, found '{text}'; write one such as 0.02mm or 20um."
        )
    return number if found and found[2] == "mm" else number / 1e3


def _keep_apart(places: dict[str, str | None]) -> None:
    """Refuse to write where is read, or twice to one place."""
    seen: dict[str, str] = {}
    for option, place in places.items():
        if place is None:
            continue
        real = os.path.realpath(place)
        if real in seen:
            raise DataError(f"{option}: {place} would overwrite the file of {seen[real]}; choose another name.")
        seen[real] = option
