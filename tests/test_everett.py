"""The Everett surface and the reversible curve against scipy's quadrature of the densities they integrate."""

import itertools

import jax
import numpy as np
import pytest
import scipy.integrate
from _models import LEVELS, compiled, densities_of, limits_V, lost_um, play, random_model, stroke_um

import data_synth as ds
import microid as m


def assert_same(model, got_um, expected_um):
    np.testing.assert_allclose(got_um, expected_um, rtol=0, atol=1e-12 * stroke_um(model))


def test_levels_converge_to_a_smooth_density_at_second_order(rng):
    hill = ds.Bump(bias=rng.uniform(-0.3, 0.3), coercivity=0.2, bias_spread=0.5, coercivity_spread=0.4)
    ridge = ds.Ridge("exponential", width=rng.uniform(0.3, 0.5), slope=0.2, skew=0.4, bend=-0.5)
    smooth = ds.Density.from_shares((hill, ridge), (0.4, 0.6), 20.0, 0.0, 120.0)
    high_V, low_V = np.array([120.0, 97.3, 71.0, 110.0]), np.array([0.0, 12.1, 55.5, 31.7])
    exact_um = [
        scipy.integrate.dblquad(smooth, low, high, lambda b: b, high, epsabs=1e-9, epsrel=1e-9)[0]
        for high, low in zip(high_V, low_V, strict=True)
    ]
    sizes, errors_um = [2 * LEVELS - 1, 4 * LEVELS - 3, 8 * LEVELS - 7], []
    for n in sizes:
        levels_V = np.linspace(0.0, 120.0, n)
        nodes = smooth(levels_V[:, None], levels_V)
        packed_um = (nodes * m.densities.node_areas(n))[np.tril_indices(n)] * 120.0**2
        model = m.Preisach(m.densities.GridDensity(packed_um, 0.0, 120.0), m.Reversible(np.zeros(n), 0.0, 120.0), 0.0)
        errors_um.append(np.linalg.norm(lost_um(model, high_V, low_V) - exact_um))
    order = -np.polyfit(np.log(np.array(sizes) - 1), np.log(errors_um), 1)[0]
    print(f"order {order:.3f}, errors {errors_um} um of 20 um")
    assert 1.7 < order < 2.3


def integrated_um(model, high_V, low_V):
    """The model's own density and slope, cell by cell, by scipy."""
    density = jax.jit(model.density.__call__)
    levels_V = np.asarray(model.density.levels_V)
    total = 0.0
    for i in range(LEVELS - 1):
        alphas = max(levels_V[i], low_V), min(levels_V[i + 1], high_V)
        if alphas[0] >= alphas[1]:
            continue
        for j in range(i + 1):
            betas = max(levels_V[j], low_V), levels_V[j + 1] if j < i else lambda alpha: alpha
            if j < i and betas[0] >= betas[1]:
                continue
            total += scipy.integrate.dblquad(lambda b, a: density(a, b), *alphas, *betas, epsabs=1e-13)[0]
    _, slope = densities_of(model)
    inner = levels_V[(levels_V > low_V) & (levels_V < high_V)]
    edges = np.concatenate([[low_V], inner, [high_V]])
    total += sum(scipy.integrate.quad(slope, a, b, epsabs=1e-13)[0] for a, b in itertools.pairwise(edges))
    return total


def test_everett_surface_is_the_integral_of_the_density(rng):
    model = random_model(rng)
    lower_V, upper_V = limits_V(model)
    low_V, high_V = np.sort(rng.uniform(lower_V, upper_V, (2, 3)), axis=0)
    level_V = float(model.density.levels_V[2])
    high_V = np.append(high_V, [upper_V, level_V + 1.3])
    low_V = np.append(low_V, [lower_V, level_V])
    expected_um = [integrated_um(model, high, low) for high, low in zip(high_V, low_V, strict=True)]
    assert_same(model, lost_um(model, high_V, low_V), expected_um)
    assert expected_um[3] == pytest.approx(stroke_um(model), rel=1e-12)


def test_everett_surface_has_the_density_for_its_mixed_derivative(rng):
    """Second derivatives too are exact within a cell: Newton's method on a branch may use them."""
    model = random_model(rng)
    lower_V, upper_V = limits_V(model)
    low_V, high_V = np.sort(rng.uniform(lower_V, upper_V, (2, 40)), axis=0)

    @compiled
    def derivatives(model, high_V, low_V):
        def in_high(low_V):
            return jax.grad(lambda high_V: model.everett(high_V, low_V).sum())(high_V)

        return jax.jvp(in_high, (low_V,), (np.ones(len(low_V)),))

    in_high, mixed = derivatives(model, high_V, low_V)
    density, slope = densities_of(model)
    expected = [
        sum(scipy.integrate.quad(lambda b: density(high, b), *ends)[0] for ends in itertools.pairwise(betas_V))  # noqa: B023
        for high, low in zip(high_V, low_V, strict=True)
        for betas_V in [np.unique(np.clip(np.append(model.density.levels_V, [low, high]), low, high))]
    ]
    np.testing.assert_allclose(in_high, slope(high_V) + expected, rtol=1e-10)
    np.testing.assert_allclose(mixed, -density(high_V, low_V), rtol=0, atol=1e-10 * density(high_V, low_V).max())


def test_everett_surface_saturates_and_vanishes(rng):
    model = random_model(rng)
    lower_V, upper_V = limits_V(model)
    middle_V = rng.uniform(lower_V, upper_V)
    high_V = np.array([upper_V + 5, middle_V, upper_V + 7, middle_V, lower_V, middle_V])
    low_V = np.array([middle_V, lower_V - 3, lower_V - 1, middle_V, lower_V - 4, upper_V])
    expected_um = lost_um(model, np.clip(high_V, lower_V, upper_V), np.clip(low_V, lower_V, upper_V))
    assert_same(model, lost_um(model, high_V, low_V), expected_um)
    assert_same(model, expected_um[3:], 0)


def test_reversible_part_is_the_integral_of_its_slope(rng):
    model = random_model(rng)
    lower_V, upper_V = limits_V(model)
    levels_V = np.linspace(lower_V, upper_V, LEVELS)
    voltage_V = np.concatenate([rng.uniform(lower_V, upper_V, 20), levels_V, [lower_V - 9, upper_V + 9]])
    _, slope = densities_of(model)
    within_V = np.clip(voltage_V, lower_V, upper_V)
    expected_um = [scipy.integrate.quad(slope, lower_V, v, points=levels_V[1:-1])[0] for v in within_V]
    got_um = compiled(lambda reversible, v: reversible(v))(model.reversible, voltage_V)
    np.testing.assert_allclose(got_um, expected_um, rtol=1e-12, atol=1e-12)
    # At an end it has the slope of the end, not the mean of that and zero.
    derivative = compiled(lambda reversible, v: jax.vmap(jax.grad(reversible))(v))(model.reversible, voltage_V)
    expected = np.where(voltage_V == within_V, slope(voltage_V), 0)
    np.testing.assert_allclose(derivative, expected, rtol=1e-12)


def test_a_major_loop_lies_on_the_everett_surface(rng):
    """Up from the lower end and down from the upper one, straight from Eq. 10."""
    model = random_model(rng)
    lower_V, upper_V = limits_V(model)
    voltage_V = np.linspace(lower_V, upper_V, 60)
    got_um = play(model, np.concatenate([voltage_V, voltage_V[::-1]]))[0] - float(model.offset_um)
    up_um = lost_um(model, voltage_V, lower_V)
    down_um = stroke_um(model) - lost_um(model, upper_V, voltage_V)
    assert_same(model, got_um, np.concatenate([up_um, down_um[::-1]]))
