"""Fits of measured records, where they are at hand."""

import numpy as np
import pytest
from _measured import measured

import fits


@pytest.mark.study
def test_sine_of_a_picma_stack_held_out():
    record = fits.read_csv(measured("picma_p885_sine_1hz.csv"))
    found = fits.fit([record], holdout=0.3, levels=12)
    assert found.in_sample.e_rms_pct < 1.0
    assert found.held_out.e_rms_pct < 1.2
    # A memoryless curve is left with the loop; the model must take off most of it.
    curve = np.polynomial.Polynomial.fit(record.voltage_V, record.displacement_um, 5)(record.voltage_V)
    assert found.held_out.rms_um < 0.2 * np.std(record.displacement_um - curve)
    assert found.runs[0].loop_model_pct == pytest.approx(found.runs[0].loop_measured_pct, rel=0.1)
    # One amplitude only, and more than noise is left: both must be said.
    assert any("no loop smaller" in remark for remark in found.remarks)
    assert any("neighbouring residuals agree" in remark for remark in found.remarks)


@pytest.mark.study
def test_amplitudes_of_a_picma_stack_held_out():
    found = fits.fit([fits.read_csv(measured("picma_p885_amplitude_modulated.csv"))], holdout=0.3, levels=16)
    assert found.held_out.e_rms_pct < 1.2
    assert not any("no loop smaller" in remark for remark in found.remarks)


def test_a_record_that_never_closes_a_loop_is_refused():
    with pytest.raises(fits.DataError, match="start each run with a full loop"):
        fits.fit([fits.read_csv(measured("afm_z_piezo_50um_2rates.csv"))], holdout=0.3)
