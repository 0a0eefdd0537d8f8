"""What a run that was not measured yet would add: the information of the old runs plus that of a virtual one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import qr

from fits.diagnosis._effects import Bench, Law
from fits.diagnosis._projector import Projector
from fits.diagnosis._regression import Regression, beside, regress
from fits.io._record import Record
from fits.io._threads import map_in_threads
from fits.loop._run import prepare_run
from fits.stats._noise import Noise
from microid.effects import AbstractEffect

_STEP = 1e-3
# The farthest that a draw moves a coordinate, which are of the order of one.
FARTHEST_DRAW = 1.0
# Relative precision below which a direction counts as not seen.
_RIDGE = 1e-10
# Noise that was learnt at a sampling interval so many times longer or shorter says nothing of its colour.
_LIKE = 1.5


@dataclass(frozen=True)
class Hypothesis:
    """Effects that the stage may have, none for the plain stage.

    `x` are the coordinates of the `laws` in all runs; `covariances` are of those of each, or empty if not known.
    """

    laws: tuple[Law, ...]
    x: tuple[np.ndarray, ...]
    covariances: tuple[np.ndarray, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(law.form.name for law in self.laws)

    def without(self, name: str) -> "Hypothesis":
        """The same without an effect, its covariances left out."""
        kept = [k for k, other in enumerate(self.names) if other != name]
        return Hypothesis(tuple(self.laws[k] for k in kept), tuple(self.x[k] for k in kept))

    def alone(self, run: int) -> "Hypothesis":
        """The same in one run only."""
        laws = tuple(Law([law.effect(x, run)], law.remembers) for law, x in zip(self.laws, self.x, strict=True))
        return Hypothesis(laws, tuple(law.vector(x, run) for law, x in zip(self.laws, self.x, strict=True)))

    def effects(self, run: int) -> list[AbstractEffect]:
        """The effects as they are in one run."""
        return [law.effect(x, run) for law, x in zip(self.laws, self.x, strict=True)]

    def drawn(self, rng: np.random.Generator) -> "Hypothesis":
        """The same effects with other coordinates that the runs allow, none of them moved by more than one."""
        if not self.covariances:
            return self
        x = []
        for at, covariance in zip(self.x, self.covariances, strict=True):
            value, vector = np.linalg.eigh((covariance + covariance.T) / 2)
            moved = vector @ (np.sqrt(np.maximum(value, 0.0)) * rng.standard_normal(len(value)))
            x.append(at + np.clip(moved, -FARTHEST_DRAW, FARTHEST_DRAW))
        return replace(self, x=tuple(x))


class Predictor:
    """Predicts how well hypotheses are told apart after one more run.

    `bench` and `projector` are of the runs at hand, beside the first hypothesis. The `pairs` that are compared are of
    the one that is true, and the one that is fitted.
    """

    def __init__(
        self, bench: Bench, projector: Projector, hypotheses: Sequence[Hypothesis], pairs: Sequence[tuple[int, int]]
    ):
        self.bench, self.projector = bench, projector
        self.hypotheses, self.pairs = tuple(hypotheses), tuple(pairs)
        # Where an effect differs from run to run, it will be as it was in the longest.
        self._like = int(np.argmax([one.run.record.duration_s for one in bench.prepared]))
        self._next = [h.alone(self._like) for h in hypotheses]
        self._kinds = [kind for kind, size in enumerate(projector.roughness) if size > 0]
        regression = projector.regression
        self._shared = regression.size + sum(regression.finer[kind][0].shape[1] for kind in self._kinds)
        # What driver and mechanics can follow depends on what comes after them, and so on what is fitted.
        fitted = sorted({fitted for _, fitted in self.pairs})
        columns = self._old_columns()
        self._old = {k: self._old_gram(self._beside(k), columns) for k in fitted}

    @property
    def present_z(self) -> float:
        """Standard deviations by which the worst pair differs in the runs at hand."""
        return self._worst(self._old)

    def predicted_z(self, time_s: np.ndarray, voltage_V: np.ndarray) -> float:
        """The same after a run with this command, shape `(n,)` each."""
        new = self._new_grams(time_s, voltage_V)
        return self._worst({k: gram + new[k] for k, gram in self._old.items()})

    def _beside(self, k: int) -> Projector:
        """The projector beside a hypothesis."""
        projector = self.projector
        if k == 0:
            return projector
        effects = [self.hypotheses[k].effects(run) for run in range(len(self.bench.prepared))]
        return Projector(beside(projector.regression, effects), projector.noise, projector.roughness, projector.held)

    def _old_columns(self) -> list[list[np.ndarray]]:
        """Of all hypotheses, what they change in the runs at hand, and the derivatives of that."""
        columns: list[list[np.ndarray]] = []
        for h in self.hypotheses:
            change, slopes = _changes(self.bench, h)
            columns.append(change)
            for law, along in zip(h.laws, slopes, strict=True):
                # Strengths in the new run, which no old run says anything of.
                nothing = [np.zeros_like(one) for one in change]
                columns += [*along, *[nothing] * int(law.differs.sum())]
        return columns

    def _old_gram(self, projector: Projector, columns: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
        """Gram matrix of what runs share and of the signals, each run's nuisance parameters eliminated."""
        signals = np.stack([projector.join(column) for column in columns], axis=1)
        root, outside = projector.root, projector.off(signals)
        stacked = np.concatenate([root, projector.along(signals)], axis=1)
        gram = stacked.T @ stacked
        size = root.shape[1]
        gram[size:, size:] += outside.T @ outside
        return _eliminated(gram, np.r_[0 : self._shared, size : len(gram)])

    def _new_grams(self, time_s: np.ndarray, voltage_V: np.ndarray) -> dict[int, np.ndarray]:
        """The same of a run with this command alone, beside each hypothesis that is fitted."""
        baseline = self.bench.baseline
        record = next_record(time_s, voltage_V, self.bench.prepared[self._like].run.record)
        # With steps between the samples that are too long, a lag and a delay differ by what both are off.
        stride = baseline.fine[self._like].coarser.stride
        run = prepare_run(record, baseline.range_V, "unknown", 0.0, stride, hold=baseline.stage.hold)
        alone = baseline.alone(run)
        bench, noise = Bench(alone), self._noise(float(time_s[1] - time_s[0]))
        columns = []
        for h, new in zip(self.hypotheses, self._next, strict=True):
            (change,), slopes = _changes(bench, new)
            columns.append(change)
            for law, along in zip(h.laws, slopes, strict=True):
                # Along the coordinates in the old runs, and then along the strengths that are its own.
                old = [np.zeros_like(change)] * law.size
                for i in np.flatnonzero(~law.differs):
                    old[law.places[self._like, i]] = along[i][0]
                columns += [*old, *(along[i][0] for i in np.flatnonzero(law.differs))]
        grams, last = {}, None
        for k in self._old:
            effects = [self._next[k].effects(0)]
            last = regress(alone, None, effects) if last is None else beside(last, effects)
            shared = [last.rows[0], *self._finer_of(last)]
            rows = noise.whiten(np.concatenate([*shared, np.stack(columns, axis=1)], axis=1))[run.fitted]
            nuisance, _ = qr(noise.whiten(last.nuisance[0])[run.fitted], mode="economic")
            rows -= nuisance @ (nuisance.T @ rows)
            grams[k] = rows.T @ rows
        return grams

    def _finer_of(self, new: Regression) -> list[np.ndarray]:
        """What is finer than the grid in a new run, which has nothing of the past of the old ones."""
        old = self.projector.regression.finer
        each = [(new.finer[kind][0], old[kind][0].shape[1]) for kind in self._kinds]
        return [np.pad(here, ((0, 0), (0, width - here.shape[1]))) for here, width in each]

    def _noise(self, interval_s: float) -> Noise:
        """Noise of the run that was sampled most alike; white where none was."""
        intervals = np.array([np.median(np.diff(one.run.record.time_s)) for one in self.bench.prepared])
        ratios = np.abs(np.log(intervals / interval_s))
        nearest = int(np.argmin(ratios))
        noise = self.projector.noise[nearest]
        colour = noise.past if ratios[nearest] < np.log(_LIKE) else np.zeros(0)
        return Noise(noise.innovation_um if len(colour) else noise.total_um, colour)

    def _worst(self, grams: Mapping[int, np.ndarray]) -> float:
        """The smallest difference of all pairs, off what the stage and the fitted hypothesis can follow."""
        rest = {k: _eliminated(gram, np.arange(self._shared, len(gram))) for k, gram in grams.items()}
        sizes = [1 + sum(law.size + int(law.differs.sum()) for law in h.laws) for h in self.hypotheses]
        starts = np.cumsum([0, *sizes])
        found = []
        for true, fitted in self.pairs:
            # Difference of the two, then the coordinates of the fitted one.
            pick = np.eye(len(rest[fitted]))[:, starts[fitted] : starts[fitted + 1]]
            pick[starts[true], 0], pick[starts[fitted], 0] = 1.0, -1.0
            found.append(float(_eliminated(pick.T @ rest[fitted] @ pick, np.arange(1))[0, 0]))
        return max(min(found), 0.0) ** 0.5


def next_record(time_s: np.ndarray, voltage_V: np.ndarray, like: Record) -> Record:
    """A run that was not measured yet, whose further columns run as in another record, stretched to its duration."""
    share, old = np.linspace(0, 1, len(time_s)), np.linspace(0, 1, len(like))
    extra = {name: np.interp(share, old, values) for name, values in like.extra.items()}
    return Record(time_s, voltage_V, np.zeros(len(time_s)), extra, source="the next run")


def _changes(bench: Bench, h: Hypothesis) -> tuple[list[np.ndarray], list[list[list[np.ndarray]]]]:
    """What a hypothesis changes in all runs, in um, and of each effect the derivatives along its coordinates."""
    at = bench.respond([h.effects(run) for run in range(len(bench.prepared))])
    slopes: list[list[list[np.ndarray]]] = []

    def along(k: int, j: int) -> list[np.ndarray]:
        law = h.laws[k]
        moved = replace(h, x=(*h.x[:k], h.x[k] + _STEP * np.eye(law.size)[j], *h.x[k + 1 :]))
        ahead = [bench.respond_in(i, moved.effects(i)) if j in law.places[i] else at[i] for i in range(len(at))]
        return [(a - b) / _STEP for a, b in zip(ahead, at, strict=True)]

    for k, law in enumerate(h.laws):
        slopes.append(map_in_threads(along, [k] * law.size, range(law.size)))
    return [a - b for a, b in zip(at, bench.plain, strict=True)], slopes


def _eliminated(gram: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """What is left of a Gram matrix after all other columns followed (Schur complement)."""
    other = np.setdiff1d(np.arange(len(gram)), keep)
    if len(other) == 0:
        return gram
    scale = np.sqrt(np.diagonal(gram)[other]) + 1e-300
    inner = gram[np.ix_(other, other)] / scale[:, None] / scale[None, :]
    factor = np.linalg.cholesky(inner + _RIDGE * np.eye(len(other)))
    half = np.linalg.solve(factor, gram[np.ix_(other, keep)] / scale[:, None])
    return gram[np.ix_(keep, keep)] - half.T @ half
