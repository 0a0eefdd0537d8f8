"""Bands of the stages that a diagnosis saves, on programs it has not seen; rigs are those of `foreign_stages.py`.

Usage: `python benchmarks/foreign_diagnoses.py [--rigs 2] [--seed 0] [--hidden creep] [--law gamma]`. Of clean rigs
the band of the plain stage is looked at, of rigs with one effect that of the extended one: creep along the logarithm
of time between hysteresis and mechanics, or a lag of the sensor; both are made by SciPy. Two programs are predicted,
a fast one and a slow one, up to the offset that the first run has. Of each: share of the noise-free truth that the
95 % band covers, rms of its sd over that of the error, and that error in um. Some 30 to 90 s per rig.
"""

import argparse
import time

import jax
import numpy as np
from foreign_stages import LAWS, FAST_V_per_s, Rig, SLOW_Hz, SLOW_V_per_s, measured, programs, ways_V

import fits

HIDDEN, PER_DECADE, HOLD_s = ("clean", "creep", "lag"), 8, 4.0


class HiddenRig(Rig):
    """A rig that creeps between hysteresis and mechanics, or whose sensor lags, or neither."""

    def __init__(self, hidden: str, law: str, rng: np.random.Generator):
        super().__init__(law, rng)
        self.creep = rng.uniform(0.01, 0.02) if hidden == "creep" else 0.0
        self.onset_s, self.lag_s = rng.uniform(0.05, 0.2), rng.uniform(2e-3, 5e-3) if hidden == "lag" else 0.0

    def behind_hysteresis(self, displacement_um: np.ndarray, rate_Hz: float) -> np.ndarray:
        """With creep along the logarithm of time, in um, `(n,)`."""
        if not self.creep:
            return displacement_um
        ratio = 10 ** np.arange(-1, 5, 1 / PER_DECADE)
        crept = sum(
            np.exp(-1 / r) / PER_DECADE * self._filtered([1], [r * self.onset_s, 1], displacement_um, rate_Hz)
            for r in ratio
        )
        return displacement_um + self.creep * (crept - crept[0])

    def read(self, displacement_um: np.ndarray, rate_Hz: float) -> np.ndarray:
        """Through the sensor's lag, in um, `(n,)`."""
        return self._filtered([1], [self.lag_s, 1], displacement_um, rate_Hz) if self.lag_s else displacement_um


def scores(hidden: str, law: str, noise: str, seed: int, number: int) -> tuple[str, list[tuple[float, float, float]]]:
    """Causes of a rig, and of each program: share that is covered, sd over rms error, and that error in um."""
    rng = np.random.default_rng([seed, HIDDEN.index(hidden), LAWS.index(law), number])
    rig = HiddenRig(hidden, law, rng)
    made = programs(rig, rng)
    name, voltage_V, rate_Hz = made[0]
    made[0] = name, np.r_[voltage_V, np.full(int(HOLD_s * rate_Hz), voltage_V[-1])], rate_Hz
    fast_V = ways_V([0, *rng.uniform(5, 95, 12)], FAST_V_per_s, 2000.0)
    slow_V = ways_V([0, *rng.uniform(5, 95, 12)], SLOW_V_per_s, SLOW_Hz)
    made[2:] = [("fast ahead", fast_V, 2000.0), ("slow ahead", slow_V, SLOW_Hz)]
    records, truths_um = measured(rig, made, noise, rng)
    found = fits.diagnose(records[:2], initial="negative")
    kept = (found.baseline, found.baseline_uncertainty)
    if hidden != "clean":
        kept = (found.extended, found.extended_uncertainty)
    words = f"{found.verdict} {','.join(cause.name for cause in found.causes)}"
    if kept[1] is None:
        return f"{words} no band", []
    first, used = fits.predict(kept[0], records[0], uncertainty=kept[1]), slice(0, round(0.8 * len(records[0])))
    offset_um = np.mean((records[0].displacement_um - first.displacement_um)[used])
    out = []
    for record, true_um in zip(records[2:], truths_um[2:], strict=True):
        ahead = fits.predict(kept[0], record, uncertainty=kept[1])
        off_um, sd_um = true_um - ahead.displacement_um - offset_um, ahead.displacement_sd_um
        rms_um = float(np.sqrt(np.mean(off_um**2)))
        covered = float(np.mean(np.abs(off_um) < 1.96 * sd_um))
        out.append((covered, float(np.sqrt(np.mean(sd_um**2))) / rms_um, rms_um))
    return words, out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=2, help="rigs of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hidden", choices=HIDDEN, help="one alone")
    parser.add_argument("--law", choices=LAWS, default="gamma")
    parser.add_argument("--noise", choices=("white", "rounded", "0.9", "0.99"), default="white")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print("hidden  rig  [covered %, sd/rms, rms um] of a fast and of a slow program; verdict and causes")
    whole = []
    for hidden in [given.hidden] if given.hidden else HIDDEN:
        for number in range(given.rigs):
            began = time.monotonic()
            # Programs of many rigs take more memory maps than a process may have.
            jax.clear_caches()
            words, rows = scores(hidden, given.law, given.noise, given.seed, number)
            whole += rows
            said = "  ".join(f"{100 * covered:3.0f} {wide:5.2f} {rms:.4f}" for covered, wide, rms in rows)
            print(f"{hidden:7} {number}  {said}  {words}  {time.monotonic() - began:.0f} s", flush=True)
    covered, wide, _ = map(np.array, zip(*whole, strict=True))
    print(
        f"covered {100 * covered.mean():.0f} (worst {100 * covered.min():.0f}) %, "
        f"sd over rms error {np.exp(np.mean(np.log(wide))):.2f}, {wide.min():.2f} to {wide.max():.2f}"
    )


if __name__ == "__main__":
    main()
