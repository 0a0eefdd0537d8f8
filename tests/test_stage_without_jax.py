"""`simulate` and static `compensate` of a whole stage in NumPy: against JAX, against SciPy, and never with JAX."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from _command import says_the_same_with_jax, without_jax
from _models import LEVELS, compiled, densities_of, limits_V, nested_voltages, random_model, starts, stroke_um
from _plant_reference import driver_and_mechanics, mechanics_alone, smoothed, states
from _reference import play_relays, relay_weights_um

import microid as m
from fits import Record, StageUncertainty, predict, save_model
from fits.io._model_text import read_model_text
from fits.loop._design import Grid
from fits.stage._chain import offsets_out
from fits.stage._declared import declared, form_of
from fits.stage._motion import predicted_ranges
from fits.stage._plain_linear import _blockwise
from fits.stage._plain_parts import SYSTEMS, PlainLinear
from fits.stage._plain_stage import plain_model

SAMPLES = 300
EXACT = 1e-12

respond = compiled(lambda stage, time_s, voltage_V, start: stage(time_s, voltage_V, start))


def draw(rng, **options):
    """A stage, and made-up perturbations on a grid of their own."""
    stage = m.Stage.of(
        driver=m.Driver(rng.uniform(1e-3, 4e-3), rng.uniform(0.5, 2)),
        hysteresis=random_model(rng),
        mechanics=m.Mechanics(rng.uniform(200, 300), rng.uniform(0.02, 0.5), rng.uniform(1, 4)),
        sensor=m.Sensor(rng.uniform(0.9, 1.1), rng.normal()),
        **options,
    ).freeze("driver.gain", "sensor")
    grid = Grid(*map(jnp.asarray, limits_V(stage["hysteresis"])), 5)
    sizes = (40, offsets_out(stage, True).size), (40, grid.columns), (40,)
    moved = (jnp.asarray(rng.normal(scale=1e-2, size=size)) for size in sizes)
    return stage, StageUncertainty(*moved, jnp.asarray(0.01), grid)


def saved(path, stage, uncertainty=None):
    save_model(path, stage, uncertainty, {})
    return plain_model(read_model_text(str(path)))


def program(rng, stage, even):
    """A command inside the range, with loops in loops and rests."""
    lower_V, upper_V = (end / float(stage["driver"].gain) for end in limits_V(stage["hysteresis"]))
    step_s = np.full(SAMPLES, 1e-3) if even else rng.uniform(0.5e-3, 2e-3, SAMPLES)
    return Record(np.cumsum(step_s), nested_voltages(rng, lower_V, upper_V, SAMPLES), None)


def test_what_is_declared_is_what_microid_declares():
    made = {"Driver": m.Driver(1e-3), "Lag": m.Lag(1e-3), "Mechanics": m.Mechanics(100.0, 0.1), "Sensor": m.Sensor()}
    assert set(SYSTEMS) == set(made)
    for kind, part in made.items():
        found = [(name, said.unit, said.scale, said.lower, np.inf) for name, said in declared()[kind].items()]
        table = m.parameter_table(part)
        assert found == [(one.path, one.spec.unit, one.spec.scale, one.spec.lower, one.spec.upper) for one in table]
        # A coordinate moves its parameter, by finite differences.
        coordinates = m.Coordinates(part)
        z = np.asarray(coordinates.of(part))
        ends = [np.asarray(coordinates.values(jnp.asarray(z + sign * 1e-5))) for sign in (-1, 1)]
        values = np.asarray(coordinates.values(jnp.asarray(z)))
        slopes = [said.slope(value) for said, value in zip(declared()[kind].values(), values, strict=True)]
        np.testing.assert_allclose(slopes, (ends[1] - ends[0]) / 2e-5, rtol=1e-6)


@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("hold", ["first", "zero", "smooth"])
@pytest.mark.parametrize("damping_ratio", [0.0, 0.05, 1.0, 3.0])
def test_linear_parts_are_those_of_the_matrix_exponential(damping_ratio, hold, even, rng):
    time_constant_s, frequency_Hz, rest_V = rng.uniform(1e-4, 1e-2), rng.uniform(30, 300), rng.uniform(-40, 40)
    time_s = np.cumsum(np.full(SAMPLES, 1e-3) if even else rng.uniform(0.5e-3, 2e-3, SAMPLES))
    signal = rng.uniform(-40, 40, SAMPLES)
    driver = PlainLinear("Driver", {"time_constant_s": time_constant_s, "gain": 2.0})
    mechanics = PlainLinear(
        "Mechanics", {"natural_frequency_Hz": frequency_Hz, "damping_ratio": damping_ratio, "gain": 3.0}
    )
    system = driver.system().then(mechanics.system())
    found = system.respond(np.diff(time_s)[: 1 if even else None], signal[:, None], np.array([rest_V]), hold)[:, 0]
    seen = smoothed(time_s, signal) if hold == "smooth" else signal
    held = "zero" if hold == "zero" else "first"
    expected = 6 * states(
        *driver_and_mechanics(time_constant_s, frequency_Hz, damping_ratio), time_s, seen, held, rest_V
    )
    np.testing.assert_allclose(found, expected[:, 1], rtol=0, atol=1e-10 * np.ptp(expected[:, 1]))


@pytest.mark.parametrize("even", [True, False])
def test_many_signals_are_followed_piece_by_piece(even, rng):
    time_constant_s, frequency_Hz, damping_ratio = rng.uniform(1e-4, 1e-2), rng.uniform(30, 300), rng.uniform(0.01, 2)
    time_s = np.cumsum(np.full(SAMPLES, 1e-3) if even else rng.uniform(0.5e-3, 2e-3, SAMPLES))
    driver = PlainLinear("Driver", {"time_constant_s": time_constant_s, "gain": 1.0})
    mechanics = PlainLinear(
        "Mechanics", {"natural_frequency_Hz": frequency_Hz, "damping_ratio": damping_ratio, "gain": 1.0}
    )
    signal, each = rng.uniform(-40, 40, SAMPLES), rng.normal(size=50)
    expected = states(
        *driver_and_mechanics(time_constant_s, frequency_Hz, damping_ratio), time_s, signal, "first", signal[0]
    )[:, 1:2]
    system, cuts = driver.system().then(mechanics.system()), np.sort(rng.integers(1, SAMPLES, 4))
    pieces = (piece for piece in np.split(signal[:, None] * each, cuts) if len(piece))
    found = np.concatenate([*system.follow(np.diff(time_s)[: 1 if even else None], pieces)])
    np.testing.assert_allclose(found, expected * each, rtol=0, atol=1e-10 * np.max(np.abs(expected * each)))


@pytest.mark.parametrize("count", [1, 2, 17, 100])
@pytest.mark.parametrize("alike", [True, False])
def test_blocks_of_a_recurrence_are_led_on(count, alike, rng):
    step, start = rng.normal(scale=0.5, size=(1 if alike else count, 3, 3)), rng.normal(size=(3, 2))
    push, z, expected = rng.normal(size=(count, 3, 2)), start, []
    for t in range(count):
        z = step[0 if alike else t] @ z + push[t]
        expected.append(z)
    np.testing.assert_allclose(_blockwise(step, push, start), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("hold", "even", "state"), [("first", True, "demagnetised"), ("zero", False, "positive")])
def test_predictions_are_those_of_jax(hold, even, state, rng, tmp_path):
    stage, uncertainty = draw(rng, hold=hold, substeps=3)
    plain, record = saved(tmp_path / "s.json", stage, uncertainty), program(rng, stage, even)
    found, expected = plain.predict(record, state), predict(stage, record, state, uncertainty=uncertainty)
    exact = {"rtol": 0, "atol": EXACT * stroke_um(stage["hysteresis"])}
    np.testing.assert_allclose(found.displacement_um, expected.displacement_um, **exact)
    np.testing.assert_allclose(found.displacement_sd_um, expected.displacement_sd_um, rtol=1e-11)
    played = respond(stage, record.time_s, record.voltage_V, m.Start(memory=starts(stage["hysteresis"])[state]))
    np.testing.assert_allclose(plain.play(record, state), played, **exact)
    # What rings between the samples counts, too.
    ranges = plain.ranges(record, found.displacement_um, state)
    same = predicted_ranges(stage, record, found.displacement_um, state)
    assert ranges.keys() == same.keys()
    for name, ends in same.items():
        np.testing.assert_allclose(ranges[name], ends, rtol=1e-11)
    assert np.ptp(ranges["displacement"]) > np.ptp(found.displacement_um)


@pytest.mark.parametrize("hold", ["first", "zero"])
def test_one_sample_is_answered_as_the_first_of_two_is(hold, rng, tmp_path):
    stage, uncertainty = draw(rng, hold=hold)
    plain, record = saved(tmp_path / "s.json", stage, uncertainty), program(rng, stage, True)
    one, two = (Record(record.time_s[:n], record.voltage_V[:n], None) for n in (1, 2))
    expected = plain.predict(two, "negative")
    for found in (plain.predict(one, "negative"), predict(stage, one, "negative", uncertainty=uncertainty)):
        assert found.displacement_um == pytest.approx(expected.displacement_um[:1], rel=1e-9)
        assert found.displacement_sd_um == pytest.approx(expected.displacement_sd_um[:1], rel=1e-9)


def test_the_chain_is_the_composition_of_relays_and_matrix_exponentials(rng, tmp_path):
    """Ahead of the hysteresis nothing lags, so that voltages stay at edges of cells, where relays are exact."""
    law, mechanics = random_model(rng), m.Mechanics(60.0, 0.1, 2.0)
    plain = saved(tmp_path / "s.json", m.Stage.of(hysteresis=law, mechanics=mechanics))
    (lower_V, upper_V), cells = limits_V(law), 2 * (LEVELS - 1)
    weights_um, thresholds_V = relay_weights_um(*densities_of(law), lower_V, upper_V, cells)
    voltage_V = lower_V + rng.integers(0, cells + 1, SAMPLES) * (upper_V - lower_V) / cells
    given_um = float(law.offset_um) + play_relays(weights_um, thresholds_V, voltage_V)
    time_s = np.arange(SAMPLES) / 1000
    expected = 2 * states(*mechanics_alone(60.0, 0.1), time_s, given_um, "first")[:, 0]
    found = plain.play(Record(time_s, voltage_V, None), "negative")
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.ptp(expected))


def test_derivatives_by_parameters_are_those_of_finite_differences(rng, tmp_path):
    """Each parameter moved by itself, and simulated again."""
    stage, uncertainty = draw(rng, substeps=2)
    plain, record = saved(tmp_path / "s.json", stage, uncertainty), program(rng, stage, True)
    known = plain.uncertainty
    for k, (place, name, at) in enumerate(known.free):
        assert at == ()
        moved = []
        for sign in (-1, 1):
            part = plain.parts[place]
            values = part.values | {
                name: part.values[name] + sign * 1e-6 * part.fields[name].slope(part.values[name])
            }
            parts = (*plain.parts[:place], replace(part, values=values), *plain.parts[place + 1 :])
            moved.append(replace(plain, parts=parts, uncertainty=None).predict(record, "negative").displacement_um)
        slope = (moved[1] - moved[0]) / 2e-6
        alone = replace(
            known,
            coordinates=np.eye(len(known.free))[k : k + 1],
            density=np.zeros((*known.density.shape[:2], 1)),
            slope=np.zeros((len(known.slope), 1)),
            mean_um=np.zeros(1),
            discrepancy_um=0.0,
        )
        sd_um = replace(plain, uncertainty=alone).predict(record, "negative").displacement_sd_um
        np.testing.assert_allclose(sd_um, np.abs(slope), rtol=0, atol=1e-5 * np.max(np.abs(slope)))


def test_what_is_not_plain_is_left_to_jax(rng, tmp_path):
    stage, uncertainty = draw(rng)
    place = tmp_path / "s.json"
    creep, slew = (
        next(effect for effect in m.effects.EFFECTS if effect.name == name) for name in ("creep", "slew_limit")
    )
    with pytest.raises(LookupError, match="SlewLimit has no form"):
        form_of(slew.__name__)
    assert saved(place, stage, uncertainty) is not None
    for other in (
        m.Stage(stage.parts, stage.names, "smooth"),
        stage.swap("hysteresis", m.Piezo(0.1)),
        m.effects.extend(stage, creep(0.01, 0.1, 0.05)),
        m.effects.extend(stage, slew(50.0)),
        stage.swap("hysteresis", m.hysteresis.PrandtlIshlinskii(0.2, np.ones(1), np.ones(1), 0.0)),
        stage.swap("driver", m.Driver(1e-3, -1.0)),
    ):
        assert saved(place, other) is None
    # On a bound a coordinate is infinite.
    assert saved(place, stage.swap("mechanics", m.Mechanics(100.0, 0.0)), uncertainty) is None
    save_model(place, stage, uncertainty, {})
    content = read_model_text(str(place))
    for part, name, value in (
        ("model", "substeps", 1.0),
        ("model", "frozen", ["nothing"]),
        ("model", "more", 1),
        ("uncertainty", "mean_um", {"unit": "um", "value": [0.0]}),
        ("uncertainty", "grid", None),
    ):
        assert plain_model(content | {part: content[part] | {name: value}}) is None


def test_the_commands_say_the_same_without_jax(rng, tmp_path, monkeypatch):
    stage, uncertainty = draw(rng)
    model, record = tmp_path / "s.json", program(rng, stage, True)
    save_model(model, stage, uncertainty, {})
    law = plain_model(read_model_text(str(model))).static
    np.savetxt(
        tmp_path / "p.csv",
        np.column_stack([record.time_s, record.voltage_V]),
        delimiter=",",
        header="time_s,voltage_V",
        comments="",
    )
    low_um, high_um = law.reach_um
    wanted_um = low_um + (high_um - low_um) * (0.5 - 0.4 * np.cos(np.arange(SAMPLES) / 20))
    rows = np.column_stack([record.time_s, wanted_um])
    np.savetxt(tmp_path / "r.csv", rows, delimiter=",", header="time_s,displacement_um", comments="")
    middle_V = 0.5 * sum(law.range_V)
    asked = [
        ["simulate", model, tmp_path / "p.csv", "--initial", "demagnetised"],
        ["compensate", model, tmp_path / "r.csv"],
        ["compensate", model, tmp_path / "r.csv", "--limits", f"{law.range_V[0]},{middle_V}"],
        ["compensate", model, tmp_path / "r.csv", "--limits", f"{law.range_V[0]},{middle_V}", "--clip"],
        ["compensate", model, tmp_path / "r.csv", "--limit", "displacement=0:1um"],
    ]
    here = tmp_path / "y.csv"
    for arguments in asked:
        says_the_same_with_jax(monkeypatch, arguments, here)
    for command, csv in (("simulate", "p.csv"), ("compensate", "r.csv")):
        done = without_jax(
            command, model, tmp_path / csv, "--out", here, and_without=("pandas", "scipy", "matplotlib")
        )
        assert (done.returncode, done.stderr) == (0, "")
    assert without_jax("export", model, "--out", tmp_path / "c").returncode == 0
