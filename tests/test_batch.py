"""Many stages at once give what each gives by itself."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import microid as m
from microid._batch import _mapped


def stages_of(rng, rows, hold, shared):
    """Stages as rows of their arrays, whose hysteresis differs from row to row or is one for all."""

    def law():
        density = m.densities.GridDensity(rng.uniform(0, 1, 15), 0.0, 100.0)
        return m.Preisach(density, m.Reversible(rng.uniform(0, 0.1, 5), 0.0, 100.0), rng.uniform(-1, 1))

    def joined(parts):
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)

    drivers = [m.Driver(rng.uniform(1e-3, 3e-3)) for _ in range(rows)]
    masses = [m.Mechanics(rng.uniform(60, 90), rng.uniform(0.05, 0.3)) for _ in range(rows)]
    laws = joined([law() for _ in range(1 if shared else rows)])
    return m.Stage((joined(drivers), laws, joined(masses)), ("driver", "law", "mechanics"), hold)


@pytest.mark.parametrize(("hold", "shared"), [pytest.param("first", True, marks=pytest.mark.study), ("zero", False)])
def test_rows_are_those_of_stages_by_themselves(rng, hold, shared):
    stages, voltage = stages_of(rng, 3, hold, shared), jnp.asarray(rng.uniform(0, 100, (3, 40)).cumsum(axis=1) % 100)
    memory = m.demagnetised(0.0, 100.0, size=9) if shared else None
    found = jax.jit(m.respond_all)(stages, 1e-3, voltage, memory)
    for row in range(3):
        own = jax.tree.map(lambda leaf, row=row: leaf[row if leaf.shape[0] > 1 else 0], stages)
        alone = eqx.filter_jit(own)(jnp.asarray(1e-3), voltage[row], m.Start(memory=memory))
        np.testing.assert_allclose(found[row], alone, rtol=0, atol=1e-11)


@pytest.mark.study
def test_rows_may_differ_in_the_offset_alone(rng):
    stages, voltage = stages_of(rng, 1, "first", True), jnp.asarray(rng.uniform(0, 100, (2, 20)))
    offsets = jnp.asarray(rng.uniform(-1, 1, 2))
    moved = eqx.tree_at(lambda stages: stages.parts[1].offset_um, stages, offsets)
    respond = jax.jit(m.respond_all)
    plain = respond(stages, 1e-3, voltage) - float(stages.parts[1].offset_um[0])
    np.testing.assert_allclose(respond(moved, 1e-3, voltage), plain + offsets[:, None], rtol=0, atol=1e-11)


def test_other_parts_are_mapped_over_the_rows(rng):
    law = m.hysteresis.Dahl(*(jnp.asarray(rng.uniform(0.1, 1.0, 2)) for _ in range(4)))
    voltage = jnp.asarray(rng.uniform(0, 10, (2, 30)))
    found = jax.jit(m.respond_all)(m.Stage((law,), ("law",)), 1e-3, voltage)
    for row in range(2):
        own = jax.tree.map(lambda leaf, row=row: leaf[row], law)
        alone = eqx.filter_jit(own)(jnp.append(voltage[row, 0], voltage[row]))
        np.testing.assert_allclose(found[row], alone[1:], rtol=1e-12)


@pytest.mark.study
def test_derivatives_are_those_of_stages_by_themselves(rng):
    stages, voltage = stages_of(rng, 2, "first", False), jnp.asarray(rng.uniform(10, 90, (2, 20)))

    def slope(respond):
        return jax.jit(jax.grad(lambda voltage: jnp.sum(respond(stages, jnp.asarray(1e-3), voltage, None)[:, -1])))

    found = slope(m.respond_all)(voltage)
    # What runs where there is no CPU.
    np.testing.assert_allclose(found, slope(_mapped)(voltage), rtol=1e-9, atol=1e-12)
