"""Effects in the runs: their simulation beside the plain stage, and their coordinates."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.diagnosis._baseline import Baseline, with_effects
from fits.diagnosis._records import LONG
from fits.io._kept import forget_programs
from fits.io._record import Record
from fits.io._threads import map_in_threads
from fits.stage._motion import Prepared, at_samples, prepare, signals
from fits.stage._run import fitted_past, place_of_hysteresis
from microid import Coordinates, Sensor, Signal, Stage
from microid.effects import AbstractEffect

# Part of a period of the resonance between samples, beyond which a run does not resolve it.
_PERIOD = 0.25
# Periods of a line in a record, as its samples show it, below which it is a drift as well.
_PERIODS = 3
# Part of a bound within which a coordinate is at it.
_BOUND = 1e-2


@dataclass(frozen=True)
class Simulated:
    """What a stage with effects makes of a run: what goes into each of its parts, and what comes out."""

    stage: Stage
    signals: Sequence[Signal]


class Bench:
    """A fitted stage and the runs, ready to be simulated with effects.

    The runs are those held out whole where it is `aside`; intervals are divided into many steps where it is `finest`.
    What effects change depends on where a rig is, and until its unknown past is wiped out that is not where the model
    is: that past is fitted to the runs, without what effects are known to have `changed_um` in them.
    """

    def __init__(
        self, baseline: Baseline, changed_um: Sequence[np.ndarray] = (), aside: bool = False, finest: bool = False
    ):
        self.baseline = baseline
        stage = baseline.stage.with_substeps(1)
        # What a fit may move is looked up anew for every stage that is built.
        self.stage = stage.thaw(*stage.frozen)
        few, many = (baseline.coarse_aside, baseline.finest_aside) if aside else (baseline.coarse, baseline.finest)
        self.resonance_Hz = baseline.resonance_Hz or 0.0
        self.prepared = [prepare(self.stage, run) for run in (many if finest else few)]
        self.known = map_in_threads(signals, [self.stage] * len(self.prepared), self.prepared)
        self.plain = [at_samples(known[-1], one) for known, one in zip(self.known, self.prepared, strict=True)]
        self._past_um = [np.zeros_like(plain) for plain in self.plain]
        for run, one in enumerate(self.prepared):
            if one.run.has_past:
                self._add_past(run, changed_um[run] if changed_um else self._past_um[run])

    def respond(self, effects: Sequence[Sequence[AbstractEffect]]) -> list[np.ndarray]:
        """Simulate all runs with effects, one list of effects per run; um, shape `(n,)` each."""
        return map_in_threads(self.respond_in, range(len(effects)), effects)

    def respond_in(self, run: int, effects: Sequence[AbstractEffect]) -> np.ndarray:
        """Simulate one run with effects; um, shape `(n,)`."""
        return self.displacement_um(run, self.simulate_in(run, effects))

    def simulate_in(self, run: int, effects: Sequence[AbstractEffect], near: Simulated | None = None) -> Simulated:
        """Simulate one run with effects; parts ahead of the first that differs are as they were `near` it."""
        one = self.prepared[run]
        stage = with_effects(self.stage, self._seen(effects, one))
        near = Simulated(self.stage, self.known[run]) if near is None else near
        return Simulated(stage, signals(stage, one, near.stage, near.signals))

    def displacement_um(self, run: int, simulated: Simulated) -> np.ndarray:
        """Displacement of a run that was simulated; um, shape `(n,)`."""
        return at_samples(simulated.signals[-1], self.prepared[run]) - self._past_um[run]

    def _add_past(self, run: int, changed_um: np.ndarray) -> None:
        """Have a run simulated with its unknown past."""
        one, known = self.prepared[run], self.known[run]
        samples, place = one.run.samples, place_of_hysteresis(self.stage)
        left_um = samples.displacement_um - known[-1].values[:: samples.stride]
        left_um = left_um.at[: len(changed_um)].add(-changed_um)
        past_um = fitted_past(self.stage, samples, one.run.coarser.samples, left_um)
        self.prepared[run] = replace(one, scene=replace(one.scene, past_um=past_um))
        # Ahead of the hysteresis nothing is another.
        self.known[run] = signals(self.stage, self.prepared[run], self.stage, known[: (place or 0) + 1])
        self._past_um[run] = at_samples(self.known[run][-1], one) - self.plain[run]

    def _seen(self, effects: Sequence[AbstractEffect], prepared: Prepared) -> list[AbstractEffect]:
        """Those that a run may be asked about: none that is its own and too fast for its samples."""
        record = prepared.run.record
        interval_s = float(np.median(np.diff(record.time_s)))
        slow = not self.resonance_Hz * interval_s > _PERIOD
        asked = [effect for effect in effects if slow or not (effect.fast and effect.per_run)]
        return [without_drifts(effect, interval_s, record.duration_s) for effect in asked]

    def change(
        self, effects: Sequence[AbstractEffect], beside: Sequence[Sequence[AbstractEffect]] = ()
    ) -> list[np.ndarray]:
        """What effects that all runs share change in them, in um, `beside` those that each of them has."""
        before = self.respond(beside) if beside else self.plain
        moved = self.respond([[*have, *effects] for have in beside or [()] * len(self.plain)])
        return [one - plain for one, plain in zip(moved, before, strict=True)]


def drop_programs(records: Sequence[Record]) -> None:
    """Free compiled programs where records are long: what JAX remembers of them takes memory, too."""
    if sum(len(record) for record in records) >= LONG:
        forget_programs()


def without_drifts(effect: AbstractEffect, interval_s: float, duration_s: float) -> AbstractEffect:
    """An effect without the lines that samples so far apart may turn into a drift of a record of this duration."""
    lines_Hz = np.array(effect.lines_Hz)
    # Samples shift a frequency by a multiple of their rate.
    shifted_Hz = np.abs(lines_Hz - np.round(lines_Hz * interval_s) / interval_s)
    seen = (shifted_Hz - effect.tolerance * lines_Hz) * duration_s > _PERIODS
    return effect if seen.all() else times(effect, seen.astype(float))


class Law:
    """The coordinates of one effect in all runs.

    Those of an effect that differs from run to run are what the runs share, then what is its own in each: strengths,
    and where it `remembers`, what went on before each run, nothing otherwise. Parameters that are `held` stay.
    """

    def __init__(self, effects: Sequence[AbstractEffect], remembers: bool = False, held: Sequence[str] = ()):
        self.form, self.remembers = type(effects[0]), remembers
        closed = (*held, *(() if remembers else self.form.history))
        # The part that an effect is put around is put in anew wherever it is simulated.
        alone = [without_host(effect) for effect in effects]
        self.maps = [
            Coordinates(one, lambda i: not i.path.startswith("inner") and i.path not in closed) for one in alone
        ]
        vectors = [np.asarray(coordinates.of(one)) for coordinates, one in zip(self.maps, alone, strict=True)]
        sizes = [math.prod(info.shape) for info in self.maps[0].table]
        stops = np.cumsum(sizes).tolist()
        self.entries = [(i, slice(b - s, b)) for i, s, b in zip(self.maps[0].table, sizes, stops, strict=True)]
        self.each = self.differs if len(effects) > 1 else np.zeros(len(vectors[0]), dtype=bool)
        self.start = np.concatenate([vectors[0][~self.each], *(v[self.each] for v in vectors)])
        # Which of them are those of a run, shape `(runs, k)`.
        shared, own = np.cumsum(~self.each) - 1, np.cumsum(self.each) - 1
        first = np.arange(len(effects))[:, None] * int(self.each.sum()) + int(np.sum(~self.each))
        self.places = np.where(self.each, first + own, shared)

    @property
    def differs(self) -> np.ndarray:
        """Which coordinates differ from run to run if there are several, shape `(k,)`."""
        return self._of((*(self.form.strength if self.form.per_run else ()), *self.form.history))

    @property
    def strengths(self) -> np.ndarray:
        """Which coordinates are strengths, shape `(size,)`."""
        strong = self._of(self.form.strength)
        return np.concatenate([strong[~self.each], np.tile(strong[self.each], len(self.maps))])

    @property
    def turning(self) -> np.ndarray:
        """Which coordinates are cosines and sines of lines, which turn into each other, shape `(size,)`."""
        return self.strengths & bool(self.form.lines_Hz)

    @property
    def common(self) -> dict[str, int]:
        """Numbers of the coordinates that all runs share, by parameter; without what went on before the runs."""
        return {
            info.path: int(self.places[0, at.start])
            for info, at in self.entries
            if at.stop - at.start == 1 and not self.each[at.start] and info.path not in self.form.history
        }

    def _of(self, paths: Sequence[str]) -> np.ndarray:
        return np.concatenate([np.full(at.stop - at.start, info.path in paths) for info, at in self.entries])

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.start)

    def vector(self, x: np.ndarray, run: int) -> np.ndarray:
        """Coordinates of the effect in one run."""
        return x[self.places[run]]

    def at_bound(self, x: np.ndarray) -> bool:
        """Whether a strength is at its bound, or another parameter where the effect is none of its kind any more.

        Then another effect may look so. A time constant is at its lower bound, the others are at their upper ones.
        """
        values = self.values(x, 0)
        for info, at in self.entries:
            here, spec = values[at], info.spec
            below = spec.lower * (1 - _BOUND) if spec.lower < 0 else -np.inf
            from_above = info.path in (*self.form.strength, *self.form.extremes)
            if from_above and np.any((here > spec.upper * (1 - _BOUND)) | (here < below)):
                return True
            if info.path == "time_constant_s" and np.any(here < (1 + _BOUND) * spec.lower):
                return True
        return False

    def values(self, x: np.ndarray, run: int) -> np.ndarray:
        """Parameters of the effect in one run, in their units."""
        return np.asarray(self.maps[run].values(jnp.asarray(self.vector(x, run))))

    def effect(self, x: np.ndarray, run: int) -> AbstractEffect:
        """The effect in one run."""
        return _at(self.maps[run], jnp.asarray(self.vector(x, run)))

    def effects(self, x: np.ndarray) -> list[AbstractEffect]:
        """The effect in each run."""
        return [self.effect(x, run) for run in range(len(self.maps))]


def strength_of(law: Law, x: np.ndarray, run: int) -> np.ndarray:
    effect = law.effect(x, run)
    return np.concatenate([np.ravel(np.asarray(getattr(effect, name))) for name in law.form.strength])


def remembering(bench: Bench, law: Law, x: np.ndarray) -> Law:
    """The same effects, what went on before the runs being unknown, and so long before as they are."""
    runs = [one.run.record.duration_s for one in bench.prepared]
    return Law([_aged(effect, of_s) for effect, of_s in zip(law.effects(x), runs, strict=True)], True)


def _aged(effect: AbstractEffect, duration_s: float) -> AbstractEffect:
    """The same effect, its history so old as suits a record of this duration."""
    return replace(effect, **{name: jnp.asarray(share * duration_s) for name, share in effect.ages})


def scaled(law: Law, x: np.ndarray, factor: float) -> Law:
    """The same effects with larger or smaller strengths."""
    return Law([times(effect, factor) for effect in law.effects(x)], law.remembers)


def times(effect: AbstractEffect, factor: float | np.ndarray) -> AbstractEffect:
    """The same effect with larger or smaller strengths."""
    return replace(effect, **{name: factor * getattr(effect, name) for name in effect.strength})


def without_host(effect: AbstractEffect) -> AbstractEffect:
    anything = Sensor(jnp.ones(()), jnp.zeros(()))
    return replace(effect, inner=anything) if hasattr(effect, "inner") else effect  # type: ignore[call-arg]


@eqx.filter_jit
def _at(coordinates: Coordinates[AbstractEffect], vector: Float[Array, " k"]) -> AbstractEffect:
    return coordinates(vector)
