"""The exact inverse, against the operator it inverts, plain relays and finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _models import (
    PLACES,
    SAMPLES,
    compiled,
    densities_of,
    ends_um,
    flat,
    limits_V,
    matrix,
    nested_voltages,
    play,
    random_model,
    starts,
    stroke_um,
)
from _reference import central_differences, invert_relays, relay_weights_um

import microid as m

TRACES: list[str] = []
FEW = 14


@compiled
def inverted(model, reference_um, start):
    TRACES.append("inverted")
    return m.invert(model, reference_um, start)


def nested_references(rng, model):
    """Reversals, small moves, rests and both ends."""
    reference_um = nested_voltages(rng, *ends_um(model), SAMPLES)
    reference_um[rng.integers(SAMPLES, size=6)] = ends_um(model)[0]
    reference_um[rng.integers(SAMPLES, size=6)] = ends_um(model)[1]
    return reference_um


@pytest.mark.parametrize("state", ["negative", "positive", "demagnetised"])
def test_the_output_is_the_reference(rng, state):
    for _ in range(3):
        model = random_model(rng)
        start, reference_um = starts(model, size=PLACES)[state], nested_references(rng, model)
        found = inverted(model, reference_um, start)
        assert np.all(found.reachable)
        np.testing.assert_allclose((found.lowest_um, found.highest_um), ends_um(model), rtol=1e-12, atol=1e-12)
        output_um, end = play(model, found.voltage_V, start)
        np.testing.assert_allclose(output_um, reference_um, rtol=0, atol=1e-12 * stroke_um(model))
        rests = np.diff(reference_um) == 0
        assert rests.any()
        np.testing.assert_array_equal(np.diff(found.voltage_V)[rests], 0)
        # Both staircases say the same of what follows.
        probe_V = rng.uniform(*limits_V(model), SAMPLES)
        np.testing.assert_allclose(
            play(model, probe_V, found.end)[0], play(model, probe_V, end)[0], rtol=0, atol=1e-12 * stroke_um(model)
        )


@pytest.mark.parametrize("state", ["negative", "positive", "demagnetised"])
def test_the_inverse_of_a_displacement_is_its_voltage(rng, state):
    model = random_model(rng)
    lower_V, upper_V = limits_V(model)
    voltage_V = nested_voltages(rng, lower_V, upper_V, SAMPLES)
    voltage_V[rng.integers(SAMPLES, size=12)] = np.repeat([lower_V, upper_V], 6)
    start = starts(model, size=PLACES)[state]
    displacement_um, _ = play(model, voltage_V, start)
    found = inverted(model, displacement_um, start)
    # Even where the output at an end differs from the end by its last digit.
    assert np.all(found.reachable)
    np.testing.assert_allclose(found.voltage_V, voltage_V, rtol=0, atol=1e-11 * (upper_V - lower_V))


def test_it_goes_on_where_it_ended(rng):
    model = random_model(rng)
    reference_um, start = nested_references(rng, model), starts(model, size=PLACES)["demagnetised"]
    whole = inverted(model, reference_um, start)
    # The second half of the first record is filled with its last value, which moves nothing.
    cut = int(rng.integers(20, SAMPLES - 20))
    first = inverted(model, np.where(np.arange(SAMPLES) < cut, reference_um, reference_um[cut - 1]), start)
    second = inverted(model, np.append(reference_um[cut:], np.full(cut, reference_um[-1])), first.end)
    voltage_V = np.append(first.voltage_V[:cut], second.voltage_V[: SAMPLES - cut])
    np.testing.assert_allclose(voltage_V, whole.voltage_V, rtol=0, atol=1e-11 * np.ptp(limits_V(model)))


def test_plain_relays_need_the_same_voltages(rng):
    model = random_model(rng)
    # Reversals far apart: what a cell is off at one shows in all that hangs from it.
    reference_um = np.interp(np.linspace(0, 8, SAMPLES), np.arange(9), rng.uniform(*ends_um(model), 9))
    found = inverted(model, reference_um, starts(model, size=PLACES)["negative"])
    relays = 240
    weights_um, thresholds_V = relay_weights_um(*densities_of(model), *limits_V(model), relays)
    expected_V = invert_relays(weights_um, thresholds_V, reference_um - float(model.offset_um))
    np.testing.assert_allclose(found.voltage_V, expected_V, rtol=0, atol=4 * np.ptp(limits_V(model)) / relays)


def test_what_is_out_of_reach_is_flagged_and_clipped(rng):
    model = random_model(rng)
    lowest_um, highest_um = ends_um(model)
    reference_um = nested_references(rng, model)
    low, high, odd = rng.permutation(SAMPLES)[:18].reshape(3, 6)
    reference_um[low] = lowest_um - rng.exponential(1, 6) - 1e-6
    reference_um[high] = highest_um + rng.exponential(1, 6) + 1e-6
    found = inverted(model, reference_um, starts(model, size=PLACES)["negative"])
    np.testing.assert_array_equal(found.reachable, ~np.isin(np.arange(SAMPLES), [*low, *high]))
    np.testing.assert_allclose(found.voltage_V[low], limits_V(model)[0], rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.voltage_V[high], limits_V(model)[1], rtol=0, atol=1e-10)
    clipped_um = np.clip(reference_um, lowest_um, highest_um)
    np.testing.assert_allclose(play(model, found.voltage_V)[0], clipped_um, rtol=0, atol=1e-12 * stroke_um(model))
    reference_um[odd] = np.nan
    found = inverted(model, reference_um, starts(model, size=PLACES)["negative"])
    assert not np.any(found.reachable[odd])
    assert np.all(np.isnan(found.voltage_V[odd]))


@compiled
def jacobians(model, reference_um):
    def voltage(model, reference_um):
        return m.invert(model, reference_um).voltage_V

    return [jac(voltage, argnums=(0, 1))(model, reference_um) for jac in (jax.jacfwd, jax.jacrev)]


def spread_references(rng, model):
    """Displacements of voltages that keep their distance from each other, from the levels and from the ends."""
    lower_V, upper_V = limits_V(model)
    voltage_V = lower_V + (upper_V - lower_V) * (rng.permutation(FEW) + rng.uniform(0.2, 0.8, FEW)) / FEW
    return play(model, voltage_V)[0]


@pytest.mark.study
def test_both_modes_agree_with_central_differences(rng):
    model = random_model(rng, levels=4)
    at = (model, spread_references(rng, model))
    forward, reverse = jacobians(*at)
    leaves, treedef = jax.tree.flatten(at)
    sizes = np.cumsum([np.size(leaf) for leaf in leaves])[:-1]

    def voltage(vector):
        parts = [np.reshape(p, np.shape(leaf)) for p, leaf in zip(np.split(vector, sizes), leaves, strict=True)]
        model, reference_um = jax.tree.unflatten(treedef, parts)
        reference_um = np.pad(reference_um, (0, SAMPLES - FEW), mode="edge")
        start = m.negative_saturation(model.density.lower_V, PLACES)
        return np.asarray(inverted(model, reference_um, start).voltage_V)[:FEW]

    expected = central_differences(voltage, flat(at), np.maximum(1e-6 * np.abs(flat(at)), 1e-6))
    largest = np.abs(expected).max(axis=0, keepdims=True) + 1e-3
    assert np.abs((matrix(forward) - expected) / largest).max() < 1e-6
    assert np.abs((matrix(forward) - matrix(reverse)) / largest).max() < 1e-10
    assert np.linalg.norm(expected[:, -FEW:]) > 1


def test_second_derivatives_agree_with_differences_of_the_first(rng):
    model = random_model(rng, levels=3)
    reference_um = spread_references(rng, model)[:5]
    weight = rng.normal(size=5)
    count = model.density.packed_um.size

    def loss(vector):
        changed = eqx.tree_at(lambda p: p.density.packed_um, model, vector[:count])
        return (
            weight @ m.invert(changed, vector[count:], m.negative_saturation(model.density.lower_V, 4)).voltage_V ** 2
        )

    at = jnp.append(model.density.packed_um, reference_um)
    along = rng.normal(size=at.size)

    @compiled
    def second(at):
        return jax.jvp(jax.grad(loss), (at,), (along,))

    curved = second(at)[1]
    expected = central_differences(lambda h: second(at + h[0] * along)[0], np.zeros(1), [1e-5])[:, 0]
    np.testing.assert_allclose(curved, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


@pytest.mark.study
def test_derivatives_at_rests_and_ends_are_finite(rng):
    model = random_model(rng, levels=4)
    lowest_um, highest_um = ends_um(model)
    share = np.array([0, 0, 0.4, 0.4, 0.2, 0.4, 0.2, 0.2, 1, 1, 0.5, 1, 0, 1])
    assert len(share) == FEW
    forward, reverse = jacobians(model, lowest_um * (1 - share) + highest_um * share)
    assert np.all(np.isfinite(matrix(forward)))
    np.testing.assert_allclose(matrix(forward), matrix(reverse), rtol=0, atol=1e-9 * np.abs(matrix(forward)).max())
    # Not lost at the very ends.
    assert np.all(np.diagonal(np.asarray(forward[1]))[[2, 8, 11, 12]] > 0.01)


def test_float32_and_many_models_and_references_at_once(rng):
    models = [random_model(rng) for _ in range(2)]
    references_um = np.stack([[nested_references(rng, model) for _ in range(3)] for model in models])
    narrow = [jax.tree.map(lambda x: np.asarray(x, np.float32), model) for model in models]
    stacked = jax.tree.map(lambda *x: np.stack(x), *narrow)
    found = compiled(jax.vmap(jax.vmap(m.invert, in_axes=(None, 0))))(stacked, references_um.astype(np.float32))
    assert found.voltage_V.dtype == found.end.extremes_V.dtype == np.float32
    for i, model in enumerate(models):
        for j in range(3):
            output_um, _ = play(model, np.asarray(found.voltage_V[i, j], np.float64))
            np.testing.assert_allclose(output_um, references_um[i, j], rtol=0, atol=1e-5 * stroke_um(model))


def test_other_numbers_compile_nothing_new(rng):
    inverted(*(lambda p: (p, nested_references(rng, p), starts(p, size=PLACES)["negative"]))(random_model(rng)))
    before = len(TRACES)
    for state in ("positive", "negative"):
        model = random_model(rng)
        inverted(model, nested_references(rng, model), starts(model, size=PLACES)[state])
    assert len(TRACES) == before


def test_a_memory_that_is_too_small_says_so(rng):
    model = random_model(rng)
    lowest_um, highest_um = ends_um(model)
    swings = np.where(np.arange(SAMPLES) % 2, 0.99, -0.99) * np.linspace(0.5, 0.1, SAMPLES)
    reference_um = (lowest_um + highest_um) / 2 + swings * (highest_um - lowest_um)
    found = inverted(model, reference_um, starts(model, size=PLACES)["negative"])
    assert np.all(np.isfinite(found.voltage_V))
    assert np.all(np.isnan(found.end.extremes_V))
    assert np.all(np.isnan(inverted(model, nested_references(rng, model), found.end).voltage_V))
