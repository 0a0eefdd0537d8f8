"""The measuring error from an idle record, against plain loops, theory and drawn truth."""

import numpy as np
import pytest
from _command import whole_picture
from scipy import signal, stats

import fits
from fits.machining._idle import idle_noise, read_idle
from fits.plots._machining import plot_idle
from fits.stats._noise_spectrum import find_lines

RATE_Hz = 1000.0


def at_rest(displacement_um, rate_Hz=RATE_Hz):
    return fits.Reference(np.arange(len(displacement_um)) / rate_Hz, displacement_um, "idle.csv")


def correlated(rng, n, pole):
    """First-order autoregressive noise, stationary from its first sample, of variance 1."""
    step = rng.normal(size=n) * np.sqrt(1 - pole**2)
    step[0] = rng.normal()
    return signal.lfilter([1.0], [1.0, -pole], step)


def test_offset_and_random_part_are_kept_apart(rng):
    offset_um, sd_um = rng.uniform(0.05, 0.2), rng.uniform(0.01, 0.05)
    readings = offset_um + sd_um * rng.normal(size=20_000)
    noise = idle_noise(at_rest(readings))
    assert noise.mean_um == pytest.approx(np.mean(readings))
    assert noise.sd_um == pytest.approx(np.std(readings, ddof=1))
    assert noise.peak_to_peak_um == readings.max() - readings.min()
    assert (noise.samples, noise.rate_Hz, noise.duration_s) == pytest.approx((20_000, RATE_Hz, 20.0))
    # Zeroing removes the mean and nothing else, whatever the paper takes for the error.
    assert noise.error_um() == pytest.approx(2 * noise.sd_um)
    assert noise.error_um(coverage=3.0) == pytest.approx(3 * noise.sd_um)
    assert noise.error_um(zeroed=False) == pytest.approx(noise.mean_um + 2 * noise.sd_um)
    shifted = idle_noise(at_rest(readings - 1.0))
    assert shifted.error_um() == pytest.approx(noise.error_um())
    assert shifted.error_um(zeroed=False) == pytest.approx(1 - noise.mean_um + 2 * noise.sd_um)
    assert np.mean(np.abs(readings - offset_um) < noise.error_um()) == pytest.approx(0.954, abs=0.01)
    assert "zeroing" in noise.remarks[0]
    assert "3.18 %" in noise.remarks[1]
    assert noise.resolution_um is None
    with pytest.raises(ValueError, match="positive coverage"):
        noise.error_um(coverage=0.0)


def test_drift_is_the_least_squares_line(rng):
    time_s = np.arange(5000) / RATE_Hz
    slope = rng.choice([-1, 1]) * rng.uniform(0.02, 0.1)
    readings = slope * time_s + 0.03 * rng.normal(size=5000)
    noise = idle_noise(at_rest(readings))
    line = stats.linregress(time_s, readings)
    assert noise.drift_um_per_s == pytest.approx(line.slope)
    assert abs(noise.drift_um_per_s - slope) < 5 * noise.drift_sd_um_per_s
    # White noise: at least the textbook error, and not much more.
    assert 0.95 * line.stderr < noise.drift_sd_um_per_s < 1.8 * line.stderr
    residual = readings - line.intercept - line.slope * time_s
    assert noise.sd_detrended_um == pytest.approx(np.sqrt(residual @ residual / 4998))
    assert any("drift" in remark for remark in noise.remarks)


@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_the_mean_lies_within_its_error_as_often_as_it_should(rng, pole):
    runs = 160
    noises = [idle_noise(at_rest(correlated(rng, 3000, pole))) for _ in range(runs)]
    inside = sum(abs(noise.mean_um) < 1.96 * noise.mean_sd_um for noise in noises)
    low, high = stats.binom.ppf([1e-5, 1 - 1e-5], runs, [0.92, 0.98])
    assert low <= inside <= high
    drifts = sum(abs(noise.drift_um_per_s) < 1.96 * noise.drift_sd_um_per_s for noise in noises)
    assert low <= drifts <= high
    # Integrated correlation time of a first-order process, in closed form.
    expected_s = (1 + pole) / (1 - pole) / RATE_Hz
    assert 0.75 * expected_s < np.median([noise.correlation_s for noise in noises]) < 1.3 * expected_s


def test_allan_deviation_is_that_of_a_double_loop(rng):
    n = 120
    readings = 5 + rng.normal(size=n).cumsum() + rng.normal(size=n)
    noise = idle_noise(at_rest(readings))
    lengths = np.rint(noise.averaging_s * RATE_Hz).astype(int)
    assert lengths[0] == 1
    assert lengths[-1] == n // 3
    for m, found in zip(lengths, noise.adev_um, strict=True):
        total, count = 0.0, 0
        for k in range(n - 2 * m + 1):
            first = sum(readings[k + j] for j in range(m)) / m
            second = sum(readings[k + m + j] for j in range(m)) / m
            total += (second - first) ** 2
            count += 1
        assert found == pytest.approx((total / count / 2) ** 0.5)


def test_allan_slopes_of_white_noise_random_walk_and_drift(rng):
    n = 60_000
    white = rng.normal(size=n)
    for readings, slope in ((white, -0.5), (np.cumsum(white), 0.5), (1e3 * np.arange(n) + white, 1.0)):
        noise = idle_noise(at_rest(readings))
        some = (noise.averaging_s > 0.01) & (noise.averaging_s < 1.0)
        found = np.polyfit(np.log(noise.averaging_s[some]), np.log(noise.adev_um[some]), 1)[0]
        assert found == pytest.approx(slope, abs=0.1)
    noise = idle_noise(at_rest(white))
    expected = 1 / np.sqrt(noise.averaging_s * RATE_Hz)
    assert np.all(np.abs(noise.adev_um - expected) < 6 * noise.adev_sd_um)
    # White noise of 1 and a random walk of 0.01 a step: 1/m + 1e-4 m/3 is least at m = 100 sqrt 3.
    noise = idle_noise(at_rest(white + 0.01 * np.cumsum(rng.normal(size=n))))
    # At long averaging times the deviation itself scatters, and may be as small there.
    short = noise.averaging_s < 2.0
    lowest = int(np.argmin(noise.adev_um[short]))
    assert 0.06 < noise.averaging_s[short][lowest] < 0.5
    assert noise.adev_um[short][lowest] == pytest.approx(np.sqrt(2 / (100 * np.sqrt(3))), rel=0.3)
    # So slight a walk may go unnoticed; one ten times as fast does not.
    noise = idle_noise(at_rest(white + 0.1 * np.cumsum(rng.normal(size=n))))
    assert any("wander" in remark for remark in noise.remarks)


@pytest.mark.parametrize("n", [9999, 10_000])
def test_spectrum_and_bands_hold_the_variance(rng, n):
    readings = 0.1 + 0.03 * correlated(rng, n, 0.5)
    noise = idle_noise(at_rest(readings))
    variance = noise.sd_detrended_um**2
    assert sum(band.sd_um**2 for band in noise.bands) == pytest.approx(variance * (n - 2) / n, rel=1e-9)
    step_Hz = noise.frequency_Hz[1] - noise.frequency_Hz[0]
    assert np.sum(noise.asd_um_per_rtHz**2) * step_Hz == pytest.approx(variance, rel=0.08)
    edges = [band.low_Hz for band in noise.bands] + [noise.bands[-1].high_Hz]
    assert edges == pytest.approx([0, 1, 10, 100, RATE_Hz / 2])
    # One-sided density of the process, in closed form.
    turn = np.exp(-2j * np.pi * noise.frequency_Hz / RATE_Hz)
    exact = 2 / RATE_Hz * 0.03**2 * (1 - 0.5**2) / np.abs(1 - 0.5 * turn) ** 2
    assert np.mean(noise.asd_um_per_rtHz**2 / exact) == pytest.approx(1, abs=0.1)


def test_lines_are_found_with_frequency_and_amplitude(rng):
    n = 30_000
    time_s = np.arange(n) / RATE_Hz
    truth = {50.0: 0.01, rng.uniform(120, 400): 0.004, rng.uniform(3, 10): 1.0}
    readings = 0.03 * correlated(rng, n, 0.3)
    for frequency_Hz, amplitude_um in truth.items():
        readings += amplitude_um * np.sin(2 * np.pi * frequency_Hz * time_s + rng.uniform(0, 2 * np.pi))
    noise = idle_noise(at_rest(readings))
    # A chance line beside the three is allowed one time in a hundred, and then it is a small one.
    assert 3 <= len(noise.lines) <= 4
    for line, (frequency_Hz, amplitude_um) in zip(
        noise.lines, sorted(truth.items(), key=lambda i: -i[1]), strict=False
    ):
        assert line.frequency_Hz == pytest.approx(frequency_Hz, abs=1.5 * RATE_Hz / n)
        assert abs(line.amplitude_um - amplitude_um) < 6 * line.amplitude_sd_um
        assert line.false_alarm < 0.01
    assert any("Narrow lines" in remark for remark in noise.remarks)


def test_the_error_of_an_amplitude_is_its_spread(rng):
    turns = 2 * np.pi * 123.4 * np.arange(4000) / RATE_Hz
    records = (np.sin(turns + rng.uniform(0, 2 * np.pi)) + rng.normal(size=4000) for _ in range(100))
    lines = [find_lines(readings, RATE_Hz)[0] for readings in records]
    off = np.array([(line.amplitude_um - 1) / line.amplitude_sd_um for line in lines])
    assert abs(off.mean()) < 0.6
    assert 0.75 < off.std() < 1.5


@pytest.mark.parametrize("colour", ["white", "correlated", "wandering"])
def test_noise_alone_shows_lines_no_more_often_than_stated(rng, colour):
    runs, n, lines = 400, 1000, 0
    for _ in range(runs):
        readings = correlated(rng, n, 0.95 if colour == "correlated" else 0.0)
        if colour == "wandering":
            readings += 0.05 * np.cumsum(rng.normal(size=n))
        lines += len(find_lines(signal.detrend(readings), RATE_Hz, false_alarm=0.05)) > 0
    # One in twenty at most, and not much fewer; each bound is missed by chance once in 100 000 tests.
    assert 0 < lines <= stats.binom.ppf(1 - 1e-5, runs, 0.05)


def test_a_quantum_is_found_and_counts(rng):
    quantum = rng.uniform(0.01, 0.1)
    level = 0.1 + 2 * quantum * rng.normal(size=5000)
    assert idle_noise(at_rest(quantum * np.round(level / quantum))).resolution_um == pytest.approx(quantum, rel=1e-6)
    # As a file has it, with its own rounding.
    written = np.round(quantum * np.round(level / quantum), 5)
    assert idle_noise(at_rest(written)).resolution_um == pytest.approx(quantum, rel=1e-3)
    assert idle_noise(at_rest(level)).resolution_um is None
    # A last digit that flickers once in a while: the quantum is what is known.
    flicker = quantum * (rng.random(5000) < 0.01)
    flicker[10] = quantum
    noise = idle_noise(at_rest(flicker))
    assert noise.error_um(coverage=1.0) == pytest.approx(quantum / np.sqrt(12))
    assert any("quantum" in remark for remark in noise.remarks)


def write(path, rows, header="time_ms,displacement_nm"):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]))
    return path


def test_a_file_is_read_with_its_units_and_a_constant_voltage(tmp_path, rng):
    readings = rng.normal(size=200)
    rows = [(k * 0.5, 1000 * x, 7) for k, x in enumerate(readings)]
    reference = read_idle(write(tmp_path / "idle.csv", rows, "time_ms,displacement_nm,voltage_V"))
    np.testing.assert_allclose(reference.displacement_um, readings)
    np.testing.assert_allclose(reference.time_s, np.arange(200) / 2000)
    flipped = read_idle(tmp_path / "idle.csv", {"displacement_um": "-displacement_nm"})
    np.testing.assert_allclose(flipped.displacement_um, -readings)
    assert idle_noise(reference).source == "idle.csv"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            lambda t, x, u: (t[:99], x, u),
            "expected at least 100 samples, found 99; record the stage at rest for longer",
        ),
        (
            lambda t, x, u: (t, np.zeros(150), u),
            "column 'displacement_um': expected readings that scatter, found 0 um",
        ),
        (lambda t, x, u: (t + (t > 0.1), x, u), "line 103, column 'time_s': expected even time steps.*cut the file"),
        (lambda t, x, u: (t[::-1], x, u), "expected strictly increasing times"),
        (
            lambda t, x, u: (t, x, u + (t > 0.05)),
            "line 53, column 'voltage_V': not idle: expected a constant voltage",
        ),
        (lambda t, x, u: (t, x + np.where(t > 0.05, np.nan, 0), u), "expected a finite number"),
    ],
)
def test_what_is_no_idle_record_is_refused_in_a_sentence(tmp_path, rng, change, sentence):
    columns = change(np.arange(150) / 1000, rng.normal(size=150), np.zeros(150))
    path = write(tmp_path / "idle.csv", zip(*columns, strict=False), "time_s,displacement_um,voltage_V")
    with pytest.raises(fits.DataError, match=sentence) as caught:
        read_idle(path)
    assert str(caught.value).count("\n") == 0


def test_arrays_that_are_no_idle_record_are_refused_too(rng):
    readings = rng.normal(size=150)
    for reference in (
        at_rest(readings[:50]),
        at_rest(np.ones(150)),
        fits.Reference(np.arange(150) ** 1.5, readings),
    ):
        with pytest.raises(fits.DataError, match=r"expected .*; "):
            idle_noise(reference)


def test_a_line_without_noise_divides_nothing_by_zero():
    noise = idle_noise(at_rest(0.5 * np.arange(1000)))
    assert noise.sd_detrended_um == 0
    assert noise.mean_sd_um == 0
    assert noise.lines == ()


@pytest.mark.parametrize("quantum", [0.0, 0.02])
def test_the_picture_shows_everything_and_is_not_cut(tmp_path, rng, quantum):
    time_s = np.arange(5000) / RATE_Hz
    readings = 0.1 + 0.03 * rng.normal(size=5000) + 0.01 * np.sin(2 * np.pi * 50 * time_s)
    readings = quantum * np.round(readings / quantum) if quantum else readings
    reference = at_rest(readings)
    (path,) = plot_idle(reference, idle_noise(reference), tmp_path)
    assert path == tmp_path / "idle.png"
    assert whole_picture(path).shape[1] == pytest.approx(180 / 25.4 * 200, abs=8)
