"""Derivatives of the operator against central differences, and the transformations of JAX."""

import equinox as eqx
import jax
import numpy as np
import pytest
from _models import compiled, flat, limits_V, matrix, play, random_model, stroke_um, without_a_cpu
from _reference import central_differences

import microid as m
from microid._memory import _by_lifting

SAMPLES = 24


def spread_voltages(rng, model):
    """Random reversals that keep their distance from each other, from the levels and from the ends."""
    lower_V, upper_V = limits_V(model)
    return lower_V + (upper_V - lower_V) * (rng.permutation(SAMPLES) + rng.uniform(0.2, 0.8, SAMPLES)) / SAMPLES


def awkward_voltages(model):
    """Rests, ties with old extremes, levels, both ends and beyond: everywhere a derivative could be lost."""
    lower_V, upper_V = limits_V(model)
    share = [
        0,
        0,
        0.4,
        0.4,
        0.2,
        0.4,
        0.2,
        0.2,
        0.5,
        0.5,
        1 / 3,
        2 / 3,
        1,
        1,
        0.5,
        1,
        1.2,
        1.1,
        0.3,
        0,
        -0.2,
        -0.1,
        0,
        1,
    ]
    # The weights of a mean: at a share of 1 they give the upper end to the last bit.
    return lower_V * (1 - np.array(share)) + upper_V * np.array(share)


@compiled
def jacobians(model, voltage_V):
    """Output, and its derivatives in the model and the voltage in both modes."""

    def function(model, voltage_V):
        return model(voltage_V)

    forward, reverse = (jac(function, argnums=(0, 1))(model, voltage_V) for jac in (jax.jacfwd, jax.jacrev))
    return function(model, voltage_V), forward, reverse


def unflat(vector, like):
    leaves, treedef = jax.tree.flatten(like)
    parts = np.split(vector, np.cumsum([np.size(leaf) for leaf in leaves])[:-1])
    return jax.tree.unflatten(treedef, [np.reshape(p, np.shape(leaf)) for p, leaf in zip(parts, leaves, strict=True)])


def test_both_modes_agree_with_central_differences(rng):
    model = random_model(rng)
    voltage_V = spread_voltages(rng, model)
    at = (model, voltage_V)
    displacement_um, forward, reverse = jacobians(*at)
    np.testing.assert_allclose(displacement_um, play(*at)[0], rtol=0, atol=1e-12 * stroke_um(model))
    # Weights, slopes and the offset enter linearly: there any step is exact. A voltage moves by a hundred-thousandth.
    small_V, any_step = 1e-5 * np.ptp(limits_V(model)), 0.1
    linear = eqx.tree_at(
        lambda p: (p.density.packed_um, p.reversible.slope_um_per_V, p.offset_um),
        at[0],
        replace_fn=lambda x: np.full(x.shape, any_step),
    )
    steps = eqx.tree_at(
        lambda p: [getattr(part, end) for part in (p.density, p.reversible) for end in ("lower_V", "upper_V")],
        linear,
        replace_fn=lambda _: np.asarray(small_V),
    )
    step = flat((steps, np.full(SAMPLES, small_V)))
    expected = central_differences(lambda x: play(*unflat(x, at))[0], flat(at), step)
    np.testing.assert_allclose(matrix(forward), matrix(reverse), rtol=0, atol=1e-12 * np.abs(expected).max())
    off = np.abs(matrix(reverse) - expected).max(axis=0) / np.abs(expected).max()
    # Nothing depends on the range of the reversible part: the density's counts.
    assert off.max() < 1e-8
    assert off[step == any_step].max() < 1e-11


def test_derivatives_are_finite_and_one_at_kinks(rng):
    model = random_model(rng)
    voltage_V = awkward_voltages(model)
    displacement_um, forward, reverse = jacobians(model, voltage_V)
    np.testing.assert_allclose(displacement_um, play(model, voltage_V)[0], rtol=0, atol=1e-12 * stroke_um(model))
    assert np.all(np.isfinite(matrix(forward)))
    np.testing.assert_allclose(matrix(forward), matrix(reverse), rtol=0, atol=1e-12 * np.abs(matrix(forward)).max())
    # Beyond the range the output is flat; at its very end it has the slope of the branch, not half of it.
    in_voltage = np.asarray(forward[1])
    beyond = (voltage_V < limits_V(model)[0]) | (voltage_V > limits_V(model)[1])
    np.testing.assert_array_equal(in_voltage[:, beyond], 0)
    inside_V = np.where(voltage_V == limits_V(model)[1], voltage_V - 1e-9, voltage_V)
    just_inside = np.asarray(jacobians(model, inside_V)[1][1])
    at_end = np.flatnonzero(inside_V != voltage_V)
    np.testing.assert_allclose(in_voltage[at_end, at_end], just_inside[at_end, at_end], rtol=1e-6)
    assert in_voltage[12, 12] > 0.01


def test_a_record_at_rest_has_finite_derivatives(rng):
    model = random_model(rng)
    for rest_V in (*limits_V(model), rng.uniform(*limits_V(model))):
        displacement_um, forward, reverse = jacobians(model, np.full(SAMPLES, rest_V))
        assert np.ptp(displacement_um) == 0
        assert np.all(np.isfinite(matrix(forward)))
        np.testing.assert_allclose(matrix(forward), matrix(reverse), rtol=0, atol=1e-11)


@pytest.mark.study
def test_float32_gradients_of_many_models_and_many_voltages_at_once(rng):
    """Single precision and two nested vmaps below a gradient, against one double precision Jacobian at a time."""
    models = [jax.tree.map(lambda x: np.asarray(x, np.float32), random_model(rng)) for _ in range(2)]
    # Voltages within the range of both, and apart from each other.
    voltages_V = [rng.permutation(np.linspace(5, 60, SAMPLES)).astype(np.float32) for _ in range(3)]
    weight = rng.normal(size=(2, 3, SAMPLES)).astype(np.float32)

    @compiled
    def loss_and_gradient(models, voltages_V):
        def loss(arguments):
            each = jax.vmap(jax.vmap(lambda p, v: p(v), in_axes=(None, 0)), in_axes=(0, None))
            displacement_um = each(*arguments)
            return (displacement_um * weight).sum(), displacement_um

        return jax.value_and_grad(loss, has_aux=True)((models, voltages_V))

    got = loss_and_gradient(jax.tree.map(lambda *x: np.stack(x), *models), np.stack(voltages_V))
    assert {leaf.dtype for leaf in jax.tree.leaves(got)} == {np.dtype(np.float32)}
    (_, displacement_um), (in_models, in_voltages) = got
    expected_in_voltages = np.zeros((3, SAMPLES))
    for i, model in enumerate(models):
        wide = jax.tree.map(lambda x: np.asarray(x, np.float64), model)
        singles = [jacobians(wide, v.astype(np.float64)) for v in voltages_V]
        for j in range(3):
            np.testing.assert_allclose(displacement_um[i, j], singles[j][0], rtol=0, atol=1e-5 * stroke_um(wide))
        expected = sum(weight[i, j] @ matrix(singles[j][2][0]) for j in range(3))
        in_model = flat(jax.tree.map(lambda x, i=i: x[i], in_models))
        np.testing.assert_allclose(in_model, expected, rtol=0, atol=1e-4 * np.abs(expected).max())
        expected_in_voltages += [weight[i, j] @ np.asarray(singles[j][2][1]) for j in range(3)]
    largest = np.abs(expected_in_voltages).max()
    np.testing.assert_allclose(in_voltages, expected_in_voltages, rtol=0, atol=1e-4 * largest)


@pytest.mark.parametrize(
    "read",
    [
        lambda p, v: p(v),
        lambda p, v: jax.jvp(lambda p, v: p(v), (p, v), (p, v))[1],
        lambda p, v: p.everett(v, v[::-1]),
        lambda p, v: p.density(v, v[::-1]),
        lambda p, v: p.reversible(v),
        lambda p, v: p.weights_um,
        lambda p, v: p.density.levels_V,
        lambda p, v: p(v, m.positive_saturation(p.density.lower_V, p.density.upper_V)),
        lambda p, v: p(v, m.demagnetised(p.density.lower_V, p.density.upper_V)),
        lambda p, v: m.remember(v, m.negative_saturation(p.density.lower_V)).end().extremes_V,
    ],
    ids=["call", "jvp", "everett", "density", "reversible", "weights", "levels", "positive", "demagnetised", "end"],
)
def test_everything_read_from_a_float32_model_is_float32(read, rng):
    model = jax.tree.map(lambda x: np.asarray(x, np.float32), random_model(rng))
    assert eqx.filter_eval_shape(read, model, np.zeros(SAMPLES, np.float32)).dtype == np.float32


def test_what_runs_on_an_accelerator_gives_the_same(rng, monkeypatch):
    """Binary lifting and pointer jumping, which a CPU would not choose, through the whole operator."""
    model = random_model(rng)
    voltage_V = np.where(rng.uniform(size=SAMPLES) < 0.5, spread_voltages(rng, model), awkward_voltages(model))
    # An entry that hung from itself would keep pointer jumping busy for ever.
    anchor, _ = jax.jit(_by_lifting)(np.concatenate([np.full(2, limits_V(model)[0]), voltage_V]))
    assert np.all(np.asarray(anchor)[1:] < np.arange(1, SAMPLES + 2))
    cotangent = rng.normal(size=SAMPLES)
    tangent = jax.tree.map(lambda x: rng.normal(size=np.shape(x)), (model, voltage_V))
    expected_um, forward, reverse = jacobians(model, voltage_V)

    @compiled
    def derivatives(model, voltage_V):
        def function(model, voltage_V):
            return model(voltage_V, m.negative_saturation(model.density.lower_V, 2))

        displacement_um, pull = jax.vjp(function, model, voltage_V)
        return displacement_um, pull(cotangent), jax.jvp(function, (model, voltage_V), tangent)[1]

    without_a_cpu(monkeypatch)
    displacement_um, pulled, pushed = derivatives(model, voltage_V)
    np.testing.assert_allclose(displacement_um, expected_um, rtol=0, atol=1e-12 * stroke_um(model))
    expected = cotangent @ matrix(reverse)
    np.testing.assert_allclose(flat(pulled), expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    expected = matrix(forward) @ flat(tangent)
    np.testing.assert_allclose(pushed, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
