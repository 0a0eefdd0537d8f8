"""A reading whose zero jumps: named with its instant, in each run at its own, and not where nothing jumps."""

import numpy as np
import pytest
from test_diagnosis_foreign import SLOW_V, plays

from fits import Record, diagnose

INTERVAL_s = 0.02


def records(rng, noise_um, instants_s, shift_um):
    """Two runs of plays, the reading of each off from an instant on, with noise; um."""
    time_s, found = INTERVAL_s * np.arange(len(SLOW_V)), []
    for k, instant_s in enumerate(instants_s):
        command_V = SLOW_V if k == 0 else SLOW_V[::-1]
        reading = plays(command_V) + shift_um * (time_s > instant_s) + noise_um * rng.standard_normal(len(time_s))
        found.append(Record(time_s, command_V, reading, source=f"{k}.csv"))
    return found


def test_the_zero_of_each_run_jumps_at_its_own_instant(rng):
    instants_s, shift_um = rng.uniform(10, 35, 2), 0.1
    found = diagnose(records(rng, 0.01, instants_s, shift_um), holdout=0.0)
    print(instants_s, [(cause.name, cause.parameters) for cause in found.causes])
    [cause] = found.causes
    assert cause.name == "zero_shift"
    values = {one.name: one.value for one in cause.parameters}
    got = [value for name, value in values.items() if name.startswith("after_s")]
    np.testing.assert_allclose(np.sort(got), np.sort(instants_s), atol=2 * INTERVAL_s)
    shifts = [value for name, value in values.items() if name.startswith("shift_um") and abs(value) > shift_um / 2]
    np.testing.assert_allclose(shifts, [shift_um] * 2, rtol=0.15)
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
