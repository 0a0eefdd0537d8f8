"""An end stop against SciPy, and a hidden one that is to be found."""

import numpy as np
import pytest
from _parts import BY_NAME, motion, through, wander

import data_synth
import fits
import microid as m


@pytest.mark.parametrize("gain_beyond", [0.5, 0.05, 0.01])
def test_an_end_stop_is_a_spring_on_one_side(rng, gain_beyond):
    # Where the stop is stiff the stage bounces off it: in steps that resolve that.
    finer = min(1.0, 3 * gain_beyond**0.5)
    interval_s, n = 2e-4 * finer, int(400 / finer)
    time, push = interval_s * np.arange(n), wander(rng, n, 5, 30)
    rate, damping, gain = 2 * np.pi * 120, 0.3, 1.2
    stop = 0.8 * gain * np.max(push)
    stiffness = 1 / gain_beyond - 1

    def right_hand(y, w):
        force = gain * w - y[0] - stiffness * max(y[0] - stop, 0.0)
        return [y[1], rate**2 * force - 2 * damping * rate * y[1]]

    rest = min(gain * push[0], stop + gain_beyond * (gain * push[0] - stop))
    truth = motion(time, push, right_hand, np.array([rest, 0.0]))[:, 0]
    mechanics = m.Mechanics(120.0, damping, gain)
    upper = BY_NAME["end_stop", ""](mechanics, stop, gain_beyond)
    found, plain = through(upper, time, push), through(mechanics, time, push)
    assert np.max(plain) > stop
    np.testing.assert_allclose(found, truth, atol=0.03 * np.max(np.abs(truth - plain)))
    # What is below is the same, upside down.
    lower = BY_NAME["end_stop", "lower"](mechanics, -stop, gain_beyond)
    np.testing.assert_allclose(through(lower, time, -push), -found, atol=1e-9)


@pytest.mark.study
def test_a_hidden_end_stop_is_found(rng):
    """One that runs touch often: at the end of the stroke a density follows what is touched for few samples."""
    seed = int(rng.integers(2**31))
    stop = data_synth.EffectSettings("end_stop", {"stop_share": 0.92}, rms_per_noise=8.0)
    bench = data_synth.hidden([stop], seed=seed, slow_samples=1500, fast_samples=2000, hold="first")
    runs = [fits.Record(one.time_s, one.voltage_V, one.displacement_um, source=one.name) for one in bench.records]
    found = fits.diagnose(runs[:2], holdout=runs[2:], budget_s=3600)
    assert found.causes, f"seed {seed}"
    assert found.causes[0].name == "end_stop", f"seed {seed}"
