"""The Bouc-Wen benchmark: a mass on a hysteretic spring under a random-phase multisine or a swept sine.

J. P. Noel and M. Schoukens, "Hysteretic benchmark with a dynamic nonlinearity", Workshop on Nonlinear System
Identification Benchmarks, Brussels, 2016. The equations are integrated as stated there, by Newmark's rule at 15 kHz.
"""

from dataclasses import dataclass

import numpy as np
from scipy import signal

from data_synth._types import FloatArray

BOUCWEN_RATE_HZ = 750.0
"""Sampling rate of the records, in Hz."""

# Steps of integration per sample: 15 kHz.
_FINE = 20

_PERIOD, _SETTLING = 8192, 2
_LOWEST_Hz, _HIGHEST_Hz = 5.0, 150.0
# Newmark's rule with constant average acceleration, and the trapezoidal rule for the hysteretic force.
_A, _B, _C = 0.5, 0.25, 0.5
_CORRECTIONS, _SAME = 50, 1e-15


@dataclass(frozen=True)
class BoucWenOscillator:
    r"""The oscillator of the benchmark, in SI units.

    .. math:: m \ddot y + c \dot y + k y + z = u, \qquad
        \dot z = \alpha \dot y - \beta \left(\gamma |\dot y| |z|^{\nu - 1} z + \delta \dot y |z|^\nu\right)

    Attributes
    ----------
    mass_kg, damping_N_s_per_m, stiffness_N_per_m
        Linear part.
    alpha_N_per_m
        Slope of the hysteretic force at zero.
    beta, gamma, delta
        Shape of the loops; only `beta gamma` and `beta delta` can be seen, in 1/m for `nu` of one.
    nu
        How sharply the force bends.
    """

    mass_kg: float = 2.0
    damping_N_s_per_m: float = 10.0
    stiffness_N_per_m: float = 5e4
    alpha_N_per_m: float = 5e4
    beta: float = 1e3
    gamma: float = 0.8
    delta: float = -1.1
    nu: float = 1.0

    def respond_m(self, force_N: FloatArray, interval_s: float) -> FloatArray:
        """Displacement from rest, in m, shape (n,), under a force in N of the same shape.

        The implicit equations of every step are solved to the last digit.
        """
        mass, damping, stiffness = self.mass_kg, self.damping_N_s_per_m, self.stiffness_N_per_m
        alpha, bg, bd, nu, h = self.alpha_N_per_m, self.beta * self.gamma, self.beta * self.delta, self.nu, interval_s
        inertia = mass + h * _A * damping + h * h * _B * stiffness
        y = v = z = rate = 0.0
        a = (float(force_N[0]) - z) / mass
        out = np.empty(len(force_N))
        for n, u in enumerate(force_N.tolist()):
            if n:
                place, speed = y + h * v + h * h * (0.5 - _B) * a, v + h * (1 - _A) * a
                begun, load = z + h * (1 - _C) * rate, u - damping * speed - stiffness * place
                for _ in range(_CORRECTIONS):
                    a = (load - z) / inertia
                    v = speed + h * _A * a
                    size = abs(z)
                    rate = alpha * v - bg * abs(v) * size ** (nu - 1) * z - bd * v * size**nu
                    before, z = z, begun + h * _C * rate
                    if abs(z - before) <= _SAME * (1 + abs(z)):
                        break
                y = place + h * h * _B * a
            out[n] = y
        return out


def boucwen_response(force_N: FloatArray, oscillator: BoucWenOscillator = BoucWenOscillator()) -> FloatArray:
    """Displacement in steady state, in m, shape (n,), under one period of a band-limited force at 750 Hz.

    The force runs along its own harmonics between the samples. The response is brought down to 750 Hz without a
    filter, as that of a period can be: its harmonics from 375 Hz on are left out. A finite filter of the same band
    shifts it by some 2e-6 m.
    """
    half = len(force_N) // 2
    spectrum = np.fft.rfft(force_N)
    # The line at half the sampling rate has no phase of its own.
    spectrum[half] = 0
    fine = np.fft.irfft(np.pad(spectrum, (0, (_FINE - 1) * half)), 2 * _FINE * half) * _FINE
    moved = oscillator.respond_m(np.tile(fine, 1 + _SETTLING), 1 / (_FINE * BOUCWEN_RATE_HZ))[-len(fine) :]
    kept = np.fft.rfft(moved)[: half + 1] / _FINE
    kept[half] = 0
    return np.fft.irfft(kept, 2 * half)


def boucwen_multisine(rms_N: float, rng: np.random.Generator) -> FloatArray:
    """One period of 8,192 samples at 750 Hz of a random-phase multisine from 5 to 150 Hz, in N, shape (8192,)."""
    line_Hz = np.fft.rfftfreq(_PERIOD, 1 / BOUCWEN_RATE_HZ)
    excited = (line_Hz >= _LOWEST_Hz) & (line_Hz <= _HIGHEST_Hz)
    force = np.fft.irfft(np.where(excited, np.exp(2j * np.pi * rng.random(len(line_Hz))), 0), _PERIOD)
    return np.asarray(rms_N / np.sqrt(np.mean(force**2)) * force)


def boucwen_sweep(
    amplitude_N: float = 40.0,
    start_Hz: float = 20.0,
    stop_Hz: float = 50.0,
    rate_Hz_per_s: float = 10 / 60,
    oscillator: BoucWenOscillator = BoucWenOscillator(),
) -> tuple[FloatArray, FloatArray]:
    """A swept sine from rest; brought down to 750 Hz by filters without phase, by 2, 2 and 5.

    Returns
    -------
    force_N, displacement_m
        Shape (n,) each, with `n` of 750 Hz times the duration.
    """
    count = round((stop_Hz - start_Hz) / rate_Hz_per_s * BOUCWEN_RATE_HZ)
    time_s = np.arange(_FINE * count) / (_FINE * BOUCWEN_RATE_HZ)
    fine = amplitude_N * np.sin(2 * np.pi * (start_Hz * time_s + rate_Hz_per_s * time_s**2 / 2))
    moved = oscillator.respond_m(fine, time_s[1])
    for factor in (2, 2, 5):
        moved = signal.decimate(moved, factor, ftype="fir", zero_phase=True)
    return fine[::_FINE], np.asarray(moved)
