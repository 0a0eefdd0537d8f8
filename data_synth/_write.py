"""Records to CSV files, and the truth to a file of its own."""

import json
import os
import tempfile
from dataclasses import asdict
from pathlib import Path

from data_synth._bench import Bench, Record
from data_synth._errors import ScenarioError

SCHEMA = "data_synth.truth/1"
"""What `truth.json` calls itself."""


def files(bench: Bench) -> dict[str, str]:
    """Make the text of each file by its name: `<run>.csv` for each run, and `truth.json` last.

    A CSV has the columns `time_s,voltage_V,displacement_um`, and `temperature_C` and `other_um` where these are
    measured, and nothing else: what is true stands in `truth.json` only. The same seed gives the same bytes.
    """
    return {f"{record.name}.csv": _csv(record) for record in bench.records} | {"truth.json": _truth(bench)}


def write(bench: Bench, folder: str | Path) -> list[Path]:
    """Write `files` into a folder that is made if need be: all under temporary names first, then each is renamed.

    Returns
    -------
    list[Path]
        The files, `truth.json` last.

    Raises
    ------
    ScenarioError
        If the folder cannot be written to.
    """
    folder = Path(folder)
    contents = files(bench)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".data_synth-") as unfinished:
            for name, text in contents.items():
                Path(unfinished, name).write_bytes(text.encode())
            for name in contents:
                os.replace(Path(unfinished, name), folder / name)
    except OSError as error:
        raise ScenarioError(f"{folder}: cannot be written to: {error.strerror}") from error
    return [folder / name for name in contents]


def _csv(record: Record) -> str:
    columns = {name: values.tolist() for name, values in record.columns().items()}
    rows = [",".join(map(repr, row)) for row in zip(*columns.values(), strict=True)]
    return "\n".join([",".join(columns), *rows, ""])


def _truth(bench: Bench) -> str:
    sensor = asdict(bench.scenario.sensor)
    if not bench.scenario.sensor.correlation:  # white noise, as it was before there was any other
        del sensor["correlation"]
    truth = {
        "schema": SCHEMA,
        "scenario": {"name": bench.scenario.name, "text": bench.scenario.text},
        "seed": bench.seed,
        "rig": asdict(bench.rig),
        **({} if bench.plant is None else {"plant": asdict(bench.plant)}),
        **({"effects": [asdict(effect) for effect in bench.effects]} if bench.effects else {}),
        "sensor": sensor,
        "runs": {
            record.name: {
                "history_V": record.history_V.tolist(),
                "displacement_um": record.true_displacement_um.tolist(),
            }
            for record in bench.records
        },
    }
    return json.dumps(truth, indent=1, allow_nan=False) + "\n"
