"""Whether slow loops are predicted better with a lag, or relaxations, behind their hysteresis."""

import operator
from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import jax
import numpy as np

from fits.loop._design import Grid
from fits.loop._grid import EVIDENCE_LEVELS, non_negative
from fits.loop._moments import BLOCKS, PIECES, Moments, blocks_of, gather, grid_of, without_nuisance
from fits.loop._prior import Hyper, Posterior, roughness
from fits.loop._run import Run, simulate_run
from fits.loop._surface import Surface

# Time constants that stand for all of a relaxation, from so many samples to such a part of a run.
_CONSTANTS, _SHORTEST, _LONGEST = 3, 20, 1 / 4
# The lag, in samples, from which the one that fits is found, and in how many rounds.
_LAG, _ROUNDS = 2.0, 3
# The error must fall to this share, in blocks that were only predicted.
_CLEARLY = 0.85
_REMEDIES = {"a lag": "a lag", "relaxations (creep)": f"{_CONSTANTS} relaxations"}
_LAGS, _RELAXES = _REMEDIES


def suggestions(runs: Sequence[Run], model: Surface, stroke_um: float, hyper: Hyper) -> list[str]:
    """Suggest the fit of a lag, or of relaxations, where blocks of the runs are predicted better with them.

    Each is fitted together with the density, on few levels: a density that was fitted alone took in what it could of
    them. As in a fit, all are non-negative: with gains below zero relaxations would do for a lag. The smoothness and
    noise given are in strokes.
    """
    grid = grid_of(runs, EVIDENCE_LEVELS)
    alone = [gather(grid, [run]).blocks for run in runs]
    predicted_um = [simulate_run(model, run) for run in runs]
    lag_s = _LAG * min(float(np.median(np.diff(run.record.time_s))) for run in runs)

    # A lag is not linear in its time constant: its signal is made anew where a fit of the density and it finds it.
    for _ in range(_ROUNDS):
        lags = [_lag(run, moved, lag_s) for run, moved in zip(runs, predicted_um, strict=True)]
        *columns, times = _solve(reduce(operator.add, _gather(grid, runs, alone, lags, stroke_um)), hyper)
        if times == 0:
            break
        lag_s *= times
        surface = grid.surface(np.array(columns) * stroke_um)
        predicted_um = [simulate_run(surface, run) for run in runs]
    signals = [
        np.c_[_lag(run, moved, lag_s), _relaxations(run, moved)]
        for run, moved in zip(runs, predicted_um, strict=True)
    ]
    blocks = _gather(grid, runs, alone, signals, stroke_um)

    def error(what: tuple[str, ...]) -> float:
        return _error([_kept(block, grid.columns, what) for block in blocks], hyper)

    out, taken = list[str](), tuple[str, ...]()
    before = error(taken)
    for choice in ([(_LAGS,), (_RELAXES,)], [(_LAGS, _RELAXES)]):
        after = {what: error(what) for what in choice}
        best = min(after, key=lambda what: after[what])
        share = after[best] / max(before, 1e-300)
        if share >= _CLEARLY:
            continue
        rest, added = "beside that, " if taken else "", [one for one in best if one not in taken]
        out.append(
            f"{rest}{' and '.join(added)} would take {100 * (1 - share):.0f} % of the residual away, in blocks that "
            f"are predicted from the others: fit again with {' and '.join(_REMEDIES[one] for one in best)}"
        )
        taken, before = best, after[best]
    return out


def _lag(run: Run, moved_um: np.ndarray, lag_s: float) -> np.ndarray:
    """What a lag adds to a displacement, shape `(n, 1)`."""
    return (_behind(run, moved_um, lag_s) - moved_um)[:, None]


def _relaxations(run: Run, moved_um: np.ndarray) -> np.ndarray:
    """What relaxations add to a displacement, and what moves before it leave to them, shape `(n, 2 k)`."""
    time_s = run.record.time_s - run.record.time_s[0]
    longest = _LONGEST * time_s[-1]
    constants_s = np.geomspace(min(_SHORTEST * time_s[-1] / (len(time_s) - 1), longest), longest, _CONSTANTS)
    added = [_behind(run, moved_um - moved_um[0], one) for one in constants_s]
    return np.stack([*added, *(np.exp(-time_s / one) for one in constants_s)], axis=1)


def _behind(run: Run, moved_um: np.ndarray, constant_s: float) -> np.ndarray:
    """A displacement behind a lag of the first order, from rest, shape `(n,)`."""
    from scipy.signal import lfilter  # slow to import, and a fit that leaves noise needs none of it

    time_s = run.record.time_s
    even_s = np.linspace(time_s[0], time_s[-1], len(time_s))
    moved = np.interp(even_s, time_s, moved_um)
    left = np.exp(-(even_s[1] - even_s[0]) / constant_s)
    return np.interp(time_s, even_s, lfilter([1 - left], [1, -left], moved, zi=left * moved[:1])[0])


def _gather(
    grid: Grid,
    runs: Sequence[Run],
    alone: Sequence[tuple[Moments, ...]],
    signals_um: Sequence[np.ndarray],
    stroke_um: float,
) -> list[Moments]:
    """Moments of blocks, in strokes, of the density's columns and then of the signals of each run, `(n, k)`.

    Those of the density `alone` are given for each run.
    """
    found = [Moments.empty(grid.columns + signals_um[0].shape[1])] * BLOCKS
    for run, blocks, signals in zip(runs, alone, signals_um, strict=True):
        # How the density's columns respond is added up for one signal at a time, as for a measured displacement.
        played = [replace(run, record=replace(run.record, displacement_um=one)) for one in signals.T]
        of = [blocks, *(gather(grid, [one]).blocks for one in played)]
        label, every = blocks_of(run, PIECES), np.c_[run.displacement_um, signals]
        for number in range(BLOCKS):
            weight = (label == number) * (1.0 if run.weight is None else run.weight)
            off = every - weight @ every / max(weight.sum(), 1e-300)
            own, square = of[0][number], off.T @ (weight[:, None] * off)
            beside = np.stack([one[number].cross_um for one in of], axis=1)
            gram = np.block(
                [[own.gram, beside[:, 1:] / stroke_um], [beside[:, 1:].T / stroke_um, square[1:, 1:] / stroke_um**2]]
            )
            cross = np.r_[beside[:, 0], square[1:, 0] / stroke_um] / stroke_um
            found[number] = found[number] + Moments(gram, cross, own.energy_um2 / stroke_um**2, own.count)
    return found


def _kept(block: Moments, size: int, what: tuple[str, ...]) -> Moments:
    """Moments of the density's columns and of what is fitted beside them."""
    lag, gains, before = np.split(np.arange(size, len(block.cross_um)), [1, 1 + _CONSTANTS])
    first = np.r_[:size, lag if _LAGS in what else [], gains if _RELAXES in what else []].astype(int)
    order = np.r_[first, before if _RELAXES in what else []].astype(int)
    kept = Moments(block.gram[np.ix_(order, order)], block.cross_um[order], block.energy_um2, block.count)
    return without_nuisance(kept, len(first))[0] if len(order) > len(first) else kept


def _solve(moments: Moments, hyper: Hyper) -> np.ndarray:
    """Non-negative columns; nothing is believed beforehand of those that are not the density's."""
    even = roughness(EVIDENCE_LEVELS)
    more = len(moments.cross_um) - len(even.density)
    return non_negative(Posterior.of(moments, jax.tree.map(lambda form: np.pad(form, (0, more)), even), hyper))[0]


def _error(blocks: Sequence[Moments], hyper: Hyper) -> float:
    """Root mean square, in strokes, by which blocks are missed that are predicted from the others."""
    whole, square = reduce(operator.add, blocks), 0.0
    for block in blocks:
        columns = _solve(whole - block, hyper)
        square += float(block.energy_um2 - 2 * columns @ block.cross_um + columns @ block.gram @ columns)
    return (max(square, 0.0) / max(float(whole.count), 1.0)) ** 0.5
