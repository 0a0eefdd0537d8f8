"""All runs as one regression: Jacobian of the baseline, and structure of the density finer than its grid."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import cholesky

from fits.diagnosis._baseline import Baseline, simulate, with_effects
from fits.io._threads import map_in_threads
from fits.loop._design import Grid
from fits.loop._past import rough_past_columns
from fits.loop._prior import interpolation
from fits.loop._run import Run
from fits.stage._chain import Chain
from fits.stage._columns import combined, pieces, propagated
from fits.stage._moments import linearise
from fits.stage._motion import at_samples, prepare, signals
from fits.stage._run import ahead, answered, place_of_hysteresis
from microid import Coordinates, Stage
from microid.effects import PLACES, AbstractEffect

# Levels of the grid of the finer structure, how many random examples of it stand for all, and levels of a rough past.
_FINE, _EXAMPLES, _PAST = 64, 120, 32
# Of central differences along coordinates, which are of the size of one.
_STEP = 1e-4
# Part of an unknown of a run that must be left in the samples that count.
_DEAD = 1e-3
# By kind, per run.
Kinds: TypeAlias = tuple[tuple[np.ndarray, ...], ...]


@dataclass(frozen=True)
class Regression:
    """Jacobian of a baseline in all runs, for all samples, and what it leaves.

    Per run: `masks` of the samples that are fitted, shape `(n,)`; `rows`, derivatives along columns and coordinates,
    shape `(n, D + p)`; `nuisance`, signals of the run's nuisance parameters, shape `(n, k)`; `residuals`, measurement
    less simulation without effects, in um, shape `(n,)`; `effects`, those beside which the baseline moves.
    By kind and run, `finer` is what roughness of the density changes that the grid cannot follow, shape `(n, k)`: of
    loops of one width at all biases, as of plays, at single places, and of what an unknown past left in each run.
    `root` is that of the prior precision of the columns, shape `(D, D)`.
    """

    baseline: Baseline
    masks: tuple[np.ndarray, ...]
    rows: tuple[np.ndarray, ...]
    nuisance: tuple[np.ndarray, ...]
    finer: Kinds
    residuals: tuple[np.ndarray, ...]
    root: np.ndarray
    effects: tuple[tuple[AbstractEffect, ...], ...]

    @property
    def saturating(self) -> tuple[tuple[AbstractEffect, ...], ...]:
        """Effects of each run that derivatives along columns go through."""
        return tuple(map(saturating, self.effects))

    @property
    def size(self) -> int:
        """Number of columns and coordinates."""
        return self.rows[0].shape[1]


def regress(
    baseline: Baseline, finer: Kinds | None = None, effects: Sequence[Sequence[AbstractEffect]] = ()
) -> Regression:
    """Linearise a baseline in all its runs.

    `finer` is taken from a baseline nearby under the same effects, or else computed. `effects` are those of each run
    beside which the baseline moves: derivatives along coordinates go through all that depend on the stage, those
    along columns through those that saturate.
    """
    chain, runs, z = baseline.chain, baseline.runs, jnp.asarray(baseline.z)
    grid = chain.grid
    assert grid is not None
    effects = effects or ((),) * len(runs)
    roughness = _roughness(baseline) if finer is None else None
    stage = baseline.stage

    def each(
        run: Run, many: Run, few: Run, own: Sequence[AbstractEffect]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:
        here = with_effects_in(chain, baseline.z, saturating(own))
        _, slope, free = linearise(chain, z, jnp.asarray(baseline.columns_um), run.coarser)
        n = len(run.record)
        both = np.empty((n, chain.size + slope.shape[1]))
        # A lag of the sensor and one of the driver do nearly the same, so that telling them apart takes derivatives
        # that go through effects.
        both[:, chain.size :] = slope[:n] + _slope_of_change(baseline, own, few)
        for first, columns in pieces(here, z, run, True):
            both[first : first + len(columns), : chain.size] = columns[: n - first]
        around = both[:, : chain.size] @ baseline.columns_um
        both[:, : chain.size] = propagated(here.coordinates, here.place, z, run, around, both[:, : chain.size])
        plain = simulate(stage, many)
        speed = np.gradient(plain, run.record.time_s)
        late = [speed] if baseline.skewed else []
        # With an instant off by d, a reading is y + d y' + d^2 y'' / 2: the first is noise, the second is not.
        blur = [np.gradient(speed, run.record.time_s)] if baseline.blurred else []
        nuisance = _without_decayed(np.column_stack([free[:n], *late, *blur]), run.fitted)
        structure = list[np.ndarray]()
        if roughness is not None:
            fine = Chain(here.coordinates, here.place, Grid(grid.lower_V, grid.upper_V, _FINE))
            moved = np.concatenate([*combined(fine, z, run, roughness)])
            structure = np.split(propagated(fine.coordinates, fine.place, z, run, around, moved), [_FINE], axis=1)
        return both, nuisance, run.displacement_um - plain, structure

    found = map_in_threads(each, runs, baseline.fine, baseline.coarse, effects)
    rows, nuisance, residuals, structure = zip(*found, strict=True)
    kinds = (*zip(*structure, strict=True), _rough_pasts(baseline)) if finer is None else finer
    data = rows, nuisance, kinds, residuals
    return Regression(
        baseline, tuple(run.fitted for run in runs), *data, root_of(baseline.prior), tuple(map(tuple, effects))
    )


def root_of(prior: np.ndarray) -> np.ndarray:
    """Root, in 1/um, of a prior precision of columns, in 1/um^2, both of shape `(D, D)`."""
    return cholesky(prior + 1e-12 * np.trace(prior) / len(prior) * np.eye(len(prior)))


def _without_decayed(nuisance: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """A run's nuisance parameters without those whose signals have decayed before the samples that count.

    They would be fitted to noise there, and reach far beyond it where they begin.
    """
    left = np.linalg.norm(nuisance[fitted], axis=0) > _DEAD * np.linalg.norm(nuisance, axis=0)
    return np.where(left, nuisance, 0.0)


def beside(regression: Regression, effects: Sequence[Sequence[AbstractEffect]]) -> Regression:
    """The same regression beside other effects: from afresh where derivatives along the columns go through them."""
    baseline, size = regression.baseline, regression.baseline.chain.size
    if any(regression.saturating) or any(map(saturating, effects)):
        return regress(baseline, None, effects)
    rows = []
    for run, before, last, now in zip(baseline.coarse, regression.rows, regression.effects, effects, strict=True):
        moved = _slope_of_change(baseline, now, run) - _slope_of_change(baseline, last, run)
        rows.append(np.concatenate([before[:, :size], before[:, size:] + moved], axis=1))
    return replace(regression, rows=tuple(rows), effects=tuple(map(tuple, effects)))


def _slope_of_change(baseline: Baseline, effects: Sequence[AbstractEffect], run: Run) -> np.ndarray:
    """Derivatives along the coordinates of what effects change, shape `(n, p)`, by central differences.

    The change of those before or after the stage does not depend on it. The programs of the others are at hand, those
    of exact derivatives would have to be compiled for every effect.
    """
    # Without driver and mechanics there are no coordinates.
    dependent = [one for one in effects if one.place not in ("environment", "noise")]
    if not dependent or len(baseline.z) == 0:
        return np.zeros((len(run.record), len(baseline.z)))
    here, prepared = baseline.stage.with_substeps(1), prepare(baseline.stage, run)
    known = signals(here, prepared)

    def change(step: np.ndarray) -> np.ndarray:
        plain = baseline.moved(step, 0.0).stage.with_substeps(1)
        passed = signals(plain, prepared, here, known)
        extended = signals(with_effects(plain, dependent), prepared, plain, passed)
        return at_samples(extended[-1], prepared) - at_samples(passed[-1], prepared)

    steps = _STEP * np.eye(len(baseline.z))
    ahead, behind = np.split(np.stack(map_in_threads(change, [*steps, *-steps])), 2)
    return np.asarray((ahead - behind).T / (2 * _STEP))


def _roughness(baseline: Baseline) -> np.ndarray:
    """Relative roughness of the density, in columns of the finer grid, in um, shape `(D, k)`."""
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
    return np.concatenate([loops, places], axis=1)


def _rough_pasts(baseline: Baseline) -> tuple[np.ndarray, ...]:
    """Relative roughness of what an unknown past left in each run, in um, shape `(n, k)`: columns of its own."""
    stage, grid = baseline.stage, baseline.chain.grid
    place = place_of_hysteresis(stage)
    assert grid is not None
    assert place is not None
    levels_V, own = np.linspace(float(grid.lower_V), float(grid.upper_V), _PAST), []
    for run in baseline.runs:
        seen = ahead(stage, place, run.samples)
        columns = rough_past_columns(np.asarray(seen.values), levels_V) * baseline.stroke_um / np.ptp(levels_V)
        columns = np.asarray(answered(stage, place, run.samples, jnp.asarray(columns), seen))[: len(run.record)]
        own.append(columns if run.has_past else columns[:, :0])
    stops = np.cumsum([columns.shape[1] for columns in own])
    return tuple(
        np.pad(columns, ((0, 0), (stop - columns.shape[1], stops[-1] - stop)))
        for columns, stop in zip(own, stops, strict=True)
    )


def saturating(effects: Sequence[AbstractEffect]) -> tuple[AbstractEffect, ...]:
    """Those that derivatives along the density go through: a rail, say, beyond which nothing moves any more.

    They saturate, stand by themselves, and act before the mechanics has answered.
    """
    early = PLACES[: PLACES.index("mechanics") + 1]
    return tuple(one for one in effects if one.finite and not hasattr(one, "inner") and one.place in early)


def _extended(plain: Coordinates[Stage], effects: tuple[AbstractEffect, ...], z: Float[Array, " p"]) -> Stage:
    return with_effects(plain(z), effects)


def with_effects_in(chain: Chain, z: np.ndarray, effects: tuple[AbstractEffect, ...]) -> Chain:
    """The chain of a stage with effects, in the same coordinates and columns."""
    if not effects:
        return chain
    coordinates: Any = eqx.Partial(_extended, chain.coordinates, effects)
    return Chain(coordinates, place_of_hysteresis(coordinates(jnp.asarray(z))), chain.grid)
