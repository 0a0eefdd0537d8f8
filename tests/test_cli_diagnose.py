import json
import re
import sys
import types

import numpy as np
import pytest
from _command import files, refused, run
from _diagnosis import diagnosis

from fits import DataError, FitError, FitStatus, read_csv
from fits.diagnosis._result import Step
from fits.report._diagnosis import report_html


@pytest.fixture
def bench(tmp_path, monkeypatch, rng):
    """A record, and what stands in for the diagnosis: its answers, and what it was asked."""
    rows = [f"{0.01 * k},{60 - 60 * np.cos(k / 10)},{20 - 20 * np.cos(k / 10)}" for k in range(200)]
    (tmp_path / "run.csv").write_text("\n".join(["time_s,voltage_V,displacement_um", *rows]) + "\n")
    monkeypatch.chdir(tmp_path)
    stand_in = types.SimpleNamespace(answer=diagnosis(rng, count=0), asked={}, folder=tmp_path)

    def diagnose(records, **options):
        stand_in.asked = {"records": records, **options}
        options["progress"](Step.SELECTION)
        if isinstance(stand_in.answer, Exception):
            raise stand_in.answer
        return stand_in.answer

    module = types.ModuleType("fits.diagnosis._diagnose")
    module.diagnose = diagnose
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return stand_in


def test_the_command_writes_everything(bench, rng):
    done = run("diagnose", "run.csv", "--out", "a/b", "--duration", "30", "--false-alarm", "0.05", "--budget", "60")
    assert done.exit_code == 0, done.stderr
    names = ["baseline.json", "diagnosis.json", "extended.json", "next_experiment.csv", "report.html"]
    assert files(bench.folder / "a" / "b") == names
    assert (bench.asked["duration_s"], bench.asked["false_alarm"], bench.asked["holdout"]) == (30.0, 0.05, 0.2)
    assert bench.asked["budget_s"] == 60.0
    assert [record.source for record in bench.asked["records"]] == ["run.csv"]
    for words in ("creep", "thermal_drift", "gain_per_decade", "47.1 nm", "12.3 nm", "It decides.", "report.html"):
        assert words in done.stdout
    assert "asking" in done.stderr
    # Announced out of turn, a step counts those before it.
    assert "[####..]" in done.stderr
    assert "[######]" in done.stderr
    folder = bench.folder / "a" / "b"
    ahead = np.loadtxt(folder / "next_experiment.csv", delimiter=",", skiprows=2)
    np.testing.assert_array_equal(ahead[:, 1], bench.answer.next_experiment.voltage_V)
    # What the program reaches, beside the limits, stands above the header, and the reader passes over it.
    first = (folder / "next_experiment.csv").read_text().splitlines()[0]
    assert first == "# predicted displacement -0.5 to 38.2 um (limits 0 to 40 um)"
    again = read_csv(folder / "next_experiment.csv", required=("time_s", "voltage_V"))
    np.testing.assert_array_equal(again.voltage_V, ahead[:, 1])
    page = (folder / "report.html").read_text(encoding="utf-8")
    when = re.search(r"read on (20\d\d-\d\d-\d\d \d\d:\d\d UTC)", page)[1]
    assert page == report_html(bench.answer, when)
    assert json.loads((folder / "baseline.json").read_text())["model"]["type"] == "Stage"
    told = run("info", folder / "extended.json").stdout
    assert re.search(r"mechanics.natural_frequency_Hz +150.020 ± 0.034 +\(95 % 149.950..150.090\) +Hz", told)
    assert re.search(r"creep.gain_per_decade +0.01542 ± 0.00031 ", told)
    bench.answer = diagnosis(rng, count=1)
    assert run("diagnose", "run.csv", "--out", "seen").exit_code == 0
    seen = run("info", bench.folder / "seen" / "baseline.json").stdout
    assert f"written by 'microid diagnose' from {bench.answer.runs[0].source}, whose report" in seen
    bench.answer = diagnosis(rng, count=0)
    assert "natural_frequency_Hz  149.80 ± 0.21" in run("info", folder / "baseline.json").stdout
    as_json = json.loads(run("diagnose", "run.csv", "--out", "a/b", "--json", "--quiet").stdout)
    assert json.loads((folder / "diagnosis.json").read_text()).items() <= as_json.items()
    # What an earlier diagnosis advised is not left beside a later one without advice.
    bench.answer = diagnosis(rng, "no_effect", count=0)
    assert run("diagnose", "run.csv", "--out", "a/b").exit_code == 0
    assert files(folder) == [name for name in names if name != "next_experiment.csv"]


def test_what_is_held_out_and_what_the_rig_stands_are_passed_on(bench):
    options = ["--limit", "displacement=0:0.04mm", "--limit", "slew=2kV/s", "--margin", "0.1"]
    assert run("diagnose", "run.csv", "--out", "d", "--holdout", "0", *options).exit_code == 0
    assert bench.asked["holdout"] == 0.0
    assert bench.asked["limits"] == {"displacement": (0.0, 40.0), "slew": (-2000.0, 2000.0)}
    assert bench.asked["margin"] == 0.1
    assert run("diagnose", "run.csv", "--out", "d", "--holdout", "run.csv").exit_code == 0
    assert [record.source for record in bench.asked["holdout"]] == ["run.csv"]
    assert (bench.asked["limits"], bench.asked["margin"]) == ({}, 0.02)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--limit", "displacement=4"], ["--limit", "displacement"]),
        (["--limit", "length=0:4"], ["--limit", "length"]),
        (["--margin", "-1"], ["--margin"]),
        (["--margin", "nan"], ["--margin"]),
        (["--false-alarm", "0"], ["--false-alarm"]),
        (["--false-alarm", "0.6"], ["--false-alarm", "0.6"]),
        (["--false-alarm", "nan"], ["--false-alarm"]),
        (["--duration", "0"], ["--duration"]),
        (["--budget", "0"], ["--budget"]),
        (["--budget", "nan"], ["--budget"]),
        (["--duration", "inf"], ["--duration"]),
        (["--holdout", "1.5"], ["--holdout"]),
        (["--holdout", "none.csv"], ["none.csv"]),
        (["--columns", "voltage_V=u_V"], ["u_V"]),
        (["--out", "run.csv"], ["run.csv: expected a folder"]),
        (["--out", "run.csv/d"], ["run.csv/d: expected a folder"]),
    ],
)
def test_bad_options_end_in_one_sentence(bench, options, words):
    refused(run("diagnose", "run.csv", "--out", "d", *options), *words)
    assert files(bench.folder) == ["run.csv"]
    assert bench.asked == {}


@pytest.mark.parametrize("error", [DataError("run.csv: no good; measure again"), FitError(FitStatus.MAX_STEPS)])
def test_a_diagnosis_that_fails_leaves_nothing(bench, error):
    bench.answer = error
    refused(run("diagnose", "run.csv", "--out", "d"), str(error))
    assert files(bench.folder) == ["run.csv"]


def test_what_cannot_be_written_whole_is_not_written(bench, monkeypatch):
    def full(*_):
        raise DataError("the disk is full")

    monkeypatch.setattr("fits.io._atomic.write_csv", full)
    refused(run("diagnose", "run.csv", "--out", "d"), "full")
    assert files(bench.folder / "d") == []


def test_inputs_are_not_overwritten(bench):
    (bench.folder / "d").mkdir()
    (bench.folder / "run.csv").rename(bench.folder / "d" / "next_experiment.csv")
    refused(run("diagnose", "d/next_experiment.csv", "--out", "d"), "overwrite")
