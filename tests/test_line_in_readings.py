"""A line in the readings, as a fan or a pump makes: taken out, and named a vibration."""

import numpy as np
import pytest
from test_diagnosis_residuals import regression, run_of

from fits import Record
from fits.diagnosis._noise import find_faults, name_faults
from fits.diagnosis._regression import Regression


def test_a_line_is_taken_out_of_all_runs_and_named(rng):
    n, rate_Hz, noise_um, amplitude_um = 5000, 2000.0, 6e-3, 0.05
    reg = regression(rng, lengths=(n, n), kinds=0)
    time_s, middle_Hz = np.arange(n) / rate_Hz, rng.uniform(230, 280)
    lines = [amplitude_um * np.sin(2 * np.pi * middle_Hz * time_s + rng.uniform(0, 6)) for _ in range(2)]
    left = [line + noise_um * rng.standard_normal(n) for line in lines]
    # A loop that is played again and again might make a line itself.
    command_V = np.interp(time_s, np.linspace(0, time_s[-1], 25), rng.uniform(0, 10, 25))
    runs = [run_of(command_V, command_V + one, rate_Hz) for one in left]
    reg.baseline.runs, reg.baseline.stroke_um, reg.baseline.dynamic = tuple(runs), 20.0, False
    reg.baseline.columns_um = np.zeros(12)

    def seen(rests):
        rows = tuple(0 * one for one in reg.rows)
        masks = tuple(run.fitted for run in runs)
        return Regression(reg.baseline, masks, rows, reg.nuisance, (), tuple(rests), reg.root, ((), ()))

    found = find_faults(seen(left))
    assert found.repaired
    for line, taken in zip(lines, found.lines_um, strict=True):
        np.testing.assert_allclose(taken, line, atol=0.1 * amplitude_um)
    records = [Record(time_s, run.record.voltage_V, run.displacement_um) for run in runs]
    for line, clean, record in zip(lines, found.clean(records), records, strict=True):
        change_um = record.displacement_um - clean.displacement_um
        np.testing.assert_allclose(change_um, line, atol=0.1 * amplitude_um)
    # Without it the noise is what it was, and the line is still what there was of it.
    again = find_faults(seen([one - taken for one, taken in zip(left, found.wrong_um, strict=True)])).beside(found)
    assert again.noise[0].total_um == pytest.approx(noise_um, rel=0.1)
    [fault] = name_faults(again, cyclic=False)
    assert fault.statistic == "band"
    (_, size_um, sd_um, _), (_, frequency_Hz, _, _) = fault.parameters
    assert size_um == pytest.approx(amplitude_um / 2**0.5, abs=6 * sd_um)
    assert frequency_Hz == pytest.approx(middle_Hz, abs=0.05)
