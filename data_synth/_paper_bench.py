"""The paper's stage as a bench that a controller runs against, sample by sample."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from scipy.linalg import expm

from data_synth._paper_piezo import PaperPiezo
from data_synth._types import FloatArray


@dataclass(frozen=True)
class PaperSensor:
    """The capacitive sensor of Sections 4.1 and 4.2: fast readings, of which the mean over a sample is handed out.

    The paper gives the resolution, and the noise in ways that contradict each other (errata 40 and 41); the one taken
    here, 3.18 % of 1 um, is what its band of 0.05 to 0.15 um allows. It gives no rate of readings: that is assumed.

    Attributes
    ----------
    noise_um
        Standard deviation of a reading, white and Gaussian.
    resolution_um
        Last digit of a reading; 0 for none.
    rate_Hz
        Readings per second.
    """

    noise_um: float = 0.0318
    resolution_um: float = 0.1
    rate_Hz: float = 2e4

    def read(self, displacement_um: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Mean of the readings along the last axis of displacements in um, which is one sample."""
        reading_um = displacement_um + self.noise_um * rng.standard_normal(displacement_um.shape)
        if self.resolution_um > 0:
            reading_um = self.resolution_um * np.rint(reading_um / self.resolution_um)
        return reading_um.mean(axis=-1)


@dataclass(frozen=True)
class PaperAxis:
    """One motion of the stage, as the sensor reads it.

    Attributes
    ----------
    amplification
        Nominal displacement at the sensor per elongation of the piezo.
    gain_error
        By what share of it the true amplification is more.
    rest_s
        How long the stage rests before a tracking run, and again after it.
    unit, per_um
        What the motion is, and how much of it is 1 um at the sensor.
    natural_rad_per_s, damping_ratio
        Of the slow mode (erratum 46).
    """

    amplification: float
    gain_error: float
    rest_s: float
    unit: str = "um"
    per_um: float = 1.0
    natural_rad_per_s: float = 34.7
    damping_ratio: float = 0.1305


_NODES = 5
_PERIODS = 2
_ARM_mm = 40.0
"""Where the sensor reads a rotation: the distance between the tilt axis and the leaf that lifts the platform."""

PAPER_AXES: Mapping[str, PaperAxis] = MappingProxyType(
    {
        "x": PaperAxis(6.613, -0.0278, 3.577),
        "z": PaperAxis(9.148, 0.0516, 1.383),
        "alpha": PaperAxis(0.10244 * _ARM_mm, -0.1786, 0.745, "urad", 1e3 / _ARM_mm),
        "gamma": PaperAxis(0.50085 * _ARM_mm, -0.4549, 1.434, "urad", 1e3 / _ARM_mm),
    }
)
"""The axes of Tables 3 and 4; y is as x, and beta as alpha.

Amplifications are the paper's 6.613 (erratum 44) and those of the stage's kinematics; rotations are read as the
displacement of a point 40 mm from the axis. What was calibrated, each figure by one number, with all axes sharing one
piezo:

- the damping ratio: Table 2's overshoot under feedforward, 66.12 % (`exp(-pi zeta / sqrt(1 - zeta^2))`);
- the natural frequency: its settling time, 0.84 s into a band of 2 %;
- the gain error of x: its positioning error, 2.78 %, about what tolerances of 0.02 mm do to this axis at worst;
- the piezo's `quadratic`: e_max of Table 3's open loop, 18.22 %;
- the gain errors of the other axes: e_max of Table 4's open loops;
- the rests: e_rms of the open loops. The error of a loop that is run through from its lower end is 1.6 times as large
  at most as it is in the root mean square, and the paper's are 1.9 to 2.7 times as large: its records hold rests.
"""

PAPER_BIAS_V = 20.0
"""Under which the axes rest and work. At 0 V a feedback could not push both ways."""
PAPER_SWING_um = 2.0
"""Peak to peak of a tracking run; the paper gives it for x only."""
PAPER_PERIOD_s = 2.0
"""Of a tracking run, which is at 0.5 Hz."""
PAPER_STEP_um = 6.613
"""Table 2's target: 1 um of the piezo, by erratum 44."""


def paper_reference_um(axis: PaperAxis, interval_s: float) -> FloatArray:
    """A tracking run at 0.5 Hz from rest to rest, shape `(n,)`, in um at the sensor."""
    time_s = np.arange(round((2 * axis.rest_s + _PERIODS * PAPER_PERIOD_s) / interval_s)) * interval_s
    phase = 2 * np.pi * np.clip((time_s - axis.rest_s) / PAPER_PERIOD_s, 0, _PERIODS)
    return PAPER_SWING_um / 2 * (1 - np.cos(phase))


@dataclass(eq=False)
class PaperBench:
    """Driver, piezo, amplifier and slow mode of one axis, several times side by side, at rest under a bias.

    The bias is reached by a full sweep from above, and there the sensor is zeroed.

    The command is held between samples and cut to the amplifier's range. The driver is an RC, in closed form. Its
    voltage, which runs one way between two samples, plays the piezo's hysteresis at a few instants; between these the
    elongation runs in lines, for which the mode is exact.

    Attributes
    ----------
    axis, piezo, sensor
        What is on the bench.
    rng
        Noise of the sensors. None: sensors without noise and without a last digit, which read at the sample.
    benches
        How many of them there are; they differ in their noise only.
    interval_s
        Between two samples of the command.
    time_constant_s
        Of the driver.
    """

    axis: PaperAxis
    piezo: PaperPiezo = field(default_factory=PaperPiezo)
    sensor: PaperSensor = field(default_factory=PaperSensor)
    rng: np.random.Generator | None = None
    benches: int = 1
    interval_s: float = 1e-3
    time_constant_s: float = 1e-3

    def __post_init__(self) -> None:
        """Raise ValueError if there is no bench, or the interval is shorter than the sensor's."""
        self._readings = round(self.interval_s * self.sensor.rate_Hz)
        if self.benches < 1 or self._readings < 1:
            raise ValueError(
                f"benches must be 1 or more and interval_s {1 / self.sensor.rate_Hz:g} s or more, "
                f"got {self.benches} and {self.interval_s}"
            )
        ends_s = self.interval_s / _NODES * np.arange(1, _NODES + 1)
        self._decay = np.exp(-ends_s / self.time_constant_s)
        self._kernel = self._mode(self.interval_s / self._readings)
        self._gain = self.axis.amplification * (1 + self.axis.gain_error)
        self.reset()

    def _mode(self, step_s: float) -> FloatArray:
        """From state and static displacements at the nodes to the displacement at each reading, and the last speed.

        Shape `(2 + nodes + 1, readings + 1)`; the speed is counted in the natural frequency.
        """
        omega, zeta, count = self.axis.natural_rad_per_s, self.axis.damping_ratio, self._readings
        block = np.zeros((4, 4))
        block[:2, :2] = omega * np.array([[0.0, 1.0], [-1.0, -2 * zeta]])
        block[1, 2], block[2, 3] = omega, 1 / step_s
        moved = expm(block * step_s)
        state = np.eye(2, 3 + count)
        rows = []
        for k in range(count):
            state = moved[:2, :2] @ state
            # Straight from the static displacement before to the one after.
            state[:, 2 + k] += moved[:2, 2] - moved[:2, 3]
            state[:, 3 + k] += moved[:2, 3]
            rows.append(state[0])
        share = np.linspace(0, _NODES, count + 1)[:, None] - np.arange(_NODES + 1)
        lines = np.maximum(1 - np.abs(share), 0)
        fine = np.array([*rows, state[1]])
        return np.concatenate([fine[:, :2], fine[:, 2:] @ lines], axis=1).T

    def reset(self) -> tuple[FloatArray, FloatArray]:
        """Bring everything to rest under the bias; displacements and readings in um, shape `(benches,)`."""
        self._rest_um, play_V = self.piezo.rest(PAPER_BIAS_V)
        self._play_V = np.tile(play_V, (self.benches, 1))
        self._voltage_V = np.full(self.benches, PAPER_BIAS_V)
        self._inputs = np.zeros((self.benches, 3 + _NODES))
        rest = np.zeros((self.benches, self._readings))
        return rest[:, -1], self._read(rest)

    def step(self, command_V: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Displacements and readings in um, one interval later, from commands in V of shape `(benches,)`."""
        command = np.minimum(np.maximum(command_V, 0.0), self.piezo.upper_V)[:, None]
        voltage_V = command + (self._voltage_V[:, None] - command) * self._decay
        self._voltage_V = voltage_V[:, -1]
        elongation_um, self._play_V = self.piezo.glide(voltage_V, self._play_V)
        inputs = self._inputs
        inputs[:, 2] = inputs[:, -1]
        inputs[:, 3:] = self._gain * (elongation_um - self._rest_um)
        found = inputs @ self._kernel
        inputs[:, :2] = found[:, -2:]
        return found[:, -2], self._read(found[:, :-1])

    def run(self, command_V: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Reset, then run commands without feedback.

        Parameters
        ----------
        command_V
            Shape `(benches, n)`.

        Returns
        -------
        tuple
            Displacements and readings in um right before each command, both of this shape.
        """
        visited = [self.reset(), *(self.step(command) for command in command_V.T[:-1])]
        displacement_um, reading_um = (np.stack(values, axis=1) for values in zip(*visited, strict=True))
        return displacement_um, reading_um

    def _read(self, displacement_um: FloatArray) -> FloatArray:
        return displacement_um[:, -1] if self.rng is None else self.sensor.read(displacement_um, self.rng)
