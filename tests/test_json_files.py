"""Columns in JSON in the forms in which programs write them, and logs of servos and dampers that others measured."""

import json

import numpy as np
import pandas as pd
import pytest
from _command import refused, run
from _measured import measured

import fits

FORMS = {
    "named": lambda t, v, y: {"time_s": t, "voltage_V": v, "displacement_um": y, "rig": "b", "settings": [1, 2]},
    "grouped": lambda t, v, y: {"run": {"time_s": t, "voltage_V": v, "displacement_um": y}, "at": None},
    "split": lambda t, v, y: json.loads(
        pd.DataFrame({"time_s": t, "voltage_V": v, "displacement_um": y}).to_json(orient="split", double_precision=15)
    ),
    "rows": lambda t, v, y: [
        {"time_s": a, "voltage_V": b, "displacement_um": c} for a, b, c in zip(t, v, y, strict=True)
    ],
    "matrix": lambda t, v, y: {"data": np.column_stack([t, v, y]).tolist(), "dt": 0.01, "units": "s"},
    "bare": lambda t, v, y: np.column_stack([t, v, y]).tolist(),
}


def signals(rng):
    voltage_V = np.round(50 - 50 * np.cos(np.linspace(0, 9, 300)), 4)
    return np.arange(300) / 100, voltage_V, np.round(0.2 * voltage_V + 0.1 * rng.standard_normal(300), 5)


@pytest.mark.parametrize("name", FORMS)
def test_numbers_in_json_are_read_as_they_stand_there(tmp_path, rng, name):
    columns = signals(rng)
    path = tmp_path / "run.json"
    path.write_text(json.dumps(FORMS[name](*(column.tolist() for column in columns))))
    record = fits.read_csv(path, "1,2,3" if name in ("matrix", "bare") else None)
    for found, column in zip((record.time_s, record.voltage_V, record.displacement_um), columns, strict=True):
        np.testing.assert_array_equal(found, column)


def test_null_is_a_missing_number_and_other_content_is_refused(tmp_path, rng):
    time_s, voltage_V, displacement_um = (column.tolist() for column in signals(rng))
    displacement_um[7] = None
    path = tmp_path / "run.json"
    path.write_text(json.dumps({"time_s": time_s, "voltage_V": voltage_V, "displacement_um": displacement_um}))
    refused(run("fit", path, "--out", tmp_path / "m.json"), "row 8, column 'displacement_um'")
    assert len(fits.read_csv(path, missing="drop").time_s) == len(time_s) - 1
    for text, words in {
        '{"a": "b"}': "expected a JSON file with arrays of numbers, found none",
        '{"a": [1, 2], "b"': "expected a table in JSON, found a broken or cut one (",
        "[[1, 2], [3]]": "expected a JSON file with arrays of numbers, found none",
        "": "it is empty",
        "\xff": "run.json",
    }.items():
        path.write_bytes(text.encode("latin-1"))
        refused(run("inspect", path), words)


def test_a_first_row_with_empty_cells_is_a_row_and_numbers_of_channels_are_no_units(tmp_path):
    path = tmp_path / "log.csv"
    lines = [f"2026-11-29T10:00:{k / 10 + 10:06.3f}Z,{k % 7},{k % 5 + 0.5},{k}" for k in range(60)]
    path.write_text("timestamp,target pos (1),pos (1),load (2)\n2026-11-29T10:00:09.900Z,1,,\n" + "\n".join(lines))
    told = json.loads(run("inspect", path, "--json").stdout)
    assert [channel["unit"] for channel in told["channels"]] == ["s", None, None, None]
    assert [channel["use"] for channel in told["channels"]][:3] == ["time_s", "voltage_V", "displacement_um"]
    assert "'voltage_V=target pos (1)[V],displacement_um=pos (1)[um]' --missing drop" in told["command"]
    columns = "voltage_V=target pos (1)[0.1V],displacement_um=pos (1)[um]"
    refused(run("fit", path, "--columns", columns, "--out", tmp_path / "m.json"), "line 2, column 'pos (1)'")
    record = fits.read_csv(path, columns, missing="drop")
    np.testing.assert_allclose(record.time_s, np.arange(60) / 10, atol=1e-9)
    np.testing.assert_allclose(record.voltage_V, np.arange(60) % 7 / 10)
    np.testing.assert_allclose(record.displacement_um, np.arange(60) % 5 + 0.5)


@pytest.mark.parametrize(("name", "motor"), [("nocomp2", 1), ("nocomp2", 4), ("comp2", 2), ("single", 5)])
def test_logs_of_servos_are_read_as_they_are(name, motor):
    path = measured(f"servo_backlash/motor_telemetry_{name}.csv")
    columns = f"voltage_V=target pos ({motor})[0.1V],displacement_um=pos ({motor})[um]"
    record = fits.read_csv(path, columns, missing="drop")
    table = pd.read_csv(path).dropna(subset=[f"pos ({motor})"])
    np.testing.assert_allclose(record.voltage_V, table[f"target pos ({motor})"] / 10)
    np.testing.assert_array_equal(record.displacement_um, table[f"pos ({motor})"])
    stamps = pd.to_datetime(table["timestamp"], utc=True)
    np.testing.assert_allclose(record.time_s, (stamps - stamps.iloc[0]).dt.total_seconds(), atol=1e-6)
