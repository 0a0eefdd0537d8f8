"""A diagnosis made by hand."""

from dataclasses import replace

import numpy as np

from fits import ParameterEstimate, default_stage
from fits.diagnosis._result import (
    Bound,
    Diagnosis,
    Experiment,
    FoundCause,
    Gain,
    RunView,
    Test,
)
from fits.io._limits import Extreme

KINDS = ("no_effect", "effect_found", "unexplained")
ODD = "a <b> & \"c\" 'd'"


def run_view(rng, source, n):
    time_s = 0.01 * np.arange(n)
    voltage_V = 60 - 60 * np.cos(time_s)
    after_um = 0.01 * rng.standard_normal(n)
    before_um = after_um + 0.05 * np.sin(time_s)
    return RunView(source, time_s, voltage_V, voltage_V / 5, before_um, after_um, time_s < 0.8 * time_s[-1])


def cause(name, also=()):
    gain = ParameterEstimate("gain_per_decade", "1", 0.01542, 0.00031, 0.0148, 0.016)
    onset = ParameterEstimate("onset_s", "s", 0.1, np.nan, np.nan, np.inf)
    words = f"{name} shows {ODD}"
    return FoundCause(name, "log", also, 24.3, 3e-12, (gain, onset), 0.93, 0.045, words, "Steps.", "a book")


def diagnosis(rng, kind="effect_found", n=3000, count=2):
    names = {
        "no_effect": (),
        "effect_found": (cause("creep", ("thermal_drift",)),),
        "unexplained": (cause("mains_hum"), cause("backlash"), cause("sensor_lowpass")),
    }
    stage = default_stage()
    bounds = (Bound("friction", 0.4, 0.9, 0.02), Bound("thermal_gain", np.nan, np.nan, np.nan, f"no column {ODD}"))
    time_s = np.arange(0.0, 5.0, 0.01)
    program_V = 50 + 50 * np.sign(np.sin(time_s))
    extremes = (Extreme("displacement", -0.5, 38.2, 0.0, 40.0),)
    ahead = Experiment(time_s, program_V, "steps", "It decides.", ("creep", "aging"), 9.0, 1.0, extremes=extremes)
    return Diagnosis(
        verdict=kind,
        noise_um=0.0101,
        noise_source="repeated loops",
        noise_samples=1.8,
        causes=names[kind],
        unexplained_rms_um=0.012,
        upper_bounds=bounds,
        tests=(Test("voltage", 3.1, 0.002, 0.1, f"It depends, {ODD}."),),
        gain=Gain() if kind == "no_effect" else Gain(0.0471, 0.0123, 0.0008, noise_um=0.0101, source="slow.csv"),
        next_experiment=None if kind == "no_effect" else ahead,
        remarks=(f"Remark {ODD}",),
        baseline=stage,
        extended=stage,
        runs=tuple(run_view(rng, f"{ODD}{k}.csv", n) for k in range(count)),
        false_alarm=0.01,
        baseline_parameters=(ParameterEstimate("mechanics.natural_frequency_Hz", "Hz", 149.8, 0.21, 149.39, 150.21),),
        extended_parameters=(
            ParameterEstimate("mechanics.natural_frequency_Hz", "Hz", 150.02, 0.034, 149.95, 150.09),
            *(replace(each, name=f"{one.name}.{each.name}") for one in names[kind] for each in one.parameters),
        ),
    )
