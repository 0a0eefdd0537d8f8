"""Creep, drifts and walls: what went on before the record, against longer records and closed forms."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from _models import random_model
from scipy import interpolate, signal
from test_effects_reference import BY_NAME, through, wander

import microid as m


def test_voltage_creep_is_what_a_controller_takes_back():
    time = 2e-3 * np.arange(20_000)
    step = np.where(time > 0, 50.0, 0.0)
    crept = through(BY_NAME["creep", "voltage"](0.015, 0.1), 2e-3, step) - step
    line = 0.015 * 50 * np.log10(1 + time / 0.1)
    np.testing.assert_allclose(crept[1:], line[1:], atol=0.01 * line[-1])


def test_creep_of_moves_before_the_record(rng):
    """A record that begins in the middle of a longer one, told what was going on."""
    time = 5e-3 * np.arange(4000)
    ago, tau, height = 0.5 * time[-1], rng.uniform(1, 5), rng.uniform(5, 20)
    rest = np.full(len(time), height)
    late = 0.02 * height * np.exp(-ago / tau)
    found = through(BY_NAME["creep", "kelvin_voigt"](0.02, tau, late), 5e-3, rest) - height
    longer = 0.02 * height * (1 - np.exp(-(time + ago) / tau))
    np.testing.assert_allclose(found, longer - longer[0], atol=1e-9)
    older = BY_NAME["creep", ""](0.02, 0.01, 0.0, 0.02 * height, older_s=ago)
    found = through(older, 5e-3, rest) - height
    longer = 0.02 * height * np.log10(1 + (time + ago) / 0.01)
    np.testing.assert_allclose(found, longer - longer[0], atol=2e-3 * height * 0.02)
    warmth = 20 + np.cumsum(rng.standard_normal(len(time))) / 50
    drift = BY_NAME["thermal_drift", "temperature"](0.3, tau)
    whole = through(drift, 5e-3, rest, temperature_degC=warmth)
    cut = len(time) // 2
    # What is still to come of changes so far: those that the lag has not followed yet.
    left = 0.3 * (warmth[cut] - warmth[0]) - (whole[cut] - height)
    second = through(eqx.tree_at(lambda d: d.before_um, drift, left), 5e-3, rest[cut:], temperature_degC=warmth[cut:])
    np.testing.assert_allclose(second - height, whole[cut:] - whole[cut], atol=1e-9)


def test_lags_of_readings_that_begin_while_the_stage_moves():
    """The last part of a longer record of the same motion, in lines between samples."""
    interval, cut = 1e-3, 300
    time = interval * np.arange(600)
    moved = 10 * np.sin(2 * np.pi * 5 * time)
    whole = through(BY_NAME["sensor_lowpass", ""](0.02), interval, moved)
    lag = BY_NAME["sensor_lowpass", ""](0.02, whole[cut] - moved[cut])
    np.testing.assert_allclose(through(lag, interval, moved[cut:]), whole[cut:], atol=1e-9)
    line = 3.0 * time
    delay = BY_NAME["transport_delay", ""](0.0137, 3.0)
    np.testing.assert_allclose(through(delay, interval, line[cut:]), line[cut:] - 3.0 * 0.0137, atol=1e-9)


def test_walls_that_take_their_time(rng):
    model = random_model(rng)
    low, high = float(model.density.lower_V), float(model.density.upper_V)
    command = wander(rng, 400, low + 0.1 * (high - low), high - 0.1 * (high - low))
    lag, onset, late = 0.01 * (high - low), 5.0, 3e-3
    rate = np.gradient(command, 1e-3)
    _, slow, _ = signal.lsim(([1.0], [late, 1.0]), rate - rate[0], 1e-3 * np.arange(400))
    behind = command - lag * np.arcsinh((slow + rate[0]) / onset)
    found = through(BY_NAME["rate_dependence", "activated"](model, lag, onset, late), 1e-3, command)
    walls = through(model, 1e-3, behind, before=command[0])
    slope = np.asarray(model.reversible(jnp.asarray(command)) - model.reversible(jnp.asarray(behind)))
    np.testing.assert_allclose(found, walls + slope, atol=1e-9)


def test_plays_that_widen_with_the_rate_are_relays_that_do(rng):
    """Each of the relays of a fine grid, its half-width wider by what the rate makes it."""
    levels, low, high = 16, -10.0, 110.0
    i, j = np.tril_indices(levels)
    weights = (0.1 + rng.uniform(0, 1) * i + rng.uniform(0, 1) * j) * np.exp(-rng.uniform(0.05, 0.2) * (i - j))
    model = m.Preisach(
        m.densities.GridDensity(weights, low, high), m.Reversible(np.full(levels, 0.1), low, high), 0.0
    )
    command = wander(rng, 400, low + 5, high - 5)
    gain, onset, late, fine = 0.3, 2000.0, 3e-3, 300
    speed = np.abs(np.gradient(command, 1e-3))
    _, slow, _ = signal.lsim(([1.0], [late, 1.0]), speed - speed[0], 1e-3 * np.arange(400))
    wider = 1 + gain * np.log10(1 + (slow + speed[0]) / onset)
    # One relay at random in each cell: those of an even grid would switch many at a time.
    step, cells = (high - low) / fine, np.meshgrid(np.arange(fine), np.arange(fine), indexing="ij")
    area = np.where(np.eye(fine, dtype=bool), 0.5, 1.0)[np.tril_indices(fine)] * step**2
    up, down = (
        low + step * (one[np.tril_indices(fine)] + rng.uniform(0, 1, fine * (fine + 1) // 2)) for one in cells
    )
    up, down = np.maximum(up, down), np.minimum(up, down)
    nodes = np.asarray(model.density.nodes_um_per_V2())
    # Bilinear, also across the diagonal, where the cells that it halves count half.
    whole = nodes + np.tril(nodes, -1).T
    grid = np.linspace(low, high, levels)
    density = interpolate.RegularGridInterpolator((grid, grid), whole)(np.stack([up, down], axis=1))

    def relays(factors):
        centre, half = (up + down) / 2, (up - down) / 2
        on, found = np.zeros(len(up), dtype=bool), []
        for volts, factor in zip([command[0], *command], [1.0, *factors], strict=True):
            on = np.where(volts >= centre + factor * half, True, np.where(volts <= centre - factor * half, False, on))
            found.append(float((density * area)[on].sum()))
        return np.array(found[1:])

    expected = relays(wider) - relays(np.ones(400))
    effect = BY_NAME["rate_dependence", "thresholds"](model, gain, onset, late)
    found = through(effect, 1e-3, command) - through(model, 1e-3, command)
    # Plays are some steps apart, where single samples are off by more.
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.04 * np.max(np.abs(expected))
