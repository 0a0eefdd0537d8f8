"""Files as scopes, spreadsheets, ControlDesk and scripts write them, by the command that `inspect` gives to paste."""

import json
import shlex
from dataclasses import replace

import h5py
import numpy as np
import pandas as pd
import pytest
from _command import refused, run
from nptdms import ChannelObject, TdmsWriter
from scipy.io import loadmat, savemat
from test_foreign_files import LVM, RATE_Hz, assert_same, clock, rows, signals

import fits
from fits.io._inspect import inspect_table
from fits.io._units import parse_columns

T, V, Y = signals()
HEAD = "time_s,voltage_V,displacement_um\n"
DAY = [f"{int(t + 86399) // 3600 % 24:02d}:{int(t + 86399) // 60 % 60:02d}:{(t + 86399) % 60:06.3f}" for t in T]
CONTROLDESK = """[dSPACE] Measurement Data
version,1
experiment,"rig, old"

path,,Model Root/DAC,Model Root/ENC
description,,,
name,,Out1,x
unit,s,V,µm
trace_type,x,y,y
trace_values,,,
"""


def clocked(words, stamps=DAY, separator=","):
    return words + "".join(
        f"{at}{separator}{v!r}{separator}{y!r}\n" for at, v, y in zip(stamps, V.tolist(), Y.tolist(), strict=True)
    )


ODD = {
    "spaces": "time voltage displacement\n" + rows(T, V, Y, separator=" "),
    "right-aligned": "".join(f"{t:12.4f} {v:12.4f} {y:12.5f}\n" for t, v, y in zip(T, V, Y, strict=True)),
    "bars": "t|U|x\ns|V|um\n" + rows(T, V, Y, separator="|"),
    "header in a comment": "# rig 3\n# time_ms,voltage_mV,displacement_nm\n" + rows(1e3 * T, 1e3 * V, 1e3 * Y),
    "spaced header in a comment": "# time_s voltage_V displacement_um\n" + rows(T, V, Y, separator=" "),
    "ControlDesk": CONTROLDESK + "".join(f",{line}\n" for line in rows(T, V, Y).splitlines()),
    "names twice": "time,drive,time,position,x,x\n" + rows(T, V, T, Y, T, T),
    "words under the units": "Time,Drive,Gauge,Force\ns,V,um,N\nx,y,y,y\n" + rows(T, V, Y, V),
    "time of day": clocked("Time,Voltage,Displacement\n"),
    "time of day, decimal comma": clocked("Zeit;Spannung [V];Weg [µm]\n", DAY, ";").replace(".", ","),
    "noon": clocked(HEAD, [f"{at.replace('23:', '11:')} AM" if at[0] == "2" else f"12{at[2:]} PM" for at in DAY]),
    "day and time": clocked(HEAD, [f"11/25/2026 {9 + (at[0] == '0')}:{at[3:]}" for at in DAY]),
    "minutes of a spreadsheet": clocked("Time,Voltage,Displacement\n", [at[3:] for at in DAY]),
    "ISO without separators": clocked(HEAD, [at.replace("-", "").replace(":", "") + "+0100" for at in clock(T)]),
    "date beside": "Scope 3\n\n" + clocked("Date,Time,U [V],Position [um]\n", [f"2026-11-25,{at}" for at in DAY]),
    "names of two lines": '"Time\n(s)","Voltage\n(V)","Position\n(um)"\n' + rows(T, V, Y),
    "names with spaces": "Time (s)   Voltage (V)  Position (um)\n" + rows(T, V, Y, separator="   "),
    "separator, lines above, units": "sep=;\nRig 3;;\nt;U;x\ns;V;um\n" + rows(T, V, Y, separator=";"),
    "units behind a slash": "Zeit/ms;Spannung / mV;Weg/µm\n" + rows(1e3 * T, 1e3 * V, Y, separator=";"),
    "units behind a blank": "Time ms,Piezo V,Pos um\n" + rows(1e3 * T, V, Y),
    "quantities and units behind a slash": "Time/s,Voltage/V,Displacement/Micrometers\n" + rows(T, V, Y),
    "minutes": "t [min],U [V],x [um]\n" + rows(T / 60, V, Y),
}  # fmt: skip


def pasted(path, monkeypatch):
    """The record that `fit` has from the command that `inspect` says to paste."""
    got = []

    def fit(records, **options):
        got.extend(records)
        raise fits.DataError("seen")

    monkeypatch.setattr("fits.cli._late.fit", fit, raising=False)
    monkeypatch.chdir(path.parent)
    told = json.loads(run("inspect", path, "--json").stdout)
    command = shlex.split(told["command"])
    assert command[:2] == ["microid", "fit"], told
    refused(run(*command[1:]), "seen")
    return got.pop()


def assert_close(record):
    for found, expected in zip((record.time_s, record.voltage_V, record.displacement_um), (T, V, Y), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ODD)
def test_an_odd_text_is_read_as_it_was_written(tmp_path, monkeypatch, name):
    path = tmp_path / "odd.csv"
    path.write_text(ODD[name])
    record = pasted(path, monkeypatch)
    assert not any("Date" not in warning for warning in record.warnings)  # of a text beside
    assert_close(record)


def test_a_column_that_stands_there_twice_has_to_be_chosen(tmp_path, monkeypatch):
    path = tmp_path / "twice.csv"
    path.write_text("time_s,voltage_V,displacement_um,voltage_V\n" + rows(T, V, Y, 2 * V))
    with pytest.raises(fits.DataError, match=r"line 1, column 'voltage_V 4'.*{'voltage_V': 'voltage_V 4'}"):
        fits.read_table(path)
    assert_same(fits.read_table(path, {"voltage_V": "voltage_V"}))
    np.testing.assert_array_equal(fits.read_table(path, {"voltage_V": "voltage_V 4"}).voltage_V, 2 * V)
    assert_same(pasted(path, monkeypatch))


def test_a_damaged_first_row_is_no_header(tmp_path):
    path = tmp_path / "damaged.csv"
    path.write_text(HEAD + "x,1.5,2\n" + rows(T, V, Y))
    with pytest.raises(fits.DataError, match=r"damaged\.csv, line 2, column 'time_s'"):
        fits.read_table(path)


def test_dates_that_change_without_saying_which_is_the_day_are_refused(tmp_path):
    path = tmp_path / "days.csv"
    days = [f"{1 + (t > 0.2):02d}/02/2026 10:00:{1 + t:06.3f}" for t in T]
    path.write_text(clocked(HEAD, days))
    with pytest.raises(fits.DataError, match="dates that change are read in the form 2026-11-25 only"):
        fits.read_table(path)


@pytest.mark.parametrize("word", ["---", "OVERLOAD", "NaN", "", "-1.#IND"])
def test_words_for_a_missing_number_are_dropped_on_request(tmp_path, word):
    cells = [repr(y) if k not in (5, 77) else word for k, y in enumerate(Y.tolist())]
    path = tmp_path / "holes.csv"
    path.write_text(
        HEAD + "".join(f"{t!r},{v!r},{y}\n" for t, v, y in zip(T.tolist(), V.tolist(), cells, strict=True))
    )
    refused(run("fit", path, "--out", tmp_path / "m.json"), "holes.csv, line 7, column 'displacement_um'", "drop")
    np.testing.assert_array_equal(fits.read_table(path, missing="drop").time_s, np.delete(T, [5, 77]))


def structures(names, values):
    """An array of structures with the fields Name, Data and Unit, as ControlDesk captures signals."""
    made = np.zeros((1, len(names)), dtype=[("Name", "O"), ("Data", "O"), ("Unit", "O")])
    made[0] = [(name, data[None, :], unit) for (name, unit), data in zip(names, values, strict=True)]
    return made


def mat_7_3(path, content):
    """Write what SciPy reads of a file of version 5 as MATLAB does in version 7.3, with lists as references."""

    def put(group, name, value):
        if isinstance(value, str):
            made = group.create_dataset(name, data=np.array([[ord(c)] for c in value], dtype=np.uint16))
            made.attrs["MATLAB_class"] = np.bytes_("char")
        elif isinstance(value, dict):
            for key, each in value.items():
                put(group.require_group(name), key, each)
        elif isinstance(value, list):
            for key in value[0]:
                for k, each in enumerate(value):
                    put(group.file["#refs#"], f"{key}{k}", each[key])
                refs = [[group.file[f"#refs#/{key}{k}"].ref] for k in range(len(value))]
                group.require_group(name).create_dataset(key, data=np.array(refs, dtype=h5py.ref_dtype))
        else:
            group.create_dataset(name, data=value[:, None]).attrs["MATLAB_class"] = np.bytes_("double")

    with h5py.File(path, "w", userblock_size=512) as file:
        file.create_group("#refs#")
        for name, value in content.items():
            put(file, name, value)
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def test_a_capture_of_controldesk_is_the_same_in_both_versions_of_matlab(tmp_path, monkeypatch):
    old, new = tmp_path / "old.mat", tmp_path / "new.mat"
    capture = {"X": structures([("time", "s")], [T]), "Y": structures([("DAC/u", "V"), ("ENC/x", "µm")], [V, Y])}
    savemat(old, {"exp_001": capture | {"Description": {"Author": "me"}}})
    content = loadmat(old, simplify_cells=True)
    mat_7_3(new, {"exp_001": content["exp_001"]})
    for path in (old, new):
        assert_same(pasted(path, monkeypatch))


def test_channels_of_labview_that_have_times_each(tmp_path, monkeypatch):
    head = LVM.format(x="Multi").replace("Volts\tMicrometers", "Volts\t\tMicrometers")
    path = tmp_path / "multi.lvm"
    path.write_text(
        head.replace("X_Value\tVoltage\tDisp", "X_Value\tVoltage\tX_Value\tDisp") + rows(T, V, T, Y, separator="\t")
    )
    assert_same(pasted(path, monkeypatch))


def test_labview_without_its_header_is_a_text(tmp_path):
    (tmp_path / "bare.lvm").write_text(rows(T, V, Y, separator="\t"))
    assert_same(fits.read_table(tmp_path / "bare.lvm", parse_columns("1,2,3")))


@pytest.mark.parametrize("kind", ["frame", "day", "h5", "npz", "parquet"])
def test_time_stamps_that_are_texts_are_read_in_every_form(tmp_path, monkeypatch, kind):
    stamps = DAY if kind == "day" else [f"{at}Z" for at in clock(T)]
    columns = {"time": stamps, "voltage_V": V, "displacement_um": Y}
    path = tmp_path / f"run.{kind}"
    if kind in ("frame", "day"):
        assert_close(fits.read_table(pd.DataFrame(columns)))
        return
    if kind == "npz":
        np.savez(path, **columns)
    elif kind == "parquet":
        pd.DataFrame(columns).to_parquet(path)
    else:
        with h5py.File(path, "w") as file:
            for name, values in columns.items():
                file[name] = values
            file["note"] = ["a", "b"]
    assert_close(pasted(path, monkeypatch))


def test_a_frame_of_objects_holds_numbers_and_what_is_none_is_named():
    frame = pd.DataFrame({"time_s": T, "voltage_V": V, "displacement_um": Y.astype(str).astype(object)})
    assert_same(fits.read_table(frame))
    frame.loc[3, "displacement_um"] = "overload"
    with pytest.raises(fits.DataError, match="row 4, column 'displacement_um': expected a finite number"):
        fits.read_table(frame)
    assert len(replace(fits.read_table(frame, missing="drop"), warnings=())) == len(T) - 1


def test_inspect_says_what_has_to_be_stated(tmp_path):
    path = tmp_path / "drive.csv"
    path.write_text("Time [s],Drive [%],Gauge [V]\n" + rows(T, V, Y))
    told = json.loads(run("inspect", path, "--json").stdout)
    assert any("'Drive [%]' is in '%'" in remark for remark in told["remarks"])
    assert "voltage_V=Drive [%][SCALE V]" in told["command"]
    assert any("--columns 'displacement_um=Gauge [V][0.5um]'" in remark for remark in told["remarks"])
    # A count of samples is no time.
    path.write_text("Sample,Voltage (V),Displacement (um)\n" + rows(np.arange(len(T)), V, Y))
    told = json.loads(run("inspect", path, "--json").stdout)
    assert told["command"].endswith(f"{path} --sample-rate HZ --out model.json")
    assert told["rate_Hz"] is None
    assert_same(fits.read_table(path, sample_rate_Hz=RATE_Hz))
    # What keeps a file from being read is said with its line.
    path.write_text("time_s,voltage_V\n0 s,1 V\n1 s,2 V\n")
    refused(run("inspect", path), "drive.csv, line 2, column 'time_s': expected columns of numbers, found '0 s'")


def test_names_of_two_lines_leave_lines_their_numbers(tmp_path):
    path = tmp_path / "two.csv"
    path.write_text('"Time\n(s)","Voltage\n(V)","Displacement\n(um)"\n' + rows(T, V, Y).replace("0.002,", "x,", 1))
    with pytest.raises(fits.DataError, match=r"two\.csv, line 6, column 'Time \(s\)'"):
        fits.read_table(path)


def test_columns_of_a_record_are_found_among_more_arrays_of_another_length(tmp_path):
    path = tmp_path / "all.npz"
    spectra = {name: np.zeros(121) for name in "abcdef"}
    np.savez(path, time_s=T, voltage_V=V, displacement_um=Y, settings=np.array({"a": 1}, dtype=object), **spectra)
    assert_same(fits.read_table(path))


def test_the_interval_of_a_tdms_file_is_that_of_the_channels_that_are_read(tmp_path, monkeypatch):
    path = tmp_path / "both.tdms"
    slow, fast = {"wf_increment": 0.02}, {"wf_increment": 1 / RATE_Hz}
    with TdmsWriter(path) as writer:
        channels = [ChannelObject("slow", "Temperature", T[:24], slow)]
        for name, values, unit in (("Voltage", V, "V"), ("Displacement", Y, "um")):
            channels.append(ChannelObject("fast", name, values, fast | {"unit_string": unit}))
        writer.write_segment(channels)
    assert_same(pasted(path, monkeypatch))


def test_a_file_and_columns_that_begin_with_a_minus_are_read_by_the_command_that_is_shown(tmp_path, monkeypatch):
    """A minus before a column turns its sign, unless it belongs to the name."""
    monkeypatch.chdir(tmp_path)
    time_s = np.arange(300) / 100
    voltage_V = 50 - 50 * np.cos(3 * time_s)
    table = np.c_[time_s, voltage_V, 0.3 * voltage_V + 0.01 * np.sin(40 * time_s)]
    np.savetxt("-run.csv", table, delimiter=",", header="t,-U,-x", comments="")
    told = json.loads(run("inspect", "./-run.csv", "--json").stdout)
    assert [one for one in told["remarks"] if "states no unit" not in one] == []
    words = shlex.split(inspect_table("-run.csv").command)
    assert words[2] == "./-run.csv"
    found = fits.read_table(words[2], words[words.index("--columns") + 1])
    np.testing.assert_allclose(found.voltage_V, voltage_V)
    turned = fits.read_table(words[2], {"time_s": "t[s]", "voltage_V": "--U[V]", "displacement_um": "-x[um]"})
    np.testing.assert_allclose(turned.voltage_V, -voltage_V)


@pytest.mark.parametrize("ending", [".h5", ".tdms", ".npy", ".npz"])
def test_a_file_that_is_cut_off_is_told_of_in_our_own_words(tmp_path, ending):
    whole = tmp_path / f"whole{ending}"
    if ending == ".h5":
        with h5py.File(whole, "w") as file:
            file["time_s"] = T
    elif ending == ".tdms":
        with TdmsWriter(whole) as writer:
            writer.write_segment([ChannelObject("fast", "time_s", T)])
    else:
        (np.save if ending == ".npy" else np.savez)(whole, T)
    (tmp_path / f"cut{ending}").write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    with pytest.raises(fits.DataError) as caught:
        fits.read_table(tmp_path / f"cut{ending}")
    words = str(caught.value)
    assert words.endswith("export it again, or as CSV.") or ending == ".tdms"
    assert "(" not in words.replace(str(tmp_path), "")
