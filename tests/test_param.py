"""Parameters with units, scales and bounds, against the formulas of the bijections in NumPy."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _models import random_model

import microid as m


class Inner(eqx.Module):
    """A part without declarations of its own."""

    weight: jax.Array
    count: jax.Array


class Toy(eqx.Module):
    """One field of every kind."""

    free: jax.Array = m.param(unit="V", scale=2.0)
    below: jax.Array = m.param(unit="um", scale=0.5, lower=-1.0)
    above: jax.Array = m.param(unit="s", scale=3.0, upper=4.0)
    between: jax.Array = m.param(unit="1", lower=-2.0, upper=6.0)
    parts: Inner = m.param(unit="um/V", scale=10.0)
    many: dict[str, list[Inner]] = eqx.field()
    data: jax.Array = m.array()
    size: int = m.static()


def toy(rng, **changes):
    def inner():
        return Inner(jnp.asarray(rng.normal(size=2)), jnp.arange(3))

    values = {
        "free": rng.normal(size=3),
        "below": rng.uniform(-0.9, 3, (2, 2)),
        "above": rng.uniform(-3, 3.9, 2),
        "between": rng.uniform(-1.9, 5.9, 2),
        "parts": inner(),
        "many": {"a": [inner()]},
        "data": rng.normal(size=4),
        "size": 5,
    }
    return Toy(**values | changes)


def softplus(z):
    return np.logaddexp(0, z)


def test_table_lists_what_is_declared_in_the_order_of_the_coordinates(rng):
    model = toy(rng)
    table = m.parameter_table(model)
    assert [(row.path, row.shape) for row in table] == [
        ("free", (3,)),
        ("below", (2, 2)),
        ("above", (2,)),
        ("between", (2,)),
        ("parts.weight", (2,)),
    ]
    inf = math.inf
    assert [row.spec for row in table] == [
        m.ParameterSpec("V", 2.0, -inf, inf),
        m.ParameterSpec("um", 0.5, -1.0, inf),
        m.ParameterSpec("s", 3.0, -inf, 4.0),
        m.ParameterSpec("1", 1.0, -2.0, 6.0),
        m.ParameterSpec("um/V", 10.0, -inf, inf),
    ]
    assert m.Coordinates(model).size == sum(math.prod(row.shape) for row in table)


def test_table_of_an_operator(rng):
    rows = {row.path: (row.shape, row.spec.unit, row.spec.lower) for row in m.parameter_table(random_model(rng))}
    assert rows == {
        "density.packed_um": ((28,), "um", 0.0),
        "reversible.slope_um_per_V": ((7,), "um/V", 0.0),
        "offset_um": ((), "um", -math.inf),
    }


def test_the_innermost_declaration_counts_and_reaches_into_lists(rng):
    class Middle(eqx.Module):
        toys: list[Toy]

    class Outer(eqx.Module):
        middle: Middle = m.param(unit="N", scale=7.0)

    rows = {row.path: row.spec.unit for row in m.parameter_table({"x": Outer(Middle([toy(rng)]))})}
    assert rows["['x'].middle.toys[0].free"] == "V"
    assert rows["['x'].middle.toys[0].parts.weight"] == "um/V"
    assert rows["['x'].middle.toys[0].many['a'][0].weight"] == "N"


def test_coordinates_are_the_documented_bijections(rng):
    model = toy(rng)
    coordinates = m.Coordinates(model)
    z = rng.uniform(-4, 4, coordinates.size)
    built = coordinates(jnp.asarray(z))
    free, below, above, between, weight = np.split(z, [3, 7, 9, 11])
    np.testing.assert_allclose(built.free, 2 * free, rtol=1e-14)
    np.testing.assert_allclose(built.below, -1 + 0.5 * softplus(below).reshape(2, 2), rtol=1e-13)
    np.testing.assert_allclose(built.above, 4 - 3 * softplus(-above), rtol=1e-13)
    np.testing.assert_allclose(built.between, -2 + 8 / (1 + np.exp(-between)), rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(built.parts.weight, 10 * weight, rtol=1e-14)
    # What is not a parameter stays.
    np.testing.assert_array_equal(built.data, model.data)
    np.testing.assert_array_equal(built.many["a"][0].weight, model.many["a"][0].weight)
    assert built.size == 5
    np.testing.assert_allclose(coordinates.of(built), z, rtol=0, atol=1e-12)


def test_models_come_back_from_their_coordinates(rng):
    model = toy(rng)
    coordinates = m.Coordinates(model)
    for got, expected in zip(
        jax.tree.leaves(coordinates(coordinates.of(model))), jax.tree.leaves(model), strict=True
    ):
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12)


def test_no_vector_leaves_the_bounds(rng):
    coordinates = m.Coordinates(toy(rng))
    for z in (-1e6, -40.0, 40.0, 1e6):
        built = coordinates(jnp.full(coordinates.size, z))
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(built))
        assert np.all(built.below >= -1)
        assert np.all(built.above <= 4)
        assert np.all((built.between >= -2) & (built.between <= 6))


def test_values_on_a_bound_start_just_inside(rng):
    model = toy(rng, below=np.full((2, 2), -1.0), above=np.full(2, 4.0), between=np.array([-2.0, 6.0]))
    coordinates = m.Coordinates(model)
    built = coordinates(coordinates.of(model))
    np.testing.assert_allclose(np.asarray(built.below) + 1, 0.5e-6, rtol=1e-6)
    np.testing.assert_allclose(4 - np.asarray(built.above), 3e-6, rtol=1e-6)
    np.testing.assert_allclose(np.abs(np.asarray(built.between) - [-2, 6]), [1e-6, 8e-6], rtol=1e-6)


def test_values_between_bounds_many_decades_apart_come_back(rng):
    class Wide(eqx.Module):
        time_constant_s: jax.Array = m.param(unit="s", scale=100.0, lower=1e-3, upper=1e6)

    for value in 10 ** rng.uniform(-2.5, 5.5, 20):
        model = Wide(value)
        coordinates = m.Coordinates(model)
        np.testing.assert_allclose(coordinates(coordinates.of(model)).time_constant_s, value, rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"below": np.array([[0.0, -1.5], [0.0, 0.0]])}, r"value -1.5 um lies outside its bounds \[-1, inf\] um"),
        ({"above": np.array([4.5, 0.0])}, r"value 4.5 s lies outside its bounds \[-inf, 4\] s"),
        ({"between": np.array([7.0, 0.0])}, r"value 7 1 lies outside its bounds \[-2, 6\] 1"),
    ],
)
def test_values_outside_their_bounds_are_refused(changes, sentence, rng):
    model = toy(rng, **changes)
    coordinates = m.Coordinates(model)
    with pytest.raises(ValueError, match=sentence):
        coordinates.of(model)
    # A traced value cannot be looked at; it is moved to the bound.
    assert np.all(np.isfinite(eqx.filter_jit(coordinates.of)(model)))


def test_only_what_is_free_moves(rng):
    model = toy(rng)
    coordinates = m.Coordinates(model, lambda info: info.spec.unit == "s" or info.path.startswith("parts"))
    assert coordinates.size == 4
    built = coordinates(jnp.zeros(4))
    np.testing.assert_allclose(built.above, 4 - 3 * np.log(2), rtol=1e-14)
    np.testing.assert_array_equal(built.parts.weight, 0)
    for name in ("free", "below", "between"):
        np.testing.assert_array_equal(getattr(built, name), getattr(model, name))
    with pytest.raises(ValueError, match="no parameter is free"):
        m.Coordinates(model, lambda info: False)
    with pytest.raises(ValueError, match="no parameter is free"):
        m.Coordinates(jnp.ones(3))


def test_models_of_another_structure_are_refused(rng):
    coordinates = m.Coordinates(toy(rng))
    for other in (toy(rng, size=6), toy(rng, many={}), random_model(rng)):
        with pytest.raises(ValueError, match="another structure"):
            coordinates.of(other)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"scale": 0.0}, "scale must be positive"),
        ({"scale": -1.0}, "scale must be positive"),
        ({"scale": math.nan}, "scale must be positive"),
        ({"lower": 1.0, "upper": 1.0}, "lower must be less than upper"),
        ({"lower": 2.0, "upper": 1.0}, "lower must be less than upper"),
        ({"lower": math.nan}, "lower must be less than upper"),
    ],
)
def test_declarations_that_make_no_sense_are_refused(settings, sentence):
    with pytest.raises(ValueError, match=sentence):
        m.param(unit="V", **settings)


@pytest.mark.parametrize("given", [3, 3.0, np.float32(3), np.float64(3), np.int64(3), jnp.asarray(3.0), jnp.int32(3)])
def test_fields_hold_strongly_typed_floats_whatever_is_given(given):
    """A weakly typed value would compile every function once more."""

    class Holder(eqx.Module):
        fitted: jax.Array = m.param(unit="V")
        data: jax.Array = m.array()

    holder = Holder(given, given)
    for field in (holder.fitted, holder.data):
        assert field.dtype == (np.float32 if given.__class__ is np.float32 else np.float64)
        assert not field.weak_type
        assert float(field) == 3


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: m.Mechanics(-1.0, 0.1), r"natural_frequency_Hz -1 Hz lies outside its bounds \[1e-06, inf\] Hz"),
        (lambda: m.Sensor(1.0, math.nan), r"offset_um nan um lies outside its bounds \[-inf, inf\] um"),
    ],
)
def test_a_number_out_of_bounds_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()
