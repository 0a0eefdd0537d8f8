"""A driver's lag and a damped mode delay alike below the resonance: where the fit goes on from."""

import jax.numpy as jnp
import numpy as np
import pytest

from fits.stage._start import with_lag_elsewhere
from microid import Driver, Mechanics, Piezo, Stage


def stage_of(tau_s, natural_Hz, damping):
    mode = Mechanics(jnp.asarray(natural_Hz), jnp.asarray(damping))
    parts = Driver(jnp.asarray(tau_s)), Piezo(jnp.asarray(0.1)), mode
    return Stage(parts, ("driver", "piezo", "mechanics"))


def lags_s(stage):
    mode = stage["mechanics"]
    damped_s = float(mode.damping_ratio) / (np.pi * float(mode.natural_frequency_Hz))
    return np.array([float(stage["driver"].time_constant_s), damped_s])


@pytest.mark.parametrize(
    ("lag", "places"),
    [
        ((1e-9, 117.0, 0.36), ["driver"]),
        ((1e-3, 300.0, 0.005), ["mode"]),
        ((3e-4, 780.0, 0.27), ["driver", "mode"]),
    ],
)
def test_the_lag_goes_where_it_was_not_and_stays_as_long(lag, places):
    stage = stage_of(*lag)
    before, others = lags_s(stage), with_lag_elsewhere(stage)
    assert [("driver", "mode")[int(np.argmax(lags_s(other)))] for other in others] == places
    for other in others:
        after = lags_s(other)
        assert after.sum() == pytest.approx(before.sum(), rel=1e-9)
        assert after.min() < 0.31 * after.sum()
        assert float(other["mechanics"].natural_frequency_Hz) == lag[1]


@pytest.mark.parametrize("lag", [(1e-9, 2.5e8, 4e5), (2e-4, 2.5e8, 0.5), (1e-9, 1e5, 1e-4), (1e-4, 300.0, 0.0)])
def test_a_mode_far_beyond_all_samples_keeps_to_the_bounds(lag):
    """Fits of runs that show no resonance end there: a driver of 0.04 ns had been an error."""
    stage = stage_of(*lag)
    for other in with_lag_elsewhere(stage):
        assert lags_s(other).sum() == pytest.approx(lags_s(stage).sum(), rel=1e-9)
        assert float(other["driver"].time_constant_s) >= 1e-9


def test_a_stage_without_both_has_no_other_place():
    stage = stage_of(1e-3, 120.0, 0.05)
    assert with_lag_elsewhere(stage.without("driver")) == []
    assert with_lag_elsewhere(stage.without("mechanics")) == []
    assert with_lag_elsewhere(stage.freeze("mechanics")) == []
