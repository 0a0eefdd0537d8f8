"""What a re-fitted baseline leaves of a signal: projection off its tangent space, in units of the noise."""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve, solve_triangular
from scipy.linalg.lapack import dpstrf

from fits.diagnosis._baseline import Baseline
from fits.diagnosis._orthonormal import AT_ONCE, SHOWN, inverse_root
from fits.diagnosis._regression import Regression, regress
from fits.io._threads import map_in_threads
from fits.loop._grid import non_negative
from fits.loop._prior import Posterior, definite
from fits.loop._result import FitError, FitStatus
from fits.stats._compare import surprise
from fits.stats._noise import Noise

# Standard deviations by which the data press a column that is zero below that, beyond chance.
_PRESSED_Z = 3.0
# The farthest that a coordinate moves at a time.
_FARTHEST = 3.0


class Projector:
    """Takes off signals what the baseline can follow.

    Signals are given per run, for all samples; inside they are whitened by the `noise` of each run, joined, and
    followed by one entry for each unknown that has a prior. `roughness` is the standard deviation of the relative
    roughness of the density that its grid cannot follow, of each kind in `Regression.finer`. Columns that are `held`,
    shape `(D,)`, stay where they are.
    """

    def __init__(
        self,
        regression: Regression,
        noise: Sequence[Noise],
        roughness: Sequence[float] = (),
        held: np.ndarray | None = None,
    ):
        self._regression, self.noise, self.roughness = regression, tuple(noise), tuple(roughness)
        self.held = np.zeros(regression.baseline.chain.size, dtype=bool) if held is None else held
        self.masks = regression.masks
        self.count = sum(int(mask.sum()) for mask in self.masks)
        grid = regression.baseline.chain.size
        self._rough = [(kind, size) for kind, size in zip(regression.finer, roughness, strict=False) if size > 0]
        rough = sum(kind[0].shape[1] for kind, _ in self._rough)
        self._priors = grid + rough
        matrix = self._joined()
        size = np.sqrt(np.einsum("ij,ij->j", matrix, matrix))
        # What changes nothing in the samples that count, as what has died away before them, stays where it is.
        self._live = size > 0
        self._scale = np.where(self._live, size, 1.0)
        matrix /= self._scale
        self._gram = matrix.T @ matrix
        columns = np.arange(len(size))
        self._is_rough = (columns >= regression.size) & (columns < regression.size + rough)
        self._kept: np.ndarray | None = matrix
        self.residual = self.join(regression.residuals)
        self.residual[self.count : self.count + grid] = -regression.root @ regression.baseline.columns_um
        self._factor()

    def _joined(self) -> np.ndarray:
        """Columns of the tangent and below them the roots of their priors, shape `(rows, unknowns)`."""
        regression = self.regression
        blocks = [regression.rows, *(kind for kind, _ in self._rough)]
        nuisance = self.nuisance_rows
        stops = np.cumsum([block[0].shape[1] for block in blocks])
        matrix = np.empty((len(nuisance), stops[-1] + nuisance.shape[1]))
        for block, stop in zip(blocks, stops, strict=True):
            self.join(block, matrix[:, stop - block[0].shape[1] : stop])
        matrix[:, stops[-1] :] = nuisance
        row = self.count + len(regression.root)
        matrix[self.count : row, : len(regression.root)] = regression.root
        for (kind, size), at in zip(self._rough, stops, strict=False):
            k = kind[0].shape[1]
            matrix[row : row + k, at : at + k] = np.eye(k) / size
            row += k
        return matrix

    @property
    def regression(self) -> Regression:
        """All runs as one regression."""
        if not self._regression.rows:
            one = self._regression
            self._regression = regress(one.baseline, one.finer, one.effects)
        return self._regression

    @property
    def _matrix(self) -> np.ndarray:
        """The same in columns of length one."""
        if self._kept is None:
            self._kept = self._joined() / self._scale
        return self._kept

    def release(self) -> None:
        """Free what takes the most memory, and is computed again where it is needed."""
        self.__dict__.pop("bare", None)
        self._kept, self._regression = None, replace(self._regression, rows=())

    def _factor(self) -> None:
        """Factorise the tangent of what is not held."""
        held = np.pad(self.held, (0, len(self._scale) - len(self.held)))
        self._moving = np.flatnonzero(~(held if any(self.roughness) else held | self._is_rough))
        # A Cholesky factor, pivoted: columns that the others make up have nothing of their own to be projected on.
        factor, pivots, rank, _ = dpstrf(self._gram[np.ix_(self._moving, self._moving)], tol=SHOWN, lower=1)
        lower, order = np.tril(factor)[:, :rank], self._moving[pivots - 1]
        self._inverse = np.zeros((len(self._scale), rank))
        self._inverse[order[:rank]] = solve_triangular(lower[:rank], np.eye(rank), lower=True).T
        self._root = np.zeros((rank, len(self._scale)))
        self._root[:, order] = lower.T
        # Samples that are worth one of the unknowns: what is fitted takes so many degrees of freedom off.
        self.freedom = float(rank - np.sum((self._matrix[self.count :] @ self._inverse) ** 2))

    @cached_property
    def bare(self) -> "Projector":
        """The same without roughness of the density beyond its grid."""
        return self._sharing(self.held, ()) if any(self.roughness) else self

    def _sharing(self, held: np.ndarray, roughness: Sequence[float]) -> "Projector":
        """The same with other columns held, or without roughness, which shares all but the factors."""
        other = copy(self)
        for name in ("bare", "_spread"):
            other.__dict__.pop(name, None)
        other.held, other.roughness = held, tuple(roughness)
        other._factor()
        return other

    def beside(self, noise: Sequence[Noise] | None = None, roughness: Sequence[float] | None = None) -> "Projector":
        """The same with other noise or roughness."""
        other = self.noise if noise is None else noise, self.roughness if roughness is None else roughness
        return Projector(self.regression, *other, self.held)

    def with_readings_less(self, heights_um: Sequence[np.ndarray]) -> "Projector":
        """The same with readings that are less by some heights, shape `(n,)` per run."""
        residuals = tuple(map(np.subtract, self.regression.residuals, heights_um))
        return Projector(replace(self.regression, residuals=residuals), self.noise, self.roughness, self.held)

    def bounded(self, change_um: Sequence[np.ndarray] = ()) -> "Projector":
        """Hold the columns that are zero and that the data press below that, under what effects change in each run.

        The others are at their best then: without a bound, a few relays that one run does not reach would follow
        whatever differs from run to run.
        """
        zero, gram = self.regression.baseline.columns_um <= 0, self._gram
        joined = self.residual - self.join(change_um) if len(change_um) else self.residual
        cross = self._matrix.T @ joined
        at, others = np.flatnonzero(zero), np.setdiff1d(np.arange(len(cross)), np.flatnonzero(zero))
        half = inverse_root(gram[np.ix_(others, others)])
        along = gram[np.ix_(at, others)] @ half
        left = np.diagonal(gram)[at] - np.sum(along**2, axis=1)
        best = cross[at] - along @ (half.T @ cross[others])
        held = np.zeros(len(zero), dtype=bool)
        held[at] = best < -_PRESSED_Z * np.sqrt(np.maximum(left, SHOWN))
        return self if np.array_equal(held, self.held) else self._sharing(held, self.roughness)

    @property
    def leverage(self) -> np.ndarray:
        """Part of an unknown that each joined sample is worth, shape `(rows,)`."""
        columns = self._matrix @ self._inverse
        return np.einsum("ij,ij->i", columns, columns)

    @property
    def root(self) -> np.ndarray:
        """The tangent's columns in terms of orthonormal ones that span it, shape `(k, unknowns)`."""
        return self._root * self._scale

    def along(self, joined: np.ndarray) -> np.ndarray:
        """Joined signals in terms of these orthonormal columns, shape `(k, ...)`."""
        return self._inverse.T @ (self._matrix.T @ joined)

    @property
    def nuisance_rows(self) -> np.ndarray:
        """The runs' nuisance parameters, whitened and joined, shape `(rows, k)`."""
        nuisance = self.regression.nuisance
        out = np.zeros((self.count + self._priors, sum(o.shape[1] for o in nuisance)))
        row = at = 0
        for o, noise, mask in zip(nuisance, self.noise, self.masks, strict=True):
            stop = row + int(mask.sum())
            out[row:stop, at : at + o.shape[1]] = noise.whiten(o)[mask]
            row, at = stop, at + o.shape[1]
        return out

    def join(self, signals: Sequence[np.ndarray], into: np.ndarray | None = None) -> np.ndarray:
        """Whiten signals of all runs, each of shape `(n, ...)`, and join them; shape `(count + priors, ...)`.

        Many at once are whitened some at a time: all of them would take the memory of several such results.
        """
        out = np.empty((self.count + self._priors, *signals[0].shape[1:])) if into is None else into
        out[self.count :] = 0.0
        row = 0
        for signal, noise, mask in zip(signals, self.noise, self.masks, strict=True):
            stop = row + int(mask.sum())
            if out.ndim == 1:
                out[row:stop] = noise.whiten(signal)[mask]
            for at in range(0, out.shape[1] if out.ndim > 1 else 0, AT_ONCE):
                out[row:stop, at : at + AT_ONCE] = noise.whiten(signal[:, at : at + AT_ONCE])[mask]
            row = stop
        return out

    def off(self, joined: np.ndarray) -> np.ndarray:
        """Project joined signals off the tangent."""
        return joined - self._matrix @ (self._inverse @ self.along(joined))

    def take_off(self, joined: np.ndarray) -> None:
        """Project joined signals off the tangent in place and many at once: of long records they fill the memory."""

        def take(at: int) -> None:
            joined[:, at : at + AT_ONCE] = self.off(joined[:, at : at + AT_ONCE])

        self._matrix  # noqa: B018  computed here and not in each thread
        map_in_threads(take, range(0, joined.shape[1], AT_ONCE))

    def split(self, joined: np.ndarray) -> list[np.ndarray]:
        """Cut a joined signal into those of the runs, whitened, at the samples that count."""
        stops = np.cumsum([int(mask.sum()) for mask in self.masks])
        return np.split(joined[: self.count], stops[:-1])

    def unit_um(self, joined: np.ndarray) -> float:
        """What one standard deviation of a joined signal is before it is whitened, root mean square."""
        square = 0.0
        for part, noise, mask in zip(self.split(joined), self.noise, self.masks, strict=True):
            whole = np.zeros(len(mask))
            whole[mask] = part
            square += float(np.sum(noise.colour(whole)[mask] ** 2))
        return (square / max(float(joined[: self.count] @ joined[: self.count]), 1e-300)) ** 0.5

    def step(self, joined: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Steps of coordinates and columns by which the baseline follows a joined signal best."""
        answer = self._answer(joined)
        columns = self.regression.baseline.chain.size
        return answer[columns : self.regression.size], answer[:columns]

    @cached_property
    def _spread(self) -> np.ndarray:
        """Root of the covariance, in the order of its eigenvalues: that of pivots is up to rounding."""
        value, vector = np.linalg.eigh(self._gram[np.ix_(self._moving, self._moving)])
        shown = value > SHOWN / 10 * value[-1]
        spread = np.zeros((len(self._scale), int(shown.sum())))
        spread[self._moving] = vector[:, shown] / np.sqrt(value[shown])
        return spread

    def variance_um2(self, rows: np.ndarray) -> np.ndarray:
        """Variance, by what the runs leave open, of what the first unknowns make of rows `(n, k)`, shape `(n,)`."""
        return np.sum((rows @ (self._spread[: rows.shape[1]] / self._scale[: rows.shape[1], None])) ** 2, axis=1)

    def draw(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Steps of coordinates and columns to another baseline that the runs allow, drawn by their covariance."""
        spread = self._spread
        answer = (spread @ rng.standard_normal(spread.shape[1])) / self._scale
        columns = self.regression.baseline.chain.size
        return answer[columns : self.regression.size], answer[:columns]

    def follow(self, joined: np.ndarray) -> list[np.ndarray]:
        """What the baseline, and roughness of its density, make of the best steps along a joined signal, `(n,)` each.

        The runs' nuisance parameters follow, too, and are no part of it.
        """
        answer = self._answer(joined)
        kinds = [self.regression.rows, *(kind for kind, _ in self._rough)]
        parts = np.split(answer, np.cumsum([kind[0].shape[1] for kind in kinds]))
        return [sum(kind[k] @ part for kind, part in zip(kinds, parts, strict=False)) for k in range(len(self.masks))]

    def _answer(self, joined: np.ndarray) -> np.ndarray:
        return (self._inverse @ self.along(joined)) / self._scale

    def held_out(self, change_um: Sequence[np.ndarray]) -> np.ndarray:
        """Errors in what is held out of the runs, in noise, one after the other, under effects; shape `(n,)`.

        The baseline, without roughness beyond its grid, and the runs' nuisance parameters follow what was fitted.
        """
        bare, regression = self.bare, self.regression
        step, columns = bare.step(bare.residual - bare.join(change_um))
        found = []
        for k, run in enumerate(regression.baseline.runs):
            left = regression.residuals[k] - change_um[k] - regression.rows[k] @ np.concatenate([columns, step])
            nuisance, mask, held = regression.nuisance[k], self.masks[k], run.held_out
            if held.any():
                left = left - nuisance @ np.linalg.lstsq(nuisance[mask], left[mask], rcond=None)[0]
                found.append(left[held] / self.noise[k].total_um)
        return np.concatenate(found) if found else np.zeros(0)

    def surprise(self, errors: np.ndarray) -> float:
        """How improbable such errors in what was held out are, shape `(n,)`; see `fits.stats._compare.surprise`."""
        stops = np.cumsum([int(run.held_out.sum()) for run in self.regression.baseline.runs])
        each = zip(np.split(errors, stops[:-1]), self.noise, strict=True)
        return sum(surprise(own, noise) for own, noise in each if len(own))

    def move(self, joined: np.ndarray) -> Baseline:
        """The baseline moved so that it follows a joined signal best, with columns that stay non-negative.

        What roughness beyond the grid would explain is not put into the grid.
        """
        baseline, held = self.regression.baseline, 1.0
        while True:
            dz, columns_um = self._followed(joined, held)
            if np.all(np.abs(dz) < _FARTHEST):
                return baseline.moved(dz, columns_um - baseline.columns_um)
            # What the runs hardly show at this place says little of places far away.
            held *= 10

    def _followed(self, joined: np.ndarray, held: float) -> tuple[np.ndarray, np.ndarray]:
        """Steps of coordinates that a precision holds, and non-negative columns, that follow a joined signal."""
        baseline = self.regression.baseline
        columns = baseline.chain.size
        bare = np.flatnonzero(~self._is_rough)
        scale = self._scale[bare]
        gram = self._gram[np.ix_(bare, bare)] * scale * scale[:, None]
        cross = (self._matrix.T @ joined)[bare] * scale
        live = self._live[bare][columns:]
        coordinate = np.arange(len(live)) < self.regression.size - columns
        block = gram[columns:, columns:][np.ix_(live, live)]
        block = block + np.diag(1e-12 * np.diagonal(block) + held * coordinate[live])
        alone, follow = np.zeros(len(live)), np.zeros((len(live), columns))
        alone[live] = np.linalg.solve(block, cross[columns:][live])
        follow[live] = np.linalg.solve(block, gram[columns:, :columns][live])
        precision = gram[:columns, :columns] - gram[:columns, columns:] @ follow
        precision, root = definite((precision + precision.T) / 2 + 1e-12 * np.diag(np.diagonal(precision)))
        step = cho_solve((root, True), cross[:columns] - follow.T @ cross[columns:])
        kept, found = non_negative(Posterior(baseline.columns_um + step, precision, root))
        if not found:
            raise FitError(FitStatus.MAX_STEPS)
        others = alone - follow @ (np.asarray(kept) - baseline.columns_um)
        return others[coordinate], np.asarray(kept)
