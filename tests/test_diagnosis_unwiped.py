"""Until an unknown past is wiped out a rig is elsewhere than its model, and what depends on where it is with it."""

import numpy as np
import pytest

from fits import Record, diagnose

RATE_Hz, COUNT, NOISE_um = 1000.0, 4000, 0.003


def plays(voltage_V, radii_V, at_V):
    """Plays that were at some places before, shape `(n, k)`."""
    found = np.empty((len(voltage_V), len(radii_V)))
    for n, now_V in enumerate(voltage_V):
        at_V = np.clip(at_V, now_V - radii_V, now_V + radii_V)
        found[n] = at_V
    return found


@pytest.mark.study
def test_a_cyclic_error_is_read_where_the_past_has_put_the_stage(rng):
    """It was not found, or came out a tenth too small beside a rest of several times the noise."""
    radii_V = np.linspace(0.5, 45, 90)
    weights = rng.gamma(3.0, 1.0, 90) * np.exp(-radii_V / 20)
    weights *= 12 / 100 / np.sum(weights)
    amplitude_um, period_um, second = rng.uniform(0.025, 0.035), rng.uniform(0.8, 1.2), rng.uniform(0.2, 0.4)
    phase, time = rng.uniform(0, 2 * np.pi), np.arange(COUNT) / RATE_Hz
    growing_V = 50 + (8 + 42 * time / time[-1]) * np.sin(2 * np.pi * rng.uniform(2.2, 2.6) * time)
    waves = rng.uniform(0.8, 2.6, 5)
    many_V = np.sum([np.sin(2 * np.pi * f * time + rng.uniform(0, 2 * np.pi)) for f in waves], axis=0)
    many_V = 50 + 48 * (0.2 + 0.8 * time / time[-1]) * many_V / np.max(np.abs(many_V))
    runs = []
    for source, drive_V in (("growing.csv", growing_V), ("many.csv", many_V)):
        before_V = np.r_[rng.permutation([0.0, 100.0]), 50 + rng.uniform(-45, 45, 12), drive_V[0]]
        driven_V = np.interp(np.arange(0, len(before_V) - 1, 0.02), np.arange(len(before_V)), before_V)
        begun_V = plays(driven_V, radii_V, np.full(len(radii_V), 50.0))[-1]
        place_um = plays(drive_V, radii_V, begun_V) @ weights + 0.03 * drive_V
        turn = 2 * np.pi * place_um / period_um + phase
        waves_um = amplitude_um * (np.cos(turn) + second * np.cos(2 * turn + 1))
        read_um = place_um + waves_um + NOISE_um * rng.standard_normal(COUNT)
        runs.append(Record(time, drive_V, read_um, source=source))
    found = diagnose(runs)
    print(amplitude_um, second, period_um, found.summary())
    # The past is estimated as smooth: on four rigs 2, 7, 0 and 10 % were missing, on two of them 4 nm unexplained;
    # one had a further cause.
    [cause] = [one for one in found.causes if one.name == "cyclic_error"]
    values = {one.name: one.value for one in cause.parameters}
    found_um = np.hypot(values["cosine_um[0]"], values["sine_um[0]"])
    assert found_um == pytest.approx(amplitude_um, rel=0.2)
    assert values["period_um"] == pytest.approx(period_um, rel=2e-3)
