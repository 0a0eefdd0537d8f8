"""How far a residual is from noise, against the noise that the records themselves show."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fits.io._record import Record
from fits.loop._run import Run
from fits.stats._noise import idle_stretches, quantum_um, rough_noise_um

# So many samples of a command at rest say what the noise is.
_IDLE = 150
# A residual beyond so many times the noise, and such a part of the stroke in %, is far from it.
_FAR_TIMES_NOISE, _FAR_PCT = 2.0, 0.1


@dataclass(frozen=True)
class Misfit:
    """What a fit leaves of the run that it describes worst, against what the sensor's noise would leave.

    `residual_um` is the root mean square over the fitted samples, `share_pct` the same in % of the run's stroke, and
    `noise_um` the standard deviation of the sensor's noise, its last digit included, read off what `shown_by` says.
    """

    source: str
    residual_um: float
    share_pct: float
    noise_um: float
    shown_by: str

    @property
    def times_noise(self) -> float:
        """How many times the noise the residual is."""
        return self.residual_um / self.noise_um

    @property
    def far(self) -> bool:
        """Whether more than noise is left, and more than a trifle of the stroke."""
        return self.times_noise > _FAR_TIMES_NOISE and self.share_pct > _FAR_PCT


def misfits(runs: Sequence[Run], residuals: Sequence[np.ndarray]) -> list[Misfit]:
    """Compare the residual of each run, in um, with the noise of the sensor, which is that of its quietest run."""
    noise, shown_by = min(
        (sensor_noise_um(run.record, residual) for run, residual in zip(runs, residuals, strict=True)),
        key=lambda one: one[0],
    )
    out = []
    for run, residual in zip(runs, residuals, strict=True):
        left = residual[run.fitted] - residual[run.fitted].mean()
        rms = float(np.sqrt(np.mean(left**2)))
        stroke = float(np.ptp(run.displacement_um[run.fitted]))
        out.append(Misfit(run.record.source, rms, 100 * rms / max(stroke, 1e-300), noise, shown_by))
    return out


def worst(found: Sequence[Misfit]) -> Misfit:
    """The run that is furthest from noise."""
    return max(found, key=lambda one: (one.far, one.times_noise))


def compare_gains(moved_um: Sequence[np.ndarray], left_um: Sequence[np.ndarray]) -> tuple[int, int, float]:
    """The runs that move most and least for what a model says they move, by what it leaves, and their ratio."""
    gains = []
    for moved, left in zip(moved_um, left_um, strict=True):
        moved = moved - moved.mean()
        gains.append(1 + float(moved @ left / max(moved @ moved, 1e-300)))
    low, high = int(np.argmin(gains)), int(np.argmax(gains))
    return high, low, gains[high] / gains[low] if gains[low] > 0 else np.inf


def sensor_noise_um(record: Record, residual_um: np.ndarray) -> tuple[float, str]:
    """Standard deviation of a sensor's noise, whatever a model leaves, and what shows it.

    Where the command rests long enough it is that of the readings there; elsewhere that of the fastest changes of the
    readings, or of what a fit leaves of them, as if noise were white. No less than the last digit makes.
    """
    reading = record.displacement_um
    assert reading is not None
    pieces = []
    for stretch in idle_stretches(record.voltage_V, 0):
        piece = reading[stretch]
        time = np.linspace(-1, 1, len(piece))
        # What settles is no noise.
        pieces.append(piece - np.polyval(np.polyfit(time, piece, min(3, len(piece) // 12)), time))
    found = []
    if sum(map(len, pieces)) >= _IDLE:
        joined = np.concatenate(pieces)
        found.append((1.4826 * float(np.median(np.abs(joined))), f"{record.source} at rest"))
    words = f"the fastest changes in {record.source}"
    found += [(rough_noise_um(values), words) for values in (reading, residual_um)]
    digit = quantum_um(reading) / 12**0.5
    least = max(digit, 1e-7 * float(np.ptp(reading)))
    noise, shown_by = min(found, key=lambda one: one[0])
    return (noise, shown_by) if noise >= least else (least, f"the last digit in {record.source}")
