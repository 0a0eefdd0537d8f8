"""The operator against relays, scipy's quadrature and the laws of Preisach hysteresis."""

import jax.numpy as jnp
import numpy as np
import pytest
from _models import (
    LEVELS,
    PLACES,
    SAMPLES,
    TRACES,
    densities_of,
    limits_V,
    nested_voltages,
    play,
    random_model,
    respond,
    stroke_um,
)
from _reference import play_relays, relay_weights_um

import microid as m

EXACT = 1e-12


def assert_same(model, got_um, expected_um, times=1.0):
    np.testing.assert_allclose(got_um, expected_um, rtol=0, atol=times * EXACT * stroke_um(model))


@pytest.mark.parametrize("refined", [1, 4])
def test_relays_and_operator_agree_exactly_at_the_edges_of_cells(refined, rng):
    """Where a cell is either swept or not and its relays weigh its integral, neither side approximates anything."""
    for _ in range(5):
        model = random_model(rng)
        lower_V, upper_V = limits_V(model)
        cells = refined * (LEVELS - 1)
        weights_um, thresholds_V = relay_weights_um(*densities_of(model), lower_V, upper_V, cells)
        # One cell beyond either end too: there are no relays, and the output saturates.
        voltage_V = lower_V + rng.integers(-1, cells + 2, SAMPLES) * (upper_V - lower_V) / cells
        expected_um = float(model.offset_um) + play_relays(weights_um, thresholds_V, voltage_V)
        assert_same(model, play(model, voltage_V)[0], expected_um)


def test_relays_converge_at_first_order(rng):
    """At any other voltage a staircase of N treads is up to half a tread off."""
    model = random_model(rng)
    voltage_V = nested_voltages(rng, *limits_V(model), 160)
    displacement_um = play(model, voltage_V)[0] - float(model.offset_um)
    sizes, errors_um = [100, 200, 400, 800], []
    for n in sizes:
        weights_um, thresholds_V = relay_weights_um(*densities_of(model), *limits_V(model), n)
        off_um = play_relays(weights_um, thresholds_V, voltage_V) - displacement_um
        errors_um.append(np.sqrt(np.mean(off_um**2)))
    order = -np.polyfit(np.log(sizes), np.log(errors_um), 1)[0]
    print(f"order {order:.3f}, errors {errors_um} um of {stroke_um(model)} um")
    assert 0.8 < order < 1.2
    assert errors_um[-1] < stroke_um(model) / 800


def test_finer_sampling_of_a_path_changes_nothing(rng):
    model = random_model(rng)
    coarse_V = nested_voltages(rng, *limits_V(model), SAMPLES // 16)
    fine_V = np.interp(np.arange(SAMPLES - 15) / 16, np.arange(len(coarse_V)), coarse_V)
    assert_same(model, play(model, fine_V)[0][::16], play(model, coarse_V)[0])


def test_wiping_out(rng):
    """What happens between two remembered extremes is forgotten once the voltage is back."""
    model = random_model(rng)
    lower_V, upper_V = limits_V(model)
    before_V = rng.uniform(lower_V, upper_V, 20)
    low_V, high_V = np.sort(rng.uniform(lower_V, upper_V, 2))
    inner_V = nested_voltages(rng, low_V, high_V, 60)
    after_V = rng.uniform(lower_V, upper_V, 30)
    straight_V = np.concatenate([before_V, [high_V, low_V], after_V])
    detour_V = np.concatenate([before_V, [high_V, low_V], inner_V, [high_V, low_V], after_V])
    assert_same(model, play(model, detour_V)[0][-30:], play(model, straight_V)[0][-30:])


def test_congruency(rng):
    """Loops between the same two voltages have the same shape after any history; only their height differs."""
    model = random_model(rng)
    lower_V, upper_V = limits_V(model)
    low_V, high_V = lower_V + np.array([0.35, 0.6]) * (upper_V - lower_V)
    loop_V = np.concatenate([np.linspace(low_V, high_V, 40), np.linspace(high_V, low_V, 40)])
    below_um, above_um = (
        play(model, np.concatenate([[end_V], loop_V, loop_V]))[0][-80:] for end_V in (lower_V, upper_V)
    )
    assert above_um[0] - below_um[0] > 1e-3 * stroke_um(model)
    assert_same(model, above_um - above_um[0], below_um - below_um[0])


def test_return_point_memory(rng):
    """Back at the voltage where a branch was left, the output is back too, however often that is nested."""
    model = random_model(rng)
    lower_V, upper_V = limits_V(model)
    depth = PLACES // 2 - 2
    cuts_V = np.sort(rng.uniform(lower_V, upper_V, 2 * depth))
    inward_V = np.column_stack([cuts_V[:depth], cuts_V[: -depth - 1 : -1]]).ravel()
    out_um = play(model, np.concatenate([[upper_V], inward_V, inward_V[-2::-1]]))[0][1:]
    assert_same(model, out_um[2 * depth :], out_um[2 * depth - 2 :: -1])


def test_loops_turn_clockwise_and_outputs_rise_with_the_voltage(rng):
    """No weight is negative, so no branch falls where the voltage rises."""
    model = random_model(rng)
    voltage_V = nested_voltages(rng, *limits_V(model), SAMPLES)
    displacement_um = play(model, voltage_V)[0]
    assert np.all(np.diff(displacement_um) * np.diff(voltage_V) >= 0)


def test_initial_states_are_those_of_relays(rng):
    """From the lower end, from the upper end, and after an alternating voltage that decays from edge to edge."""
    model = random_model(rng)
    lower_V, upper_V = limits_V(model)
    swings = (PLACES - 1) // 2
    cells = 2 * swings * (LEVELS - 1)
    cell_V = (upper_V - lower_V) / cells
    weights_um, thresholds_V = relay_weights_um(*densities_of(model), lower_V, upper_V, cells)
    rest = rng.integers(1, cells // swings) * swings
    decay = np.arange(swings + 1)[:, None] / swings * (np.array([0, cells]) - rest) + rest
    starts = {
        "negative": (m.negative_saturation(lower_V, PLACES), [0]),
        "positive": (m.positive_saturation(lower_V, upper_V, PLACES), [cells]),
        "demagnetised": (m.demagnetised(lower_V, upper_V, lower_V + rest * cell_V, PLACES), decay[::-1].ravel()),
    }
    voltage_V = lower_V + rng.integers(0, cells + 1, 100) * cell_V
    for start, before in starts.values():
        expected_um = play_relays(weights_um, thresholds_V, voltage_V, before_V=lower_V + np.asarray(before) * cell_V)
        assert_same(model, play(model, voltage_V, start)[0], float(model.offset_um) + expected_um)


def test_demagnetised_rests_in_the_middle_by_default():
    state = m.demagnetised(-2.0, 10.0, size=PLACES)
    used_V = np.asarray(state.extremes_V)[: int(state.count)]
    assert (used_V[0], used_V[1], used_V[-1]) == (-2.0, 10.0, 4.0)
    # Minima rise to the middle from below and maxima fall to it from above, all by equal steps.
    np.testing.assert_allclose(used_V[:-1:2] + used_V[1::2], 8.0, rtol=1e-14)
    np.testing.assert_allclose(np.diff(used_V[:-1:2]), 6 / ((PLACES - 1) // 2), rtol=1e-13)


def test_a_record_can_be_continued_from_any_sample(rng):
    model = random_model(rng)
    lower_V, upper_V = limits_V(model)
    start = m.demagnetised(lower_V, upper_V, size=13)
    start = m.Staircase(jnp.pad(start.extremes_V, (0, PLACES - 13)), start.count)
    # Steps of a twentieth of the range: ties with old extremes and rests are frequent.
    voltage_V = lower_V + rng.integers(0, 21, SAMPLES) / 20 * (upper_V - lower_V)
    whole_um, _ = play(model, voltage_V, start)
    for first in range(1, SAMPLES, 7):
        part_um, end = play(model, voltage_V[:first], start)
        rest_um, _ = play(model, voltage_V[first:], end)
        assert_same(model, np.concatenate([part_um, rest_um]), whole_um)


def test_too_deep_a_memory_is_nan_and_stays_so(rng):
    model = random_model(rng)
    lower_V, upper_V = limits_V(model)
    left = 0.95 ** np.arange(PLACES + 6)
    inward_V = lower_V + (upper_V - lower_V) * (0.5 + 0.5 * left * np.where(np.arange(len(left)) % 2, -1, 1))
    shown_um, end = play(model, inward_V)
    assert np.all(np.isfinite(shown_um))
    assert np.all(np.isnan(end.extremes_V))
    assert np.all(np.isnan(play(model, voltage_V=np.linspace(lower_V, upper_V, 30), start=end)[0]))
    # A larger staircase at the end holds it.
    _, memory, _ = respond(
        model, jnp.asarray(np.pad(inward_V, (0, SAMPLES - len(inward_V)), mode="edge")), fresh(model)
    )
    assert np.all(np.isfinite(memory.end(size=2 * PLACES).extremes_V))


def fresh(model):
    return m.negative_saturation(model.density.lower_V, PLACES)


def test_new_data_of_the_same_shape_compile_nothing(rng):
    model = random_model(rng)
    play(model, np.linspace(0.0, 60.0, SAMPLES))
    traced = len(TRACES)
    for make in (float, np.asarray, jnp.asarray):
        model = random_model(rng)
        lower_V, upper_V = (make(v) for v in limits_V(model))
        density = m.densities.GridDensity(make_list(model.density.packed_um), lower_V, upper_V)
        model = m.Preisach(
            density, m.Reversible(np.asarray(model.reversible.slope_um_per_V), lower_V, upper_V), make(3.0)
        )
        _, end = play(
            model, nested_voltages(rng, *limits_V(model), SAMPLES), m.positive_saturation(lower_V, upper_V, PLACES)
        )
        play(model, np.zeros(SAMPLES), end)
    assert len(TRACES) == traced


def make_list(packed_um):
    return [float(v) for v in packed_um]


def test_parts_with_differing_levels_are_refused():
    density = m.densities.GridDensity(np.ones(6), 0.0, 1.0)
    with pytest.raises(ValueError, match="3 levels and the reversible part 4"):
        m.Preisach(density, m.Reversible(np.ones(4), 0.0, 1.0), 0.0)
    with pytest.raises(ValueError, match="two levels or more"):
        m.Reversible(np.ones(1), 0.0, 1.0)
    with pytest.raises(ValueError, match="raise its size"):
        m.positive_saturation(0.0, 1.0, size=1)
