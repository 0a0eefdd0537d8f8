"""The command `microid compensate`: its options, and the work."""

from typing import Any

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.cli import _options as options
from fits.io._errors import DataError
from fits.io._file_set import file_set
from fits.io._length import length


@click.command()
@options.model
@options.reference
@options.out_csv("VOLTAGE.csv")
@click.option(
    "--static", "way", flag_value="static", default="static", help="Compensate the hysteresis only: the default."
)
@click.option("--dynamic", "way", flag_value="dynamic", help="Compensate the mechanics and the driver too.")
@click.option("--clip", is_flag=True, help="Where the reference is out of reach take the nearest that is not.")
@options.limits
@options.limit
@options.margin
@options.initial("the reference")
@options.plots("a plot")
@options.columns
@options.json_output
@common.in_sentences
def compensate(given: common.Given) -> None:
    """Find the voltage that makes the stage follow a reference.

    REFERENCE.csv needs the columns time_s and displacement_um: what the sensor is to read, with the model's
    offset_um at rest at the lowest voltage: 0 for the models of diagnose. The result has time_s, voltage_V and
    displacement_um, which is what the model then does.
    """
    import numpy as np

    late.check_table_name(given.out)
    common.refuse_overwriting(given.out, [given.model, given.reference])
    volts, stated = common.parse_rig_limits(given.limits, given.limit, given.margin)
    wanted = late.read_reference(given.reference, **common.reading(given))
    every = bool({"velocity", "acceleration", "current"} & set(stated))
    loaded = common.opened(given.model, plain=given.way == "static" and not (every or given.plots))
    stage: Any = loaded if isinstance(loaded, late.PlainModel) else common.stage_or_preisach(given.model, loaded)
    if given.way == "dynamic" and isinstance(stage, late.Preisach):
        raise DataError(
            f"{given.model}: expected a model with mechanics for --dynamic, found a Preisach model, which has none; "
            "leave out --dynamic, or fit a whole stage."
        )
    with file_set() as made:
        unfinished, drawings = made.file(given.out), made.folder(given.plots)
        asked = stage, wanted, given.initial, given.clip, volts
        plain = isinstance(stage, late.PlainModel)
        try:
            found = late.compensate_plain(*asked) if plain else late.compensate(*asked, given.way)
        except DataError as error:
            raise DataError(str(error).replace("clip=True", "--clip"), of_model=error.of_model) from error
        program = late.Record(wanted.time_s, found.voltage_V, None, source=wanted.source)
        if plain:
            predicted = stage.ranges(program, found.displacement_um, given.initial)
        else:
            predicted = late.predicted_ranges(stage, program, found.displacement_um, given.initial, every)
        said = late.check_command(wanted.source, predicted, late.reached_in(loaded.report), stated, given.margin)
        sd_um = None
        if loaded.uncertainty is not None:
            sd_um = common.predicted_by(given.model, loaded, program, given.initial).displacement_sd_um
            late.refuse_nonfinite("displacement_sd_um", sd_um)
        to_draw = stage, wanted, found, sd_um
        same: dict[str, Any] = {"initial": given.initial, "form": given.form}
        drawn = [] if drawings is None else late.plot_compensation(*to_draw, drawings, **same)
        table = {"time_s": wanted.time_s, "voltage_V": found.voltage_V, "displacement_um": found.displacement_um}
        late.write_table(unfinished, table)
    off = np.abs(found.displacement_um - found.reference_um)
    places = common.paths_in(given.plots, drawn)
    remarks = [*wanted.warnings, *found.remarks, *said]
    summary = {
        "out": given.out,
        "plots": places,
        "samples": len(wanted),
        "clipped": int(found.clipped.sum()),
        "voltage_min_V": float(found.voltage_V.min()),
        "voltage_max_V": float(found.voltage_V.max()),
        "offset_um": float((stage.static if plain else late.static_equivalent(stage)).offset_um),
        "error_max_um": float(off.max()),
        "error_max_within_reach_um": float(off[~found.clipped].max(initial=0.0)),
        "displacement_sd_median_um": None if sd_um is None else float(np.median(sd_um)),
        "remarks": remarks,
    }
    lines = [
        f"{len(wanted)} samples, {summary['voltage_min_V']:.6g} to {summary['voltage_max_V']:.6g} V",
        f"by the model   within {length(summary['error_max_within_reach_um'])} of the reference where it is in reach",
    ]
    if sd_um is not None:
        lines.append(f"expected       standard deviation {length(float(np.median(sd_um)))} in the median")
    lines.append(
        f"offset         the reference is a sensor's reading, {summary['offset_um']:.6g} um at negative saturation"
    )
    if summary["clipped"]:
        lines.append(
            f"clipped        at {summary['clipped']} of the samples, off by at most {length(float(off.max()))}"
        )
    lines += [f"Note: {remark}" for remark in remarks]
    lines += [f"voltage        {given.out}", *(f"plot           {place}" for place in places)]
    common.print_result(given, summary, lines)
