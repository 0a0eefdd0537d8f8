"""The commands `microid simulate` and `microid info`: the work."""

import click
import numpy as np

from fits.cli._files import keep_inputs
from fits.io._atomic import finite_json, write_csv
from fits.io._errors import DataError
from fits.io._jax_setup import start_jax
from fits.io._read_csv import read_csv
from fits.io._record import Record
from fits.io._units import parse_columns
from fits.loop._result import Prediction, predict
from fits.loop._uncertainty import Uncertainty
from fits.report._loop import describe
from fits.report._stage import describe_stage
from fits.stage._model_file import ModelFile, load_model
from fits.stage._result import predict_stage
from fits.stage._uncertainty import StageUncertainty
from microid import Preisach, Stage, parameter_table


def run_simulate(*, model: str, program: str, out: str, initial: str, columns: str, as_json: bool) -> None:
    """Do `microid simulate`; the options are the command's."""
    start_jax()
    keep_inputs(out, [model, program])
    loaded = load_model(model)
    record = read_csv(program, parse_columns(columns), required=("time_s", "voltage_V"))
    prediction = _predict(model, loaded, record, initial)
    table = {
        "time_s": record.time_s,
        "voltage_V": record.voltage_V,
        "displacement_um": prediction.displacement_um,
    }
    known = loaded.uncertainty is not None
    if known:
        table["displacement_sd_um"] = prediction.displacement_sd_um
    write_csv(out, table)
    summary = {
        "out": out,
        "samples": len(record),
        "displacement_min_um": float(prediction.displacement_um.min()),
        "displacement_max_um": float(prediction.displacement_um.max()),
        "displacement_sd_median_um": float(np.median(prediction.displacement_sd_um)) if known else None,
        "remarks": list(record.warnings),
    }
    if as_json:
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
    click.echo("\n".join([f"Note: {remark}" for remark in record.warnings] + [f"prediction  {out}"]))


def run_info(*, model: str, as_json: bool) -> None:
    """Do `microid info`; the options are the command's."""
    start_jax()
    loaded = load_model(model)
    named = loaded.model.named if isinstance(loaded.model, Stage) else str
    parameters = [
        {"path": named(row.path), "shape": list(row.shape), "unit": row.spec.unit}
        for row in parameter_table(loaded.model)
    ]
    kind = type(loaded.model).__name__
    if as_json:
        content = {"written_by": loaded.written_by, "model": kind, "parameters": parameters, "fit": loaded.report}
        click.echo(finite_json(content))
        return
    lines = [f"{kind}, written by {loaded.written_by}"]
    for row in parameters:
        lines.append(f"  {row['path']:28} {'x'.join(map(str, row['shape'])) or '1':>8} {row['unit']}")
    click.echo("\n".join([*lines, "", _known_of_fit(model, loaded)]))


def _known_of_fit(path: str, loaded: ModelFile) -> str:
    if loaded.uncertainty is None:
        return "written by 'microid diagnose', whose report says how well it predicts"
    words = describe_stage if isinstance(loaded.uncertainty, StageUncertainty) else describe
    try:
        return words(loaded.report)
    except (LookupError, TypeError, ValueError, AttributeError):
        # The format does not say what a report holds, and the words are made for that of a fit.
        raise DataError(f"{path}: its report is not that of a fit; fit again, or add --json to see it.") from None


def _predict(path: str, loaded: ModelFile, record: Record, initial: str) -> Prediction:
    """Predict with whatever model a file holds."""
    if isinstance(loaded.model, Stage):
        assert not isinstance(loaded.uncertainty, Uncertainty)
        return predict_stage(loaded.model, loaded.uncertainty, record, initial)
    if not isinstance(loaded.uncertainty, Uncertainty):
        raise DataError(f"{path}: the file lacks the uncertainty of its model; fit again.")
    return predict(preisach_of(path, loaded), loaded.uncertainty, record, initial)


def preisach_of(path: str, loaded: ModelFile) -> Preisach:
    """Return the hysteresis that a model file holds; a `DataError` where it holds something else."""
    if isinstance(loaded.model, Preisach):
        return loaded.model
    raise DataError(f"{path}: expected a Preisach model, found a {type(loaded.model).__name__}; fit one first.")
