import re

import numpy as np
import pytest
from _measured import measured

from fits import read_table
from fits.io._errors import DataError
from fits.io._read_csv import read_table as read_csv
from fits.io._units import parse_columns


def sine(n=400):
    """Voltage 0 to 100 V and its time in s, shape (n,): two periods."""
    time_s = np.arange(n) / 100
    return time_s, 50 - 50 * np.cos(np.pi * time_s)


def warned(folder, time_s, voltage_V, displacement_um, columns=None):
    path = folder / "a.csv"
    rows = np.stack([time_s, voltage_V, displacement_um], axis=1)
    np.savetxt(path, rows, "%.17g", delimiter=",", header="time_s,voltage_V,displacement_um", comments="")
    return read_csv(path, columns).warnings


SWAP = r"--columns voltage_V=displacement_um\[V\],displacement_um=voltage_V\[um\]"
STROKES = [  # um per V as written in the file, words of the warning
    (0.006, None),
    (0.2, None),
    (15.0, None),
    (45.0, None),
    (200.0, r"200 um/V.*in nm instead of um \(--columns displacement_um=displacement_um\[nm\]\).*swapped \(" + SWAP),
    (2e-4, r"0\.0002 um/V.*in mm instead of um.*voltage_V=voltage_V\[mV\]"),
    (2e5, "in pm instead of um"),
    (2e-7, "in m instead of um"),
]


@pytest.mark.parametrize(("ratio", "words"), STROKES)
def test_stroke_per_volt(tmp_path, ratio, words):
    time_s, voltage_V = sine()
    found = warned(tmp_path, time_s, voltage_V, ratio * voltage_V)
    assert len(found) == (0 if words is None else 1)
    assert words is None or re.search(words, found[0])


def test_falling_displacement(tmp_path):
    time_s, voltage_V = sine()
    (sentence,) = warned(tmp_path, time_s, voltage_V, -0.2 * voltage_V)
    assert "line" not in sentence
    assert "falls as the voltage rises; flip its sign with --columns displacement_um=-displacement_um" in sentence
    assert warned(tmp_path, time_s, voltage_V, -0.2 * voltage_V, {"displacement_um": "-displacement_um"}) == ()


def test_measured_voltage_and_swapped_columns(tmp_path, rng):
    time_s, voltage_V = sine()
    noisy_V = voltage_V + rng.normal(size=voltage_V.size)  # steps of the sine are below 0.8 V
    noisy_um = 0.2 * noisy_V
    (measured,) = warned(tmp_path, time_s, noisy_V, noisy_um)
    assert re.search(r"turns round at \d+% of the samples.*--columns voltage_V=NAME", measured)
    (swapped,) = warned(tmp_path, time_s, noisy_V, 0.2 * voltage_V)
    assert re.search("noisy while the displacement is smooth.*swapped.*" + SWAP, swapped)
    multisine_V = rng.uniform(0, 100, 400)  # turns round often, but as commanded
    assert warned(tmp_path, time_s, multisine_V, 0.2 * multisine_V) == ()


def test_gaps_are_warned_of_but_uneven_sampling_is_not(tmp_path, rng):
    time_s, voltage_V = sine()
    (sentence,) = warned(tmp_path, time_s + (time_s > 2.005), voltage_V, 0.2 * voltage_V)
    # Samples 200 (2.00 s, line 202) and 201 (line 203) are 0.01 s + 1 s apart.
    assert "a.csv, line 203, column 'time_s': a gap of 1.01 s after 2 s" in sentence
    for uneven_s in (np.cumsum(rng.exponential(size=400)), 1.05 ** np.arange(400.0), np.cumsum([0.1, 1.0] * 200)):
        assert warned(tmp_path, uneven_s, voltage_V, 0.2 * voltage_V) == ()


@pytest.mark.parametrize(
    "name",
    [
        "picma_p885_sine_1hz",
        "picma_p885_amplitude_modulated",
        "afm_z_piezo_hold30s",
        "afm_z_piezo_50um_2rates",
        "afm_z_piezo_5um",
    ],
)
def test_real_files_are_read_without_warnings(name):
    path = measured(f"{name}.csv")
    expected = np.loadtxt(path, delimiter=",", skiprows=1)
    record = read_csv(path)
    assert record.warnings == ()
    assert np.array_equal(np.stack([record.time_s, record.voltage_V, record.displacement_um]), expected[:, :3].T)


@pytest.mark.parametrize("name", ["fsm_cubespec_100mV_train.csv", "fsm_cubespec_300mV_train.csv"])
def test_real_multi_run_files_are_split_where_the_message_says(tmp_path, name):
    path = measured(name)
    columns = parse_columns("voltage_V=u1_V,displacement_um=y1_um")
    with pytest.raises(DataError) as caught:
        read_csv(path, columns)
    # Two periods of 8192 samples and the header come before the first restart.
    assert ", line 16386, column 'time_s': expected strictly" in str(caught.value)
    assert "found a restart at 0 s" in str(caught.value)
    lines = path.read_text().split("\n")
    (tmp_path / "a.csv").write_text("\n".join(lines[:16385]))
    record = read_csv(tmp_path / "a.csv", columns)
    assert (len(record), record.warnings) == (16384, ())
    assert set(record.extra) == {"realization", "period", "u2_V", "u3_V", "y2_um", "y3_um"}


def test_a_sensor_at_its_end_is_noticed(tmp_path):
    time = np.arange(400) / 100
    voltage = 50 - 50 * np.cos(time)
    whole = 0.3 * voltage + 0.01 * np.sin(40 * time)
    for displacement, lines in ((whole, None), (np.minimum(whole, 27.0), "largest, 27 um")):
        path = tmp_path / "run.csv"
        rows = [f"{t:.4f},{v:.6f},{d:.6f}" for t, v, d in zip(time, voltage, displacement, strict=True)]
        path.write_text("\n".join(["time_s,voltage_V,displacement_um", *rows]) + "\n")
        warnings = read_csv(path).warnings
        assert [lines in warning for warning in warnings] == ([True] if lines else [])


def test_a_column_in_a_unit_of_another_quantity_is_not_proposed():
    with pytest.raises(DataError, match=r"'time_s': 't\[UNIT\]', 'voltage_V': 'Vcmd\[UNIT\]', 'disp"):
        read_table({"t": np.arange(9.0), "Vcmd": np.arange(9.0), "gauge_um": np.arange(9.0)})


def test_a_rate_beside_a_column_of_times_at_another_is_remarked_on(tmp_path):
    time_s, voltage_V = sine()
    warned(tmp_path, time_s, voltage_V, 0.2 * voltage_V)
    found = read_csv(tmp_path / "a.csv", sample_rate_Hz=50.0)
    np.testing.assert_array_equal(found.time_s, np.arange(len(time_s)) / 50)
    (sentence,) = found.warnings
    assert "a.csv, column 'time_s': it holds times at 100 Hz, and --sample-rate 50 was taken instead" in sentence
    assert read_csv(tmp_path / "a.csv", sample_rate_Hz=100.0).warnings == ()


def test_numbers_that_name_the_time_too_are_counted_with_it(tmp_path):
    """Two numbers, meant as time and voltage, were taken for voltage and displacement."""
    time_s, voltage_V = sine()
    warned(tmp_path, time_s, voltage_V, 0.2 * voltage_V)
    words = "expected by --columns 3 numbers, for time_s, voltage_V, displacement_um, found 2; give one for each"
    with pytest.raises(DataError, match=words):
        read_csv(tmp_path / "a.csv", "1,2")
    np.testing.assert_array_equal(read_csv(tmp_path / "a.csv", "1,2", ("time_s", "voltage_V")).voltage_V, voltage_V)
    np.testing.assert_array_equal(read_csv(tmp_path / "a.csv", "2,-3").displacement_um, -0.2 * voltage_V)
    with pytest.raises(DataError, match=r"found unit 's'.*'voltage_V=time_s\[SCALE V\]'"):
        read_csv(tmp_path / "a.csv", {"voltage_V": "time_s"})
