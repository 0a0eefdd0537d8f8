"""The records of the Bouc-Wen benchmark as CSV files."""

import json
from dataclasses import asdict

import numpy as np

from data_synth._bouc_wen import (
    BOUCWEN_RATE_HZ,
    BoucWenOscillator,
    boucwen_multisine,
    boucwen_response,
    boucwen_sweep,
)
from data_synth._types import FloatArray

BOUCWEN = "boucwen"
"""What the command calls the benchmark."""

# Of the estimation data; and the ends of the sweep, in Hz, with its rate in Hz/s.
_RMS_N, _NOISE_um, _SWEEP = 50.0, 8.0, (20.0, 50.0, 10 / 60)
# Samples that the filters of the sweep reach beyond the last that is kept.
_BEYOND = 50


def boucwen_files(seed: int = 0, samples: int | None = None) -> dict[str, str]:
    """Make the text of each file of the benchmark by its name, in some 40 s, most of which are those of the sweep.

    `estimation.csv` and `test_multisine.csv` hold one period of a multisine each in steady state, the first with 8 um
    of noise, `test_sweep.csv` a swept sine from rest without noise; the columns are `time_s,force_N,displacement_um`.
    `truth.json` holds the oscillator and the displacement without noise. Only the first `samples` of each record are
    kept. The same seed gives the same bytes.
    """
    rng, oscillator = np.random.default_rng(seed), BoucWenOscillator()
    forces = [boucwen_multisine(_RMS_N, rng) for _ in range(2)]
    records = [(force, 1e6 * boucwen_response(force, oscillator)) for force in forces]
    noise_um = rng.normal(0, _NOISE_um, len(forces[0]))
    start_Hz, stop_Hz, rate_Hz_per_s = _SWEEP
    if samples is not None:
        stop_Hz = min(stop_Hz, start_Hz + rate_Hz_per_s * (samples + _BEYOND) / BOUCWEN_RATE_HZ)
    force, moved = boucwen_sweep(
        start_Hz=start_Hz, stop_Hz=stop_Hz, rate_Hz_per_s=rate_Hz_per_s, oscillator=oscillator
    )
    (first, clean_um), test = records
    out = {
        "estimation.csv": _csv(first, clean_um + noise_um, samples),
        "test_multisine.csv": _csv(*test, samples),
        "test_sweep.csv": _csv(force, 1e6 * moved, samples),
    }
    truth = {
        "schema": "data_synth.boucwen/1",
        "seed": seed,
        "oscillator": asdict(oscillator),
        "noise_um": _NOISE_um,
        "runs": {"estimation": {"displacement_um": clean_um[:samples].tolist()}},
    }
    return out | {"truth.json": json.dumps(truth, indent=1, allow_nan=False) + "\n"}


def _csv(force_N: FloatArray, displacement_um: FloatArray, samples: int | None) -> str:
    time_s = np.arange(len(force_N)) / BOUCWEN_RATE_HZ
    rows = zip(*(column[:samples].tolist() for column in (time_s, force_N, displacement_um)), strict=True)
    return "\n".join(["time_s,force_N,displacement_um", *(",".join(map(repr, row)) for row in rows), ""])
