"""What a diagnosis makes of a real record."""

import numpy as np
import pytest
from _measured import measured

import fits


@pytest.mark.study
def test_the_cause_is_found_why_a_real_record_predicts_badly():
    # In-sample the plain hysteresis looks fine; the last third is predicted several times worse.
    found = fits.diagnose([fits.read_csv(measured("picma_p885_amplitude_modulated.csv"))], holdout=1 / 3)
    assert found.verdict == "effect_found"
    # Its authors mention a delay of the acquisition; which lag it is, the record cannot tell.
    lags = {"sensor_lowpass", "transport_delay"}
    assert lags & {name for cause in found.causes for name in (cause.name, *cause.also_consistent)}
    assert found.gain.heldout_rms_after_um < found.gain.heldout_rms_before_um / 2


@pytest.mark.study
def test_creep_is_read_off_what_a_controller_took_back():
    # At constant height the voltage falls by 1.5 % of the step with each decade of time.
    found = fits.diagnose([fits.read_csv(measured("afm_z_piezo_hold30s.csv"))])
    assert found.causes[0].name == "creep"
    gain = next(one for one in found.causes[0].parameters if one.name == "gain_per_decade")
    assert gain.value == pytest.approx(0.015, rel=0.2)
    assert any("a controller held the displacement" in words for words in found.remarks)


@pytest.mark.study
def test_one_branch_shows_no_effect_that_a_density_does_not():
    # Up from an unknown past and down again: any function of the voltage is a density there.
    record = fits.read_csv(measured("afm_z_piezo_5um.csv"))
    found = fits.diagnose([record])
    # A hum of 0.7 nm goes with the time, not with the voltage: that may be there.
    assert {cause.name for cause in found.causes} <= {"mains_hum"}
    assert found.unexplained_rms_um < 0.001 * np.ptp(record.displacement_um)
