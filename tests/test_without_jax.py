"""`simulate` and static `compensate` of a hysteresis in NumPy: against JAX, against relays, and never with JAX."""

import re
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from _command import says_the_same_with_jax, without_jax
from _models import (
    LEVELS,
    compiled,
    densities_of,
    ends_um,
    limits_V,
    nested_voltages,
    random_model,
    starts,
    stroke_um,
)
from _reference import branches, play_relays, relay_weights_um

import microid as m
from fits import DataError, Record, Uncertainty, predict, save_model
from fits.io._model_text import read_model_text
from fits.loop._design import Grid
from fits.loop._path import Path
from fits.loop._plain_file import plain_loop
from fits.loop._prediction import MOST_EXTREMES, PIECE

STATES = ("negative", "positive", "demagnetised")
EXACT = 1e-12
SAMPLES = 300

inverse = compiled(m.invert)
respond = compiled(lambda model, voltage_V, start: model(voltage_V, start))


def uncertainty_of(rng, model):
    """Made-up perturbations on a grid of their own."""
    grid = Grid(*map(jnp.asarray, limits_V(model)), 5)
    columns_um = jnp.asarray(rng.normal(scale=1e-2, size=(40, grid.columns)))
    return Uncertainty(columns_um, jnp.asarray(rng.normal(scale=1e-2, size=40)), jnp.asarray(0.01), grid)


@pytest.fixture
def file(rng, tmp_path):
    """A model, its uncertainty and their file."""
    model = random_model(rng)
    uncertainty = uncertainty_of(rng, model)
    save_model(tmp_path / "m.json", model, uncertainty, {})
    return model, uncertainty, tmp_path / "m.json"


def plainly(path):
    return plain_loop(read_model_text(str(path)))


def times_s(n):
    return np.arange(n) / 100


@pytest.mark.parametrize("levels", [2, LEVELS])
def test_predictions_are_those_of_jax(levels, rng, tmp_path):
    model = random_model(rng, levels)
    uncertainty = uncertainty_of(rng, model)
    save_model(tmp_path / "m.json", model, uncertainty, {})
    loop = plainly(tmp_path / "m.json")
    lower_V, upper_V = limits_V(model)
    for state in STATES:
        voltage_V = nested_voltages(rng, lower_V, upper_V, SAMPLES)
        voltage_V[[20, 40, 41, 60]] = lower_V, upper_V, upper_V, rng.choice(np.linspace(lower_V, upper_V, levels))
        # Loops that come back exactly, and what begins otherwise.
        voltage_V[200:] = voltage_V[100:200]
        record = Record(times_s(SAMPLES), voltage_V, None)
        exact = {"rtol": 0, "atol": EXACT * stroke_um(model)}
        start = starts(model)[state]
        perturbed = np.stack(
            [
                respond(uncertainty.grid.model(columns, offset), voltage_V, start)
                for columns, offset in zip(uncertainty.columns_um, uncertainty.offset_um, strict=True)
            ]
        )
        sd_um = np.sqrt(np.sum(perturbed**2, axis=0) + float(uncertainty.discrepancy_um) ** 2)
        for found in (loop.predict(record, state), predict(model, record, state, uncertainty=uncertainty)):
            np.testing.assert_allclose(found.displacement_um, respond(model, voltage_V, start), **exact)
            np.testing.assert_allclose(found.displacement_sd_um, sd_um, **exact)


@pytest.mark.parametrize("state", STATES)
def test_the_inverse_is_that_of_jax(state, rng, file):
    model, _, path = file
    (lower_V, upper_V), (lowest_um, highest_um) = limits_V(model), ends_um(model)
    wanted_um = nested_voltages(rng, lowest_um - 1, highest_um + 1, SAMPLES)
    wanted_um[:4] = lowest_um, highest_um, highest_um, np.nextafter(highest_um, np.inf)
    voltage_V, *found_um = plainly(path).invert(wanted_um, state)
    expected = inverse(model, wanted_um, starts(model)[state])
    np.testing.assert_allclose(voltage_V, expected.voltage_V, rtol=0, atol=1e-11 * (upper_V - lower_V))
    expected_um = float(expected.lowest_um), float(expected.highest_um)
    np.testing.assert_allclose(found_um, expected_um, rtol=0, atol=EXACT * stroke_um(model))


def test_relays_agree_exactly_at_the_edges_of_cells(rng, file):
    model, _, path = file
    lower_V, upper_V = limits_V(model)
    cells = 2 * (model.density.levels - 1)
    weights_um, thresholds_V = relay_weights_um(*densities_of(model), lower_V, upper_V, cells)
    voltage_V = lower_V + rng.integers(0, cells + 1, SAMPLES) * (upper_V - lower_V) / cells
    found_um = plainly(path).predict(Record(times_s(SAMPLES), voltage_V, None), "negative").displacement_um
    expected_um = float(model.offset_um) + play_relays(weights_um, thresholds_V, voltage_V)
    np.testing.assert_allclose(found_um, expected_um, rtol=0, atol=EXACT * stroke_um(model))


def test_branches_hang_from_the_extremes_of_the_definition(rng):
    path = rng.integers(0, 12, 200).astype(float)
    path[0] = 0
    found, (anchor, rising) = Path.of(path[:1], path[1:]), branches(path)
    np.testing.assert_array_equal(path[found.anchor], path[anchor])
    np.testing.assert_array_equal(found.rising, rising)
    # The same piece by piece, with what each leaves carried on.
    pieces = list(Path.pieces(path[:1], path[1:], 7))
    anchors = np.concatenate([piece.values[piece.anchor[piece.lead :]] for piece in pieces])
    np.testing.assert_array_equal(anchors, path[anchor][1:])
    np.testing.assert_array_equal(np.concatenate([piece.rising[piece.lead :] for piece in pieces]), rising[1:])


def test_a_voltage_that_nests_too_deeply_is_refused(file):
    model, _, path = file
    loop, (lower_V, upper_V) = plainly(path), limits_V(model)

    def nested(n):
        swing = np.where(np.arange(n) % 2, 1.0, -1.0) * np.linspace(0.5, 0.01, n)
        return loop.predict(
            Record(times_s(n), (lower_V + upper_V) / 2 + swing * (upper_V - lower_V), None), "negative"
        )

    assert nested(MOST_EXTREMES - 10).displacement_um.shape == (MOST_EXTREMES - 10,)
    with pytest.raises(DataError, match="nests more than 4096"):
        nested(PIECE)


def test_what_is_not_plain_is_left_to_jax(file, tmp_path):
    model, _, path = file
    assert plainly(path) is not None
    content = read_model_text(str(path))
    for part, name, value in (
        ("model", "type", "Stage"),
        ("model", "more", 1),
        ("model", "offset_um", {"unit": "mm", "value": 0.0}),
        ("model", "offset_um", {"unit": "um", "value": 1e31}),
        ("uncertainty", "offset_um", {"unit": "um", "value": [0.0]}),
        ("uncertainty", "columns_um", {"unit": "um", "value": "none"}),
    ):
        assert plain_loop(content | {part: content[part] | {name: value}}) is None
    assert plain_loop(content | {"uncertainty": None}) is None
    stage = m.Stage.of(driver=m.Driver(0.001), hysteresis=model)
    save_model(tmp_path / "stage.json", stage, None, {})
    assert plainly(tmp_path / "stage.json") is None


def test_the_commands_say_the_same_without_jax(rng, file, tmp_path, monkeypatch):
    model, _, path = file
    lower_V, upper_V = limits_V(model)
    share = nested_voltages(rng, 0.1, 0.9, SAMPLES).tolist()
    program, reference = tmp_path / "p.csv", tmp_path / "r.csv"
    lowest_um, highest_um = ends_um(model)
    rows = [f"{k / 100},{lower_V + s * (upper_V - lower_V)}\n" for k, s in enumerate(share)]
    program.write_text("time_s,voltage_V\n" + "".join(rows))
    rows = [f"{k / 100},{lowest_um + s * (highest_um - lowest_um)}\n" for k, s in enumerate(share)]
    reference.write_text("time_s,displacement_um\n" + "".join(rows))
    asked = [
        ["simulate", path, program, "--initial", "demagnetised"],
        ["simulate", path, reference],
        ["compensate", path, reference],
        ["compensate", path, reference, "--limits", f"{lower_V},{0.5 * (lower_V + upper_V)}"],
        ["compensate", path, reference, "--limits", f"{lower_V},{upper_V + 10}"],
        ["compensate", path, reference, "--limit", "slew=1V/s"],
    ]
    here = tmp_path / "y.csv"
    for arguments in asked:
        says_the_same_with_jax(monkeypatch, arguments, here)


def test_jax_and_pandas_are_not_imported(file, tmp_path):
    model, _, path = file
    lower_V, upper_V = limits_V(model)
    (tmp_path / "p.csv").write_text(f"time_s,voltage_V\n0,{lower_V}\n0.1,{upper_V}\n0.2,{(lower_V + upper_V) / 2}\n")
    (tmp_path / "r.csv").write_text(f"time_s,displacement_um\n0,{ends_um(model)[0]}\n1,{np.mean(ends_um(model))}\n")
    for command, csv in (("simulate", "p.csv"), ("compensate", "r.csv")):
        arguments = command, path, tmp_path / csv, "--out", tmp_path / "y.csv"
        done = without_jax(*arguments, and_without=("pandas", "scipy"))
        assert (done.returncode, done.stderr) == (0, "")
    assert without_jax("export", path, "--out", tmp_path / "c").returncode == 0


@pytest.mark.parametrize("command", ["simulate", "compensate"])
def test_a_model_that_is_not_there_is_refused_before_jax_is_imported(command, tmp_path):
    (tmp_path / "x.csv").write_text("time_s,voltage_V,displacement_um\n0,1,2\n1,2,3\n")
    more = ["--dynamic"] if command == "compensate" else []
    done = without_jax(command, tmp_path / "none.json", tmp_path / "x.csv", "--out", tmp_path / "y.csv", *more)
    assert done.returncode == 2
    assert "none.json" in done.stderr


def test_the_command_of_python_does_without_jax_as_well(file):
    """`python -m microid` imports the package before the command."""
    asked = sys.executable, "-X", "importtime", "-m", "microid", "info", file[2]
    done = subprocess.run(list(map(str, asked)), capture_output=True, text=True, check=False)
    assert "fits.loop._report_words" in done.stderr
    assert not re.search(r"\| +jax(lib)?\b", done.stderr)
    named = (
        "import microid, sys; assert 'jax' not in sys.modules; microid.Stage; microid.effects.EFFECTS; dir(microid)"
    )
    subprocess.run([sys.executable, "-c", named], check=True)
