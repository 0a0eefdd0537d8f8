"""A stage with hysteresis inside its mechanics as C: against adaptive integration, and the simulation in JAX."""

import ctypes
import subprocess

import jax.numpy as jnp
import numpy as np
import pytest
from _command import files, refused, run
from _models import LEVELS, compiled
from scipy.integrate import solve_ivp
from test_export_c import COMPILER, STRICT, needs_compiler
from test_laws import random_laws

import fits
import microid as m

T, SAMPLES = 1e-3, 160
TIME_s = np.arange(SAMPLES) * T
PLAIN = "prandtl", "maxwell", "dahl", "duhem"


@compiled
def respond(stage, voltage_V, rest_V):
    return stage(jnp.asarray(T), voltage_V, m.Start(rest_V))


def built(folder, name):
    """The C, compiled as a controller would have it."""
    library = folder / f"{name}.so"
    sources = sorted(map(str, folder.glob("*.c")))
    subprocess.run([COMPILER, *STRICT, "-fPIC", "-shared", *sources, "-lm", "-o", str(library)], check=True)
    return ctypes.CDLL(str(library))


def simulated_um(folder, name, voltage_V, rest_V):
    code, state = built(folder, name), ctypes.create_string_buffer(1 << 16)
    begin, step = getattr(code, f"{name}_init"), getattr(code, f"{name}_step")
    begin.argtypes, begin.restype = [ctypes.c_void_p, ctypes.c_double, ctypes.c_double], ctypes.c_double
    step.argtypes, step.restype = [ctypes.c_void_p, ctypes.c_double], ctypes.c_double
    first, *rest = voltage_V.tolist()
    return np.array([begin(state, rest_V, first), *(step(state, value) for value in rest)])


def program_V(rng):
    phase = rng.uniform(0, 6, 2)
    return 60 * np.sin(2 * np.pi * 35 * TIME_s + phase[0]) + 30 * np.sin(2 * np.pi * 61 * TIME_s + phase[1])


def yielding(rng, law, **around):
    linear = m.Mechanics(rng.uniform(30, 50), rng.uniform(0.03, 0.1), rng.uniform(1, 2))
    return m.Stage.of(
        **around, piezo=m.Piezo(0.2, rng.normal()), mechanics=m.HystereticMechanics(linear, law), substeps=5
    )


@needs_compiler
@pytest.mark.parametrize("hold", ["first", "zero"])
def test_it_moves_as_adaptive_integration_does(rng, tmp_path, hold):
    """A driver that lags, a Bouc-Wen oscillator and a sensor, from rest; a command in lines and one in steps."""
    beta, gamma, stiffness = rng.uniform(0.02, 0.05), rng.uniform(-0.01, 0.01), rng.uniform(0.5, 1.0)
    law = m.hysteresis.BoucWen(0.0, stiffness, beta, gamma, 1.0, 0.0, 1)
    stage = yielding(rng, law, driver=m.Driver(2e-3, 0.8)).append("sensor", m.Sensor(1.1, 3.0))
    driver, piezo, mechanics, _ = stage.parts
    inner = mechanics.inner
    omega, zeta, gain = 2 * np.pi * float(inner.natural_frequency_Hz), float(inner.damping_ratio), float(inner.gain)
    offset_um, voltage_V = float(piezo.offset_um), program_V(rng)
    sent, y = float(driver.gain) * voltage_V[0], gain * (0.2 * 0.8 * voltage_V[0] + offset_um)
    state, expected = [sent, y, 0.0, 0.0], [y]
    for k in range(SAMPLES - 1):
        ends = voltage_V[k : k + 2] if hold == "first" else voltage_V[[k, k]]

        def motion(t, x, ends=ends):
            sent, y, v, h = x
            rate = (0.8 * np.interp(t, [0, T], ends) - sent) / 2e-3
            push = omega**2 * (gain * (0.2 * sent + offset_um) - y - h) - 2 * zeta * omega * v
            return [rate, v, push, stiffness * v - abs(h) * (gamma * v + beta * np.sign(h) * abs(v))]

        state = solve_ivp(motion, (0, T), state, method="LSODA", rtol=1e-10, atol=1e-12).y[:, -1]
        expected.append(state[1])
    expected = 1.1 * np.array(expected) + 3.0
    errors = []
    for substeps in (25, 100):
        name = f"axis{substeps}"
        stage = stage.with_substeps(substeps).with_hold(hold)
        fits.export_simulation_c(stage, tmp_path / name, name, T)
        found = simulated_um(tmp_path / name, name, voltage_V, float(voltage_V[0]))
        errors.append(np.abs(found - expected).max() / np.ptp(expected))
    assert errors[1] < 1e-6
    # Of second order in the step.
    assert errors[1] < errors[0] / 10


def law_of(rng, name):
    """A random law, and a Preisach operator as wide as the motion."""
    if name != "preisach":
        return random_laws(rng)[name][0]
    density = m.densities.GridDensity(rng.exponential(0.03, LEVELS * (LEVELS + 1) // 2), -200.0, 200.0)
    return m.Preisach(density, m.Reversible(np.full(LEVELS, 0.1), -200.0, 200.0), rng.normal())


@needs_compiler
@pytest.mark.parametrize(
    "name", ["bouc-wen", "preisach", *(pytest.param(one, marks=pytest.mark.study) for one in PLAIN)]
)
def test_every_law_is_that_of_jax(rng, tmp_path, name):
    stage = yielding(rng, law_of(rng, name))
    voltage_V, rest_V = program_V(rng), rng.uniform(-20, 20)
    fits.save_model(tmp_path / "stage.json", stage, None, {})
    done = run("export", tmp_path / "stage.json", "--out", tmp_path / "c", "--name", "axis", "--rate", 1 / T)
    assert done.exit_code == 0, done.stderr
    found = simulated_um(tmp_path / "c", "axis", voltage_V, rest_V)
    expected = np.asarray(respond(stage, jnp.asarray(voltage_V), jnp.asarray(rest_V)))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.ptp(expected))


@needs_compiler
def test_what_is_no_number_leaves_the_command_as_it_was(rng, tmp_path):
    fits.export_simulation_c(yielding(rng, law_of(rng, "dahl")), tmp_path, "axis", T)
    held = simulated_um(tmp_path, "axis", np.array([0.0, 30.0, 30.0, 30.0, 10.0]), 0.0)
    broken = simulated_um(tmp_path, "axis", np.array([0.0, 30.0, np.nan, 30.0, 10.0]), 0.0)
    np.testing.assert_array_equal(broken, held)


def test_what_has_no_such_form_is_refused(rng, tmp_path):
    stage = yielding(rng, law_of(rng, "dahl"))
    with pytest.raises(fits.DataError, match="positive interval"):
        fits.export_simulation_c(stage, tmp_path / "c", "axis", 0.0)
    with pytest.raises(fits.DataError, match="name: expected a letter"):
        fits.export_simulation_c(stage, tmp_path / "c", "axis-z", T)
    with pytest.raises(fits.DataError, match="hysteresis inside its mechanics"):
        fits.export_simulation_c(m.Stage.of(piezo=m.Piezo(0.1)), tmp_path / "c", "axis", T)
    inner = m.Stage.of(hysteresis=law_of(rng, "dahl"), mechanics=stage["mechanics"])
    with pytest.raises(fits.DataError, match="Dahl has no form in C"):
        fits.export_simulation_c(inner, tmp_path / "c", "axis", T)
    fits.save_model(tmp_path / "stage.json", stage, None, {})
    export = "export", tmp_path / "stage.json", "--out", tmp_path / "c"
    refused(run(*export), "stage.json", "--rate")
    refused(run(*export, "--rate", 1000, "--limits", "0,10"), "--limits")
    assert files(tmp_path) == ["stage.json"]
    fits.save_model(tmp_path / "stage.json", stage.with_hold("smooth"), None, {})
    assert "lines" in run(*export, "--rate", 1000).stdout
