"""Records that pass through in pieces, against the whole at once."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from _models import random_model

import fits
from fits.io._atomic import write_table
from fits.loop import _moments, _plain
from fits.loop._design import Grid
from fits.loop._moments import gather
from fits.loop._run import prepare_run, simulate_run
from fits.stats import _noise

PIECE, LEVELS, SAMPLES = 64, 6, 2000
responses = eqx.filter_jit(
    lambda grid, columns, voltage_V: [grid.model(one, jnp.zeros(()))(voltage_V) for one in columns]
)


@pytest.fixture
def short_pieces(monkeypatch):
    for module in (_plain, _moments):
        monkeypatch.setattr(module, "PIECE", PIECE)
    monkeypatch.setattr(_moments, "_AT_ONCE", 2)
    monkeypatch.setattr(_moments, "_TOLD", 3)


def record(rng):
    """Sweeps of many samples between two levels, and others of few."""
    turns = np.concatenate([[0.0, 10.0], rng.uniform(0, 10, 40), [0.0]])
    at = np.cumsum(np.r_[0.0, rng.choice([5, 20, 120], len(turns) - 1)])
    voltage_V = np.interp(np.linspace(0, at[-1], SAMPLES), at, turns)
    return fits.Record(np.arange(SAMPLES) * 0.01, voltage_V, voltage_V * 0.3 + rng.normal(0, 0.1, SAMPLES))


def test_moments_of_pieces_are_those_of_all_samples(rng, short_pieces):
    one, grid, told = record(rng), Grid(jnp.asarray(0.0), jnp.asarray(10.0), LEVELS), []
    data = gather(grid, [prepare_run(one, (0.0, 10.0), "negative", 0.2)], progress=told.append)
    dense = np.stack(responses(grid, jnp.eye(grid.columns), jnp.asarray(one.voltage_V)), axis=1)
    fitted = slice(0, round(0.8 * SAMPLES))
    dense, target = dense[fitted], one.displacement_um[fitted]
    label = np.arange(len(target)) * 40 // len(target) % 5
    for moments, inside in [(data.total, label >= 0), *((data.blocks[k], label == k) for k in range(5))]:
        rows, left = dense[inside] - dense[inside].mean(axis=0), target[inside] - target[inside].mean()
        np.testing.assert_allclose(moments.gram, rows.T @ rows, rtol=0, atol=1e-10 * len(rows))
        np.testing.assert_allclose(moments.cross_um, rows.T @ left, rtol=0, atol=1e-10 * np.abs(left).sum())
        np.testing.assert_allclose(float(moments.energy_um2), left @ left, rtol=1e-11)
        assert float(moments.count) == len(left)
    assert len(told) == SAMPLES // (2 * 3 * PIECE)
    assert told[0] == "  384 of 2,000 samples"


def test_a_simulation_in_pieces_is_that_of_the_whole(rng, short_pieces):
    model = random_model(rng)
    low, high = float(model.density.lower_V), float(model.density.upper_V)
    voltage_V = low + record(rng).voltage_V / 10 * (high - low)
    run = prepare_run(fits.Record(np.arange(SAMPLES) * 0.01, voltage_V, None), (low, high), "negative", 1.0)
    assert len(run.path) > 30
    whole = eqx.filter_jit(model)(jnp.asarray(voltage_V))
    np.testing.assert_allclose(simulate_run(model, run), whole, rtol=0, atol=1e-12 * np.ptp(whole))


def test_what_a_very_long_residual_repeats_is_seen_in_some_samples(rng, monkeypatch):
    monkeypatch.setattr(_noise, "_COMPARED", 5000)
    place = rng.uniform(0, 1, 40_000)
    repeated = 0.5 * np.sin(40 * place)
    found = _noise.repeated_square(place, repeated + rng.normal(0, 0.3, len(place)), 1.0)
    assert found == pytest.approx(0.125, rel=0.2)
    assert _noise.repeated_square(place, rng.normal(0, 0.3, len(place)), 1.0) < 0.01


@pytest.mark.parametrize("suffix", ["csv", "npz", "parquet"])
def test_tables_are_read_back_exactly_in_every_format(rng, tmp_path, suffix):
    pytest.importorskip("pyarrow")
    one = record(rng)
    path = tmp_path / f"a.{suffix}"
    write_table(path, {"time_s": one.time_s, "voltage_V": one.voltage_V, "displacement_um": one.displacement_um})
    back = fits.read_table(path)
    for name in ("time_s", "voltage_V", "displacement_um"):
        np.testing.assert_array_equal(getattr(back, name), getattr(one, name))
    with pytest.raises(fits.DataError, match="voltage_V: the result is nan from sample 2"):
        write_table(path, {"time_s": one.time_s[:2], "voltage_V": np.array([0.0, np.nan])})
    assert len(fits.read_table(path)) == SAMPLES
