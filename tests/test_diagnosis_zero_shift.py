"""A reading whose zero jumps: named with its instant, in each run at its own, and not where nothing jumps."""

import numpy as np
import pytest
from test_diagnosis_foreign import SLOW_V, plays

from fits import Record, diagnose
from fits.diagnosis._occurrences import has_occurred, is_abrupt
from fits.diagnosis._prepare import Reading, prepare_diagnosis
from fits.diagnosis._refit import nothing, refit_beside
from fits.diagnosis._relocate import relocate
from fits.diagnosis._score import score
from fits.diagnosis._thresholds import THRESHOLDS

INTERVAL_s = 0.02


def records(rng, noise_um, instants_s, shift_um):
    """Two runs of plays, the reading of each off from an instant on, with noise; um."""
    time_s, found = INTERVAL_s * np.arange(len(SLOW_V)), []
    for k, instant_s in enumerate(instants_s):
        command_V = SLOW_V if k == 0 else SLOW_V[::-1]
        reading = plays(command_V) + shift_um * (time_s > instant_s) + noise_um * rng.standard_normal(len(time_s))
        found.append(Record(time_s, command_V, reading, source=f"{k}.csv"))
    return found


def wander(rng, step_um):
    """A slow random walk in lines, um."""
    time_s = INTERVAL_s * np.arange(len(SLOW_V))
    return np.interp(time_s, np.linspace(0, time_s[-1], 14), step_um * np.cumsum(rng.standard_normal(14)))


@pytest.mark.parametrize("jumps", [True, pytest.param(False, marks=pytest.mark.study)])
def test_a_jump_is_found_to_the_sample_and_a_wander_is_none(rng, jumps):
    time_s, instant_s = INTERVAL_s * np.arange(len(SLOW_V)), rng.uniform(10, 35)
    off = 0.05 * (time_s > instant_s) if jumps else wander(rng, 0.05)
    reading = plays(SLOW_V) + off + 0.005 * rng.standard_normal(len(time_s))
    record = Record(time_s, SLOW_V, reading, source="a.csv")
    ready = prepare_diagnosis(Reading([record], [], 0.0, "unknown"), lambda _: None)
    plain = nothing(ready.bench, ready.projector)
    probes = [probe for probe in ready.probes if probe.name == "zero_shift"]
    best = max(score(ready.projector, probes, plain.residual).each, key=lambda one: one.z)
    found = relocate(ready.bench, ready.projector, refit_beside(ready.bench, ready.projector, plain, best))
    shift = found.laws[0].effect(found.x[0], 0)
    print(instant_s, shift.after_s, shift.shift_um, shift.rise_s)
    assert best.z > 10
    assert is_abrupt(ready.bench, ready.projector, found, THRESHOLDS) == jumps
    if jumps:
        assert has_occurred(ready.bench, found)
        assert float(shift.after_s) == pytest.approx(instant_s, abs=2 * INTERVAL_s)
        assert float(shift.shift_um) == pytest.approx(0.05, rel=0.1)


@pytest.mark.study
def test_the_zero_of_each_run_jumps_at_its_own_instant(rng):
    instants_s, shift_um = rng.uniform(10, 35, 2), 0.1
    found = diagnose(records(rng, 0.01, instants_s, shift_um), holdout=0.0)
    print(instants_s, [(cause.name, cause.parameters) for cause in found.causes])
    [cause] = found.causes
    assert cause.name == "zero_shift"
    values = {one.name: one.value for one in cause.parameters}
    instants = [value for name, value in values.items() if name.startswith("after_s")]
    np.testing.assert_allclose(np.sort(instants), np.sort(instants_s), atol=2 * INTERVAL_s)
    shifts = [value for name, value in values.items() if name.startswith("shift_um") and abs(value) > shift_um / 2]
    np.testing.assert_allclose(shifts, [shift_um] * 2, rtol=0.15)
    # Between samples nothing shows of an instant.
    assert all(0 < one.sd <= INTERVAL_s for one in cause.parameters if one.unit == "s")
    assert found.verdict == "effect_found"


@pytest.mark.study
def test_a_reading_that_creeps_jumps_nowhere(rng):
    time_s = INTERVAL_s * np.arange(len(SLOW_V))
    crept = []
    for command_V in (SLOW_V, SLOW_V[::-1]):
        moved = plays(command_V)
        late = np.zeros(len(moved))
        for constant_s in (0.1, 1.0, 10.0):
            decay = np.exp(-INTERVAL_s / constant_s)
            slow = moved[0] + np.zeros(len(moved))
            for k in range(1, len(moved)):
                slow[k] = decay * slow[k - 1] + (1 - decay) * moved[k]
            late += 0.01 * (slow - moved[0])
        reading = moved + late + 0.005 * rng.standard_normal(len(moved))
        crept.append(Record(time_s, command_V, reading, source=f"{len(crept)}.csv"))
    found = diagnose(crept)
    assert found.causes
    assert "zero_shift" not in {name for cause in found.causes for name in (cause.name, *cause.also_consistent)}


@pytest.mark.study
def test_a_reading_that_wanders_jumps_nowhere(rng):
    time_s = INTERVAL_s * np.arange(len(SLOW_V))
    wandered = []
    for command_V in (SLOW_V, SLOW_V[::-1]):
        reading = plays(command_V) + wander(rng, 0.05) + 0.005 * rng.standard_normal(len(time_s))
        wandered.append(Record(time_s, command_V, reading, source=f"{len(wandered)}.csv"))
    found = diagnose(wandered, holdout=0.0)
    print(found.verdict, [cause.name for cause in found.causes])
    assert "zero_shift" not in {name for cause in found.causes for name in (cause.name, *cause.also_consistent)}
