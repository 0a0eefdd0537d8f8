"""Faults of samples and noise: spikes, last digits, jitter and narrow bands, which no change of the mean explains."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.diagnosis._floor import Band, band_of, floor_of, jitter_s, pooled, spikes
from fits.diagnosis._projector import Projector
from fits.diagnosis._regression import Regression
from fits.io._record import Record
from fits.stats._at_rest import quantum_um
from fits.stats._whiten import Noise, rough_noise_um

# Effects that are looked for in single samples and in the noise.
SINGLE = ("outliers", "quantisation", "timestamp_jitter", "floor_vibration")
# So many spikes are no chance; a last digit or jitter counts above this part of the noise variance.
_SPIKES, _PART = 3, 0.3
_JITTER_Z, _BAND_Z = 8.0, 8.0
# A band is one of a resonance from this quality on; what is broader wanders, or jumps.
_NARROW = 1.5
# E-folds after which a motion has settled.
_SETTLED = 8.0


@dataclass(frozen=True)
class Faults:
    """What is wrong with samples, and what the noise is.

    Attributes
    ----------
    noise
        Of each run.
    source
        What it was learnt from, in words.
    spikes
        Bad samples of each run, shape `(n,)`.
    heights_um
        How far off they are, shape `(n,)`.
    quantum_um
        Last digit of the sensor, the largest of all runs; 0 for none.
    jitter_s, jitter_um, jitter_z
        Jitter of the instants of sampling, what it makes in the readings, and its evidence.
    band
        The strongest narrow band of all runs.
    remarks
        What the user should know, one sentence each.
    """

    noise: tuple[Noise, ...]
    source: str
    spikes: tuple[np.ndarray, ...]
    heights_um: tuple[np.ndarray, ...]
    quantum_um: float
    jitter_s: float
    jitter_um: float
    jitter_z: float
    band: Band
    remarks: tuple[str, ...] = ()

    @property
    def repaired(self) -> bool:
        """Whether there are enough spikes to be taken out."""
        return sum(int(s.sum()) for s in self.spikes) >= _SPIKES

    def clean(self, records: Sequence[Record]) -> list[Record]:
        """Take the spikes out of records."""
        if not self.repaired:
            return list(records)
        out = []
        for record, height in zip(records, self.heights_um, strict=True):
            assert record.displacement_um is not None
            out.append(replace(record, displacement_um=record.displacement_um - height, extra=dict(record.extra)))
        return out


def find_faults(regression: Regression, change_um: Sequence[np.ndarray] | None = None) -> Faults:
    """Look at what a fitted plain stage leaves of each run, sample by sample.

    Where effects are known, `change_um` is what they change in each run, shape `(n,)`, and is taken off before.
    """
    if change_um is not None:
        left = tuple(r - change for r, change in zip(regression.residuals, change_um, strict=True))
        regression = replace(regression, residuals=left)
    baseline = regression.baseline
    guess = [
        Noise(max(rough_noise_um(r[m]), 1e-9 * baseline.stroke_um), np.zeros(0))
        for r, m in zip(regression.residuals, regression.masks, strict=True)
    ]
    projector = Projector(regression, guess)
    dz, dw = projector.step(projector.residual)
    quantum = max(quantum_um(run.displacement_um) for run in baseline.runs)
    # Rounding is noise that a command at rest does not show.
    least = quantum / 12**0.5
    floors, found, heights, jitters, bands = [], [], [], [], []
    poles = np.asarray(baseline.stage.poles_rad_per_s).real if baseline.dynamic else np.zeros(0)
    settling_s = float(_SETTLED / max(np.min(np.abs(poles)), 1e-3)) if len(poles) else 0.0
    for run, rows, own, residual in zip(
        baseline.runs, regression.rows, regression.own, regression.residuals, strict=True
    ):
        moved = residual - rows @ np.concatenate([dw, dz])
        mask = run.fitted
        free = np.linalg.lstsq(own[mask], moved[mask], rcond=None)[0]
        left = moved - own @ free
        bad = spikes(run, left, 2 * quantum)
        smooth = np.interp(np.arange(len(left)), np.flatnonzero(~bad), left[~bad]) if bad.any() else left
        found.append(bad)
        heights.append(np.where(bad, left - smooth, 0.0))
        floors.append(floor_of(run, smooth, settling_s))
        rate = np.gradient(run.displacement_um - left, run.record.time_s)
        size, z, most = jitter_s(smooth[mask], rate[mask], least)
        jitters.append((z, size, np.abs(rate), most))
        interval = float(np.median(np.diff(run.record.time_s)))
        bands.append(band_of(smooth[mask], interval, run.record.voltage_V[mask]))
    floors = pooled(floors)
    idle = [floor.idle > 0 for floor in floors]
    noise = [one.noise if one.noise.total_um > least else Noise(least, np.zeros(0)) for one in floors]
    z, size, _, _ = max(jitters, key=lambda j: j[0])
    # One recorder took all runs: what only one of them shows is something else.
    z = z if size / 2 < min(most for _, _, _, most in jitters) else 0.0
    if z > _JITTER_Z:
        noise = [
            replace(n, spread=np.sqrt(1 + (size * rate / n.innovation_um) ** 2))
            for n, (_, _, rate, _) in zip(noise, jitters, strict=True)
        ]
    # What may be hum in one run may be told from it in another.
    band = max(bands, key=lambda one: (not one.mains, one.z))
    source = (
        "idle stretches of the runs"
        if all(idle)
        else "the fastest changes of the residual, as if it were white"
        if not any(idle)
        else "idle stretches where there are any, and the fastest changes of the residual elsewhere"
    )
    size = size if z > _JITTER_Z else 0.0
    made = size * float(np.sqrt(np.mean(np.concatenate([rate for _, _, rate, _ in jitters]) ** 2)))
    return Faults(tuple(noise), source, tuple(found), tuple(heights), quantum, size, made, z, band)


@dataclass(frozen=True)
class Fault:
    """A fault of samples or noise that is a cause of its own."""

    name: str
    z: float
    parameters: tuple[tuple[str, float, float, str], ...]
    variance_um2: float


def name_faults(faults: Faults, cyclic: bool) -> list[Fault]:
    """Which of them explain enough of what is left; what repeats itself with the position (`cyclic`) is no jitter."""
    found = []
    total = float(np.mean([n.total_um**2 for n in faults.noise]))
    count = sum(int(s.sum()) for s in faults.spikes)
    samples = sum(len(s) for s in faults.spikes)
    if count >= _SPIKES:
        heights = np.concatenate([h[s] for h, s in zip(faults.heights_um, faults.spikes, strict=True)])
        size = float(np.sqrt(np.mean(heights**2)))
        share = count / samples
        found.append(
            Fault(
                "outliers",
                float(np.max(np.abs(heights)) / total**0.5),
                (("fraction", share, count**0.5 / samples, "1"), ("size_um", size, size / (2 * count) ** 0.5, "um")),
                share * size**2,
            )
        )
    step = faults.quantum_um
    if step**2 / 12 > _PART * total:
        z = (samples * step**2 / 12 / total) ** 0.5
        found.append(Fault("quantisation", z, (("step_um", step, 1e-6 * step, "um"),), step**2 / 12))
    if faults.jitter_s > 0 and not cyclic:
        sd = faults.jitter_s / (2 * max(faults.jitter_z, 1e-9))
        known = (("jitter_s", faults.jitter_s, sd, "s"),)
        found.append(Fault("timestamp_jitter", faults.jitter_z, known, faults.jitter_um**2))
    band = faults.band
    narrow = band.z > _BAND_Z and band.quality > _NARROW
    if narrow and band.size_um**2 > _PART / 3 * total and not band.mains:
        found.append(
            Fault(
                "floor_vibration",
                band.z,
                (
                    ("amplitude_um", band.size_um, band.sd_um, "um"),
                    ("frequency_Hz", band.frequency_Hz, band.frequency_Hz / band.quality, "Hz"),
                ),
                band.size_um**2,
            )
        )
    return found
