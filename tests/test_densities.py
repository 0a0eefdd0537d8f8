"""Families of densities against their documented formulas, written out once more in NumPy."""

import pkgutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from _models import LEVELS, compiled
from _reference import interpolated, relay_weights_um

import microid as m
import microid.densities

LOWER_V, UPPER_V = -25.0, 130.0
RANGE_V = UPPER_V - LOWER_V


def node_integrals(levels):
    """Integral of the interpolating function of each node, in units of the range squared."""
    integrals = np.zeros((levels, levels))
    for i in range(levels):
        for j in range(i + 1):
            unit = np.zeros((levels, levels))
            unit[i, j] = 1
            weights, _ = relay_weights_um(
                lambda a, b, unit=unit: interpolated(unit, 0.0, 1.0, a, b), np.zeros_like, 0.0, 1.0, levels - 1
            )
            integrals[i, j] = weights.sum()
    return integrals


def make_grid(rng):
    packed_um = rng.exponential(0.3, LEVELS * (LEVELS + 1) // 2)
    return m.densities.GridDensity(packed_um, LOWER_V, UPPER_V)


def make_mixture(rng):
    k = 3
    return m.densities.MixtureDensity(
        weight_um=rng.uniform(1, 20, k),
        bias=rng.uniform(0, 1, k),
        spread=rng.uniform(0.1, 0.6, k),
        coercivity=rng.uniform(-0.2, 0.3, k),
        width=rng.uniform(0.05, 0.4, k),
        lower_V=LOWER_V,
        upper_V=UPPER_V,
        levels=LEVELS,
    )


def make_network(rng):
    key = jax.random.key(int(rng.integers(2**31)))
    return m.densities.NetworkDensity.start(jnp.array(LOWER_V), jnp.array(UPPER_V), LEVELS, jnp.array(12.0), key)


def grid_nodes(density):
    """Eq. 9 row by row: alpha outer, beta up to alpha inner."""
    weights_um, areas = iter(np.asarray(density.packed_um)), node_integrals(LEVELS)
    nodes = np.zeros((LEVELS, LEVELS))
    for i in range(LEVELS):
        for j in range(i + 1):
            nodes[i, j] = next(weights_um) / (areas[i, j] * RANGE_V**2)
    return nodes


def mixture_nodes(density):
    nodes = np.zeros((LEVELS, LEVELS))
    parameters = [np.asarray(getattr(density, n)) for n in ("weight_um", "bias", "spread", "coercivity", "width")]
    for i in range(LEVELS):
        for j in range(i + 1):
            middle, coercivity = (i + j) / 2 / (LEVELS - 1), (i - j) / 2 / (LEVELS - 1)
            for w, m_k, s_k, c_k, d_k in zip(*parameters, strict=True):
                along = np.exp(-((middle - m_k) ** 2) / (2 * s_k**2))
                nodes[i, j] += w / RANGE_V**2 * along * np.exp(-((coercivity - c_k) ** 2) / (2 * d_k**2))
    return nodes


def network_nodes(density):
    layers = [(np.asarray(layer.weight), np.asarray(layer.bias)) for layer in density.network.layers]
    nodes = np.zeros((LEVELS, LEVELS))
    for i in range(LEVELS):
        for j in range(i + 1):
            alpha, beta = 2 * i / (LEVELS - 1) - 1, 2 * j / (LEVELS - 1) - 1
            x = np.array([alpha + beta, 2 * np.sqrt((alpha - beta) / 2) - 1])
            for weight, bias in layers[:-1]:
                x = np.tanh(weight @ x + bias)
            weight, bias = layers[-1]
            nodes[i, j] = np.logaddexp(0, (weight @ x + bias).item()) * float(density.scale_um) / RANGE_V**2
    return nodes


MAKERS = {"grid": make_grid, "mixture": make_mixture, "network": make_network}
FORMULAS = {"grid": grid_nodes, "mixture": mixture_nodes, "network": network_nodes}


@compiled
def read(density, alpha_V, beta_V):
    return density.nodes_um_per_V2(), density.weights_um, density.levels_V, density(alpha_V, beta_V)


def corners(rng):
    """Points everywhere, on nodes, on the diagonal, below it and beyond the range."""
    levels_V = np.linspace(LOWER_V, UPPER_V, LEVELS)
    alpha_V, beta_V = rng.uniform(LOWER_V - 20, UPPER_V + 20, (2, 200))
    diagonal_V = rng.uniform(LOWER_V, UPPER_V, 20)
    on = np.array([(a, b) for a in levels_V for b in levels_V]).T
    return np.concatenate([alpha_V, diagonal_V, on[0]]), np.concatenate([beta_V, diagonal_V, on[1]])


def test_every_file_of_the_package_is_a_family_with_a_test():
    files = {module.name for module in pkgutil.iter_modules(microid.densities.__path__) if module.name[0] != "_"}
    assert set(m.densities.FAMILIES) == files == set(MAKERS)
    assert {type(make(np.random.default_rng(0))) for make in MAKERS.values()} == set(m.densities.FAMILIES.values())


@pytest.mark.parametrize("family", MAKERS)
def test_density_is_its_formula_interpolated(family, rng):
    density = MAKERS[family](rng)
    alpha_V, beta_V = corners(rng)
    nodes, weights_um, levels_V, values = (np.asarray(x) for x in read(density, alpha_V, beta_V))
    expected = FORMULAS[family](density)
    largest = expected.max()
    np.testing.assert_allclose(nodes, expected, rtol=0, atol=1e-13 * largest)
    assert np.all(nodes[np.tril_indices(LEVELS)] >= 0)
    assert np.all(nodes[np.triu_indices(LEVELS, 1)] == 0)
    np.testing.assert_allclose(levels_V, np.linspace(LOWER_V, UPPER_V, LEVELS), rtol=0, atol=1e-12)
    points = interpolated(nodes, LOWER_V, UPPER_V, alpha_V, beta_V)
    np.testing.assert_allclose(values, points, rtol=0, atol=1e-12 * largest)
    assert np.all(values >= 0)
    assert np.all(values[(alpha_V < beta_V) | (alpha_V > UPPER_V) | (beta_V < LOWER_V)] == 0)
    np.testing.assert_allclose(weights_um, nodes * node_integrals(LEVELS) * RANGE_V**2, rtol=1e-12)


@pytest.mark.parametrize("family", MAKERS)
def test_weights_add_up_to_the_integral_of_the_density(family, rng):
    nodes, weights_um, levels_V, _ = (np.asarray(x) for x in read(MAKERS[family](rng), *corners(rng)))
    total_um = 0.0
    for i in range(LEVELS - 1):
        for j in range(i + 1):
            betas = levels_V[j], levels_V[j + 1] if j < i else lambda alpha: alpha
            total_um += scipy.integrate.dblquad(
                lambda b, a: interpolated(nodes, LOWER_V, UPPER_V, a, b), levels_V[i], levels_V[i + 1], *betas
            )[0]
    assert weights_um.sum() == pytest.approx(total_um, rel=1e-12)


def test_weights_of_a_grid_are_what_was_packed(rng):
    density = make_grid(rng)
    weights_um = np.asarray(read(density, *corners(rng))[1])
    np.testing.assert_allclose(weights_um[np.tril_indices(LEVELS)], density.packed_um, rtol=1e-14)
    np.testing.assert_allclose(m.densities.node_areas(LEVELS), node_integrals(LEVELS), rtol=1e-13, atol=1e-16)
    assert m.densities.node_areas(2).sum() == pytest.approx(0.5)


@pytest.mark.parametrize("family", MAKERS)
def test_derivatives_of_the_nodes_are_central_differences(family, rng):
    whole = MAKERS[family](rng)
    density, structure = jax.tree.flatten(whole)
    arrays = [np.asarray(x) for x in density if hasattr(x, "dtype")]
    tangent = [rng.normal(size=x.shape) for x in arrays]
    cotangent = rng.normal(size=(LEVELS, LEVELS))

    def with_arrays(values):
        values = iter(values)
        return jax.tree.unflatten(structure, [next(values) if hasattr(x, "dtype") else x for x in density])

    @compiled
    def all_modes(arrays, tangent):
        def function(arrays):
            return with_arrays(arrays).nodes_um_per_V2()

        nodes, pushed = jax.jvp(function, (arrays,), (tangent,))
        return nodes, pushed, jax.vjp(function, arrays)[1](cotangent)[0]

    step = 1e-5
    ahead, behind = (
        all_modes([x + s * t for x, t in zip(arrays, tangent, strict=True)], tangent)[0] for s in (step, -step)
    )
    _, pushed, pulled = all_modes(arrays, tangent)
    expected = (np.asarray(ahead) - np.asarray(behind)) / (2 * step)
    np.testing.assert_allclose(pushed, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    inner = sum(float(np.sum(p * t)) for p, t in zip(pulled, tangent, strict=True))
    assert inner == pytest.approx(float(np.sum(cotangent * np.asarray(pushed))), rel=1e-9, abs=1e-12)
    assert all(np.all(np.isfinite(p)) for p in pulled)


@pytest.mark.parametrize("family", MAKERS)
def test_a_fit_can_start_from_a_drawn_density(family, rng):
    keys = [jax.random.key(int(k)) for k in rng.integers(2**31, size=2)]
    start = m.densities.FAMILIES[family].start
    drawn = [start(jnp.array(LOWER_V), jnp.array(UPPER_V), LEVELS, jnp.array(12.0), key) for key in keys]
    weights_um = [np.asarray(read(density, *corners(rng))[1]) for density in drawn]
    assert (drawn[0].levels, float(drawn[0].lower_V), float(drawn[0].upper_V)) == (LEVELS, LOWER_V, UPPER_V)
    # Of the size of the stroke: within a factor of ten, whatever was drawn.
    assert all(np.all(w >= 0) and 0.1 < w.sum() / 12 < 10 for w in weights_um)
    if family == "grid":
        assert weights_um[0].sum() == pytest.approx(12)
    assert np.array_equal(*weights_um) == (family == "grid")


@pytest.mark.parametrize("count", [0, 1, 2, 4, 5, 7])
def test_weights_that_fill_no_triangle_are_refused(count):
    with pytest.raises(ValueError, match=f"{count} weights fill no triangle"):
        m.densities.GridDensity(np.ones(count), LOWER_V, UPPER_V)


def test_families_are_registered_under_the_names_of_their_files():
    def family(name, module):
        return type("Some", (), {"family": name, "__module__": f"elsewhere.{module}"})

    before = dict(m.densities.FAMILIES)
    with pytest.raises(ValueError, match=r"Some.family is 'one', but its file is called 'other'"):
        microid.densities.register(family("one", "other"))
    with pytest.raises(ValueError, match="its file is called 'nameless'"):
        microid.densities.register(type("Some", (), {"__module__": "nameless"}))
    with pytest.raises(ValueError, match="'grid' is defined twice"):
        microid.densities.register(family("grid", "grid"))
    assert before == m.densities.FAMILIES
    new = family("one", "one")
    try:
        assert microid.densities.register(new) is new
        assert m.densities.FAMILIES["one"] is new
    finally:
        m.densities.FAMILIES.pop("one", None)
