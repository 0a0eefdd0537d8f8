"""Anchors, staircases and sums along branches against definitions in plain Python."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _models import compiled, without_a_cpu
from _reference import branches, forest_totals, reduced
from jax import lax

import microid as m
from microid._forest import _down, _down_by_jumping, _up, _up_by_jumping
from microid._memory import _by_lifting, _by_stack
from microid._platform import _by_platform

LENGTH = 60
SEARCHES = {"stack": compiled(_by_stack), "lifting": compiled(_by_lifting)}
SUMS = {"one pass": (_down, _up), "jumping": (_down_by_jumping, _up_by_jumping)}


def paths(rng, length):
    """Paths that start at their minimum: few values, so ties and plateaus; then all different, then monotone."""
    yield np.concatenate([[0], rng.integers(0, 5, length - 1)]).astype(float)
    yield np.concatenate([[0], rng.integers(0, 3, length // 2 + 1).repeat(2)])[:length].astype(float)
    yield np.concatenate([[-1], rng.normal(size=length - 1).cumsum()]).clip(-1)
    yield np.concatenate([[-1], rng.uniform(0, 1, length - 1)])
    yield np.linspace(0, 1, length)
    yield np.concatenate([[0], np.linspace(1, 0, length - 1)])
    yield np.zeros(length)
    yield np.concatenate([[0], np.tile([4.0, 0, 3, 0, 5, 0, 5, 5, 0, 0, 6], length)[: length - 1]])
    yield np.concatenate([[0.0], 1 + 0.9 ** np.arange(length - 1) * (-1) ** np.arange(length - 1)])


@pytest.mark.parametrize("search", SEARCHES)
def test_anchors_are_those_of_the_definition(search, rng):
    for _ in range(10):
        for path in paths(rng, LENGTH):
            anchor, rising = (np.asarray(x) for x in SEARCHES[search](path))
            expected, expected_rising = branches(path)
            # Of several equal extremes any may be named, but never the entry itself or a later one.
            np.testing.assert_array_equal(path[anchor], path[expected])
            assert np.all(anchor[1:] < np.arange(1, LENGTH))
            assert anchor[0] == 0
            np.testing.assert_array_equal(rising, expected_rising)


def test_both_searches_name_the_same_entries(rng):
    """Between equal extremes the derivative has to choose, and must not depend on the machine."""
    for _ in range(20):
        for path in paths(rng, LENGTH):
            anchors = [np.asarray(search(path)[0]) for search in SEARCHES.values()]
            np.testing.assert_array_equal(*anchors)


@pytest.mark.parametrize("search", SEARCHES)
def test_nothing_hangs_from_itself_even_below_the_root_or_where_there_are_no_numbers(search, rng):
    """Pointer jumping would go round for ever."""
    below = rng.integers(-3, 4, LENGTH).astype(float)
    for path in (below, np.full(LENGTH, np.nan), np.where(np.arange(LENGTH) < 9, np.nan, below)):
        anchor = np.asarray(SEARCHES[search](path)[0])
        assert np.all((anchor[1:] >= 0) & (anchor[1:] < np.arange(1, LENGTH)))


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("path", [[1.0], [1.0, 1.0], [1.0, 2.0], [1.0, 1.0, 2.0], [1.0, 2.0, 1.0]])
def test_shortest_paths(search, path):
    anchor, rising = SEARCHES[search](np.array(path))
    expected, expected_rising = branches(np.array(path))
    np.testing.assert_array_equal(anchor, expected)
    np.testing.assert_array_equal(rising, expected_rising)


@compiled
def remembered(voltage_V, start):
    memory = m.remember(voltage_V, start)
    return memory, memory.end(), memory.end(size=LENGTH + 9)


def used(staircase):
    return np.asarray(staircase.extremes_V)[: int(staircase.count)]


def without_repeats(extremes_V):
    return extremes_V[np.append(True, np.diff(extremes_V) != 0)]


def test_the_end_of_a_record_is_its_reduced_memory(rng):
    for path in (*paths(rng, LENGTH + 1), *paths(rng, LENGTH + 1)):
        memory, _, end = remembered(path[1:], m.negative_saturation(path[0], 9))
        assert (memory.lead, memory.path_V.shape) == (9, (LENGTH + 9,))
        expected_V = without_repeats(reduced(path))
        np.testing.assert_array_equal(without_repeats(used(end)), expected_V)
        # Minima below maxima, and each pair within the one before.
        np.testing.assert_array_equal(np.sign(np.diff(expected_V)), (-1.0) ** np.arange(len(expected_V) - 1))
        assert np.all(np.diff(np.abs(np.diff(expected_V))) <= 0) or len(expected_V) < 3
        np.testing.assert_array_equal(np.asarray(end.extremes_V)[int(end.count) :], path[-1])


def test_a_start_is_as_good_as_the_record_that_led_to_it(rng):
    start_V = np.array([0.0, 9.0, 2.0, 7.0, 3.0, 5.0])
    start = m.Staircase(jnp.array([*start_V, 99.0, -99.0, 99.0]), jnp.array(6, dtype=jnp.int32))
    for _ in range(10):
        voltage_V = rng.integers(0, 10, LENGTH).astype(float)
        _, _, end = remembered(voltage_V, start)
        expected_V = without_repeats(reduced(np.concatenate([start_V, voltage_V])))
        np.testing.assert_array_equal(without_repeats(used(end)), expected_V)


def test_as_many_extremes_as_there_are_places_fit_and_one_more_is_nan(rng):
    start = m.negative_saturation(0.0, 9)
    inward_V = np.array([9.0, 1, 8, 2, 7, 3, 6, 4, 5])
    for deep in (8, 9):
        _, end, larger = remembered(np.pad(inward_V[:deep], (0, LENGTH - deep), mode="edge"), start)
        np.testing.assert_array_equal(used(larger), [0, *inward_V[:deep]])
        if deep == 8:
            np.testing.assert_array_equal(used(end), used(larger))
        else:
            assert np.all(np.isnan(end.extremes_V))


def test_starting_staircases():
    negative, positive = m.negative_saturation(-3.0, 4), m.positive_saturation(-3.0, 7.0, 4)
    np.testing.assert_array_equal(used(negative), [-3])
    np.testing.assert_array_equal(used(positive), [-3, 7])
    at_rest = used(m.demagnetised(-3.0, 7.0, 1.0, 9))
    np.testing.assert_allclose(at_rest, [-3, 7, -2, 5.5, -1, 4, 0, 2.5, 1], rtol=0, atol=1e-14)
    for size in (1, 2):
        with pytest.raises(ValueError, match="size"):
            m.demagnetised(-3.0, 7.0, size=size)
    with pytest.raises(ValueError, match="2 extremes do not fit into a staircase of size 1: raise its size"):
        m.positive_saturation(-3.0, 7.0, 1)


def random_forest(rng, n, chain=False):
    back = np.ones(n, dtype=int) if chain else rng.integers(1, 8, n)
    return np.maximum(np.arange(n) - back, 0).astype(np.int32)


@pytest.mark.parametrize("variant", SUMS)
@pytest.mark.parametrize("columns", [(), (3,)])
def test_sums_along_a_forest_and_their_transposes(variant, columns, rng):
    down, up = (compiled(one) for one in SUMS[variant])
    for chain in (False, True):
        anchor = random_forest(rng, LENGTH, chain)
        step = rng.normal(size=(LENGTH, *columns))
        np.testing.assert_allclose(down(anchor, step), forest_totals(step, anchor), rtol=0, atol=1e-12)
        # The transpose of a linear map, from the map of every unit vector.
        matrix = forest_totals(np.eye(LENGTH), anchor)
        np.testing.assert_allclose(up(anchor, step), np.tensordot(matrix.T, step, 1), rtol=0, atol=1e-12)


@pytest.mark.parametrize("variant", SUMS)
def test_forest_sum_is_linear_in_both_modes(variant, rng, monkeypatch):
    if variant == "jumping":
        without_a_cpu(monkeypatch)

    @compiled
    def all_modes(step, anchor, tangent, cotangent):
        total, pushed = jax.jvp(lambda s: m.forest_sum(s, anchor), (step,), (tangent,))
        _, pull = jax.vjp(lambda s: m.forest_sum(s, anchor), step)
        return total, pushed, pull(cotangent)[0]

    anchor = random_forest(rng, LENGTH)
    anchor[0] = rng.integers(LENGTH)  # what stands at the root is ignored
    step, tangent, cotangent = rng.normal(size=(3, LENGTH))
    total, pushed, pulled = all_modes(step, anchor, tangent, cotangent)
    np.testing.assert_allclose(total, forest_totals(step, anchor), rtol=0, atol=1e-12)
    difference = (forest_totals(step + tangent, anchor) - forest_totals(step - tangent, anchor)) / 2
    np.testing.assert_allclose(pushed, difference, rtol=0, atol=1e-12)
    matrix = forest_totals(np.eye(LENGTH), anchor)
    np.testing.assert_allclose(pulled, cotangent @ matrix, rtol=0, atol=1e-12)


def test_memory_carries_no_derivative_but_the_voltages_do(rng):
    voltage_V = rng.uniform(0, 1, LENGTH)

    @compiled
    def slopes(voltage_V):
        def read(voltage_V):
            memory = m.remember(voltage_V, m.negative_saturation(0.0, 9))
            return memory.path_V[memory.anchor], memory.end(LENGTH).extremes_V

        return jax.jacfwd(read)(voltage_V)

    of_anchors, of_end = (np.asarray(x) for x in slopes(voltage_V))
    anchor, _ = branches(np.concatenate([np.zeros(9), voltage_V]))
    expected = np.equal.outer(anchor, np.arange(9, LENGTH + 9)).astype(float)
    np.testing.assert_array_equal(of_anchors, expected)
    assert np.all(of_end.sum(axis=1)[1:] == 1)


def test_on_a_cpu_the_algorithms_of_other_devices_are_not_traced(monkeypatch):
    def refuse(_):
        raise AssertionError("traced")

    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    assert _by_platform(np.ones(3), cpu=lax.neg, default=refuse).tolist() == [-1.0] * 3
    # Where there are other devices the place of the arrays decides.
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with jax.default_device(jax.devices("cpu")[0]):
        found = jax.jit(lambda x: _by_platform(x, cpu=lax.neg, default=lax.abs))(np.ones(3))
    assert found.tolist() == [-1.0] * 3
    with pytest.raises(AssertionError, match="traced"):
        jax.jit(lambda x: _by_platform(x, cpu=lax.neg, default=refuse))(np.ones(3))
