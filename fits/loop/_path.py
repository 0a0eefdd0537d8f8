"""What a hysteresis remembers along a voltage, in NumPy; see `microid.Memory`."""

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from operator import neg
from typing import Self

import numpy as np


@dataclass(frozen=True)
class Path:
    """Extremes of the memory to begin with, `lead` of them, and what follows; see `microid.Memory`.

    A branch to each entry hangs from its anchor, and is rising or not. `depth` counts the anchors back to the first.
    Values may be complex: what is remembered is decided by their real parts.
    """

    values: np.ndarray
    anchor: np.ndarray
    rising: np.ndarray
    depth: np.ndarray
    lead: int = 0

    @classmethod
    def of(cls, before: np.ndarray, then: Sequence[float] | np.ndarray = ()) -> Self:
        """Find the extreme that each branch hangs from, with a stack (Madelung's rules), from turn to turn."""
        values = np.append(before, then)
        count, path = len(values), values.real.tolist()
        moves = np.append(0.0, np.sign(np.diff(values.real)))
        # An entry that does not move belongs to the branch of the one before it; the first is a rising one.
        latest = np.maximum.accumulate(np.where(moves != 0, np.arange(count), 0))
        rising = moves[latest] >= 0
        turns = np.flatnonzero(np.diff(rising)) + 1
        # From these entries on branches hang from these anchors, which are so many.
        entries, anchors, depths = [0, 1], [0, 0], [0, 1]
        stack = [0]
        bounds = [1, *turns.tolist(), count]
        for turn, (first, stop) in enumerate(pairwise(bounds)):
            up = turn % 2 == int(count > 1 and not rising[1])
            if turn > 0:
                stack.append(first - 1)
                entries.append(first)
                anchors.append(first - 1)
                depths.append(len(stack))
            # Entries go one way until the next turn: each older extreme that they pass is wiped out, with its pair.
            while len(stack) > 2 and (path[stack[-2]] <= path[stop - 1] if up else path[stack[-2]] >= path[stop - 1]):
                old = path[stack[-2]]
                first = bisect_left(path, old, first, stop) if up else bisect_left(path, -old, first, stop, key=neg)
                del stack[-2:]
                entries.append(first)
                anchors.append(stack[-1])
                depths.append(len(stack))
        size = np.diff([*entries, count])
        anchor, depth = (np.repeat(np.array(each, dtype=np.int32), size) for each in (anchors, depths))
        return cls(values, anchor, rising, depth, len(before))

    @classmethod
    def pieces(cls, before: np.ndarray, then: np.ndarray, length: int) -> Iterator[Self]:
        """The same piece by piece, each of so many entries beside the memory that the one before it leaves."""
        for first in range(0, len(then), length):
            piece = cls.of(before, then[first : first + length])
            yield piece
            before = piece.end

    @property
    def end(self) -> np.ndarray:
        """Extremes of the memory after the last entry, oldest first, that entry included."""
        chain = [len(self.values) - 1]
        while chain[-1] > 0:
            chain.append(int(self.anchor[chain[-1]]))
        return np.asarray(self.values[chain[::-1]])

    @cached_property
    def turns(self) -> tuple[Self, np.ndarray]:
        """The path of those entries alone from which branches hang; and where each entry's anchor is among them."""
        entries = np.unique(self.anchor)
        at = np.searchsorted(entries, self.anchor)
        return type(self)(self.values[entries], at[entries], self.rising[entries], self.depth[entries]), at

    @cached_property
    def levels(self) -> list[np.ndarray]:
        """Entries whose anchor is not the first, by their depth: each adds to one of the level before."""
        order = np.argsort(self.depth, kind="stable")
        return np.split(order, np.searchsorted(self.depth[order], np.arange(2, self.depth.max() + 1)))[1:]

    def add(self, total: np.ndarray) -> np.ndarray:
        """Add to each entry of an array, `(n, ...)`, in place, all that its anchors have; the first has nothing."""
        total[0] = 0.0
        for rows in self.levels:
            total[rows] += total[self.anchor[rows]]
        return total


def branches(pieces: Sequence[Path]) -> tuple[np.ndarray, np.ndarray]:
    """Extremes that the branches of a path's entries hang from, and whether these are rising, shape `(n,)` each."""
    anchors = np.concatenate([piece.values[piece.anchor[piece.lead :]] for piece in pieces])
    return anchors, np.concatenate([piece.rising[piece.lead :] for piece in pieces])
