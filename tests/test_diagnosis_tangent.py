"""The tangent of a stage with effects that level off, against differences of whole simulations."""

import jax.numpy as jnp
import numpy as np
import pytest

from fits import Record
from fits._design import Grid
from fits._fit_stage import default_stage
from fits._stage_moments import Chain
from fits._stage_run import place_of_hysteresis, prepare_stage_run
from fits._stage_uncertainty import offsets_out
from fits.diagnosis._baseline import Baseline
from fits.diagnosis._evaluate import simulate, with_effects
from fits.diagnosis._regression import regress
from fits.diagnosis._through import passed
from microid.effects.backlash import Backlash
from microid.effects.driver_saturation import DriverSaturation
from microid.effects.slew_limit import SlewLimit
from microid.effects.transport_delay import TransportDelay

LEVELS, RANGE_V = 10, (0.0, 100.0)


def two_runs():
    """A slow decaying loop, and a fast chirp that the mechanics does not follow."""
    slow_s, fast_s = np.linspace(0, 20, 900), np.linspace(0, 0.5, 900)
    slow_V = 50 + 50 * np.cos(2 * np.pi * 0.3 * slow_s) * (1 - 0.03 * slow_s)
    fast_V = 50 + 40 * np.sin(2 * np.pi * (10 + 60 * fast_s) * fast_s)
    return [
        Record(time_s, voltage_V, voltage_V / 10, source=name)
        for name, time_s, voltage_V in (("slow", slow_s, slow_V), ("fast", fast_s, fast_V))
    ]


def baseline_of(rng):
    """A plain stage with a density drawn at random, as no fit has to find it."""
    stage = default_stage()
    grid = Grid(*RANGE_V, LEVELS)
    columns_um = rng.uniform(0.2, 1.0, grid.columns)
    chain = Chain(offsets_out(stage, True), place_of_hysteresis(stage), grid)
    z = np.asarray(chain.coordinates.of(stage))
    runs, fine = (
        tuple(prepare_stage_run(record, RANGE_V, "negative", 0.0, stride) for record in two_runs())
        for stride in (4, 16)
    )
    prior = np.eye(grid.columns)
    return Baseline(chain, z, columns_um, prior, 10.0, RANGE_V, runs, (), runs, (), fine, (), fine, (), True, ())


EFFECTS = {
    "backlash": Backlash(jnp.asarray(0.02), jnp.asarray(0.3)),
    "driver_saturation": DriverSaturation(jnp.asarray(75.0)),
    "slew_limit": SlewLimit(jnp.asarray(6e3)),
}


@pytest.mark.parametrize("name", list(EFFECTS))
def test_the_tangent_goes_through_what_levels_off(name, rng):
    baseline, effect = baseline_of(rng), EFFECTS[name]
    dressed, plain = (regress(baseline, kinds, [own, own]) for kinds, own in ((None, [effect]), ((), [])))
    assert dressed.through == ((effect,), (effect,))
    size, p = len(baseline.columns_um), len(baseline.z)
    # A smooth change of the density, and one of driver and mechanics.
    wave = np.sin(np.linspace(0, rng.uniform(2, 6), size) + rng.uniform(0, 6))
    for dz, dcolumns_um in (
        (np.zeros(p), 1e-4 * baseline.columns_um * wave),
        (1e-5 * rng.standard_normal(p), np.zeros(size)),
    ):
        ahead, behind = (
            [
                simulate(with_effects(baseline.moved(way * dz, way * dcolumns_um).stage, [effect]), run)
                for run in baseline.fine
            ]
            for way in (1, -1)
        )
        truth = np.concatenate([(a - b) / 2 for a, b in zip(ahead, behind, strict=True)])
        said, without = (
            np.linalg.norm(np.concatenate([rows @ np.append(dcolumns_um, dz) for rows in one.rows]) - truth)
            for one in (dressed, plain)
        )
        print(f"off by {said / np.linalg.norm(truth):.4f}, the plain one by {without / np.linalg.norm(truth):.4f}")
        assert said < 0.05 * np.linalg.norm(truth)
        assert said < 0.5 * without


def test_what_is_finer_than_the_grid_goes_through_it_too(rng):
    baseline, effect = baseline_of(rng), EFFECTS["driver_saturation"]
    dressed, plain = (regress(baseline, None, [own, own]) for own in ([effect], []))
    # Nothing moves any more beyond the rail, while it does without.
    slow = baseline.runs[0].record
    above = (slow.voltage_V > 78.0) & np.append(slow.voltage_V[1:] > 78.0, False) & (np.arange(len(slow)) > 20)
    inner = above[1:] & above[:-1]
    still, moving = (np.abs(np.diff(one.finer[0][0], axis=0)[inner]).max() for one in (dressed, plain))
    assert still < 0.05 * moving


def test_only_effects_that_level_off_ahead_of_the_mechanics_are_gone_through():
    late = TransportDelay(jnp.asarray(1e-3))
    assert passed([*EFFECTS.values(), late]) == tuple(EFFECTS.values())
