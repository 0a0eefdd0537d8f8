"""All that scores and fits of effects need: the fitted plain stage, its noise, and every effect simulated."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.diagnosis._baseline import Baseline, fit_baseline
from fits.diagnosis._discrepancy import ROUGHEST, learn_roughness, with_discrepancy
from fits.diagnosis._effects import Bench, drop_programs
from fits.diagnosis._lag_place import is_of_driver, lag_of, may_be_of_driver
from fits.diagnosis._noise import Faults, find_faults
from fits.diagnosis._plain_fit import IN_LINES, IN_STEPS, Holds, PlainFit
from fits.diagnosis._projector import Projector
from fits.diagnosis._regression import Regression, regress
from fits.diagnosis._result import FoundCause, Step
from fits.diagnosis._score import Probe
from fits.diagnosis._thresholds import THRESHOLDS, Thresholds
from fits.io._record import Record
from fits.loop._run import Run
from fits.stage._run import named_parts
from fits.stage._solve import Problem
from fits.stats._held import held_gain
from fits.stats._metrics import TWO_SIDED_95
from microid import Driver, Hold
from microid.effects import card_of

# A delay below this part of the sampling interval is no effect, but one of each run's own.
_SKEW = 0.04
# It must have at least this part of the evidence of the strongest effect.
_ABOUT = 0.8
_SKEWED = (
    "the readings are late by {:.2g} s, a small part of the sampling interval: no more than converters that take "
    "turns, or steps of a simulation, are off by, so that each run may have a lag of its own"
)
BEHIND = "a lag of the driver, ahead of the hysteresis, leaves more of these runs than a lag of the readings does"
_DRIVER = (
    "the stage has a driver, which lags by {:.3g} s, and no mechanics, as these runs show a lag and no resonance; to "
    "have that, add a run with steps, a chirp or a multisine that goes beyond it, sampled at 5 times its frequency"
)
_STEPS = (
    "the command{} is taken to be held between samples, as a converter does: behind lines the readings would be late "
    "by half a sample, and a delay of that length would look the same"
)
_LATE = (
    "readings that are late by half a sample look the same as a command that is held between its samples: if a "
    "converter holds it, the delay is that, and nothing is wrong"
)
_CURVES = (
    "the command{} is taken to run along curves through its samples, since that leaves less of the displacement than "
    "lines do"
)
_LINES = "the command{} is taken to run in lines between samples"
_ASIDE = "the command of {}, held out, is taken to {} between samples, since it is predicted better so"
_NOT_ASKED = (
    "the command seems to run along curves or in steps between its samples, and the stage was not fitted again with "
    "that, for lack of time: give it a larger budget"
)
_CLOSED = (
    "a controller held the displacement, and what bends a loop cannot be told from a density there, which is asked "
    "only along the way that it took"
)
_BEYOND = (
    "{} goes to {:.4g} V, and what was fitted from {:.4g} to {:.4g} V only: how it moves there, and what it "
    "remembers of that, is not known from these runs, so that an error there says little of causes"
)
# Times that bad samples are taken out and looked for again: they pull a stage towards themselves, and hide others.
_CLEANED = 3
# Part of the range by which a run held out may go beyond what was fitted.
_LITTLE = 0.01
# Part of the intervals in which a command in steps stays where it is.
_MOST = 0.5
# Part of the samples held out at voltages through which it goes both ways in what is fitted.
_HALF = 0.5
ONE_WAY = (
    "nothing was held out, since most of that would have been at voltages through which the rest does not go both "
    "ways, where no fit predicts anything: the gain is not measured"
)
_WORDS: dict[Hold, tuple[str, str]] = {
    "first": (_LINES, "run in lines"),
    "smooth": (_CURVES, "run along curves"),
    "zero": (_STEPS, "be held"),
}


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


def prepare_diagnosis(
    reading: Reading,
    progress: Callable[[str], None],
    has_time: Callable[[], bool] = lambda: True,
    onward: Problem | None = None,
) -> Prepared:
    """Fit the plain stage, learn the noise, and simulate every probe of every effect.

    The stage is fitted again, its command in another way between samples, only where it still `has_time`. The first
    fit goes `onward` from one that was made.
    """
    return prepared(*decide_plain_stage(reading, progress, has_time, onward), progress)


def fit_plain_stage(
    reading: Reading,
    holds: Holds,
    progress: Callable[[str], None],
    onward: Problem | None = None,
    known: Faults | None = None,
) -> PlainFit:
    """Fit the plain stage with commands that go between samples in one way, and what is wrong with single samples.

    Nothing is looked for where that is `known`.
    """
    records = reading.records
    settings = reading.aside, reading.fraction, reading.initial, progress, holds, reading.thresholds.model_error
    if known is not None:
        return PlainFit(regress(fit_baseline(known.clean(records), *settings, onward)), known, reading.thresholds)
    regression = regress(fit_baseline(records, *settings, onward))
    faults = find_faults(regression, None, reading.thresholds)
    if not faults.repaired:
        return PlainFit(regression, faults, reading.thresholds)
    progress("fitting the plain stage again, without bad samples")
    # Where an effect passes for bad samples, what runs show no poles of they show none of without these.
    left_out = () if regression.baseline.dynamic else regression.baseline.remarks
    for _ in range(_CLEANED):
        regression = regress(fit_baseline(faults.clean(records), *settings, regression.baseline.problem, left_out))
        known, faults = faults, find_faults(regression, None, reading.thresholds).beside(faults)
        if faults.count == known.count and faults.lines_um is known.lines_um:
            break
    return PlainFit(regression, faults, reading.thresholds)


def decide_plain_stage(
    reading: Reading,
    progress: Callable[[str], None],
    has_time: Callable[[], bool] = lambda: True,
    onward: Problem | None = None,
) -> tuple[Reading, PlainFit, tuple[str, ...]]:
    """Fit the plain stage, find which parts it has and how its command goes between samples, and what to say of it.

    The reading that comes back holds nothing out where no fit would predict that.
    """
    records = reading.records
    said: tuple[str, ...] = ()
    if reading.fraction > 0 and not _covered(records, reading.fraction) and _covered(records, 0.0):
        reading, said = replace(reading, fraction=0.0), (*said, ONE_WAY)
    said = (*said, *_beyond(records, reading.aside, reading.fraction))

    def fitted(holds: Holds, onward: Problem | None = None) -> PlainFit:
        return fit_plain_stage(reading, holds, progress, onward)

    def lagging(here: PlainFit, holds: Holds) -> tuple[PlainFit, str]:
        """A stage with a driver and no mechanics in place of another, where that explains more, and what to say."""
        if not (may_be_of_driver(here, reading.thresholds) and has_time()):
            return here, ""
        progress("fitting the plain stage again, with a driver and no mechanics")
        drop_programs(records)
        other = fitted(holds, here.regression.baseline.with_driver_alone(lag_of(here)))
        if not is_of_driver(other, here, reading.thresholds):
            behind = other.regression.baseline.dynamic and not here.regression.baseline.dynamic
            return here, BEHIND if behind else ""
        return other, _DRIVER

    progress(Step.BASELINE)
    holds = tuple(map(_hold_of_plateaus, records))
    here = fitted(holds, onward)
    drop_programs(records)
    progress(Step.PROBES)
    words = ""
    if not here.regression.baseline.dynamic:
        here, words = lagging(here, holds)
    if here.regression.baseline.dynamic:
        rings = here.regression.baseline.resonance_Hz is not None
        holds = here.better_holds(reading.thresholds)
        if holds != here.holds and not has_time():
            said = (*said, _NOT_ASKED)
        elif holds != here.holds:
            progress("fitting the plain stage again, its command in another way between samples")
            drop_programs(records)
            other = fitted(holds, here.regression.baseline.problem)
            lines = IN_LINES * len(records)
            if "smooth" in holds and lines not in (here.holds, holds) and has_time():
                # Levels looked like steps, which are as far from lines as from curves.
                plain = fitted(lines, other.regression.baseline.problem)
                other = plain if plain.outdoes(other) else other
            # What comes late at a sensor looks like a command that does so between samples.
            here = here if here.outdoes(other) else other
            if here is other and has_time() and (own := here.better_holds(reading.thresholds)) != here.holds:
                # What this stage leaves is less, and shows of each run how it goes.
                progress("fitting the plain stage again, the command of each run in its own way between samples")
                other = fitted(own, here.regression.baseline.problem)
                here = other if other.leaves_less(here) else here
            drop_programs(records)
        if rings:
            here, words = lagging(here, here.holds)
        steps = IN_STEPS * len(records)
        if steps not in (here.holds, holds) and here.may_be_held(reading.thresholds) and has_time():
            progress("fitting the plain stage again, its command held between samples")
            other = fitted(steps, here.regression.baseline.problem)
            here = other if other.explains_more(here) and not here.outdoes(other) else here
            drop_programs(records)
        if words == _DRIVER:
            [(_, driver)] = named_parts(here.regression.baseline.stage, Driver)
            words = _DRIVER.format(float(driver.time_constant_s))
        said = (*said, *_of_holds(here.regression.baseline))
    said = (*said, *filter(None, [words]))
    return reading, here, said


def prepared(reading: Reading, here: PlainFit, said: tuple[str, ...], progress: Callable[[str], None]) -> Prepared:
    """What is asked beside a plain stage, and what is `said` of that."""
    records = reading.records
    if here.regression.baseline.dynamic:
        drop, late_s = here.late()
        if (
            drop > max(reading.thresholds.other_hold_z**2, (_ABOUT * here.largest_z()) ** 2)
            and late_s < _SKEW * here.scales.interval_s
        ):
            here = replace(here, regression=regress(replace(here.regression.baseline, skewed=True)))
            said = (*said, _SKEWED.format(late_s))
    if here.faults.jitter_s > 0:
        here = replace(here, regression=regress(replace(here.regression.baseline, blurred=True)))
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
    here.projector.release()
    drop_programs(records)
    projector = Projector(regression, faults.noise, rough).bounded()
    projector = projector.beside(with_discrepancy(projector, candidates)).bounded()
    return Prepared(reading, baseline, regression, bench, projector, tuple(probes), faults, tuple(skipped))


def _beyond(records: Sequence[Record], aside: Sequence[Record], fraction: float) -> list[str]:
    """What to say of runs held out that go beyond the voltages that are fitted."""
    fitted = [record.voltage_V[: len(record) - round(fraction * len(record))] for record in records]
    low_V, high_V = min(float(each.min()) for each in fitted), max(float(each.max()) for each in fitted)
    said = []
    for record in aside:
        ends_V = float(record.voltage_V.min()), float(record.voltage_V.max())
        end_V, beyond_V = max(
            zip(ends_V, (low_V - ends_V[0], ends_V[1] - high_V), strict=True), key=lambda one: one[1]
        )
        if beyond_V > _LITTLE * (high_V - low_V):
            said.append(_BEYOND.format(record.source, end_V, low_V, high_V))
    return said


def _hold_of_plateaus(record: Record) -> Hold:
    """Steps where a command stays where it is most of the time, lines otherwise."""
    return "zero" if float(np.mean(np.diff(record.voltage_V) == 0)) > _MOST else "first"


def _of_holds(baseline: Baseline) -> list[str]:
    """Say how commands are taken to go between samples, where not all of them run in lines."""
    said = []
    each = {run.hold for run in baseline.runs}
    for hold in sorted(each) if each != {"first"} else []:
        of = "" if len(each) == 1 else " of " + ", ".join(r.record.source for r in baseline.runs if r.hold == hold)
        said.append(_WORDS[hold][0].format(of))
    return said


def of_half_a_sample(causes: Sequence[FoundCause], runs: Sequence[Run]) -> list[str]:
    """Say it where a delay is that of a command that is held, which runs are not taken to have."""
    late = [one for cause in causes for one in cause.parameters if one.name == (card_of(cause.name).delay or None)]
    halves_s = [0.5 / run.rate_Hz for run in runs if run.hold != "zero"]
    return [_LATE] if any(abs(one.value - half) < TWO_SIDED_95 * one.sd for one in late for half in halves_s) else []


def of_holds_aside(usual: Hold, runs: Sequence[Run]) -> list[str]:
    """Say of which runs held out whole the command is taken to go otherwise between samples than usual."""
    others = [run for run in runs if run.hold != usual]
    return [_ASIDE.format(run.record.source, _WORDS[run.hold][1]) for run in others]


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
