"""The error budget, against sums in plain NumPy; the command's refusals."""

import dataclasses
import json
import math
import typing
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from _command import files, refused, run, whole_picture
from _gain_formulas import TABLE_1, gains, slopes
from _models import densities_of, limits_V, random_model

import fits
import microid as m
from fits.cli._main import cli
from fits.loop._design import Grid
from fits.report._machining import budget_json

NAMES = {
    "x": ["l1", "t1", "la1", "alpha1", "l2", "t2", "l3"],
    "gamma": ["l6", "t6", "la3", "alpha3", "l7", "t7", "J", "R"],
}
UNIT = {"x": 1.0, "gamma": 1e6}
CELLS = 1500


@pytest.fixture
def idle(rng):
    readings = 0.1 + 0.03 * rng.normal(size=400)
    return fits.idle_noise(fits.Reference(np.arange(400) / 1000, readings, "idle.csv"))


@pytest.fixture
def model(rng):
    return random_model(rng)


def loop_um(model):
    """Voltages and displacements of a loop from the lowest voltage, by quadrature over relays and slopes."""
    lower, upper = limits_V(model)
    density, slope = densities_of(model)
    step = (upper - lower) / CELLS
    edges = np.linspace(lower, upper, CELLS + 1)
    middles = edges[:-1] + step / 2
    # Relays that switch up at alpha and down at beta; on the diagonal half a cell is below it.
    weights = np.tril(density(middles[:, None], middles[None, :])) * step**2
    weights[np.diag_indices(CELLS)] /= 2
    reversible = np.concatenate([[0], np.cumsum(slope(middles) * step)])
    up = np.concatenate([[0], np.cumsum(weights.sum(axis=1))])
    # What has switched down again between the top and each voltage.
    down = up[-1] - np.concatenate([np.cumsum(weights.sum(axis=0)[::-1])[::-1], [0]])
    return np.concatenate([edges, edges[-2::-1]]), np.concatenate([up + reversible, (down + reversible)[-2::-1]])


def hysteresis(model):
    """Stroke, and highest and lowest of a loop less the line through its start with the smallest squares."""
    volts, moved = loop_um(model)
    slope = np.linalg.lstsq((volts - volts[0])[:, None], moved, rcond=None)[0][0]
    off = moved - slope * (volts - volts[0])
    return moved[CELLS], slope, off.max(), off.min()


def tolerances(names):
    legs = {"alpha1": "la1", "alpha3": "la3"}
    return np.array([0.02 / TABLE_1.get(legs.get(name), 1.0) for name in names])


def machining(axis, stroke_um, **options):
    """Errors of the dimensions at plus one tolerance; with a piezo, at the voltage of the same stroke."""
    free_um = stroke_um * gains(axis, TABLE_1) / gains(axis, TABLE_1, **options)
    return UNIT[axis] * free_um * slopes(axis, TABLE_1, NAMES[axis], **options) * tolerances(NAMES[axis])


def test_a_budget_by_hand(model, idle):
    found = fits.budget(fits.paper_design(), model, idle, ("x", "y", "gamma"), arm_mm=50.0)
    stroke_um, slope, highest, lowest = hysteresis(model)
    # The quadrature of the relays is this good.
    near = {"rel": 2e-4, "abs": 2e-4 * (highest - lowest)}
    assert found.driving.stroke_um == pytest.approx(stroke_um, **near)
    assert found.driving.slope_um_per_V == pytest.approx(slope, rel=2e-4)
    assert found.driving.highest_um == pytest.approx(highest, **near)
    assert found.driving.lowest_um == pytest.approx(lowest, **near)
    assert found.driving.absolute_um == pytest.approx(max(highest, -lowest), **near)
    assert dataclasses.replace(found["y"], axis="x") == found["x"]

    # From here on to the last digits, but for the rotation's arc.
    piezo = found.driving
    random_um = 2 * idle.sd_um
    for axis, measuring, close in (("x", random_um, 1e-9), ("gamma", 1e6 * random_um / 50e3, 1e-3)):
        each = found[axis]
        gain = UNIT[axis] * gains(axis, TABLE_1)
        assert each.stroke == pytest.approx(gain * piezo.stroke_um, rel=close)
        driving = [gain * piezo.highest_um, gain * piezo.lowest_um]
        assert [each.driving_highest, each.driving_lowest] == pytest.approx(driving, rel=close)
        largest = driving[np.argmax(np.abs(driving))]
        assert each.driving == pytest.approx(largest, rel=close)
        errors = machining(axis, piezo.stroke_um)
        assert each.machining_worst_case == pytest.approx(np.abs(errors).sum(), rel=close)
        assert each.machining_signed == pytest.approx(errors.sum(), rel=close)
        assert each.machining_root_sum_square == pytest.approx(np.linalg.norm(errors), rel=close)
        assert each.measuring == pytest.approx(measuring)
        assert each.signed == pytest.approx(largest + errors.sum() + measuring, rel=10 * close)
        assert each.worst_case == pytest.approx(abs(largest) + np.abs(errors).sum() + measuring, rel=close)
        parts = np.array([largest, np.linalg.norm(errors), measuring])
        assert each.root_sum_square == pytest.approx(np.linalg.norm(parts), rel=close)
        assert [*each.shares.values()] == pytest.approx(parts**2 / (parts @ parts), rel=3 * close)
        by_voltage = machining(axis, piezo.stroke_um, piezo=50.0)
        # l4, h and d change a stiffness too; here only d, as the width of all, and h.
        others = ["d", "h"]
        free_um = piezo.stroke_um * gains(axis, TABLE_1) / gains(axis, TABLE_1, piezo=50.0)
        more = UNIT[axis] * free_um * slopes(axis, TABLE_1, others, piezo=50.0) * 0.02
        by_voltage = np.concatenate([by_voltage, more])
        assert each.machining_voltage_worst_case == pytest.approx(np.abs(by_voltage).sum(), rel=close)
        assert each.machining_voltage_root_sum_square == pytest.approx(np.linalg.norm(by_voltage), rel=close)


def test_dimensions_that_go_together_and_a_sensor_with_its_offset(model, idle):
    plain = fits.paper_design()
    design = dataclasses.replace(plain, together=(fits.Together(("t1", "t2"), 1.0),))
    found = fits.budget(design, model, idle, ("x",), zeroed=False)["x"]
    errors = machining("x", float(found.stroke / gains("x", TABLE_1)))
    both = errors[NAMES["x"].index("t1")] * errors[NAMES["x"].index("t2")]
    assert found.machining_root_sum_square == pytest.approx(math.sqrt(errors @ errors + 2 * both))
    assert found.measuring == pytest.approx(abs(idle.mean_um) + 2 * idle.sd_um)


def test_what_the_model_measures_is_turned_into_the_piezos_elongation(model, idle):
    design = fits.paper_design()
    piezo = fits.budget(design, model, idle, ("x",))
    stage = fits.budget(design, model, idle, ("x",), measures="x")
    assert stage["x"].stroke == pytest.approx(piezo.driving.stroke_um)
    assert stage["x"].driving_highest == pytest.approx(piezo.driving.highest_um)
    assert stage.driving.slope_um_per_V == pytest.approx(piezo.driving.slope_um_per_V / gains("x", TABLE_1))
    turned = fits.budget(design, model, idle, ("gamma",), measures="gamma", arm_mm=30.0)
    assert turned["gamma"].stroke == pytest.approx(1e3 * piezo.driving.stroke_um / 30.0, rel=1e-3)
    # A stage counts with its static gains.
    parts = m.Stage.of(piezo=model, mechanics=m.Mechanics(jnp.asarray(180.0), jnp.asarray(0.02), jnp.asarray(2.0)))
    whole = fits.budget(design, parts, idle, ("x",))
    assert whole.driving.highest_um == pytest.approx(2 * piezo.driving.highest_um)
    longer = eqx.tree_at(lambda law: law.reversible.slope_um_per_V, model, 1 + model.reversible.slope_um_per_V)
    assert (
        "against the stage the piezos of this design reach 20.87 um"
        in fits.budget(design, longer, idle, ("x",)).remarks[0]
    )


def test_impossible_budgets_are_refused(model, idle):
    design = fits.paper_design()
    with pytest.raises(fits.DataError, match="arm"):
        fits.budget(design, model, idle, measures="alpha")
    with pytest.raises(fits.DataError, match="above 0 mm"):
        fits.budget(design, model, idle, arm_mm=-1.0)
    still = eqx.tree_at(
        lambda law: (law.density.packed_um, law.reversible.slope_um_per_V),
        model,
        (0 * model.density.packed_um, 0 * model.reversible.slope_um_per_V),
    )
    with pytest.raises(fits.DataError, match="moves"):
        fits.budget(design, still, idle)


@pytest.fixture
def folder(tmp_path, rng, model):
    """A model file, an idle record and a stage."""
    levels = model.reversible.slope_um_per_V.shape[0]
    grid = Grid(model.density.lower_V, model.density.upper_V, levels)
    unsure = fits.Uncertainty(jnp.zeros((1, grid.columns)), jnp.zeros(1), jnp.asarray(0.01), grid)
    fits.save_model(tmp_path / "model.json", model, unsure, {})
    rows = [f"{k / 1000!r},{value!r}" for k, value in enumerate((0.1 + 0.03 * rng.normal(size=200)).tolist())]
    (tmp_path / "idle.csv").write_text("\n".join(["time_s,displacement_um", *rows, ""]))
    fits.write_design(fits.paper_design(), tmp_path / "stage.toml")
    return tmp_path


def command(folder, *options, stage="paper"):
    return run("budget", stage, folder / "model.json", folder / "idle.csv", *options)


def test_the_command_writes_what_the_library_finds(folder, model):
    noise = fits.idle_noise(fits.read_idle(folder / "idle.csv"))
    wanted = budget_json(fits.budget(fits.paper_design(), model, noise, ("x",), zeroed=False))
    options = ("--axis", "x", "--not-zeroed")
    result = command(folder, *options, "--plots", folder / "p", stage=folder / "stage.toml")
    assert result.exit_code == 0, result.stderr
    content = json.loads(command(folder, *options, "--json").stdout)
    assert content == json.loads(json.dumps(wanted))
    assert content["schema"] == "microid.budget/1"
    x = content["axes"]["x"]
    assert x["worst_case_pct"] == pytest.approx(100 * x["worst_case_um"] / x["stroke_um"])
    assert sum(x["share_of_squares"].values()) == pytest.approx(1)
    for words in (
        f"{x['worst_case_pct']:.2f}",
        "and its offset",
        "worst case",
        f"plot   {folder / 'p' / 'budget.png'}",
    ):
        assert words in result.stdout
    assert "Note: The measuring" not in result.stdout
    whole_picture(folder / "p" / "budget.png")
    assert files(folder) == ["idle.csv", "model.json", "p", "p/budget.png", "stage.toml"]


def test_a_rotation_needs_an_arm_for_its_sensor(folder):
    without = command(folder, "--axis", "gamma")
    assert without.exit_code == 0, without.stderr
    assert "unknown" in without.stdout
    assert "Note: The measuring error of gamma is left out" in without.stdout
    with_one = command(folder, "--axis", "gamma", "--arm", "0.05m", "--json")
    content = json.loads(with_one.stdout)
    assert content["sensor"]["arm_mm"] == 50.0
    assert content["axes"]["gamma"]["measuring_urad"] == pytest.approx(content["sensor"]["error_um"] / 0.05)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["none.toml", "model.json", "idle.csv"], ["none.toml"]),
        (["paper", "none.json", "idle.csv"], ["none.json"]),
        (["paper", "model.json", "none.csv"], ["none.csv"]),
        (["paper", "idle.csv", "idle.csv"], ["idle.csv"]),
        (["paper", "linear.json", "idle.csv"], ["linear.json", "hysteresis"]),
        (["paper", "model.json", "short.csv"], ["short.csv", "100 samples"]),
        (["paper", "model.json", "idle.csv", "--arm", "50"], ["--arm", "'50'", "50mm"]),
        (["paper", "model.json", "idle.csv", "--arm", "-50mm"], ["--arm", "above 0"]),
        (["paper", "model.json", "idle.csv", "--arm", "1e999mm"], ["--arm"]),
        (["paper", "model.json", "idle.csv", "--model-measures", "beta"], ["--model-measures beta", "--arm"]),
        (["paper", "model.json", "idle.csv", "--columns", "speed=a"], ["--columns", "speed"]),
        (["paper", "model.json", "idle.csv", "--plots", "idle.csv"], ["idle.csv: expected a folder"]),
    ],
)
def test_bad_input_ends_in_one_sentence(folder, monkeypatch, arguments, words):
    monkeypatch.chdir(folder)
    monkeypatch.setattr("fits.machining._budget.budget", lambda *_, **__: pytest.fail("worked before refusing"))
    Path("short.csv").write_text("\n".join(Path("idle.csv").read_text().splitlines()[:50]))
    linear = m.Stage.of(piezo=m.Piezo(jnp.asarray(0.3)))
    unsure = fits.load_model("model.json").uncertainty
    fits.save_model("linear.json", linear, unsure, {})
    before = {path: Path(path).read_bytes() for path in files(folder)}
    refused(run("budget", *arguments), *words)
    assert {path: Path(path).read_bytes() for path in files(folder)} == before


def test_choices_in_the_help_are_those_of_the_library():
    options = {option.name: option for option in cli.commands["budget"].params}
    assert tuple(options["axis"].type.choices) == (*m.kinetostatics.AXES, "all")
    assert tuple(options["model_measures"].type.choices) == typing.get_args(fits.machining._budget.Measures)
