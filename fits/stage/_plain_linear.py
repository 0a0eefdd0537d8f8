"""Linear systems in NumPy; see `microid.LinearSystem`.

Numbers may be complex: along a tiny imaginary part all that is computed has its derivative (Squire and Trapp, 1998).
"""

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

    def respond(self, interval_s: np.ndarray, signal: np.ndarray, before: np.ndarray, hold: str) -> np.ndarray:
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
        moved, _ = self.move(interval_s, np.diff(signal, axis=0), start, hold)
        return level + np.concatenate([(self.read @ start)[None], moved])

    def move(
        self, interval_s: np.ndarray, change: np.ndarray, start: np.ndarray, hold: str
    ) -> tuple[np.ndarray, np.ndarray]:
        """What the states add to the output after each change of signals, `(t, k)`, and the states in the end.

        Intervals are `(t,)` or `(1,)`; states are `(n, k)`.
        """
        if len(self.rest) == 0:
            return np.zeros_like(change), start
        step, taken = self._advance(interval_s, hold)
        push = -taken[:, :, None] * change[:, None]
        states = _blockwise(step, push, start)
        return self.read @ states, states[-1] if len(states) else start

    def _advance(self, interval_s: np.ndarray, hold: str) -> tuple[np.ndarray, np.ndarray]:
        """Matrices `exp(A h)`, and what the states lose by an input that rises by one, `(t, n, n)` and `(t, n)`."""
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
