"""The mechanics of a stage on a fine grid: what is linear by exact steps, what is not by steps that follow it."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter

from data_synth._types import FloatArray


class Resistance(Protocol):
    """A force on the mass over the spring's stiffness, in um, that is no linear function of the displacement."""

    def rest(self, static_um: float) -> float:
        """Displacement (um) at which the stage rests before the run, with `static_um` (um) asked of it."""
        ...

    def force_um(self, displacement_um: float) -> float:
        """The force over the stiffness (um) at the next displacement (um)."""
        ...


@dataclass(frozen=True)
class Mode:
    """An oscillator of unit static gain: its frequency (Hz) and damping ratio."""

    natural_frequency_Hz: float
    damping_ratio: float

    def steps(self, step_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Transition (2, 2) and the gains (2,) of the input before and after a step between which it is straight.

        The state is the displacement and the speed over omega.
        """
        omega = 2 * math.pi * self.natural_frequency_Hz
        block = np.zeros((4, 4))
        block[:2, :2] = omega * np.array([[0.0, 1.0], [-1.0, -2 * self.damping_ratio]])
        block[1, 2] = omega
        block[2, 3] = 1 / step_s
        moved = expm(block * step_s)
        return moved[:2, :2], moved[:2, 2] - moved[:2, 3], moved[:2, 3]

    def respond(self, static_um: FloatArray, step_s: float) -> FloatArray:
        """Displacement, shape (N,), in um, of what rests before the first of the inputs, shape (N,), in um."""
        transition, before, after = self.steps(step_s)
        # The transfer function of the first state, by Cramer's rule on z - transition.
        (a, b), (c, d) = transition
        numerator = [
            after[0],
            before[0] - d * after[0] + b * after[1],
            -d * before[0] + b * before[1],
        ]
        swing, _ = lfilter(numerator, [1.0, -(a + d), a * d - b * c], static_um - static_um[0], zi=np.zeros(2))
        return static_um[0] + swing


@dataclass(frozen=True)
class Mechanics:
    """A mass on a spring, and what effects have added to it.

    Attributes
    ----------
    mode
        The first mode; None for a stage without mass.
    others
        Further modes in parallel, each with its share of the displacement; the first mode has the rest.
    resistances
        What makes the forces that are no linear function of the displacement.
    load
        The mass over that of `mode` from which instant (s) on.
    """

    mode: Mode | None
    others: tuple[tuple[float, Mode], ...] = ()
    resistances: tuple[Callable[[], Resistance], ...] = ()
    load: tuple[float, float] | None = None

    def respond(self, static_um: FloatArray, time_s: FloatArray) -> FloatArray:
        """Displacement, shape (N,), in um, from the static one on the fine grid `time_s` (s), both of shape (N,)."""
        step_s = float(time_s[1])
        if self.mode is None:
            return self._without_mass(static_um)
        first_um = (
            self.mode.respond(static_um, step_s)
            if not self.resistances and self.load is None
            else self._stepwise(self.mode, static_um, time_s)
        )
        displacement_um = first_um * (1 - sum(share for share, _ in self.others))
        for share, mode in self.others:
            displacement_um = displacement_um + share * mode.respond(static_um, step_s)
        return displacement_um

    def _without_mass(self, static_um: FloatArray) -> FloatArray:
        displacement_um = static_um.copy()
        for make in self.resistances:
            resistance = make()
            place_um = resistance.rest(float(static_um[0]))
            for k, asked_um in enumerate(displacement_um.tolist()):
                # One step behind: the grid is fine, and the force small.
                place_um = asked_um - resistance.force_um(place_um)
                displacement_um[k] = place_um
        return displacement_um

    def _stepwise(self, mode: Mode, static_um: FloatArray, time_s: FloatArray) -> FloatArray:
        """Exact steps of the linear part; the force is carried on along a straight line through its last two."""
        step_s = float(time_s[1])
        cut = len(time_s)
        modes = [mode]
        if self.load is not None:
            mass, at_s = self.load
            cut = int(np.searchsorted(time_s, at_s))
            # The spring and the dashpot stay: omega and zeta both go with one over the root of the mass.
            modes.append(Mode(mode.natural_frequency_Hz / math.sqrt(mass), mode.damping_ratio / math.sqrt(mass)))
        resistances = [make() for make in self.resistances]
        x = float(static_um[0])
        for resistance in resistances:
            x = resistance.rest(x)
        forces = [resistance.force_um for resistance in resistances]
        speed, now = 0.0, sum(force(x) for force in forces)
        past = now
        displacement_um = [x]
        asked = static_um.tolist()
        for part, oscillator in zip((asked[: cut + 1], asked[cut:]), modes, strict=False):
            transition, before, after = oscillator.steps(step_s)
            (a, b), (c, d) = transition.tolist()
            (e0, e1), (f0, f1) = before.tolist(), after.tolist()
            for w0, w1 in itertools.pairwise(part):
                p0, p1 = w0 - now, w1 - 2 * now + past
                x, speed = a * x + b * speed + e0 * p0 + f0 * p1, c * x + d * speed + e1 * p0 + f1 * p1
                past = now
                now = 0.0
                for force in forces:
                    now += force(x)
                displacement_um.append(x)
            # The speed is counted in omega of the mode.
            speed *= modes[0].natural_frequency_Hz / modes[-1].natural_frequency_Hz
        return np.array(displacement_um)
