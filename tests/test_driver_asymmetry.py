"""A driver that charges at another rate than it discharges: against SciPy, and a hidden one that is to be found."""

import numpy as np
import pytest
from _parts import BY_NAME, motion, through, uneven, wander

import data_synth
import fits
import microid as m

TAU_s = 1e-3


@pytest.mark.parametrize("asymmetry", [0.4, -0.7])
def test_a_driver_rises_and_falls_at_its_own_rates(rng, asymmetry):
    time, push = uneven(rng, 200, 4e-4), wander(rng, 200, 0, 100)
    # Jumps between samples are lines, and steps are met within one.
    push = np.where(np.arange(200) % 40 < 20, push, push + 30)
    driver = m.Driver(TAU_s, 2.0)

    def right_hand(v, u):
        return (2 * u - v) / (TAU_s * (1 + asymmetry * np.sign(2 * u - v)))

    truth = motion(time, push, right_hand, 2 * push[:1])[:, 0]
    found = through(BY_NAME["driver_asymmetry", ""](driver, asymmetry), time, push)
    np.testing.assert_allclose(found, truth, atol=1e-4 * np.max(np.abs(truth - through(driver, time, push))))


def test_a_command_that_is_held_is_approached_from_one_side(rng):
    command = np.repeat(rng.uniform(0, 100, 8), 5)
    found = through(BY_NAME["driver_asymmetry", ""](m.Driver(TAU_s, 1.0), 0.5), 3e-4, command, hold="zero")
    expected = [command[0]]
    for held in command[:-1]:
        lag = TAU_s * (1.5 if held > expected[-1] else 0.5)
        expected.append(held + (expected[-1] - held) * np.exp(-3e-4 / lag))
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.study
def test_a_hidden_asymmetry_is_found_and_called_nothing_else(rng):
    """Or left unexplained, as on one rig of five: the lag was put behind the hysteresis, with no driver to ask."""
    seed = int(rng.integers(2**31))
    hidden = data_synth.EffectSettings("driver_asymmetry", {}, rms_per_noise=5.0)
    bench = data_synth.hidden([hidden], seed=seed, slow_samples=1500, fast_samples=2000, hold="first")
    runs = [fits.Record(one.time_s, one.voltage_V, one.displacement_um, source=one.name) for one in bench.records]
    found = fits.diagnose(runs[:2], holdout=runs[2:], budget_s=3600)
    if found.verdict == "unexplained":
        assert any("has no driver" in one for one in found.remarks), f"seed {seed}"
    else:
        assert [cause.name for cause in found.causes] == ["driver_asymmetry"], f"seed {seed}"
