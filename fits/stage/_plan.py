"""What a fit of a stage was asked for: its records, and how their commands and memories are taken."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.io._record import Record
from fits.loop._run import Progress, Run, prepare_run
from fits.stage._run import settled_samples
from fits.stage._solve import Solved
from microid import Hold, Stage


@dataclass(frozen=True)
class Plan:
    """What was asked for, and of which records an unknown past is `estimated`; of none where that is empty.

    The command of each record runs between samples as `holds` say, and comes `shifts_s` later; samples that have
    `settled`, `(n,)`, are fitted, and count as `weights` say, `(n,)`. Where its lag is `movable`, the stage may have
    it behind the hysteresis.
    """

    records: tuple[Record, ...]
    states: tuple[str, ...]
    fraction: float
    range_V: tuple[float, float]
    loss: str
    progress: Progress
    gain: float | None
    holds: tuple[Hold, ...]
    accept_best: bool
    estimated: tuple[bool, ...] = ()
    shifts_s: tuple[float, ...] = ()
    settled: tuple[np.ndarray, ...] = ()
    weights: tuple[np.ndarray, ...] = ()
    movable: bool = False

    def runs(self, strides: Sequence[int] = ()) -> list[Run]:
        """The records, the intervals of each divided into so many steps, or not at all."""
        shifts, each = self.shifts_s or (0.0,) * len(self.records), strides or (1,) * len(self.records)
        return [self.run(k, *both) for k, both in enumerate(zip(each, shifts, strict=True))]

    @property
    def interval_s(self) -> float:
        """Shortest of the sampling intervals."""
        return min(float(np.median(np.diff(record.time_s))) for record in self.records)

    def run(self, k: int, stride: int, shift_s: float = 0.0) -> Run:
        """One of them, its command that much later."""
        record, usable = self.records[k], self.settled[k] if self.settled else None
        if shift_s:
            time = record.time_s - shift_s
            # Beyond the record's ends nobody knows the command.
            there = (time >= record.time_s[0]) & (time <= record.time_s[-1])
            usable = there if usable is None else there & usable
            later = np.interp(time, record.time_s, record.voltage_V)
            record = replace(record, voltage_V=later)
        settings = self.range_V, self.states[k], self.fraction, stride, self.gain, self.holds[k]
        run = prepare_run(record, *settings, usable, bool(self.estimated) and self.estimated[k])
        return replace(run, weight=self.weights[k]) if self.weights else run

    def behind(self, solved: Solved) -> "Plan | None":
        """The same without what an unknown past reaches behind the lag that was found; None where that is hardly any.

        The hysteresis is driven by what lags the command: it turns later, and short of the command's ends.
        """
        if any(self.estimated):
            return None
        settled = self.settled_for(solved.stage, solved.runs)
        lost = [np.sum(run.fitted & ~own) / run.fitted.sum() for run, own in zip(solved.runs, settled, strict=True)]
        if max(lost) < 0.01:  # not worth another fit
            return None
        return replace(self, settled=settled)

    def settled_for(self, stage: Stage, runs: Sequence[Run]) -> tuple[np.ndarray, ...]:
        """What no longer depends on the past of each run, shape `(n,)`."""
        return tuple(settled_samples(stage, *each) for each in zip(runs, self.states, strict=True))

    def shifted(self, shifts_s: np.ndarray) -> "Plan":
        """The same with the command of each run that much later, in s, shape `(runs,)`."""
        return replace(self, shifts_s=tuple(map(float, shifts_s)))
