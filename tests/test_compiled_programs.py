"""How many programs a command compiles, in a process of its own."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from _command import run


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("programs")
    run("synth", "plays", "--out", folder, "--seed", 5)
    return folder


def programs(*arguments):
    """Names of the programs that a command compiles; those that only move numbers to the device do not count."""
    root = Path(__file__).parents[1]
    where = {"PYTHONPATH": str(root), "MICROID_CACHE": "off", "JAX_LOG_COMPILES": "1"}
    command = [sys.executable, "-m", "microid", *map(str, arguments)]
    done = subprocess.run(command, env=os.environ | where, capture_output=True, text=True, check=True)
    names = re.findall(r"Finished XLA compilation of jit\((\w+)\)", done.stderr)
    return sorted(name for name in names if name != "stage")


def test_a_fit_with_pictures_compiles_only_what_makes_the_model(folder):
    train, aside = folder / "train.csv", folder / "heldout.csv"
    out, pictures = folder / "model.json", folder / "plots"
    found = programs("fit", train, "--holdout", aside, "--initial", "negative", "--out", out, "--plots", pictures)
    assert found == ["columns_of", "model"]
    assert programs("simulate", out, aside, "--out", folder / "p.csv") == []
