"""Programs that the command keeps: they answer as those that are traced anew, and never for something else."""

import os
import shutil
import time
from collections import OrderedDict
from dataclasses import replace
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_stage_without_jax import draw, program

import microid as m
from fits import predict
from fits.io import _kept
from fits.io._kept import keep_in, kept
from fits.stage._run import project_out


@pytest.fixture
def folder(tmp_path):
    """Where programs are kept during a test."""
    keep_in(tmp_path / "kept")
    yield tmp_path / "kept"
    keep_in(None)


@pytest.fixture
def again(folder, tmp_path, monkeypatch):
    """Call a function as another process would: from the files alone, and without tracing."""

    def call(function, *args, **options):
        shutil.copytree(folder, tmp_path / "copy")
        keep_in(tmp_path / "copy")
        with monkeypatch.context() as patched:
            patched.setattr(_kept, "_traced", lambda *args: pytest.fail("traced again"))
            return function(*args, **options)

    return call


def parted(rng, rows=40):
    """Columns, weights and values, and what least squares leave of the values."""
    columns, weight, values = rng.normal(size=(rows, 3)), rng.uniform(0.5, 2, rows), rng.normal(size=rows)
    root = np.sqrt(weight)
    answer = np.linalg.lstsq(root[:, None] * columns, root * values, rcond=None)[0]
    return tuple(map(jnp.asarray, (columns, weight, values))), values - columns @ answer


def test_a_kept_program_answers_for_other_numbers(folder, again, rng):
    given, expected = parted(rng)
    np.testing.assert_allclose(project_out(*given), expected, atol=1e-9)
    assert len(list(folder.iterdir())) == 1
    given, expected = parted(rng)
    found = again(project_out, *given)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    # Bound to no device, so that what takes it is compiled once.
    assert not found.committed


def test_stages_with_effects_answer_as_without(folder, again, rng):
    stage, uncertainty = draw(rng, substeps=2)
    effects = {effect.name: effect for effect in reversed(m.effects.EFFECTS)}
    for effect in (effects["creep"](0.01, 0.1), effects["thermal_gain"](0.002, 21.0, 0.3)):
        stage = m.effects.extend(stage, effect)
    more = jnp.asarray(rng.normal(scale=1e-2, size=(40, 7)))
    uncertainty = replace(uncertainty, coordinates=jnp.concatenate([uncertainty.coordinates, more], axis=1))
    record = replace(program(rng, stage, True), extra={"temperature_degC": rng.normal(21, 1, 300)})
    keep_in(None)
    expected = predict(stage, record, uncertainty=uncertainty)
    keep_in(folder)
    found = predict(stage, record, uncertainty=uncertainty), again(predict, stage, record, uncertainty=uncertainty)
    for one in found:
        exact = {"rtol": 0, "atol": 1e-12 * np.ptp(expected.displacement_um)}
        np.testing.assert_allclose(one.displacement_um, expected.displacement_um, **exact)
        np.testing.assert_allclose(one.displacement_sd_um, expected.displacement_sd_um, rtol=1e-10)


def test_what_differs_is_another_program(folder, rng):
    """Shapes, types, and all that is no array: here the number of substeps."""
    given, _ = parted(rng)
    stage = m.Stage.of(hysteresis=m.Piezo(0.1), mechanics=m.Mechanics(60.0, 0.1, 2.0))
    voltage_V, simulate, inner = jnp.asarray(rng.uniform(0, 10, 30)), kept(m.Stage.__call__), kept(m.innermost)
    made = [
        lambda: project_out(*given),
        lambda: project_out(*parted(rng, 50)[0]),
        lambda: inner(m.Sensor(jnp.asarray(1.0))),
        lambda: inner(m.Sensor(jnp.asarray(1.0, dtype=jnp.float32))),
        lambda: simulate(stage, 1e-3, voltage_V),
        lambda: simulate(stage, 2e-3, voltage_V),
        lambda: simulate(stage, jnp.asarray(1e-3), voltage_V),
        lambda: simulate(stage.with_substeps(2), 1e-3, voltage_V),
        lambda: simulate(stage.with_hold("zero"), 1e-3, voltage_V),
    ]
    for count, make in enumerate(made, 1):
        make()
        assert len(list(folder.iterdir())) == count


def test_a_process_holds_those_that_it_used_last(monkeypatch):
    monkeypatch.setattr(_kept, "_held", OrderedDict())
    monkeypatch.setattr(_kept, "_MOST", 2)
    traced = []

    @kept
    def double(x):
        traced.append(x.shape)
        return 2 * x

    for n in (1, 2, 1, 3, 1, 2):
        np.testing.assert_array_equal(double(jnp.ones(n)), np.full(n, 2.0))
    # The second of two elements was forgotten when three came.
    assert traced == [(1,), (2,), (3,), (2,)]
    assert len(_kept._held) == 2


def test_another_line_version_or_setting_is_another_program(monkeypatch, tmp_path):
    def digest():
        return _kept._circumstances.__wrapped__()

    copies = {name: tmp_path / name for name in _kept._OWN}
    for name, copy in copies.items():
        (copy / "below").mkdir(parents=True)
        (copy / "__init__.py").write_text("")
        (copy / "below" / "part.py").write_text(f"x = '{name}'\n")
    specs = {name: SimpleNamespace(origin=str(copy / "__init__.py")) for name, copy in copies.items()}
    monkeypatch.setattr(_kept, "find_spec", specs.__getitem__)
    seen = {digest()}
    assert digest() in seen
    for copy in copies.values():
        with (copy / "below" / "part.py").open("a") as file:
            file.write("y = 1\n")
        assert digest() not in seen
        seen.add(digest())
    monkeypatch.setenv("JAX_NUMPY_RANK_PROMOTION", "allow")
    assert digest() not in seen
    seen.add(digest())
    monkeypatch.setattr(_kept, "version", lambda name: "0")
    assert digest() not in seen


def twice(x):
    return 2 * x


class Own(eqx.Module):
    """A part that this file alone knows, and may change."""

    gain: jax.Array

    def __call__(self, x):
        return self.gain * x


def test_what_may_change_without_notice_is_not_kept(folder):
    """A class or function of somebody else is told by its name alone, which stays as it is."""
    three = jnp.asarray(3.0)
    assert kept(Own.__call__)(Own(jnp.asarray(2.0)), three) == 6.0
    assert kept(twice)(three) == 6.0
    assert kept(m.innermost)(Own(three)).gain == 3.0
    assert not folder.exists()
    assert kept(m.innermost)(m.Sensor(three)).gain == 3.0
    assert len(list(folder.iterdir())) == 1


def test_a_damaged_file_is_made_anew(folder, tmp_path, rng):
    given, expected = parted(rng)
    project_out(*given)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    for damaged in (b"", whole[:100], whole[:-1] + bytes([whole[-1] ^ 1])):
        place = tmp_path / str(len(damaged))
        place.mkdir()
        (place / file.name).write_bytes(damaged)
        keep_in(place)
        np.testing.assert_allclose(project_out(*given), expected, atol=1e-9)
        assert _kept._read(place / file.name) is not None


def test_what_was_not_used_for_a_month_is_removed(folder, rng):
    """In the folder and in that of JAX around it; what is younger, or belongs to neither, stays."""
    folder.mkdir()
    places = [folder / "old", folder / "young", folder.parent / "x-cache", folder.parent / "own.csv"]
    for place, days in zip(places, (31, 29, 31, 31), strict=True):
        place.write_text("")
        os.utime(place, (time.time() - 86400 * days,) * 2)
    project_out(*parted(rng)[0])
    assert [place.exists() for place in places] == [False, True, False, True]
    assert len(list(folder.iterdir())) == 2


def test_inside_another_program_it_is_a_part_of_that(folder, rng):
    (columns, weight, values), expected = parted(rng)
    slope = jax.jit(jax.grad(lambda values: jnp.sum(project_out(columns, weight, values) ** 2)))(values)
    np.testing.assert_allclose(slope, 2 * expected @ jax.jacobian(lambda v: project_out(columns, weight, v))(values))
    assert not folder.exists()
