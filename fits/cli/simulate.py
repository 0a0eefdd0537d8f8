"""The command `microid simulate`: its options, and the work."""

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.cli import _options as options
from fits.io._file_set import check_file
from fits.io._length import length


@click.command()
@options.model
@click.argument("program", metavar="PROGRAM.csv")
@options.out_csv("PREDICTION.csv")
@click.option(
    "--initial",
    metavar="STATE|RUN",
    default="negative",
    show_default=True,
    help="Memory before the program: negative, positive, demagnetised or unknown, or as before a run of the fit.",
)
@options.columns
@options.json_output
@common.in_sentences
def simulate(given: common.Given) -> None:
    """Predict the displacement of a voltage program, with its standard deviation.

    PROGRAM.csv needs the columns time_s and voltage_V. The prediction has time_s, voltage_V, displacement_um and
    displacement_sd_um; sensor noise is not in the last. Voltages beyond the model's range, by less than a thousandth
    of it, are taken as its ends, with a remark; others are refused.

    What a rig went through before is remembered until the voltage has been at both ends of its range. Where it is
    unknown the standard deviation has that. A run of the fit is named as it was then.
    """
    import numpy as np

    progress = common.now_and_then(common.progress_to_stderr(given.quiet))
    late.check_table_name(given.out)
    common.refuse_overwriting(given.out, [given.model, given.program])
    check_file(given.out)
    record = late.read_table(given.program, required=("time_s", "voltage_V"), **common.reading(given))
    loaded = common.opened(given.model)
    initial = late.memory_named(given.initial, loaded.report)
    prediction = common.predicted_by(given.model, loaded, record, initial, progress)
    displacement_um, sd_um = prediction.displacement_um, prediction.displacement_sd_um
    known = loaded.uncertainty is not None
    table = {"time_s": record.time_s, "voltage_V": record.voltage_V, "displacement_um": displacement_um}
    late.write_table(given.out, table | ({"displacement_sd_um": sd_um} if known else {}))
    summary = {
        "out": given.out,
        "samples": len(record),
        "displacement_min_um": float(displacement_um.min()),
        "displacement_max_um": float(displacement_um.max()),
        "displacement_sd_median_um": float(np.median(sd_um)) if known else None,
        "remarks": list(prediction.remarks),
    }
    spread = "of unknown standard deviation, as the model has none"
    if known:
        spread = f"standard deviation {length(summary['displacement_sd_median_um'])} in the median"
    lines = [
        f"{len(record)} samples, {summary['displacement_min_um']:.6g} to {summary['displacement_max_um']:.6g} um, "
        f"{spread}",
        *(f"Note: {remark}" for remark in prediction.remarks),
        f"prediction  {given.out}",
    ]
    common.print_result(given, summary, lines)
