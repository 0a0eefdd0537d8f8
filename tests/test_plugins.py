"""A new density, hysteresis law, effect or command is one new file, and works from the command at once."""

import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

DENSITY = '''
    """A density that is the same everywhere."""
    from typing import ClassVar, Self
    import jax.numpy as jnp
    from jaxtyping import Array, Float, PRNGKeyArray
    from microid._param import array, param, static
    from microid.densities._base import AbstractDensity, register

    @register
    class FlatDensity(AbstractDensity):
        """One number."""
        family: ClassVar[str] = "flat"
        weight_um: Float[Array, ""] = param(unit="um", scale=10.0, lower=0.0)
        lower_V: Float[Array, ""] = array()
        upper_V: Float[Array, ""] = array()
        levels: int = static()

        def nodes_um_per_V2(self):
            area = (self.upper_V - self.lower_V) ** 2 / 2
            return self.weight_um / area * jnp.tril(jnp.ones((self.levels, self.levels)))

        @classmethod
        def start(cls, lower_V, upper_V, levels, stroke_um, key):
            return cls(jnp.asarray(stroke_um), lower_V, upper_V, levels)
'''
LAW = '''
    """A spring: no hysteresis at all."""
    import jax.numpy as jnp
    from jaxtyping import Array, Float
    from microid._param import param
    from microid._part import AbstractHysteresis
    from microid.hysteresis._base import register

    @register
    class Spring(AbstractHysteresis):
        """Proportional."""
        slope_um_per_V: Float[Array, ""] = param(unit="um/V", scale=0.1, lower=0.0)
        offset_um: Float[Array, ""] = param(unit="um", scale=10.0, default=0.0)

        def __call__(self, voltage_V, start=None):
            return self.slope_um_per_V * voltage_V + self.offset_um
'''
EFFECT = '''
    """A sensor that shows so many times the displacement."""
    from typing import ClassVar
    import jax.numpy as jnp
    from jaxtyping import Array, Float
    from microid._param import param
    from microid._part import Signal
    from microid.effects._base import AbstractEffect, Place, View, register

    @register
    class WrongGain(AbstractEffect):
        """A factor."""
        name: ClassVar[str] = "wrong_gain"
        takes: ClassVar[str] = "um"
        gives: ClassVar[str] = "um"
        place: ClassVar[Place] = "sensor"
        strength: ClassVar[tuple[str, ...]] = ("excess",)
        fingerprint: ClassVar[str] = "The residual is proportional to the displacement."
        confusions: ClassVar[tuple[str, ...]] = ()
        experiment: ClassVar[str] = "A reference sensor."
        source: ClassVar[str] = "a test"
        view: ClassVar[View] = "position"
        column: ClassVar[str] = "gauge_um: a second sensor."
        excess: Float[Array, ""] = param(unit="1", scale=1e-2)

        @classmethod
        def probes(cls, scales, inner):
            return ((cls(jnp.asarray(1e-3)),),)

        def run(self, time_s, signal, start=None):
            grow = 1 + self.excess
            return Signal(grow * signal.values, grow * signal.before, signal.hold)
'''
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
        "fits/cli/hello.py": COMMAND,
    }.items():
        (folder / place).write_text(textwrap.dedent(text).lstrip())
    return folder


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
    return done.stdout


def test_a_command_is_one_file(copy):
    assert "hello" in python(copy, "-m", "fits", "--help")
    assert python(copy, "-m", "fits", "hello", "you", "--loud") == "hello YOU\n"


def test_a_density_is_one_file_and_is_saved_and_read(copy):
    python(copy, "-m", "fits", "synth", "quickstart", "--out", "data")
    fit = ["fit", "data/train.csv", "--family", "flat", "--starts", "1", "--levels", "8", "--out", "flat.json"]
    python(copy, "-m", "fits", *fit)
    assert "FlatDensity" in (copy / "flat.json").read_text()
    python(copy, "-m", "fits", "simulate", "flat.json", "data/heldout.csv", "--out", "out.csv")
    assert (copy / "out.csv").read_text().startswith("time_s,voltage_V,displacement_um")


SAVE = """
import jax; jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp, microid, fits
from microid.hysteresis import LAWS
[effect] = [each for each in microid.EFFECTS if each.name == "wrong_gain"]
law = LAWS["spring"](jnp.asarray(0.25), jnp.asarray(1.0))
stage = microid.Stage.of(hysteresis=law, sensor=effect(jnp.asarray(0.5)))
fits.save_model("spring.json", stage, None, {})
"""


def test_a_hysteresis_law_and_an_effect_are_one_file_each_and_are_saved_and_read(copy):
    python(copy, "-c", SAVE)
    (copy / "program.csv").write_text("time_s,voltage_V\n0,0\n1,8\n2,4\n")
    python(copy, "-m", "fits", "simulate", "spring.json", "program.csv", "--out", "moved.csv")
    rows = [line.split(",") for line in (copy / "moved.csv").read_text().splitlines()[1:]]
    assert [float(row[2]) for row in rows] == pytest.approx([1.5, 4.5, 3.0])


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
    assert "Wrong gain explains" in page
    assert said[0] in page
    assert "Residual against measured displacement" in page
    assert "Source: a test." in page
