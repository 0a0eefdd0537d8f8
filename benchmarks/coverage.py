"""How often the intervals of a fitted stage hold the truth, over random rigs of the bench.

Each rig has a hysteresis, a driver and a mechanics of its own; slow loops and a fast multisine are fitted jointly
without a guess. Prints a line per rig and the coverage of 95 % intervals. About 40 s per rig on one core.

    python benchmarks/coverage.py --rigs 50 [--seed 600] [--roughness 0]
"""

import argparse
import secrets
import time

import jax
import numpy as np

import data_synth
import fits

SCENARIO = """
name = "coverage"
description = "loops of all sizes at 200 Hz, and a multisine beyond the resonance"

[rig]
random = true
kind = "plays"
plays = 1500
roughness = {roughness}

[plant]
time_constant_s = {plant.time_constant_s}
natural_frequency_Hz = {plant.natural_frequency_Hz}
damping_ratio = {plant.damping_ratio}

[sensor]
noise_um = 0.03
quantum_um = 0.001

[[runs]]
name = "slow"
sample_rate_Hz = 200.0

[[runs.program]]
kind = "triangle"
cycles = 1
rate_V_per_s = 100.0

[[runs.program]]
kind = "forc"
side = "above"
reversals_V = [100.0, 80.0, 60.0, 40.0, 20.0]
rate_V_per_s = 100.0

[[runs.program]]
kind = "nested"
biases_V = [60.0]
amplitude_V = 60.0
loops = 8
rate_V_per_s = 100.0

[[runs]]
name = "fast"
sample_rate_Hz = {rate_Hz}

[[runs.program]]
kind = "triangle"
cycles = 1
rate_V_per_s = 600.0

[[runs.program]]
kind = "ramp"
to_V = 60.0
rate_V_per_s = 600.0

[[runs.program]]
kind = "multisine"
amplitude_V = 15.0
low_Hz = 2.0
high_Hz = {high_Hz}
period_s = 0.5
periods = 2
"""
NAMES = ("driver.time_constant_s", "mechanics.natural_frequency_Hz", "mechanics.damping_ratio")


def scores(seed: int, roughness: float) -> np.ndarray:
    """Errors of the three poles of one rig in standard deviations."""
    plant = data_synth.random_plant(np.random.default_rng(seed + 1000))
    high_Hz = min(2.5 * plant.natural_frequency_Hz, 1500.0)
    scenario = SCENARIO.format(plant=plant, roughness=roughness, high_Hz=high_Hz, rate_Hz=max(8 * high_Hz, 2000.0))
    bench = data_synth.simulate(data_synth.parse_scenario(scenario), seed)
    runs = [fits.Record(r.time_s, r.voltage_V, r.displacement_um, source=f"{r.name}.csv") for r in bench.records]
    found = fits.fit_stage(runs, holdout=0.0, initial="negative")
    truth = (plant.time_constant_s, plant.natural_frequency_Hz, plant.damping_ratio)
    return np.array([(found[name].value - value) / found[name].sd for name, value in zip(NAMES, truth, strict=True)])


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description="Coverage of the intervals of a fitted stage.")
    parser.add_argument("--rigs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=secrets.randbelow(10**6), help="of the first rig")
    parser.add_argument("--roughness", type=float, default=0.0, help="0 for smooth densities, 1 for random plays")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    found, refused = [], 0
    for seed in range(options.seed, options.seed + options.rigs):
        began = time.monotonic()
        try:
            found.append(scores(seed, options.roughness))
        except (fits.DataError, fits.FitError) as error:
            refused += 1
            print(seed, "refused:", error, flush=True)
            continue
        print(seed, *(f"{z:+.2f}" for z in found[-1]), f"{time.monotonic() - began:.0f} s", flush=True)
    z = np.array(found)
    for name, column in zip(NAMES, z.T, strict=True):
        inside, near = np.mean(np.abs(column) < 1.96), np.mean(np.abs(column) < 3)
        print(
            f"{name}: 95 % intervals hold {100 * inside:.0f} %, 3 sd {100 * near:.0f} %, rms {np.std(column):.2f} sd"
        )
    print(f"{refused} of {options.rigs} refused")


if __name__ == "__main__":
    main()
