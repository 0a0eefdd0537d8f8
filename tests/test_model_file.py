import base64
import hashlib
import json
import re
import shutil
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fits
import microid
from fits import DataError, Uncertainty, load_model, save_model
from fits.loop._design import Grid
from fits.loop._run import prepare_run, simulate_run

REPORT = {"status": "converged", "noise_um": 0.1 + 0.2, "remarks": ["a: b"], "held_out": None}


def draw(family, rng, levels=7):
    lower, upper = jnp.asarray(rng.uniform(-5, 0)), jnp.asarray(rng.uniform(10, 100))
    key = jax.random.key(int(rng.integers(2**31)))
    density = microid.densities.FAMILIES[family].start(lower, upper, levels, jnp.asarray(rng.uniform(5, 50)), key)
    slope = jnp.asarray(rng.uniform(0, 1, levels) / 3)
    model = microid.Preisach(density, microid.Reversible(slope, lower, upper), jnp.asarray(rng.normal()))
    grid = Grid(lower, upper, levels)
    columns = jnp.asarray(rng.normal(size=(4, grid.columns)) * 10.0 ** rng.integers(-300, 29, (4, grid.columns)))
    return model, Uncertainty(columns, jnp.asarray(rng.normal(size=4)), jnp.asarray(rng.uniform()), grid)


def bits(tree):
    return [
        (np.asarray(leaf).dtype, np.asarray(leaf).tobytes()) for leaf in jax.tree.leaves(tree) if eqx.is_array(leaf)
    ]


def hashed(content):
    rest = {key: value for key, value in content.items() if key != "sha256"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"))
    return content | {"sha256": hashlib.sha256(text.encode("ascii")).hexdigest()}


@pytest.fixture
def written(tmp_path, rng):
    path = tmp_path / "model.json"
    save_model(path, *draw("grid", rng), REPORT)
    return path


def refusal(path):
    with pytest.raises(DataError) as caught:
        load_model(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


@pytest.mark.parametrize("family", sorted(microid.densities.FAMILIES))
def test_every_family_comes_back_bit_by_bit(tmp_path, rng, family):
    model, uncertainty = draw(family, rng)
    save_model(tmp_path / "a.json", model, uncertainty, REPORT)
    back = load_model(tmp_path / "a.json")
    assert jax.tree.structure(back.model) == jax.tree.structure(model)
    assert bits(back.model) == bits(model)
    assert bits(back.uncertainty) == bits(uncertainty)
    assert back.uncertainty.grid.levels == uncertainty.grid.levels
    assert back.report == REPORT
    assert back.written_by.startswith("microid")

    lower, upper = float(model.density.lower_V), float(model.density.upper_V)
    voltage = rng.uniform(lower, upper, 100)
    run = prepare_run(fits.Record(np.arange(100.0), voltage, None), (lower, upper), "negative", holdout=1.0)
    assert simulate_run(back.model, run).tobytes() == simulate_run(model, run).tobytes()

    save_model(tmp_path / "b.json", back.model, back.uncertainty, back.report)
    assert (tmp_path / "b.json").read_bytes() == (tmp_path / "a.json").read_bytes()


def test_the_documented_lines_read_the_file_without_microid(tmp_path, rng, monkeypatch):
    model, uncertainty = draw("grid", rng)
    save_model(tmp_path / "named.json", model, uncertainty, REPORT)
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parents[1] / "docs" / "files.md").read_text(encoding="utf-8")
    (lines,) = re.findall(r"are read by\n\n```python\n(.*?)```", page, re.DOTALL)
    assert len(lines.splitlines()) < 11
    found = {}
    exec(lines, found)
    assert np.array_equal(found["weights_um"][np.tril_indices(7)], np.asarray(model.density.packed_um))
    np.testing.assert_allclose(found["weights_um"], np.asarray(model.weights_um), rtol=1e-14)
    assert found["columns_um"].tobytes() == np.asarray(uncertainty.columns_um).tobytes()


def test_the_file_says_what_it_holds(written):
    text = written.read_text(encoding="utf-8")
    content = json.loads(text, parse_constant=lambda name: pytest.fail(name))
    assert list(content) == ["schema", "sha256", "written_by", "model", "uncertainty", "fit"]
    assert content["schema"] == "microid.model/1"
    assert content == hashed(content)
    assert content["model"]["type"] == "Preisach"
    assert content["model"]["density"]["packed_um"]["unit"] == "um"
    assert content["model"]["density"]["lower_V"]["unit"] == "V"
    assert content["model"]["reversible"]["slope_um_per_V"]["unit"] == "um/V"
    assert content["uncertainty"]["discrepancy_um"]["unit"] == "um"
    assert content["fit"] == REPORT
    assert max(map(len, text.split("\n"))) < 5000  # one array a line


class Toy(eqx.Module):
    stiffness_N_per_um: jax.Array = microid.param(unit="N/um", lower=0.0)
    rate_per_s: jax.Array = microid.array()
    parts: tuple[microid.Reversible, ...]
    count: jax.Array
    label: str = microid.static()
    order: int = microid.static()
    gain: float = microid.static()
    signed: bool = microid.static()


def toy(**changes):
    part = microid.Reversible(jnp.asarray([0.1, 0.2]), jnp.asarray(0.0), jnp.asarray(1.0))
    fields = {
        "stiffness_N_per_um": jnp.asarray([[1.0, 2.0], [3.0, 1 / 3]]),
        "rate_per_s": jnp.asarray(5.0, dtype=jnp.float32),
        "parts": (part, part),
        "count": jnp.asarray([1, 2], dtype=jnp.int32),
        "label": "µ",
        "order": 2,
        "gain": 0.1,
        "signed": True,
    }
    return Toy(**fields | changes)


def test_a_new_public_module_needs_no_new_code(tmp_path, rng, monkeypatch):
    _, uncertainty = draw("grid", rng)
    with pytest.raises(DataError, match="no public class Toy"):
        save_model(tmp_path / "a.json", toy(), uncertainty, {})
    monkeypatch.setattr(microid, "Toy", Toy, raising=False)
    save_model(tmp_path / "a.json", toy(), uncertainty, {})
    back = load_model(tmp_path / "a.json").model
    assert eqx.tree_equal(back, toy(), typematch=True)
    assert bits(back) == bits(toy())
    assert json.loads((tmp_path / "a.json").read_text())["model"]["stiffness_N_per_um"]["unit"] == "N/um"
    monkeypatch.undo()
    assert "Toy" in refusal(tmp_path / "a.json")


@pytest.mark.parametrize(
    "wrong",
    [
        {"gain": float("nan")},
        {"rate_per_s": jnp.asarray(jnp.inf)},
        {"rate_per_s": jnp.asarray(1j)},
        {"label": ["a list"]},
        {"label": print},
    ],
)
def test_what_the_format_cannot_hold_is_not_written(tmp_path, rng, monkeypatch, wrong):
    monkeypatch.setattr(microid, "Toy", Toy, raising=False)
    _, uncertainty = draw("grid", rng)
    with pytest.raises(DataError, match="cannot be written"):
        save_model(tmp_path / "a.json", toy(**wrong), uncertainty, {})
    assert list(tmp_path.iterdir()) == []


def test_other_networks_and_reports_are_not_written(tmp_path, rng):
    model, uncertainty = draw("network", rng)
    other = eqx.nn.MLP(2, "scalar", 3, 1, activation=jax.nn.relu, key=jax.random.key(0))
    with pytest.raises(DataError, match="activation"):
        save_model(tmp_path / "a.json", eqx.tree_at(lambda m: m.density.network, model, other), uncertainty, {})
    other = eqx.nn.MLP(2, "scalar", 3, 1, activation=jnp.tanh, final_activation=jnp.exp, key=jax.random.key(0))
    with pytest.raises(DataError, match="not give back"):
        save_model(tmp_path / "a.json", eqx.tree_at(lambda m: m.density.network, model, other), uncertainty, {})
    for report in ({"a": float("inf")}, {"a": (1, 2)}, {"a": np.zeros(2)}):
        with pytest.raises(DataError, match="report"):
            save_model(tmp_path / "a.json", model, uncertainty, report)
    assert list(tmp_path.iterdir()) == []


def test_one_changed_digit_is_noticed(written, rng):
    text = written.read_text(encoding="utf-8")
    digits = [match.start() for match in re.finditer(r"\d", text)]
    for place in rng.choice(digits, 20, replace=False):
        changed = text[:place] + str((int(text[place]) + 5) % 10) + text[place + 1 :]
        try:
            same = json.loads(changed) == json.loads(text)
        except json.JSONDecodeError:
            same = False
        if same:  # beyond the 16th digit
            continue
        written.write_text(changed, encoding="utf-8")
        refusal(written)


def test_a_cut_file_is_refused(written, rng):
    data = written.read_bytes()
    for length in [0, 1, *rng.integers(2, len(data) - 2, 5)]:
        written.write_bytes(data[:length])
        assert "broken or cut" in refusal(written)


def test_other_files_are_refused(written, tmp_path):
    content = json.loads(written.read_text())
    newer = tmp_path / "newer.json"
    newer.write_text(json.dumps(hashed(content | {"schema": "microid.model/2"})))
    assert "microid.model/2" in refusal(newer)
    for name, text in {
        "csv.json": "time_s,voltage_V\n0,1\n",
        "list.json": "[1, 2]",
        "truth.json": '{"schema": "data_synth.truth/1"}',
        "number.json": '{"schema": 1}',
        "nan.json": '{"schema": NaN}',
        "twice.json": '{"schema": "a", "schema": "b"}',
        "deep.json": "[" * 100_000,
    }.items():
        (tmp_path / name).write_text(text)
        refusal(tmp_path / name)
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00{")
    assert "UTF-8" in refusal(tmp_path / "binary.json")
    (tmp_path / "folder.json").mkdir()
    assert "folder" in refusal(tmp_path / "folder.json")
    assert "no such file" in refusal(tmp_path / "none.json")


def replaced(content, path, value):
    """Copy `content` with the value at a dotted path replaced, or removed where it is None."""
    copy = json.loads(json.dumps(content))
    *way, last = path.split(".")
    at = copy
    for key in way:
        at = at[int(key)] if isinstance(at, list) else at[key]
    if value is None:
        del at[last]
    else:
        at[last] = value
    return hashed(copy)


ONE = {"unit": "um", "value": 1.0}


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("model", "Preisach"),
        ("model", {"type": "Grid", "lower_V": ONE, "upper_V": ONE}),
        ("model.type", "Path"),
        ("model.type", "AbstractDensity"),
        ("model.type", "Coordinates"),
        ("model.type", "everett"),
        ("model.type", ["Preisach"]),
        ("model.type", "GridDensity"),
        ("model.type", None),
        ("model.offset_um", None),
        ("model.extra", 1),
        ("model.density", ONE),
        ("model.density.packed_um.value", [1.0, 2.0]),
        ("model.density.packed_um.value", [[1.0], [2.0, 3.0]]),
        ("model.density.packed_um.value", [-1.0] * 28),
        ("model.density.packed_um.value", ["1.0"] * 28),
        ("model.density.packed_um.value", "1.0"),
        ("model.density.packed_um.value", [10**400] * 28),
        ("model.density.packed_um.unit", "nm"),
        ("model.density.packed_um.unit", None),
        ("model.density.packed_um.dtype", "object"),
        ("model.density.packed_um.dtype", "int32"),
        ("model.density.lower_V.value", [0.0]),
        ("model.density.upper_V.value", -1e3),
        ("uncertainty.grid.upper_V.value", -1e3),
        ("model.reversible.slope_um_per_V.value", [0.1] * 6),
        ("uncertainty.columns_um.float64_base64", "AAAA"),
        ("uncertainty.columns_um.float64_base64", "*"),
        ("uncertainty.columns_um.float64_base64", 3),
        ("uncertainty.columns_um.float64_base64", base64.b64encode(np.full((4, 35), np.nan).tobytes()).decode()),
        ("uncertainty.columns_um.shape", [35, 4]),
        ("uncertainty.columns_um.shape", [-1]),
        ("uncertainty.columns_um.shape", None),
        ("uncertainty.grid.levels", 8),
        ("uncertainty.grid.levels", 7.0),
        ("uncertainty.type", "Preisach"),
        ("uncertainty", {"type": "Uncertainty"}),
        ("fit", "good"),
        ("written_by", None),
        ("extra", 1),
    ],
)
def test_nonsense_with_a_right_hash_is_refused(written, path, value):
    content = json.loads(written.read_text())
    written.write_text(json.dumps(replaced(content, path, value)))
    refusal(written)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("activation", "eval"),
        ("activation", ["tanh"]),
        ("in_size", 3),
        ("in_size", "two"),
        ("out_size", None),
        ("layers", []),
        ("layers", [1, 2]),
        ("layers.1.bias", {"unit": "1", "value": [1.0]}),
        ("layers.0.weight", {"unit": "1", "value": 1.0}),
        ("layers.0.weight", {"unit": "V", "value": [[1.0]]}),
        ("layers.0.weight", 1.0),
        ("layers.0.bias", None),
    ],
)
def test_nonsense_in_a_network_is_refused(tmp_path, rng, path, value):
    written = tmp_path / "a.json"
    save_model(written, *draw("network", rng), {})
    content = json.loads(written.read_text())
    written.write_text(json.dumps(replaced(content, f"model.density.network.{path}", value)))
    refusal(written)


def test_saving_leaves_the_old_file_when_it_fails(written, rng, monkeypatch):
    before = written.read_bytes()
    model, uncertainty = draw("grid", rng)
    broken = eqx.tree_at(lambda m: m.offset_um, model, jnp.asarray(jnp.nan))
    with pytest.raises(DataError, match="not finite"):
        save_model(written, broken, uncertainty, {})
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        save_model(written, model, uncertainty, {})
    assert written.read_bytes() == before
    assert [path.name for path in written.parent.iterdir()] == ["model.json"]


def test_single_precision_is_refused(written, tmp_path):
    shutil.copy(written, tmp_path / "copy.json")
    with jax.enable_x64(False), pytest.raises(RuntimeError, match="float64"):
        load_model(tmp_path / "copy.json")
