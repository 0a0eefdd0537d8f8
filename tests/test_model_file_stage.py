"""Whole stages and their uncertainty in model files."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from _command import refused, run
from _models import random_model
from test_model_file import REPORT, bits, hashed, refusal

import microid
from fits import DataError, Record, StageUncertainty, Uncertainty, load_model, predict, save_model
from fits.loop._design import Grid
from microid.effects.bouc_wen_hysteresis import BoucWenHysteresis

PARAMETERS, LEVELS, PERTURBATIONS = 3, 5, 6


def draw(rng, grid=True):
    """A stage whose gains are frozen, and perturbations of all sizes."""
    piezo = random_model(rng) if grid else microid.Piezo(rng.uniform(0.1, 1), rng.normal())
    stage = microid.Stage.of(
        driver=microid.Driver(rng.uniform(1e-4, 1e-2)),
        piezo=piezo,
        mechanics=microid.Mechanics(rng.uniform(50, 500), rng.uniform(0.01, 0.5)),
        substeps=int(rng.integers(1, 9)),
    )
    stage = stage.freeze("driver.gain", "mechanics.gain")
    mesh = Grid(jnp.asarray(0.0), jnp.asarray(rng.uniform(10, 100)), LEVELS) if grid else None

    def numbers(*shape):
        return jnp.asarray(rng.normal(size=shape) * 10.0 ** rng.integers(-300, 29, shape))

    return stage, StageUncertainty(
        numbers(PERTURBATIONS, PARAMETERS if grid else PARAMETERS + 1),
        numbers(PERTURBATIONS, mesh.columns if mesh else 0),
        numbers(PERTURBATIONS),
        jnp.asarray(rng.uniform()),
        mesh,
    )


@pytest.mark.parametrize("grid", [True, False])
def test_a_stage_comes_back_bit_by_bit(tmp_path, rng, grid):
    stage, uncertainty = draw(rng, grid)
    save_model(tmp_path / "a.json", stage, uncertainty, REPORT)
    back = load_model(tmp_path / "a.json")
    assert bits(back.model) == bits(stage)
    assert bits(back.uncertainty) == bits(uncertainty)
    assert isinstance(back.uncertainty, StageUncertainty)
    for name in ("names", "hold", "substeps", "frozen"):
        assert getattr(back.model, name) == getattr(stage, name)
    assert (back.uncertainty.grid is None) == (not grid)
    assert [type(part) for part in back.model.parts] == [type(part) for part in stage.parts]
    save_model(tmp_path / "b.json", back.model, back.uncertainty, back.report)
    assert (tmp_path / "b.json").read_bytes() == (tmp_path / "a.json").read_bytes()


def test_an_uncertainty_of_another_kind_of_model_is_refused(rng):
    stage, uncertainty = draw(rng)
    program = Record(np.arange(3.0), np.zeros(3), None)
    with pytest.raises(DataError, match="the uncertainty is that of a stage"):
        predict(stage["piezo"], program, uncertainty=uncertainty)
    other = Uncertainty(uncertainty.columns_um, uncertainty.mean_um, uncertainty.discrepancy_um, uncertainty.grid)
    with pytest.raises(DataError, match="the uncertainty is that of a hysteresis"):
        predict(stage, program, uncertainty=other)


@pytest.fixture
def written(tmp_path, rng):
    stage, uncertainty = draw(rng)
    path = tmp_path / "stage.json"
    save_model(path, stage, uncertainty, REPORT)
    return path, stage, uncertainty


def test_matrices_are_packed(written):
    path, _, uncertainty = written
    content = json.loads(path.read_text(encoding="utf-8"))
    for name in ("coordinates", "columns_um", "mean_um"):
        assert set(content["uncertainty"][name]) == {"unit", "shape", "float64_base64"}
        assert content["uncertainty"][name]["shape"] == list(getattr(uncertainty, name).shape)
    assert content["uncertainty"]["mean_um"]["unit"] == "um"
    assert content["model"]["parts"][0]["time_constant_s"]["unit"] == "s"


def test_tampering_is_refused(written, rng):
    path, _, _ = written
    content = json.loads(path.read_text(encoding="utf-8"))
    frequency = content["model"]["parts"][2]["natural_frequency_Hz"]
    frequency["value"] *= 1 + rng.uniform(1e-9, 1e-3)
    path.write_text(json.dumps(content), encoding="utf-8")
    assert "sha256" in refusal(path)


def wrong(rng, stage, uncertainty):
    """Uncertainties that are not of this stage, each with a word from its refusal."""
    u = uncertainty
    more = jnp.asarray(rng.normal(size=(PERTURBATIONS, PARAMETERS + 1)))
    short = u.columns_um[:, 1:]
    finer = Grid(u.grid.lower_V, u.grid.upper_V, LEVELS + 1)
    return {
        "another parameter": StageUncertainty(more, u.columns_um, u.mean_um, u.discrepancy_um, u.grid),
        "a column less": StageUncertainty(u.coordinates, short, u.mean_um, u.discrepancy_um, u.grid),
        "another grid": StageUncertainty(u.coordinates, u.columns_um, u.mean_um, u.discrepancy_um, finer),
        "no grid": StageUncertainty(u.coordinates, u.columns_um, u.mean_um, u.discrepancy_um, None),
    }


@pytest.mark.parametrize("case", ["another parameter", "a column less", "another grid", "no grid"])
def test_an_uncertainty_of_another_shape_is_refused(tmp_path, rng, case):
    stage, uncertainty = draw(rng)
    path = tmp_path / "stage.json"
    save_model(path, stage, wrong(rng, stage, uncertainty)[case], REPORT)
    assert "does not fit" in refusal(path)


def test_perturbations_of_different_number_are_refused(written):
    path, _, _ = written
    content = json.loads(path.read_text(encoding="utf-8"))
    content["uncertainty"]["mean_um"] |= {"shape": [2], "float64_base64": "AAAAAAAA8D8AAAAAAAAAQA=="}
    path.write_text(json.dumps(hashed(content)), encoding="utf-8")
    refusal(path)


def test_something_else_for_a_grid_is_refused(written):
    path, _, _ = written
    content = json.loads(path.read_text(encoding="utf-8"))
    content["uncertainty"]["grid"] = "fine"
    path.write_text(json.dumps(hashed(content)), encoding="utf-8")
    assert 'uncertainty.grid: expected an object with a type or null, found "fine"' in refusal(path)


def test_a_stage_uncertainty_needs_a_stage(tmp_path, rng):
    _, uncertainty = draw(rng)
    save_model(tmp_path / "m.json", random_model(rng), uncertainty, REPORT)
    assert "does not fit the stage" in refusal(tmp_path / "m.json")


def test_a_stage_with_the_uncertainty_of_its_hysteresis_is_still_read(tmp_path, rng):
    stage, uncertainty = draw(rng)
    grid = uncertainty.grid
    plain = Uncertainty(uncertainty.columns_um, uncertainty.mean_um, uncertainty.discrepancy_um, grid)
    save_model(tmp_path / "m.json", stage, plain, REPORT)
    assert bits(load_model(tmp_path / "m.json").uncertainty) == bits(plain)


def test_what_is_not_finite_is_not_written(tmp_path, rng):
    stage, u = draw(rng)
    endless = StageUncertainty(u.coordinates.at[0, 0].set(jnp.nan), u.columns_um, u.mean_um, u.discrepancy_um, u.grid)
    with pytest.raises(DataError, match="finite"):
        save_model(tmp_path / "m.json", stage, endless, REPORT)
    assert not (tmp_path / "m.json").exists()


BROKEN = {
    ("parts",): (None, "expected a list, each of it an object with a type, found nothing"),
    ("parts", 0): (None, "expected an object with a type, found nothing"),
    ("frozen", 0): (1, "expected a text, found 1"),
    ("names",): ("x", 'expected a list, each of it a text, found "x"'),
    ("frozen",): (None, "expected a list, each of it a text, found nothing"),
    ("hold",): (1, "expected one of first, zero, smooth, found 1"),
    ("substeps",): (True, "expected a whole number, found true"),
}


@pytest.mark.parametrize("place", BROKEN, ids=str)
def test_what_is_of_another_kind_is_refused_in_words_of_the_file(written, place):
    path, _, _ = written
    content = json.loads(path.read_text())
    inner = content["model"]
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]], words = BROKEN[place]
    path.write_text(json.dumps(hashed(content)))
    where = place[0] if len(place) == 1 else f"{place[0]}[{place[1]}]"
    assert f"model.{where}: {words}; write the file again" in refusal(path)


def test_a_stage_that_turns_the_sign_ahead_of_its_hysteresis_is_refused_with_its_file(written):
    path, _, _ = written
    content = json.loads(path.read_text())
    content["model"]["parts"][0]["gain"]["value"] = -1.0
    path.write_text(json.dumps(hashed(content)))
    program = path.with_name("program.csv")
    program.write_text("time_s,voltage_V\n0,0\n1,1\n2,2\n")
    reference = path.with_name("reference.csv")
    reference.write_text("time_s,displacement_um\n0,0\n1,1\n2,2\n")
    out = path.with_name("out.csv")
    refused(run("simulate", path, program, "--out", out), f"{path}: the static gain ahead of", "is -1")
    refused(run("compensate", path, reference, "--out", out), f"{path}: part ", "a positive static gain, found -1")
    assert not out.exists()


def test_an_effect_of_an_older_file_has_what_came_later_at_rest(tmp_path, rng):
    path = tmp_path / "model.json"
    law = BoucWenHysteresis(random_model(rng, 6), 2.0, 0.25, 0.8, 1.4, 100.0, gain_first=0.3)
    save_model(path, microid.Stage.of(hysteresis=law), None, {})
    content = json.loads(path.read_text())
    (part,) = content["model"]["parts"]
    came_later = "gain_first", "gain_second", "gain_third", "gain_fourth", "loss_first", "loss_second"
    for name in (*came_later, "lower_V", "approach"):
        del part[name]
    path.write_text(json.dumps(hashed(content)))
    effect = load_model(path).model.parts[0]
    assert float(effect.gain_first) == 0.0
    assert float(effect.approach) == 1.0
    assert float(effect.sigma) == 0.8
    del part["sigma"]
    path.write_text(json.dumps(hashed(content)))
    assert "has the fields" in refusal(path)
