"""Sampled signals in NumPy, for forms of effects that answer before JAX is imported: nothing here imports it.

An effect may have such a form, a method of its own file beside `run`:

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal

`fits` takes it off that file without running the rest. So it may use NumPy as `np`, `math`, plain functions and
constants of its own module, what this module has, and the fields of the effect but for its `history`, which is zero
there. Numbers may be complex: along a tiny imaginary part all that is computed has its derivative, so that what
decides must look at real parts alone.
"""

from typing import Any, NamedTuple

import numpy as np

# Samples whose answers to each other are one product.
_BLOCK = 64
_NODES = 4


class _NumpySignal(NamedTuple):
    """Signals on their way from one part to the next; see `microid.Signal`.

    Samples are `(t, k)`, what they were before the first of them is `(k,)`.
    """

    values: np.ndarray
    before: np.ndarray
    hold: str
    settling_s: complex | None = None


def _instants(interval_s: np.ndarray, count: int) -> np.ndarray:
    """Times of so many samples from 0 on, `(t,)`; intervals are `(t - 1,)`, or `(1,)` where all are alike."""
    if len(interval_s) == 1:
        return interval_s[0] * np.arange(count)
    return np.concatenate([[0.0], np.cumsum(interval_s)])


def _blockwise(step: np.ndarray, push: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Solve `z[t] = step[t] @ z[t - 1] + push[t]` from a start, `(n, k)`, for `(t, n, k)`.

    There is a step, `(n, n)`, for each sample, or one for all. Blocks of samples go side by side, each from zero on,
    and are led on from each other in the end.
    """
    if np.iscomplexobj(push) and not np.iscomplexobj(step):
        return _as_complex(_blockwise(step, _as_real(push), _as_real(start.astype(complex))))
    count, n, k = push.shape
    length = int(np.ceil(np.sqrt(count)))
    blocks = -(-count // max(length, 1))
    fill = ((0, blocks * length - count), (0, 0), (0, 0))
    inside = np.pad(push, fill).reshape(blocks, length, n, k).astype(np.result_type(step, push, start), copy=False)
    each = step[None] if len(step) == 1 else np.pad(step, fill).reshape(blocks, length, n, n)
    over = np.empty((len(each), length, n, n), dtype=step.dtype)
    whole = np.broadcast_to(np.eye(n), (len(each), n, n))
    for j in range(length):
        now = each[:, min(j, each.shape[1] - 1)]
        over[:, j] = whole = now @ whole
        if j > 0:
            inside[:, j] += now @ inside[:, j - 1]
    for b in range(blocks):
        inside[b] += over[min(b, len(over) - 1)] @ start
        start = inside[b, -1]
    return inside.reshape(-1, n, k)[:count]


def _decay(left: np.ndarray, push: np.ndarray) -> np.ndarray:
    """Solve `z[t] = left[t] z[t - 1] + push[t]` from zero on, `(t, k)`, with what is left `(t, 1)` or `(1, 1)`."""
    return _blockwise(left[:, None], push[:, None], np.zeros((1, push.shape[1])))[:, 0]


def _sag(interval_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """How far lines through the samples of smooth signals lie beside them on average, `(t, k)`; see `microid`."""
    found = np.zeros_like(values)
    each = np.broadcast_to(interval_s, max(len(values) - 1, 0))[:, None]
    slope = np.diff(values, axis=0) / each
    early, late = each[:-1], each[1:]
    found[1:-1] = np.diff(slope, axis=0) * early * late / (6 * (early + late))
    return found


def _lags(interval_s: np.ndarray, values: np.ndarray, constants_s: Any, weights: Any) -> np.ndarray:
    """Follow signals that run in lines, `(t, k)`, by a sum of lags of the first order, at rest at the first sample.

    Time constants and weights are `(m,)`.
    """
    constants_s, weights, change = np.asarray(constants_s), np.asarray(weights), np.diff(values, axis=0)
    behind = np.zeros(values.shape, dtype=np.result_type(values, constants_s, weights))
    if len(interval_s) == 1:
        behind[1:] = _behind(interval_s[0] / constants_s, change, weights)
    else:
        for constant_s, weight in zip(constants_s, weights, strict=True):
            ratio = (interval_s / constant_s)[:, None]
            behind[1:] += _decay(np.exp(-ratio), weight * np.expm1(-ratio) / ratio * change)
    return np.sum(weights) * values + behind


def _behind(ratio: np.ndarray, change: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """What a sum of lags is behind signals that change each sample, `(t, k)`, for intervals over constants, `(m,)`.

    Answer of each block of samples to itself as one product, and to the blocks before it by the states of the lags.
    """
    if np.iscomplexobj(change) and not np.iscomplexobj(ratio):
        return _as_complex(_behind(ratio, _as_real(change), weights))
    count, k = change.shape
    blocks = -(-count // _BLOCK)
    inside = np.zeros((_BLOCK, blocks, k), dtype=change.dtype)
    for j in range(_BLOCK):
        inside[j, : len(change[j::_BLOCK])] = change[j::_BLOCK]
    keep = np.exp(-ratio[:, None] * np.arange(_BLOCK + 1))
    lost = weights * np.expm1(-ratio) / ratio
    lag = np.arange(_BLOCK)[:, None] - np.arange(_BLOCK)
    answer = np.where(lag >= 0, (lost @ keep)[np.abs(lag)], 0.0)
    # What a block leaves in the lags, and what they had before it.
    left = ((lost[:, None] * keep[:, _BLOCK - 1 :: -1]) @ inside.reshape(_BLOCK, -1)).reshape(-1, blocks, k)
    states = np.zeros_like(left)
    for b in range(1, blocks):
        states[:, b] = keep[:, _BLOCK:] * states[:, b - 1] + left[:, b - 1]
    found = answer @ inside.reshape(_BLOCK, -1) + keep[:, 1:].T @ states.reshape(len(ratio), -1)
    return np.moveaxis(found.reshape(_BLOCK, blocks, k), 0, 1).reshape(-1, k)[:count]


def _as_real(values: np.ndarray) -> np.ndarray:
    """Real and imaginary parts as two signals: by real factors that is a quarter of the work."""
    return np.stack([values.real, values.imag], axis=-1).reshape(*values.shape[:-1], -1)


def _as_complex(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values).view(complex)


def _reading_at(interval_s: np.ndarray, signal: _NumpySignal, when_s: np.ndarray) -> np.ndarray:
    """Read signals at other times, `(t,)`, counted from the first sample, by cubics through the four samples around.

    Before their first sample signals are what they were before, behind the last they stay what they are.
    """
    values, before = signal.values, signal.before
    time, fixed = _instants(interval_s, len(values)), when_s.real
    if len(values) < _NODES:
        own = zip(values.T, before, strict=True)
        return np.stack([np.interp(fixed, time, each, left=rest) for each, rest in own], axis=1)
    # To the last digit as `microid` finds them.
    alike = len(interval_s) == 1
    place = np.floor(fixed / interval_s[0]) if alike else np.searchsorted(time, fixed, side="right") - 1
    ahead_s = time[1] - time[0]
    nodes, known = np.append([-2 * ahead_s, -ahead_s], time), np.concatenate([[before, before], values])
    first = np.clip(place.astype(int) + 1, 0, len(values) + 2 - _NODES)
    at = [nodes[first + j] for j in range(_NODES)]
    when = np.where(fixed < -ahead_s, -ahead_s, np.where(fixed > time[-1], time[-1], when_s))
    total = np.zeros(values.shape, dtype=np.result_type(values, when))
    for j in range(_NODES):
        others = [(when - at[other]) / (at[j] - at[other]) for other in range(_NODES) if other != j]
        total += (others[0] * others[1] * others[2])[:, None] * known[first + j]
    return total
