"""What happens to the mass on its spring."""

import math
from dataclasses import replace

from scipy.optimize import brentq

from data_synth._effect import POSITIVE, Situation, effect
from data_synth._mechanics import Mechanics, Mode


@effect(
    "mechanics",
    "share",
    usual=0.05,
    limit=0.4,
    draws={"frequency_ratio": (1.4, 2.5), "damping_ratio": (0.003, 0.05)},
    needs="mass",
    between={"frequency_ratio": POSITIVE, "damping_ratio": POSITIVE},
)
def second_resonance(
    mechanics: Mechanics,
    run: Situation,
    *,
    share: float,
    frequency_ratio: float = 2.0,
    damping_ratio: float = 0.02,
) -> Mechanics:
    """A second oscillator has `share` of the displacement, at `frequency_ratio` times the first one's frequency.

    The static gain stays as it is.
    """
    assert mechanics.mode is not None
    second = Mode(mechanics.mode.natural_frequency_Hz * frequency_ratio, damping_ratio)
    return replace(mechanics, others=(*mechanics.others, (share, second)))


class _Hardening:
    """A spring whose stiffness is `1 + rise ((x - centre) / reach)^2` of the usual."""

    def __init__(self, rise: float, centre_um: float, reach_um: float) -> None:
        self._rise, self._centre_um, self._reach_um = rise, centre_um, reach_um

    def rest(self, static_um: float) -> float:
        far_um = abs(static_um) + self._reach_um
        return float(brentq(lambda x: x + self.force_um(x) - static_um, -far_um, far_um))

    def force_um(self, displacement_um: float) -> float:
        away = (displacement_um - self._centre_um) / self._reach_um
        return self._rise * away * away * displacement_um


@effect(
    "mechanics",
    "rise",
    usual=0.005,
    limit=0.1,
    draws={"centre_share": (0.01, 0.5)},
    needs="mass",
    between={"rise": (-1.0, math.inf)},
)
def stiffness_hardening(mechanics: Mechanics, run: Situation, *, rise: float, centre_share: float = 0.0) -> Mechanics:
    """Duffing's spring: the stiffness rises by `rise` at one stroke away from `centre_share` of the stroke."""
    stroke_um = run.rig.stroke_um
    return replace(
        mechanics,
        resistances=(*mechanics.resistances, lambda: _Hardening(rise, centre_share * stroke_um, stroke_um)),
    )


class _Stop:
    """A spring of `stiffness` times the stage's, that only touches beyond `stop_um`."""

    def __init__(self, stop_um: float, stiffness: float) -> None:
        self._stop_um, self._stiffness = stop_um, stiffness

    def rest(self, static_um: float) -> float:
        beyond_um = max(static_um - self._stop_um, 0.0)
        return static_um - beyond_um * self._stiffness / (1 + self._stiffness)

    def force_um(self, displacement_um: float) -> float:
        return self._stiffness * max(displacement_um - self._stop_um, 0.0)


@effect(
    "mechanics",
    "stiffness",
    usual=1.0,
    limit=30.0,
    draws={"stop_share": (0.9, 0.995)},
    needs="mass",
    between={"stiffness": (-1.0, 100.0), "stop_share": POSITIVE},
)
def end_stop(mechanics: Mechanics, run: Situation, *, stiffness: float, stop_share: float = 0.95) -> Mechanics:
    """A spring of `stiffness` times the stage's own touches it beyond `stop_share` of the stroke."""
    stop_um = stop_share * run.rig.stroke_um
    return replace(mechanics, resistances=(*mechanics.resistances, lambda: _Stop(stop_um, stiffness)))


class _Dahl:
    """Friction that saturates at `most_um` (force over stiffness) within a few `length_um` of travel."""

    def __init__(self, most_um: float, length_um: float) -> None:
        self._most_um, self._length_um = most_um, length_um
        self._force_um = self._before_um = 0.0

    def rest(self, static_um: float) -> float:
        # The stage has come down to its rest.
        self._force_um, self._before_um = -self._most_um, static_um + self._most_um
        return self._before_um

    def force_um(self, displacement_um: float) -> float:
        way_um = displacement_um - self._before_um
        self._before_um = displacement_um
        if way_um != 0:
            # Dahl's law, exactly, along a way without a turn.
            end_um = math.copysign(self._most_um, way_um)
            self._force_um = end_um + (self._force_um - end_um) * math.exp(-abs(way_um) / self._length_um)
        return self._force_um


@effect(
    "mechanics",
    "force_um",
    usual=0.1,
    limit=1.0,
    draws={"length_um": (0.1, 1.0)},
    needs="mass",
    between={"length_um": POSITIVE},
)
def friction(mechanics: Mechanics, run: Situation, *, force_um: float, length_um: float = 0.3) -> Mechanics:
    """Dahl friction at the mass: its greatest force over the stiffness (um), and the travel it needs (um).

    Source: P. Dahl, A Solid Friction Model (1968).
    """
    return replace(mechanics, resistances=(*mechanics.resistances, lambda: _Dahl(force_um, length_um)))


@effect(
    "mechanics",
    "mass_share",
    usual=0.1,
    limit=3.0,
    draws={"instant_share": (0.35, 0.65)},
    needs="mass",
    between={"mass_share": (-1.0, math.inf)},
)
def load_change(
    mechanics: Mechanics, run: Situation, *, mass_share: float, instant_share: float = 0.5, first_run: int = 0
) -> Mechanics:
    """A load of `mass_share` of the mass is put on at `instant_share` of each run from `first_run` on.

    With `instant_share` 0 the load is there from the start of those runs: it changes between runs.
    """
    if run.index < first_run:
        return mechanics
    return replace(mechanics, load=(1 + mass_share, instant_share * run.duration_s))
