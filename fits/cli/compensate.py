"""The command `microid compensate`: its options, and the work."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from fits.cli._common import Given, columns, in_sentences, initial, json_output, limit, limits, margin
from fits.cli._files import keep_inputs
from fits.io._errors import DataError
from fits.io._file_set import file_set

if TYPE_CHECKING:
    import numpy as np

    from fits.io._record import Record
    from fits.stage._model_file import ModelFile


@click.command()
@click.argument("model", metavar="MODEL.json")
@click.argument("reference", metavar="REFERENCE.csv")
@click.option("--out", required=True, metavar="VOLTAGE.csv", help="CSV to write; .gz is compressed.")
@click.option(
    "--static", "way", flag_value="static", default="static", help="Compensate the hysteresis only: the default."
)
@click.option("--dynamic", "way", flag_value="dynamic", help="Compensate the mechanics and the driver too.")
@click.option("--clip", is_flag=True, help="Where the reference is out of reach take the nearest that is not.")
@limits
@limit
@margin
@initial("reference")
@click.option("--plots", metavar="DIR", help="Folder for a plot; it is made if need be.")
@columns
@json_output
@in_sentences
def compensate(given: Given) -> None:
    """Find the voltage that makes the stage follow a reference.

    REFERENCE.csv needs the columns time_s and displacement_um: what the sensor is to read, its offset included. The
    result has time_s, voltage_V and displacement_um, which is what the model then does.
    """
    import numpy as np

    from fits.cli._models import parse_rig_limits, stage_or_preisach
    from fits.control._compensate import compensate
    from fits.control._compensate_stage import static_equivalent
    from fits.io._atomic import finite_json, refuse_nonfinite, write_csv
    from fits.io._jax_setup import start_jax
    from fits.io._limits import check_command, reached_in
    from fits.io._read_csv import read_reference
    from fits.io._record import Record
    from fits.io._units import parse_columns
    from fits.plots._compensation import plot_compensation
    from fits.stage._model_file import load_model
    from fits.stage._motion import predicted_ranges
    from microid import Preisach, Stage

    keep_inputs(given.out, [given.model, given.reference])
    volts, stated = parse_rig_limits(given.limits, given.limit, given.margin)
    start_jax()
    loaded = load_model(given.model)
    stage = stage_or_preisach(given.model, loaded)
    if given.way == "dynamic" and isinstance(stage, Preisach):
        raise DataError(
            f"{given.model}: expected a model with mechanics for --dynamic, found a Preisach model, which has none; "
            "leave out --dynamic, or fit a whole stage."
        )
    wanted = read_reference(given.reference, parse_columns(given.columns))
    # Entered before the work, so that a place that cannot be written to is refused before the wait.
    with file_set() as made:
        unfinished, drawings = made.file(given.out), made.folder(given.plots)
        found = compensate(
            stage, wanted, given.initial, given.clip, volts, "dynamic" if given.way == "dynamic" else "static"
        )
        program = Record(wanted.time_s, found.voltage_V, None, source=wanted.source)
        every = bool({"velocity", "acceleration", "current"} & set(stated))
        predicted = predicted_ranges(stage, program, found.displacement_um, given.initial, every)
        said = check_command(wanted.source, predicted, reached_in(loaded.report), stated, given.margin)
        sd_um = _displacement_sd_um(loaded, program, given.initial)
        if sd_um is not None:
            refuse_nonfinite("displacement_sd_um", sd_um)
        drawn = []
        if drawings is not None:
            drawn = plot_compensation(stage, wanted, found, sd_um, drawings, initial=given.initial)
        columns_out = {
            "time_s": wanted.time_s,
            "voltage_V": found.voltage_V,
            "displacement_um": found.displacement_um,
        }
        write_csv(unfinished, columns_out)
    off = np.abs(found.displacement_um - found.reference_um)
    places = [str(Path(given.plots) / path.name) for path in drawn] if given.plots else []
    remarks = [*wanted.warnings, *found.remarks, *said]
    summary = {
        "out": given.out,
        "plots": places,
        "samples": len(wanted),
        "clipped": int(found.clipped.sum()),
        "voltage_min_V": float(found.voltage_V.min()),
        "voltage_max_V": float(found.voltage_V.max()),
        "offset_um": float((static_equivalent(stage) if isinstance(stage, Stage) else stage).offset_um),
        "error_max_um": float(off.max()),
        "error_max_within_reach_um": float(off[~found.clipped].max(initial=0.0)),
        "displacement_sd_median_um": None if sd_um is None else float(np.median(sd_um)),
        "remarks": remarks,
    }
    if given.as_json:
        click.echo(finite_json(summary))
        return
    lines = [
        f"{len(wanted)} samples, {summary['voltage_min_V']:.6g} to {summary['voltage_max_V']:.6g} V",
        f"by the model   within {summary['error_max_within_reach_um']:.3g} um of the reference where it is in reach",
        f"offset         the reference is a sensor's reading, {summary['offset_um']:.6g} um at negative saturation",
    ]
    if sd_um is not None:
        lines.insert(2, f"expected       standard deviation {np.median(sd_um):.3g} um in the median")
    if summary["clipped"]:
        lines.append(f"clipped        at {summary['clipped']} of the samples, off by at most {off.max():.3g} um")
    lines += [f"Note: {remark}" for remark in remarks]
    click.echo("\n".join([*lines, f"voltage        {given.out}", *(f"plot           {place}" for place in places)]))


def _displacement_sd_um(loaded: ModelFile, program: Record, initial: str) -> np.ndarray | None:
    """Standard deviation of a model's displacement, where the file says enough for one."""
    from fits.stage._predict import predict
    from microid import Preisach, Stage

    if loaded.uncertainty is None or not isinstance(loaded.model, Preisach | Stage):
        return None
    return predict(loaded.model, loaded.uncertainty, program, initial).displacement_sd_um
