"""Controllers of all kinds for one loop: the PID controller tuned, the others made around it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from fits._control_setup import Setup
from fits._errors import DataError
from fits._tune import tune_controller
from fits._tune_problem import Goal, linear_part
from fits._tune_result import Tuning
from fits._tune_start import relay_start, slope_array, steepest_slope
from microid import (
    BPPID,
    CMACPID,
    PID,
    AbstractController,
    ControlledRun,
    Margins,
    ResonantPID,
    Stage,
    margins,
    simulate_loop,
)

GAINS = ("proportional_V_per_um", "integral_V_per_um_s", "derivative_V_s_per_um")
# Resonators take up an error over so many of their periods, and a table holds this share of the reference's voltage.
_PERIODS = 3.0
_TABLE = 0.5
_LEARNING = 0.1
_MOST_PEAK = 4.0


@dataclass(frozen=True)
class Loop:
    """All that stays the same while controllers change.

    Attributes
    ----------
    ready
        Stage, reference and feedforward.
    plants
        To be controlled, the one that is run first.
    noise_um
        Standard deviation of the sensor's noise.
    delay, resolution_um
        Of the readings.
    skip
        How many samples at the beginning do not count.
    """

    ready: Setup
    plants: list[Stage]
    noise_um: float
    delay: int
    resolution_um: float | None
    skip: int

    def run(
        self, controller: AbstractController, noise_um: np.ndarray | None, resolution_V: float | None = None
    ) -> ControlledRun:
        """Run a controller on the first plant."""
        return simulate_loop(
            controller,
            self.plants[0],
            jnp.asarray(self.ready.reference_um),
            feedforward_V=None if self.ready.feedforward_V is None else jnp.asarray(self.ready.feedforward_V),
            noise_um=None if noise_um is None else jnp.asarray(noise_um),
            delay=self.delay,
            resolution_um=self.resolution_um,
            resolution_V=resolution_V,
            limits_V=self.ready.limits_V,
            start=self.ready.start,
        )

    def margins(self, controller: AbstractController) -> list[Margins]:
        """Margins of every plant, at the steepest slope of its hysteresis."""
        return [
            margins(linear_part(controller), one, delay=self.delay, slope_um_per_V=slope_array(one))
            for one in self.plants
        ]


@dataclass(frozen=True)
class Maker:
    """Makes controllers for a loop.

    Attributes
    ----------
    loop, goal, starts, seed
        See `tune_controller`.
    noise_um
        Noise to tune under, shape `(t,)`; None for none.
    tell
        Told what is being done.
    """

    loop: Loop
    goal: Goal
    starts: int
    seed: int
    noise_um: np.ndarray | None
    tell: Callable[[str], None]

    def make(
        self, kind: str, gains: dict[str, float] | None, frequency_Hz: Sequence[float]
    ) -> tuple[AbstractController, Tuning[Any] | None, list[str]]:
        """Make a controller of a kind, with its tuning and what is to be said of it.

        Parameters
        ----------
        kind
            `"pid"`, `"bp-pid"`, `"cmac-pid"` or `"resonant"`.
        gains
            Of the PID controller, by field; tuned if None.
        frequency_Hz
            Of resonators; the strongest in the reference if there are none.

        Raises
        ------
        DataError
            If the reference or the gains do not suit the controller.
        FitError
            See `tune_controller`.
        """
        loop, ready = self.loop, self.loop.ready
        tuning: Tuning[Any] | None = None
        if gains is None:
            self.tell("start by Ziegler and Nichols")
            begin = relay_start(loop.plants, ready.interval_s, delay=loop.delay)
            tuning = self._tuned(_limited(begin, ready.limits_V))
            pid = tuning.controller
        else:
            kp, ki, kd, interval = (jnp.asarray(x) for x in (*(gains[name] for name in GAINS), ready.interval_s))
            pid = _limited(PID(kp, ki, kd, interval), ready.limits_V)
        more = [] if tuning is None else list(tuning.remarks)
        if kind == "pid":
            return pid, tuning, more
        if kind == "resonant":
            return self._resonant(pid, tuning, frequency_Hz, more)
        which = "margins are" if tuning is None else "what was tuned, and margins, are"
        more.append(f"{which} those of its PID controller, before it learns")
        low, high = float(ready.reference_um.min()), float(ready.reference_um.max())
        stage = loop.plants[0]
        if kind == "bp-pid":
            slope = float(stage.static_gain) * (steepest_slope(stage) or 1.0)
            if min(float(getattr(pid, name)) for name in GAINS) <= 0:
                raise DataError("bp-pid: expected three gains above 0 to learn around, found one of 0; choose pid.")
            scale = max(high - low, 1e-9) / 10
            return BPPID.around(pid, jax.random.key(self.seed), slope_um_per_V=slope, scale_um=scale), tuning, more
        fastest = float(np.abs(np.diff(ready.reference_um)).max()) / ready.interval_s
        limit = _TABLE * max(float(np.ptp(ready.static_V)), 1e-6)
        pad = 0.02 * max(high - low, 1e-9)
        ends = low - pad, high + pad, 1.02 * fastest + 1e-9
        lower, upper, rate, learning, most = (jnp.asarray(x) for x in (*ends, _LEARNING, limit))
        return CMACPID(pid, lower, upper, rate, learning, most), tuning, more

    def _tuned(self, controller: Any) -> Tuning[Any]:
        ready = self.loop.ready
        return tune_controller(
            controller,
            self.loop.plants,
            ready.reference_um,
            goal=self.goal,
            feedforward_V=ready.feedforward_V,
            noise_um=self.noise_um,
            delay=self.loop.delay,
            resolution_um=self.loop.resolution_um,
            start=ready.start,
            skip=self.loop.skip,
            starts=self.starts,
            seed=self.seed,
            progress=self.tell,
        )

    def _resonant(
        self, pid: PID, before: Tuning[Any] | None, frequency_Hz: Sequence[float], more: list[str]
    ) -> tuple[AbstractController, Tuning[Any] | None, list[str]]:
        ready = self.loop.ready
        own = list(frequency_Hz) or [_strongest_Hz(ready.reference_um, ready.interval_s)]
        bad = [f for f in own if not 0 < f < 0.5 / ready.interval_s]
        if bad:
            raise DataError(
                f"--frequency: expected one between 0 and {0.5 / ready.interval_s:g} Hz, found {bad[0]:g} Hz."
            )
        if not frequency_Hz:
            more.append(f"the resonator is at {own[0]:.6g} Hz, the strongest in the reference")
        stage = self.loop.plants[0]
        found = ResonantPID.around(
            pid,
            stage,
            jnp.asarray(own),
            min(own) / _PERIODS,
            delay=self.loop.delay,
            slope_um_per_V=slope_array(stage),
        )
        if before is None:
            return found, None, more
        for _ in range(20):
            if all(bool(one.stable) and float(one.sensitivity_peak) < _MOST_PEAK for one in self.loop.margins(found)):
                break
            found = eqx.tree_at(lambda x: x.resonant_V_per_um_s, found, found.resonant_V_per_um_s / 2)
        tuning = self._tuned(found)
        said = [*more, *(remark for remark in tuning.remarks if remark not in more)]
        return tuning.controller, tuning, said


def _limited(pid: PID, limits_V: tuple[float, float]) -> PID:
    return eqx.tree_at(lambda p: (p.lower_V, p.upper_V), pid, tuple(jnp.asarray(x) for x in limits_V))


def _strongest_Hz(reference_um: np.ndarray, interval_s: float) -> float:
    """Frequency of the strongest line of a reference, between the lines of its transform by a parabola."""
    n = len(reference_um)
    size = np.abs(np.fft.rfft((reference_um - reference_um.mean()) * np.hanning(n), 8 * n))
    k = int(np.clip(np.argmax(size), 1, len(size) - 2))
    if size[k] <= 0:
        raise DataError("--controller resonant: expected a reference that oscillates, found none; state --frequency.")
    left, here, right = np.log(np.maximum(size[k - 1 : k + 2], 1e-300))
    bend = left - 2 * here + right
    return float((k + (0.5 * (left - right) / bend if bend else 0.0)) / (8 * n * interval_s))
