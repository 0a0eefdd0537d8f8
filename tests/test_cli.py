import json
import os
import re
import shutil
import signal
import subprocess
import sys
from html import unescape
from pathlib import Path

import jax
import numpy as np
import pytest
from _command import OFF, columns_of, files, refused, run, without_jax

from fits.io._jax_setup import _cache_folder

ROOT = Path(__file__).parents[1]


# A shell that runs in the background makes its children ignore interrupts.
HEEDING = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from fits.cli._main import main; main()"
)


def shell(*arguments, **options):
    env = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"} | OFF | options.pop("env", {})
    command = [sys.executable, "-c", HEEDING, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env, **options)


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A folder with example CSVs, and what `synth` and `fit` said about them."""
    folder = tmp_path_factory.mktemp("bench")
    synth = run("synth", "plays", "--out", folder / "csv", "--seed", 5)
    train, heldout = folder / "csv" / "train.csv", folder / "csv" / "heldout.csv"
    out, plots = folder / "model.json", folder / "new" / "plots"
    fit = run("fit", train, "--holdout", heldout, "--levels", 8, "--out", out, "--plots", plots)
    return folder, synth, fit


def test_synth_writes_records_and_truth(bench):
    folder, synth, _ = bench
    assert synth.exit_code == 0
    assert files(folder / "csv") == ["heldout.csv", "train.csv", "truth.json"]
    for line in synth.stdout.splitlines()[1:]:
        assert Path(line).exists()


def test_fit_reports_in_words_and_writes_model_and_plots(bench):
    folder, _, fit = bench
    assert fit.exit_code == 0, fit.stderr
    for words in ("8 levels from 0 to 120 V", "in-sample", "held-out", "e_loop", "model.json", "heldout.png"):
        assert words in fit.stdout
    assert "8 levels" in fit.stderr
    assert "Traceback" not in fit.stderr
    pictures = [f"{name}.png" for name in ("density", "everett", "heldout", "loops")]
    assert files(folder / "new") == ["plots", *sorted(f"plots/{name}" for name in (*pictures, "index.html"))]
    page = (folder / "new" / "plots" / "index.html").read_text(encoding="utf-8")
    assert sorted(re.findall(r'<img src="(.*?)"', page)) == pictures
    told = re.sub("<[^>]+>", "", re.search("<pre.*?>(.*?)</pre>", page, re.DOTALL)[1])
    assert unescape(told).rstrip("\n") == fit.stdout.partition("\n\nmodel ")[0]


def test_prediction_agrees_with_the_truth_of_the_bench(bench, tmp_path):
    folder, _, _ = bench
    program = folder / "csv" / "heldout.csv"
    result = run("simulate", folder / "model.json", program, "--out", tmp_path / "p.csv", "--json")
    assert result.exit_code == 0, result.stderr
    predicted, measured = columns_of(tmp_path / "p.csv"), columns_of(program)
    assert list(predicted) == ["time_s", "voltage_V", "displacement_um", "displacement_sd_um"]
    for column in ("time_s", "voltage_V"):
        assert np.array_equal(predicted[column], measured[column])
    truth = json.loads((folder / "csv" / "truth.json").read_text())["runs"]["heldout"]["displacement_um"]
    assert np.std(predicted["displacement_um"] - truth) < 0.05  # the sensor's noise is 0.03 um, the stroke 40 um
    assert np.all(predicted["displacement_sd_um"] > 0)
    summary = json.loads(result.stdout)
    assert summary["samples"] == len(measured["time_s"])
    assert summary["displacement_max_um"] == predicted["displacement_um"].max()


def test_programs_need_no_displacement_and_initial_states_differ(bench, tmp_path):
    folder, _, _ = bench
    program = tmp_path / "program.csv"
    program.write_text("t_ms,u_mV\n0,40000\n1,50000\n2,40000\n")
    found = {}
    for state in ("negative", "positive", "demagnetised"):
        out = tmp_path / f"{state}.csv"
        columns = "time_s=t_ms,voltage_V=u_mV"
        result = run(
            "simulate", folder / "model.json", program, "--out", out, "--initial", state, "--columns", columns
        )
        assert result.exit_code == 0, result.stderr
        assert str(out) in result.stdout
        found[state] = columns_of(out)
    assert found["negative"]["voltage_V"].tolist() == [40.0, 50.0, 40.0]
    first = {state: columns["displacement_um"][0] for state, columns in found.items()}
    assert first["negative"] < first["demagnetised"] < first["positive"]


def test_json_and_info_agree(bench, tmp_path):
    folder, _, fit = bench
    out = tmp_path / "model.json"
    again = run(
        "fit", folder / "csv" / "train.csv", "--holdout", folder / "csv" / "heldout.csv", "--levels", 8, "--out", out,
        "--json", "--quiet",
    )  # fmt: skip
    assert again.exit_code == 0
    assert again.stderr == ""
    assert out.read_bytes() == (folder / "model.json").read_bytes()
    report = json.loads(again.stdout)
    assert report.pop("out") == str(out)
    assert report.pop("plots") == []
    info = json.loads(run("info", out, "--json").stdout)
    assert info["model"] == "Preisach"
    assert info["fit"] == report
    packed = json.loads(out.read_text())["model"]["density"]["packed_um"]["value"]
    ends = {"lowest": min(packed), "highest": max(packed)}
    assert {"path": "density.packed_um", "shape": [36], "unit": "um", **ends} in info["parameters"]

    measured = columns_of(folder / "csv" / "heldout.csv")["displacement_um"]
    assert report["held_out"]["range_um"] == np.ptp(measured)
    assert report["held_out"]["e_rms_pct"] == pytest.approx(100 * report["held_out"]["rms_um"] / np.ptp(measured))
    assert 0.05 < report["held_out"]["e_rms_pct"] < 0.15
    assert [run["source"] for run in report["runs"]] == ["train.csv", "heldout.csv"]
    words = run("info", out)
    assert words.exit_code == 0
    assert fit.stdout.split("\n\nmodel ")[0] in words.stdout
    assert "\nfitted to train.csv; heldout.csv only predicted\n" in words.stdout
    assert f"36 numbers from {min(packed):.4g} to {max(packed):.4g} um\n" in words.stdout


def test_info_does_not_wait_for_jax(bench):
    done = without_jax("info", bench[0] / "model.json")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("command", [["fit"], ["diagnose"], ["simulate", "model.json"], ["compensate", "model.json"]])
def test_what_cannot_be_read_is_refused_without_jax(command, tmp_path):
    bad = tmp_path / "bad.csv"
    bad.write_text("time_s,voltage_V,displacement_um\n0,1,2\n1,x,y\n")
    done = without_jax(*command, bad, "--out", tmp_path / "out")
    assert done.returncode == 2
    column = "displacement_um" if command[0] == "compensate" else "voltage_V"
    assert f"bad.csv, line 3, column '{column}'" in done.stderr


@pytest.mark.parametrize("step", ["loop._fit.fit", "plots._fit.plot_fit", "stage._model_file.model_text"])
def test_an_interruption_leaves_nothing(bench, tmp_path, monkeypatch, step):
    folder, _, _ = bench
    old = tmp_path / "m.json"
    old.write_text("old")

    def interrupt(*arguments, **_):
        for argument in arguments:
            if isinstance(argument, Path):
                (argument / "loops.png").write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(f"fits.{step}", interrupt)
    csv = folder / "csv" / "train.csv"
    result = run("fit", csv, "--out", old, "--plots", tmp_path / "plots", "--levels", 8)
    assert result.exit_code == 130
    assert result.stderr.splitlines()[-1] == "Interrupted: no unfinished file was left."
    assert result.stdout == ""
    assert files(tmp_path) == ["m.json"]
    assert old.read_text() == "old"


def test_simulate_refuses_what_it_cannot_predict(bench, tmp_path):
    folder, _, _ = bench
    model, out, program = folder / "model.json", tmp_path / "p.csv", tmp_path / "program.csv"
    program.write_text("time_s,voltage_V\n0,10\n1,130\n")
    refused(run("simulate", model, program, "--out", out), "program.csv", "130 V", "120 V")
    program.write_text("time_s,displacement_um\n0,10\n1,130\n")
    refused(run("simulate", model, program, "--out", out), "program.csv", "voltage_V")
    program.write_text("time_s,voltage_V\n0,10\n1,20\n")
    refused(run("simulate", model, tmp_path / "none.csv", "--out", out), "none.csv")
    refused(run("simulate", model, program, "--out", tmp_path / "none" / "p.csv"), "none")
    refused(run("simulate", model, program, "--out", program), "overwrite")
    for name in ("p.xlsx", "p.xlsx.gz", "p.npz.gz", "p.json"):
        refused(run("simulate", model, program, "--out", tmp_path / name), f"{name}: expected a name that ends in")
    refused(run("simulate", program, program, "--out", out), "program.csv")
    text = model.read_text()
    for changed in (text.replace("microid.model/1", "microid.model/2"), text.replace("0.", "1.", 1), text[:1000]):
        (tmp_path / "changed.json").write_text(changed)
        refused(run("simulate", tmp_path / "changed.json", program, "--out", out), "changed.json")
        refused(run("info", tmp_path / "changed.json"), "changed.json")
    assert files(tmp_path) == ["changed.json", "program.csv"]


def test_exchanged_columns_are_noticed(bench, tmp_path):
    header, *rows = (bench[0] / "csv" / "train.csv").read_text().splitlines()
    assert header.startswith("time_s,voltage_V,displacement_um")
    path = tmp_path / "exchanged.csv"
    other = header.replace("voltage_V,displacement_um", "displacement_um,voltage_V")
    path.write_text("\n".join([other, *rows]) + "\n")
    refused(run("fit", path, "--out", tmp_path / "model.json"), "exchanged.csv", "the other way round")
    refused(run("diagnose", path, "--out", tmp_path / "report"), "exchanged.csv", "the other way round")
    assert set(files(tmp_path)) <= {"exchanged.csv", "report"}


def test_synth_refuses_unknown_scenarios_and_places(tmp_path):
    (tmp_path / "file").write_text("")
    refused(run("synth", "quickstrat", "--out", tmp_path / "q"), "quickstart")
    refused(run("synth", "bouwen", "--out", tmp_path / "q"), "boucwen")
    refused(run("synth", "quickstart", "--out", tmp_path / "file"), "file")
    assert files(tmp_path) == ["file"]
    listed = run("synth", "--list")
    assert listed.exit_code == 0
    assert {"quickstart", "plays"} <= {line.split()[0] for line in listed.stdout.splitlines()}
    for arguments in (("--list", "--json"), ("--json", "--list")):
        about = json.loads(run("synth", *arguments).stdout)
        assert [f"{name:20} {words}" for name, words in about.items()] == listed.stdout.splitlines()
    for arguments in ((), ("plays",), ("--out", tmp_path / "q")):
        refused(run("synth", *arguments), "expected a SCENARIO and --out DIR; --list shows the scenarios")
    seeded = json.loads(run("synth", "plays", "--out", tmp_path / "q", "--seed", 3, "--json").stdout)
    assert seeded["seed"] == 3
    assert sorted(seeded["files"]) == [
        str(tmp_path / "q" / name) for name in ("heldout.csv", "train.csv", "truth.json")
    ]


def test_version():
    result = run("--version")
    assert result.exit_code == 0
    assert result.stdout.startswith("microid")
    done = subprocess.run(
        [sys.executable, "-m", "microid", "--version"], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout == result.stdout


def test_compiled_functions_are_kept_where_the_user_says(tmp_path, monkeypatch):
    monkeypatch.setenv("MICROID_CACHE", str(tmp_path / "a" / "b"))
    assert _cache_folder() == tmp_path / "a" / "b"
    assert _cache_folder().is_dir()
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("MICROID_CACHE", str(tmp_path / "file" / "below"))
    assert _cache_folder() is None
    for off in ("", "off", "0"):
        monkeypatch.setenv("MICROID_CACHE", off)
        assert _cache_folder() is None
    monkeypatch.delenv("MICROID_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert _cache_folder() == tmp_path / "xdg" / "microid" / "jax"
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert _cache_folder() is None


def test_help_does_not_wait_for_heavy_libraries():
    code = (
        "import sys\n"
        "from fits.cli._main import cli\n"
        "for arguments in (['--help'], ['fit', '--help'], ['synth', '--help'], ['--version']):\n"
        "    cli(arguments, standalone_mode=False)\n"
        "print(sorted({'jax', 'pandas', 'matplotlib', 'numpy', 'scipy'} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert "simulate" in done.stdout


def test_a_real_interruption_and_a_closed_pipe(bench, tmp_path):
    folder, _, _ = bench
    shutil.copy(folder / "csv" / "train.csv", tmp_path / "train.csv")
    process = shell("fit", "train.csv", "--out", "m.json", "--plots", "plots", cwd=tmp_path)
    assert "levels" in process.stderr.readline()
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate()
    assert (process.returncode, stdout) == (130, "")
    assert stderr.splitlines()[-1] == "Interrupted: no unfinished file was left."
    assert "Traceback" not in stderr
    assert files(tmp_path) == ["train.csv"]

    process = shell("info", folder / "model.json")
    process.stdout.close()
    stderr = process.stderr.read()
    process.stderr.close()
    assert process.wait() != 0
    assert "Traceback" not in stderr


def test_double_precision_is_on(bench):
    assert jax.config.read("jax_enable_x64")
    model = json.loads((bench[0] / "model.json").read_text())["model"]
    values = np.array(model["density"]["packed_um"]["value"])
    assert np.any(values.astype(np.float32).astype(float) != values)


@pytest.mark.study
def test_a_name_is_shown_as_it_is_whatever_is_in_it(bench, tmp_path):
    """A formula for Matplotlib, a command for a terminal, a tag, and a byte that is no character."""
    folder, _, _ = bench
    names = [os.fsencode(tmp_path) + b"/" + name for name in (b"a$x^$ \\$\xff.csv", b"<b>\x1b[31m\n.csv")]
    train, heldout = map(os.fsdecode, names)
    shutil.copy(folder / "csv" / "train.csv", train)
    shutil.copy(folder / "csv" / "heldout.csv", heldout)
    out, plots = os.fsdecode(os.fsencode(tmp_path) + b"/\xfe.json"), tmp_path / "plots$x^$"
    fitted = run("fit", train, "--holdout", heldout, "--levels", 8, "--out", out, "--plots", plots, "--json")
    assert fitted.exit_code == 0, fitted.stderr
    content = json.loads(fitted.stdout)
    assert [each["source"] for each in content["runs"]] == [r"a$x^$ \$\udcff.csv", r"<b>\x1b[31m\n.csv"]
    assert content["out"] == out
    assert len(list(plots.iterdir())) == 5
    # Through a real pipe, which has an encoding.
    process = shell("info", out)
    stdout, stderr = process.communicate()
    assert (process.returncode, stderr) == (0, "")
    assert r"a$x^$ \$\udcff.csv" in stdout
    assert "\x1b" not in stdout
    process = shell("export", out, "--out", os.fsdecode(os.fsencode(tmp_path) + b"/\xfd"))
    stdout, stderr = process.communicate()
    assert (process.returncode, stderr) == (0, "")
    assert r"\udcfd/compensator.h" in stdout
    refused(run("fit", os.fsdecode(names[1]) + "none", "--out", out), r"\x1b[31m")


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (["fit", "train.csv", "--out"], "out"),
        (["fit", "train.csv", "--out", "m.json", "--plots"], "plots"),
        (["diagnose", "train.csv", "--out"], "out"),
        (["synth", "quickstart", "--out"], "out"),
        (["export", "model.json", "--out"], "out"),
        (["simulate", "model.json", "train.csv", "--out"], "out"),
        (["compensate", "model.json", "train.csv", "--out"], "out"),
    ],
)
def test_places_that_cannot_be_are_refused_before_the_work(bench, tmp_path, monkeypatch, arguments, option):
    folder, _, _ = bench
    monkeypatch.chdir(tmp_path)
    shutil.copy(folder / "csv" / "train.csv", "train.csv")
    shutil.copy(folder / "model.json", "model.json")
    os.mkfifo("pipe")
    monkeypatch.setattr("fits.io._read_csv.read_runs", lambda *_: pytest.fail("the work has begun"))
    for place in ("", "n" * 300, "pipe"):
        refused(run(*arguments, place))
    assert files(tmp_path) == ["model.json", "pipe", "train.csv"]
