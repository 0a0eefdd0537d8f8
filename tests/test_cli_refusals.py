import json
import shlex

import numpy as np
import pytest
from _command import files, refused, run, without_jax
from _docs import commands, options_of
from test_foreign_files import rows, signals

from fits import FitError, FitStatus, read_table
from fits.cli._main import cli
from fits.io._units import parse_columns
from fits.loop._plain import INITIAL_STATES
from microid.densities import FAMILIES


def write_csv(path, time_s, voltage_V, displacement_um):
    rows = [f"{t},{v},{x}" for t, v, x in zip(time_s, voltage_V, displacement_um, strict=True)]
    path.write_text("\n".join(["time_s,voltage_V,displacement_um", *rows]) + "\n")


def bad_csv(path, kind):
    time = [0.01 * k for k in range(200)]
    voltage = [60 - 60 * np.cos(k / 10) for k in range(200)]
    moved: list = [v / 3 for v in voltage]
    if kind == "text":
        moved[7] = "high"
    elif kind == "nan":
        moved[7] = "nan"
    elif kind == "backwards":
        time[7] = 0.0
    elif kind == "short":
        time, voltage, moved = time[:49], voltage[:49], moved[:49]
    elif kind == "still":
        voltage = [1.0] * 200
    elif kind == "inverted":
        moved = [-x for x in moved]
    if kind == "folder":
        path.mkdir()
    elif kind == "empty":
        path.write_text("")
    elif kind == "binary":
        path.write_bytes(bytes(range(256)) * 9)
    elif kind == "headers":
        path.write_text("a,b,c\n1,2,3\n")
    elif kind != "missing":
        write_csv(path, time, voltage, moved)


@pytest.mark.parametrize(
    "kind",
    ["missing", "folder", "empty", "binary", "headers", "text", "nan", "backwards", "short", "still", "inverted"],
)
def test_bad_records_end_in_one_sentence(tmp_path, kind):
    path = tmp_path / "bad.csv"
    bad_csv(path, kind)
    before = files(tmp_path)
    refused(run("fit", path, "--out", tmp_path / "m.json", "--plots", tmp_path / "plots"), "bad.csv")
    assert files(tmp_path) == before


@pytest.fixture
def good_csv(tmp_path):
    path = tmp_path / "good.csv"
    bad_csv(path, "good")
    return path


@pytest.mark.parametrize("command", ["control none.json {}", "budget paper none.json {}", "fit {} --start none.json"])
def test_a_missing_model_is_refused_before_jax_starts(tmp_path, good_csv, command):
    out = [] if command.startswith("budget") else ["--out", tmp_path / "out"]
    done = without_jax(*command.format(good_csv).split(), *out)
    assert (done.returncode, done.stderr) == (2, "none.json: no such file; check the name and the folder.\n")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--family", "spline"], ["spline", *sorted(FAMILIES)]),
        (["--levels", "3"], ["levels"]),
        (["--holdout", "1.5"], ["--holdout", "1.5"]),
        (["--holdout", "nan"], ["--holdout"]),
        (["--holdout", "0.1", "--holdout", "good.csv"], ["--holdout"]),
        (["--holdout", "none.csv"], ["none.csv"]),
        (["--holdout", "0.9", "--levels", "8"], ["good.csv"]),
        (["--columns", "voltage_V"], ["--columns"]),
        (["--columns", "voltage_V=u_V"], ["u_V"]),
        (["--out", "no/such/m.json"], ["no/such/m.json"]),
        (["--out", "."], ["folder"]),
        (["--out", "good.csv"], ["good.csv", "overwrite"]),
        (["--plots", "good.csv"], ["good.csv"]),
        (["--plots", "good.csv/plots"], ["good.csv"]),
    ],
)
def test_bad_options_end_in_one_sentence(good_csv, monkeypatch, options, words):
    monkeypatch.chdir(good_csv.parent)
    before = good_csv.read_bytes()
    refused(run("fit", good_csv, "--out", "m.json", *options), *words)
    assert files(good_csv.parent) == ["good.csv"]
    assert good_csv.read_bytes() == before


@pytest.mark.parametrize("status", [FitStatus.MAX_STEPS, FitStatus.NONFINITE])
def test_a_failed_fit_ends_in_its_sentence(good_csv, monkeypatch, status):
    def fail(*_, **__):
        raise FitError(status)

    monkeypatch.setattr("fits.loop._fit.fit", fail)
    refused(run("fit", good_csv, "--out", good_csv.parent / "m.json", "--plots", good_csv.parent / "p"), status.value)
    assert files(good_csv.parent) == ["good.csv"]


def test_other_mistakes_are_not_hidden(good_csv, monkeypatch):
    monkeypatch.setattr("fits.loop._fit.fit", lambda *_, **__: 1 / 0)
    assert isinstance(run("fit", good_csv, "--out", good_csv.parent / "m.json").exception, ZeroDivisionError)
    assert files(good_csv.parent) == ["good.csv"]


@pytest.mark.parametrize(
    "typed", [["{}"], ["fit", "a.csv", "--{}"], ["fit", "a.csv", "--out", "m.json", "--loss", "{}"]]
)
def test_what_was_typed_is_not_quoted_at_any_length(typed):
    result = run(*(part.format("q" * 6000) for part in typed))
    assert result.exit_code == 2
    assert "qqq" in result.stderr
    assert len(result.stderr) < 1300


def test_the_option_that_a_refusal_suggests_can_be_pasted(tmp_path):
    path = tmp_path / "weg.csv"
    path.write_text("time_s;Spannung [V];Weg [nm]\n" + rows(*signals(), separator=";"))
    told = run("fit", path, "--out", tmp_path / "m.json").stderr
    option, columns = shlex.split(told[told.index("--columns") :].rstrip(".\n"))
    found = read_table(path, columns=parse_columns(columns))
    assert option == "--columns"
    np.testing.assert_allclose(found.displacement_um, signals()[2] / 1000)


def test_the_refusal_of_a_column_without_a_unit_says_what_guesses_it(tmp_path):
    """It said um where `inspect` said nm."""
    path = tmp_path / "plain.csv"
    path.write_text("time_s,voltage_V,y\n" + rows(*signals()[:2], 1000 * signals()[2]))
    told = "for instance --columns 'displacement_um=y[UNIT]', or see what microid inspect "
    refused(run("fit", path, "--out", tmp_path / "m.json"), f"{told}{path} says")
    named = ("--columns", "displacement_um=y[UNIT]")
    refused(
        run("fit", path, *named, "--out", tmp_path / "m.json"), "expected a unit out of um, nm", "found unit 'UNIT'"
    )
    command = shlex.split(json.loads(run("inspect", path, "--json").stdout)["command"])
    found = read_table(path, columns=command[command.index("--columns") + 1])
    np.testing.assert_allclose(found.displacement_um, signals()[2])


def test_every_command_can_be_quiet_and_tell_more(good_csv):
    for name, command in commands():
        known = {spelt for option in options_of(command) for spelt in option.opts}
        assert name == "sweep" or {"-q", "--quiet", "-v", "--verbose"} <= known, name
    plain, told = run("inspect", good_csv), run("inspect", good_csv, "-v", "-q")
    assert plain.stderr == ""
    assert told.stdout == plain.stdout
    assert f"read {good_csv}, {good_csv.stat().st_size} bytes" in told.stderr
    assert run("inspect", good_csv).stderr == ""
    lines = run("info", "none.json", "--verbose").stderr.splitlines()
    assert "Traceback (most recent call last):" in lines
    assert lines[-1] == "none.json: no such file; check the name and the folder."


def test_a_file_of_another_kind_is_told_by_what_it_is(tmp_path, good_csv):
    model, answer = tmp_path / "model.json", tmp_path / "diagnosis.json"
    assert run("fit", good_csv, "--levels", 8, "--out", model, "--quiet").exit_code == 0
    refused(
        run("inspect", model), "line 1: expected a header and rows of numbers, found JSON; name a table (microid info"
    )
    table = "expected a model file in JSON, found a table or another text; name such a file (microid inspect shows"
    refused(run("info", good_csv), table)
    bare = tmp_path / "bare.csv"
    bare.write_text("0.5,1,2\n1.5,2,3\n")
    refused(run("info", bare), table)
    large = tmp_path / "large.json"
    large.write_text(model.read_text() + " " * 1_000_000)
    for file in (model, large):
        for command in (("sweep", file, "--out", tmp_path / "out"), ("sensitivity", file)):
            refused(run(*command), "found JSON; name another file (microid info shows a model file)")
    answer.write_text('{"schema": "microid.diagnosis/1"}')
    refused(run("info", answer), "found the answer of a diagnosis; name baseline.json or extended.json beside it")


def test_a_unit_that_is_guessed_is_said_to_be(tmp_path):
    """Counts were taken for nm without a word."""
    time_s, voltage_V, displacement_um = signals()
    for name, unit, guessed in (("counts", "", True), ("counts", "[nm]", False), ("weg", "_um", False)):
        path = tmp_path / "counts.csv"
        path.write_text(f"time_s,voltage_V,{name}{unit}\n" + rows(time_s, voltage_V, 500 * displacement_um))
        told = " ".join(json.loads(run("inspect", path, "--json").stdout)["remarks"])
        assert (f"column '{name}' states no unit, and [nm] is guessed" in told) == guessed


@pytest.mark.parametrize("command", ["fit", "inspect", "sensitivity"])
def test_a_format_of_no_pictures_is_refused(command, tmp_path):
    (tmp_path / "run.csv").write_text("time_s,voltage_V,displacement_um\n0,0,0\n")
    given = {"fit": [tmp_path / "run.csv", "--out", tmp_path / "m.json"], "inspect": [tmp_path / "run.csv"]}
    refused(run(command, *given.get(command, []), "--format", "svg"), "--format", "--plots")
    assert files(tmp_path) == ["run.csv"]


def test_choices_in_the_help_are_those_of_the_library():
    options = {option.name: option for option in cli.commands["fit"].params}
    assert tuple(options["initial"].type.choices) == INITIAL_STATES
    for family in FAMILIES:
        assert family in options["family"].help
    assert run("simulate", "m", "p", "--out", "o", "--initial", "unknown").exit_code == 2
