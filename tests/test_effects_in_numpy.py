"""Forms in NumPy of effects: those of JAX to the last digits, and predictions with them without JAX."""

import dataclasses
import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _command import says_the_same_with_jax, without_jax
from _models import limits_V, nested_voltages, random_model, starts, stroke_um
from _plant_reference import states
from scipy.interpolate import BarycentricInterpolator

import microid as m
from fits import Record, StageUncertainty, predict, save_model
from fits.io._model_text import read_model_text
from fits.loop._design import Grid
from fits.stage._chain import offsets_out
from fits.stage._declared import form_of, tools
from fits.stage._plain_stage import plain_model

SAMPLES, INTERVAL_s, TINY, EXACT = 300, 1e-3, 1e-30, 1e-12
FORMS = [effect for effect in m.effects.EFFECTS if hasattr(effect, "in_numpy")]
BY_NAME = {effect.__name__: effect for effect in FORMS}


def drawn(effect, rng):
    """An effect of the size that its scales say, without a history."""
    values = {}
    for name, said in form_of(effect.__name__).fields.items():
        if said is None:
            values[name] = rng.uniform(10, 30)
        elif name not in effect.history:
            lowest = said.lower if math.isfinite(said.lower) else 0.0
            size = rng.uniform(0.3, 0.9, said.shape) * min(said.scale, said.upper - lowest)
            values[name] = lowest + size
    return effect(**values)


def in_numpy(effect, interval_s, signal, **moved):
    form = form_of(type(effect).__name__)
    values = {name: np.asarray(getattr(effect, name))[()] for name in form.fields}
    return form.run(SimpleNamespace(**(values | moved)), interval_s, signal)


def clock(rng, even):
    """Times as JAX takes them, and intervals as NumPy does."""
    if even:
        return jnp.asarray(INTERVAL_s), np.array([INTERVAL_s])
    interval_s = rng.uniform(0.5, 2, SAMPLES - 1) * INTERVAL_s
    return jnp.asarray(np.append(0.0, np.cumsum(interval_s))), interval_s


def test_simple_effects_have_a_form():
    assert {effect.name for effect in FORMS} >= {
        "sensor_lowpass",
        "transport_delay",
        "creep",
        "mount_relaxation",
        "floor_vibration",
        "mains_hum",
        "sensor_nonlinearity",
    }
    assert not any(effect.needs for effect in FORMS)


@pytest.mark.parametrize("effect", FORMS, ids=lambda effect: effect.__name__)
def test_what_is_declared_is_what_the_effect_declares(effect, rng):
    form, made = form_of(effect.__name__), drawn(effect, rng)
    assert (form.gives, form.history) == (effect.gives, effect.history)
    assert list(form.fields) == [field.name for field in dataclasses.fields(effect)]
    stated = [(name, said) for name, said in form.fields.items() if said is not None]
    table = m.parameter_table(made)
    found = [(name, said.shape, said.unit, said.scale, said.lower, said.upper) for name, said in stated]
    expected = [(x.path, x.shape, x.spec.unit, x.spec.scale, x.spec.lower, x.spec.upper) for x in table]
    assert found == expected
    # A coordinate moves its parameter, by finite differences.
    coordinates = m.Coordinates(made)
    z = np.asarray(coordinates.of(made))
    down, here, up = (np.asarray(coordinates.values(jnp.asarray(z + step))) for step in (-1e-5, 0.0, 1e-5))
    declared = [said for _, said in stated for _ in np.ndindex(said.shape)]
    slopes = [said.slope(value) for said, value in zip(declared, here, strict=True)]
    np.testing.assert_allclose(slopes, (up - down) / 2e-5, rtol=1e-5)
    assert all(said.inside(value) for said, value in zip(declared, here, strict=True) if value)


@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("effect", FORMS, ids=lambda effect: effect.__name__)
def test_a_form_and_its_derivatives_are_those_of_jax(effect, even, rng):
    """Along all parameters, and along what comes in."""
    made, (time_s, interval_s) = drawn(effect, rng), clock(rng, even)
    values, before = np.cumsum(rng.normal(scale=3.0, size=SAMPLES)), rng.uniform(-5, 5)
    moved, moved_before = rng.normal(size=SAMPLES), rng.normal()
    stated = [(name, said) for name, said in form_of(effect.__name__).fields.items() if name not in effect.history]
    along = {name: rng.normal(size=said.shape) * said.scale for name, said in stated if said is not None}
    history = {name: 0.0 for name in effect.history}

    def run(parameters, values, before):
        fields = {name: parameters.get(name, getattr(made, name)) for name, _ in stated}
        found = effect(**fields, **history).run(time_s, m.Signal(values, before, hold))
        return found.values, found.before

    for hold in ("smooth", "zero") if effect.name == "sensor_lowpass" else ("smooth",):
        point = ({name: getattr(made, name) for name in along}, jnp.asarray(values), jnp.asarray(before))
        tangent = ({name: jnp.asarray(x) for name, x in along.items()}, jnp.asarray(moved), jnp.asarray(moved_before))
        (expected, rest), (slope, rest_slope) = jax.jit(lambda *at: jax.jvp(run, at[:3], at[3:]))(*point, *tangent)
        signal = tools()._NumpySignal(
            (values + 1j * TINY * moved)[:, None], np.array([before + 1j * TINY * moved_before]), hold
        )
        shifted = {name: np.asarray(getattr(made, name)) + 1j * TINY * x for name, x in along.items()}
        found = in_numpy(made, interval_s, signal, **shifted)
        exact = {"rtol": 0, "atol": EXACT * np.ptp(values)}
        np.testing.assert_allclose(found.values[:, 0].real, expected, **exact)
        np.testing.assert_allclose(found.before.real, rest, **exact)
        size = max(np.max(np.abs(slope)), 1.0)
        np.testing.assert_allclose(found.values[:, 0].imag / TINY, slope, rtol=0, atol=1e-10 * size)
        np.testing.assert_allclose(found.before.imag / TINY, rest_slope, rtol=0, atol=1e-10 * size)


@pytest.mark.parametrize("even", [True, False])
def test_lags_are_those_of_the_matrix_exponential(even, rng):
    time_s, interval_s = clock(rng, even)
    values = rng.normal(size=(SAMPLES, 2))
    time_s = INTERVAL_s * np.arange(SAMPLES) if even else np.asarray(time_s)
    constants_s, weights = np.array([3e-3, 0.2]), np.array([0.7, 2.0])
    expected = np.zeros_like(values)
    for column, constant_s, weight in [(k, *pair) for k in (0, 1) for pair in zip(constants_s, weights, strict=True)]:
        system = np.array([[-1 / constant_s]]), np.array([1 / constant_s])
        expected[:, column] += weight * states(*system, time_s, values[:, column], "first", values[0, column])[:, 0]
    np.testing.assert_allclose(tools()._lags(interval_s, values, constants_s, weights), expected, rtol=0, atol=1e-12)


def test_cubics_go_through_the_samples_around(rng):
    time_s, interval_s = clock(rng, False)
    values, time_s = rng.normal(size=SAMPLES), np.asarray(time_s)
    when_s = rng.uniform(time_s[2], time_s[-3], SAMPLES)
    signal = tools()._NumpySignal(values[:, None], values[:1], "first")
    found = tools()._reading_at(interval_s, signal, when_s)[:, 0]
    for k in range(0, SAMPLES, 10):
        around = np.searchsorted(time_s, when_s[k]) + np.arange(-2, 2)
        assert found[k] == pytest.approx(BarycentricInterpolator(time_s[around], values[around])(when_s[k]), abs=1e-9)


def extended(rng, **options):
    """A stage with a chain of effects ahead of the hysteresis and behind it, and made-up perturbations."""
    stage = m.Stage.of(
        creeping=drawn(BY_NAME["VoltageCreep"], rng),
        driver=m.Driver(rng.uniform(1e-3, 4e-3), rng.uniform(0.5, 2)),
        hysteresis=random_model(rng),
        creep=drawn(BY_NAME["KelvinVoigtCreep"], rng),
        lag=m.Lag(rng.uniform(1e-3, 4e-3)),
        mechanics=m.Mechanics(rng.uniform(100, 150), rng.uniform(0.05, 0.5), rng.uniform(1, 4)),
        settling=drawn(BY_NAME["MountRelaxation"], rng),
        sensor=m.Sensor(rng.uniform(0.9, 1.1), rng.normal()),
        lowpass=drawn(BY_NAME["SensorLowpass"], rng),
        hum=drawn(BY_NAME["MainsHum"], rng),
        bent=drawn(BY_NAME["SensorNonlinearity"], rng),
        delay=drawn(BY_NAME["TransportDelay"], rng),
        **options,
    ).freeze("driver.gain", "sensor")
    grid = Grid(*map(jnp.asarray, limits_V(stage["hysteresis"])), 5)
    coordinates = offsets_out(stage, True)
    moves = rng.normal(scale=1e-2, size=(40, coordinates.size))
    names = [stage.named(info.path) for info in coordinates.table for _ in np.ndindex(info.shape)]
    moves[:, ["before" in name or "recent" in name or "older" in name for name in names]] = 0
    columns = rng.normal(scale=1e-2, size=(40, grid.columns))
    moved = (jnp.asarray(x) for x in (moves, columns, rng.normal(scale=1e-2, size=40)))
    return stage, StageUncertainty(*moved, jnp.asarray(0.01), grid)


def program(rng, stage, even):
    lower_V, upper_V = (end / float(stage["driver"].gain) for end in limits_V(stage["hysteresis"]))
    step_s = INTERVAL_s * (np.ones(SAMPLES) if even else rng.uniform(0.5, 2, SAMPLES))
    # Creep ahead of the hysteresis takes a command from the ends of its range.
    inside = 0.1 * (upper_V - lower_V)
    return Record(np.cumsum(step_s), nested_voltages(rng, lower_V + inside, upper_V - inside, SAMPLES), None)


@pytest.mark.parametrize(("hold", "even"), [("first", True), pytest.param("zero", False, marks=pytest.mark.study)])
def test_predictions_of_extended_stages_are_those_of_jax(hold, even, rng, tmp_path):
    stage, uncertainty = extended(rng, hold=hold, substeps=3)
    save_model(tmp_path / "s.json", stage, uncertainty, {})
    plain, record = plain_model(read_model_text(str(tmp_path / "s.json"))), program(rng, stage, even)
    found, expected = plain.predict(record, "negative"), predict(stage, record, uncertainty=uncertainty)
    exact = {"rtol": 0, "atol": EXACT * stroke_um(stage["hysteresis"]) * float(stage["mechanics"].gain)}
    np.testing.assert_allclose(found.displacement_um, expected.displacement_um, **exact)
    np.testing.assert_allclose(found.displacement_sd_um, expected.displacement_sd_um, rtol=1e-10)
    start = m.Start(memory=starts(stage["hysteresis"])["positive"])
    played = jax.jit(lambda stage, *given: stage(*given))(stage, record.time_s, record.voltage_V, start)
    np.testing.assert_allclose(plain.play(record, "positive"), played, **exact)
    one = plain.predict(Record(record.time_s[:1], record.voltage_V[:1], None), "negative")
    assert np.isfinite([one.displacement_um, one.displacement_sd_um]).all()


def test_what_went_on_before_is_left_to_jax(rng, tmp_path):
    stage, uncertainty = extended(rng)
    place = tmp_path / "s.json"

    def plain(stage, uncertainty):
        save_model(place, stage, uncertainty, {})
        return plain_model(read_model_text(str(place)))

    assert plain(stage, uncertainty) is not None
    assert plain(stage.swap("lowpass", BY_NAME["SensorLowpass"](1e-3, 0.1)), None) is None
    moves = uncertainty.coordinates + 1e-3
    others = uncertainty.columns_um, uncertainty.mean_um, uncertainty.discrepancy_um, uncertainty.grid
    assert plain(stage, StageUncertainty(moves, *others)) is None


def test_the_commands_say_the_same_without_jax(rng, tmp_path, monkeypatch):
    stage, _ = extended(rng)
    # Of a lag and a delay the inverse of the plain stage knows nothing.
    stage = stage.without("lowpass").without("delay").without("creeping")
    save_model(tmp_path / "s.json", stage, None, {})
    record, law = program(rng, stage, True), plain_model(read_model_text(str(tmp_path / "s.json"))).static
    low_um, high_um = law.reach_um
    wanted_um = low_um + (high_um - low_um) * (0.5 - 0.4 * np.cos(np.arange(SAMPLES) / 20))
    for name, what, values in (("p", "voltage_V", record.voltage_V), ("r", "displacement_um", wanted_um)):
        rows = np.column_stack([record.time_s, values])
        np.savetxt(tmp_path / f"{name}.csv", rows, delimiter=",", header=f"time_s,{what}", comments="")
    here = tmp_path / "y.csv"
    for command, csv in (("simulate", "p.csv"), ("compensate", "r.csv")):
        says_the_same_with_jax(monkeypatch, [command, tmp_path / "s.json", tmp_path / csv], here)
        done = without_jax(
            command, tmp_path / "s.json", tmp_path / csv, "--out", here, and_without=("pandas", "scipy", "matplotlib")
        )
        assert (done.returncode, done.stderr) == (0, "")
