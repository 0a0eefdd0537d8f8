"""Commands between their samples, against SciPy's splines and a fine integration."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import microid as m


def curves(values, substeps):
    time, finer = m.refined(jnp.asarray(1.0), jnp.asarray(values), substeps, "smooth")
    assert float(time) == pytest.approx(1 / substeps)
    return np.asarray(finer)


def test_a_band_limited_signal_is_found_between_its_samples(rng):
    at = np.arange(300)
    fine = np.arange(299 * 8 + 1) / 8
    waves = [rng.uniform([1, 0.1, 0], [3, 2.5, 6]) for _ in range(4)]
    values, true = (sum(a * np.sin(w * t + phase) for a, w, phase in waves) for t in (at, fine))
    found = curves(values, 8)
    inside = (fine > 20) & (fine < 280)
    off = found - true
    # A sample or two may pass for a corner.
    assert np.mean(np.abs(off[inside]) < 0.01 * np.std(true)) > 0.7
    lines = np.interp(fine, at, values)
    assert np.median(np.abs(off[inside])) < 0.03 * np.median(np.abs((lines - true)[inside]))


def test_few_samples_are_joined_by_a_natural_spline(rng):
    at = np.arange(24)
    values = 3 * np.sin(rng.uniform(0.3, 0.8) * at + rng.uniform(0, 6))
    spline = CubicSpline(at, values, bc_type="natural")(np.arange(23 * 8 + 1) / 8)
    np.testing.assert_allclose(curves(values, 8), spline, atol=1e-6)


def test_steps_and_tips_keep_their_corners(rng):
    steps = np.repeat(rng.uniform(0, 100, 12), 9)
    tips = np.interp(np.arange(300), np.arange(0, 301, 30), rng.uniform(0, 100, 11))
    for values in (steps, tips):
        fine = np.arange((len(values) - 1) * 4 + 1) / 4
        np.testing.assert_allclose(curves(values, 4), np.interp(fine, np.arange(len(values)), values), atol=1e-9)


@pytest.mark.study
def test_a_stage_under_a_smooth_command(rng):
    natural, damping, lag, interval = 2 * np.pi * rng.uniform(150, 250), 0.05, 4e-4, 1e-3
    swept = rng.uniform(300, 400)

    def command(t):
        return 10 * (1 - np.exp(-t / 0.02)) * np.sin(2 * np.pi * (30 * t + swept * t**2))

    def motion(t, y):
        return [(command(t) - y[0]) / lag, y[2], natural**2 * (y[0] - y[1]) - 2 * damping * natural * y[2]]

    time = interval * np.arange(400)
    exact = solve_ivp(motion, (0, time[-1]), [0, 0, 0], t_eval=time, max_step=5e-5, rtol=1e-8, atol=1e-9).y[1]

    def off(hold):
        parts = {"piezo": m.Piezo(1.0), "mechanics": m.Mechanics(natural / (2 * np.pi), damping)}
        stage = m.Stage.of(driver=m.Driver(lag), hold=hold, substeps=8, **parts)
        return np.std(np.asarray(stage(interval, command(time))) - exact) / np.std(exact)

    # Lines through the samples are the worse, the fewer there are in a period.
    assert off("first") > 0.02
    assert off("smooth") < off("first") / 10
