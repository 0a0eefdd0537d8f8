"""Long records are read in part, and records of any sampling rate are asked what their rate allows."""

from dataclasses import fields

import numpy as np
import pytest
from _models import random_model

from fits import Record
from fits.diagnosis._effects import Law
from fits.diagnosis._records import excerpts, joined
from fits.diagnosis._score import _is_allowed
from microid.effects import EFFECTS, Scales


def record(count, cycle, source="long.csv"):
    time_s = 0.01 * np.arange(count)
    voltage_V = 50 + 40 * np.sin(2 * np.pi * np.arange(count) / cycle)
    return Record(time_s, voltage_V, 0.2 * voltage_V + 1e-3 * time_s, {"temperature_degC": time_s}, source)


def test_files_whose_time_goes_on_are_one_record_and_others_are_not():
    whole = record(900, 100)
    parts = [whole[:300], whole[300:650], whole[650:]]
    (found,) = joined(parts)
    for name in ("time_s", "voltage_V", "displacement_um"):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))
    np.testing.assert_array_equal(found.extra["temperature_degC"], whole.extra["temperature_degC"])
    assert found.source == whole.source
    gap = [whole[:300], whole[310:]]
    assert joined(gap) == tuple(gap)
    again = [whole[:300], whole[:300]]
    assert joined(again) == tuple(again)
    slower = [whole[:300], Record(whole.time_s[300:] * 2 - 3.0, *[whole.voltage_V[300:]] * 2, source="b")]
    assert joined(slower) == tuple(slower)


def test_short_records_stay_as_they_are():
    given = record(300, 100), record(700, 100)
    found, said = excerpts(given, 1000)
    assert found == given
    assert said == ()


def test_windows_are_spread_over_a_long_record_and_know_how_far_the_command_went_between_them():
    long = record(100_000, 100)
    (short, *windows), said = excerpts([record(500, 100), long], 4000)
    assert len(short) == 500
    assert len(windows) == 4
    assert 3400 <= sum(map(len, windows)) <= 3500
    assert windows[0].time_s[0] == long.time_s[0]
    assert windows[-1].time_s[-1] == long.time_s[-1]
    gone_V = np.abs(np.diff(long.voltage_V))
    for window in windows:
        first = round(window.time_s[0] / 0.01)
        same = slice(first, first + len(window))
        np.testing.assert_array_equal(window.voltage_V, long.voltage_V[same])
        np.testing.assert_array_equal(window.displacement_um, long.displacement_um[same])
        np.testing.assert_array_equal(window.extra["temperature_degC"], long.time_s[same])
        np.testing.assert_allclose(window.extra["path_V"][0], gone_V[:first].sum(), rtol=1e-12)
    assert len(said) == 1
    assert "100000 samples" in said[0]
    assert "4 windows" in said[0]


def test_neighbours_are_averaged_where_a_cycle_is_longer_than_what_can_be_read():
    long = record(100_000, 50_000)
    (found,), said = excerpts([long], 2000)
    assert len(found) == 2000
    np.testing.assert_allclose(found.voltage_V, long.voltage_V.reshape(2000, 50).mean(axis=1), rtol=1e-12)
    np.testing.assert_allclose(found.time_s, long.time_s.reshape(2000, 50).mean(axis=1), rtol=1e-12)
    assert "means of 50" in said[0]


@pytest.mark.parametrize("interval_s", [1e-6, 1e-5, 1e-3, 0.1, 1.0, 100.0])
def test_what_is_asked_of_samples_of_any_rate_can_be_fitted(rng, interval_s):
    model = random_model(rng)
    scales = Scales(0, 100, 1 / interval_s, 20, 10, interval_s, 1e4 * interval_s, 1e3 * interval_s, 0.01)
    alone = [form for form in EFFECTS if "inner" not in {field.name for field in fields(form)}]
    for form in [*alone, *(form for form in EFFECTS if form.place == "hysteresis" and form not in alone)]:
        for group in form.probes(scales, None if form in alone else model):
            laws = [Law([effect]) for effect in group if _is_allowed(effect)]
            assert all(law.size > 0 for law in laws)
