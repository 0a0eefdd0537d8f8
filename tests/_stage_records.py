"""Runs of stages made by SciPy alone, for tests of their identification."""

import numpy as np
from scipy import signal

from fits import Record


def linear_displacement(time_s, voltage_V, time_constant_s, natural_frequency_Hz, damping_ratio, gain_um_per_V):
    """Driver, gain and mechanics under a voltage in lines, from rest under no voltage."""
    rate = 2 * np.pi * natural_frequency_Hz
    below = np.polymul([time_constant_s, 1.0], [1 / rate**2, 2 * damping_ratio / rate, 1.0])
    return signal.lsim(signal.TransferFunction([gain_um_per_V], below), voltage_V, time_s)[1]


def multisine(rng, time_s, low_Hz, high_Hz, period_s, peak_V):
    """Random phases on all lines of a band, scaled to a peak."""
    lines = np.arange(np.ceil(low_Hz * period_s), high_Hz * period_s) / period_s
    phase = rng.uniform(0, 2 * np.pi, len(lines))
    wave = np.sum(np.cos(2 * np.pi * lines[:, None] * time_s + phase[:, None]), axis=0)
    return peak_V * wave / np.max(np.abs(wave))


def coloured(rng, n, sd, pole):
    """Noise whose samples follow each other with a pole, of a given standard deviation."""
    white = rng.standard_normal(n + 500) * sd * np.sqrt(1 - pole**2)
    return signal.lfilter([1.0], [1.0, -pole], white)[500:]


def linear_record(rng, truth, n=3000, rate_Hz=4000.0, noise_um=0.02, pole=0.0, source="fast.csv"):
    """A multisine run of a linear stage, from 0 V on; `truth` are the arguments of `linear_displacement`."""
    time = np.arange(n) / rate_Hz
    voltage = multisine(rng, time, 4.0, 3 * truth["natural_frequency_Hz"], 0.25, 20.0)
    voltage = voltage - voltage[0]
    clean = linear_displacement(time, voltage, **truth)
    return Record(time, voltage, clean + 3.0 + coloured(rng, n, noise_um, pole), source=source)
