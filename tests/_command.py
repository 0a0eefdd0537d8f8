"""Running the `microid` command in tests, and looking at what it writes."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.image import imread

from fits.cli._main import cli
from fits.stage import _plain_stage

OFF = {"MICROID_CACHE": "off"}


def run(*arguments):
    return CliRunner(env=OFF).invoke(cli, [str(argument) for argument in arguments])


def without_jax(*arguments, and_without=()):
    """Run a command, of which it is known in the end that it did not load JAX, nor other libraries."""
    asked = "import sys; from fits.cli._main import main; sys.argv[0] = 'microid'; main()"
    loaded = f"atexit.register(lambda: print({{'jax', *{tuple(and_without)}}} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", f"import atexit, sys; {loaded}; {asked}", *map(str, arguments)],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.endswith("set()\n"), done.stderr + done.stdout
    return done


def says_the_same_with_jax(monkeypatch, arguments, here):
    """Run a command that writes a table `here`, and again with JAX: both agree, and so does what they say."""
    plain = run(*arguments, "--out", here, "--json")
    rows = columns_of(here) if plain.exit_code == 0 else {}
    with monkeypatch.context() as patched:
        patched.setattr(_plain_stage, "plain_model", lambda content: None)
        slow = run(*arguments, "--out", here, "--json")
    assert (plain.exit_code, plain.stderr) == (slow.exit_code, slow.stderr)
    if slow.exit_code:
        return
    assert rows.keys() == columns_of(here).keys()
    for name, values in columns_of(here).items():
        np.testing.assert_allclose(rows[name], values, rtol=0, atol=1e-11 * max(1.0, np.ptp(values)))
    said, expected = json.loads(plain.stdout), json.loads(slow.stdout)
    assert said.keys() == expected.keys()
    for key, value in expected.items():
        assert said[key] == (pytest.approx(value, rel=1e-9, abs=1e-9) if isinstance(value, float) else value)


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def columns_of(path):
    """Columns of numbers of a CSV by name."""
    header, *rows = path.read_text().splitlines()
    return dict(zip(header.split(","), np.array([row.split(",") for row in rows], dtype=float).T, strict=True))


def whole_picture(path):
    """Grey levels of a picture on which something is drawn and nothing is cut off: the rim stays white."""
    image = imread(path)[..., :3].mean(axis=-1)
    assert image.std() > 0.02
    assert np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]]).min() > 0.99
    return image


def refused(result, *words):
    assert result.exit_code == 2
    assert result.stdout == ""
    progress = re.compile(r"(\[[#.]+\])? +\d+\.\d s  ")
    lines = [line for line in result.stderr.splitlines() if not progress.match(line)]
    assert len(lines) == 1
    for word in words:
        assert word in lines[0]
