"""Frequency responses from analysers: every way of writing one down says the same, and modes are found in it."""

import numpy as np
import pytest
from scipy.signal import freqs

import fits

FREQUENCY_Hz = np.linspace(5, 300, 120)


def measured(rng):
    """One mode, by SciPy's `freqs`: its frequency, damping ratio and noisy response in um/V."""
    natural_Hz, damping = rng.uniform(80, 150), rng.uniform(0.01, 0.05)
    pole = 2 * np.pi * natural_Hz
    exact = freqs([0.3 * pole**2], [1, 2 * damping * pole, pole**2], 2 * np.pi * FREQUENCY_Hz)[1]
    noise = 1e-3 * (rng.standard_normal(len(exact)) + 1j * rng.standard_normal(len(exact)))
    return natural_Hz, damping, exact + noise


def write(path, **columns):
    rows = zip(*(np.broadcast_to(column, FREQUENCY_Hz.shape) for column in columns.values()), strict=True)
    path.write_text("\n".join([",".join(columns), *(",".join(map(repr, map(float, row))) for row in rows)]))
    return path


def test_modes_are_found_however_the_response_is_written(rng, tmp_path):
    natural_Hz, damping, response = measured(rng)
    size, angle = np.abs(response), np.unwrap(np.angle(response))
    ways = (
        {"real_um_per_V": response.real, "imag_um_per_V": response.imag, "variance_um2_per_V2": 2e-6},
        {"magnitude_um_per_V": size, "phase_deg": np.degrees(angle)},
        {"magnitude_dB": 20 * np.log10(size), "phase_rad": angle},
    )
    for way in ways:
        data = fits.read_response(write(tmp_path / "response.csv", frequency_Hz=FREQUENCY_Hz, **way))
        np.testing.assert_allclose(data.response_um_per_V[:, 0, 0], response, rtol=1e-12)
        assert (data.variance_um2_per_V2 is None) == ("variance_um2_per_V2" not in way)
    found = fits.fit_response(data, 1)
    for name, truth in (("natural_frequency_Hz", natural_Hz), ("damping_ratio", damping)):
        assert abs(getattr(found.model, name)[0] - truth) < 5 * getattr(found.sd, name)[0]


@pytest.mark.parametrize(
    ("columns", "sentence"),
    [
        ({"real_um_per_V": 1.0}, "expected the columns frequency_Hz and either real_um_per_V and imag_um_per_V"),
        ({"real_um_per_V": 1, "imag_um_per_V": 0, "magnitude_dB": 0, "phase_deg": 0}, "rename or drop columns"),
        ({"magnitude_dB": 0, "magnitude_um_per_V": 1, "phase_deg": 0}, "found both; drop one"),
        ({"magnitude_um_per_V": -1, "phase_deg": 0}, "line 2, column 'magnitude_um_per_V': expected magnitudes"),
        ({"real_um_per_V": 1, "imag_um_per_V": np.nan}, "column 'imag_um_per_V'"),
        ({"real_um_per_V": 1, "imag_um_per_V": 0, "variance_um2_per_V2": 0}, "expected positive variances"),
    ],
)
def test_odd_files_are_refused_in_a_sentence(columns, sentence, tmp_path):
    with pytest.raises(fits.DataError, match=sentence):
        fits.read_response(write(tmp_path / "response.csv", frequency_Hz=FREQUENCY_Hz, **columns))


def test_frequencies_that_do_not_increase_are_named_by_line(tmp_path):
    path = write(tmp_path / "response.csv", frequency_Hz=FREQUENCY_Hz, real_um_per_V=1, imag_um_per_V=0)
    lines = path.read_text().split("\n")
    path.write_text("\n".join([*lines[:4], lines[2], *lines[4:]]))
    with pytest.raises(fits.DataError, match=r"line 5, column 'frequency_Hz': expected frequencies that increase"):
        fits.read_response(path)
