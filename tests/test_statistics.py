"""Calibration over fresh rigs: held-out error over the noise floor, and coverage of the prediction band."""

from dataclasses import replace

import numpy as np
import pytest

import data_synth
import fits

_RIGS = 20
_NOISE_UM = 0.03


@pytest.fixture(scope="module")
def study():
    """Fits of fresh rigs; relays are fine enough for their staircase to stay below the band."""
    seed = int(np.random.SeedSequence().generate_state(1)[0])
    print(f"study seed {seed}")
    plain = data_synth.load_scenario("quickstart")
    scenario = replace(plain, rig=replace(plain.rig, relays=4000))
    ratios, coverage, alarms = [], [], []
    for number in range(_RIGS):
        bench = data_synth.simulate(scenario, seed=seed + number)
        train, heldout = (fits.Record(r.time_s, r.voltage_V, r.displacement_um, source=r.name) for r in bench.records)
        found = fits.fit([train], holdout=[heldout], levels=16, initial="negative")
        prediction = found.predict(heldout, initial="negative")
        off = prediction.displacement_um - bench.records[1].true_displacement_um
        # The sensor's offset belongs to the record, not to the model: it is judged with the model's own.
        off += bench.records[0].true_displacement_um[0] - found.model.offset_um
        off -= off.mean()
        ratios.append(found.held_out.rms_um / _NOISE_UM)
        coverage.append(np.mean(np.abs(off) < 1.96 * prediction.displacement_sd_um))
        alarms.append(found.correlation_samples > 1.2)
    print(f"e_rms over the noise floor: median {np.median(ratios):.3f}, largest {max(ratios):.3f}")
    print(f"coverage of the 95 % band: mean {np.mean(coverage):.3f}, smallest {min(coverage):.3f}")
    print(f"white residuals called coloured: {sum(alarms)} of {_RIGS}")
    return np.array(ratios), np.array(coverage), np.array(alarms)


@pytest.mark.study
def test_held_out_error_is_the_noise(study):
    assert np.median(study[0]) < 1.05


@pytest.mark.study
def test_band_covers_the_truth(study):
    assert 0.90 <= np.mean(study[1]) <= 0.99


@pytest.mark.study
def test_clean_data_raise_few_alarms(study):
    assert np.mean(study[2]) <= 0.2
