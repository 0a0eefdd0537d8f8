"""Voltage programs: where they go, how fast, and where they turn."""

import itertools

import numpy as np
import pytest
import scipy.signal

import data_synth as ds

LOWER_V, UPPER_V = -10.0, 70.0


def turning_points(start_V, voltage_V):
    """Where the voltage changes direction, with the start and the end, read off sample by sample."""
    path = [start_V, *voltage_V]
    path = [path[0], *(after for before, after in itertools.pairwise(path) if after != before)]
    turns = [b for a, b, c in zip(path, path[1:], path[2:], strict=False) if (b - a) * (c - b) < 0]
    return np.array([path[0], *turns, path[-1]])


def limits():
    return {"lower_V": LOWER_V, "upper_V": UPPER_V}


def programs(rng, rate_V_per_s, sample_rate_Hz):
    """One of each program that moves at a stated rate, with the extremes that it must reach."""
    common = {"rate_V_per_s": rate_V_per_s, "sample_rate_Hz": sample_rate_Hz}
    start_V = float(rng.uniform(LOWER_V, UPPER_V))
    level_V = float(rng.uniform(LOWER_V, UPPER_V))
    amplitude_V = float(rng.uniform(3, 30))
    full = {LOWER_V, UPPER_V}
    return start_V, {
        "ramp": (ds.ramp(start_V, to_V=level_V, **common), {level_V}),
        "triangle": (ds.triangle(start_V, **limits(), cycles=2, **common), full),
        "forc above": (ds.forc(start_V, reversals_V=[level_V, LOWER_V], **limits(), **common), full | {level_V}),
        "forc below": (
            ds.forc(start_V, reversals_V=[level_V, UPPER_V], side="below", **limits(), **common),
            full | {level_V},
        ),
        "nested": (
            ds.nested(start_V, biases_V=[30.0, 35.0], amplitude_V=amplitude_V, loops=4, **common),
            {30 - amplitude_V, 35 + amplitude_V},
        ),
        "random": (ds.random_reversals(start_V, **limits(), reversals=9, rng=rng, **common), set()),
        "steps": (ds.steps(start_V, levels_V=[level_V, 20.0], dwell_s=1.0, **common), {level_V, 20.0}),
    }


def test_programs_stay_in_range_hit_their_extremes_and_keep_their_rate(rng):
    for _ in range(5):
        rate_V_per_s, sample_rate_Hz = float(rng.uniform(5, 200)), float(rng.uniform(3, 300))
        start_V, all_programs = programs(rng, rate_V_per_s, sample_rate_Hz)
        for name, (voltage_V, extremes_V) in all_programs.items():
            step_V = np.abs(np.diff([start_V, *voltage_V])).max()
            assert step_V <= rate_V_per_s / sample_rate_Hz * (1 + 1e-6), name
            assert voltage_V.min() >= LOWER_V, name
            assert voltage_V.max() <= UPPER_V, name
            assert extremes_V <= set(voltage_V.tolist()), name


def test_a_program_goes_on_from_the_one_before(rng):
    """Joined programs have no sample twice and no jump at the joints."""
    pieces, start_V = [], 3.0
    for _, (piece, _) in programs(rng, 50.0, 20.0)[1].items():
        moved = ds.ramp(start_V, to_V=float(piece[0]), rate_V_per_s=50.0, sample_rate_Hz=20.0)
        pieces += [moved, piece[1:]]
        start_V = float(piece[-1])
    joined_V = np.concatenate([[3.0], *pieces])
    assert np.abs(np.diff(joined_V)).max() <= 50.0 / 20.0 * (1 + 1e-6)


def test_a_ramp_takes_the_time_it_should():
    voltage_V = ds.ramp(0.0, to_V=120.0, rate_V_per_s=60.0, sample_rate_Hz=100.0)
    np.testing.assert_allclose(voltage_V, 0.6 * np.arange(1, 201), atol=1e-12)
    assert len(ds.ramp(5.0, to_V=5.0, rate_V_per_s=1.0, sample_rate_Hz=10.0)) == 0
    assert ds.ramp(5.0, to_V=7.0, rate_V_per_s=np.inf, sample_rate_Hz=10.0).tolist() == [7.0]


@pytest.mark.parametrize("side", ["above", "below"])
def test_reversal_curves_turn_where_stated(side, rng):
    reversals_V = rng.uniform(LOWER_V + 1, UPPER_V - 1, 7).tolist()
    saturation_V = UPPER_V if side == "above" else LOWER_V
    voltage_V = ds.forc(20.0, reversals_V=reversals_V, side=side, **limits(), rate_V_per_s=33.0, sample_rate_Hz=17.0)
    expected_V = [20.0, saturation_V]
    for reversal_V in reversals_V:
        expected_V += [reversal_V, saturation_V]
    assert turning_points(20.0, voltage_V).tolist() == expected_V


def test_nested_loops_shrink_about_each_bias():
    voltage_V = ds.nested(
        0.0, biases_V=[30.0, 40.0], amplitude_V=12.0, loops=3, rate_V_per_s=10.0, sample_rate_Hz=7.0
    )
    loops_V = np.array([12, -12, 8, -8, 4, -4])
    # The second bias is reached on the way up to its first loop: nothing turns there.
    np.testing.assert_allclose(turning_points(0.0, voltage_V), [0, *(30 + loops_V), *(40 + loops_V), 40], atol=1e-12)


def test_random_reversals_really_reverse(rng):
    voltage_V = ds.random_reversals(0.0, **limits(), reversals=40, rate_V_per_s=100.0, sample_rate_Hz=50.0, rng=rng)
    assert len(turning_points(0.0, voltage_V)) == 40 + 2


def test_a_sine_is_a_sine_and_reaches_its_extremes(rng):
    frequency_Hz = float(rng.uniform(0.5, 9.0))
    voltage_V = ds.sine(LOWER_V, **limits(), cycles=3, frequency_Hz=frequency_Hz, sample_rate_Hz=100.0)
    samples = len(voltage_V) // 3
    assert 100.0 / samples <= frequency_Hz * (1 + 1e-9)
    assert 100.0 / (samples - 2) > frequency_Hz
    time_s = np.arange(1, len(voltage_V) + 1) / 100.0
    expected_V = 30.0 - 40.0 * np.cos(2 * np.pi * 100.0 / samples * time_s)
    np.testing.assert_allclose(voltage_V, expected_V, atol=1e-9)
    assert turning_points(LOWER_V, voltage_V) == pytest.approx([LOWER_V, *[UPPER_V, LOWER_V] * 3])


@pytest.mark.parametrize("spacing", ["linear", "logarithmic"])
def test_a_chirp_is_scipys_chirp(spacing, rng):
    start_Hz, stop_Hz = rng.uniform(1, 40, 2).tolist()
    voltage_V = ds.chirp(
        20.0,
        bias_V=20.0,
        amplitude_V=6.0,
        start_Hz=start_Hz,
        stop_Hz=stop_Hz,
        duration_s=4.0,
        spacing=spacing,
        rate_V_per_s=10.0,
        sample_rate_Hz=100.0,
    )
    time_s = np.arange(1, 401) / 100.0
    # SciPy's chirp is a cosine: a quarter of a turn makes it a sine.
    cosine = scipy.signal.chirp(time_s, start_Hz, 4.0, stop_Hz, method=spacing, phi=-90)
    np.testing.assert_allclose(voltage_V, 20 + 6 * cosine, atol=1e-9)


def test_steps_jump_and_rest():
    voltage_V = ds.steps(0.0, levels_V=[10.0, 5.0], dwell_s=0.3, sample_rate_Hz=10.0)
    assert voltage_V.tolist() == [10.0] * 4 + [5.0] * 4
    assert ds.hold(5.0, duration_s=0.3, sample_rate_Hz=10.0).tolist() == [5.0] * 3


SENSIBLE = {"rate_V_per_s": 1.0, "sample_rate_Hz": 10.0}


@pytest.mark.parametrize(
    ("program", "settings", "sentence"),
    [
        (ds.ramp, {"to_V": 1.0, **SENSIBLE, "rate_V_per_s": -1.0}, "rate_V_per_s must be positive"),
        (ds.ramp, {"to_V": 1e9, **SENSIBLE}, "more than ten million"),
        (ds.hold, {"duration_s": 0.0, "sample_rate_Hz": 10.0}, "duration_s must be positive"),
        (ds.triangle, {"lower_V": 5.0, "upper_V": 5.0, "cycles": 1, **SENSIBLE}, "lower_V must be below"),
        (ds.triangle, {"lower_V": 0.0, "upper_V": 5.0, "cycles": 0, **SENSIBLE}, "cycles must be 1 to"),
        (ds.forc, {"lower_V": 0.0, "upper_V": 5.0, "reversals_V": [6.0], **SENSIBLE}, "reversals_V must lie in"),
        (ds.nested, {"biases_V": [0.0], "amplitude_V": -1.0, "loops": 2, **SENSIBLE}, "amplitude_V must be"),
    ],
)
def test_numbers_without_sense_are_refused_by_name(program, settings, sentence):
    with pytest.raises(ValueError, match=sentence):
        program(0.0, **settings)


def test_a_chirp_above_half_the_sample_rate_is_refused():
    with pytest.raises(ValueError, match="at most half of sample_rate_Hz"):
        ds.chirp(0.0, bias_V=0.0, amplitude_V=1.0, start_Hz=1.0, stop_Hz=6.0, duration_s=1.0, **SENSIBLE)


BAND = {"amplitude_V": 12.0, "low_Hz": 3.0, "high_Hz": 600.0, "period_s": 0.5, "periods": 3, "sample_rate_Hz": 5000.0}


def test_a_multisine_has_equal_lines_in_its_band_and_none_outside(rng):
    voltage_V = ds.multisine(60.0, **BAND, rng=rng)
    wave_V = voltage_V.reshape(3, 2500) - 60.0
    np.testing.assert_array_equal(wave_V[0], wave_V[2])
    lines_V = np.abs(np.fft.rfft(wave_V[0])) / 1250
    frequency_Hz = np.fft.rfftfreq(2500, 1 / 5000.0)
    inside = (frequency_Hz >= 3.0) & (frequency_Hz <= 600.0)
    assert inside.sum() == 299
    np.testing.assert_allclose(lines_V[inside], lines_V[inside].mean(), rtol=1e-9)
    np.testing.assert_allclose(lines_V[~inside], 0, atol=1e-9)
    assert np.abs(wave_V).max() == pytest.approx(12.0, rel=1e-12)
    # It ends where it is closest to the start, and so begins one sample after that.
    assert abs(wave_V[0, -1]) == np.abs(wave_V[0]).min()
    assert not np.allclose(ds.multisine(60.0, **BAND, rng=rng), voltage_V)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"amplitude_V": 0.0}, "amplitude_V must be positive"),
        ({"periods": 0}, "periods must be 1 to"),
        ({"high_Hz": 2500.0}, "high_Hz must be below half of sample_rate_Hz, 2500"),
        ({"low_Hz": 3.1, "high_Hz": 3.9}, "low_Hz to high_Hz must hold a multiple of 1 / period_s"),
        ({"period_s": 1e-9}, "low_Hz to high_Hz must hold"),
        ({"period_s": 2000.0}, "more than ten million"),
    ],
)
def test_multisines_without_sense_are_refused_by_name(settings, sentence, rng):
    with pytest.raises(ValueError, match=sentence):
        ds.multisine(0.0, **{**BAND, **settings}, rng=rng)
