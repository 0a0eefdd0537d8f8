"""Hysteresis inside the mechanics: against adaptive integration, and the benchmark's record where it is at hand."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _models import compiled
from _plant_reference import play_positions
from _reference import central_differences
from scipy.integrate import solve_ivp
from scipy.io import loadmat
from test_architecture import ROOT
from test_laws import random_laws

import data_synth
import microid as m
from microid.hysteresis import BoucWen, MaxwellSlip, PrandtlIshlinskii

OFFICIAL = ROOT.parent / "shared" / "data" / "boucwen"
T, SAMPLES = 1e-3, 160


@compiled
def respond(stage, voltage_V):
    return stage(jnp.asarray(T), voltage_V, m.Start(jnp.asarray(0.0)))


@compiled
def step_by_step(law, voltage_V, start):
    state, first = law.init(voltage_V[0], start)
    return first, jax.lax.scan(lambda state, x: law.step(state, x), state, voltage_V[1:])[1]


@pytest.mark.parametrize("name", ["prandtl", "maxwell", "dahl", "duhem", "bouc-wen"])
def test_a_law_by_the_step_is_the_law_along_the_record(name, rng):
    law, start = random_laws(rng)[name]
    voltage_V = np.cumsum(rng.normal(0, 8, 40))
    voltage_V[rng.integers(1, 40, 4)] = voltage_V[3]
    first, rest = step_by_step(law, jnp.asarray(voltage_V), jnp.asarray(start))
    np.testing.assert_allclose(
        np.append(first, rest), compiled(law)(jnp.asarray(voltage_V), start), rtol=0, atol=1e-12
    )


def integrated_um(stage, law_rate, voltage_V):
    """The equation of motion with the law's state beside it, under lines through the samples."""
    piezo, mechanics = stage.parts
    omega = 2 * np.pi * float(mechanics.inner.natural_frequency_Hz)
    zeta, gain = float(mechanics.inner.damping_ratio), float(piezo.gain_um_per_V)
    time_s = np.arange(len(voltage_V)) * T

    def motion(t, x):
        y, v, h = x
        w = gain * np.interp(t, time_s, voltage_V)
        return [v, omega**2 * (w - y - h) - 2 * zeta * omega * v, law_rate(h, v)]

    out, state = [0.0], [0.0, 0.0, 0.0]
    # Corners of the command are no place for an adaptive step.
    for begin, end in itertools.pairwise(time_s):
        done = solve_ivp(motion, (begin, end), state, method="LSODA", rtol=1e-10, atol=1e-12)
        state = done.y[:, -1]
        out.append(state[0])
    return np.array(out)


def test_motion_is_that_of_adaptive_integration(rng):
    beta, gamma = rng.uniform(0.02, 0.05), rng.uniform(-0.01, 0.01)
    stiffness = rng.uniform(0.5, 1.0)
    law = BoucWen(0.0, stiffness, beta, gamma, 1.0, 0.0, 1)
    mechanics = m.HystereticMechanics(m.Mechanics(rng.uniform(30, 50), rng.uniform(0.03, 0.1)), law)
    stage = m.Stage.of(piezo=m.Piezo(0.2), mechanics=mechanics)
    time_s = np.arange(SAMPLES) * T
    voltage_V = 60 * np.sin(2 * np.pi * 35 * time_s) + 30 * np.sin(2 * np.pi * 61 * time_s)

    def rate(h, v):
        return stiffness * v - abs(h) * (gamma * v + beta * np.sign(h) * abs(v))

    expected = integrated_um(stage, rate, voltage_V)
    errors = [
        np.abs(respond(stage.with_substeps(n), jnp.asarray(voltage_V)) - expected).max() / np.ptp(expected)
        for n in (25, 100)
    ]
    assert errors[1] < 1e-6
    # Of second order in the step.
    assert errors[1] < errors[0] / 10


def test_a_spring_that_does_not_yield_is_that_of_linear_mechanics(rng):
    linear = m.Mechanics(rng.uniform(50, 100), rng.uniform(0.01, 0.3))
    stiff = m.HystereticMechanics(linear, MaxwellSlip(0.0, np.full(2, 1e-9), np.ones(2), 0.0))
    stages = [m.Stage.of(piezo=m.Piezo(0.3), mechanics=part) for part in (linear, stiff)]
    voltage_V = jnp.asarray(np.cumsum(rng.normal(0, 5, SAMPLES)))
    expected, found = (respond(stage, voltage_V) for stage in stages)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_at_rest_force_and_spring_are_in_balance(rng):
    law = PrandtlIshlinskii(0.1, rng.uniform(0.05, 0.2, 3), rng.uniform(0, 10, 3), 0.0)
    stage = m.Stage.of(piezo=m.Piezo(0.5), mechanics=m.HystereticMechanics(m.Mechanics(80.0, 0.2), law))
    rest_V = rng.uniform(20, 60)
    still = np.asarray(compiled(stage)(jnp.asarray(T), jnp.full(50, rest_V)))
    assert np.ptp(still) < 1e-9
    plays = play_positions(still[:1], np.asarray(law.threshold_V), np.zeros(3))
    yields = 0.1 * still[0] + float(plays[0] @ np.asarray(law.weight_um_per_V))
    assert still[0] - yields == pytest.approx(0.5 * rest_V, abs=1e-9)


@pytest.mark.study
def test_derivatives_are_those_of_finite_differences(rng):
    voltage_V = jnp.asarray(60 * np.sin(2 * np.pi * 35 * np.arange(60) * T))

    def end_um(values):
        law = BoucWen(0.0, values[0], values[1], values[2], 1.5, 0.0, 1)
        mechanics = m.HystereticMechanics(m.Mechanics(values[3], values[4]), law)
        return m.Stage.of(piezo=m.Piezo(0.2), mechanics=mechanics)(jnp.asarray(T), voltage_V)[-1]

    values = np.array([0.8, 0.03, 0.005, 40.0, 0.05])
    expected = central_differences(compiled(end_um), values, 1e-5 * np.abs(values))
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(compiled(mode(end_um))(jnp.asarray(values)), expected, rtol=1e-5)


def test_the_bench_oscillates_as_adaptive_integration_does(rng):
    oscillator = data_synth.BoucWenOscillator()
    time_s = np.arange(1500) / 15000
    force_N = 40 * np.sin(2 * np.pi * 31 * time_s)
    found = oscillator.respond_m(force_N, 1 / 15000)

    def motion(t, x):
        y, v, z = x
        turn = oscillator.gamma * abs(v) * z + oscillator.delta * v * abs(z)
        force = 40 * np.sin(2 * np.pi * 31 * t) - 10 * v - 5e4 * y - z
        return [v, force / 2, 5e4 * v - 1e3 * turn]

    done = solve_ivp(motion, (0, time_s[-1]), [0, 0, 0], t_eval=time_s, method="LSODA", rtol=1e-10, atol=1e-13)
    # Newmark's rule is of second order: about (omega h)^2 / 12.
    assert np.abs(found - done.y[0]).max() < 1e-4 * np.ptp(done.y[0])


@pytest.mark.study
@pytest.mark.skipif(
    not OFFICIAL.is_dir(), reason="no official record of the Bouc-Wen benchmark beside the repository"
)
def test_the_official_multisine_is_met_by_bench_and_model():
    force_N, official_m = (
        next(v for k, v in loadmat(OFFICIAL / f"{name}val_multisine.mat").items() if k[0] != "_").ravel()
        for name in "uy"
    )
    oscillator = data_synth.BoucWenOscillator()
    bench_m = data_synth.boucwen_response(force_N, oscillator)
    assert np.sqrt(np.mean((bench_m - official_m) ** 2)) < 3e-7

    mechanics = m.Mechanics.from_mass(oscillator.mass_kg, oscillator.stiffness_N_per_m, oscillator.damping_N_s_per_m)
    # The law's state is the hysteretic force over the stiffness, in um.
    law = BoucWen(0.0, 1.0, 1e-6 * oscillator.beta * oscillator.gamma, 1e-6 * oscillator.beta * oscillator.delta)
    stage = m.Stage.of(
        force=m.Piezo(1e6 / oscillator.stiffness_N_per_m),
        mechanics=m.HystereticMechanics(mechanics, law),
        hold="smooth",
        substeps=20,
    )
    twice = compiled(stage)(jnp.asarray(1 / 750), jnp.asarray(np.tile(force_N, 2)), m.Start(jnp.asarray(0.0)))
    assert np.sqrt(np.mean((1e-6 * np.asarray(twice)[8192:] - official_m) ** 2)) < 5e-7
