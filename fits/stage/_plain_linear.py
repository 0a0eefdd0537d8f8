"""Linear systems in NumPy; see `microid.LinearSystem`.

Numbers may be complex: along a tiny imaginary part all that is computed has its derivative (Squire and Trapp, 1998).
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from fits.stage._declared import tools

if TYPE_CHECKING:
    from microid._in_numpy import _blockwise, _sag
else:
    _blockwise, _sag = tools()._blockwise, tools()._sag

# As in `microid`: terms of the exponential series for a norm of a half, and doublings at most.
_TERMS, _DOUBLINGS = 16, 64
_EPS = float(np.finfo(float).eps)
# Samples whose answers to each other are one product, where signals are at least so many.
_BLOCK = 32


@dataclass(frozen=True)
class Linear:
    """A stable linear system of `n` states in its deviation from rest; see `microid.LinearSystem`.

    The shape of `rate_per_s` is `(n, n)`, those of `rest` and `read` are `(n,)`.
    """

    rate_per_s: np.ndarray
    rest: np.ndarray
    read: np.ndarray
    gain: complex
    offset: complex

    @classmethod
    def memoryless(cls, gain: complex, offset: complex = 0.0) -> Self:
        """A gain and an offset, without states."""
        return cls(np.zeros((0, 0)), np.zeros(0), np.zeros(0), gain, offset)

    def then(self, other: "Linear") -> "Linear":
        """Put another system behind this one."""
        inward = other.rate_per_s @ other.rest
        none = np.zeros((len(self.rest), len(other.rest)))
        through = other.gain - other.read @ other.rest
        return Linear(
            np.block([[self.rate_per_s, none], [-np.outer(inward, self.read), other.rate_per_s]]),
            np.concatenate([self.rest, self.gain * other.rest]),
            np.concatenate([through * self.read, other.read]),
            other.gain * self.gain,
            other.gain * self.offset + other.offset,
        )

    def respond(
        self,
        interval_s: np.ndarray,
        signal: np.ndarray,
        before: np.ndarray,
        hold: str,
        settling_s: complex | None = None,
    ) -> np.ndarray:
        """Respond to samples of signals, `(t, k)`, which rested at `before`, `(k,)`; see `microid.LinearSystem`.

        Intervals are `(t - 1,)`, or `(1,)` where all are alike; the `hold` is `first`, `zero` or `smooth`.
        """
        level = self.offset + self.gain * signal
        if len(self.rest) == 0:
            return level
        if hold == "smooth":
            bent = signal - _sag(interval_s, signal)
            directly = self.gain - self.read @ self.rest
            return self.respond(interval_s, bent, before, "first") + directly * (signal - bent)
        start = self.rest[:, None] * (before - signal[0])
        moved, _ = self.move(interval_s, np.diff(signal, axis=0), start, hold, settling_s)
        return level + np.concatenate([(self.read @ start)[None], moved])

    def move(
        self,
        interval_s: np.ndarray,
        change: np.ndarray,
        start: np.ndarray,
        hold: str,
        settling_s: complex | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """What the states add to the output after each change of signals, `(t, k)`, and the states in the end.

        Intervals are `(t,)` or `(1,)`; states are `(n, k)`.
        """
        if len(self.rest) == 0:
            return np.zeros_like(change), start
        step, taken = self._advance(interval_s, hold, settling_s)
        if change.shape[1] >= _BLOCK:
            return self._products(step, taken, change, start)
        push = -taken[:, :, None] * change[:, None]
        states = _blockwise(step, push, start)
        return self.read @ states, states[-1] if len(states) else start

    def follow(
        self,
        interval_s: np.ndarray,
        pieces: Iterable[np.ndarray],
        hold: str = "first",
        settling_s: complex | None = None,
    ) -> Iterator[np.ndarray]:
        """Respond to many signals piece by piece, `(l, k)` each, which rested before; no offset.

        They run in lines, settle with a time constant from each sample to the next, or are held.

        Intervals are those between samples, `(t - 1,)`, or `(1,)` where all are alike.
        """
        if len(interval_s) > 1:
            # The state before the first sample is one of rest, which no interval changes.
            interval_s = np.append(interval_s[:1], interval_s)
        last, states, first = None, np.zeros((len(self.rest), 1)), 0
        for signals in pieces:
            change = np.diff(signals, axis=0, prepend=signals[:1] if last is None else last)
            each = interval_s if len(interval_s) == 1 else interval_s[first : first + len(signals)]
            moved, states = self.move(each, change, states, hold, settling_s)
            moved += self.gain * signals
            yield moved
            last, first = signals[-1:].copy(), first + len(signals)

    def _products(
        self, step: np.ndarray, taken: np.ndarray, change: np.ndarray, start: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `move`, by products of matrices: a block of samples answers all its changes, and states lead it on.

        Going from sample to sample would wait for memory.
        """
        count, k = change.shape
        out = np.empty(change.shape, dtype=np.result_type(step, taken, change, start))
        whole = count - count % _BLOCK
        # What is left is a shorter block.
        blocks = ((0, whole, _BLOCK), (whole, count, count - whole))
        for some, length in ((slice(first, stop), length) for first, stop, length in blocks if stop > first):
            inside, here = change[some].reshape(-1, length, k), out[some].reshape(-1, length, k)
            each = (step, taken) if len(step) == 1 else (step[some], taken[some])
            answer, moved = self._of_blocks(*each, length)
            np.matmul(answer[:, :, :length], inside, out=here)
            for b in range(len(inside)):
                one = min(b, len(answer) - 1)
                here[b] += answer[one, :, length:] @ start
                start = moved[one, :, :length] @ inside[b] + moved[one, :, length:] @ start
        return out, start

    def _of_blocks(self, step: np.ndarray, taken: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
        """What blocks of samples add to the output, and their last states, `(b, length, m)` and `(b, n, m)`.

        Each is per unit of every change within the block, and then of every state before it, `m = length + n`.
        """
        n = len(self.rest)
        step, taken = (one.reshape(-1, min(length, len(one)), *one.shape[1:]) for one in (step, taken))
        state = np.zeros((len(step), n, length + n), dtype=np.result_type(step, taken))
        state[:, :, length:] = np.eye(n)
        answer = np.empty((len(step), length, length + n), dtype=np.result_type(state, self.read))
        for j in range(length):
            now = min(j, step.shape[1] - 1)
            state = step[:, now] @ state
            state[:, :, j] -= taken[:, now]
            answer[:, j] = self.read @ state
        return answer, state

    def _advance(
        self, interval_s: np.ndarray, hold: str, settling_s: complex | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Matrices `exp(A h)`, and what the states lose by an input that rises by one, `(t, n, n)` and `(t, n)`."""
        if settling_s is not None:
            n, rate = len(self.rest), 1 / settling_s
            driven = np.concatenate([self.rate_per_s, -rate * self.rest[:, None]], axis=1)
            whole = np.concatenate([driven, np.append(np.zeros(n), -rate)[None]])
            step, _ = Linear(whole, np.zeros(n + 1), np.zeros(n + 1), 0.0, 0.0)._advance(interval_s, "zero")
            return step[:, :n, :n], step[:, :n, n] / np.expm1(-rate * interval_s)[:, None]
        longest = float(np.max(interval_s, initial=_EPS))
        norm = float(np.max(np.sum(np.abs(self.rate_per_s * longest), axis=1)))
        doublings = int(np.clip(np.ceil(np.log2(max(norm, _EPS))) + 1, 0, _DOUBLINGS))
        share = self.rate_per_s * (interval_s * 2.0**-doublings)[:, None, None]
        one = np.eye(len(self.rest))
        mean = np.broadcast_to(one, share.shape)
        # Horner's scheme for (exp(X) - 1) / X.
        for term in range(_TERMS, 0, -1):
            mean = (one + share @ mean) / term
        less, lost = share @ mean, mean @ self.rest
        # Doubling exp(X) - 1 rather than exp(X) keeps the digits of slow states beside fast ones.
        for _ in range(doublings):
            less, lost = 2 * less + less @ less, lost + (less @ lost[..., None])[..., 0] / 2
        return one + less, lost if hold == "first" else np.broadcast_to(self.rest, lost.shape)
