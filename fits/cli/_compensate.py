"""The commands `microid compensate` and `microid export`: the work."""

import json
import math
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np

from fits.cli._files import keep_inputs
from fits.cli._work import preisach_of
from fits.control._compensate import compensate
from fits.control._compensate_stage import static_equivalent
from fits.control._export_c import export_c
from fits.io._atomic import finite_json, refuse_nonfinite, write_csv
from fits.io._errors import DataError
from fits.io._file_set import file_set
from fits.io._jax_setup import start_jax
from fits.io._limits import Ranges, allowed, check_command, parse_limits, reached_in
from fits.io._read_csv import read_reference
from fits.io._record import Record
from fits.io._units import parse_columns
from fits.loop._result import predict
from fits.loop._uncertainty import Uncertainty
from fits.plots._compensation import plot_compensation
from fits.stage._model_file import ModelFile, load_model
from fits.stage._motion import predicted_ranges
from fits.stage._result import predict_stage
from fits.stage._uncertainty import StageUncertainty
from microid import Preisach, Stage

_STATIC_ONLY = "the files hold the hysteresis with the static gains of the stage; what moves in it is left out."


def run_compensate(
    *,
    model: str,
    reference: str,
    out: str,
    way: str,
    clip: bool,
    limits: str | None,
    limit: Sequence[str],
    margin: float,
    initial: str,
    plots: str | None,
    columns: str,
    as_json: bool,
) -> None:
    """Do `microid compensate`; the options are the command's."""
    keep_inputs(out, [model, reference])
    volts, stated = parse_rig_limits(limits, limit, margin)
    start_jax()
    loaded = load_model(model)
    stage = _compensable(model, loaded)
    if way == "dynamic" and isinstance(stage, Preisach):
        raise DataError(
            f"{model}: expected a model with mechanics for --dynamic, found a Preisach model, which has none; "
            "leave out --dynamic, or fit a whole stage."
        )
    wanted = read_reference(reference, parse_columns(columns))
    # Entered before the work, so that a place that cannot be written to is refused before the wait.
    with file_set() as made:
        unfinished, drawings = made.file(out), made.folder(plots)
        found = compensate(stage, wanted, initial, clip, volts, "dynamic" if way == "dynamic" else "static")
        program = Record(wanted.time_s, found.voltage_V, None, source=wanted.source)
        every = bool({"velocity", "acceleration", "current"} & set(stated))
        predicted = predicted_ranges(stage, program, found.displacement_um, initial, every)
        said = check_command(wanted.source, predicted, reached_in(loaded.report), stated, margin)
        sd_um = _displacement_sd_um(loaded, program, initial)
        if sd_um is not None:
            refuse_nonfinite("displacement_sd_um", sd_um)
        drawn = []
        if drawings is not None:
            drawn = plot_compensation(stage, wanted, found, sd_um, drawings, initial=initial)
        columns_out = {
            "time_s": wanted.time_s,
            "voltage_V": found.voltage_V,
            "displacement_um": found.displacement_um,
        }
        write_csv(unfinished, columns_out)
    off = np.abs(found.displacement_um - found.reference_um)
    places = [str(Path(plots) / path.name) for path in drawn] if plots else []
    remarks = [*wanted.warnings, *found.remarks, *said]
    summary = {
        "out": out,
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
    if as_json:
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
    click.echo("\n".join([*lines, f"voltage        {out}", *(f"plot           {place}" for place in places)]))


def run_export(*, model: str, out: str, name: str, memory: int, limits: str | None, as_json: bool) -> None:
    """Do `microid export`; the options are the command's."""
    start_jax()
    loaded = load_model(model)
    stage = _compensable(model, loaded)
    hysteresis = static_equivalent(stage) if isinstance(stage, Stage) else stage
    files = export_c(hysteresis, out, name, size=memory, limits_V=_limits(limits))
    # The inverse of mechanics needs the samples to come, which a controller does not have.
    remarks = [_STATIC_ONLY] if isinstance(stage, Stage) else []
    if as_json:
        click.echo(json.dumps({"files": [str(file) for file in files], "remarks": remarks}, indent=1))
    else:
        click.echo("\n".join([*(f"Note: {remark}" for remark in remarks), *map(str, files)]))


def _compensable(path: str, loaded: ModelFile) -> Preisach | Stage:
    return loaded.model if isinstance(loaded.model, Stage) else preisach_of(path, loaded)


def _displacement_sd_um(loaded: ModelFile, program: Record, initial: str) -> np.ndarray | None:
    """Standard deviation of a model's displacement, where the file says enough for one."""
    if isinstance(loaded.model, Stage) and isinstance(loaded.uncertainty, StageUncertainty):
        return predict_stage(loaded.model, loaded.uncertainty, program, initial).displacement_sd_um
    if isinstance(loaded.model, Preisach) and isinstance(loaded.uncertainty, Uncertainty):
        return predict(loaded.model, loaded.uncertainty, program, initial).displacement_sd_um
    return None


def parse_rig_limits(
    volts: str | None, limit: Sequence[str], margin: float
) -> tuple[tuple[float, float] | None, Ranges]:
    """Read `--limits`, `--limit` and `--margin`: the range of the command in V, and what else is stated."""
    stated = parse_limits(limit)
    allowed({}, stated, margin)
    both = _limits(volts)
    if "voltage" not in stated:
        return both, stated
    if both is not None:
        raise DataError("--limit voltage: --limits states that already; leave one of them out.")
    return stated["voltage"], stated


def _limits(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        raise DataError(
            f"--limits: expected two voltages such as 0,100, found '{text}'; write LOW,HIGH in V."
        ) from None
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise DataError(
            f"--limits: expected two finite voltages, the lower one first, found '{text}'; write LOW,HIGH in V."
        )
    return low, high
