"""The dynamics of a stage: a driver in front of the hysteresis, and a mass on a spring behind it."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter

from data_synth._types import FloatArray

Hold: TypeAlias = Literal["first", "zero"]

# Longest time constant and highest resonance of any stage: beyond it a number stands in another unit.
_LARGEST = {"time_constant_s": 1e6, "natural_frequency_Hz": 1e9, "damping_ratio": 1e3}
# Times of the fastest motion of a stage between two samples: each is integrated over.
_MOST_TURNS = 500
_BLOCK = 2048
_NODES = 4


@dataclass(frozen=True)
class Plant:
    """What lies between the command, the voltage in the CSV, and the displacement.

    The command drives an RC low-pass, `tau v' + v = u`. The voltage v goes through the rig's hysteresis, which gives
    the static displacement w. That drives `x'' + 2 zeta omega x' + omega^2 x = omega^2 w`, whose static gain is one,
    and x is the displacement.

    Source: the paper's Eq. 12 and 16, with its errata: the hysteresis stands in the place of the linear Eq. 13-14,
    and the static gain, which Eq. 17 leaves open, is in the hysteresis.

    Attributes
    ----------
    time_constant_s
        tau of the driver, in s; None for a driver without delay.
    natural_frequency_Hz
        omega / (2 pi), in Hz; None for a stage without mass.
    damping_ratio
        zeta; stated if, and only if, there is a natural frequency.
    hold
        What the command does between two samples: a straight line from one to the next (`first`), or it stays at
        the earlier one and jumps (`zero`). A sample of the displacement is taken just before such a jump.
    """

    time_constant_s: float | None = None
    natural_frequency_Hz: float | None = None
    damping_ratio: float | None = None
    hold: Hold = "first"

    def __post_init__(self) -> None:
        """Raise ValueError for a plant that cannot be."""
        for name, largest in _LARGEST.items():
            value = getattr(self, name)
            if not (value is None or 0 < value <= largest):
                raise ValueError(f"{name} must be positive and at most {largest:g}, got {value}")
        if (self.natural_frequency_Hz is None) != (self.damping_ratio is None):
            missing = "damping_ratio" if self.damping_ratio is None else "natural_frequency_Hz"
            raise ValueError(
                "natural_frequency_Hz and damping_ratio must be stated together or not at all, "
                f"and {missing} is missing"
            )

    def require_samples(self, sample_rate_Hz: float) -> None:
        """Raise ValueError where the mass moves so often between two samples that a simulation does not end."""
        if self.natural_frequency_Hz is None or self.damping_ratio is None:
            return
        fastest_Hz = self.natural_frequency_Hz * max(1.0, self.damping_ratio)
        if fastest_Hz > _MOST_TURNS * sample_rate_Hz:
            raise ValueError(
                f"sampled at {sample_rate_Hz:g} Hz, a mass of {self.natural_frequency_Hz:g} Hz with a damping ratio "
                f"of {self.damping_ratio:g} moves {fastest_Hz / sample_rate_Hz:.4g} times between two samples, and "
                f"at most {_MOST_TURNS} are simulated: sample faster, or leave the mass out"
            )

    def respond(
        self,
        command_V: FloatArray,
        sample_rate_Hz: float,
        static: Callable[[FloatArray], FloatArray],
        refinement: int = 1,
    ) -> FloatArray:
        """Displacement at each sample, shape (n,), in um, of a stage that is at rest before the first.

        The driver is solved in closed form, and where its voltage turns between two samples the hysteresis turns
        too. The mechanics are carried from sample to sample by the matrix exponential and Duhamel's integral, whose
        panels are fine where the driver settles.

        Parameters
        ----------
        command_V
            The command, shape (n,), in V.
        sample_rate_Hz
            Samples per second.
        static
            From voltages (V) that only rise or only fall to the static displacements (um), both of shape (m,). It
            remembers what it was called with.
        refinement
            Into how many each panel is cut: 1 is fine enough, a larger number shows it.

        Raises
        ------
        ValueError
            As `require_samples` does.
        """
        self.require_samples(sample_rate_Hz)
        period_s = 1 / sample_rate_Hz
        slope_V_per_s = np.diff(command_V) * sample_rate_Hz if self.hold == "first" else np.zeros(len(command_V) - 1)
        start_V, end_V = self._driver_at_samples(command_V, slope_V_per_s, period_s)
        nodes_s, transition, kernel = self._mechanics(
            period_s, float(np.abs(end_V - start_V).max(initial=0)), float(np.ptp(command_V)), refinement
        )
        times_s = np.append(nodes_s, period_s)
        last_V = float(command_V[0])
        (rest_um,) = static(command_V[:1]).tolist()
        state = (rest_um, 0.0)
        displacement_um = [rest_um]
        for first in range(0, len(slope_V_per_s), _BLOCK):
            part = slice(first, first + _BLOCK)
            voltage_V, turn_V, turn_at = self._driver_between(
                command_V[:-1][part], slope_V_per_s[part], start_V[part], times_s
            )
            voltage_V[:, -1] = end_V[part]
            path_V = np.insert(voltage_V.ravel(), turn_at, turn_V)
            path_um = np.concatenate([static(run_V) for run_V in monotone_runs(path_V, last_V)])
            last_V = float(path_V[-1])
            static_um = np.delete(path_um, turn_at + np.arange(len(turn_at))).reshape(voltage_V.shape)
            if self.natural_frequency_Hz is None:
                displacement_um += static_um[:, -1].tolist()
                continue
            (a, b), (c, d) = transition
            for push_um, push_speed_um in (static_um[:, :-1] @ kernel).tolist():
                x_um, speed_um = state
                state = (a * x_um + b * speed_um + push_um, c * x_um + d * speed_um + push_speed_um)
                displacement_um.append(state[0])
        return np.array(displacement_um)

    def _driver_at_samples(
        self, command_V: FloatArray, slope_V_per_s: FloatArray, period_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """The driver's voltage (V) as each interval between samples begins and ends, both of shape (n - 1,)."""
        tau_s = self.time_constant_s
        last_V = command_V[:-1] + slope_V_per_s * period_s
        if tau_s is None:
            return command_V[:-1], last_V
        decay = math.exp(-period_s / tau_s)
        lag_V = slope_V_per_s * tau_s
        gain_V = last_V - lag_V - (command_V[:-1] - lag_V) * decay
        end_V, _ = lfilter([1.0], [1.0, -decay], gain_V, zi=decay * command_V[:1])
        return np.concatenate([command_V[:1], end_V])[:-1], end_V

    def _driver_between(
        self, command_V: FloatArray, slope_V_per_s: FloatArray, start_V: FloatArray, times_s: FloatArray
    ) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """The driver's voltage (V) at times (s) after each of m samples, shape (m, times), and where it turns.

        It turns where it meets the command, at most once in an interval. Given are its voltages (V) there and the
        places in the ravelled first array to insert them at.
        """
        line_V = command_V[:, None] + slope_V_per_s[:, None] * times_s
        tau_s = self.time_constant_s
        if tau_s is None:
            return line_V, np.empty(0), np.empty(0, dtype=int)
        lag_V = slope_V_per_s * tau_s
        away_V = start_V - command_V + lag_V
        voltage_V = line_V - lag_V[:, None] + away_V[:, None] * np.exp(-times_s / tau_s)
        # Its slope is zero where exp(-t / tau) is lag / away.
        shrunk = np.divide(lag_V, away_V, out=np.zeros_like(lag_V), where=away_V != 0)
        rows = np.flatnonzero((shrunk > math.exp(-times_s[-1] / tau_s)) & (shrunk < 1))
        turn_s = -tau_s * np.log(shrunk[rows])
        turn_V = command_V[rows] + slope_V_per_s[rows] * turn_s
        return voltage_V, turn_V, rows * len(times_s) + np.searchsorted(times_s, turn_s)

    def _mechanics(
        self, period_s: float, swing_V: float, range_V: float, refinement: int
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Nodes (s) of Duhamel's integral, shape (k,), the transition (2, 2) of the state, and the kernel (k, 2).

        The state is the displacement and the speed over omega, both in um.
        """
        if self.natural_frequency_Hz is None or self.damping_ratio is None:
            return np.empty(0), np.eye(2), np.empty((0, 2))
        omega_rad_per_s = 2 * math.pi * self.natural_frequency_Hz
        matrix = omega_rad_per_s * np.array([[0.0, 1.0], [-1.0, -2 * self.damping_ratio]])
        # Short against the oscillation, and against the driver while it settles. Where a branch of the hysteresis
        # joins another the slope jumps, and the error grows with the voltage and the phase within a panel.
        longest_s = min(period_s, 1 / (12 * self.natural_frequency_Hz * max(1.0, self.damping_ratio)))
        if swing_V > 0:
            branch_s = math.sqrt(1e-4 * period_s * range_V / (swing_V * omega_rad_per_s))
            longest_s = min(longest_s, max(branch_s, period_s / 128))
        edges_s = [0.0]
        while edges_s[-1] < period_s * (1 - 1e-9):
            width_s = longest_s
            if self.time_constant_s is not None:
                width_s = min(longest_s, max(self.time_constant_s / 3, edges_s[-1] / 4))
            edges_s.append(min(edges_s[-1] + width_s, period_s))
        cuts = np.arange(refinement) / refinement
        fine_s = np.append((np.array(edges_s[:-1])[:, None] + np.diff(edges_s)[:, None] * cuts).ravel(), period_s)
        places, shares = np.polynomial.legendre.leggauss(_NODES)
        widths_s = np.diff(fine_s)[:, None]
        nodes_s = (fine_s[:-1, None] + widths_s * (places + 1) / 2).ravel()
        weights_s = (widths_s * shares / 2).ravel()
        # The force enters the second state: the last column of each exponential carries it to the next sample.
        carried = np.array([expm(matrix * (period_s - node_s))[:, 1] for node_s in nodes_s])
        return nodes_s, expm(matrix * period_s), omega_rad_per_s * weights_s[:, None] * carried


def monotone_runs(voltage_V: FloatArray, before_V: float) -> list[FloatArray]:
    """Cut voltages (V) that follow `before_V` where they turn, and where a piece becomes long for the memory."""
    moves = np.diff(voltage_V, prepend=before_V)
    moving = np.flatnonzero(moves)
    turning = moving[1:][moves[moving[1:]] * moves[moving[:-1]] < 0]
    cuts = np.union1d(turning, np.arange(0, len(voltage_V), _BLOCK)).tolist()
    return [voltage_V[first:last] for first, last in itertools.pairwise([*cuts, len(voltage_V)])]


def random_plant(
    rng: np.random.Generator,
    *,
    time_constant_s: float | None = None,
    natural_frequency_Hz: float | None = None,
    damping_ratio: float | None = None,
    hold: Hold = "first",
) -> Plant:
    """Draw a plant, evenly on a logarithmic scale. What is not None is kept, and changes nothing else.

    Parameters
    ----------
    rng
        Source of randomness.
    time_constant_s
        Of the driver, in s; drawn from 0.1 to 2 ms.
    natural_frequency_Hz
        Of the stage, in Hz; drawn from 80 to 600 Hz.
    damping_ratio
        Of the stage; drawn from 0.01 to 0.2.
    hold
        What the command does between two samples.

    Raises
    ------
    ValueError
        If a value that is stated is not positive.
    """
    tau_s, frequency_Hz, ratio = np.exp(rng.uniform(np.log([1e-4, 80.0, 0.01]), np.log([2e-3, 600.0, 0.2]))).tolist()
    return Plant(
        time_constant_s=tau_s if time_constant_s is None else time_constant_s,
        natural_frequency_Hz=frequency_Hz if natural_frequency_Hz is None else natural_frequency_Hz,
        damping_ratio=ratio if damping_ratio is None else damping_ratio,
        hold=hold,
    )
