"""The chain of a run on a fine grid, with effects at their places in it.

Command -> amplifier -> driver -> hysteresis -> static displacement -> mechanics -> environment -> sensor -> sampling.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from scipy.signal import lfilter

from data_synth._effect import Effect, Place, Situation, TimeConstant
from data_synth._mechanics import Mechanics, Mode
from data_synth._plant import Plant, monotone_runs
from data_synth._types import FloatArray, Hysteresis

AFTER = 40
"""Samples for which the chain goes on after the last: lost samples and clocks that run ahead look there."""

_SPACING = 5e-4
# Fine steps of a run, and of a sample: what a driver or a mass does within far less is a jump to all that follows.
_MOST_STEPS, _FINEST = 1_500_000, 4096


@dataclass(frozen=True)
class Acting:
    """An effect with its arguments, and where its own randomness starts."""

    effect: Effect
    parameters: Mapping[str, Any]
    seed: tuple[int, ...]

    def __call__(self, signal: Any, situation: Situation) -> Any:
        """Let the effect act on the signal at its place."""
        situation.rng = np.random.default_rng((*self.seed, situation.index))
        return self.effect.function(signal, situation, **self.parameters)


Operator: TypeAlias = Callable[[FloatArray], FloatArray]


def refinement(plant: Plant, sample_rate_Hz: float, samples: int) -> int:
    """Fine steps per sample: short against the driver and the oscillation."""
    longest_s = math.inf
    if plant.time_constant_s is not None:
        longest_s = plant.time_constant_s
    if plant.natural_frequency_Hz is not None:
        longest_s = min(longest_s, 1 / (40 * plant.natural_frequency_Hz))
    steps = max(16, math.ceil(1 / (sample_rate_Hz * longest_s)))
    return min(steps, _FINEST, max(16, _MOST_STEPS // samples))


class Player:
    """One run: its voltages, its history and its situation, played with any effects."""

    def __init__(
        self, command_V: FloatArray, history_V: FloatArray, situation: Situation, hysteresis: Hysteresis
    ) -> None:
        self.situation = situation
        self.samples = len(command_V)
        self._history_V = history_V
        self._hysteresis = hysteresis
        steps = situation.refinement
        longer_V = np.concatenate([command_V, np.full(AFTER, command_V[-1])])
        if situation.plant.hold == "first":
            share = np.arange(steps) / steps
            fine_V = (longer_V[:-1, None] + np.diff(longer_V)[:, None] * share).ravel()
            self._command_V = np.append(fine_V, longer_V[-1])
        else:  # each node has the voltage just before it
            self._command_V = np.append(longer_V[0], np.repeat(longer_V[:-1], steps))
        self._played: list[tuple[FloatArray, FloatArray, FloatArray]] = []

    def respond(self, effects: Sequence[Acting] = ()) -> tuple[FloatArray, FloatArray]:
        """The reading without noise, and the displacement itself, both of shape (n,), in um."""
        situation = self.situation
        history_V = _apply(effects, "history", self._history_V, situation)
        command_V = _apply(effects, "command", self._command_V, situation)
        tau_s = _apply(effects, "driver", situation.plant.time_constant_s, situation)
        situation.voltage_V = _drive(command_V, tau_s, situation)
        operate: Operator = _apply(effects, "hysteresis", lambda path_V: self._play(history_V, path_V), situation)
        static_um = situation.rig.reversible(situation.voltage_V) + operate(situation.voltage_V)
        static_um = _apply(effects, "static", static_um, situation)
        plant = situation.plant
        mode = None
        if plant.natural_frequency_Hz is not None and plant.damping_ratio is not None:
            mode = Mode(plant.natural_frequency_Hz, plant.damping_ratio)
        mechanics: Mechanics = _apply(effects, "mechanics", Mechanics(mode), situation)
        displacement_um = mechanics.respond(static_um, situation.time_s)
        reading_um = _apply(effects, "environment", displacement_um, situation)
        reading_um = _apply(effects, "sensor", reading_um, situation)
        even = np.arange(self.samples) * situation.refinement
        instants_s = _apply(effects, "sampling", even * situation.step_s, situation)
        return np.interp(instants_s, situation.time_s, reading_um), displacement_um[even]

    def read(self, reading_um: FloatArray, effects: Sequence[Acting]) -> FloatArray:
        """What is written down, shape (n,), in um: the effects that come after the sensor's noise."""
        return _apply(effects, "reading", reading_um, self.situation)

    def _play(self, history_V: FloatArray, path_V: FloatArray) -> FloatArray:
        for before_V, known_V, known_um in self._played:
            if np.array_equal(before_V, history_V) and np.array_equal(known_V, path_V):
                return known_um
        for turn_V in history_V:
            self._hysteresis.glide(np.array([turn_V]))
        spacing_V = _SPACING * (self.situation.rig.upper_V - self.situation.rig.lower_V)
        irreversible_um = np.concatenate(
            [_glide(self._hysteresis, run_V, spacing_V) for run_V in monotone_runs(path_V, float(history_V[-1]))]
        )
        # The run without effects is the first: strengths are searched against it.
        self._played = [*self._played[:1], (history_V, path_V, irreversible_um)]
        return irreversible_um


def _glide(hysteresis: Hysteresis, voltage_V: FloatArray, spacing_V: float) -> FloatArray:
    """Ask the operator at voltages (V) about `spacing_V` apart, and join them by straight lines in voltage."""
    if len(voltage_V) < 3:
        return hysteresis.glide(voltage_V)
    sign = 1.0 if voltage_V[-1] >= voltage_V[0] else -1.0
    way = sign * (voltage_V - voltage_V[0])
    cells = np.floor(way / spacing_V)
    asked = np.ones(len(way), bool)
    asked[1:-1] = cells[1:-1] != cells[:-2]
    return np.interp(way, way[asked], hysteresis.glide(voltage_V[asked]))


def _apply(effects: Sequence[Acting], place: Place, signal: Any, situation: Situation) -> Any:
    for acting in effects:
        if acting.effect.place == place:
            signal = acting(signal, situation)
    return signal


def _drive(command_V: FloatArray, tau_s: TimeConstant | None, situation: Situation) -> FloatArray:
    """The driver's voltage, shape (N,), in V, at rest before the first."""
    if tau_s is None:
        return command_V
    if callable(tau_s):
        return _drive_stepwise(command_V, tau_s, situation)
    decay = math.exp(-situation.step_s / tau_s)
    if situation.plant.hold == "first":
        lag = (1 - decay) * tau_s / situation.step_s
        gains = [1 - lag, lag - decay]
    else:
        gains = [1 - decay]
    settled = lfilter(gains, [1.0, -decay], command_V - command_V[0])
    return command_V[0] + settled


def _drive_stepwise(
    command_V: FloatArray, tau_s: Callable[[float, float], float], situation: Situation
) -> FloatArray:
    step_s, straight = situation.step_s, situation.plant.hold == "first"

    def ahead(now_V: float, before_V: float, next_V: float, tau: float) -> float:
        # Where the command goes on along a straight line, the voltage lags it by slope times tau.
        lag_V = (next_V - before_V) / step_s * tau if straight else 0.0
        start_V = before_V if straight else next_V
        return next_V - lag_V + (now_V - start_V + lag_V) * math.exp(-step_s / tau)

    now_V = before_V = float(command_V[0])
    voltage_V = [now_V]
    for next_V in command_V[1:].tolist():
        if not next_V == before_V == now_V:
            # The time constant of the middle of the step, where that would lead with the one of its beginning.
            asked_V = (before_V + next_V) / 2 if straight else next_V
            middle_V = (now_V + ahead(now_V, before_V, next_V, tau_s(now_V, asked_V - now_V))) / 2
            now_V = ahead(now_V, before_V, next_V, tau_s(middle_V, asked_V - middle_V))
        voltage_V.append(now_V)
        before_V = next_V
    return np.array(voltage_V)
