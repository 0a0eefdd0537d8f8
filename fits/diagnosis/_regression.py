"""All runs as one regression: derivatives of the baseline, and finer structure of the density than its grid has."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from scipy.linalg import cholesky

from fits.diagnosis._baseline import Baseline
from fits.diagnosis._evaluate import simulate, with_effects
from fits.diagnosis._tangent import answering, behind, dressed, passed
from fits.loop._design import Grid
from fits.loop._prior import interpolation
from fits.loop._run import Run
from fits.stage._moments import Chain, linearise, pieces
from microid import AbstractEffect

# Levels of the grid of the finer structure, and how many random examples of it stand for all.
_FINE = 64
_EXAMPLES = 120
# Of central differences along coordinates, which are of the size of one.
_STEP = 1e-4
# Part of an unknown of a run that must be left in the samples that count.
_DEAD = 1e-3


# By kind, per run.
Kinds: TypeAlias = tuple[tuple[np.ndarray, ...], ...]


@dataclass(frozen=True)
class Regression:
    """Derivatives of a baseline in all runs, for all samples.

    Attributes
    ----------
    baseline
        Where it is linearised.
    masks
        Samples of each run that are fitted, shape `(n,)`.
    rows
        Derivatives along columns and coordinates, shape `(n, D + p)` per run.
    own
        Each run's nuisance parameters, shape `(n, k)`.
    finer
        By kind, per run, what relative roughness of the density changes that the grid cannot follow, shape `(n, k)`:
        of loops of one width at all biases, as play operators are, and at single places of the half-plane.
    residuals
        Measurement less simulation, in um, shape `(n,)` per run.
    root
        Root of the prior precision of the columns, shape `(D, D)`.
    through
        Per run, the effects that the derivatives go through; the residuals are those without them.
    """

    baseline: Baseline
    masks: tuple[np.ndarray, ...]
    rows: tuple[np.ndarray, ...]
    own: tuple[np.ndarray, ...]
    finer: Kinds
    residuals: tuple[np.ndarray, ...]
    root: np.ndarray
    through: tuple[tuple[AbstractEffect, ...], ...]

    @property
    def size(self) -> int:
        """Number of columns and coordinates."""
        return self.rows[0].shape[1]


def regress(
    baseline: Baseline, finer: Kinds | None = None, effects: Sequence[Sequence[AbstractEffect]] = ()
) -> Regression:
    """Linearise a baseline in all its runs.

    Parameters
    ----------
    baseline
        The plain stage.
    finer
        Structure finer than its grid, from a baseline nearby and under the same effects; computed by default.
    effects
        Per run, those beside which the baseline moves: the derivatives along coordinates go through all that answer
        to the stage, those along columns where that matters.
    """
    chain, runs, z = baseline.chain, baseline.runs, jnp.asarray(baseline.z)
    assert chain.grid is not None
    through = tuple(map(passed, effects)) if effects else ((),) * len(runs)
    bases = _bases(baseline) if finer is None else []
    rows, own, residuals = [], [], []
    kinds: list[list[np.ndarray]] = [[] for _ in bases]
    stage = baseline.stage
    beside = tuple(map(answering, effects)) if effects else ((),) * len(runs)
    for run, fine_run, there, own_effects in zip(runs, baseline.fine, through, beside, strict=True):
        here = dressed(chain, baseline.z, there)
        _, slope, free = linearise(chain, z, jnp.asarray(baseline.columns_um), run)
        n = len(run.record)
        both = np.empty((n, chain.size + slope.shape[1]))
        both[:, chain.size :] = _slope(baseline, own_effects, fine_run) if own_effects else slope[:n]
        for first, columns in pieces(here, z, run, True):
            both[first : first + len(columns), : chain.size] = columns[: n - first]
        around = both[:, : chain.size] @ baseline.columns_um
        both[:, : chain.size] = behind(here, baseline.z, run, around, both[:, : chain.size])
        rows.append(both)
        plain = simulate(stage, fine_run)
        speed = np.gradient(plain, run.record.time_s)[:, None]
        late = [speed] if baseline.skewed else []
        # With an instant off by d, a reading is y + d y' + d^2 y'' / 2: the first is noise, the second is not.
        blur = [np.gradient(speed[:, 0], run.record.time_s)[:, None]] if baseline.blurred else []
        own.append(_alive(np.concatenate([free[:n], *late, *blur], axis=1), run.fitted))
        residuals.append(run.displacement_um - plain)
        if finer is None:
            fine = Chain(here.coordinates, here.place, Grid(chain.grid.lower_V, chain.grid.upper_V, _FINE))
            for kind, part in zip(kinds, _along(fine, baseline, run, bases, around), strict=True):
                kind.append(part)
    return Regression(
        baseline,
        tuple(run.fitted for run in runs),
        tuple(rows),
        tuple(own),
        tuple(tuple(kind) for kind in kinds) if finer is None else finer,
        tuple(residuals),
        root_of(baseline.prior),
        through,
    )


def root_of(prior: np.ndarray) -> np.ndarray:
    """Root, in 1/um, of a prior precision of columns, in 1/um^2, both of shape `(D, D)`."""
    return cholesky(prior + 1e-12 * np.trace(prior) / len(prior) * np.eye(len(prior)))


def _alive(own: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """A run's nuisance parameters without those that have died away before the samples that count.

    They would be fitted to noise there, and reach far beyond it where they begin.
    """
    left = np.linalg.norm(own[fitted], axis=0) > _DEAD * np.linalg.norm(own, axis=0)
    return np.where(left, own, 0.0)


def _slope(baseline: Baseline, effects: tuple[AbstractEffect, ...], run: Run) -> np.ndarray:
    """Derivatives along the coordinates of the stage with effects, shape `(n, p)`, by central differences.

    Their programs are at hand, those of exact ones would have to be compiled for every effect.
    """
    out = np.empty((len(run.record), len(baseline.z)))
    for k, step in enumerate(_STEP * np.eye(len(baseline.z))):
        ends = [simulate(with_effects(baseline.moved(way, 0.0).stage, effects), run) for way in (step, -step)]
        out[:, k] = (ends[0] - ends[1]) / (2 * _STEP)
    return out


def _bases(baseline: Baseline) -> list[np.ndarray]:
    """Relative roughness of the density, in columns of the finer grid, in um, shape `(D, k)` by kind."""
    grid = baseline.chain.grid
    assert grid is not None
    smooth = interpolation(grid.levels, _FINE) @ baseline.columns_um
    weights = _FINE * (_FINE + 1) // 2
    density, slope = np.maximum(smooth[:weights], 0), smooth[weights:]
    i, j = np.tril_indices(_FINE)
    loops = np.zeros((len(smooth), _FINE))
    loops[np.arange(weights), i - j] = density
    # Relays without width are the reversible part.
    loops[weights:, 0] = slope
    rng = np.random.default_rng(0)
    places = np.zeros((len(smooth), _EXAMPLES))
    places[:weights] = density[:, None] * rng.standard_normal((weights, _EXAMPLES)) / _EXAMPLES**0.5
    return [loops, places]


def _along(
    finer: Chain, baseline: Baseline, run: Run, bases: list[np.ndarray], around_um: np.ndarray
) -> list[np.ndarray]:
    joined = np.concatenate(bases, axis=1)
    parts = [columns @ joined for _, columns in pieces(finer, jnp.asarray(baseline.z), run, True)]
    moved = behind(finer, baseline.z, run, around_um, np.concatenate(parts)[: len(run.record)])
    return np.split(moved, np.cumsum([base.shape[1] for base in bases])[:-1], axis=1)
