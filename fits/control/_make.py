"""Controllers of all kinds for one loop: the PID controller tuned, the others made around it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from fits.control._defaults import PERIODS, bp_defaults, cmac_defaults, strongest_Hz
from fits.control._gains import GAINS, Given
from fits.control._setup import Setup
from fits.control._tune import tune_controller
from fits.control._tune_problem import Goal, linear_part
from fits.control._tune_result import Tuning
from fits.control._tune_start import relay_start, slope_array
from fits.io._errors import DataError
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

_MOST_PEAK = 4.0
# Resonators that are nearer to each other than this share of their frequency fight.
_ALIKE = 1e-3


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
        self,
        controller: AbstractController,
        noise_um: np.ndarray | None,
        resolution_V: float | None = None,
        plant: int = 0,
    ) -> ControlledRun:
        """Run a controller on one of the plants."""
        return simulate_loop(
            controller,
            self.plants[plant],
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
class Made:
    """A controller that was made.

    Attributes
    ----------
    controller
        For the loop.
    pid
        The PID controller that it is, or was made around.
    tuning
        None where gains were given.
    remarks
        One sentence each.
    """

    controller: AbstractController
    pid: PID
    tuning: Tuning[Any] | None
    remarks: list[str]


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

    def make(self, kind: str, given: Given | None, frequency_Hz: Sequence[float]) -> Made:
        """Make a controller of a kind, with its tuning and what is to be said of it.

        Parameters
        ----------
        kind
            `"pid"`, `"bp-pid"`, `"cmac-pid"` or `"resonant"`.
        given
            Gains; tuned if None.
        frequency_Hz
            Of resonators; if there are none, those that are given, or the strongest in the reference.

        Raises
        ------
        DataError
            If the reference or the gains do not suit the controller.
        FitError
            See `tune_controller`.
        """
        loop, ready = self.loop, self.loop.ready
        tuning: Tuning[Any] | None = None
        if given is None:
            self.tell("start by Ziegler and Nichols")
            begin = relay_start(loop.plants, ready.interval_s, delay=loop.delay)
            tuning = self._tuned(_limited(begin, ready.limits_V))
            pid = tuning.controller
        else:
            pid = _limited(given.make_pid(ready.interval_s), ready.limits_V)
        more = [] if tuning is None else list(tuning.remarks)
        if kind == "pid":
            return Made(pid, pid, tuning, more)
        if kind == "resonant":
            return self._resonant(pid, tuning, given, frequency_Hz, more)
        which = "margins are" if tuning is None else "what was tuned, and margins, are"
        more.append(f"{which} those of its PID controller, before it learns")
        learner = self._learner(kind, pid)
        return Made(learner if given is None else given.put_into(kind, learner), pid, tuning, more)

    def _learner(self, kind: str, pid: PID) -> BPPID | CMACPID:
        ready = self.loop.ready
        if kind == "bp-pid":
            if min(float(getattr(pid, name)) for name in GAINS) <= 0:
                raise DataError("bp-pid: expected three gains above 0 to learn around, found one of 0; choose pid.")
            around = bp_defaults(self.loop.plants[0], ready.reference_um)
            return BPPID.around(pid, jax.random.key(self.seed), **around)
        table = cmac_defaults(ready.reference_um, ready.static_V, ready.interval_s)
        fields: dict[str, Any] = {name: jnp.asarray(value) for name, value in table.items()}
        return CMACPID(pid, **fields)

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
        self,
        pid: PID,
        before: Tuning[Any] | None,
        given: Given | None,
        frequency_Hz: Sequence[float],
        more: list[str],
    ) -> Made:
        ready = self.loop.ready
        held = None if given is None else given.resonators()
        kept = held is not None and (not frequency_Hz or np.array_equal(np.sort(held[0]), np.sort(frequency_Hz)))
        own = list(frequency_Hz)
        if held is not None and kept:
            own = held[0].tolist()
        elif held is not None:
            more.append("the resonators of --gains are at other frequencies than --frequency, and made anew")
        elif not own:
            strongest = strongest_Hz(ready.reference_um, ready.interval_s)
            if strongest is None:
                raise DataError(
                    "--controller resonant: expected a reference that oscillates, found none; state --frequency."
                )
            own = [strongest]
            more.append(f"the resonator is at {own[0]:.6g} Hz, the strongest in the reference")
        bad = [f for f in own if not 0 < f < 0.5 / ready.interval_s]
        if bad:
            raise DataError(
                f"--frequency: expected one between 0 and {0.5 / ready.interval_s:g} Hz, found {bad[0]:g} Hz."
            )
        near = np.sort(own)
        if np.any(np.diff(near) <= _ALIKE * near[1:]):
            raise DataError("--frequency: expected frequencies that differ, found two alike; state each once.")
        if held is not None and kept:
            found = ResonantPID(pid, *(jnp.asarray(x) for x in held))
            return Made(found, pid, None, more)
        stage = self.loop.plants[0]
        found = ResonantPID.around(
            pid,
            stage,
            jnp.asarray(own),
            min(own) / PERIODS,
            delay=self.loop.delay,
            slope_um_per_V=slope_array(stage),
        )
        if before is None:
            return Made(found, pid, None, more)
        for _ in range(20):
            if all(bool(one.stable) and float(one.sensitivity_peak) < _MOST_PEAK for one in self.loop.margins(found)):
                break
            found = eqx.tree_at(lambda x: x.resonant_V_per_um_s, found, found.resonant_V_per_um_s / 2)
        tuning = self._tuned(found)
        said = [*more, *(remark for remark in tuning.remarks if remark not in more)]
        return Made(tuning.controller, tuning.controller.pid, tuning, said)


def _limited(pid: PID, limits_V: tuple[float, float]) -> PID:
    return eqx.tree_at(lambda p: (p.lower_V, p.upper_V), pid, tuple(jnp.asarray(x) for x in limits_V))
