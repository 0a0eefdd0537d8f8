"""All that scores and fits of effects need: the fitted plain stage, its noise, and every effect simulated."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fits.diagnosis._baseline import Baseline, fit_baseline, simulate
from fits.diagnosis._discrepancy import ROUGHEST, learn_roughness, with_discrepancy
from fits.diagnosis._effects import Bench, Law, drop_programs
from fits.diagnosis._joint_fit import fit_from_poles
from fits.diagnosis._noise import Faults, find_faults
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import refit
from fits.diagnosis._regression import Regression, regress
from fits.diagnosis._result import Step
from fits.diagnosis._score import Probe, applicable, probes_of, scales_of, score
from fits.diagnosis._thresholds import THRESHOLDS, Thresholds
from fits.io._record import Record
from fits.stage._solve import Problem
from fits.stats._held import held_gain
from microid import Hold
from microid.effects import EFFECTS, Scales

# A delay below this part of the sampling interval is no effect, but one of each run's own.
_SKEW = 0.04
# It must have at least this part of the evidence of the strongest effect.
_ABOUT = 0.8
_SKEWED = (
    "the readings are late by {:.2g} s, a small part of the sampling interval: no more than converters that take "
    "turns, or steps of a simulation, are off by, so that each run may have a lag of its own"
)
_STEPS = (
    "the command is taken to be held between samples, as a converter does, since the readings are late by half a "
    "sample; a delay of that length would look the same"
)
_CURVES = (
    "the command is taken to run along curves through its samples, since that leaves less of the displacement than "
    "lines do"
)
_NOT_ASKED = (
    "whether the command runs {} between its samples was not asked, for lack of time: give it a larger budget"
)
_CLOSED = (
    "a controller held the displacement, and what bends a loop cannot be told from a density there, which is asked "
    "only along the way that it took"
)
# Part of the samples held out at voltages through which it goes both ways in what is fitted.
_HALF = 0.5
ONE_WAY = (
    "nothing was held out, since most of that would have been at voltages through which the rest does not go both "
    "ways, where no fit predicts anything: the gain is not measured"
)
_RUNS: dict[Hold, tuple[str, str]] = {"smooth": ("along curves", _CURVES), "zero": ("held in steps", _STEPS)}


@dataclass(frozen=True)
class Reading:
    """How the records are read.

    The last `fraction` of each of the `records` is held out, and all of `aside`. `initial` is the memory before each
    run, and `thresholds` decide.
    """

    records: Sequence[Record]
    aside: Sequence[Record]
    fraction: float
    initial: str
    thresholds: Thresholds = THRESHOLDS


@dataclass(frozen=True)
class Prepared:
    """The fitted baseline of a `reading`, its regression, noise and probes, and why some effects were `skipped`."""

    reading: Reading
    baseline: Baseline
    regression: Regression
    bench: Bench
    projector: Projector
    probes: tuple[Probe, ...]
    faults: Faults
    skipped: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class _Fit:
    """The plain stage, fitted to runs in one way."""

    regression: Regression
    faults: Faults

    @cached_property
    def projector(self) -> Projector:
        return Projector(self.regression, self.faults.noise).bounded()

    @cached_property
    def bench(self) -> Bench:
        return Bench(self.regression.baseline)

    @cached_property
    def scales(self) -> Scales:
        return scales_of(self.bench, min(noise.total_um for noise in self.faults.noise))

    @cached_property
    def probed(self) -> tuple[list[Probe], list[tuple[str, str]]]:
        return _probed(self.bench, self.scales, self.projector)

    @cached_property
    def left(self) -> np.ndarray:
        """What the stage leaves, whitened and joined."""
        return self.projector.off(self.projector.residual)

    def late(self, left: np.ndarray | None = None) -> tuple[float, float]:
        """Decrease of that, or of what is `left` otherwise, by a delay, and the delay in s."""
        left = self.left if left is None else left
        form = next(form for form in EFFECTS if form.delay)
        scores = score(self.projector, list(probes_of(self.bench, form, self.scales)), left).each
        if not scores:
            return 0.0, 0.0
        best = max(scores, key=lambda one: one.drop)
        return best.drop, float(best.coefficients[0] * getattr(best.probe.effects[0], form.delay))

    def delay_drop(self, left: np.ndarray | None = None) -> float:
        """The same decrease, if that is a delay and no lead."""
        drop, late_s = self.late(left)
        return drop if late_s > 0 else 0.0

    def left_under(self, hold: Hold) -> np.ndarray:
        """What is left with the command in another way between samples, the stage following along its tangent."""
        baseline = self.regression.baseline
        here, there = baseline.stage, baseline.stage.with_hold(hold)
        change = [simulate(there, replace(run, hold=hold)) - simulate(here, run) for run in baseline.finest]
        return self.projector.off(self.projector.residual - self.projector.join(change))

    def prefers(self, hold: Hold, thresholds: Thresholds) -> bool:
        """Whether there is evidence for another command between samples.

        Curves must leave less than lines beyond chance. Steps must explain what a delay behind lines does. Either
        must explain more with the best effect beside it than lines do.
        """
        least, off = thresholds.other_hold_z**2, thresholds.model_error
        late = self.delay_drop() if hold == "zero" else np.inf
        if late <= least:
            return False
        left = self.left_under(hold)
        gained = float(self.left @ self.left - left @ left)
        best, beside = self.largest_z() ** 2, gained + self.largest_z(left) ** 2
        if hold == "zero":
            explains = gained > (1 - off) * late or gained - late + self.delay_drop(left) > off * late
            return explains and beside > (1 - off) * best
        return gained > least and beside > best

    def left_beside_lag(self) -> float:
        """Sum of squares beside a lag of the reading, fitted from poles that the runs show together with it."""
        probe = next((probe for probe in self.probed[0] if probe.form.lag), None)
        if probe is None:
            return np.inf
        law = Law([probe.effects[0]] * len(self.regression.baseline.runs))
        model = refit(self.bench, self.projector, [law], [law.start], 0)
        ends = fit_from_poles(self.bench, self.projector, model)
        return min((end[-1].cost for end in ends), default=np.inf)

    def outdoes(self, other: "_Fit") -> bool:
        """Whether a lag of the reading leaves less here than another fit does with the best effect beside it."""
        there = Projector(other.regression, self.faults.noise).bounded()
        left = there.off(there.residual)
        return self.left_beside_lag() < float(left @ left) - other.largest_z() ** 2

    def largest_z(self, left: np.ndarray | None = None) -> float:
        """Evidence of the effect that has most, in what is `left`."""
        scores = score(self.projector, self.probed[0], self.left if left is None else left).each
        return max((one.z for one in scores), default=0.0)


def prepare_diagnosis(
    reading: Reading, progress: Callable[[str], None], has_time: Callable[[], bool] = lambda: True
) -> Prepared:
    """Fit the plain stage, learn the noise, and simulate every probe of every effect.

    The stage is fitted again, its command in another way between samples, only where it still `has_time`.
    """
    records, initial, fraction = reading.records, reading.initial, reading.fraction
    said: tuple[str, ...] = ()
    if fraction > 0 and not _covered(records, fraction) and _covered(records, 0.0):
        fraction, said = 0.0, (*said, ONE_WAY)

    def fitted(hold: Hold, onward: Problem | None = None) -> _Fit:
        settings = reading.aside, fraction, initial, progress, hold
        regression = regress(fit_baseline(records, *settings, onward))
        faults = find_faults(regression, None, reading.thresholds)
        if not faults.repaired:
            return _Fit(regression, faults)
        progress("fitting the plain stage again, without single bad samples")
        regression = regress(fit_baseline(faults.clean(records), *settings, regression.baseline.problem))
        found = find_faults(regression, None, reading.thresholds)
        return _Fit(regression, replace(found, spikes=faults.spikes, heights_um=faults.heights_um))

    progress(Step.BASELINE)
    here = fitted("first")
    drop_programs(records)
    progress(Step.PROBES)
    taken = ""
    for hold, (words, remark) in _RUNS.items():
        if here.regression.baseline.dynamic and here.prefers(hold, reading.thresholds):
            if not has_time():
                said = (*said, _NOT_ASKED.format(words))
                break
            progress(f"fitting the plain stage again, its command {words}")
            drop_programs(records)
            other = fitted(hold, here.regression.baseline.problem)
            # What comes late at a sensor looks like a command that does so between samples.
            if not here.outdoes(other):
                here, taken = other, remark
            drop_programs(records)
    said = (*said, taken) if taken else said
    if here.regression.baseline.dynamic:
        drop, late_s = here.late()
        if (
            drop > max(reading.thresholds.other_hold_z**2, (_ABOUT * here.largest_z()) ** 2)
            and late_s < _SKEW * here.scales.interval_s
        ):
            here = _Fit(regress(replace(here.regression.baseline, skewed=True)), here.faults)
            said = (*said, _SKEWED.format(late_s))
    if here.faults.jitter_s > 0:
        here = _Fit(regress(replace(here.regression.baseline, blurred=True)), here.faults)
    regression, bench, faults, (probes, skipped) = here.regression, here.bench, here.faults, here.probed
    if all(held_gain([record]) is not None for record in records):
        shut = dict.fromkeys(one.name for one in probes if not one.form.held)
        skipped = [*skipped, *((name, _CLOSED) for name in shut)]
        probes = [one for one in probes if one.form.held]
    baseline = replace(regression.baseline, remarks=(*regression.baseline.remarks, *said))
    progress(Step.ROUGHNESS)
    candidates = [column for probe in probes for column in probe.signatures]
    # Where a run passes each voltage one way only, a rough density looks like any effect.
    rough = (ROUGHEST,) * len(regression.finer) if ONE_WAY in said else learn_roughness(here.projector, candidates)
    # What is large and has been used makes room.
    del here
    drop_programs(records)
    projector = Projector(regression, faults.noise, rough).bounded()
    projector = projector.beside(with_discrepancy(projector, candidates)).bounded()
    return Prepared(reading, baseline, regression, bench, projector, tuple(probes), faults, tuple(skipped))


def _covered(records: Sequence[Record], fraction: float) -> bool:
    """Whether most of what is held out is at voltages through which the rest goes up and down; of all, if nothing."""
    kept = [len(record) - round(fraction * len(record)) for record in records]
    parts = [record.voltage_V[:stop] for record, stop in zip(records, kept, strict=True)]
    asked = [record.voltage_V[stop if fraction else 0 :] for record, stop in zip(records, kept, strict=True)]
    inside = np.ones(sum(map(len, asked)), dtype=bool)
    for way in (1, -1):
        steps = [way * np.diff(part) > 0 for part in parts]
        passed_V = np.concatenate(
            [part[np.r_[step, False] | np.r_[False, step]] for part, step in zip(parts, steps, strict=True)]
        )
        if len(passed_V) == 0:
            return False
        inside &= (np.concatenate(asked) >= passed_V.min()) & (np.concatenate(asked) <= passed_V.max())
    return float(np.mean(inside)) > _HALF


def _probed(bench: Bench, scales: Scales, projector: Projector) -> tuple[list[Probe], list[tuple[str, str]]]:
    """Simulate every probe of every effect that can be asked about, and say of the others why not."""
    probes: list[Probe] = []
    skipped = []
    for form in EFFECTS:
        reason = applicable(bench.baseline, form)
        if reason is not None:
            skipped.append((form.name, reason))
            continue
        found = list(probes_of(bench, form, scales, projector))
        if not found:
            why = "the runs are too short or too plain to show it"
            skipped.append((form.name, "nothing of it was found, sample by sample" if form.statistic else why))
        probes += found
    return probes, skipped
