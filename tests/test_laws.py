"""Hysteresis laws beside Preisach, each against an independent integration along the path of the voltage."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _models import compiled, without_a_cpu
from _plant_reference import play_positions
from _reference import central_differences
from scipy.integrate import solve_ivp

import microid as m

SAMPLES = 60


@compiled
def play(law, voltage_V, start=None):
    return law(voltage_V, start)


@compiled
def derivatives(law, voltage_V, start):
    def function(law, voltage_V):
        return law(voltage_V, start)

    return jax.jacfwd(function, argnums=(0, 1))(law, voltage_V), jax.jacrev(function, argnums=(0, 1))(law, voltage_V)


def random_laws(rng):
    """One of each law, and a start for it."""
    k = 4
    stiffness = rng.uniform(0.02, 0.05, k)
    return {
        "prandtl": (
            m.hysteresis.PrandtlIshlinskii(
                rng.uniform(0.1, 0.3), rng.uniform(0.02, 0.1, k), rng.uniform(0, 30, k), rng.normal()
            ),
            rng.uniform(-20, 20, k),
        ),
        "maxwell": (
            m.hysteresis.MaxwellSlip(0.4, stiffness, stiffness * rng.uniform(0, 30, k), rng.normal()),
            rng.normal(0, 9, k),
        ),
        "dahl": (m.hysteresis.Dahl(0.4, rng.uniform(1, 3), rng.uniform(8, 20), rng.normal()), rng.uniform(-1, 1, 2)),
        "duhem": (
            m.hysteresis.Duhem(
                rng.uniform(0.02, 0.1), rng.uniform(0.2, 0.4), rng.normal(0, 1e-3), rng.uniform(0, 0.2), rng.normal()
            ),
            rng.normal(size=2),
        ),
        "bouc-wen": (
            m.hysteresis.BoucWen(
                0.4, rng.uniform(0.1, 0.3), 0.03, rng.uniform(-0.01, 0.01), rng.uniform(2, 3), rng.normal(), 64
            ),
            rng.uniform(-1, 1, 2),
        ),
    }


LAWS = ("prandtl", "maxwell", "dahl", "duhem", "bouc-wen")


def integrated(rate, voltage_V, start_V, state):
    """A state along a path of voltages, by adaptive integration to the last digits."""
    out, before = [], start_V
    for voltage in voltage_V:
        if voltage != before:
            sign = np.sign(voltage - before)
            done = solve_ivp(
                lambda u, h, s=sign: rate(u, h, s),
                (before, voltage),
                [state],
                rtol=1e-12,
                atol=1e-13,
                method="DOP853",
            )
            state = done.y[0, -1]
        before = voltage
        out.append(state)
    return np.array(out)


def reference_um(name, law, voltage_V, start):
    p = {field: np.asarray(getattr(law, field)) for field in law.__dataclass_fields__}
    if name == "prandtl":
        plays = play_positions(voltage_V, p["threshold_V"], start)
        return p["offset_um"] + p["slope_um_per_V"] * voltage_V + plays @ p["weight_um_per_V"]
    if name == "maxwell":
        # Elements stretched by every move, and cut at their limits.
        before = float(voltage_V[0])
        held = np.clip(p["stiffness_um_per_V"] * (before - start), -p["limit_um"], p["limit_um"])
        given = []
        for voltage in voltage_V:
            held = np.clip(held + p["stiffness_um_per_V"] * (voltage - before), -p["limit_um"], p["limit_um"])
            before = voltage
            given.append(held.sum())
        return p["offset_um"] + p["slope_um_per_V"] * voltage_V - given
    if name == "dahl":
        state = integrated(lambda u, z, s: (1 - s * z) / p["length_V"], voltage_V, *start)
        return p["offset_um"] + p["slope_um_per_V"] * voltage_V - p["amplitude_um"] * state
    if name == "duhem":

        def curve(u):
            return p["offset_um"] + p["slope_um_per_V"] * u + p["curvature_um_per_V2"] * u**2

        def pursue(u, w, s):
            return p["pursuit_per_V"] * (curve(u) - w) * s + p["local_um_per_V"]

        return integrated(pursue, voltage_V, start[0], curve(start[0]) + start[1])

    def rate(_, h, s):
        turn = p["gamma"] + p["beta"] * np.sign(h * s)
        return p["stiffness_um_per_V"] - np.abs(h) ** p["exponent"] * turn

    return p["offset_um"] + p["slope_um_per_V"] * voltage_V - integrated(rate, voltage_V, *start)


def voltages(rng):
    """Reversals, small moves and rests."""
    mixed = np.where(
        rng.uniform(size=SAMPLES) < 0.3, rng.uniform(-60, 60, SAMPLES), rng.normal(0, 4, SAMPLES).cumsum()
    )
    return np.where(rng.uniform(size=SAMPLES) < 0.2, np.roll(mixed, 1), mixed)


@pytest.mark.parametrize("name", LAWS)
def test_law_is_that_of_an_independent_integration(name, rng):
    law, start = random_laws(rng)[name]
    voltage_V = voltages(rng)
    expected = reference_um(name, law, voltage_V, start)
    limit = 1e-6 if name == "bouc-wen" else 1e-10
    np.testing.assert_allclose(play(law, voltage_V, start), expected, rtol=0, atol=limit * np.ptp(expected))


def test_bouc_wen_converges_at_fourth_order(rng):
    """On a path on which the state keeps its sign, where the rate is smooth."""
    law, _ = random_laws(rng)["bouc-wen"]
    voltage_V, start = np.linspace(0, 60, 7), np.array([0.0, 0.5])
    expected = reference_um("bouc-wen", law, voltage_V, start)
    errors = []
    for substeps in (2, 4, 8):
        coarse = dataclasses.replace(law, substeps=substeps)
        errors.append(np.abs(play(coarse, voltage_V, start) - expected).max())
    assert np.log2(errors[0] / errors[2]) / 2 > 3.5


@pytest.mark.parametrize("name", LAWS)
def test_rate_independence(name, rng):
    """The same path, sampled four times as often, and rests."""
    law, start = random_laws(rng)[name]
    voltage_V = voltages(rng)[: SAMPLES // 4]
    fine_V = np.interp(np.arange(4 * len(voltage_V) - 3) / 4, np.arange(len(voltage_V)), voltage_V)
    coarse_um = play(law, voltage_V, start)
    limit = 1e-6 if name == "bouc-wen" else 1e-12
    np.testing.assert_allclose(play(law, fine_V, start)[::4], coarse_um, rtol=0, atol=limit * np.ptp(coarse_um))


@pytest.mark.parametrize("name", LAWS)
def test_displacement_stays_behind_the_voltage(name, rng):
    """Loops of a piezo: the way up lies below the way down."""
    law, _ = random_laws(rng)[name]
    up_V = np.linspace(-40, 40, 15)
    loop_um = np.asarray(play(law, np.concatenate([up_V, up_V[::-1], up_V, up_V[::-1]])))[30:]
    assert np.mean(loop_um[:15] - loop_um[:14:-1]) < 0


@pytest.mark.parametrize("name", LAWS)
def test_derivatives_are_those_of_finite_differences(name, rng):
    law, start = random_laws(rng)[name]
    # No rests: at them a derivative is one-sided. Nor ties with the start.
    voltage_V = rng.uniform(-50, 50, SAMPLES)
    forward, reverse = derivatives(law, voltage_V, start)
    leaves, treedef = jax.tree.flatten((law, voltage_V))
    flat = np.concatenate([np.ravel(x) for x in leaves])
    splits = np.cumsum([np.size(x) for x in leaves])[:-1]

    def function(x):
        parts = [np.reshape(p, np.shape(leaf)) for p, leaf in zip(np.split(x, splits), leaves, strict=True)]
        return play(*jax.tree.unflatten(treedef, parts), start)

    step = 1e-6 * np.maximum(np.abs(flat), 1e-2)
    expected = central_differences(function, flat, step)
    one, other = (
        np.concatenate([np.reshape(x, (SAMPLES, -1)) for x in jax.tree.leaves(jac)], axis=1)
        for jac in (forward, reverse)
    )
    scale = np.abs(expected).max(axis=0) + 1e-3
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-11 * scale.max())
    # Of an element that only slips nothing depends on its stiffness, but for the rounding of the differences.
    rounding = 4 * np.finfo(float).eps * np.abs(function(flat)).max() / step
    assert np.all(np.abs(one - expected).max(axis=0) < 1e-5 * scale + rounding)


@pytest.mark.parametrize("name", LAWS)
def test_derivatives_are_finite_at_rest_and_in_single_precision(name, rng):
    law, start = random_laws(rng)[name]
    law = jax.tree.map(lambda x: x.astype(jnp.float32), law)
    voltage_V = np.repeat(np.array([0.0, 3.0, 3.0, 0.0]), SAMPLES // 4).astype(np.float32)
    forward, reverse = derivatives(law, voltage_V, start.astype(np.float32) * 0)
    for leaf in jax.tree.leaves((forward, reverse)):
        assert leaf.dtype == np.float32
        assert np.all(np.isfinite(leaf))


def test_the_inverse_of_plays_is_exact(rng):
    law, _ = random_laws(rng)["prandtl"]
    start = play_positions(voltages(rng), np.asarray(law.threshold_V), np.zeros(4))[-1]
    voltage_V = voltages(rng)
    back_V = compiled(lambda law, w, start: law.invert(w, start))(law, play(law, voltage_V, start), start)
    np.testing.assert_allclose(back_V, voltage_V, rtol=0, atol=1e-11)
    reference_um_ = rng.uniform(-20, 20, SAMPLES)
    command_V = compiled(lambda law, w: law.invert(w))(law, reference_um_)
    np.testing.assert_allclose(play(law, command_V), reference_um_, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", LAWS)
def test_what_runs_on_an_accelerator_gives_the_same(name, rng, monkeypatch):
    law, start = random_laws(rng)[name]
    voltage_V = voltages(rng)
    expected = play(law, voltage_V, start)
    without_a_cpu(monkeypatch)
    got = compiled(lambda law, v, start: law(v, start))(law, voltage_V, start)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12 * np.ptp(expected))


def test_parts_of_unequal_lengths_are_refused():
    with pytest.raises(ValueError, match="every play has a weight and a threshold"):
        m.hysteresis.PrandtlIshlinskii(1.0, np.ones(2), np.ones(3))
    with pytest.raises(ValueError, match="every element has a stiffness and a limit"):
        m.hysteresis.MaxwellSlip(1.0, np.ones(2), np.ones(3))
