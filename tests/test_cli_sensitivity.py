import dataclasses
import json
import sys
import types
from pathlib import Path

import pytest
from _command import files, refused, run

import fits
from fits.cli._main import cli
from fits.report._machining import sensitivity_json
from microid import kinetostatics as ks


def told(*options):
    """What the command prints as JSON."""
    result = run("sensitivity", *options, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    return json.loads(result.stdout)


@pytest.fixture
def stage(tmp_path):
    """A stage with a tolerance for t4 that no other dimension has."""
    design = fits.paper_design()
    path = tmp_path / "stage.toml"
    fits.write_design(dataclasses.replace(design, tolerance=design.tolerance | {"t4": 0.05}), path)
    return path


@pytest.mark.study
def test_the_papers_stage_is_ranked_and_compared_with_the_papers_words(tmp_path):
    result = run("sensitivity")
    assert result.exit_code == 0, result.stderr
    for words in (
        "x and y: 6.53222 um/um",
        "gamma: 500.847 urad/um",
        "um/10 um",
        "Fig. 7",
        "disagree",
    ):
        assert words in result.stdout
    assert "fixed voltage" not in result.stdout
    assert told() == sensitivity_json(fits.sensitivities(fits.paper_design()))


def test_one_axis_and_a_fixed_voltage():
    result = run("sensitivity", "--axis", "z", "--voltage")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith("z: 9.14828 um/um")
    assert "at a fixed voltage, % of output: t4 -4.34, alpha2 +1.2" in result.stdout
    assert "la2 rises" in result.stdout
    for words in ("gamma:", "x and y:", "t6, t7"):
        assert words not in result.stdout


def test_json_on_stdout_is_nothing_but_json():
    assert list(told("--axis", "beta")["axes"]) == ["beta"]


def test_a_stage_of_ones_own(stage):
    result = run("sensitivity", stage, "--axis", "z")
    assert result.exit_code == 0, result.stderr
    assert "0.05 mm" in result.stdout
    assert "Fig. 7" not in result.stdout
    found = told(stage, "--axis", "z")["axes"]["z"]["parameters"]["t4"]
    assert found["tolerance"] == 0.05
    assert found["relative_change_pct"] == pytest.approx(5 * found["derivative"] / 9.148282226628, rel=1e-9)


@pytest.mark.parametrize("length", ["0.01mm", " 10 um ", "10µm", "1e-2 mm"])
def test_a_tolerance_is_that_of_all_lengths(stage, length):
    found = told(stage, "--axis", "z", "--tolerance", length)["axes"]["z"]["parameters"]
    assert {name: each["tolerance"] for name, each in found.items()} == {"t4": 0.01, "la2": 0.01, "alpha2": 0.01 / 9}


def test_the_stage_it_writes_is_the_one_it_used(stage, tmp_path):
    level_0 = tmp_path / "level_0.toml"
    options = ("--axis", "z", "--tolerance", "0.013mm", "--level", 0)
    once = told(stage, *options, "--write-stage", level_0)
    assert once == told(level_0, "--axis", "z")
    assert once["level"] == 0
    assert fits.read_design(level_0).tolerance["t4"] == 0.013


def draw(design, report, folder, *, form):
    assert isinstance(design, fits.Design)
    path = folder / f"{'_'.join(report.axes)}.png"
    path.write_bytes(b"drawn")
    return [path]


@pytest.fixture
def drawing(monkeypatch):
    def use(function):
        module = types.ModuleType("fits.plots._machining")
        module.plot_sensitivity = function
        monkeypatch.setitem(sys.modules, module.__name__, module)

    return use


def test_plots_go_to_their_folder(stage, tmp_path, drawing):
    drawing(draw)
    result = run("sensitivity", stage, "--axis", "z", "--plots", tmp_path / "new" / "plots")
    assert result.exit_code == 0, result.stderr
    assert f"plot   {tmp_path / 'new' / 'plots' / 'z.png'}" in result.stdout
    assert files(tmp_path / "new") == ["plots", "plots/z.png"]


def test_an_interruption_leaves_nothing(stage, tmp_path, drawing):
    def interrupt(design, report, folder, **options):
        draw(design, report, folder, **options)
        raise KeyboardInterrupt

    drawing(interrupt)
    (tmp_path / "w.toml").write_text("old")
    options = ("--write-stage", tmp_path / "w.toml", "--plots", tmp_path / "plots")
    result = run("sensitivity", stage, "--axis", "z", *options)
    assert (result.exit_code, result.stdout) == (130, "")
    assert result.stderr == "Interrupted: no unfinished file was left.\n"
    assert files(tmp_path) == ["stage.toml", "w.toml"]
    assert (tmp_path / "w.toml").read_text() == "old"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["none.toml"], ["none.toml"]),
        (["."], ["."]),
        (["broken.toml"], ["broken.toml", "line 8", "geometry.t1", "0.8"]),
        (["--tolerance", "0.02"], ["--tolerance", "0.02mm", "20um", "'0.02'"]),
        (["--tolerance", "0.02cm"], ["--tolerance", "'0.02cm'"]),
        (["--tolerance", "-0.02mm"], ["--tolerance"]),
        (["--tolerance", "0mm"], ["--tolerance", "above 0"]),
        (["--tolerance", "1e999mm"], ["--tolerance"]),
        (["--tolerance", "1.2.3mm"], ["--tolerance"]),
        (["--tolerance", "1mm"], ["--tolerance 1mm", "geometry.t1", "0.8"]),
        (["--write-stage", "no/such/s.toml"], ["no/such"]),
        (["--write-stage", "."], ["folder"]),
        (["stage.toml", "--write-stage", "./stage.toml"], ["--write-stage", "STAGE.toml", "overwrite"]),
        (["--plots", "stage.toml"], ["stage.toml: expected a folder"]),
    ],
)
def test_bad_input_ends_in_one_sentence(stage, monkeypatch, options, words):
    monkeypatch.chdir(stage.parent)
    monkeypatch.setattr("fits.machining._sensitivity.sensitivities", lambda *_: pytest.fail("worked before refusing"))
    Path("broken.toml").write_text(stage.read_text().replace("t1 = { value = 0.8", "t1 = { value = -0.8"))
    before = stage.read_bytes()
    refused(run("sensitivity", *options), *words)
    assert files(stage.parent) == ["broken.toml", "stage.toml"]
    assert stage.read_bytes() == before


def test_choices_in_the_help_are_those_of_the_library():
    options = {option.name: option for option in cli.commands["sensitivity"].params}
    assert tuple(options["axis"].type.choices) == (*ks.AXES, "all")
    assert run("sensitivity", "--axis", "w").exit_code == 2
    assert run("sensitivity", "--level", "2").exit_code == 2
