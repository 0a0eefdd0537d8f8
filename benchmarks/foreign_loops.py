"""Loops of other laws, `fits.fit` on what is seen of them: error on what is not, and coverage of its 95 % band.

Usage: `python benchmarks/foreign_loops.py [--rigs 4] [--seed 0] [--program loops]`. Laws none of which is a smooth
density on a grid: sums of 300 plays with gamma or lognormal thresholds, or in a narrow ridge, of 5 to 8 plays, and a
grid of relays with a bell in the half-plane; each beside a straight line, with noise of 0.03 um on a stroke of some
20 um: white, and for the gamma law also rounded to 0.1 um, and coloured, AR(1) of 0.9 and 0.99. Three programs, from
negative saturation: `one way` is seen up only, `two turns` once up, down and up, and the last way back is predicted;
of `loops`, which shrink, the last third is predicted. Errors are in % of the stroke; `sd/rms` is the mean sd of the
band over the rms error.
"""

import argparse

import jax
import numpy as np

import fits

jax.config.update("jax_enable_x64", True)

LAWS, PROGRAMS = ("gamma", "lognormal", "bell", "ridge", "few"), ("one way", "two turns", "loops")
ROWS = [*((law, "white") for law in LAWS), ("gamma", "rounded"), ("gamma", "0.9"), ("gamma", "0.99")]
SAMPLES, NOISE_um, DIGIT_um, HIGH_V, RELAYS, PLAYS = 1500, 0.03, 0.1, 100.0, 120, 300


def program(name: str, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Voltage at a constant rate, shape `(n,)`, and the fraction at its end that is predicted."""
    turns_V = [0.0, 0.0, HIGH_V, HIGH_V, 0.0]
    if name == "two turns":
        turns_V = [0.0, rng.uniform(50, 70), rng.uniform(20, 40), HIGH_V, 0.0]
    elif name == "loops":
        shrinking = [
            v for k in range(6) for v in (HIGH_V - 12 * k * rng.uniform(0.5, 1), 6 * k * rng.uniform(0.5, 1))
        ]
        turns_V = [0.0, *shrinking, *rng.uniform(20, 90, 6)]
    lengths = np.abs(np.diff(turns_V))
    path = np.r_[0, np.cumsum(np.where(lengths == 0, 5.0, lengths))]
    voltage_V = np.interp(np.linspace(0, path[-1], SAMPLES), path, turns_V)
    return voltage_V, 1 / 3 if name == "loops" else float((path[-1] - path[-2] + 1) / path[-1])


def plays_V(law: str, rng: np.random.Generator) -> np.ndarray:
    """Radii of the plays of one rig, in V, shape `(k,)`."""
    if law == "gamma":
        return rng.gamma(2, rng.uniform(4, 10), PLAYS)
    if law == "lognormal":
        return rng.lognormal(np.log(rng.uniform(5, 15)), 0.8, PLAYS)
    if law == "ridge":
        return rng.normal(rng.uniform(8, 25), 1.0, PLAYS)
    return rng.uniform(2, 40, rng.integers(5, 9))


def displacement(law: str, voltage_V: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Answer of one rig from negative saturation, in um, shape `(n,)`."""
    line, share_um = rng.uniform(0.1, 0.16), rng.uniform(3, 8)
    out_um = line * voltage_V
    if law == "bell":
        at_V = (np.arange(RELAYS) + 0.5) / RELAYS * HIGH_V
        upper, lower = np.meshgrid(at_V, at_V, indexing="ij")
        bias, width = (upper + lower) / 2 - rng.uniform(30, 70), upper - lower - rng.uniform(0, 20)
        density = np.exp(-((bias / rng.uniform(25, 50)) ** 2) / 2 - (width / rng.uniform(15, 40)) ** 2 / 2)
        density *= upper >= lower
        on = np.zeros(density.shape, dtype=bool)
        for k, voltage in enumerate(voltage_V):
            on = (on | (upper <= voltage)) & (lower <= voltage)
            out_um[k] += share_um * np.sum(density * on) / np.sum(density)
        return out_um
    radius_V = plays_V(law, rng)
    place = voltage_V[0] + radius_V
    for k, voltage in enumerate(voltage_V):
        place = np.clip(place, voltage - radius_V, voltage + radius_V)
        out_um[k] += share_um * place.mean() / HIGH_V
    return out_um


def reading(true_um: np.ndarray, noise: str, rng: np.random.Generator) -> np.ndarray:
    """What a sensor says, in um, whose noise is white, rounded, or coloured as an AR(1) of the number given."""
    white = rng.standard_normal(len(true_um))
    if noise == "rounded":
        return DIGIT_um * np.round((true_um + NOISE_um * white) / DIGIT_um)
    if noise != "white":
        past = float(noise)
        for k in range(1, len(white)):
            white[k] = past * white[k - 1] + (1 - past**2) ** 0.5 * white[k]
    return true_um + NOISE_um * white


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=4, help="rigs of each law")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--program", choices=PROGRAMS, help="one alone")
    given = parser.parse_args()
    print("law       noise   program    error, mean and worst [%]  covered, mean and worst [%]  sd/rms")
    for law, noise in ROWS:
        for name in [given.program] if given.program else PROGRAMS:
            errors_pct, covered_pct, wide = [], [], []
            for rig in range(given.rigs):
                rng = np.random.default_rng([given.seed, LAWS.index(law), rig])
                voltage_V, fraction = program(name, rng)
                true_um = displacement(law, voltage_V, rng)
                read_um = reading(true_um, noise, rng)
                record = fits.Record(0.01 * np.arange(SAMPLES), voltage_V, read_um, source=f"{law}.csv")
                found = fits.fit([record], holdout=fraction, initial="negative")
                ahead = found.predict(record, initial="negative")
                held = np.arange(SAMPLES) >= SAMPLES - round(fraction * SAMPLES)
                off_um = true_um - ahead.displacement_um
                off_um, sd_um = (off_um - off_um[~held].mean())[held], ahead.displacement_sd_um[held]
                errors_pct.append(100 * np.sqrt(np.mean(off_um**2)) / np.ptp(true_um))
                covered_pct.append(100 * np.mean(np.abs(off_um) < 1.96 * sd_um))
                wide.append(sd_um.mean() / np.sqrt(np.mean(off_um**2)))
            print(
                f"{law:9} {noise:7} {name:10} {np.mean(errors_pct):8.3f} {np.max(errors_pct):8.3f} "
                f"{np.mean(covered_pct):19.0f} {np.min(covered_pct):8.0f} {np.exp(np.mean(np.log(wide))):16.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
