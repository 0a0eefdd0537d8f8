"""The `microid` command: the work."""

import json
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import click
import numpy as np

from fits._atomic import atomic_path, write_csv
from fits._cli_jax import start_jax
from fits._errors import DataError
from fits._fit import fit
from fits._model_file import ModelFile, load_model, model_text
from fits._plots import plot_fit
from fits._read_csv import read_csv, read_runs
from fits._record import Record
from fits._report import describe, fit_report
from fits._result import FitError, Prediction, predict
from fits._stage_report import describe_stage
from fits._stage_result import predict_stage
from fits._stage_uncertainty import StageUncertainty
from fits._units import parse_columns
from microid import Preisach, Stage, parameter_table

_DEFAULT_HOLDOUT, _DEFAULT_FAMILY, _DEFAULT_INITIAL, _DEFAULT_STARTS = 0.2, "grid", "unknown", 8


def run_fit(
    *,
    runs: Sequence[str],
    out: str,
    plots: str | None,
    family: str | None,
    levels: int | None,
    loss: str | None,
    holdout: Sequence[str],
    columns: str,
    initial: Sequence[str],
    starts: int | None,
    seed: int | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Do `microid fit --model loop`; the options are the command's."""
    start_jax()
    if loss is not None:
        raise DataError(
            f"--loss {loss}: only the fit of a stage has a choice; leave out --loss, or use --model stage."
        )
    if len(initial) > 1:
        raise DataError(
            f"--initial: expected one state for all runs, found {len(initial)}; give one, or use --model stage."
        )
    before = initial[0] if initial else _DEFAULT_INITIAL
    progress = _progress(quiet)
    mapping = parse_columns(columns)
    fraction, files = _holdout(holdout)
    _keep_inputs(out, [*runs, *files])
    # Entered before the fit, so that a place that cannot be written to is refused before the wait.
    with atomic_path(out) as unfinished, _folder(plots) as drawings:
        records = read_runs(runs, mapping)
        aside = [read_csv(file, mapping) for file in files]
        left_out = aside or fraction
        try:
            result = fit(
                records,
                family=family or _DEFAULT_FAMILY,
                levels=levels,
                holdout=left_out,
                initial=before,
                starts=starts or _DEFAULT_STARTS,
                seed=seed or 0,
                progress=progress,
            )
        except FitError as error:
            raise DataError(f"{error}.") from error
        report = fit_report(result)
        drawn = []
        if drawings is not None:
            progress("drawing")
            drawn = plot_fit(result, records, drawings(), holdout=left_out, initial=before)
        unfinished.write_text(model_text(result.model, result.uncertainty, report), encoding="utf-8")
    places = [str(Path(plots) / path.name) for path in drawn] if plots else []
    if as_json:
        click.echo(json.dumps({"out": out, "plots": places, **report}, indent=1, allow_nan=False))
    else:
        click.echo("\n".join([describe(report), "", f"model  {out}", *(f"plot   {place}" for place in places)]))


def run_simulate(*, model: str, program: str, out: str, initial: str, columns: str, as_json: bool) -> None:
    """Do `microid simulate`; the options are the command's."""
    start_jax()
    _keep_inputs(out, [model, program])
    loaded = load_model(model)
    record = read_csv(program, parse_columns(columns), required=("time_s", "voltage_V"))
    prediction = _predict(model, loaded, record, initial)
    write_csv(
        out,
        {
            "time_s": record.time_s,
            "voltage_V": record.voltage_V,
            "displacement_um": prediction.displacement_um,
            "displacement_sd_um": prediction.displacement_sd_um,
        },
    )
    summary = {
        "out": out,
        "samples": len(record),
        "displacement_min_um": float(prediction.displacement_um.min()),
        "displacement_max_um": float(prediction.displacement_um.max()),
        "displacement_sd_median_um": float(np.median(prediction.displacement_sd_um)),
        "remarks": list(record.warnings),
    }
    if as_json:
        click.echo(json.dumps(summary, indent=1, allow_nan=False))
        return
    click.echo(
        f"{len(record)} samples, {summary['displacement_min_um']:.6g} to {summary['displacement_max_um']:.6g} um, "
        f"standard deviation {summary['displacement_sd_median_um']:.3g} um in the median"
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
        click.echo(json.dumps(content, indent=1, allow_nan=False))
        return
    click.echo(f"{kind}, written by {loaded.written_by}")
    for row in parameters:
        click.echo(f"  {row['path']:28} {'x'.join(map(str, row['shape'])) or '1':>8} {row['unit']}")
    words = describe_stage if isinstance(loaded.uncertainty, StageUncertainty) else describe
    click.echo(f"\n{words(loaded.report)}")


def _predict(path: str, loaded: ModelFile, record: Record, initial: str) -> Prediction:
    """Predict with whatever model a file holds."""
    if isinstance(loaded.uncertainty, StageUncertainty):
        assert isinstance(loaded.model, Stage)
        return predict_stage(loaded.model, loaded.uncertainty, record, initial)
    return predict(_preisach(path, loaded), loaded.uncertainty, record, initial)


def _preisach(path: str, loaded: ModelFile) -> Preisach:
    if isinstance(loaded.model, Preisach):
        return loaded.model
    raise DataError(f"{path}: expected a Preisach model, found a {type(loaded.model).__name__}; fit one first.")


def _progress(quiet: bool) -> Callable[[str], None]:
    began = time.monotonic()

    def tell(sentence: str) -> None:
        if not quiet:
            click.echo(f"{time.monotonic() - began:6.1f} s  {sentence}", err=True)

    return tell


def _holdout(given: Sequence[str]) -> tuple[float, list[str]]:
    """Tell a fraction from files."""
    numbers = []
    for text in given:
        try:
            numbers.append(float(text))
        except ValueError:
            continue
    if not given:
        return _DEFAULT_HOLDOUT, []
    if not numbers:
        return 0.0, list(given)
    if len(given) > 1:
        raise DataError("--holdout: expected one fraction, or files only, found a fraction with others; choose one.")
    if not 0 <= numbers[0] <= 0.9:
        raise DataError(f"--holdout: expected a fraction between 0 and 0.9 or a file, found {given[0]}.")
    return numbers[0], []


def _keep_inputs(out: str, inputs: Iterable[str]) -> None:
    for path in inputs:
        if os.path.realpath(path) == os.path.realpath(out):
            raise DataError(f"--out: {out} would overwrite what is read; choose another name.")


@contextmanager
def _folder(path: str | None) -> Iterator[Callable[[], Path] | None]:
    """Yield a function that makes a temporary folder; what is in it moves to `path` at the end, or nowhere."""
    if path is None:
        yield None
        return
    target = Path(os.path.realpath(path))
    anchor = next(place for place in (target, *target.parents) if place.exists())
    if not anchor.is_dir() or not os.access(anchor, os.W_OK | os.X_OK):
        raise DataError(f"{path}: expected a folder that can be written to; choose another for --plots.")
    made: list[Path] = []
    with ExitStack() as stack:

        def make() -> Path:
            made.append(Path(stack.enter_context(tempfile.TemporaryDirectory(dir=anchor, prefix=".microid-"))))
            return made[-1]

        yield make
        try:
            target.mkdir(parents=True, exist_ok=True)
            for file in sorted(file for folder in made for file in folder.iterdir()):
                os.replace(file, target / file.name)
        except OSError as error:
            reason = error.strerror or error
            raise DataError(
                f"{path}: the plots cannot be put there ({reason}); choose another for --plots."
            ) from error
