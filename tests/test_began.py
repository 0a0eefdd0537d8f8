"""What a driver was still charged with when a record was cut from a drive, which SciPy plays."""

import jax.numpy as jnp
import numpy as np
import pytest
from _models import limits_V, random_model
from scipy.signal import lsim

import microid as m
from fits import Record
from fits.loop._run import prepare_run
from fits.stage._began import as_begun

RATE_Hz, COUNT, PARTS, NOISE = 2000.0, 1500, 4, 1e-4


@pytest.mark.parametrize("share", [-0.2, 0.0, 0.15])
def test_the_voltage_behind_the_driver_is_found(rng, share):
    model, lag_s, natural = random_model(rng, 6), rng.uniform(3e-3, 6e-3), 2 * np.pi * rng.uniform(120, 200)
    lower, upper = limits_V(model)
    span = upper - lower
    stage = m.Stage.of(driver=m.Driver(lag_s), hysteresis=model, mechanics=m.Mechanics(natural / (2 * np.pi), 0.04))
    fine_s = np.arange((COUNT - 1) * PARTS + 1) / RATE_Hz / PARTS
    growing = -np.sin(2 * np.pi * 6 * fine_s) * (0.1 + 0.35 * fine_s / fine_s[-1])
    command_V = lower + span * (0.5 + growing)
    settling_V = share * span * np.exp(-fine_s / lag_s)
    driven_V = command_V[0] + lsim(([1.0], [lag_s, 1.0]), command_V - command_V[0], fine_s)[1] + settling_V
    given_um = np.asarray(model(jnp.asarray(driven_V)))
    rung = lsim(([natural**2], [1.0, 0.08 * natural, natural**2]), given_um - given_um[0], fine_s)[1]
    read_um = given_um[0] + rung[::PARTS]
    read_um += NOISE * np.std(read_um) * rng.standard_normal(COUNT)
    run = prepare_run(
        Record(fine_s[::PARTS], command_V[::PARTS], read_um), (lower, upper), "unknown", 0.0, 2, estimated=True
    )
    [found] = as_begun(stage, [run])
    assert found.charged_V == pytest.approx(share * span, abs=0.02 * span)
    # A record that says so already is left as it is.
    [again] = as_begun(stage, [prepare_run(found, (lower, upper), "unknown", 0.0, 2, estimated=True)])
    assert again.charged_V == pytest.approx(found.charged_V, abs=1e-3 * span)
