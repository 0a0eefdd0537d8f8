"""Modal models with several inputs in plain NumPy and SciPy: state matrices, no code shared with `microid`."""

import numpy as np
from scipy.linalg import block_diag


def state_space(natural_frequency_Hz, damping_ratio, gain, quadrature, residual):
    """Matrices `A, B, C, D`: for every mode and input a displacement and its rate over the natural one."""
    inputs = residual.shape[1]
    a, b, c = [], [], []
    for natural, damping, g, q in zip(natural_frequency_Hz, damping_ratio, gain, quadrature, strict=True):
        rate = 2 * np.pi * natural
        for i in range(inputs):
            a.append(np.array([[0, rate], [-rate, -2 * damping * rate]]))
            b.append(rate * np.outer([0, 1], np.eye(inputs)[i]))
            c.append(np.stack([g[:, i], q[:, i]], axis=1))
    return block_diag(*a), np.concatenate(b), np.concatenate(c, axis=1), residual


def response(frequency_Hz, a, b, c, d, delay_s):
    """`C (s - A)^-1 B + D`, late by the delay, at every frequency, shape `(f, p, m)`."""
    out = [c @ np.linalg.solve(2j * np.pi * f * np.eye(len(a)) - a, b) + d for f in frequency_Hz]
    return np.array(out) * np.exp(-2j * np.pi * np.asarray(frequency_Hz) * delay_s)[:, None, None]


def multisine(rng, samples, lines, rms, realizations, inputs):
    """Random-phase multisines of equal amplitudes, shape `(r, n, m)`."""
    spectrum = np.zeros((realizations, samples // 2 + 1, inputs), dtype=complex)
    spectrum[:, lines] = np.exp(2j * np.pi * rng.uniform(size=(realizations, len(lines), inputs)))
    signal = np.fft.irfft(spectrum, samples, axis=1)
    return rms * signal / np.std(signal, axis=1, keepdims=True)
