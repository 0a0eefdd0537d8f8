"""Linear plants and hysteresis laws in plain NumPy and SciPy: no code is shared with `microid`."""

import numpy as np
from scipy.linalg import expm


def driver_and_mechanics(time_constant_s, natural_frequency_Hz, damping_ratio):
    """State matrix and input of a driver followed by mechanics: voltage, displacement, velocity over omega."""
    rate = 2 * np.pi * natural_frequency_Hz
    a = np.array(
        [[-1 / time_constant_s, 0, 0], [0, 0, rate], [rate, -rate, -2 * damping_ratio * rate]],
    )
    return a, np.array([1 / time_constant_s, 0, 0])


def mechanics_alone(natural_frequency_Hz, damping_ratio):
    rate = 2 * np.pi * natural_frequency_Hz
    return np.array([[0, rate], [-rate, -2 * damping_ratio * rate]]), np.array([0, rate])


def van_loan(a, b, interval_s, hold):
    """Transition matrix and the weights of the input at either end of an interval, from one matrix exponential."""
    n = len(a)
    big = np.zeros((n + 2, n + 2))
    big[:n, :n], big[:n, n], big[n, n + 1] = a * interval_s, b * interval_s, 1
    big = expm(big)
    if hold == "zero":
        return big[:n, :n], big[:n, n], np.zeros(n)
    return big[:n, :n], big[:n, n] - big[:n, n + 1], big[:n, n + 1]


def by_eigenvalues(a, b, interval_s, hold):
    """The same for poles that stand apart, however far: SciPy's exponential loses digits of stiff matrices."""
    rates, vectors = np.linalg.eig(a)
    x, inward = rates * interval_s, np.linalg.solve(vectors, b)
    step = ((vectors * np.exp(x)) @ np.linalg.inv(vectors)).real
    whole = (vectors * np.expm1(x) / rates @ inward).real
    there = (vectors * (np.expm1(x) - x) / (x * rates) @ inward).real
    return (step, whole, 0 * whole) if hold == "zero" else (step, whole - there, there)


def states(a, b, time_s, signal, hold, before=None, interval=van_loan):
    """States at all samples, from rest under `before`; every interval has its own matrix exponential."""
    x = np.linalg.solve(a, -b) * (signal[0] if before is None else before)
    known, out = {}, [x]
    for k, h in enumerate(np.diff(time_s)):
        if h not in known:
            known[h] = interval(a, b, h, hold)
        step, here, there = known[h]
        x = step @ x + here * signal[k] + there * signal[k + 1]
        out.append(x)
    return np.array(out)


def settling(a, b, time_s, signal, time_constant_s, before):
    """States at all samples of a signal that settles from each to the next: a lag of the first order that is held."""
    n, rate = len(a), 1 / time_constant_s
    x, out = np.linalg.solve(a, -b) * before, []
    for k, value in enumerate(signal):
        out.append(x)
        if k + 1 == len(signal):
            return np.array(out)
        h = time_s[k + 1] - time_s[k]
        aim = value + (signal[k + 1] - value) / -np.expm1(-h * rate)
        big = np.zeros((n + 2, n + 2))
        big[:n, :n], big[:n, n], big[n, n:] = a, b, [-rate, rate]
        x = (expm(big * h) @ np.concatenate([x, [value, aim]]))[:n]


def smoothed(time_s, signal):
    """Samples whose joining lines have, on average, the height of the parabolas through three samples each."""
    out = np.array(signal, dtype=float)
    for k in range(1, len(out) - 1):
        bend = np.polyfit(time_s[k - 1 : k + 2] - time_s[k], signal[k - 1 : k + 2], 2)[0]
        out[k] -= bend * (time_s[k] - time_s[k - 1]) * (time_s[k + 1] - time_s[k]) / 6
    return out


def play_positions(signal, slack, start):
    """Positions of plays, one sample and one play after the other."""
    position, out = np.array(start, dtype=float), []
    for value in signal:
        for k, r in enumerate(slack):
            position[k] = max(value - r, min(value + r, position[k]))
        out.append(position.copy())
    return np.array(out)
