"""The chain of parts against a composition in NumPy, and what can be done with it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _models import compiled, random_model
from _plant_reference import driver_and_mechanics, mechanics_alone, play_positions, settling, smoothed, states
from _reference import central_differences
from jax.extend.core import jaxprs_in_params

import microid as m

SAMPLES = 80
TRACES: list[str] = []


@compiled
def respond(stage, time_s, voltage_V, start=None):
    TRACES.append("respond")
    return stage(time_s, voltage_V, start)


def plays_of(rng):
    return m.hysteresis.PrandtlIshlinskii(0.2, rng.uniform(0.02, 0.1, 3), rng.uniform(1, 20, 3), 2.0)


def full_stage(rng, law=None, **options):
    return m.Stage.of(
        driver=m.Driver(rng.uniform(1e-3, 4e-3), rng.uniform(0.5, 2)),
        hysteresis=plays_of(rng) if law is None else law,
        mechanics=m.Mechanics(rng.uniform(30, 90), rng.uniform(0.02, 0.5), rng.uniform(1, 4)),
        sensor=m.Sensor(rng.uniform(0.9, 1.1), rng.normal()),
        **options,
    )


def interval(rng):
    """One for all samples: with times of their own twice as much would have to be compiled."""
    return np.asarray(rng.uniform(0.5e-3, 2e-3))


@pytest.mark.parametrize("hold", ["first", "zero"])
@pytest.mark.parametrize("rested", [True, False])
def test_chain_is_the_composition_of_its_parts(hold, rested, rng):
    stage, time_s = full_stage(rng, hold=hold), np.cumsum(rng.uniform(0.5e-3, 2e-3, SAMPLES))
    driver, law, mechanics, sensor = stage.parts
    voltage_V, memory_V = rng.uniform(-40, 40, SAMPLES), rng.uniform(-5, 5, 3)
    rest_V = rng.uniform(-40, 40) if rested else voltage_V[0]
    a, b = driver_and_mechanics(float(driver.time_constant_s), 1.0, 1.0)
    u = float(driver.gain) * states(a[:1, :1], b[:1], time_s, voltage_V, hold, rest_V)[:, 0]
    u = np.append(float(driver.gain) * rest_V, u)
    plays = play_positions(u, np.asarray(law.threshold_V), memory_V)
    w = float(law.offset_um) + float(law.slope_um_per_V) * u + plays @ np.asarray(law.weight_um_per_V)
    a, b = mechanics_alone(float(mechanics.natural_frequency_Hz), float(mechanics.damping_ratio))
    if hold == "first":
        answer = states(a, b, time_s, smoothed(time_s, w[1:]), "first", w[0])
    else:
        answer = settling(a, b, time_s, w[1:], float(driver.time_constant_s), w[0])
    out = float(mechanics.gain) * answer[:, 0]
    expected = float(sensor.offset_um) + float(sensor.gain) * out
    start = m.Start(np.asarray(rest_V) if rested else None, memory_V)
    np.testing.assert_allclose(respond(stage, time_s, voltage_V, start), expected, rtol=0, atol=1e-12 * 200)


def test_a_stage_at_rest_stays_there(rng):
    model = random_model(rng)
    stage = full_stage(rng, model)
    rest_V = 30 / stage["driver"].gain
    out = respond(stage, interval(rng), np.full(SAMPLES, rest_V))
    law_um = float(compiled(lambda law, voltage_V: law(voltage_V))(model, np.full(1, 30.0))[0])
    still = float(stage["sensor"].offset_um) + float(stage["sensor"].gain * stage["mechanics"].gain) * law_um
    np.testing.assert_allclose(out, still, rtol=1e-12)


def test_neighbouring_linear_parts_are_exact_and_substeps_converge(rng):
    """Without a hysteresis nothing is approximated. With a linear one between it is, to third order at corners."""
    driver, mechanics = m.Driver(2e-3), m.Mechanics(60.0, 0.1, 2.0)
    time_s, voltage_V = interval(rng), rng.uniform(-40, 40, SAMPLES)
    plant = driver_and_mechanics(2e-3, 60.0, 0.1)
    exact = 2 * 0.3 * states(*plant, time_s * np.arange(SAMPLES), voltage_V, "first")[:, 1]
    joined = m.Stage.of(driver=driver, piezo=m.Piezo(0.3), mechanics=mechanics)
    np.testing.assert_allclose(respond(joined, time_s, voltage_V), exact, rtol=0, atol=1e-12 * 40)
    law = m.hysteresis.PrandtlIshlinskii(0.3, np.zeros(1), np.zeros(1))
    errors = []
    for substeps in (2, 8):
        parted = m.Stage.of(driver=driver, law=law, mechanics=mechanics, substeps=substeps)
        errors.append(np.abs(respond(parted, time_s, voltage_V) - exact).max())
    assert 2.7 < np.log(errors[0] / errors[1]) / np.log(4) < 4.2


def test_a_linear_law_behind_a_held_command_is_exact(rng):
    """What a driver makes of a command in steps keeps its form through a law that is a line, however slow it is."""
    law = m.hysteresis.PrandtlIshlinskii(0.3, np.zeros(1), np.zeros(1))
    voltage_V = rng.uniform(-40, 40, SAMPLES)
    for lag_s in (1e-5, 2e-3, 0.1):
        exact = (
            0.3 * states(*driver_and_mechanics(lag_s, 60.0, 0.1), 1e-3 * np.arange(SAMPLES), voltage_V, "zero")[:, 1]
        )
        stage = m.Stage.of(driver=m.Driver(lag_s), law=law, mechanics=m.Mechanics(60.0, 0.1), hold="zero")
        np.testing.assert_allclose(respond(stage, np.asarray(1e-3), voltage_V), exact, rtol=0, atol=1e-11 * 40)


def test_steps_behind_a_driver_need_few_substeps(rng):
    """In the form of lines a tenth of an interval of lag would be off by a hundredth of the stroke."""
    law = m.hysteresis.PrandtlIshlinskii(0.2, rng.uniform(0.01, 0.03, 3), rng.uniform(1, 20, 3))
    voltage_V = np.repeat(rng.uniform(-40, 40, 8), SAMPLES // 8)
    stage = m.Stage.of(driver=m.Driver(1e-4), law=law, mechanics=m.Mechanics(60.0, 0.1), hold="zero")
    whole, fine = (respond(stage.with_substeps(count), np.asarray(1e-3), voltage_V) for count in (1, 256))
    assert np.sqrt(np.mean((whole - fine) ** 2)) < 1e-3 * np.ptp(fine)


def test_steps_are_held_through_substeps(rng):
    """And times of samples mean what the interval between them does."""
    voltage_V = rng.uniform(-40, 40, SAMPLES)
    coarse = m.Stage.of(driver=m.Driver(2e-3), piezo=m.Piezo(0.3), hold="zero")
    fine = m.Stage.of(driver=m.Driver(2e-3), piezo=m.Piezo(0.3), hold="zero", substeps=4)
    expected = respond(coarse, np.asarray(1 / 1024), voltage_V)
    np.testing.assert_allclose(respond(fine, np.asarray(1 / 1024), voltage_V), expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(respond(fine, np.arange(SAMPLES) / 1024, voltage_V), expected, rtol=0, atol=1e-11)


@compiled
def gradients(stage, time_s, voltage_V):
    def function(stage, voltage_V):
        return stage(time_s, voltage_V, m.Start(rest_V=jnp.zeros(())))

    at = stage, voltage_V
    return function(*at), jax.jacfwd(function, argnums=(0, 1))(*at), jax.jacrev(function, argnums=(0, 1))(*at)


@compiled
def driven(stage, time_s, voltage_V):
    return stage(time_s, voltage_V, m.Start(rest_V=jnp.zeros(())))


@pytest.mark.study
@pytest.mark.parametrize("kind", ["preisach", "plays"])
def test_derivatives_through_the_memory_are_those_of_finite_differences(kind, rng):
    """A driver before a hysteresis moves every remembered extreme when its time constant changes."""
    law = random_model(rng) if kind == "preisach" else plays_of(rng)
    stage, time_s = full_stage(rng, law), interval(rng)
    voltage_V = rng.uniform(5, 55, SAMPLES)
    _, forward, reverse = gradients(stage, time_s, voltage_V)
    leaves, treedef = jax.tree.flatten((stage, voltage_V))
    flat = np.concatenate([np.ravel(x) for x in leaves])
    splits = np.cumsum([np.size(x) for x in leaves])[:-1]

    def function(x):
        parts = [np.reshape(p, np.shape(leaf)) for p, leaf in zip(np.split(x, splits), leaves, strict=True)]
        stage, voltage_V = jax.tree.unflatten(treedef, parts)
        return driven(stage, time_s, voltage_V)

    expected = central_differences(function, flat, 1e-6 * np.maximum(np.abs(flat), 1e-2))
    one, other = (
        np.concatenate([np.reshape(x, (SAMPLES, -1)) for x in jax.tree.leaves(jac)], axis=1)
        for jac in (forward, reverse)
    )
    scale = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-10 * scale.max())
    # Ends of the reversible part's range appear twice; only the density's count.
    off = np.abs(one - expected).max(axis=0) / np.maximum(scale, 1e-6 * scale.max())
    assert np.quantile(off, 0.9) < 1e-6
    assert off[:2].max() < 1e-6
    assert scale[:2].min() > 0


def test_many_stages_in_single_precision_at_once(rng):
    stages = [full_stage(rng) for _ in range(3)]
    time_s, voltage_V = interval(rng), rng.uniform(-40, 40, SAMPLES)
    single = jax.tree.map(lambda *x: np.stack(x).astype(np.float32), *stages)
    many = compiled(lambda s, t, v: jax.vmap(lambda s: s(t, v))(s))
    got = many(single, time_s.astype(np.float32), voltage_V.astype(np.float32))
    assert got.dtype == np.float32
    for one, stage in zip(got, stages, strict=True):
        np.testing.assert_allclose(one, respond(stage, time_s, voltage_V), rtol=0, atol=1e-2)
    spread = np.float32([1.0, 1.1])
    wide = jax.eval_shape(
        lambda s, v: jax.vmap(lambda k: s(time_s.astype(np.float32), k * v))(spread),
        jax.tree.map(lambda x: x[0], single),
        voltage_V.astype(np.float32),
    )
    assert wide.shape == (2, SAMPLES)
    assert wide.dtype == np.float32


def equations_in(jaxpr):
    for equation in jaxpr.eqns:
        yield equation
        for inner in jaxprs_in_params(equation.params):
            yield from equations_in(inner)


@pytest.mark.parametrize("even", [True, False], ids=["even", "uneven"])
def test_no_product_of_matrices_is_left_to_the_default_precision(even, rng):
    """Which on a GPU is ten bits in single precision: there a response was wrong by 2e-4 of its amplitude."""
    stage, voltage_V = full_stage(rng), rng.uniform(-40, 40, SAMPLES)
    time_s = np.asarray(1e-3) if even else np.arange(SAMPLES) * 1e-3

    def gradient(stage, voltage_V):
        return eqx.filter_grad(lambda both: both[0](time_s, both[1]).sum())((stage, voltage_V))

    jaxpr = eqx.filter_make_jaxpr(gradient)(stage, voltage_V)[0].jaxpr
    products = [each for each in equations_in(jaxpr) if each.primitive.name == "dot_general"]
    assert len(products) > 10
    highest = (jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGHEST)
    assert all(each.params["precision"] == highest for each in products)


def test_new_data_of_the_same_shape_compile_nothing(rng):
    respond(full_stage(rng), interval(rng), rng.uniform(-40, 40, SAMPLES))
    traced = len(TRACES)
    stage = full_stage(rng)
    respond(stage.swap("driver", m.Driver(np.asarray(3e-3), 2)), interval(rng), rng.uniform(-40, 40, SAMPLES))
    assert len(TRACES) == traced


def test_parts_can_be_swapped_inserted_appended_and_taken_out(rng):
    stage = full_stage(rng).freeze("driver.gain", "sensor")
    other = stage.swap("hysteresis", m.hysteresis.Dahl(0.4, 1.0, 10.0))
    assert isinstance(other["hysteresis"], m.hysteresis.Dahl)
    assert isinstance(stage["hysteresis"], m.hysteresis.PrandtlIshlinskii)
    longer = other.append("second", m.Sensor(2.0)).insert(3, "second_mode", m.Mechanics(300.0, 0.02))
    assert longer.names == ("driver", "hysteresis", "mechanics", "second_mode", "sensor", "second")
    assert longer.frozen == ("driver.gain", "sensor")
    shorter = longer.without("sensor").without("driver")
    assert shorter.names == ("hysteresis", "mechanics", "second_mode", "second")
    assert shorter.frozen == ()
    time_s, voltage_V = interval(rng), rng.uniform(-40, 40, SAMPLES)
    np.testing.assert_allclose(
        respond(other.append("second", m.Sensor(2.0, 1.0)), time_s, voltage_V),
        1 + 2 * np.asarray(respond(other, time_s, voltage_V)),
        rtol=1e-12,
    )
    assert stage.swap("sensor", m.Sensor()) != stage


def test_what_is_frozen_stays(rng):
    stage = full_stage(rng).freeze("driver.gain", "sensor")
    coordinates = m.Coordinates(stage, stage.free)
    assert coordinates.size == 1 + 8 + 3
    moved = coordinates(coordinates.of(stage) + 0.1)
    assert moved["driver"].gain == stage["driver"].gain
    assert eqx.tree_equal(moved["sensor"], stage["sensor"])
    assert moved["driver"].time_constant_s != stage["driver"].time_constant_s
    thawed = stage.thaw("sensor")
    assert m.Coordinates(thawed, thawed.free).size == coordinates.size + 2
    names = [stage.named(info.path) for info in m.parameter_table(stage)]
    assert names[:3] == ["driver.time_constant_s", "driver.gain", "hysteresis.slope_um_per_V"]


def test_the_small_signal_response_needs_a_slope(rng):
    stage = full_stage(rng)
    with pytest.raises(ValueError, match="'hysteresis' has no transfer function: give the slope_um_per_V"):
        stage.frequency_response(np.ones(1))
    frequency_Hz = np.geomspace(1, 1e3, 5)
    linear = stage.swap("hysteresis", m.Piezo(0.25))
    np.testing.assert_allclose(
        stage.frequency_response(frequency_Hz, 0.25), linear.frequency_response(frequency_Hz), rtol=1e-13
    )
    np.testing.assert_allclose(0.25 * stage.static_gain, linear.static_gain, rtol=1e-13)
    assert stage.poles_rad_per_s.shape == (3,)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: m.Stage.of(sensor=m.Sensor()), "'sensor' takes um but the command gives V"),
        (lambda: m.Stage.of(a=m.Piezo(1.0), b=m.Driver(1e-3)), "'b' takes V but 'a' gives um"),
        (lambda: m.Stage.of(a=m.Driver(1e-3)), "must give a displacement in um, but 'a' gives V"),
        (lambda: m.Stage((m.Piezo(1.0), m.Sensor()), ("a", "a")), "no two alike"),
        (lambda: m.Stage((), ()), "one part or more"),
        (lambda: m.Stage.of(a=m.Piezo(1.0), hold="second"), "hold must be 'first', 'zero' or 'smooth'"),
        (lambda: m.Stage.of(a=m.Piezo(1.0), substeps=0), "substeps 1 to"),
        (lambda: m.Stage.of(a=m.Piezo(1.0)).freeze("b"), "nothing called 'b' to freeze: choose some of a.gain"),
        (lambda: m.Stage.of(a=m.Piezo(1.0)).freeze("a.gain"), "nothing called 'a.gain'"),
        (lambda: m.Stage.of(a=m.Piezo(1.0)).swap("b", m.Sensor()), "no part 'b': choose one of a"),
        (lambda: m.Stage.of(a=m.Piezo(1.0)).append("a", m.Sensor()), "a part 'a' already"),
    ],
)
def test_chains_that_do_not_fit_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
