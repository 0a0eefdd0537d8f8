"""CPU time, taken side by side."""

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax

Call = Callable[[], Any]
# A measurement shorter than this says more about the clock than about the code.
_SHORTEST_s = 0.1


def cpu_seconds(call: Call, times: int = 1) -> float:
    """CPU seconds of one call, over all threads of this process."""
    start = time.process_time()
    for _ in range(times):
        jax.block_until_ready(call())
    return (time.process_time() - start) / times


def side_by_side(calls: dict[str, Call], repeats: int) -> dict[str, list[float]]:
    """CPU seconds of several calls, taken in turn so that a busy machine slows all of them alike.

    Every call is made once before, to be compiled. Quick calls are made several times in a row.
    """
    times = {}
    for name, call in calls.items():
        jax.block_until_ready(call())
        once = cpu_seconds(call)
        times[name] = max(1, math.ceil(_SHORTEST_s / max(once, 1e-6)))
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            taken[name].append(cpu_seconds(call, times[name]))
    return taken


def median_ratio(peer: list[float], ours: list[float]) -> float:
    """Median of the ratios of measurements that stood next to each other."""
    return statistics.median(p / o for p, o in zip(peer, ours, strict=True))


@dataclass(frozen=True)
class Line:
    """One line of the table: what was compared, the figure wanted, the figure found, and CPU seconds."""

    what: str
    wanted: str
    found: str
    ours: str = ""
    peer: str = ""
    note: str = ""


@dataclass
class Table:
    """Lines as they come, printed at once."""

    markdown: bool
    lines: list[Line] = field(default_factory=list)

    _HEAD = ("what", "wanted (aim)", "found", "ours, CPU s", "peer, CPU s", "note")
    _WIDTH = (70, 14, 8, 12, 12, 0)

    def head(self) -> None:
        self._print(self._HEAD)
        if self.markdown:
            self._print(("---",) * len(self._HEAD))

    def add(self, line: Line) -> None:
        self.lines.append(line)
        self._print((line.what, line.wanted, line.found, line.ours, line.peer, line.note))

    def ratio(
        self, what: str, wanted: str, peer: list[float], ours: list[float], *, note: str = "", inverse: bool = False
    ) -> None:
        """Add how many times faster ours is, or with `inverse` how many times slower."""
        found = median_ratio(ours, peer) if inverse else median_ratio(peer, ours)
        times = f"{found:.0f}x" if found >= 20 else f"{found:.2g}x"
        self.add(Line(what, wanted, times, seconds(ours), seconds(peer), note))

    def _print(self, cells: tuple[str, ...]) -> None:
        if self.markdown:
            print("| " + " | ".join(cells) + " |", flush=True)
        else:
            padded = (cell.ljust(width) for cell, width in zip(cells, self._WIDTH, strict=True))
            print("  ".join(padded).rstrip(), flush=True)


def seconds(taken: list[float]) -> str:
    """Median, to three digits."""
    return f"{statistics.median(taken):.3g}"
