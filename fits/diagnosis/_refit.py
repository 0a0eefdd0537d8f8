"""Effects fitted to what the baseline leaves, the baseline following along its tangent space."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.diagnosis._effects import Bench, Law, Simulated, remembering, strength_of
from fits.diagnosis._orthonormal import orthonormal
from fits.diagnosis._projector import Projector
from fits.diagnosis._score import Scored, law_of
from fits.io._threads import map_in_threads
from fits.io.columns import columns_beside
from fits.io.columns.temperature import TEMPERATURE
from fits.stats._score_test import BLOCK
from microid.effects import AbstractEffect

STEP = 1e-3
# Standard deviations up to which a strength may be larger than it was found.
_LARGEST_Z = 3.0
# Rounds of a fit, the farthest that a coordinate moves in one, the factor by which that is shortened where it was too
# far, and the gain in chi-square below which a fit stops.
_ROUNDS, _FARTHEST, _SHORTER, _LEAST_GAIN = 12, 3.0, 4.0, 0.1
# Last rounds of which the best says what others may gain.
_LAST = 3
# Part of a derivative below which what the baseline leaves of it is rounding, and the variance of a coordinate that
# the runs do not show.
_ROUNDING_SHARE, _UNKNOWN_VARIANCE = 1e-4, 1e6
# Multiple of its range in the runs by which a rig may have moved at most before one, and the least of a room's.
_FARTHER, _ROOM_K = 2.0, 0.5
# Displacements beyond this are those of a model that runs away, and multiples of the linearised answer as starts.
_AWAY_um, _MULTIPLES = 1e9, (1.0, 3.0, 9.0)


@dataclass(frozen=True)
class Refit:
    """A set of effects, fitted together.

    `x` are the coordinates of the `laws`; `change_um` what they change in the plain stage's response, shape `(n,)`
    per run; `residual` what is left, whitened and joined, off the baseline's tangent space, and `cost` its sum of
    squares in noise variances; `tangent` the derivatives of the response along all coordinates, off the same, shape
    `(rows, k)`.
    """

    laws: tuple[Law, ...]
    x: tuple[np.ndarray, ...]
    change_um: tuple[np.ndarray, ...]
    residual: np.ndarray
    tangent: np.ndarray
    cost: float

    @property
    def freedom(self) -> int:
        """Number of coordinates that the data determine."""
        if self.tangent.shape[1] == 0:
            return 0
        size = np.linalg.svd(self.tangent, compute_uv=False)
        return int(np.sum(size > 1e-6 * size[0])) if size[0] > 0 else 0

    def criterion(self, count: int) -> float:
        """Bayesian information criterion: the smaller, the better."""
        return self.cost + self.freedom * float(np.log(count))

    def effects(self, run: int) -> list[AbstractEffect]:
        """The effects in one run."""
        return [law.effect(x, run) for law, x in zip(self.laws, self.x, strict=True)]

    def with_law(self, k: int, law: Law) -> tuple[list[Law], list[np.ndarray]]:
        """Laws and coordinates with one of them replaced, at its start."""
        laws, x = list(self.laws), list(self.x)
        laws[k], x[k] = law, law.start
        return laws, x

    def with_last(self, k: int) -> "Refit":
        """The same, one of the laws being the last."""
        order = [*(i for i in range(len(self.laws)) if i != k), k]
        owner = np.repeat(np.arange(len(self.laws)), [law.size for law in self.laws])
        columns = np.concatenate([np.flatnonzero(owner == i) for i in order])
        laws, x = tuple(self.laws[i] for i in order), tuple(self.x[i] for i in order)
        return replace(self, laws=laws, x=x, tangent=self.tangent[:, columns])

    def covariance(self, robust: bool = True) -> np.ndarray:
        """Of all coordinates together.

        A robust one is larger where what is left stays alike for a while, as where the model of an effect is not
        exact: as large as sums over blocks say (the sandwich of White, Econometrica 48 (1980) 817).
        """
        size = np.linalg.norm(self.tangent, axis=0)
        scale = np.where(size > 0, size, 1.0)
        value, vector = np.linalg.eigh((self.tangent / scale).T @ (self.tangent / scale))
        # What the runs do not show may be anything.
        spread = vector / np.sqrt(np.maximum(value, _ROUNDING_SHARE**2)) / scale[:, None]
        plain = spread @ spread.T
        sums = np.add.reduceat(self.tangent * self.residual[:, None], np.arange(0, len(self.residual), BLOCK))
        spread_out = np.sum((sums @ plain) ** 2, axis=0)
        wider = np.sqrt(np.maximum(spread_out / np.maximum(np.diagonal(plain), 1e-300), 1.0))
        seen = size > 0
        scaled = plain * wider * wider[:, None] if robust else plain
        return np.where(seen[:, None] & seen, scaled, np.diag(np.where(seen, 0.0, _UNKNOWN_VARIANCE)))

    def is_noise(self, projector: Projector, chance_z: float) -> bool:
        """Whether what is left is no more than noise, within so many standard deviations."""
        return self.cost < projector.count - projector.freedom + chance_z * (2 * projector.count) ** 0.5

    def determined(self, least_z: float, marginally: bool = True, alone: bool = False) -> bool:
        """Whether the strength of the last effect is so far from zero, in some run at least, and within its bounds.

        Marginally, whatever its other coordinates are, as its time constant, or else beside them as they were found:
        where an effect is weak, the records may show no more than that it is there. At its bound it counts only where
        it `alone` leaves nothing but noise of what was more.
        """
        law, x = self.laws[-1], self.x[-1]
        if not law.form.strength or (alone and law.at_bound(x)):
            return True
        if law.at_bound(x):
            return False
        varied = np.arange(law.size) if marginally else np.flatnonzero(law.strengths)
        before = self.tangent.shape[1] - law.size
        beside = replace(self, tangent=self.tangent[:, [*range(before), *(before + varied)]])
        covariance = beside.covariance(robust=False)[before:, before:]
        runs = range(len(law.maps) if law.each.any() else 1)
        strengths = [_strength(law, x, run, varied, covariance) for run in runs]
        return any(bool(np.any(np.abs(here) > least_z * sd)) for here, sd in strengths)

    def strength_z(self, k: int) -> float:
        """Standard deviations of a law's strength from zero, in the run that shows it best; infinite without one."""
        if not self.laws[k].form.strength:
            return np.inf
        return max(float(np.max(np.abs(here) / np.maximum(sd, 1e-300))) for here, sd in self._strengths(k))

    def in_each_run(self, which: Sequence[int], part: float, apart_z: float) -> bool:
        """Whether some laws together may be at least a part as strong in every run as where they are strongest."""
        each = np.concatenate([self._strengths(k) for k in which], axis=-1)
        least = part * np.max(np.linalg.norm(each[:, 0], axis=1))
        return bool(np.all(np.linalg.norm(np.abs(each[:, 0]) + apart_z * each[:, 1], axis=1) >= least))

    def _strengths(self, k: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Strengths of a law in each run, and their standard deviations."""
        law, x = self.laws[k], self.x[k]
        own = slice(start := sum(other.size for other in self.laws[:k]), start + law.size)
        covariance = self.covariance()[own, own]
        return [_strength(law, x, run, np.arange(law.size), covariance) for run in range(len(law.maps))]

    def possible(self, bench: Bench) -> bool:
        """Whether what went on in the last effect before the runs is no more than moves of the rig leave behind."""
        law, x = self.laws[-1], self.x[-1]
        if not law.form.moved or not law.remembers:
            return True
        columns = [columns_beside(run.record) for run in bench.baseline.runs]
        room_K = max(_ROOM_K, *(float(np.ptp(beside.get(TEMPERATURE, 0.0))) for beside in columns))
        spans = {"um": bench.baseline.stroke_um, "V": float(np.ptp(bench.baseline.range_V)), "K": room_K}
        before = self.tangent.shape[1] - law.size
        covariance = self.covariance(robust=False)[before:, before:]
        for run in range(len(law.maps)):
            here, sd = _strength(law, x, run, np.arange(law.size), covariance)
            most = _FARTHER * spans[law.form.moved] * float(np.max(np.abs(here) + _LARGEST_Z * sd))
            effect = law.effect(x, run)
            if any(float(np.max(np.abs(getattr(effect, name)))) > most for name in law.form.history):
                return False
        return True

    def basis(self) -> np.ndarray:
        """Orthonormal columns that span the tangent."""
        return orthonormal(self.tangent)


def _strength(
    law: Law, x: np.ndarray, run: int, varied: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Strengths of an effect in a run, and their standard deviations by the covariance of the varied coordinates."""
    here, moves = strength_of(law, x, run), STEP * np.eye(law.size)[varied]
    slope = np.stack([(strength_of(law, x + move, run) - here) / STEP for move in moves], axis=1)
    return here, np.sqrt(np.maximum(np.diagonal(slope @ covariance @ slope.T), 0))


def nothing(bench: Bench, projector: Projector) -> Refit:
    """The baseline without any effect."""
    residual = projector.off(projector.residual)
    change_um = tuple(np.zeros_like(plain) for plain in bench.plain)
    return Refit((), (), change_um, residual, np.zeros((len(residual), 0)), float(residual @ residual))


def refit(
    bench: Bench, projector: Projector, laws: Sequence[Law], x: Sequence[np.ndarray], rounds: int = _ROUNDS
) -> Refit:
    """Fit effects together by Levenberg and Marquardt's steps, the baseline projected out (variable projection)."""
    return fit_laws(bench, projector, laws, x, 0, np.zeros((len(projector.residual), 0)), rounds)


def refit_beside(bench: Bench, projector: Projector, model: Refit, scored: Scored, enough: float = np.inf) -> Refit:
    """Fit one more effect, those that are there following along their tangent.

    It starts from the multiple of the linearised answer that explains most: effects saturate as they grow, and from
    too weak a start a fit ends in another minimum. It is given up where it does not come to a sum of squares that is
    `enough`.
    """
    basis, runs = model.basis(), len(bench.prepared)

    def fit(law: Law, rounds: int) -> Refit:
        laws, x = [*model.laws, law], [*model.x, law.start]
        return fit_laws(bench, projector, laws, x, len(model.laws), basis, rounds, enough)

    laws = [law_of(scored, runs, more) for more in (_MULTIPLES if scored.form.strength else (1.0,))]
    found = fit(min(laws, key=lambda law: fit(law, 0).cost), _ROUNDS)
    if not scored.form.history:
        return found
    # What went on before the runs is unknown where that explains more than so many coordinates do by chance.
    unknown = fit(remembering(bench, found.laws[-1], found.x[-1]), _ROUNDS)
    better = unknown.criterion(projector.count) < found.criterion(projector.count)
    return unknown if better and unknown.possible(bench) else found


def refit_around(bench: Bench, projector: Projector, model: Refit, which: int, law: Law, rounds: int) -> Refit:
    """Fit all other laws beside one that stays as it starts."""
    laws, x = model.with_law(which, law)
    if len(laws) == 1:
        return refit(bench, projector, laws, x, 0)
    order = [which, *(k for k in range(len(laws)) if k != which)]
    nothing = np.zeros((len(projector.residual), 0))
    found = fit_laws(bench, projector, [laws[k] for k in order], [x[k] for k in order], 1, nothing, rounds)
    return in_order(found, order)


def in_order(found: Refit, order: Sequence[int]) -> Refit:
    """Laws and coordinates in the order from which they were taken."""
    back = np.argsort(order)
    return replace(found, laws=tuple(found.laws[k] for k in back), x=tuple(found.x[k] for k in back))


def fit_laws(
    bench: Bench,
    projector: Projector,
    laws: Sequence[Law],
    x: Sequence[np.ndarray],
    held: int,
    basis: np.ndarray,
    rounds: int,
    enough: float = np.inf,
) -> Refit:
    """Fit all laws but the first so many, which follow along `basis`.

    Rounds that are left are not taken where none of them would be `enough`, gaining as much as one of the last.
    """
    runs = len(bench.prepared)
    moving = laws[held:]
    target = projector.off(projector.residual)

    def parts(flat: np.ndarray) -> list[np.ndarray]:
        return np.split(flat, np.cumsum([law.size for law in moving])[:-1])

    fixed = [[law.effect(own, run) for law, own in zip(laws[:held], x[:held], strict=True)] for run in range(runs)]
    # Per run, whether it depends on each of the coordinates.
    counts = [[k in law.places[run] for law in moving for k in range(law.size)] for run in range(runs)]

    def simulated_in(run: int, flat: np.ndarray, near: Simulated | None) -> Simulated:
        effects = [*fixed[run], *(law.effect(own, run) for law, own in zip(moving, parts(flat), strict=True))]
        return bench.simulate_in(run, effects, near)

    def change_in(run: int, simulated: Simulated) -> np.ndarray:
        # What runs away is as wrong as can be, and its square is still a number.
        return np.clip(bench.displacement_um(run, simulated) - bench.plain[run], -_AWAY_um, _AWAY_um)

    def off(joined: np.ndarray) -> np.ndarray:
        moved = projector.off(joined)
        return moved - basis @ (basis.T @ moved)

    def left(change_um: Sequence[np.ndarray]) -> np.ndarray:
        moved = aim - off(projector.join(change_um))
        return np.where(np.isfinite(moved), moved, 1e6)

    def simulated(flat: np.ndarray, near: Sequence[Simulated | None]) -> list[Simulated]:
        return map_in_threads(simulated_in, range(runs), [flat] * runs, near)

    def slope() -> np.ndarray:
        at, raw = projector.join(at_um), np.empty((len(target), len(flat)))
        moves = [(run, k) for k in range(len(flat)) for run in range(runs) if counts[run][k]]
        steps = flat + STEP * np.eye(len(flat))

        def moved_um(run: int, k: int) -> np.ndarray:
            return change_in(run, simulated_in(run, steps[k], here[run]))

        found = dict(zip(moves, map_in_threads(lambda move: moved_um(*move), moves), strict=True))
        for k in range(len(flat)):
            raw[:, k] = (projector.join([found.get((run, k), um) for run, um in enumerate(at_um)]) - at) / STEP
        raw = np.where(np.isfinite(raw), raw, 0.0)
        seen = -off(raw)
        return np.where(np.linalg.norm(seen, axis=0) > _ROUNDING_SHARE * np.linalg.norm(raw, axis=0), seen, 0.0)

    aim = target - basis @ (basis.T @ target)
    flat = np.concatenate(list(x[held:]))
    here = simulated(flat, [None] * runs)
    at_um = list(map(change_in, range(runs), here))
    residual = left(at_um)
    jacobian = slope() if rounds else np.zeros((len(residual), len(flat)))
    damping, farthest = 1e-3, _FARTHEST
    turning = np.concatenate([law.turning for law in moving])
    gains = list[float]()
    for number in range(rounds):
        cost = float(residual @ residual)
        scale = np.linalg.norm(jacobian, axis=0) + 1e-300
        gram, cross = (jacobian / scale).T @ (jacobian / scale), (jacobian / scale).T @ residual
        moved = False
        for _ in range(4):
            step = -np.linalg.solve(gram + damping * np.eye(len(flat)), cross) / scale
            # No coordinate moves by more than a few e-folds at a time, or than less where that was too far, as near a
            # bound; one at its bound holds no other back. Cosine and sine of a line turn as its frequency moves.
            step = np.where(turning, step, np.clip(step, -farthest, farthest))
            ahead = simulated(flat + step, here)
            ahead_um = list(map(change_in, range(runs), ahead))
            trial = left(ahead_um)
            if float(trial @ trial) < cost:
                flat, here, at_um, residual = flat + step, ahead, ahead_um, trial
                damping, moved = damping / 10, True
                farthest = min(_SHORTER * farthest, _FARTHEST)
                break
            damping *= 10
            farthest = min(farthest, float(np.max(np.abs(step)))) / _SHORTER
        left_over = float(residual @ residual)
        gains.append(cost - left_over)
        hopeless = left_over - max(gains[-_LAST:]) * (rounds - 1 - number) > enough
        if not moved or gains[-1] < _LEAST_GAIN or hopeless:
            break
        jacobian = slope()
    found = tuple(laws), (*x[:held], *parts(flat)), tuple(at_um)
    return Refit(*found, residual, -jacobian, float(residual @ residual))
