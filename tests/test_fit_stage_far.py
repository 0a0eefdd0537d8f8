"""Few plays between a driver and a mode: a hysteresis read off fast runs is far off, and so is the start of a fit."""

import numpy as np
import pytest
from scipy import signal

import fits
from fits.diagnosis._baseline import fit_baseline
from microid import Driver, Mechanics

RATE_Hz, FINE = 5000.0, 16
LAG_s, NATURAL_Hz, DAMPING = 0.64e-3, 347.0, 0.096


def moved_um(command_V):
    """Fifteen plays behind a lag, ahead of a mode, in steps of a sixteenth of the sampling interval."""
    fine = np.interp(np.arange((len(command_V) - 1) * FINE + 1) / FINE, np.arange(len(command_V)), command_V)
    time_s = np.arange(len(fine)) / (RATE_Hz * FINE)
    lagging = signal.lsim(([1], [LAG_s, 1]), fine - fine[0], time_s)[1] + fine[0]
    radii, play, given = 40 * np.linspace(0.05, 1, 15) ** 2, np.full(15, lagging[0]), np.empty(len(fine))
    for k, value in enumerate(lagging):
        play = np.clip(play, value - radii, value + radii)
        given[k] = 0.04 * value + 0.03 * play.mean()
    rate = 2 * np.pi * NATURAL_Hz
    mode = [rate**2], [1, 2 * DAMPING * rate, rate**2]
    return (signal.lsim(mode, given - given[0], time_s)[1] + given[0])[::FINE]


def walk(rng, count):
    """From end to end of 100 V along the low frequencies of noise, most of it at 4 Hz."""
    noise = signal.sosfiltfilt(signal.butter(2, (1, 7), "bandpass", fs=RATE_Hz, output="sos"), rng.normal(size=count))
    return 0.5 + 99 * (noise - noise.min()) / np.ptp(noise)


def multisine(rng, count, spacing_Hz=0.0):
    """Lines at multiples of a spacing, or wherever they come to lie."""
    time_s = np.arange(count) / RATE_Hz
    lines_Hz = np.r_[21.0, np.geomspace(40, 660, 12)]
    lines_Hz = spacing_Hz * np.round(lines_Hz / spacing_Hz) if spacing_Hz else lines_Hz
    size = np.r_[24.0, np.full(12, 1.0)]
    return 50 + np.cos(2 * np.pi * np.outer(time_s, lines_Hz) + rng.uniform(0, 6.3, 13)) @ size


def taken(rng, spacing_Hz=0.0):
    """A walk and a multisine on the rig."""
    commands = walk(rng, 3000), multisine(rng, 3000, spacing_Hz)
    return [
        fits.Record(np.arange(3000) / RATE_Hz, one, moved_um(one) + 0.003 * rng.normal(size=3000), source=name)
        for one, name in zip(commands, ("walk.csv", "fast.csv"), strict=True)
    ]


def ends_near(rng, spacing_Hz=0.0):
    """Whether the plain fit of a walk and a multisine has the poles of the rig."""
    records = taken(rng, spacing_Hz)
    stage = fit_baseline(records, [], 0.0, "unknown", print).stage
    [driver] = [part for part in stage.parts if isinstance(part, Driver)]
    [mode] = [part for part in stage.parts if isinstance(part, Mechanics)]
    found = float(driver.time_constant_s), float(mode.natural_frequency_Hz), float(mode.damping_ratio)
    print(found)
    return np.allclose(np.array(found) / (LAG_s, NATURAL_Hz, DAMPING), 1, rtol=0, atol=(0.03, 0.01, 0.05))


def test_a_plain_fit_that_is_far_from_noise_begins_again():
    """Of eight rigs this one had come to a driver of 17 ms and a mode of 3 kHz without damping."""
    assert ends_near(np.random.default_rng(8))


def test_a_fit_ends_where_smoothness_and_noise_would_take_turns():
    """Each round weighs the runs by what the last one left of them, which went back and forth for 40 rounds."""
    found = fits.fit_stage(taken(np.random.default_rng(3)), levels=23)
    values = [parameter.value for parameter in found.parameters]
    np.testing.assert_allclose(values, (LAG_s, NATURAL_Hz, DAMPING), rtol=0.01)


def test_most_of_a_run_may_depend_on_a_past_that_nobody_knows():
    """It had been refused: the multisine meets the ends of its range late, and once."""
    found = fits.fit_stage(taken(np.random.default_rng(33)), levels=23)
    assert any("fast.csv: what the rig went through before is unknown and estimated" in one for one in found.remarks)
    assert [one.unknown for one in found.runs][1] == 0
    values = [parameter.value for parameter in found.parameters]
    np.testing.assert_allclose(values, (LAG_s, NATURAL_Hz, DAMPING), rtol=0.01)


@pytest.mark.study
def test_so_do_those_of_fresh_rigs(rng):
    """Of 20 fresh rigs all did; where 98 of 100 do, fewer than six of eight do once in 2,000 runs."""
    # Two periods: where a run first meets its own ends late, hardly a sample is left whose past is known.
    assert sum(ends_near(rng, 2 * RATE_Hz / 3000) for _ in range(8)) >= 6
