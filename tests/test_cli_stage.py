"""The command on a whole stage, end to end: from a virtual bench to a voltage, and what is refused on the way."""

import json

import numpy as np
import pytest
from _command import columns_of, files, refused, run, whole_picture
from test_cli_refusals import bad_csv, write_csv

from fits import FitError, FitStatus, StageUncertainty, load_model
from fits.loop._report_words import describe
from microid import Stage

SCENARIO = """
name = "small"
description = "A small stage with dynamics, in few samples."
seed = 7

[rig]
kind = "plays"
plays = 60

[plant]
time_constant_s = 0.0008
natural_frequency_Hz = 180.0
damping_ratio = 0.05

[sensor]
noise_um = 0.1

[[runs]]
name = "slow"
sample_rate_Hz = 100.0

[[runs.program]]
kind = "triangle"
cycles = 1
rate_V_per_s = 100.0

[[runs.program]]
kind = "forc"
side = "above"
reversals_V = [90.0, 60.0, 30.0, 0.0]
rate_V_per_s = 100.0

[[runs.program]]
kind = "triangle"
cycles = 2
rate_V_per_s = 100.0

[[runs]]
name = "fast"
sample_rate_Hz = 12000.0

[[runs.program]]
kind = "ramp"
to_V = 60.0
rate_V_per_s = 2000.0

[[runs.program]]
kind = "multisine"
amplitude_V = 25.0
low_Hz = 16.0
high_Hz = 500.0
period_s = 0.0625
periods = 2
"""
TRUTH = {
    "driver.time_constant_s": 8e-4,
    "mechanics.natural_frequency_Hz": 180.0,
    "mechanics.damping_ratio": 0.05,
}
LEVELS = 6


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A folder with the runs of a bench, and what `fit` said of them."""
    folder = tmp_path_factory.mktemp("bench")
    (folder / "small.toml").write_text(SCENARIO)
    assert run("synth", folder / "small.toml", "--out", folder).exit_code == 0
    runs, out = [folder / "slow.csv", folder / "fast.csv"], folder / "model.json"
    options = ["--model", "stage", "--levels", LEVELS, "--initial", "negative", "--plots", folder / "plots"]
    fit = run("fit", *runs, *options, "--out", out, "--json")
    assert fit.exit_code == 0, fit.output
    return folder, runs, out, json.loads(fit.stdout)


def test_the_fit_finds_the_plant_of_the_bench(bench):
    _, _, _, report = bench
    found = {each["name"]: each for each in report["parameters"]}
    assert set(found) == set(TRUTH)
    for name, value in TRUTH.items():
        each = found[name]
        assert abs(each["value"] - value) < 6 * each["sd"]
        assert 0 < each["sd"] < 0.02 * value
        assert each["lower"] < each["value"] < each["upper"]
    assert np.allclose([run["noise_um"] for run in report["runs"]], 0.1, rtol=0.1)
    assert report["held_out"]["rms_um"] < 0.12
    assert report["status"] == "converged"


def test_the_words_name_every_parameter_with_its_interval(bench):
    _, _, _, report = bench
    lines = describe(report).splitlines()
    for each in report["parameters"]:
        (line,) = [line for line in lines if line.startswith(each["name"])]
        value, sd = (float(part) for part in line.split(" (95 %")[0].removeprefix(each["name"]).split("±"))
        low, high = (float(end) for end in line.split("(95 %")[1].split(")")[0].split(".."))
        assert np.isclose(value, each["value"], rtol=0, atol=each["sd"] / 10)
        assert np.isclose(sd, each["sd"], rtol=0.06)
        assert np.allclose([low, high], [each["lower"], each["upper"]], rtol=0, atol=each["sd"] / 10)
        assert line.endswith(each["unit"].replace("1", ""))
    text = "\n".join(lines)
    for word in ("slow.csv", "fast.csv", "in-sample", "held-out", "levels from 0 to 120 V", "m standard deviation"):
        assert word in text


def test_parameters_that_go_together_and_remarks_are_said(bench):
    _, _, _, report = bench
    names = [each["name"] for each in report["parameters"]]
    correlation = [[1.0, -0.7, 0.4], [-0.7, 1.0, None], [0.4, None, 1.0]]
    parameter = report["parameters"][0] | {"sd": None, "lower": None, "upper": None}
    told = describe(
        report
        | {"correlation": correlation, "remarks": ["Mind this"], "unseen": ["a and b"]}
        | {"parameters": [parameter, *report["parameters"][1:]]}
    )
    assert f"{names[0]} and {names[1]}: -0.70" in told
    assert told.count("correlated") == 1
    assert told.endswith("Unseen: a and b\nNote: Mind this")
    (line,) = [line for line in told.split("\n") if line.startswith(parameter["name"])]
    assert " ".join(line.split()).endswith("± unknown (95 % unknown..unknown) s")


def test_the_pictures_are_drawn(bench):
    folder, _, _, report = bench
    assert files(folder / "plots") == ["index.html", "loop.png", "response.png", "runs.png"]
    assert len(report["plots"]) == 3
    for place in report["plots"]:
        whole_picture(place)


def test_info_names_the_parameters_of_the_parts(bench):
    _, _, out, report = bench
    told = json.loads(run("info", out, "--json").stdout)
    assert told["model"] == "Stage"
    assert set(TRUTH) <= {row["path"] for row in told["parameters"]}
    assert told["fit"] == {key: value for key, value in report.items() if key not in ("out", "plots")}
    words = run("info", out).stdout
    assert words.startswith("Stage, written by microid")
    assert describe(told["fit"]) in words


def test_simulate_predicts_the_bench_within_its_noise(bench, tmp_path):
    folder, _, out, _ = bench
    loaded = load_model(out)
    assert isinstance(loaded.model, Stage)
    assert isinstance(loaded.uncertainty, StageUncertainty)
    result = run("simulate", out, folder / "fast.csv", "--out", tmp_path / "p.csv", "--json")
    assert result.exit_code == 0, result.output
    predicted, measured = columns_of(tmp_path / "p.csv"), columns_of(folder / "fast.csv")
    assert list(predicted) == ["time_s", "voltage_V", "displacement_um", "displacement_sd_um"]
    off = measured["displacement_um"] - predicted["displacement_um"]
    assert np.std(off) < 0.12
    sd = predicted["displacement_sd_um"]
    assert np.all((sd > 0) & (sd < 0.1))
    assert json.loads(result.stdout)["displacement_sd_median_um"] == np.median(sd)


def test_compensate_leads_the_mechanics_and_says_how_sure_it_is(bench, tmp_path):
    _, _, out, _ = bench
    time_s = np.arange(400) / 2000
    rise = np.clip(time_s / 0.1, 0, 1)
    wanted = 8 + 12 * rise**3 * (10 - 15 * rise + 6 * rise**2)
    write_csv(tmp_path / "r.csv", time_s, np.zeros(400), wanted)
    arguments = [out, tmp_path / "r.csv", "--dynamic", "--out", tmp_path / "v.csv", "--json"]
    result = run("compensate", *arguments, "--initial", "negative")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert 0 < told["displacement_sd_median_um"] < 0.1
    assert told["error_max_within_reach_um"] < 0.3
    assert np.ptp(columns_of(tmp_path / "v.csv")["voltage_V"]) > 20


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--model", "loop", "--hold", "steps"], ["--hold", "stage"]),
        (["--hold", "lines"], ["--hold", "stage"]),
        (["--model", "stage", "--family", "mixture"], ["--family", "mixture", "grid"]),
        (["--model", "stage", "--starts", "4"], ["--starts"]),
        (["--model", "stage", "--seed", "0"], ["--seed"]),
        (["--model", "stage", *["--initial", "negative"] * 3], ["--initial", "3", "2 runs"]),
        (["--model", "loop", *["--initial", "negative"] * 2], ["--initial", "--model stage"]),
        (["--model", "stage", "--holdout", "1.5"], ["--holdout", "1.5"]),
    ],
)
def test_options_that_cannot_be_honoured_are_refused(tmp_path, options, words):
    for name in ("a.csv", "b.csv"):
        bad_csv(tmp_path / name, "good")
    before = files(tmp_path)
    refused(run("fit", tmp_path / "a.csv", tmp_path / "b.csv", "--out", tmp_path / "m.json", *options), *words)
    assert files(tmp_path) == before


@pytest.mark.parametrize("kind", ["missing", "text", "nan", "backwards", "short", "still"])
def test_bad_records_leave_the_old_model(tmp_path, kind):
    bad_csv(tmp_path / "good.csv", "good")
    bad_csv(tmp_path / "bad.csv", kind)
    (tmp_path / "m.json").write_text("old")
    before = files(tmp_path)
    runs = [tmp_path / "good.csv", tmp_path / "bad.csv"]
    options = ["--out", tmp_path / "m.json", "--plots", tmp_path / "plots"]
    refused(run("fit", *runs, "--model", "stage", *options), "bad.csv")
    assert files(tmp_path) == before
    assert (tmp_path / "m.json").read_text() == "old"


def test_slow_runs_alone_show_no_dynamics(bench, tmp_path):
    _, (slow, _), _, _ = bench
    head, *rows = slow.read_text().splitlines()
    (tmp_path / "again.csv").write_text("\n".join([head, *rows[:-20]]))
    (tmp_path / "m.json").write_text("old")
    options = ["--model", "stage", "--levels", LEVELS, "--initial", "negative", "--out", tmp_path / "m.json"]
    refused(run("fit", slow, tmp_path / "again.csv", *options), "add a run with steps")
    assert files(tmp_path) == ["again.csv", "m.json"]
    assert (tmp_path / "m.json").read_text() == "old"


def test_a_failed_fit_ends_in_its_sentence(tmp_path, monkeypatch):
    bad_csv(tmp_path / "good.csv", "good")

    def fail(*_, **__):
        raise FitError(FitStatus.MAX_STEPS)

    monkeypatch.setattr("fits.stage._fit.fit_stage", fail)
    options = ["--model", "stage", "--out", tmp_path / "m.json", "--plots", tmp_path / "p"]
    refused(run("fit", tmp_path / "good.csv", *options), FitStatus.MAX_STEPS.value)
    assert files(tmp_path) == ["good.csv"]


def test_each_run_may_have_a_memory_of_its_own(tmp_path, monkeypatch):
    given = []
    for name in ("a.csv", "b.csv"):
        bad_csv(tmp_path / name, "good")

    def fail(*_, initial, loss, **__):
        given.append((initial, loss))
        raise FitError(FitStatus.NONFINITE)

    monkeypatch.setattr("fits.stage._fit.fit_stage", fail)
    runs = ["fit", tmp_path / "a.csv", tmp_path / "b.csv", "--model", "stage", "--out", tmp_path / "m.json"]
    run(*runs)
    run(*runs, "--initial", "negative", "--loss", "huber")
    run(*runs, "--initial", "negative", "--initial", "demagnetised")
    assert given == [("unknown", "squares"), ("negative", "huber"), (["negative", "demagnetised"], "squares")]
