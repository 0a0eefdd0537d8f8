"""The command `microid simulate`: its options, and the work."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from fits.cli._common import Given, columns, in_sentences, initial, json_output
from fits.cli._files import keep_inputs
from fits.io._errors import DataError

if TYPE_CHECKING:
    from fits.io._record import Record
    from fits.loop._uncertainty import Prediction
    from fits.stage._model_file import ModelFile


@click.command()
@click.argument("model", metavar="MODEL.json")
@click.argument("program", metavar="PROGRAM.csv")
@click.option("--out", required=True, metavar="PREDICTION.csv", help="CSV to write; .gz is compressed.")
@initial("program")
@columns
@json_output
@in_sentences
def simulate(given: Given) -> None:
    """Predict the displacement of a voltage program, with its standard deviation.

    PROGRAM.csv needs the columns time_s and voltage_V. The prediction has time_s, voltage_V, displacement_um and
    displacement_sd_um; sensor noise is not in the last.
    """
    import numpy as np

    from fits.io._atomic import finite_json, write_csv
    from fits.io._jax_setup import start_jax
    from fits.io._read_csv import read_csv
    from fits.io._units import parse_columns
    from fits.stage._model_file import load_model

    start_jax()
    keep_inputs(given.out, [given.model, given.program])
    loaded = load_model(given.model)
    record = read_csv(given.program, parse_columns(given.columns), required=("time_s", "voltage_V"))
    prediction = _predict(given.model, loaded, record, given.initial)
    table = {
        "time_s": record.time_s,
        "voltage_V": record.voltage_V,
        "displacement_um": prediction.displacement_um,
    }
    known = loaded.uncertainty is not None
    if known:
        table["displacement_sd_um"] = prediction.displacement_sd_um
    write_csv(given.out, table)
    summary = {
        "out": given.out,
        "samples": len(record),
        "displacement_min_um": float(prediction.displacement_um.min()),
        "displacement_max_um": float(prediction.displacement_um.max()),
        "displacement_sd_median_um": float(np.median(prediction.displacement_sd_um)) if known else None,
        "remarks": list(record.warnings),
    }
    if given.as_json:
        click.echo(finite_json(summary))
        return
    spread = (
        f"standard deviation {summary['displacement_sd_median_um']:.3g} um in the median"
        if known
        else "of unknown standard deviation, as the model has none"
    )
    click.echo(
        f"{len(record)} samples, {summary['displacement_min_um']:.6g} to {summary['displacement_max_um']:.6g} um, "
        f"{spread}"
    )
    click.echo("\n".join([f"Note: {remark}" for remark in record.warnings] + [f"prediction  {given.out}"]))


def _predict(path: str, loaded: ModelFile, record: Record, initial: str) -> Prediction:
    """Predict with whatever model a file holds."""
    from fits.cli._models import preisach_of
    from fits.stage._predict import predict
    from microid import Stage

    model = loaded.model if isinstance(loaded.model, Stage) else preisach_of(path, loaded)
    if loaded.uncertainty is None and not isinstance(model, Stage):
        raise DataError(f"{path}: the file lacks the uncertainty of its model; fit again.")
    return predict(model, loaded.uncertainty, record, initial)
