"""Each new law, density, effect, column, controller, command or kind of sweep is one file, and works at once."""

import json
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pandas as pd
import pytest
from _plugins import COLUMN, DENSITY, EFFECT, LAW

ROOT = Path(__file__).parents[1]

SWELLING = (
    EFFECT.replace("WrongGain", "Swelling")
    .replace('"wrong_gain"', '"swelling"')
    .replace("excess: Float", 'needs: ClassVar[tuple[str, ...]] = ("humidity_pct",)\n        excess: Float')
)
SWELLING = SWELLING.replace("1 + self.excess", "1 + self.excess * start.columns['humidity_pct']")
COMMAND = '''
    """Say hello."""
    import click
    from fits.cli._common import Given, in_sentences

    @click.command()
    @click.argument("name")
    @click.option("--loud", is_flag=True)
    @in_sentences
    def hello(given: Given) -> None:
        """Greet."""
        click.echo(f"hello {given.name.upper() if given.loud else given.name}")
'''


FORMAT = '''
    """Channels one below the other: a name, and its numbers."""
    from fits.io._table import gathered
    from fits.io.formats._base import Format, register

    def open_pairs(path, data):
        rows = [line.split() for line in data.decode().splitlines()[1:]]
        return gathered(path, "channels", [((name,), [float(cell) for cell in cells], None) for name, *cells in rows])

    register(Format("a file of channels", (".pairs",), (b"PAIRS",), open_pairs))
'''


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """A copy of the packages with a new file of each kind in its place."""
    folder = tmp_path_factory.mktemp("copy")
    for package in ("microid", "fits", "data_synth"):
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    for place, text in {
        "microid/densities/flat.py": DENSITY,
        "microid/hysteresis/spring.py": LAW,
        "microid/effects/wrong_gain.py": EFFECT,
        "microid/effects/swelling.py": SWELLING,
        "fits/io/columns/humidity.py": COLUMN,
        "fits/io/formats/pairs.py": FORMAT,
        "fits/cli/hello.py": COMMAND,
    }.items():
        (folder / place).write_text(textwrap.dedent(text).lstrip())
    return folder


# Commands one after another, in one process that imports once.
COMMANDS = """
import json, sys
from click.testing import CliRunner
from fits.cli._main import cli
for arguments in json.loads(sys.argv[1]):
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0, (arguments, done.output)
    print(json.dumps(done.stdout))
"""


def commands(folder, *each, first=""):
    """What each command printed; `first` is Python to run before them."""
    said = python(folder, "-c", first + COMMANDS, json.dumps(each))
    return [json.loads(line) for line in said.splitlines()]


def python(folder, *arguments, code=0):
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(folder), "MICROID_CACHE": os.environ["JAX_COMPILATION_CACHE_DIR"]},
    )
    assert done.returncode == code, done.stderr
    return done.stderr if code else done.stdout


def test_a_command_is_one_file(copy):
    assert "hello" in python(copy, "-m", "fits", "--help")
    assert python(copy, "-m", "fits", "hello", "you", "--loud") == "hello YOU\n"


def test_a_density_is_one_file_and_is_saved_and_read(copy):
    # Two full loops of a constant density: between ends 10 V apart, u volts from the last one give u^2 / 100 of all.
    voltage_V = [10 - abs(k % 40 - 20) / 2 for k in range(121)]
    part = [(v / 10) ** 2 if k % 40 < 20 else 1 - (1 - v / 10) ** 2 for k, v in enumerate(voltage_V)]
    rows = [f"{0.1 * k},{v},{3 * p}" for k, (v, p) in enumerate(zip(voltage_V, part, strict=True))]
    (copy / "loops.csv").write_text("\n".join(["time_s,voltage_V,displacement_um", *rows]) + "\n")
    fit = ["fit", "loops.csv", "--family", "flat", "--starts", "1", "--levels", "4", "--out", "flat.json"]
    commands(copy, fit, ["simulate", "flat.json", "loops.csv", "--out", "out.csv"])
    assert "FlatDensity" in (copy / "flat.json").read_text()
    found = pd.read_csv(copy / "out.csv")["displacement_um"]
    assert found.max() - found.min() == pytest.approx(3, rel=1e-3)


SAVE = """
import jax; jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp, microid, fits
from microid.hysteresis import LAWS
[effect] = [each for each in microid.effects.EFFECTS if each.name == "wrong_gain"]
law = LAWS["spring"](jnp.asarray(0.25), jnp.asarray(1.0))
stage = microid.Stage.of(hysteresis=law, sensor=effect(jnp.asarray(0.5)))
fits.save_model("spring.json", stage, None, {})
"""


def test_a_hysteresis_law_and_an_effect_are_one_file_each_and_are_saved_and_read(copy):
    (copy / "program.csv").write_text("time_s,voltage_V\n0,0\n1,8\n2,4\n")
    commands(copy, ["simulate", "spring.json", "program.csv", "--out", "moved.csv"], first=SAVE)
    rows = [line.split(",") for line in (copy / "moved.csv").read_text().splitlines()[1:]]
    assert [float(row[2]) for row in rows] == pytest.approx([1.5, 4.5, 3.0])


@pytest.mark.study
def test_a_column_is_one_file_and_an_effect_uses_it(copy):
    save = SAVE.replace("wrong_gain", "swelling").replace("spring.json", "swelling.json")
    rows = "time_s,voltage_V,{}\n0,0,30\n1,8,40\n2,4,50\n"
    # Of its own name, converted; of a name that its file recognises; chosen by the user.
    given = (("humidity_permille", "", 0.1), ("hum_lab", "", 1.0), ("rh", "humidity_pct=rh[permille]", 0.1))
    for header, _, _ in given:
        (copy / f"{header}.csv").write_text(rows.format(header))
    simulate = [
        ["simulate", "swelling.json", f"{header}.csv", "--columns", columns, "--out", f"{header}_swollen.csv"]
        for header, columns, _ in given
    ]
    commands(copy, *simulate, first=save)
    for header, _, factor in given:
        found = [float(line.split(",")[2]) for line in (copy / f"{header}_swollen.csv").read_text().splitlines()[1:]]
        # The spring, 0.25 um/V and 1 um, times 1 + 0.5 per percent beyond the first reading.
        damp = [factor * more for more in (0, 10, 20)]
        expected = [(1 + 0.5 * each) * um for each, um in zip(damp, (1, 3, 2), strict=True)]
        assert found == pytest.approx(expected)
    arguments = ["simulate", "swelling.json", "program.csv", "--out", "not.csv"]
    (copy / "program.csv").write_text("time_s,voltage_V\n0,0\n1,8\n2,4\n")
    sentence = "program.csv: the model depends on humidity_pct: add a column of that name that varies.\n"
    assert python(copy, "-m", "fits", *arguments, code=2) == sentence


CONTROLLER = '''
    """An integral of the error, and nothing else."""
    from typing import ClassVar
    import jax.numpy as jnp
    from jaxtyping import Array, Float
    from microid._param import array, param
    from microid.control._base import AbstractLinearController, Setting, register

    @register
    class Integrator(AbstractLinearController):
        """A sum."""
        settings: ClassVar[tuple[Setting, ...]] = (
            Setting("integral_V_per_um_s", default=50.0), Setting("share", "1", lower=0.0, upper=1.0, default=1.0)
        )
        own: ClassVar[tuple[str, ...]] = ("gain_V_per_um_s",)
        gain_V_per_um_s: Float[Array, ""] = param(unit="V/(um s)", scale=100.0, lower=0.0)
        interval_s: Float[Array, ""] = array()

        @classmethod
        def of(cls, pid, numbers, plant):
            return cls(numbers["share"] * pid.integral_V_per_um_s, pid.interval_s)

        def init(self, rest_um=0.0, feedback_V=0.0):
            return jnp.zeros_like(self.interval_s) + feedback_V

        def step(self, state, reference_um, measured_um, feedforward_V=0.0):
            state = state + self.gain_V_per_um_s * self.interval_s * (reference_um - measured_um)
            return state, feedforward_V + state

        def transfer(self, z):
            return (self.gain_V_per_um_s * self.interval_s).astype(z.dtype) * z / (z - 1)

        def _unlimited(self):
            return self

        def _driven(self, state):
            return jnp.where(self.gain_V_per_um_s == 0, 0, state)
'''
LINEAR = """
import jax; jax.config.update("jax_enable_x64", True)
import microid, fits
fits.save_model("linear.json", microid.Stage.of(piezo=microid.Piezo(0.1)), None, {})
"""
SWEEP = """
schema = "microid.sweep/1"
kind = "control"
model = "linear.json"
[reference]
shape = "step"
samples = 20
interval_s = 1e-3
amplitude_um = 2.0
[controller]
kind = "integrator"
share = 0.5
[[axis]]
parameter = "controller.integral_V_per_um_s"
values = [4000.0, 8000.0]
"""


def integrated(rate_V_per_um_s, samples, wanted_um=2.0):
    """Errors of an integral around 0.1 um/V that answers a millisecond late, from 0 V and 0 um on."""
    voltage, displacement, errors = 0.0, 0.0, []
    for _ in range(samples):
        errors.append(wanted_um - displacement)
        voltage += rate_V_per_um_s * 1e-3 * errors[-1]
        displacement = 0.1 * voltage
    return errors


@pytest.mark.study
def test_a_controller_is_one_file_and_is_run_and_swept(copy):
    (copy / "microid/control/integrator.py").write_text(textwrap.dedent(CONTROLLER).lstrip())
    rows = [f"{k * 1e-3},{2.0 if k else 0.0}" for k in range(20)]
    (copy / "step.csv").write_text("\n".join(["time_s,displacement_um", *rows]) + "\n")
    (copy / "sweep.toml").write_text(SWEEP)
    control = ["control", "linear.json", "step.csv", "--controller", "integrator", "--feedforward", "none", "--json"]
    words, told = commands(
        copy, ["control", "--help"], [*control, "--gains", "0,4000,0", "--out", "run.csv"], first=LINEAR
    )
    assert "|integrator|" in words
    assert json.loads(told)["gains"]["gain_V_per_um_s"] == 4000.0
    # What is printed, changed, is what runs.
    (copy / "gains.json").write_text(told.replace("4000.0", "2000.0"))
    again = [*control, "--gains", "gains.json", "--out", "again.csv"]
    told, _ = commands(copy, again, ["sweep", "sweep.toml", "--out", "results"])
    assert json.loads(told)["gains"]["gain_V_per_um_s"] == 2000.0
    header, *lines = (copy / "run.csv").read_text().splitlines()
    errors = [float(line.split(",")[header.split(",").index("error_um")]) for line in lines]
    assert errors == pytest.approx([0.0, *integrated(4000.0, 19)], abs=1e-12)
    found = pd.read_parquet(copy / "results" / "results.parquet")
    expected = [integrated(rate, 20)[-1] for rate in (2000.0, 4000.0)]
    assert found["error_final_um"].tolist() == pytest.approx(expected, abs=1e-12)


def test_a_format_of_files_is_one_file(copy):
    (copy / "run.pairs").write_text("PAIRS\ntime_s 0 1 2\nvoltage_V 5 7 6\n")
    said = json.loads(python(copy, "-m", "fits", "inspect", "run.pairs", "--json"))
    assert [(each["use"], each["highest"]) for each in said["channels"]] == [("time_s", 2.0), ("voltage_V", 7.0)]


KIND = '''
    """The job `double`: twice a number."""
    from fits.sweeps._types import AbstractJob, Facts, Output, Parameter, Rows

    KEYS = ("double",)

    class DoubleJob(AbstractJob):
        """A product."""

        @property
        def facts(self):
            return Facts((Parameter("double.of_um", "um", 1.0),), (Output("twice_um", "um", "double"),), 4)

        def compute(self, block):
            return Rows({"twice_um": 2 * block.values["double.of_um"]}, ("",) * len(block.rows))

    def make(request):
        return DoubleJob()
'''


def test_a_kind_of_sweep_is_one_file(copy):
    (copy / "fits/sweeps/kinds/double.py").write_text(textwrap.dedent(KIND).lstrip())
    text = 'schema = "microid.sweep/1"\nkind = "double"\n[[axis]]\nparameter = "double.of_um"\nvalues = [1, 2, 5]\n'
    (copy / "double.toml").write_text(text)
    python(copy, "-m", "fits", "sweep", "double.toml", "--out", "doubled")
    assert pd.read_parquet(copy / "doubled" / "results.parquet")["twice_um"].tolist() == [2, 4, 10]


REPORT = """
import numpy as np, fits
from fits.diagnosis._experiment import further_column
from fits.diagnosis._findings import described
from fits.diagnosis._result import Diagnosis, Gain, RunView
from fits.report._diagnosis import report_html
from microid.effects import card_of
cause = described(card_of("wrong_gain"), ("creep",), 9.0, 1e-9, (), 1.0, 0.1)
time_s = 0.01 * np.arange(400)
voltage_V = 50 - 50 * np.cos(time_s)
run = RunView("run.csv", time_s, voltage_V, voltage_V / 5, voltage_V / 900, 0 * voltage_V, voltage_V < 99)
stage = fits.default_stage()
found = Diagnosis("effect_found", 0.01, "", 1.0, (cause,), 0.0, (), (), Gain(), None, (), stage, stage, (run,), 0.01)
open("report.html", "w").write(report_html(found))
print(fits.diagnosis_json(found)["causes"][0]["fingerprint"])
print(further_column(("wrong_gain",), ()))
"""


def test_the_card_of_an_effect_reaches_the_report(copy):
    said = python(copy, "-c", REPORT).splitlines()
    assert said == ["The residual is proportional to the displacement.", "gauge_um: a second sensor."]
    page = (copy / "report.html").read_text(encoding="utf-8")
    assert "explained by wrong gain" in page
    assert said[0] in page
    assert "Residual against measured displacement" in page
    assert "Source: a test." in page
