"""The bench of the paper's stage against integrators and formulas, and what it was calibrated to."""

import dataclasses
import itertools

import numpy as np
import pytest
import scipy.optimize
import scipy.signal

import data_synth as ds

TABLES = {"x": (18.22, 6.70), "z": (11.62, 5.50), "alpha": (30.77, 16.10), "gamma": (54.17, 25.34)}
INTERVAL_s = 1e-3
FINE = 100


def elongation_um(piezo, voltage_V, play_V):
    """Play by play, sample by sample, as the play operator is defined."""
    share = voltage_V / piezo.upper_V
    stroke_um = piezo.stroke_um * piezo.reversible_share
    total_um = stroke_um * (share + piezo.quadratic * share**2) / (1 + piezo.quadratic)
    for radius_V, weight, play in zip(piezo.radii_V, piezo.weights_um_per_V, play_V, strict=True):
        state, path = play, []
        for voltage in voltage_V.tolist():
            state = max(voltage - radius_V, min(voltage + radius_V, state))
            path.append(state)
        total_um = total_um + weight * (np.array(path) - radius_V)
    return total_um


def integrated_um(axis, piezo, command_V):
    """The whole chain on a fine grid; only the bias is given."""
    times_s = INTERVAL_s / FINE * np.arange(1, FINE + 1)
    voltage_V, pieces = ds.PAPER_BIAS_V, [np.array([ds.PAPER_BIAS_V])]
    for command in command_V:
        pieces.append(command + (voltage_V - command) * np.exp(-times_s / 1e-3))
        voltage_V = pieces[-1][-1]
    path_V = np.concatenate(pieces)
    # From above, all plays that reach as far hang on the falling side.
    play_V = np.minimum(ds.PAPER_BIAS_V + piezo.radii_V, piezo.upper_V - piezo.radii_V)
    piezo_um = elongation_um(piezo, path_V, play_V)
    static_um = axis.amplification * (1 + axis.gain_error) * (piezo_um - piezo_um[0])
    w, zeta = axis.natural_rad_per_s, axis.damping_ratio
    mode = scipy.signal.lti([w**2], [1, 2 * zeta * w, w**2])
    _, found, _ = scipy.signal.lsim(mode, static_um, INTERVAL_s / FINE * np.arange(len(path_V)))
    return found[::FINE]


@pytest.mark.parametrize("name", TABLES)
def test_the_bench_is_driver_plays_and_mode(name, rng):
    axis, piezo = ds.PAPER_AXES[name], ds.PaperPiezo(plays=15)
    command_V = np.repeat(rng.uniform(0, 60, 12), rng.integers(1, 20, 12))
    found_um, reading_um = ds.PaperBench(axis, piezo).run(command_V[None])
    np.testing.assert_array_equal(found_um, reading_um)
    expected_um = integrated_um(axis, piezo, command_V)[: len(command_V)]
    np.testing.assert_allclose(found_um[0], expected_um, rtol=0, atol=2e-3 * np.ptp(expected_um))


def test_what_the_amplifier_cannot_give_is_cut(rng):
    bench = ds.PaperBench(ds.PAPER_AXES["x"])
    wild_V = np.repeat(rng.uniform(-100, 300, 8), 10)[None]
    np.testing.assert_array_equal(bench.run(wild_V)[0], bench.run(np.clip(wild_V, 0, 120))[0])


def test_benches_side_by_side_are_alone_each_and_reset(rng):
    axis = ds.PAPER_AXES["z"]
    command_V = rng.uniform(0, 60, (3, 50))
    together = ds.PaperBench(axis, benches=3)
    first = together.run(command_V)[0]
    np.testing.assert_array_equal(first, together.run(command_V)[0])
    for command, displacement in zip(command_V, first, strict=True):
        np.testing.assert_allclose(displacement, ds.PaperBench(axis).run(command[None])[0][0], rtol=0, atol=1e-9)


def test_the_loop_of_the_piezo_is_as_wide_as_the_papers():
    piezo = ds.PaperPiezo()
    voltage_V = np.linspace(0, 120, 401)
    both_um = elongation_um(piezo, np.concatenate([voltage_V, voltage_V[::-1]]), piezo.radii_V)
    up_um, down_um = both_um[:401], both_um[401:][::-1]
    assert 100 * (down_um - up_um).max() / both_um.max() == pytest.approx(12.83, rel=1e-3)
    assert both_um.max() == pytest.approx(40.7, rel=1e-9)
    assert np.all(np.diff(up_um) > 0)
    with pytest.raises(ValueError, match=r"no loop of 0\.4"):
        ds.PaperPiezo(loop_width=0.4).weights_um_per_V


def open_loop_pct(axis):
    """Open loop with the straight line of the full stroke, by the definitions of Eq. 35 and 36."""
    reference_um = ds.paper_reference_um(axis, INTERVAL_s)
    line_V = ds.PAPER_BIAS_V + reference_um / axis.amplification / (40.7 / 120)
    error_um = reference_um - ds.PaperBench(axis).run(line_V[None])[0][0]
    return 100 * np.abs(error_um).max() / 2, 100 * np.sqrt(np.mean(error_um**2)) / 2


@pytest.mark.parametrize("name", TABLES)
def test_the_open_loops_are_calibrated(name):
    """Within 5 % is what is asked for; the calibration itself is exact to its last digits."""
    assert open_loop_pct(ds.PAPER_AXES[name]) == pytest.approx(TABLES[name], rel=2e-3)


def test_the_calibrated_numbers_are_found_again():
    """The gain error and the rest of an axis, by a root finder and by the duty that e_rms asks for."""
    axis = ds.PAPER_AXES["alpha"]
    without = dataclasses.replace(axis, rest_s=0.0)

    def excess(gain_error):
        return open_loop_pct(dataclasses.replace(without, gain_error=gain_error))[0] - TABLES["alpha"][0]

    assert scipy.optimize.brentq(excess, -0.4, 0.0, xtol=1e-5) == pytest.approx(axis.gain_error, abs=2e-4)
    duty = (TABLES["alpha"][1] / open_loop_pct(without)[1]) ** 2
    assert 2 * (1 / duty - 1) == pytest.approx(axis.rest_s, rel=0.01)


def test_the_step_under_feedforward_is_table_2(rng):
    """With the exact inverse, found by a root finder: overshoot, settling time and settling value."""
    axis, piezo = ds.PAPER_AXES["x"], ds.PaperPiezo()
    _, play_V = piezo.rest(ds.PAPER_BIAS_V)

    def missing_um(voltage_V):
        path_V = np.array([ds.PAPER_BIAS_V, voltage_V])
        return float(np.diff(elongation_um(piezo, path_V, play_V))[0]) - ds.PAPER_STEP_um / axis.amplification

    voltage_V = scipy.optimize.brentq(missing_um, ds.PAPER_BIAS_V, 60)
    found_um = ds.PaperBench(axis, piezo).run(np.full((1, 3000), voltage_V))[0][0]
    settled_um = found_um[-300:].mean()
    outside = np.flatnonzero(np.abs(found_um / settled_um - 1) > 0.02)
    assert 100 * (found_um.max() / settled_um - 1) == pytest.approx(66.12, rel=0.005)
    assert INTERVAL_s * (outside[-1] + 1) == pytest.approx(0.84, rel=0.01)
    assert settled_um == pytest.approx(6.429, rel=1e-3)
    zeta = axis.damping_ratio
    assert 100 * np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2)) == pytest.approx(66.12, rel=0.005)


def test_a_reading_is_a_mean_of_noisy_readings_with_a_last_digit(rng):
    sensor = ds.PaperSensor()
    still_um = np.full((4000, 20), rng.uniform(-1, 1))
    plain = dataclasses.replace(sensor, resolution_um=0.0).read(still_um, rng)
    assert plain.std() == pytest.approx(0.0318 / np.sqrt(20), rel=0.1)
    assert plain.mean() == pytest.approx(still_um[0, 0], abs=5 * 0.0318 / np.sqrt(still_um.size))
    counts = 20 * sensor.read(still_um, rng) / 0.1
    np.testing.assert_allclose(counts, np.rint(counts), rtol=0, atol=1e-6)


def test_records_are_what_the_fits_read(rng):
    loops = ds.paper_loops(ds.PaperPiezo(), ds.PaperSensor(), rng)
    assert list(loops) == ["time_s", "voltage_V", "displacement_um"]
    assert np.ptp(loops["voltage_V"]) == 120
    true_um = elongation_um(ds.PaperPiezo(), loops["voltage_V"], ds.PaperPiezo().radii_V)
    off_um = loops["displacement_um"] - true_um
    # 200 readings each: the noise, and what is left of the last digit.
    assert 0.002 < off_um.std() < 0.01
    assert abs(off_um.mean()) < 1e-3


def test_responses_are_those_of_the_slow_mode(rng):
    """Lines of the spectrum against the mode's own formula, but for a gain and the delay; the mean of two noises."""
    axis = ds.PAPER_AXES["z"]
    measured = ds.paper_responses(axis, ds.PaperPiezo(), ds.PaperSensor(), 2, rng)
    assert not np.array_equal(measured[0]["y1_um"], measured[1]["y1_um"])
    record = {name: np.mean([one[name] for one in measured], axis=0) for name in measured[0]}
    voltage_V, displacement_um = (record[name].reshape(4, -1).mean(axis=0) for name in ("u1_V", "y1_um"))
    first = slice(0, len(record["u1_V"]) // 4)
    assert set(zip(record["realization"].tolist(), record["period"].tolist(), strict=True)) == {
        (0, 0),
        (0, 1),
        (1, 0),
        (1, 1),
    }
    np.testing.assert_array_equal(record["u1_V"].reshape(4, -1)[0], record["u1_V"].reshape(4, -1)[1])
    frequency_Hz = np.fft.rfftfreq(len(record["u1_V"][first]), INTERVAL_s)
    lines = (frequency_Hz > 0.4) & (frequency_Hz < 12)
    ratio = np.abs(np.fft.rfft(displacement_um)[lines] / np.fft.rfft(voltage_V)[lines])
    s = 2j * np.pi * frequency_Hz[lines] / axis.natural_rad_per_s
    mode = np.abs(1 / (s**2 + 2 * axis.damping_ratio * s + 1))
    # The slope where the axis works is within the range of the piezo's; hysteresis bends the response a little.
    gain = np.median(ratio / mode)
    assert 0.6 < gain / (axis.amplification * 40.7 / 120) < 1.4
    np.testing.assert_allclose(ratio, gain * mode, rtol=0.1)


def test_references_begin_and_end_at_rest():
    for axis in ds.PAPER_AXES.values():
        reference_um = ds.paper_reference_um(axis, INTERVAL_s)
        moving = np.flatnonzero(reference_um > 1e-9) * INTERVAL_s
        assert moving[[0, -1]] == pytest.approx([axis.rest_s, axis.rest_s + 4], abs=2e-3)
        assert reference_um.max() == pytest.approx(2)
        assert all(abs(after - before) < 4e-3 for before, after in itertools.pairwise(reference_um.tolist()))


@pytest.mark.parametrize("wrong", [{"benches": 0}, {"interval_s": 1e-6}])
def test_benches_that_cannot_be_are_refused(wrong):
    with pytest.raises(ValueError, match="benches must be 1 or more and interval_s"):
        ds.PaperBench(ds.PAPER_AXES["x"], **wrong)
