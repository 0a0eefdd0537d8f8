"""Sweeps for tests, and stages simulated by SciPy and a loop of relays."""

import numpy as np
from scipy.signal import StateSpace, lsim

from fits.sweeps._spec import parse_sweep

SMALL = """
schema = "microid.sweep/1"
kind = "simulate"
seed = {seed}
[program]
shape = "sine"
samples = 60
interval_s = 1e-3
offset_V = 60.0
amplitude_V = 40.0
frequency_Hz = 40.0
[design]
method = "random"
rows = {rows}
[[axis]]
parameter = "mechanics.natural_frequency_Hz"
low = 80.0
high = 160.0
[[axis]]
parameter = "mechanics.damping_ratio"
mean = 0.05
sd = 0.04
[run]
chunk_rows = {chunk}
"""


def refuse(name):
    raise AssertionError(f"{name} is not a file of this sweep")


def parsed(text, **files):
    return parse_sweep(text, "sweep.toml", lambda name: files.get(name.partition(".")[0], b""))


def small(seed, rows=600, chunk=256):
    return SMALL.format(seed=seed, rows=rows, chunk=chunk)


class Relays:
    """A Preisach operator whose relays are counted one by one, from negative saturation."""

    def __init__(self, stage, cells=400):
        preisach = stage["hysteresis"]
        low, high = float(preisach.density.lower_V), float(preisach.density.upper_V)
        centre = low + (np.arange(cells) + 0.5) * (high - low) / cells
        alpha, beta = np.meshgrid(centre, centre, indexing="ij")
        keep = alpha >= beta
        self.alpha, self.beta = alpha[keep], beta[keep]
        area = ((high - low) / cells) ** 2 * np.where(self.alpha == self.beta, 0.5, 1.0)
        self.weight = np.asarray(preisach.density(self.alpha, self.beta)) * area
        self.state = np.zeros(len(self.alpha), dtype=bool)
        slope = np.asarray(preisach.reversible.slope_um_per_V)
        self.fine = np.linspace(low, high, 20001)
        middle = (self.fine[1:] + self.fine[:-1]) / 2
        rises = np.interp(middle, np.linspace(low, high, len(slope)), slope) * np.diff(self.fine)
        self.curve = np.concatenate([[0.0], np.cumsum(rises)]) + float(preisach.offset_um)

    def __call__(self, value):
        self.state = np.where(value >= self.alpha, True, np.where(value <= self.beta, False, self.state))
        return float(self.weight[self.state].sum() + np.interp(value, self.fine, self.curve))


def stage_um(stage, values, time_s, voltage_V):
    """Response of driver, relays and mechanics, by SciPy and a loop."""
    tau = values.get("driver.time_constant_s", float(stage["driver"].time_constant_s))
    rate = 2 * np.pi * values.get("mechanics.natural_frequency_Hz", float(stage["mechanics"].natural_frequency_Hz))
    damping = values.get("mechanics.damping_ratio", float(stage["mechanics"].damping_ratio))
    _, driven, _ = lsim(StateSpace([[-1 / tau]], [[1 / tau]], [[1.0]], [[0.0]]), voltage_V, time_s, X0=[voltage_V[0]])
    relays = Relays(stage)
    relays(voltage_V[0])
    loaded = np.array([relays(value) for value in driven])
    matrix = [[0.0, 1.0], [-(rate**2), -2 * damping * rate]]
    plant = StateSpace(matrix, [[0.0], [rate**2]], [[1.0, 0.0]], [[0.0]])
    return lsim(plant, loaded, time_s, X0=[loaded[0], 0.0])[1]
