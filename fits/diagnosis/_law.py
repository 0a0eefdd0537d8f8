"""Coordinates of one effect in all runs: what they share, and what each has by itself."""

import math
from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.diagnosis._score import Scored
from microid import AbstractEffect, Coordinates, ParameterInfo, Sensor

# Part of a bound within which a coordinate is at it.
_BOUND = 1e-2


def _alone(effect: AbstractEffect) -> AbstractEffect:
    anything = Sensor(jnp.ones(()), jnp.zeros(()))
    return replace(effect, inner=anything) if hasattr(effect, "inner") else effect  # type: ignore[call-arg]


class Law:
    """The coordinates of one effect in all runs.

    Those of an effect that differs from run to run are what the runs share, then what is its own in each: strengths,
    or what went on before the run.

    Parameters
    ----------
    effects
        The effect in each run.
    remembers
        Whether what went on in it before each run is unknown, or else nothing.
    held
        Parameters that stay as they are.
    """

    def __init__(self, effects: Sequence[AbstractEffect], remembers: bool = False, held: Sequence[str] = ()):
        self.form, self.remembers = type(effects[0]), remembers
        closed = (*held, *(() if remembers else self.form.history))
        # The part that an effect is put around is put in anew wherever it is simulated.
        self.maps = [Coordinates(_alone(effect), lambda info: _free(info, closed)) for effect in effects]
        vectors = [np.asarray(one.of(_alone(effect))) for one, effect in zip(self.maps, effects, strict=True)]
        names = [info.path for info in self.maps[0].table]
        self.each = self.differs if len(effects) > 1 else np.zeros(len(vectors[0]), dtype=bool)
        self.names = tuple(names)
        self.start = np.concatenate([vectors[0][~self.each], *(v[self.each] for v in vectors if self.each.any())])
        if not self.each.any():
            self.start = vectors[0]

    @property
    def differs(self) -> np.ndarray:
        """Which coordinates differ from run to run if there are several, shape `(k,)`."""
        return self._of((*(self.form.strength if self.form.per_run else ()), *self.form.history))

    @property
    def strengths(self) -> np.ndarray:
        """Which coordinates are strengths, shape `(size,)`."""
        strong = self._of(self.form.strength)
        if not self.each.any():
            return strong
        return np.concatenate([strong[~self.each], np.tile(strong[self.each], len(self.maps))])

    @property
    def common(self) -> dict[str, int]:
        """Numbers of the coordinates that all runs share, by parameter; without what went on before the runs."""
        found, at, own = {}, 0, self.each.any()
        for info in self.maps[0].table:
            differs = info.path in self.form.history or (info.path in self.form.strength and self.form.per_run)
            if own and differs:
                continue
            size = math.prod(info.shape)
            if size == 1 and info.path not in self.form.history:
                found[info.path] = at
            at += size
        return found

    def _of(self, paths: Sequence[str]) -> np.ndarray:
        return np.concatenate([np.full(math.prod(info.shape), info.path in paths) for info in self.maps[0].table])

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.start)

    def vector(self, x: np.ndarray, run: int) -> np.ndarray:
        """Coordinates of the effect in one run."""
        if not self.each.any():
            return x
        shared, own = int(np.sum(~self.each)), int(np.sum(self.each))
        full = np.empty(len(self.each))
        full[~self.each] = x[:shared]
        full[self.each] = x[shared + run * own : shared + (run + 1) * own]
        return full

    def pinned(self, x: np.ndarray) -> bool:
        """Whether a strength is all that it can be, or a time as short: then the effect stands in for another."""
        values, at = np.asarray(self.maps[0].values(jnp.asarray(self.vector(x, 0)))), 0
        for info in self.maps[0].table:
            size, spec = math.prod(info.shape), info.spec
            here = values[at : at + size]
            at += size
            below = spec.lower * (1 - _BOUND) if spec.lower < 0 else -np.inf
            if info.path in self.form.strength and np.any((here > spec.upper * (1 - _BOUND)) | (here < below)):
                return True
            if info.path == "time_constant_s" and np.any(here < (1 + _BOUND) * spec.lower):
                return True
        return False

    def effect(self, x: np.ndarray, run: int) -> AbstractEffect:
        """The effect in one run."""
        return _at(self.maps[run], jnp.asarray(self.vector(x, run)))


def _free(info: ParameterInfo, closed: Sequence[str]) -> bool:
    return not info.path.startswith("inner") and info.path not in closed


@eqx.filter_jit
def _at(coordinates: Coordinates[AbstractEffect], vector: Float[Array, " k"]) -> AbstractEffect:
    return coordinates(vector)


def strength_of(law: Law, x: np.ndarray, run: int) -> np.ndarray:
    effect = law.effect(x, run)
    return np.concatenate([np.ravel(np.asarray(getattr(effect, name))) for name in law.form.strength])


def remembering(law: Law, x: np.ndarray) -> Law:
    """The same effects, what went on before the runs being unknown."""
    return Law([law.effect(x, run) for run in range(len(law.maps))], True)


def law_of(scored: Scored, runs: int, more: float = 1.0) -> Law:
    """Start from a probe and the multiples of its signatures that the data ask for, or more of them."""
    form = scored.form
    effects: list[AbstractEffect] = []
    per_run = form.per_run and runs > 1
    for run in range(runs):
        first = scored.probe.effects[0]
        values = {}
        for name in form.strength:
            spec = next(i.spec for i in Coordinates(_alone(first)).table if i.path == name)
            total = np.zeros(np.shape(getattr(first, name)))
            for k, effect in enumerate(scored.probe.effects):
                share = scored.coefficients[k * runs + run] if per_run else scored.coefficients[k]
                total = total + more * float(share) * np.asarray(getattr(effect, name))
            values[name] = jnp.asarray(np.clip(total, spec.lower, spec.upper))
        effects.append(replace(first, **values) if values else first)
    return Law(effects)
