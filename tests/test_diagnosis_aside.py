"""Runs that are held out whole: what they went through before is as unknown as of those that are fitted."""

from types import SimpleNamespace

import numpy as np
import pytest

import microid as m
from fits import Record
from fits.diagnosis._extension import _with_past
from fits.loop._run import prepare_run

CREEP, CYCLES = (
    next(effect for effect in m.effects.EFFECTS if effect.__name__ == name)
    for name in ("KelvinVoigtCreep", "CyclicError")
)


@pytest.mark.parametrize("initial", ["unknown", "negative"])
def test_what_an_effect_remembers_is_fitted_to_a_run_whose_past_is_unknown(rng, initial):
    time_s, noise_um, past = np.arange(4000) * 1e-3, 0.002, 0.3
    voltage = 50 - 50 * np.cos(3 * time_s)
    plain_um, decay = 0.1 * voltage, np.exp(-time_s / 0.5)
    effect = CREEP(0.02, 0.5)
    (name,) = effect.history
    # A bench whose effect does no more than to remember.
    behind = SimpleNamespace(
        plain=[plain_um], respond_in=lambda _, effects: plain_um + float(getattr(effects[0], name)) * decay
    )
    reading = plain_um + past * decay + 0.7 + noise_um * rng.standard_normal(4000)
    run = prepare_run(Record(time_s, voltage, reading), (0.0, 100.0), initial, 0.0, estimated=True)
    left = _with_past(behind, 0, [effect], run, plain_um, np.ones((4000, 1)))
    if initial == "unknown":
        assert np.std(left) == pytest.approx(noise_um, rel=0.1)
    else:
        # A constant follows what it can of the decay.
        assert np.std(left) == pytest.approx(past * np.std(decay), rel=0.05)


def test_where_a_period_of_the_position_begins_is_fitted_to_a_run_held_out(rng):
    """An offset of the sensor, or an unknown past, moves it; the waves here are NumPy's own."""
    time_s, noise_um, period_um, moved_um = np.arange(4000) * 1e-3, 0.002, 0.3, rng.uniform(0.02, 0.28)
    voltage = 50 - 50 * np.cos(3 * time_s)
    plain_um = 0.1 * voltage

    def waves(position_um):
        turn = 2 * np.pi * position_um / period_um
        return 0.02 * np.cos(turn) - 0.01 * np.sin(2 * turn)

    effect = CYCLES(np.array([0.02, 0.0]), np.array([0.0, -0.01]), np.array(period_um), np.array(0.0))
    behind = SimpleNamespace(
        plain=[plain_um], respond_in=lambda _, effects: plain_um + waves(plain_um - float(effects[0].centre_um))
    )
    reading = plain_um + waves(plain_um + moved_um) + 0.7 + noise_um * rng.standard_normal(4000)
    run = prepare_run(Record(time_s, voltage, reading), (0.0, 100.0), "negative", 0.0)
    left = _with_past(behind, 0, [effect], run, plain_um, np.ones((4000, 1)))
    assert np.std(left) == pytest.approx(noise_um, rel=0.1)
