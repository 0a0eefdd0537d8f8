"""The next experiment: the voltage program that would tell apart best what the records leave open."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from fits.diagnosis._explanation import Selection
from fits.diagnosis._findings import MOST_RIVALS
from fits.diagnosis._predict import Hypothesis, Predictor
from fits.diagnosis._prepare import Prepared
from fits.diagnosis._programs import Program, limits_of, repeated
from fits.diagnosis._refit import Refit
from fits.diagnosis._result import Experiment, FoundCause
from fits.diagnosis._safe import guard_of
from fits.diagnosis._score import best_of, law_of
from fits.io._limits import MARGIN, RangeMap
from fits.io._record import Record
from fits.io.columns import COLUMNS, columns_beside
from fits.loop._run import Progress
from microid.effects import card_of

# Samples of a program: as many as are simulated some twenty times in a bearable time.
_MOST_SAMPLES = 4096
# A short program is repeated until it tells the suspects apart by so many standard deviations, so often at most.
_ENOUGH_Z, _OVER = 12.0, {2: "twice", 3: "three times", 4: "four times"}
# An effect is suspected from this evidence on, or below this probability of as much by chance.
_SUSPECT_Z, _SUSPECT_P = 3.5, 0.1
# The shortest of the programs that are at least this part as good as the best is taken.
_NEARLY_BEST = 0.95
# An experiment that tells less than so many times what the records at hand do is not worth it.
_LEAST_GAIN = 1.02
# Steps of the ascent: for the gradient, and the lengths that are tried along it, as shares of the parameters' ranges.
_PROBE, _LENGTHS = 0.05, (0.4, 0.15)
# Below so many standard deviations effects are not told apart.
_TOLD_APART = 3.0
# Names, hypotheses, and which is compared with which.
Question: TypeAlias = tuple[tuple[str, ...], tuple[Hypothesis, ...], tuple[tuple[int, int], ...]]


@dataclass(frozen=True)
class Request:
    """What is asked of the next experiment: its duration, that of the longest run if None, and the limits of the rig.

    A quantity of which no limit is stated may go beyond what the records reached by the part `margin` of its range.
    Where it no longer `has_time`, the best program so far is taken.
    """

    duration_s: float | None = None
    limits: RangeMap = field(default_factory=dict)
    margin: float = MARGIN
    has_time: Callable[[], bool] = lambda: True


def suggest(
    ready: Prepared, found: Selection, causes: tuple[FoundCause, ...], request: Request, progress: Progress
) -> Experiment | None:
    """Choose and refine the program that decides best what is open.

    The first of the `causes` that has rivals is asked about, or what is suspected where there is none at all. Each
    program that keeps the rig inside its limits, whichever of the rivals is true, is played virtually: the regression
    of the new run is added to that of the old ones, and what the rivals change in all of them is projected off what
    the stage and the other rival can follow. None where nothing is open or suspected, and where no program inside the
    limits and no further column would help.
    """
    question = open_question(ready, found, causes)
    if question is None:
        return None
    names, hypotheses, pairs = question
    progress(f"looking for the experiment that tells {' from '.join(names)}")
    baseline = ready.baseline
    guard = guard_of(ready, found, hypotheses, request.limits, request.margin)
    records = [run.record for run in baseline.runs]
    limits = guard.narrowed(limits_of(records, baseline.range_V, baseline.resonance_Hz, request.duration_s))
    if limits is None:
        return None
    predictor = Predictor(found.bench, found.projector, hypotheses, pairs)
    programs = guard.menu(limits, _MOST_SAMPLES)
    if not programs:
        return None
    scores = []
    for program in programs:
        scores.append(predictor.predicted_z(*program.samples(program.start)))
        if not request.has_time():
            break
    programs = programs[: len(scores)]
    column = further_column(names, records)
    asked = predictor
    if column and max(scores) < 1.0:
        # Only the column tells: what shows the first of them best is played with it.
        asked = Predictor(found.bench, found.projector, (hypotheses[0], hypotheses[0].without(names[0])), ((0, 1),))
        scores = [asked.predicted_z(*program.samples(program.start)) for program in programs]
    near = [(one, z) for one, z in zip(programs, scores, strict=True) if z >= _NEARLY_BEST * max(scores)]
    program, z = min(near, key=lambda one: (one[0].limits.duration_s, -one[1]))
    progress(f"refining {program.words}")

    def gain(parameters: np.ndarray) -> float:
        played = program.samples(parameters)
        return asked.predicted_z(*played) if request.has_time() and guard.allows(played) else float("nan")

    parameters, z = refine(program, gain, z)
    once, words = program.samples(parameters), program.words
    played, most = once, int(limits.duration_s / (1.1 * program.limits.duration_s))
    for times, over in _OVER.items():
        longer = repeated(program.limits, once, times)
        if times > most or z >= _ENOUGH_Z or not guard.allows(longer):
            break
        played, words = longer, f"{program.words}, {over} over"
        z = asked.predicted_z(*played)
    if asked is not predictor:
        z = predictor.predicted_z(*played)
    # What tells nothing is not worth playing, but for a further column.
    present_z = predictor.present_z
    if not column and (z < 1.0 or z < _LEAST_GAIN * present_z):
        return None
    purpose = _purpose(names, z, present_z, column)
    return Experiment(*played, words, purpose, names, z, present_z, column, guard.extremes(played))


def open_question(ready: Prepared, found: Selection, causes: tuple[FoundCause, ...]) -> Question | None:
    """What is to be decided: names, hypotheses, and which is compared with which."""
    named = {cause.name for cause in causes}
    best = _hypothesis(found.model)
    for at, cause in enumerate(found.causes):
        # Another cause may have turned out to be the rival.
        taken = {other.name for k, other in enumerate(found.causes) if k != at}
        rivals = [rival for rival in cause.rivals[:MOST_RIVALS] if rival.name not in taken]
        if cause.name in named and rivals:
            every = (best, *(_with_last(best, at, rival.refit) for rival in rivals))
            # The cause and each rival, be the one or the other true: rivals among themselves may be alike for ever.
            pairs = tuple(pair for k in range(1, len(every)) for pair in ((0, k), (k, 0)))
            return tuple(h.names[at] for h in every), every, pairs
    if causes:
        return None
    nothing = Hypothesis((), ())
    if found.causes:
        # What explains too little to be named is a suspicion all the same.
        first = Hypothesis(best.laws[:1], best.x[:1], best.covariances[:1])
        return (found.causes[0].name,), (first, nothing), ((0, 1),)
    leading = next(iter(best_of(found.left).values()), None)
    if leading is None or (leading.z < _SUSPECT_Z and found.family.p(leading.z) >= _SUSPECT_P):
        return None
    law = law_of(leading, len(ready.bench.prepared))
    return (leading.name,), (Hypothesis((law,), (law.start,)), nothing), ((0, 1),)


def _hypothesis(model: Refit) -> Hypothesis:
    """The effects of a model."""
    whole, stops = model.covariance(), np.cumsum([law.size for law in model.laws])
    blocks = [slice(stop - law.size, stop) for law, stop in zip(model.laws, stops, strict=True)]
    return Hypothesis(model.laws, model.x, tuple(whole[block, block] for block in blocks))


def _with_last(best: Hypothesis, at: int, model: Refit) -> Hypothesis:
    """The best with the last effect of a model instead of one.

    What is before it may only have followed along its tangent, and then has no covariance.
    """
    law, size = model.laws[-1], model.laws[-1].size
    laws, x = (*best.laws[:at], law, *best.laws[at + 1 :]), (*best.x[:at], model.x[-1], *best.x[at + 1 :])
    covariances = *best.covariances[:at], model.covariance()[-size:, -size:], *best.covariances[at + 1 :]
    return Hypothesis(laws, x, covariances)


def refine(program: Program, gain: Callable[[np.ndarray], float], first: float) -> tuple[np.ndarray, float]:
    """Climb the logarithm of a gain in a program's parameters by finite differences, and keep the best.

    The `gain` of parameters of shape `(k,)` is NaN where they are not allowed, and `first` at the program's start.
    """
    span = program.upper - program.lower
    best, top = program.start.copy(), first
    for _ in range(2):
        slope = np.zeros(len(best))
        for k in np.flatnonzero(span > 0):
            ahead = best.copy()
            # Towards the middle, so that a step is never cut off.
            ahead[k] += span[k] * (_PROBE if best[k] < (program.lower + program.upper)[k] / 2 else -_PROBE)
            if not np.isnan(there := gain(ahead)):
                slope[k] = np.log(max(there, 1e-12) / max(top, 1e-12)) * span[k] / (ahead[k] - best[k])
        size = float(np.max(np.abs(slope)))
        if size == 0:
            break
        tried = [np.clip(best + length * span * slope / size, program.lower, program.upper) for length in _LENGTHS]
        gains = [gain(p) for p in tried]
        if np.isnan(gains).all():
            break
        highest = int(np.nanargmax(gains))
        if gains[highest] <= top:
            break
        best, top = tried[highest], gains[highest]
    return best, top


def _purpose(names: tuple[str, ...], z: float, present: float, column: str) -> str:
    *others, last = (name.replace("_", " ") for name in names)
    if not others:
        # Evidence that was sought, not supposed, is another number: the two are not to stand side by side.
        by = (
            f"by {z:.1f} standard deviations"
            if present < 1.0
            else f"{z / present:.1f} times as clearly as these records"
        )
        # Whether it is there is what the verdict says, and not this sentence.
        return f"If the rig has {last} after all, of the size that fits these records best, this would show it {by}."
    listed = f"{', '.join(others)} and {last}"
    if z < _TOLD_APART and column:
        return f"No program within the limits tells {listed} apart by itself: record this one with a further column."
    if z < _TOLD_APART:
        return (
            f"No program within the rig's limits would tell {listed} apart for sure; this one comes nearest, with "
            f"{z:.1f} standard deviations where the records at hand have {present:.1f}."
        )
    few = ", too few for effects so alike" if present > _TOLD_APART else ""
    return (
        f"It would tell {listed} apart by {z:.1f} standard deviations at least, where the records at hand do by "
        f"{present:.1f}{few}."
    )


def further_column(names: tuple[str, ...], records: Sequence[Record]) -> str:
    """Which further column helps most of the suspects, and why; empty if none does, or the records have it."""
    wanted = [column for name in names if (column := card_of(name).column)]
    if not wanted:
        return ""
    # Of several that help as many, that of the first.
    column = max(wanted, key=wanted.count)
    # One that shows nothing is there all the same.
    if any(column in record.extra or column in columns_beside(record) for record in records):
        return ""
    return f"{column}: {COLUMNS[column].use}" if column in COLUMNS else column
