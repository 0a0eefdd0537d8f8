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


@pytest.mark.parametrize("lag", [(1e-9, 117.0, 0.36), (2e-3, 300.0, 0.01), (1e-3, 120.0, 0.05)])
def test_the_lag_goes_from_one_to_the_other_and_stays_as_long(lag):
    stage = stage_of(*lag)
    other = with_lag_elsewhere(stage)

    def lags_s(one):
        mode = one["mechanics"]
        damped_s = float(mode.damping_ratio) / (np.pi * float(mode.natural_frequency_Hz))
        return np.array([float(one["driver"].time_constant_s), damped_s])

    before, after = lags_s(stage), lags_s(other)
    assert after.sum() == pytest.approx(before.sum(), rel=1e-9)
    assert (before[0] > before[1]) != (after[0] > after[1])
    assert float(other["mechanics"].natural_frequency_Hz) == lag[1]


def test_a_stage_without_both_has_no_other_place():
    stage = stage_of(1e-3, 120.0, 0.05)
    assert with_lag_elsewhere(stage.without("driver")) is None
    assert with_lag_elsewhere(stage.without("mechanics")) is None
    assert with_lag_elsewhere(stage.freeze("mechanics")) is None
