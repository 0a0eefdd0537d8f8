"""What `inspect` says of units that a file does not state, and what its command then does."""

import json
import shlex

import numpy as np
import pytest
from _command import refused, run
from test_foreign_files import RATE_Hz, rows, signals

import fits

T, V, Y = signals()


def test_a_drive_in_percent_is_fitted_only_once_its_scale_is_stated(tmp_path, monkeypatch):
    """The command that was shown took 100 % for 100 V."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive.csv").write_text("time_s,drive_%,displacement_um\n" + rows(T, V / 1.2, Y))
    told = run("inspect", "drive.csv")
    assert told.stdout.splitlines()[3].split()[:3] == ["2", "drive_%", "%"]
    words = shlex.split(told.stdout.splitlines()[-1])
    assert words[words.index("--columns") + 1] == "voltage_V=drive_%[SCALE V]"
    refused(run(*words[1:]), "column 'drive_%': expected what 1 in the column is", "write a number in place of SCALE")
    refused(
        run("fit", "drive.csv", "--columns", "voltage_V=drive_%", "--out", "m.json"), "'voltage_V=drive_%[SCALE V]'"
    )
    record = fits.read_table("drive.csv", words[words.index("--columns") + 1].replace("SCALE", "1.2"))
    np.testing.assert_allclose(record.voltage_V, V, rtol=0, atol=1e-9)
    assert record.warnings == ()
    (warning,) = fits.read_table("drive.csv", {"voltage_V": "drive_%[V]"}).warnings
    assert "column 'drive_%': it is in '%', and 1 of it was read as 1 V" in warning


def test_counts_of_converters_are_no_volts_and_no_micrometres(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    counts, readings = np.rint(524.28 * V).astype(int), np.rint(2000 * Y).astype(int)
    (tmp_path / "counts.csv").write_text("sample,dac,adc\n" + rows(np.arange(len(T)), counts, readings))
    told = json.loads(run("inspect", "counts.csv", "--json").stdout)
    words = shlex.split(told["command"])
    named = words[words.index("--columns") + 1]
    assert named == "voltage_V=dac[SCALE V],displacement_um=adc[SCALE um]"
    assert [remark[:12] for remark in told["remarks"] if "taken for counts" in remark] == [
        "column 'dac'",
        "column 'adc'",
    ]
    stated = named.replace("SCALE V", "1.9e-3 V").replace("SCALE um", "0.5 nm")
    np.testing.assert_allclose(fits.read_table("counts.csv", stated, sample_rate_Hz=5.0).voltage_V, 1.9e-3 * counts)


@pytest.mark.parametrize(
    ("order", "units"), [("tvd", "s;counts;counts"), ("vdt", "counts;counts;s"), ("tvd", "s;N;q")]
)
def test_unknown_units_below_the_names_do_not_replace_them(tmp_path, order, units):
    path, columns = tmp_path / "units.csv", {"t": ("time", T), "v": ("voltage", V), "d": ("displacement", Y)}
    names, values = zip(*(columns[letter] for letter in order), strict=True)
    path.write_text(";".join(names) + f"\n{units}\n" + rows(*values, separator=";"))
    told = json.loads(run("inspect", path, "--json").stdout)
    shown = {each["name"]: (each["unit"], each["use"]) for each in told["channels"]}
    stated = dict(zip(names, units.split(";"), strict=True))
    uses = {"time": "time_s", "voltage": "voltage_V", "displacement": "displacement_um"}
    assert shown == {f"{name}[{stated[name]}]": (stated[name], uses[name]) for name in names}
    assert "[SCALE V]" in told["command"]
    assert "[SCALE um]" in told["command"]


def test_every_unit_that_is_guessed_is_told_of(tmp_path):
    """Times in ms were taken for s without a word, and the 3 of data_3 for a unit."""
    path = tmp_path / "plain.csv"
    path.write_text("data_1,data_2,data_3\n" + rows(1e3 * T, V, Y))
    told = json.loads(run("inspect", path, "--json").stdout)
    assert [remark.partition(":")[0] for remark in told["remarks"] if "is guessed" in remark] == [
        f"column 'data_{k}' states no unit, and [{unit}] is guessed" for k, unit in ((1, "s"), (2, "V"), (3, "um"))
    ]


@pytest.mark.parametrize(
    ("name", "unit", "in_s"), [("t_min", "min", 60), ("Time [minutes]", "min", 60), ("t[h]", "h", 3600)]
)
def test_the_rate_of_times_in_minutes_and_hours_is_that_of_the_record(tmp_path, name, unit, in_s):
    """The rate was stated for times in s."""
    path = tmp_path / "minutes.csv"
    path.write_text(f"{name},voltage_V,displacement_um\n" + rows(T / in_s, V, Y))
    told = json.loads(run("inspect", path, "--json").stdout)
    assert told["rate_Hz"] == pytest.approx(RATE_Hz)
    assert told["channels"][0]["unit"] == unit
    np.testing.assert_allclose(fits.read_table(path, {"time_s": f"{name}[{in_s}s]"}).time_s, T, rtol=0, atol=1e-12)
    assert f"time_s={name}[{in_s}s]" in told["command"]
