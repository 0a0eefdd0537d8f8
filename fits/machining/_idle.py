"""The measuring error (Eq. 6): what a sensor reads while the stage is at rest."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import signal

from fits.io._errors import DataError
from fits.io._length import length
from fits.io._quantity import FloatArray
from fits.io._read_csv import KnownColumns
from fits.io._record import Reference
from fits.stats._noise import correlation_samples
from fits.stats._noise_spectrum import NoiseBand, NoiseLine, allan_deviation, find_lines, noise_bands

MIN_IDLE_SAMPLES = 100
# Share of a step by which steps may differ: spectra do not see less.
_UNEVEN = 0.05


@dataclass(frozen=True, eq=False)
class IdleNoise:
    """Noise of a position sensor, with its constant and its random part kept apart.

    The paper (section 4.2, Fig. 8) takes the *average* of an idle record, 0.103 um, for the measuring error. An
    average is an offset: zeroing the sensor removes it, and Eq. 1 is about displacements, where it cancels (errata
    11). What is left is the random part, of which the paper says "3.18 %" without saying of what; of its own figures
    only a standard deviation of 0.0318 um is consistent with its band of 0.05 to 0.15 um (errata 41). Here both are
    in um, and `error_um` says what enters Eq. 1.

    The mean is the offset; `sd_um` is the standard deviation about it, `sd_detrended_um` that about a straight line
    in time, whose slope is the drift. Standard errors of mean and drift are with the noise's own correlation, and
    `correlation_s` is the time after which a sample counts as a new one: the interval for white noise. The duration
    is `samples` times that interval. The resolution is the quantum of the readings, be it the converter's or the last
    digit of the file; None where none shows.

    The amplitude spectral density, one-sided, shape `(f,)` as its frequencies, is by Welch's method without the
    drift. `bands` are the noise by decades of frequency, whose squares add up to the variance about the line; `lines`
    are sines above the floor, such as mains hum. The overlapping Allan deviation of the readings and its approximate
    standard error have shape `(a,)`, as the averaging times; its minimum is the bias instability, beyond whose time
    averaging does not help.
    """

    samples: int
    rate_Hz: float
    duration_s: float
    mean_um: float
    mean_sd_um: float
    sd_um: float
    sd_detrended_um: float
    drift_um_per_s: float
    drift_sd_um_per_s: float
    peak_to_peak_um: float
    resolution_um: float | None
    correlation_s: float
    frequency_Hz: FloatArray
    asd_um_per_rtHz: FloatArray
    bands: tuple[NoiseBand, ...]
    lines: tuple[NoiseLine, ...]
    averaging_s: FloatArray
    adev_um: FloatArray
    adev_sd_um: FloatArray
    bias_instability_um: float
    bias_instability_s: float
    source: str = ""

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a reader must know, one sentence each."""
        return tuple(_remarks(self))

    def error_um(self, zeroed: bool = True, coverage: float = 2.0) -> float:
        """Measuring error in um that enters Eq. 1, of a single reading within a time as long as the record.

        The mean is added, by its size, unless the sensor is zeroed at rest, which removes it. The random part counts
        by the coverage factor, of which 2 covers 95 % of normal noise, and is at least that of an even spread over
        one quantum of the readings. A ValueError says that the factor is not positive.
        """
        if not coverage > 0:
            raise ValueError(f"expected a positive coverage factor, got {coverage}")
        random = coverage * max(self.sd_um, (self.resolution_um or 0.0) / np.sqrt(12))
        return float(random if zeroed else abs(self.mean_um) + random)


def read_idle(
    path: str | os.PathLike[str],
    columns: Mapping[str, str] | None = None,
    sample_rate_Hz: float | None = None,
    missing: str = "refuse",
) -> Reference:
    """Read what a sensor shows while the stage is at rest: `time_s`, `displacement_um` and perhaps `voltage_V`.

    Units, separators and `columns` are as in `read_table`. A `DataError`, with file, line and column, refuses a
    voltage that changes, fewer than 100 samples, uneven time steps, a reading that never changes, or what
    `read_table` refuses.
    """
    needed = ("time_s", "displacement_um")
    read = KnownColumns.read(path, columns, needed, ("voltage_V",), sample_rate_Hz, missing)
    table, sources, arrays = read.table, read.sources, read.arrays
    voltage_V = arrays.get("voltage_V", np.zeros(1))
    changes = np.flatnonzero(voltage_V != voltage_V[0])
    if len(changes):
        what = (
            f"not idle: expected a constant voltage, found {voltage_V.min():.6g} to {voltage_V.max():.6g} V; cut out "
            "the part at rest, or drop the column if it is a noisy monitor of a constant voltage"
        )
        raise table.error(what, int(changes[0]), sources["voltage_V"].column)
    fault = _find_fault(arrays["time_s"], arrays["displacement_um"])
    if fault:
        what, row, name = fault
        raise table.error(what, row, sources[name].column if name in sources else None)
    return Reference(arrays["time_s"], arrays["displacement_um"], os.path.basename(table.path))


def idle_noise(reference: Reference) -> IdleNoise:
    """Describe the noise of an idle record from `read_idle` (Eq. 6 and Fig. 8).

    A `DataError` refuses fewer than 100 samples, uneven time steps, and readings that never change.
    Standard errors: A. Sokal, "Monte Carlo Methods in Statistical Mechanics" (1997), section 3. Allan deviation: IEEE
    Std 952-1997, annex C.
    """
    fault = _find_fault(reference.time_s, reference.displacement_um)
    if fault:
        raise DataError(f"{reference.source or 'idle record'}, row {fault[1]}, column '{fault[2]}': {fault[0]}.")
    readings, n = reference.displacement_um, len(reference.time_s)
    interval_s = float(reference.time_s[-1] - reference.time_s[0]) / (n - 1)
    rate_Hz, mean = 1 / interval_s, float(readings.mean())
    time_s = interval_s * (np.arange(n) - (n - 1) / 2)
    moment = float(time_s @ time_s)
    drift = float(time_s @ (readings - mean)) / moment
    residual = readings - mean - drift * time_s
    # A record without noise but for a straight line has a residual of rounding alone.
    residual = residual if np.ptp(residual) > 1e-9 * np.ptp(readings) else np.zeros(n)
    sd_detrended = float(np.sqrt(residual @ residual / (n - 2)))
    correlation = _correlation_samples(residual)
    error = sd_detrended * np.sqrt(correlation)
    segment = min(n, max(64, n // 8))
    # The drift is gone already; taking more out of each segment would take slow noise with it.
    frequency_Hz, density = signal.welch(residual, rate_Hz, nperseg=segment, detrend=False)
    averaging_s, adev, adev_sd = allan_deviation(readings, interval_s)
    lowest = int(np.argmin(adev))
    return IdleNoise(
        samples=n,
        rate_Hz=rate_Hz,
        duration_s=n * interval_s,
        mean_um=mean,
        mean_sd_um=float(error / np.sqrt(n)),
        sd_um=float(readings.std(ddof=1)),
        sd_detrended_um=sd_detrended,
        drift_um_per_s=drift,
        drift_sd_um_per_s=float(error / np.sqrt(moment)),
        peak_to_peak_um=float(np.ptp(readings)),
        resolution_um=_quantum(readings),
        correlation_s=correlation * interval_s,
        frequency_Hz=frequency_Hz[1:],
        asd_um_per_rtHz=np.sqrt(density[1:]),
        bands=noise_bands(residual, rate_Hz),
        lines=find_lines(residual, rate_Hz),
        averaging_s=averaging_s,
        adev_um=adev,
        adev_sd_um=adev_sd,
        bias_instability_um=float(adev[lowest]),
        bias_instability_s=float(averaging_s[lowest]),
        source=reference.source,
    )


def _find_fault(time_s: FloatArray, displacement_um: FloatArray) -> tuple[str, int, str] | None:
    """Why a record says nothing of noise, with the row and column to look at; None where it does."""
    n = len(time_s)
    if n < MIN_IDLE_SAMPLES:
        what = f"expected at least {MIN_IDLE_SAMPLES} samples, found {n}; record the stage at rest for longer"
        return what, max(n - 1, 0), "time_s"
    steps_s = np.diff(time_s)
    step_s = float(np.median(steps_s))
    row = int(np.argmax(np.abs(steps_s - step_s)))
    if abs(steps_s[row] - step_s) > _UNEVEN * step_s:
        what = (
            f"expected even time steps, found one of {steps_s[row]:.6g} s among steps of {step_s:.6g} s; cut the "
            "file at a gap, export the time with more digits, or sample by a clock"
        )
        return what, row + 1, "time_s"
    if displacement_um.min() == displacement_um.max():
        what = (
            f"expected readings that scatter, found {displacement_um[0]:.9g} um throughout; check that the sensor is "
            "on and in range, or export more digits"
        )
        return what, 0, "displacement_um"
    return None


def _correlation_samples(residual_um: FloatArray) -> float:
    """Samples that are worth one independent one; means of batches show slow noise that hides below white noise."""
    each = len(residual_um) // 32
    means = residual_um[: 32 * each].reshape(32, each).mean(axis=1)
    square = float(residual_um @ residual_um) / len(residual_um)
    batch = each * float(means @ means) / 30 / square if square > 0 else 1.0
    return max(correlation_samples([residual_um]), batch)


def _quantum(readings_um: FloatArray) -> float | None:
    """Step that all distances between readings are multiples of, if there is one."""
    levels = np.unique(readings_um)
    steps = np.diff(levels)
    steps = steps[steps > 64 * np.finfo(float).eps * np.abs(levels).max()]  # what rounding tells apart is one level
    if not len(steps) or len(levels) == len(readings_um):
        return None
    quantum = float(steps.min())
    multiples = np.round(steps / quantum)
    quantum = float(steps.sum() / multiples.sum())
    return quantum if np.all(np.abs(steps / quantum - multiples) < 0.1) else None


def _remarks(noise: IdleNoise) -> Iterator[str]:
    yield (
        f"The mean of {noise.mean_um:.4g} um is an offset that zeroing the sensor removes; what enters Eq. 1 as the "
        f"measuring error is {length(noise.error_um())}, twice the random part. The paper takes the average, "
        "0.103 um, instead."
    )
    yield (
        f"The standard deviation is {length(noise.sd_um)} and no percentage: the paper's 3.18 % has no reference, "
        "and 0.0318 um would fit its band of 0.05 to 0.15 um."
    )
    if abs(noise.drift_um_per_s) > 3 * noise.drift_sd_um_per_s:
        yield (
            f"The readings drift by {noise.drift_um_per_s:.3g} um/s, {noise.drift_um_per_s * noise.duration_s:.3g} "
            "um over the record, so the standard deviation depends on how long one waits; zero again from time to "
            "time."
        )
    if noise.duration_s < 50 * noise.correlation_s:
        # With so few stretches that know nothing of each other the error of the mean is itself a guess.
        yield (
            f"The noise is correlated over {noise.correlation_s:.3g} s, which is long for a record of "
            f"{noise.duration_s:.3g} s: the errors of mean and drift are rough; record for longer."
        )
    if noise.resolution_um is not None and noise.sd_um < noise.resolution_um / 2:
        yield (
            f"The readings scatter by less than half their quantum of {length(noise.resolution_um)}, so their "
            "standard deviation is not that of the noise; no less is counted than an even spread over the quantum."
        )
    if noise.bias_instability_s == noise.averaging_s[-1]:
        yield (
            "The Allan deviation still falls at the longest averaging time, so the bias instability is an upper "
            "bound; record for longer."
        )
    elif noise.adev_um[-1] - noise.adev_sd_um[-1] > noise.bias_instability_um:
        yield (
            f"The Allan deviation rises beyond {noise.bias_instability_s:.3g} s: the readings wander, averaging for "
            "longer does not help, and the mean of another record may differ by more than its error says."
        )
    if noise.lines:
        named = ", ".join(f"{length(line.amplitude_um, 2)} at {line.frequency_Hz:.4g} Hz" for line in noise.lines[:3])
        more = f" and {len(noise.lines) - 3} more" if len(noise.lines) > 3 else ""
        yield f"Narrow lines stand above the floor: {named}{more}; they do not average out as noise does."
