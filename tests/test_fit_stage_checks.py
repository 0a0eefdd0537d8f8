"""Runs of a stage that are not what they seem: each is refused, or named, and its intervals own up to it."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from _wrong_records import TRUTH, bench, delayed, in_ms, said, stuck, thinned, with_outliers
from scipy import signal

import fits
from fits.stage._checks import refuse_slopes, speed_Hz
from fits.stage._delay import WithoutDelays

LEVELS = 16
ALARMS = ("BEFORE", "AFTER", "stuck", "outliers", "another unit", "no resonance")


@pytest.fixture(scope="module")
def runs():
    return bench()


def fit(slow, fast, **options):
    return fits.fit_stage([slow, fast], levels=LEVELS, initial="negative", **options)


def named(slow, fast, word):
    """The sentence with a word in it, from a refusal or a remark, and the fit if there is one."""
    try:
        result = fit(slow, fast)
    except fits.DataError as refusal:
        return (str(refusal), None) if word in str(refusal) else ("", None)
    return said(result, word), result


def samples(remark):
    size, sd = (float(part) for part in re.search(r"comes ([\d.]+) \+- ([\d.]+) samples", remark).groups())
    return size, sd


def holds_the_truth(result):
    for name, value in TRUTH.items():
        print(result[name], "truth", value)
        # A fraction of a per cent is what the grid's own error may be worth beside the noise.
        assert result[name].lower - 5e-3 * value < value < result[name].upper + 5e-3 * value


@pytest.mark.study
def test_a_clean_rig_gets_no_such_remark(runs):
    result = fit(*runs)
    assert not [remark for remark in result.remarks if any(word in remark for word in ALARMS)]
    assert not result.misfit.far
    assert result.misfit.noise_um == pytest.approx(0.05, rel=0.15)
    assert result.summary().startswith("left over")
    holds_the_truth(result)


def test_what_rings_reaches_farther_and_is_no_other_rig():
    time_s, natural = np.arange(6000) * 1e-4, 2 * np.pi * 300
    mode = [natural**2], [1, 2 * 0.015 * natural, natural**2]
    stairs_V = np.repeat([10.0, 70, 30, 90, 20, 60, 40, 80, 15, 85, 25, 65], 500)
    # As fast, but beyond the mode.
    lines_V = 50 - 36 * np.cos(2 * np.pi * 5 * time_s) + 4 * np.sin(2 * np.pi * 900 * time_s)
    moved_um = [signal.lsim(mode, 0.1 * v, time_s, X0=[0, v[0] / 10 / natural**2])[1] for v in (stairs_V, lines_V)]
    assert np.ptp(moved_um[0]) > 1.5 * np.ptp(moved_um[1])
    records = [
        fits.Record(time_s, v, um, source=f"{k}.csv")
        for k, (v, um) in enumerate(zip((stairs_V, lines_V), moved_um, strict=True))
    ]
    assert speed_Hz(records[0]) == pytest.approx(speed_Hz(records[1]), rel=0.45)
    refuse_slopes(records)


@pytest.mark.study
def test_a_delay_that_ruins_the_fit_is_refused_by_its_size(runs):
    slow, fast = runs
    with pytest.raises(fits.DataError, match=r"fast\.csv: the displacement comes .* AFTER") as refusal:
        fit(slow, delayed(fast, 20))
    size, sd = samples(str(refusal.value))
    assert abs(size - 20) < 0.1 + 5 * sd


@pytest.mark.parametrize(
    ("late", "where"),
    [pytest.param(1, "AFTER", id="late", marks=pytest.mark.study), pytest.param(-3, "BEFORE", id="acausal")],
)
@pytest.mark.study
def test_a_delay_is_named_and_the_intervals_own_up_to_it(runs, late, where):
    slow, fast = runs
    told, result = named(slow, delayed(fast, late), where)
    size, sd = samples(told)
    assert abs(size - abs(late)) < 0.1 + 5 * sd
    if result is None:
        # With this rig the delay ruins the fit, or leaves none: it is refused.
        return
    holds_the_truth(result)
    assert result.summary().startswith("FAR FROM NOISE")


@pytest.mark.study
def test_a_fast_run_sampled_below_its_resonance_is_refused(runs):
    slow, fast = runs
    with pytest.raises(fits.DataError, match=r"fast\.csv: sampled at 135\.1 Hz, .*too slow"):
        fit(slow, thinned(fast, 37))


@pytest.mark.study
def test_times_in_ms_are_told_by_the_resonance(runs):
    result = fit(*map(in_ms, runs))
    assert "in ms instead of s" in said(result, "another unit")
    assert result["mechanics.natural_frequency_Hz"].value < 1
    for name, value in TRUTH.items():
        assert 0.995 * result[name].lower < value < 1.005 * result[name].upper


@pytest.mark.study
def test_outliers_are_named_and_the_intervals_reach_the_truth(runs, rng):
    slow, fast = runs
    spoilt, hit = with_outliers(rng, fast)
    pulled = fit(slow, spoilt)
    remark = said(pulled, "jump out")
    assert int(re.search(r"(\d+) readings", remark)[1]) == pytest.approx(0.8 * hit.sum(), rel=0.25)
    assert "the loss huber" in remark
    assert "driver.time_constant_s" in said(pulled, "the intervals reach there")
    for name, value in TRUTH.items():
        assert 0.995 * pulled[name].lower < value < 1.005 * pulled[name].upper


@pytest.mark.study
def test_what_counts_outliers_less_and_a_stuck_sensor_are_named(runs, rng):
    slow, fast = runs
    robust = fit(slow, with_outliers(rng, fast)[0], loss="huber")
    assert "count less" in said(robust, "outliers")
    result = fit(slow, stuck(fast, len(fast) // 2, 400))
    assert "fast.csv: 400 readings" in said(result, "stuck") or "fast.csv: 401 readings" in said(result, "stuck")


def triangles(rng, frequency_Hz, rate_Hz=10_000.0, cycles=6):
    """A recorder of little noise: plays behind a lag of 0.55 ms, and a part that follows within 30 ms."""
    n, fine = int(rate_Hz * cycles / frequency_Hz), 4
    step = 1 / (rate_Hz * fine)
    voltage = 90 * signal.sawtooth(2 * np.pi * frequency_Hz * step * np.arange(n * fine) + np.pi / 2, 0.5)
    radii = np.linspace(0, 60, 60)
    behind, moved = np.clip(0.0, voltage[0] - radii, voltage[0] + radii), np.empty(len(voltage))
    for k, now in enumerate(voltage):
        behind = np.clip(behind, now - radii, now + radii)
        moved[k] = 0.1 * now + 0.004 * np.exp(-radii / 30) @ behind

    def lag(values, constant_s):
        share = step / constant_s
        return signal.lfilter([share], [1, share - 1], values - values[0]) + values[0]

    out = lag(0.95 * moved + 0.05 * lag(moved, 30e-3), 0.55e-3)[::fine]
    time = np.arange(n) / rate_Hz
    reading = np.round(out + 2e-4 * rng.standard_normal(n), 4)
    return fits.Record(time, voltage[::fine], reading, source=f"triangle_{frequency_Hz:g}Hz.csv")


@pytest.mark.parametrize(
    ("late", "held"), [((0.55, 0.63), True), ((0.5,), True), ((0.55, 1.4), False), ((-0.5,), False), ((0.1,), False)]
)
def test_readings_half_a_sample_late_are_said_to_be_those_of_a_held_command(late, held):
    delays = tuple(SimpleNamespace(samples=one) for one in late)
    remedy = WithoutDelays(delays, None).remedy
    assert ("in steps" in (remedy or "")) == held


@pytest.mark.parametrize("others", [0.0, 1.5])
def test_a_run_beyond_its_resonance_alone_is_refused_in_true_words(rng, others):
    """Also where voltages that nobody gives move most of it, as in a mirror of three axes."""
    rate, n = 6400.0, 8192
    voltage, other = signal.lfilter(*signal.butter(2, 0.8), rng.standard_normal((2, n)))
    voltage, other = voltage - voltage[0], other - other[0]
    voltage[100:102] = 1.1 * voltage.max(), 1.1 * voltage.min()  # its past is known soon
    time, natural = np.arange(n) / rate, 2 * np.pi * 732.0
    drive = voltage + others * other
    clean = signal.lsim(([natural**2], [1, 0.02 * natural, natural**2]), drive, time)[1]
    record = fits.Record(time, voltage, clean + 0.05 * rng.standard_normal(n), source="mirror.csv")
    for of in (fits.fit, fits.fit_stage):
        with pytest.raises(fits.DataError, match=r"mirror\.csv: the displacement follows .* not at once") as refusal:
            of([record])
        assert abs(float(re.search(r"most near ([\d.]+) Hz", str(refusal.value))[1]) - 732) < 50


@pytest.mark.study
def test_a_lag_beside_what_relaxes_is_fitted_as_one(rng):
    result = fits.fit_stage([triangles(rng, 40.0), triangles(rng, 100.0)], levels=LEVELS)
    assert "show a lag, but no resonance" in said(result, "mechanics was left out")
    assert [parameter.name for parameter in result.parameters] == ["driver.time_constant_s"]
    # What relaxes, and where the lag sits, is not in this model.
    assert result["driver.time_constant_s"].value == pytest.approx(0.55e-3, rel=0.5)
    assert result.misfit.share_pct < 1


def test_small_loops_beside_a_resonance_are_no_other_rig():
    """Small loops move less per volt, and a run near the resonance more: together by more than a tenth."""
    time_s = np.arange(4000) / 1000.0
    ring = np.exp(-(((time_s - 2) / 0.2) ** 2)) * np.sin(2 * np.pi * 80 * time_s)
    decaying_V = 50 - 50 * (1 - 0.9 * time_s / 4) * np.cos(2 * np.pi * 8 * time_s)
    full_V = 50 - 47 * np.cos(2 * np.pi * 8 * time_s) + 3 * ring
    moved = []
    for voltage_V, rung_um in ((decaying_V, 0.0), (full_V, 3 * ring)):
        played_V = [voltage_V[0]]
        for now_V in voltage_V[1:]:
            played_V.append(np.clip(played_V[-1], now_V - 25, now_V + 25))
        moved.append(fits.Record(time_s, voltage_V, 0.1 * voltage_V + 0.1 * np.array(played_V) + rung_um))
    slopes = [np.polyfit(one.voltage_V, one.displacement_um, 1)[0] for one in moved]
    assert slopes[1] > 1.1 * slopes[0]
    assert np.ptp(moved[1].displacement_um) > 1.1 * np.ptp(moved[0].displacement_um)
    refuse_slopes(moved)
