"""Rigs run in other ways than the bench's: smooth commands, records that begin in the middle, late trouble."""

from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import fftconvolve, lfilter, lsim

from fits import Record, diagnose
from fits.diagnosis._regression import _without_decayed
from fits.diagnosis._thresholds import THRESHOLDS
from fits.loop import _grid as grid
from fits.loop._known import known_samples
from fits.loop._prior import Posterior
from fits.stats._held import held_gain
from fits.stats._noise import Noise
from fits.stats._sensor_noise import Floor, pooled

RATE_Hz, FINE = 1000.0, 16


def plays(voltage_V):
    """Displacement of plays of all widths, as a loop from below leaves them."""
    half_V = np.linspace(0, 50, 500)
    weight = np.exp(-half_V / 15) / np.sum(np.exp(-half_V / 15))
    place, out = np.zeros_like(half_V), np.empty(len(voltage_V))
    for k, voltage in enumerate(voltage_V):
        place = np.minimum(np.maximum(place, voltage - half_V), voltage + half_V)
        out[k] = weight @ place
    return 0.2 * out


def turns(levels, count):
    path = np.r_[0, np.cumsum(np.abs(np.diff(levels)))]
    return np.interp(np.linspace(0, path[-1], count), path, levels)


SLOW_V = turns([0, 100, 0, 80, 20, 100, 40, 70, 30, 90, 0, 60, 10, 100, 0, 50, 5, 75, 25, 100, 0], 2500)


def rig(rng, command, duration_s, noise_um):
    """A record of plays between a driver and a mass on a spring, under a command that is a function of time."""
    fine = np.arange(round(duration_s * RATE_Hz) * FINE + 1) / (RATE_Hz * FINE)
    _, driven, _ = lsim(([1.0], [5e-4, 1.0]), command(fine) - command(0.0), fine)
    static = plays(driven + command(0.0))
    natural = 2 * np.pi * 180
    _, moved, _ = lsim(([natural**2], [1.0, 0.1 * natural, natural**2]), static - static[0], fine)
    reading = (static[0] + moved)[::FINE]
    return Record(
        fine[::FINE], command(fine)[::FINE], reading + noise_um * rng.standard_normal(len(reading)), source="rig.csv"
    )


@pytest.mark.study
def test_a_smooth_command_is_no_effect(rng):
    """Swept sines as a function of time, which lines through their samples cut short."""

    def swept(t):
        rate = 10 + 80 * t
        return 50 - 42 * np.cos(2 * np.pi * 0.5 * t) - 8 * np.sin(2 * np.pi * t * rate)

    records = [Record(np.arange(2500) / 100, SLOW_V, plays(SLOW_V) + 0.01 * rng.standard_normal(2500), source="a")]
    records.append(rig(rng, swept, 2.5, 0.01))
    found = diagnose(records)
    assert found.verdict == "no_effect"
    assert found.baseline.hold == "smooth"
    assert any("along curves" in words for words in found.remarks)
    assert found.noise_um == pytest.approx(0.01, rel=0.1)
    assert found.gain.heldout_rms_before_um < 1.3 * 0.01


@pytest.mark.study
def test_coloured_noise_is_no_misfit(rng):
    """Noise of first order that no idle stretch shows: as if it were white, half of it would be left over."""

    def lines(t):
        return np.interp(t, times_s, levels_V)

    levels_V = np.r_[0, 100, rng.uniform(0, 100, 123), 0]
    times_s = 0.02 * np.arange(len(levels_V))
    records = [Record(np.arange(2500) / 100, SLOW_V, plays(SLOW_V), source="a"), rig(rng, lines, 2.5, 0.0)]
    noise = [lfilter([1.0], [1.0, -0.6], rng.standard_normal(len(r) + 99))[99:] * 0.025 * 0.8 for r in records]
    found = diagnose(
        [replace(r, displacement_um=np.asarray(r.displacement_um) + n) for r, n in zip(records, noise, strict=True)]
    )
    assert found.verdict == "no_effect"
    assert "neighbours are correlated" in found.noise_source
    assert found.noise_um == pytest.approx(0.025, rel=0.4)


@pytest.mark.study
def test_a_stack_in_steps_beside_lines_has_no_effect(rng):
    """A driver and plays, no mass: the fast run is held by its converter, and the slow one runs in lines."""
    held = np.repeat(rng.uniform(0, 100, 300), 8)
    command, lag_s = np.r_[np.zeros(FINE), np.repeat(held, FINE)], rng.uniform(5e-4, 2e-3)
    fine = np.arange(len(command)) / (RATE_Hz * FINE)
    # What a first-order lag makes of steps, exactly: each step of the command begins at a sample.
    share, driven = -np.expm1(-fine[1] / lag_s), np.zeros(len(command))
    for k in range(1, len(command)):
        driven[k] = driven[k - 1] + share * (command[k - 1] - driven[k - 1])
    reading = plays(np.r_[0.0, 100.0, driven])[2:][::FINE]
    count = len(reading)
    slow = np.arange(2499 * FINE + 1) / (100 * FINE)
    _, behind, _ = lsim(([1.0], [lag_s, 1.0]), np.interp(slow, np.arange(2500) / 100, SLOW_V), slow)
    quiet = plays(behind)[::FINE] + 0.01 * rng.standard_normal(2500)
    records = [Record(np.arange(2500) / 100, SLOW_V, quiet, source="slow.csv")]
    noisy = reading + 0.01 * rng.standard_normal(count)
    records.append(Record(fine[::FINE], command[::FINE], noisy, source="steps.csv"))
    found = diagnose(records)
    assert found.verdict == "no_effect"
    assert found.baseline.hold == "zero"
    assert found.baseline.names == ("driver", "hysteresis")
    assert float(found.baseline["driver"].time_constant_s) == pytest.approx(lag_s, rel=0.05)


@pytest.mark.study
def test_a_slow_run_in_lines_beside_one_in_steps_has_no_effect(rng):
    """Beside a stage fitted in one way to both, the readings of the other look late by half a sample."""
    levels_V = np.r_[0, 100, 0, 80, 20, 100, 40, 70, 30, 90, 0, 60, 10, 100, 0]
    slow = rig(rng, lambda t: np.interp(t, 0.3 * np.arange(len(levels_V)), levels_V), 4.2, 0.01)
    held = np.r_[0.0, np.repeat(rng.uniform(0, 100, 300), 8)]
    fine_s, natural = np.arange(len(held) * FINE) / (RATE_Hz * FINE), 2 * np.pi * 180
    driven = lsim(([1.0], [5e-4, 1.0]), np.repeat(held, FINE), fine_s, interp=False)[1]
    moved = lsim(([natural**2], [1.0, 0.1 * natural, natural**2]), plays(driven), fine_s)[1][::FINE]
    noisy = moved + 0.01 * rng.standard_normal(len(held))
    found = diagnose([slow, Record(np.arange(len(held)) / RATE_Hz, held, noisy, source="steps.csv")])
    assert found.verdict == "no_effect"
    assert [run.hold for run in found.details["ready"].baseline.runs] == ["first", "zero"]


@pytest.mark.study
def test_creep_that_was_under_way(rng):
    """The record begins after moves whose creep goes on: the gain is found all the same."""
    before = turns([50, 100, 30, 0], 600)
    voltage = np.concatenate([before, np.zeros(25), SLOW_V])
    static = plays(voltage)
    gain, rate = rng.uniform(0.008, 0.015), 50.0
    age = (np.arange(len(voltage) - 1) + 0.5) / rate
    crept = gain * fftconvolve(np.diff(static), np.log10(1 + age / 0.1))[: len(voltage) - 1]
    reading = static + np.r_[0, crept]
    first = len(before) + 25
    noisy = reading[first:] + 0.003 * rng.standard_normal(len(SLOW_V))
    found = diagnose([Record(np.arange(len(SLOW_V)) / rate, SLOW_V, noisy, source="creep.csv")])
    assert found.causes[0].name == "creep"
    values = {one.name: one for one in found.causes[0].parameters}
    assert not any(name.startswith(("recent", "older", "before")) for name in values)
    if found.causes[0].form == "":
        assert values["gain_per_decade"].value == pytest.approx(gain, rel=0.2)
    # What went on before the record is no part of the stage.
    part = found.extended["creep"]
    assert all(float(getattr(part, name)) == 0 for name in type(part).history)


@pytest.mark.study
def test_what_shows_only_in_what_was_held_out(rng):
    time = np.arange(2500) / 50
    reading = plays(SLOW_V) + 0.005 * rng.standard_normal(2500)
    lost = 2200
    # From there on, readings are one sample early: one was lost.
    reading = np.r_[reading[:lost], reading[lost + 1 :], reading[-1]]
    found = diagnose([Record(time, SLOW_V, reading, source="lost.csv")])
    assert found.causes
    assert "dropped_samples" in {found.causes[0].name, *found.causes[0].also_consistent}
    assert any("what was held out is predicted far worse" in words for words in found.remarks)


def test_creep_under_a_controller(rng):
    """A ramp, and then a hold in which the voltage takes back what would go on; and one that holds the voltage."""
    rate, gain, step = 200.0, rng.uniform(0.005, 0.03), rng.uniform(20, 80)
    hold_s = np.arange(1, 4001) / rate
    voltage = np.r_[np.zeros(100), np.linspace(0, step, 200), step * (1 - gain * np.log10(1 + hold_s / 0.005))]
    place = np.r_[np.zeros(100), np.linspace(0, 10, 200), np.full(4000, 10.0)]
    place = place + 0.003 * rng.standard_normal(len(place))
    record = Record(np.arange(len(place)) / rate, voltage, place, source="held.csv")
    held = held_gain([record])
    assert held.gain_per_decade == pytest.approx(gain, rel=0.05)
    still = replace(record, voltage_V=np.r_[voltage[:300], np.full(4000, step)])
    assert held_gain([still]) is None
    assert held_gain([Record(np.arange(2500) / 50, SLOW_V, plays(SLOW_V), source="free.csv")]) is None


def test_an_unknown_that_has_died_away_is_none():
    time = np.arange(2000) / 1000
    own = np.stack([np.ones(2000), np.exp(-time / 0.02), np.exp(-time / 0.5)], axis=1)
    kept = _without_decayed(own, time > 0.5)
    assert np.any(kept != 0, axis=0).tolist() == [True, False, True]


def test_one_noise_for_one_sensor(rng):
    level = rng.uniform(0.01, 0.1)
    few = [Floor(Noise(level * (1 + 0.5 / n**0.5), np.zeros(0)), n) for n in (200, 20_000)]
    assert few[0].noise.innovation_um != few[1].noise.innovation_um
    same = pooled(few, THRESHOLDS.apart_z)
    assert same[0].noise.innovation_um == same[1].noise.innovation_um == pytest.approx(level, rel=0.01)
    other = [few[0], Floor(Noise(2 * level, np.zeros(0)), 20_000)]
    assert pooled(other, THRESHOLDS.apart_z) == other


def test_an_end_of_the_range_that_peaks_miss_by_a_little():
    path = np.tile([10.0, 50.0, 99.7, 50.0, 0.3, 50.0], 20)
    voltage = np.r_[path, 100.0, 0.0]
    assert known_samples(voltage, 0.0, 100.0).sum() == len(voltage) - 2
    # Where most is known strictly, an end must be met.
    assert known_samples(np.r_[100.0, path], 0.0, 100.0).all()
    assert known_samples(np.r_[99.5, 100.0, path], 0.0, 100.0).sum() == len(path) + 1


def test_a_regression_is_bounded_where_block_pivoting_gives_up(rng, monkeypatch):
    root = rng.standard_normal((60, 12))
    precision, mean = root.T @ root, rng.standard_normal(12)
    posterior = Posterior(jnp.asarray(mean), jnp.asarray(precision), jnp.linalg.cholesky(jnp.asarray(precision)))
    asked = SimpleNamespace(count=0)

    def gives_up(hessian, linear, start, *_):
        asked.count += 1
        return start, False

    monkeypatch.setattr(grid, "pivot_nonnegative", gives_up)
    found, success = grid.non_negative(posterior)
    assert asked.count == 1
    assert success
    slope = precision @ (np.asarray(found) - mean)
    assert np.all(np.asarray(found) >= 0)
    # Karush, Kuhn and Tucker's conditions.
    np.testing.assert_allclose(slope[np.asarray(found) > 0], 0, atol=1e-8)
    assert np.all(slope > -1e-8)


@pytest.mark.study
def test_a_lag_at_two_rates_is_no_hum(rng):
    """Triangles of 20 and 40 Hz, whose third harmonics are lines of 60 Hz mains, at a hundredth of usual noise."""
    lag_s = rng.uniform(4e-4, 7e-4)
    records = []
    for frequency_Hz, duration_s in ((20.0, 0.75), (40.0, 0.5)):
        settled = 3 / frequency_Hz
        fine = np.arange(round((settled + duration_s) * 10_000) * 4) / 40_000
        voltage = 100 * (0.5 + np.arcsin(np.sin(2 * np.pi * frequency_Hz * fine)) / np.pi)
        moved = lsim(([1.0], [lag_s, 1.0]), plays(voltage) - plays(voltage[:1]), fine)[1]
        kept = slice(round(settled * 10_000) * 4, None, 4)
        reading = moved[kept] + 0.001 * rng.standard_normal(len(moved[kept]))
        time = np.arange(len(reading)) / 10_000
        records.append(Record(time, voltage[kept], reading, source=f"triangles_{frequency_Hz:g}_Hz.csv"))
    found = diagnose(records)
    assert [cause.name for cause in found.causes] == ["sensor_lowpass"]
    value = found.causes[0].parameters[0].value
    assert value == pytest.approx(lag_s, rel=0.05)
    assert found.gain.heldout_rms_after_um < 0.1 * found.gain.heldout_rms_before_um
