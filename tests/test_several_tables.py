"""Several tables in one text: which is read, and how another is named."""

import json
from dataclasses import replace

import numpy as np
from _command import refused, run, whole_picture
from test_foreign_files import assert_same, rows, signals, written

import fits


def tables(folder):
    """Two runs, the second in mV, and a table of two rows between them, in one text; and the first without it."""
    t, v, y = signals()
    first = f"time_s,voltage_V,displacement_um\n{rows(t, v, y)}"
    second = f"time_s,voltage_mV,displacement_um\n{rows(t, np.round(1000 * v, 1), y)}"
    (folder / "all.csv").write_text(f"# rig 3\n{first}\n\n# constants\nname,value\n1,2\n3,4\n , ,\n{second}\n")
    return folder / "all.csv"


def test_of_several_tables_in_a_text_one_is_read_and_said(tmp_path):
    path = tables(tmp_path)
    record = fits.read_table(path)
    assert record.warnings == (f"{path}: it holds 3 tables, and the first was read; the second is {path}#2.",)
    assert_same(replace(record, warnings=()))
    third = fits.read_table(f"{path}#3")
    assert (third.source, third.warnings) == ("all.csv#3", ())
    np.testing.assert_allclose(third.voltage_V, signals()[1], rtol=0, atol=1e-9)
    # Lines are those of the file.
    (tmp_path / "bad.csv").write_text(path.read_text().replace("0.002,", "x,"))
    lines = (tmp_path / "bad.csv").read_text().splitlines()
    bad = [k for k, line in enumerate(lines, 1) if line.startswith("x,")]
    for name, line in zip(("bad.csv", "bad.csv#3"), bad, strict=True):
        refused(run("fit", tmp_path / name, "--out", tmp_path / "m.json"), f"{name}, line {line}, column 'time_s'")
    refused(run("fit", f"{path}#2", "--out", tmp_path / "m.json"), "all.csv#2, line 246, column 'time_s'")
    refused(run("inspect", f"{path}#4"), "expected a table from 1 to 3, found number 4")
    refused(run("simulate", tmp_path / "no.json", f"{path}#1", "--out", path), "would overwrite what is read")
    told = json.loads(run("inspect", f"{path}#3", "--json").stdout)
    assert told["command"] == f"microid fit '{path}#3' --out model.json"
    assert run("inspect", path).stdout.count("3 tables") == 1
    (tmp_path / "tiny.csv").write_text("a,b\n1,2\n\nc,d\n3,4\n")
    assert "it holds 2 tables" in run("inspect", tmp_path / "tiny.csv").stdout
    refused(run("inspect", f"{written(tmp_path, 'run.h5')}#2"), "several tables, found an HDF5 file; leave out #2")
    # A file of that very name is what is meant.
    (tmp_path / "all.csv#2").write_text(path.read_text().partition("\n\n")[0])
    assert_same(fits.read_table(f"{path}#2"))


def test_inspect_draws_the_channels(tmp_path):
    path = tables(tmp_path)
    told = run("inspect", path, "--plots", tmp_path / "plots")
    assert told.exit_code == 0, told.output
    assert told.stdout.splitlines()[-1] == f"plot   {tmp_path / 'plots' / 'channels.png'}"
    two = whole_picture(tmp_path / "plots" / "channels.png")
    # Numbers without names are drawn over their rows, all but text.
    assert run("inspect", f"{written(tmp_path, 'headerless.csv')}", "--plots", tmp_path / "more").exit_code == 0
    assert whole_picture(tmp_path / "more" / "channels.png").shape[0] > 1.5 * two.shape[0]


def test_words_between_rows_are_no_table(tmp_path):
    path = tmp_path / "paused.csv"
    t, v, y = signals()
    half = rows(t[:90], v[:90], y[:90]), rows(t[90:], v[90:], y[90:])
    path.write_text("time_s,voltage_V,displacement_um\n" + "\npaused\n".join(half))
    refused(run("fit", path, "--out", tmp_path / "m.json"), "paused.csv, line 93")
