"""Readings that repeat the one before them: found, and only where samples were lost."""

from dataclasses import replace

import numpy as np
import pytest
from _wrong_records import said
from scipy.signal import lfilter, sawtooth

import fits
from fits.loop._lost import repeated, without_lost

N, RATE_Hz = 4000, 1000.0


def moving(rng, noise_um=5e-3, digit_um=1e-6, stroke_um=20.0, n=N):
    """A run of triangles with a lag, as a converter of some last digit reads it."""
    time_s = np.arange(n) / RATE_Hz
    voltage_V = 50 + 50 * sawtooth(2 * np.pi * rng.uniform(0.3, 3) * time_s, 0.5)
    late_V = lfilter([0.2], [1, -0.8], voltage_V - voltage_V[0]) + voltage_V[0]
    read_um = stroke_um / 100 * (late_V + 0.05 * late_V**2 / 100) + noise_um * rng.standard_normal(n)
    return fits.Record(time_s, voltage_V, digit_um * np.round(read_um / digit_um), source="run")


def losing(rng, record, share, burst=1):
    """The same, but for samples that were lost, so many together, and marks of them."""
    lost = np.zeros(len(record), dtype=bool)
    for first in rng.choice(np.arange(20, len(record) - burst, 2 * burst), round(share * len(record) / burst), False):
        lost[first : first + burst] = True
    kept = np.maximum.accumulate(np.where(lost, 0, np.arange(len(record))))
    return fits.Record(record.time_s, record.voltage_V, record.displacement_um[kept], source="run"), lost


@pytest.mark.parametrize(("burst", "share"), [(1, 0.01), (6, 0.06)])
def test_lost_samples_are_marked_to_the_last_one(rng, burst, share):
    record, lost = losing(rng, moving(rng), share, burst)
    (found,), _ = without_lost([record], 0.1)
    np.testing.assert_array_equal(found.lost, lost)
    (warning,) = found.warnings
    assert f"{int(lost.sum())} readings ({100 * lost.mean():.2g} %) are the one before them" in warning
    np.testing.assert_allclose(found.displacement_um[~lost], record.displacement_um[~lost], rtol=1e-12)


@pytest.mark.parametrize("digit_um", [1e-6, 1e-3, 5e-3, 0.03, 0.3])
def test_a_converter_repeats_readings_by_chance(rng, digit_um):
    # Forty runs; of each a part of 1 / 1000 at most is mistaken, and no more than one in all by chance of 8e-4.
    mistaken = [without_lost([moving(rng, digit_um=digit_um)], 0.1)[0][0].lost.any() for _ in range(40)]
    assert sum(mistaken) <= 1


def test_a_rest_and_an_end_of_the_sensor_are_no_loss(rng):
    record = moving(rng)
    resting = np.where(record.time_s < 2, record.displacement_um, record.displacement_um[2000])
    cut = np.minimum(record.displacement_um, np.quantile(record.displacement_um, 0.9))
    for reading in (resting, cut):
        found = fits.Record(record.time_s, record.voltage_V, reading)
        assert not without_lost([found], 0.1)[0][0].lost.any()


def test_a_third_of_the_smallest_steps_is_none_at_all(rng):
    """Counted in long runs of coarse digits: five deviations of the mean of ten."""
    found = [repeated(moving(rng, noise_um=0.05, digit_um=2e-3, n=40_000)) for _ in range(10)]
    repeats, close = (sum(each) for each in zip(*((marks.sum(), few) for marks, few in found), strict=True))
    share = repeats / (repeats + close)
    assert abs(share - 1 / 3) < 5 * (2 / 9 / (repeats + close)) ** 0.5


def test_samples_are_lost_while_a_stage_rings_under_a_command_at_rest(rng):
    time_s = np.arange(N) / RATE_Hz
    voltage_V = 50.0 + 30 * (time_s % 0.4 > 0.2)
    ringing = lfilter([0.1], [1, -1.85, 0.95], voltage_V - 50) + 5e-3 * rng.standard_normal(N)
    record, lost = losing(rng, fits.Record(time_s, voltage_V, ringing), 0.01)
    # At its ends a sensor may be cut.
    lost &= (record.displacement_um > record.displacement_um.min()) & (record.displacement_um < ringing.max())
    np.testing.assert_array_equal(without_lost([record], 0.1)[0][0].lost, lost)


def test_where_a_command_stands_still_so_may_readings_without_noise():
    time_s = np.arange(3000) / RATE_Hz
    # Sampled so that it is the same before a turn and after it.
    voltage_V = 50 - 50 * np.cos(2 * np.pi * (time_s + 0.5 / RATE_Hz) / 0.1)
    record = fits.Record(time_s, voltage_V, voltage_V / 5 + np.sin(voltage_V))
    assert not without_lost([record], 0.1)[0][0].lost.any()


def test_runs_are_judged_together_and_those_held_out_with_them(rng):
    record, lost = losing(rng, moving(rng), 0.01)
    (one,), (other,) = without_lost([moving(rng)], [record])
    assert not one.lost.any()
    np.testing.assert_array_equal(other.lost, lost)


def test_a_fit_leaves_lost_samples_out_and_says_so(rng):
    record = moving(rng)
    spoilt, _ = losing(rng, record, 0.03)
    whole, rest = (fits.fit(one, levels=16, holdout=0.2) for one in (record, spoilt))
    assert "are left out" in said(rest, "the one before")
    assert not [remark for remark in whole.remarks if "the one before" in remark]
    # Left in, samples that are off by up to 0.1 um would be many times the noise of 5 nm.
    errors = [each.runs[0].held_out.rms_um for each in (rest, whole)]
    assert errors[0] == pytest.approx(errors[1], rel=0.15)


def test_marks_are_one_for_each_sample(rng):
    record = moving(rng)
    with pytest.raises(fits.DataError, match="lost has shape"):
        replace(record, lost=np.ones(3, dtype=bool))
