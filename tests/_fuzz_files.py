"""A good file of every kind that a user can name, small ones."""

import json
from pathlib import Path

import numpy as np
from _sweeps import small

import fits
import microid as m
from fits.control._gains import GAINS
from fits.machining._design_file import design_text
from microid import Stage

SAMPLES, LEVELS = 120, 4
SCENARIO = """
name = "small"
description = "A small one."
seed = 5
[rig]
kind = "plays"
plays = 40
[plant]
time_constant_s = 0.0008
natural_frequency_Hz = 180.0
damping_ratio = 0.04
[sensor]
noise_um = 0.03
quantum_um = 0.001
[temperature]
wander_K = 0.2
[[effects]]
name = "creep"
share = 0.1
[[runs]]
name = "slow"
sample_rate_Hz = 20.0
[[runs.program]]
kind = "triangle"
cycles = 1
rate_V_per_s = 60.0
[[runs.program]]
kind = "steps"
levels_V = [81.7, 31.3]
dwell_s = 0.5
rate_V_per_s = 600.0
"""


def loops(n=SAMPLES):
    """Two loops of a play operator, as seen by a noisy sensor."""
    time_s = 0.01 * np.arange(n)
    voltage_V = 50 - 50 * np.cos(4 * np.pi * np.arange(n) / (n - 1))
    play_V, at = np.zeros(n), 0.0
    for k, value in enumerate(voltage_V):
        play_V[k] = at = min(max(at, value - 5), value + 5)
    noise_um = 0.02 * np.random.default_rng(0).standard_normal(n)
    return {"time_s": time_s, "voltage_V": voltage_V, "displacement_um": 0.2 * play_V + 1 + noise_um}


def csv(columns):
    rows = [",".join(f"{value:.9g}" for value in row) for row in zip(*columns.values(), strict=True)]
    return "\n".join([",".join(columns), *rows, ""]).encode()


def good_files(folder: Path, model: Path) -> dict[str, Path]:
    """Write a good file of each kind; `model` is a fitted loop."""
    rng, run = np.random.default_rng(1), loops()
    time_s = run["time_s"]
    frequency_Hz = np.linspace(10.0, 500.0, 60)
    response = 0.3 / (1 - (frequency_Hz / 200) ** 2 + 0.1j * frequency_Hz / 200)
    turns = np.tile(np.arange(32), 6) / 32
    group = np.repeat(np.arange(6), 32)
    wave = sum(np.cos(2 * np.pi * (k * turns + group // 2 * k**2 / 7)) for k in range(1, 6))
    texts = {
        "record.csv": csv(run),
        "program.csv": csv({name: run[name] for name in ("time_s", "voltage_V")}),
        "reference.csv": csv({"time_s": time_s, "displacement_um": 10 - 4 * np.cos(9 * time_s)}),
        "idle.csv": csv({"time_s": time_s, "displacement_um": 0.1 + 0.03 * rng.standard_normal(SAMPLES)}),
        "response.csv": csv(
            {"frequency_Hz": frequency_Hz, "real_um_per_V": response.real, "imag_um_per_V": response.imag}
        ),
        "multisine.csv": csv(
            {
                "time_s": 1e-3 * np.arange(192),
                "realization": group // 2,
                "period": group % 2,
                "u1_V": wave,
                "y1_um": 0.2 * wave + 0.01 * rng.standard_normal(192),
            }
        ),
        "model.json": model.read_bytes(),
        "design.toml": design_text(fits.paper_design()).encode(),
        "scenario.toml": SCENARIO.encode(),
        "sweep.toml": small(3, rows=20).encode(),
        "gains.json": json.dumps({"gains": dict.fromkeys(GAINS, 0.01)}).encode(),
    }
    for name, data in texts.items():
        (folder / name).write_bytes(data)
    loaded = fits.load_model(model)
    stage = Stage.of(driver=m.Driver(1e-3), hysteresis=loaded.model, mechanics=m.Mechanics(150.0, 0.05))
    fits.save_model(folder / "stage.json", stage, None, loaded.report)
    return {path.name: path for path in folder.iterdir() if path.name in (*texts, "stage.json")}
