"""Whether what a hysteresis leaves of slow loops is that of a lag, or of relaxations, behind it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fits.loop._grid import EVIDENCE_LEVELS
from fits.loop._moments import BLOCKS, PIECES, blocks_of, gather, grid_of
from fits.loop._prior import Hyper, Posterior, roughness
from fits.loop._run import Run, simulate_run
from fits.loop._surface import Surface

# Time constants that stand for all of a relaxation, from so many samples to such a part of a run.
_CONSTANTS, _SHORTEST, _LONGEST = 3, 20, 1 / 4
# What is left must fall to this share, in blocks that were only predicted.
_CLEARLY = 0.85


def suggestions(runs: Sequence[Run], model: Surface, stroke_um: float, hyper: Hyper) -> list[str]:
    """Suggest the fit of a lag, or of relaxations, where they predict blocks of what a hysteresis leaves better.

    The smoothness and noise given, in strokes, say what a hysteresis takes in of them.
    """
    predicted_um = [simulate_run(model, run) for run in runs]

    def beside(signals: Sequence[np.ndarray]) -> list[np.ndarray]:
        """What a hysteresis leaves of a signal of each run, `(n,)`, or of several, `(n, k)`."""
        if signals[0].ndim == 2:
            each = [beside([signal[:, k] for signal in signals]) for k in range(signals[0].shape[1])]
            return [np.stack(columns, axis=1) for columns in zip(*each, strict=True)]
        played = [replace(r, record=replace(r.record, displacement_um=s)) for r, s in zip(runs, signals, strict=True)]
        data = gather(grid_of(runs, EVIDENCE_LEVELS), played)
        columns = Posterior.of(data.total.scaled(1.0, stroke_um), roughness(EVIDENCE_LEVELS), hyper).mean
        fitted = data.grid.surface(np.asarray(columns) * stroke_um)
        return [run.without_nuisance(run.displacement_um - simulate_run(fitted, run), run.fitted) for run in played]

    lags, relaxations = [], []
    for run, predicted in zip(runs, predicted_um, strict=True):
        time = run.record.time_s - run.record.time_s[0]
        lags.append(np.gradient(predicted, time)[:, None])
        relaxations.append(_relaxed(time, predicted))
    left_um, lags, relaxations = map(beside, ([run.displacement_um for run in runs], lags, relaxations))
    found = {
        ("a lag", "--lag"): lags,
        ("relaxations (creep)", f"--relaxation {_CONSTANTS}"): relaxations,
    }
    # Each beside what is suggested already: what one leaves may hide the other.
    out, options = list[str](), ""
    taken = [np.ones((len(left), 1)) for left in left_um]
    before = _left(runs, taken, left_um)
    while found:
        joined = {key: [np.c_[own, more] for own, more in zip(taken, found[key], strict=True)] for key in found}
        rms_um = {key: _left(runs, columns, left_um) for key, columns in joined.items()}
        best = min(rms_um, key=lambda key: rms_um[key])
        share = rms_um[best] / max(before, 1e-300)
        if share >= _CLEARLY:
            break
        what, option = best
        rest = "beside that, " if out else ""
        options += f" {option}"
        out.append(
            f"{rest}{what} would take {100 * (1 - share):.0f} % of the residual away, in blocks that are predicted "
            f"from the others: fit again with{options}"
        )
        taken, before = joined[best], rms_um[best]
        del found[best]
    return out


def _relaxed(time_s: np.ndarray, predicted_um: np.ndarray) -> np.ndarray:
    """What relaxations add to a displacement, and what moves before it leave to them, shape `(n, 2 k)`."""
    from scipy.signal import lfilter  # slow to import, and a fit that leaves noise needs none of it

    even = np.linspace(0, time_s[-1], len(time_s))
    moved = np.interp(even, time_s, predicted_um - predicted_um[0])
    columns = []
    for constant in np.geomspace(min(_SHORTEST * even[1], _LONGEST * even[-1]), _LONGEST * even[-1], _CONSTANTS):
        left = np.exp(-even[1] / constant)
        columns += [np.interp(time_s, even, lfilter([1 - left], [1, -left], moved)), np.exp(-time_s / constant)]
    return np.stack(columns, axis=1)


def _left(runs: Sequence[Run], columns: Sequence[np.ndarray], left_um: Sequence[np.ndarray]) -> float:
    """Root mean square, in um, of what columns leave of blocks, with coefficients from the other blocks."""
    square = count = 0.0
    for run, rows, left in zip(runs, columns, left_um, strict=True):
        label = blocks_of(run, PIECES)
        for block in range(BLOCKS):
            rest, inside = (label >= 0) & (label != block), label == block
            if not inside.any():
                continue
            answer = np.linalg.lstsq(rows[rest], left[rest], rcond=1e-10)[0]
            square += float(np.sum((left[inside] - rows[inside] @ answer) ** 2))
            count += float(inside.sum())
    return float((square / max(count, 1.0)) ** 0.5)
