"""Loops that are not what they seem: each is refused, or named for what it is; clean ones are left in peace."""

import re
from html import unescape
from types import SimpleNamespace

import numpy as np
import pytest
from _wrong_records import bench, delayed, in_ms, joined, read, said, stuck, thinned, with_outliers

import fits
from fits.loop._fit import _of_speed
from fits.loop._misfit import impulsive, sensor_noise_um
from fits.loop._misfit import stuck as told_stuck

LEVELS = 16
ALARMS = ("BEFORE", "AFTER", "stuck", "outliers", "apart", "samples are")


@pytest.fixture(scope="module")
def slow():
    return bench()[0]


def fit(*records, **options):
    return fits.fit(list(records), levels=LEVELS, initial="negative", **options)


def test_a_clean_record_gets_no_such_remark_and_its_noise_is_known(slow):
    result = fit(slow)
    assert not [remark for remark in result.remarks if any(word in remark for word in ALARMS)]
    assert not result.misfit.far
    assert result.misfit.noise_um == pytest.approx(0.05, rel=0.15)
    first = result.summary().splitlines()[0]
    assert first.startswith("left over")
    assert "times the sensor's noise" in first
    assert repr(result) == result.summary()
    assert unescape(result._repr_html_()) == f"<pre>{result.summary()}</pre>"


@pytest.mark.study
def test_two_rigs_in_two_files(slow):
    other = bench(stroke_um=34.0, rig=1)[0]
    second = read(other, other.displacement_um, "second.csv")
    with pytest.raises(
        fits.DataError, match=r"slow\.csv, second\.csv: .* not show one hysteresis: .* fit them apart"
    ):
        fit(slow, second)
    # The same stroke, and another shape: no gain tells them apart.
    other = bench(rig=1)[0]
    same = read(other, other.displacement_um, "second.csv")
    result = fit(slow, same)
    assert "not show one hysteresis" in said(result, "fit them apart")
    first, *_ = result.summary().splitlines()
    assert first.startswith("FAR FROM NOISE")


@pytest.mark.study
def test_two_rigs_joined_in_one_file(slow):
    result = fit(joined(slow, bench(stroke_um=26.0, rig=1)[0]))
    remark = said(result, "something changed")
    sample = int(re.search(r"near sample (\d+)", remark)[1])
    assert abs(sample - len(slow)) < 0.02 * len(slow)
    ratio = float(re.search(r"moves ([\d.]+) times", remark)[1])
    assert ratio == pytest.approx(26 / 40, rel=0.1)
    text = result.summary()
    assert text.startswith("FAR FROM NOISE")
    assert "as well as" not in text


def test_a_sensor_that_sticks_is_named_with_its_samples(slow, rng):
    count = int(0.1 * len(slow))
    rising = np.flatnonzero((slow.voltage_V[1:] > slow.voltage_V[:-1]) & (slow.voltage_V[1:] < 30))
    first = int(rng.choice(rising[(rising > 100) & (rising < len(slow) // 2)]))
    remark = said(fit(stuck(slow, first, count)), "stuck")
    begin, end = map(int, re.search(r"samples (\d+) to (\d+)", remark).groups())
    assert abs(begin - 1 - first) <= 1
    assert abs(end - (first + count)) <= 1


def test_readings_of_a_coarse_sensor_and_a_backlash_are_not_stuck(slow):
    coarse = read(slow, np.round(slow.displacement_um / 2) * 2)
    assert told_stuck(coarse) == []


@pytest.mark.study
def test_outliers_are_counted_and_the_robust_loss_gets_past_them(slow, rng):
    spoilt, hit = with_outliers(rng, slow)
    result = fit(spoilt)
    remark = said(result, "outliers")
    fitted = hit[: len(slow) - round(0.2 * len(slow))]
    count = int(re.search(r"(\d+) readings", remark)[1])
    assert count == pytest.approx(fitted.sum(), rel=0.2)
    assert float(re.search(r"by ([\d.]+) um", remark)[1]) == pytest.approx(50, rel=0.05)
    assert "the loss huber" in remark
    robust = fit(spoilt, loss="huber")
    clean = fit(slow)
    off = [np.std(r.predict(slow).displacement_um - clean.predict(slow).displacement_um) for r in (result, robust)]
    assert off[1] < 0.05
    assert off[1] < off[0] / 5
    assert "count less in this fit" in said(robust, "outliers")
    with pytest.raises(fits.DataError, match="unknown loss 'absolute'"):
        fit(slow, loss="absolute")


def test_readings_ahead_of_their_voltage(slow):
    remark = said(fit(delayed(slow, -4)), "BEFORE")
    size = float(re.search(r"comes ([\d.]+) \+-", remark)[1])
    assert abs(size - 4) < 1


def test_times_in_another_unit(slow):
    assert "if the time is in ms" in said(fit(in_ms(thinned(slow, 2))), "samples are 20 s apart")


def test_rounding_ends_the_search_for_a_resolution(slow):
    rounded = read(slow, np.round(slow.displacement_um / 5) * 5)
    result = fits.fit([rounded], initial="negative")
    assert result.trials[-1].levels <= 32
    assert result.misfit.noise_um == pytest.approx(5 / 12**0.5, rel=1e-6)
    assert not result.misfit.far


def test_noise_and_impulses_are_read_off_signals(rng):
    n = 4000
    time = np.arange(n) / 1000
    move = 10 * np.sin(2 * np.pi * 3 * time)
    noise = 0.02 * rng.standard_normal(n)
    record = fits.Record(time, move, move + noise, source="a.csv")
    assert sensor_noise_um(record, noise)[0] == pytest.approx(0.02, rel=0.15)
    assert impulsive(noise).sum() <= 1
    hit = np.zeros(n, dtype=bool)
    hit[rng.choice(np.arange(20, n - 20, 37), 30, replace=False)] = True
    assert np.array_equal(impulsive(noise + np.where(hit, 1.0, 0.0)) & hit, hit)


@pytest.mark.parametrize("estimate", [fits.fit, fits.fit_slow, fits.fit_stage])
def test_a_number_of_levels_that_is_none_is_refused_by_every_fit(slow, estimate):
    for levels in (1, 0, -3, 101, 8.5):
        with pytest.raises(fits.DataError, match=f"levels: expected a whole number from 4 to 100, found {levels};"):
            estimate([slow], levels=levels)


def plays(voltage_V, fresh):
    """What a few plays make of a voltage, um: as they are when it first rises, or as its lower end left them."""
    moved_um = 0.05 * voltage_V
    for half_V, gain in ((2, 0.05), (6, 0.04), (12, 0.03), (25, 0.02)):
        at_V = 0.0 if fresh else voltage_V[0] + half_V
        for k, volts in enumerate(voltage_V):
            at_V = min(max(at_V, volts - half_V), volts + half_V)
            moved_um[k] += gain * at_V
    return moved_um


def test_the_first_way_of_a_fresh_stage_is_named(rng):
    """Its plays begin where no voltage of the record leaves them; later they are where voltages left them."""
    turn = np.arange(900) / 180
    voltage_V = 50 - 50 * np.cos(2 * np.pi * turn)
    for fresh in (True, False):
        noisy_um = plays(voltage_V, fresh) + 0.005 * rng.standard_normal(900)
        record = fits.Record(turn, voltage_V, noisy_um, source="rig.csv")
        found = [remark for remark in fits.fit(record, levels=LEVELS).remarks if "first way across" in remark]
        assert len(found) == fresh
        if fresh:
            stop = int(re.search(r"^rig\.csv: up to sample (\d+) ", found[0])[1])
            assert np.argmax(voltage_V > 95) <= stop <= np.argmax(voltage_V)


def test_runs_of_other_speeds_that_are_far_from_noise_ask_for_the_stage():
    def moved(rate_V_per_s, n=400):
        time_s = np.arange(n) * 0.1 / rate_V_per_s
        drive_V = 50 - 50 * np.cos(2 * np.pi * time_s / time_s[-1] * 2)
        return SimpleNamespace(record=SimpleNamespace(time_s=time_s, voltage_V=drive_V))

    (said,) = _of_speed([moved(1.0), moved(40.0), moved(3.0)])
    assert "by a factor of 40," in said
    assert "whole stage" in said
    # A run at rest has no speed, and one or two alike tell nothing of it.
    still = moved(1.0)
    still.record.voltage_V = np.zeros(400)
    assert _of_speed([moved(1.0), still]) == _of_speed([moved(1.0), moved(4.0)]) == []
