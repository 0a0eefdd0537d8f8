"""Stages whose hysteresis is of other laws, `fits.fit_stage` on their runs: poles, and cover of the band.

Usage: `python benchmarks/foreign_stages.py [--rigs 4] [--seed 0] [--law few]`. The laws, but for the bell, and the
noise are those of `foreign_loops.py`; a driver's lag of 0.1 to 2 ms is ahead of the plays, a resonance of 80 to
600 Hz with a damping of 0.01 to 0.2 behind them. Slow loops at 200 Hz and a fast multisine are fitted jointly,
without a guess; a random program at an intermediate rate is predicted. Of each rig: errors of the poles in sd, share
of the prediction that the 95 % band covers, and rms of its sd over that of the error. About 10 s per rig.
"""

import argparse
import time
from collections.abc import Sequence

import jax
import numpy as np
import scipy
from foreign_loops import HIGH_V, plays_V, reading

import fits

LAWS = ("gamma", "lognormal", "ridge", "few")
ROWS = [*((law, "white") for law in LAWS), ("gamma", "rounded"), ("gamma", "0.9"), ("gamma", "0.99")]
NAMES = ("driver.time_constant_s", "mechanics.natural_frequency_Hz", "mechanics.damping_ratio")
SLOW_Hz, SLOW_V_per_s, FAST_V_per_s = 200.0, 100.0, 600.0
SLOW_V = 0, 100, 0, 100, 80, 100, 60, 100, 40, 100, 20, 100, 0, 90, 10, 85, 15, 80, 20, 75, 25, 70, 30, 60, 40, 50, 0


def ways_V(turns_V: Sequence[float], rate_V_per_s: float, rate_Hz: float) -> np.ndarray:
    """Samples of a voltage that runs at a constant rate from turn to turn, shape `(n,)`."""
    way_V = np.r_[0, np.cumsum(np.abs(np.diff(turns_V)))]
    return np.interp(np.arange(0, way_V[-1], rate_V_per_s / rate_Hz), way_V, turns_V)


def plays(voltage_V: np.ndarray, radius_V: np.ndarray) -> np.ndarray:
    """Mean of plays from negative saturation at 0 V, in V, `(n,)`: between turns a broken line in the voltage."""
    turns = 1 + np.flatnonzero(np.diff(np.sign(np.diff(voltage_V))))
    place, out = radius_V.copy(), np.empty(len(voltage_V))
    for first, last in zip(np.r_[0, turns], np.r_[turns, len(voltage_V) - 1], strict=True):
        sign = np.sign(voltage_V[last] - voltage_V[first]) or 1.0
        # A play moves once the voltage is a radius beyond it.
        starts = np.sort(sign * place + radius_V)
        behind = np.r_[0, np.cumsum(starts)]
        piece = sign * voltage_V[first : last + 1]
        moving = np.searchsorted(starts, piece)
        out[first : last + 1] = place.mean() + sign * (moving * piece - behind[moving]) / len(place)
        place = sign * np.maximum(sign * place, piece[-1] - radius_V)
    return out


class Rig:
    """A stage, and what it answers; `poles` are the time constant in s, the frequency in Hz and the damping."""

    def __init__(self, law: str, rng: np.random.Generator):
        self.line, share_um = rng.uniform(0.1, 0.16), rng.uniform(3, 8)
        self.radius_V, self.share = plays_V(law, rng), share_um / HIGH_V
        self.poles = np.exp(rng.uniform(np.log([1e-4, 80.0, 0.01]), np.log([2e-3, 600.0, 0.2])))

    def answer(self, voltage_V: np.ndarray, rate_Hz: float) -> np.ndarray:
        """Displacement at the samples of a voltage that runs in lines, from rest, in um, `(n,)`."""
        tau_s, natural_Hz, damping = self.poles
        omega = 2 * np.pi * natural_Hz
        parts = int(np.ceil(20 / (rate_Hz * min(tau_s, 1 / omega))))
        fine = np.interp(np.arange((len(voltage_V) - 1) * parts + 1) / parts, np.arange(len(voltage_V)), voltage_V)
        lagging = self._filtered([1], [tau_s, 1], fine, rate_Hz * parts)
        drive = self.line * lagging + self.share * plays(lagging, self.radius_V)
        drive = self.behind_hysteresis(drive, rate_Hz * parts)
        whole = self._filtered([omega**2], [1, 2 * damping * omega, omega**2], drive, rate_Hz * parts)
        return self.read(whole, rate_Hz * parts)[::parts]

    def behind_hysteresis(self, displacement_um: np.ndarray, rate_Hz: float) -> np.ndarray:
        """What drives the mechanics, in um, `(n,)`: for other rigs to change."""
        return displacement_um

    def read(self, displacement_um: np.ndarray, rate_Hz: float) -> np.ndarray:
        """What the sensor makes of it, in um, `(n,)`: for other rigs to change."""
        return displacement_um

    @staticmethod
    def _filtered(above: list[float], below: list[float], values: np.ndarray, rate_Hz: float) -> np.ndarray:
        """Exact for what runs in lines between samples."""
        over, under, _ = scipy.signal.cont2discrete((above, below), 1 / rate_Hz, "foh")
        return scipy.signal.lfilter(np.ravel(over), under, values - values[0]) + values[0]


def programs(rig: Rig, rng: np.random.Generator) -> list[tuple[str, np.ndarray, float]]:
    """Name, voltage and rate in Hz of the runs: slow, fast, and one to predict."""
    high_Hz = min(2.5 * rig.poles[1], 1500.0)
    fast_Hz = max(8 * high_Hz, 2000.0)
    lines = np.arange(2, high_Hz, 2.0)
    time_s = np.arange(0, 1.0, 1 / fast_Hz)
    waves = np.cos(2 * np.pi * np.outer(time_s[time_s < 0.5], lines) + rng.uniform(0, 2 * np.pi, len(lines))).sum(1)
    waves = np.resize(15 * waves / np.abs(waves).max(), len(time_s))
    lead = ways_V([0, 100, 0, 50 + waves[0]], FAST_V_per_s, fast_Hz)
    ahead = ways_V([0, *rng.uniform(5, 95, 12)], FAST_V_per_s, 2000.0)
    return [
        ("slow", ways_V(SLOW_V, SLOW_V_per_s, SLOW_Hz), SLOW_Hz),
        ("fast", np.r_[lead, 50 + waves], fast_Hz),
        ("ahead", ahead, 2000.0),
    ]


def measured(
    rig: Rig, made: list[tuple[str, np.ndarray, float]], noise: str, rng: np.random.Generator
) -> tuple[list[fits.Record], list[np.ndarray]]:
    """Records of programs, and what each would be without noise, in um, `(n,)`."""
    records, truths_um = [], []
    for name, voltage_V, rate_Hz in made:
        truths_um.append(rig.answer(voltage_V, rate_Hz))
        read_um = reading(truths_um[-1], noise, rng)
        records.append(fits.Record(np.arange(len(voltage_V)) / rate_Hz, voltage_V, read_um, source=f"{name}.csv"))
    return records, truths_um


def scores(law: str, noise: str, seed: int, number: int) -> tuple[np.ndarray, float, float]:
    """Errors of the poles of one rig in sd, share of a prediction that its band covers, and its sd over the error."""
    rng = np.random.default_rng([seed, LAWS.index(law), number])
    rig = Rig(law, rng)
    records, truths_um = measured(rig, programs(rig, rng), noise, rng)
    found = fits.fit_stage(records[:2], holdout=0.0, initial="negative")
    ahead = found.predict(records[2], initial="negative")
    off_um, sd_um = truths_um[2] - ahead.displacement_um, ahead.displacement_sd_um
    errors = [(found[name].value - true) / found[name].sd for name, true in zip(NAMES, rig.poles, strict=True)]
    wide = float(np.sqrt(np.mean(sd_um**2) / np.mean(off_um**2)))
    return np.array(errors), float(np.mean(np.abs(off_um) < 1.96 * sd_um)), wide


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=4, help="rigs of each law")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--law", choices=LAWS, help="one alone")
    parser.add_argument("--noise", choices=("white", "rounded", "0.9", "0.99"), help="one alone")
    parser.add_argument("--each", action="store_true", help="print each rig")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print("law       noise    covered, tau, f_n, zeta [%]  worst [sd]  band, mean and worst [%]  sd/rms  refused")
    for law, noise in ROWS:
        if given.law not in (None, law) or given.noise not in (None, noise):
            continue
        rows, refused = [], 0
        for number in range(given.rigs):
            began = time.monotonic()
            try:
                rows.append(scores(law, noise, given.seed, number))
            except (fits.DataError, fits.FitError) as error:
                refused += 1
                print(number, "refused:", error, flush=True)
                continue
            if given.each:
                errors, covered, wide = rows[-1]
                words = " ".join(f"{one:+.2f}" for one in errors)
                words += f"  {100 * covered:.0f} %  {wide:.2f}  {time.monotonic() - began:.0f} s"
                print(number, words, flush=True)
        errors, covered, wide = map(np.array, zip(*rows, strict=True))
        inside = " ".join(f"{one:6.0f}" for one in 100 * np.mean(np.abs(errors) < 1.96, axis=0))
        print(
            f"{law:9} {noise:8} {inside} {np.abs(errors).max():16.1f} {100 * covered.mean():12.0f} "
            f"{100 * covered.min():8.0f} {np.exp(np.mean(np.log(wide))):14.2f} {refused:5}",
            flush=True,
        )


if __name__ == "__main__":
    main()
