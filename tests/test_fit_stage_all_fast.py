"""Runs that are all as fast, and none near the resonance: the hysteresis that is read off them holds their lag."""

import numpy as np
import pytest
from _lags import through

import fits

RATE_Hz, NOISE_um, SUBSTEPS = 10_000.0, 2e-3, 8
NAMES = "driver.time_constant_s", "mechanics.natural_frequency_Hz", "mechanics.damping_ratio"


def measured(rng, voltage_V, tau_s, natural_Hz, damping, source):
    """Driver, 400 plays of gamma-distributed widths and a mode, in steps of an eighth of the sampling interval."""
    rows, fast_Hz, natural = np.arange(len(voltage_V)), RATE_Hz * SUBSTEPS, 2 * np.pi * natural_Hz
    fine = np.interp(np.arange((len(rows) - 1) * SUBSTEPS + 1) / SUBSTEPS, rows, voltage_V)
    driven = through([1], [tau_s, 1], fine, fast_Hz)
    half_V = np.random.default_rng(1).gamma(2.0, 6.0, 400)
    place, moved = driven[0] + half_V, np.empty(len(driven))
    for k, voltage in enumerate(driven):
        place = np.minimum(np.maximum(place, voltage - half_V), voltage + half_V)
        moved[k] = 0.2 * voltage + 0.06 * place.mean()
    moved = through([natural**2], [1, 2 * damping * natural, natural**2], moved, fast_Hz)[::SUBSTEPS]
    return fits.Record(rows / RATE_Hz, voltage_V, moved + NOISE_um * rng.standard_normal(len(rows)), source=source)


@pytest.mark.study
def test_poles_are_found_that_a_hysteresis_read_off_beforehand_hides(rng):
    """A resonance of 433 Hz behind 0.3 ms had been left out, and a delay of 0.3 ms been named."""
    rig = rng.uniform(2e-4, 4e-4), rng.uniform(380, 480), rng.uniform(0.02, 0.05)
    time_s = np.arange(0, 0.3, 1 / RATE_Hz)
    decay_V = 48 * (1 - np.exp(-time_s / 0.15) * np.cos(2 * np.pi * rng.uniform(35, 45) * time_s))
    longer_s = np.arange(0, 0.42, 1 / RATE_Hz)
    chirp_V = 48 * (1 - np.cos(2 * np.pi * 10 * 0.42 / np.log(8.7) * (8.7 ** (longer_s / 0.42) - 1)))
    runs = [measured(rng, decay_V, *rig, "decay.csv"), measured(rng, chirp_V, *rig, "chirp.csv")]
    result = fits.fit_stage(runs, initial="negative")
    print(result.summary())
    assert result.misfit.times_noise < 2
    for name, true in zip(NAMES, rig, strict=True):
        assert abs(result[name].value - true) < max(5 * result[name].sd, 0.1 * true), name
