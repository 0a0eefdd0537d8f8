"""Files as other programs write them: each is read to the numbers that were written, and fitted by one command."""

import json
import shlex
import sys
from dataclasses import replace

import h5py
import numpy as np
import pandas as pd
import pytest
from _command import refused, run
from nptdms import ChannelObject, TdmsWriter
from scipy.io import savemat

import fits
from fits.io._units import parse_columns

N, RATE_Hz = 240, 500
LVM = """LabVIEW Measurement\t
Writer_Version\t2
Separator\tTab
Decimal_Separator\t.
Multi_Headings\tNo
X_Columns\t{x}
Time_Pref\tRelative
Date\t2026/11/25
Time\t10:00:00.1
***End_of_Header***\t
\t
Channels\t2\t
Samples\t240\t240\t
Date\t2026/11/25\t2026/11/25\t
Y_Unit_Label\tVolts\tMicrometers\t
X_Dimension\tTime\tTime\t
X0\t0.0000000000000000E+0\t0.0000000000000000E+0\t
Delta_X\t0.002000\t0.002000\t
***End_of_Header***\t\t\t
X_Value\tVoltage\tDisplacement\tComment
"""
DSPACE = """header;
experiment;"C:\\rig, old\\exp1.idf"
date;25.11.2026 10:00:00
sampling period;0,002

"time";"Platform()://Model Root/DAC/Out1";"Platform()://Model Root/ENC/x"
s;V;µm
"""


def signals():
    """Two loops of a play operator under noise, rounded as files are: time_s, voltage_V and displacement_um."""
    count = np.arange(N)
    voltage_V = np.round(50 - 50 * np.cos(4 * np.pi * count / (N - 1)), 4)
    play_V, at = np.zeros(N), 0.0
    for k, value in enumerate(voltage_V):
        play_V[k] = at = min(max(at, value - 5), value + 5)
    noise_um = 0.02 * np.random.default_rng(1).standard_normal(N)
    return count / RATE_Hz, voltage_V, np.round(0.2 * play_V + 1 + noise_um, 5)


def rows(*columns, separator=",", decimal="."):
    cells = zip(*(column.tolist() for column in columns), strict=True)
    return "".join(separator.join(map(repr, row)).replace(".", decimal) + "\n" for row in cells)


def clock(time_s, sep="T"):
    stamps = pd.Timestamp("2026-11-25 10:00") + pd.to_timedelta(time_s, unit="s")
    return [stamp.isoformat(sep=sep) for stamp in stamps]


def mat_5(path, t, v, y):
    savemat(path, {"t": t, "drive": v, "gauge": y, "fs": 500.0, "note": "rig 3"}, do_compression=True)


def mat_7_3(path, t, v, y):
    # MATLAB's own block of 512 bytes precedes what is an HDF5 file; a vector is stored as a matrix.
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in {"rec/t": t, "rec/drive": v, "rec/gauge": y}.items():
            file.create_dataset(name, data=values[None, :]).attrs["MATLAB_class"] = np.bytes_("double")
        file.create_dataset("note", data=np.zeros((1, N), np.uint16)).attrs["MATLAB_class"] = np.bytes_("char")
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def tdms(path, t, v, y):
    timing = {"wf_increment": 1 / RATE_Hz}
    with TdmsWriter(path) as writer:
        volts = ChannelObject("run", "drive", v, timing | {"unit_string": "Volts"})
        writer.write_segment([volts, ChannelObject("run", "gauge", y, timing | {"unit_string": "um"})])


def hdf5(path, t, v, y):
    with h5py.File(path, "w") as file:
        for name, values, units in (("time", t, "s"), ("voltage", v, "V"), ("displacement", y, "µm")):
            file.create_dataset(f"run/{name}", data=values, compression="gzip").attrs["units"] = units
        file["run/settings"] = np.arange(5.0)


def headerless(path, t, v, y):
    path.write_text(rows(v, 0 * v, 2 * y, y))


def iso(path, t, v, y):
    lines = [f"{stamp}Z,{a!r},{b!r}" for stamp, a, b in zip(clock(t), v.tolist(), y.tolist(), strict=True)]
    path.write_text("\n".join(["timestamp,voltage_V,displacement_um", *lines]))


def units_row(path, t, v, y):
    path.write_text("Time,Drive,Gauge\n[s],[V],[µm]\n" + rows(t, v, y))


def semicolon(path, t, v, y):
    path.write_text("Zeit;Spannung (V);Weg (um)\n" + rows(t, v, y, separator=";", decimal=","))


def dspace(path, t, v, y):
    path.write_text(DSPACE + rows(t, v, y, separator=";", decimal=",").replace("\n", ";\n"))


def labview(path, t, v, y):
    path.write_text(LVM.format(x="One") + rows(t, v, y, separator="\t"))


NAMED = "time_s=t[s],voltage_V=drive[V],displacement_um=gauge[um]"
FOREIGN = {
    "mat_5.mat": (mat_5, ["--columns", NAMED]),
    "mat_7_3.mat": (mat_7_3, ["--columns", NAMED]),
    "run.tdms": (tdms, ["--columns", "voltage_V=drive,displacement_um=gauge"]),
    "run.h5": (hdf5, []),
    "headerless.csv": (headerless, ["--columns", "1,4", "--sample-rate", "500"]),
    "iso.csv": (iso, []),
    "units.csv": (units_row, ["--columns", "voltage_V=Drive,displacement_um=Gauge"]),
    "semicolon.csv": (semicolon, ["--columns", "time_s=Zeit[s],voltage_V=2,displacement_um=3"]),
    "dspace.csv": (dspace, ["--columns", "voltage_V=2,displacement_um=3"]),
    "run.lvm": (labview, []),
}  # fmt: skip


def written(folder, name):
    path = folder / name
    t, v, y = signals()
    FOREIGN[name][0](path, t, v, y)
    return path


def assert_same(record):
    for found, expected in zip((record.time_s, record.voltage_V, record.displacement_um), signals(), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert record.warnings == ()


@pytest.mark.parametrize("name", FOREIGN)
def test_a_foreign_file_is_read_exactly_by_one_command(tmp_path, monkeypatch, name):
    """What the command hands to the fit is what was written, and so is what `inspect` says to paste."""
    got = []

    def fit(records, **options):
        got.extend(records)
        raise fits.DataError("seen")

    monkeypatch.setattr("fits.cli._late.fit", fit, raising=False)
    path = written(tmp_path, name)
    refused(run("fit", path, *FOREIGN[name][1], "--out", tmp_path / "m.json"), "seen")
    assert_same(got.pop())
    told = json.loads(run("inspect", path, "--json").stdout)
    said = told["command"]
    if name == "headerless.csv":
        # The rate stands nowhere, and nothing tells the third column from the fourth.
        said = said.replace(" HZ", " 500").replace("=3[", "=4[")
    _, command, *pasted = shlex.split(said)
    assert command == "fit"
    assert told["rows"] == N
    assert told["rate_Hz"] == (None if name == "headerless.csv" else pytest.approx(RATE_Hz))
    monkeypatch.chdir(tmp_path)
    refused(run("fit", *pasted), "seen")
    assert_same(got.pop())


@pytest.mark.study
def test_foreign_files_are_fitted_by_one_command(tmp_path):
    """All hold the same run, so all give the same model."""
    errors = []
    for name, (_, options) in FOREIGN.items():
        path = written(tmp_path, name)
        done = run("fit", path, *options, "--levels", 8, "--out", tmp_path / "m.json", "--json", "--quiet")
        assert done.exit_code == 0, done.stderr
        errors.append(json.loads(done.stdout)["held_out"]["e_rms_pct"])
    assert errors == [pytest.approx(errors[0], rel=1e-9)] * 10


def frames():
    """The run as objects of other libraries."""
    t, v, y = signals()
    frame = pd.DataFrame({"time_s": t, "voltage_V": v, "displacement_um": y})
    stamped = frame[["voltage_V", "displacement_um"]].set_index(pd.DatetimeIndex(clock(t), tz="Europe/Zurich"))
    return {
        "frame": frame,
        "indexed": frame.set_index("time_s"),
        "stamped": stamped,
        "timedelta": stamped.set_index(pd.to_timedelta(t, unit="s")),
        "xarray": frame.set_index("time_s").to_xarray(),
        "mapping": {"time_s": t, "voltage_V": v, "displacement_um": list(y)},
    }


@pytest.mark.parametrize("kind", ["frame", "indexed", "stamped", "timedelta", "xarray", "mapping"])
def test_objects_of_other_libraries_are_read_as_files_are(kind):
    assert_same(fits.read_table(frames()[kind]))


def test_what_is_no_table_is_refused():
    with pytest.raises(fits.DataError, match="a DataFrame or a mapping of arrays, found list"):
        fits.read_table([1, 2, 3])


OTHERS = {
    "run.npz": lambda path, t, v, y: np.savez(path, time_s=t, voltage_V=v, displacement_um=y, fs=500.0),
    "run.npy": lambda path, t, v, y: np.save(path, np.stack([t, v, y])),
    "run.parquet": lambda path, t, v, y: frames()["frame"].to_parquet(path),
    "even.lvm": lambda path, t, v, y: path.write_text(
        LVM.format(x="No") + "".join(f"\t{a!r}\t{b!r}\n" for a, b in zip(v.tolist(), y.tolist(), strict=True))
    ),
    "dspace.mat": lambda path, t, v, y: savemat(
        path, {"exp1": {"X": {"Name": "time", "Unit": "s", "Data": t},
                        "Y": [{"Name": "u", "Unit": "V", "Data": v}, {"Name": "x", "Unit": "um", "Data": y}]}}
    ),
    "above.csv": lambda path, t, v, y: path.write_text("Model,TDS\nSerial,12,34\n\nTIME,CH1,CH2\n" + rows(t, v, y)),
}  # fmt: skip


@pytest.mark.parametrize("name", OTHERS)
def test_further_formats(tmp_path, name):
    OTHERS[name](tmp_path / name, *signals())
    named = {"run.npy": "1,2,3", "above.csv": "1,2,3", "dspace.mat": "voltage_V=u,displacement_um=x"}.get(name, "")
    assert_same(fits.read_table(tmp_path / name, parse_columns(named)))


def test_a_comment_that_ends_in_a_unit_is_no_header(tmp_path):
    path = tmp_path / "comment.csv"
    path.write_text("# one sample per 2 ms\n" + TABLE)
    assert_same(fits.read_table(path, parse_columns("1,2,3")))


def test_several_tables_in_a_labview_file_are_told_apart(tmp_path):
    path = tmp_path / "two.lvm"
    t, v, y = signals()
    labview(path, t, v, y)
    # The second is in mV and nm, in its own header, and begins elsewhere.
    second = LVM.partition("***End_of_Header***\t\n\t\n")[2].replace("Volts", "mV").replace("Micrometers", "nm")
    path.write_text(f"{path.read_text()}\n{second}{rows(t, 2000 * v, 1000 * y, separator=chr(9))}")
    record = fits.read_table(path)
    assert record.warnings == (f"{path}: it holds 2 tables, and the first was read; the second is {path}#2.",)
    assert_same(replace(record, warnings=()))
    other = fits.read_table(f"{path}#2")
    assert other.warnings == ()
    np.testing.assert_allclose(other.voltage_V, 2 * v, rtol=0, atol=1e-9)
    np.testing.assert_allclose(other.displacement_um, y, rtol=0, atol=1e-9)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:-1], f"x{lines[-1]}"]))
    with pytest.raises(fits.DataError, match=rf"two\.lvm#2, line {len(lines)}, column 'time"):
        fits.read_table(f"{path}#2")
    with pytest.raises(fits.DataError, match="expected a table from 1 to 2, found number 3"):
        fits.read_table(f"{path}#3")


def test_missing_numbers_are_refused_or_dropped(tmp_path):
    t, v, y = signals()
    holes = y.copy()
    holes[[7, 90]] = np.nan
    keep = np.isfinite(holes)
    path = tmp_path / "holes.csv"
    path.write_text("# rig 3\ntime_s,voltage_V,displacement_um\n" + rows(t, v, holes).replace("nan", "", 1))
    for source, place in (
        (path, "line 10"),
        (pd.DataFrame({"time_s": t, "voltage_V": v, "displacement_um": holes}), "row 8"),
    ):
        words = f"{place}, column 'displacement_um': expected a finite .*missing=\"drop\""
        with pytest.raises(fits.DataError, match=words):
            fits.read_table(source)
        for how in ({}, {"columns": {"voltage_V": "2", "displacement_um": "3"}, "sample_rate_Hz": 500.0}):
            record = fits.read_table(source, missing="drop", **how)
            np.testing.assert_array_equal(record.time_s, t[keep])
            np.testing.assert_array_equal(record.displacement_um, y[keep])
            assert "2 of 240 rows were left out" in record.warnings[0]
    refused(run("fit", path, "--out", tmp_path / "m.json"), "line 10", "--missing drop")
    assert "--missing drop" in json.loads(run("inspect", path, "--json").stdout)["command"]


STAMPS = "timestamp,voltage_V,displacement_um\n2026-01-01T00:00:00,1,1\n{},2,2\n"
TABLE = rows(*signals())
REFUSED = {
    "two numbers": (TABLE, {"columns": parse_columns("1,2")}, "expected by columns 3 numbers.*sample_rate_Hz"),
    "beyond": (TABLE, {"columns": parse_columns("1,2,4")}, "column '4'.*no such column"),
    "time twice": (TABLE, {"columns": {"time_s": "1"}, "sample_rate_Hz": 5.0}, "leave one of them out"),
    "no rate": (TABLE, {"columns": parse_columns("2,3"), "sample_rate_Hz": 0.0}, "above 0"),
    "broken stamp": (STAMPS.format("2026-13-01T00:00:00"), {}, "time stamp"),
    "no stamp": (STAMPS.format("noon"), {}, "line 3.*time stamp, found 'noon'"),
}  # fmt: skip


@pytest.mark.parametrize(("text", "how", "words"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_read_so_is_refused(tmp_path, text, how, words):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(fits.DataError, match=words):
        fits.read_table(path, **how)


@pytest.mark.parametrize("name", ["a.mat", "a.h5", "a.npz", "a.npy", "a.parquet", "a.tdms", "a.lvm"])
def test_damaged_files_end_in_one_sentence(tmp_path, name, rng):
    starts = {
        "a.mat": b"MATLAB 5.0 MAT-file",
        "a.h5": b"\x89HDF\r\n\x1a\n",
        "a.npz": b"PK\x03\x04",
        "a.npy": b"\x93NUMPY",
    }
    starts |= {"a.parquet": b"PAR1", "a.tdms": b"TDSm", "a.lvm": b"LabVIEW Measurement\t\n"}
    (tmp_path / name).write_bytes(starts[name] + (b"" if name == "a.lvm" else rng.bytes(900)))
    refused(run("inspect", tmp_path / name), name)


@pytest.mark.parametrize(("package", "name"), [("h5py", "run.h5"), ("nptdms", "run.tdms")])
def test_a_missing_library_is_one_sentence(tmp_path, monkeypatch, package, name):
    path = written(tmp_path, name)
    monkeypatch.setitem(sys.modules, package, None)
    refused(
        run("fit", path, "--out", tmp_path / "m.json"), f"needs the package {package}", 'pip install "microid[io]"'
    )


def test_inspect_says_what_is_there_in_words(tmp_path):
    told = run("inspect", written(tmp_path, "units.csv"))
    assert told.exit_code == 0
    head, _, time, drive, gauge, _, command = told.stdout.splitlines()
    assert head.endswith("units.csv: 240 rows, 500 Hz")
    assert time.split() == ["1", "Time[s]", "s", "0", "0.478", "time_s"]
    assert drive.split() == ["2", "Drive[V]", "V", "0", "99.9957", "(voltage_V)"]
    assert gauge.split()[:3] == ["3", "Gauge[um]", "um"]
    assert command.startswith("microid fit ")


def test_inspect_refuses_what_holds_no_numbers_and_says_nothing_of_a_rate_without_a_command(tmp_path):
    (tmp_path / "letter.csv").write_text("Dear Sir,\nthis is no data\n")
    refused(run("inspect", tmp_path / "letter.csv"), "letter.csv", "expected columns of numbers")
    (tmp_path / "air.csv").write_text("air_degC,name\n2,a\n1,b\n2,c\n")
    told = run("inspect", tmp_path / "air.csv")
    assert told.exit_code == 0
    assert "no columns of voltage and displacement were found" in told.stdout
    assert "HZ" not in told.stdout
