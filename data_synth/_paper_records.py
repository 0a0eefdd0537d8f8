"""What is measured on the paper's bench to identify it: slow loops of the piezo, and a response of each axis."""

import numpy as np

from data_synth._paper_bench import PAPER_BIAS_V, PaperAxis, PaperBench, PaperSensor
from data_synth._paper_piezo import PaperPiezo
from data_synth._plant import monotone_runs
from data_synth._programs import forc, multisine, nested, ramp, triangle
from data_synth._types import FloatArray

_LOOP_RATE_Hz = 100.0
_RESPONSE_RATE_Hz = 1000.0
_ABOVE_V, _SWING_V = 1.5, 0.75
_LOWEST_Hz, _HIGHEST_Hz, _PERIOD_s = 0.5, 20.0, 2.0
_REALIZATIONS, _PERIODS = 2, 2


def paper_loops(piezo: PaperPiezo, sensor: PaperSensor, rng: np.random.Generator) -> dict[str, FloatArray]:
    """Measure the elongation of the piezo over slow loops: the columns of a CSV.

    It is the piezo's, as the paper's 40.7 um are (erratum 38): so machining errors of the amplifier are not in it,
    and what it identifies compensates the driving error only.

    Returns
    -------
    dict
        `time_s`, `voltage_V` and `displacement_um`, each of shape `(n,)`.
    """
    top_V, pace = piezo.upper_V, {"rate_V_per_s": 60.0, "sample_rate_Hz": _LOOP_RATE_Hz}
    ends = {"lower_V": 0.0, "upper_V": top_V}
    turns_V = np.linspace(0, top_V, 13)
    slow = {"rate_V_per_s": 12.0, "sample_rate_Hz": _LOOP_RATE_Hz}
    pieces = [
        triangle(0.0, **ends, cycles=2, **pace),
        forc(0.0, side="above", reversals_V=turns_V[-2::-1].tolist(), **ends, **pace),
        ramp(top_V, to_V=0.0, **pace),
        forc(0.0, side="below", reversals_V=turns_V[1:].tolist(), **ends, **pace),
        nested(0.0, biases_V=[60.0], amplitude_V=60.0, loops=10, **pace),
    ]
    pieces.append(ramp(float(pieces[-1][-1]), to_V=top_V, **pace))
    # Where steps and tracking runs are, once more and slowly.
    pieces += [triangle(0.0, lower_V=0.0, upper_V=12.0, cycles=8, **slow)]
    voltage_V = np.concatenate([np.zeros(1), *pieces])
    elongation_um, states = [], piezo.radii_V
    for run_V in monotone_runs(voltage_V, 0.0):
        part_um, states = piezo.glide(run_V, states)
        elongation_um.append(part_um)
    # Each voltage is held while the sensor's readings are averaged.
    readings = round(sensor.rate_Hz / _LOOP_RATE_Hz)
    held_um = np.tile(np.concatenate(elongation_um)[:, None], readings)
    time_s = np.arange(len(voltage_V)) / _LOOP_RATE_Hz
    return {"time_s": time_s, "voltage_V": voltage_V, "displacement_um": sensor.read(held_um, rng)}


def paper_responses(
    axis: PaperAxis, piezo: PaperPiezo, sensor: PaperSensor, count: int, rng: np.random.Generator
) -> list[dict[str, FloatArray]]:
    """Measure `count` times how an axis answers to a multisine about where it works: the columns of CSVs.

    Returns
    -------
    list of dict
        `time_s`, `realization`, `period`, `u1_V` and `y1_um`, each of shape `(n,)`: periods in the steady state.
    """
    pace = {"rate_V_per_s": 10.0, "sample_rate_Hz": _RESPONSE_RATE_Hz}
    phases = np.random.default_rng(0)  # a program, and no noise
    waves = [
        multisine(
            PAPER_BIAS_V + _ABOVE_V,
            amplitude_V=_SWING_V,
            low_Hz=_LOWEST_Hz,
            high_Hz=_HIGHEST_Hz,
            period_s=_PERIOD_s,
            periods=1 + _PERIODS,
            rng=phases,
            sample_rate_Hz=_RESPONSE_RATE_Hz,
        )
        for _ in range(_REALIZATIONS)
    ]
    voltage_V = np.concatenate([ramp(PAPER_BIAS_V, to_V=PAPER_BIAS_V + _ABOVE_V, **pace), *waves])
    bench = PaperBench(axis, piezo, sensor, rng, count, 1 / _RESPONSE_RATE_Hz)
    _, reading_um = bench.run(np.tile(voltage_V, (count, 1)))
    samples = round(_PERIOD_s * _RESPONSE_RATE_Hz)
    # Of each realization, the first period is a transient.
    steady = np.arange(len(voltage_V) - _REALIZATIONS * len(waves[0]), len(voltage_V))
    steady = steady.reshape(_REALIZATIONS, 1 + _PERIODS, samples)[:, 1:].ravel()
    realization, period, _ = np.indices((_REALIZATIONS, _PERIODS, samples)).reshape(3, -1)
    common = {
        "time_s": np.arange(len(steady)) / _RESPONSE_RATE_Hz,
        "realization": realization.astype(float),
        "period": period.astype(float),
        "u1_V": voltage_V[steady],
    }
    return [common | {"y1_um": one[steady]} for one in reading_um]
