"""Runs that cannot be fitted as one stage: what is wrong with them, in words."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from fits.io._errors import DataError
from fits.io._record import Record
from fits.loop._misfit import Misfit, compare_gains
from fits.loop._result import ParameterEstimate
from fits.loop._run import Run
from fits.stage._run import named_parts, residual_of, simulate_stage
from fits.stage._solve import Solved
from fits.stats._noise import correlation_samples, learn_noise
from microid import Driver, Mechanics, Stage

# Gains that differ by more than this are not those of one rig.
_REFUSED = 0.1
# The same before anything is fitted.
_CLEARLY = 0.5
# Part of a range of voltage that counts as all of it.
_WHOLE = 0.95
# A resonance above this fraction of the sampling rate is hardly told from its mirror image.
_HIGHEST_RESONANCE = 0.45
# Coordinates are of the order of 1; one that is known no better than this is not seen.
UNSEEN = 0.5
# Twice the logarithm of a likelihood ratio that noise rarely pretends.
_CHANCE = 40.0
# Samples over which neighbouring residuals agree where something slow is left, such as hysteresis of a linear stage.
_SLOW = 10.0
# Poles that piezo stages have, from slow macro stages and weak amplifiers to small ones with strong ones.
_USUAL_RANGES = {"natural_frequency_Hz": (3.0, 1e5), "time_constant_s": (0.0, 1.0)}
# Remedies.
_BEYOND = "add a run with steps, a chirp or a multisine that goes beyond the resonance"
_FASTER, OR_ALONE = "sample at 5 times the resonance or more", "or fit the hysteresis alone"
BESIDE_A_LAG = "; a lag of the readings may hide the resonance, too: microid diagnose fits the stage beside one"


def refuse_slopes(records: Sequence[Record]) -> None:
    """Refuse, in a `DataError`, slow runs over one range of voltage that move differently far."""
    spans = [float(np.ptp(record.voltage_V)) for record in records]
    found = zip(records, spans, map(_moved_um, records), map(speed_Hz, records), strict=True)
    full = [(record, um / span, speed) for record, span, um, speed in found if span > _WHOLE * max(spans)]
    for (one, high, fast), (other, low, slow) in permutations(full, 2):
        # Where a run rings it reaches farther, but not on average.
        ratio = min(high / low, _slope(one) / max(_slope(other), 1e-300))
        # What is faster may move less far because of the dynamics, and small loops do so because of the hysteresis,
        # neither of which is known yet.
        if ratio > 1 + _CLEARLY and max(fast, slow) < 1.5 * min(fast, slow):
            raise DataError(_not_one_rig(one.source, other.source, ratio))


def _moved_um(record: Record) -> float:
    """Range of the displacement once the voltage has been at both ends: a first way may begin from elsewhere."""
    voltage_V, displacement_um = record.voltage_V, np.asarray(record.displacement_um)
    share = (voltage_V - voltage_V.min()) / max(float(np.ptp(voltage_V)), 1e-300)
    first = max(int(np.argmax(share <= 1 - _WHOLE)), int(np.argmax(share >= _WHOLE)))
    again = first if np.ptp(share[first:]) > _WHOLE else 0
    return float(np.ptp(displacement_um[again:]))


def _slope(record: Record) -> float:
    """Displacement per voltage, least squares, in um/V; without its sign, which an inverted sensor has, too."""
    voltage_V, displacement_um = record.voltage_V, np.asarray(record.displacement_um)
    return abs(float(np.cov(voltage_V, displacement_um)[0, 1] / np.var(voltage_V, ddof=1)))


def speed_Hz(record: Record) -> float:
    """Frequency of a sine that moves as fast as a voltage does, for its size; a `DataError` if it does not move."""
    rate = np.diff(record.voltage_V) / np.diff(record.time_s)
    size = float(np.std(record.voltage_V))
    if size == 0:
        raise DataError(f"{record.source}: the voltage does not move; there is nothing to fit")
    return float(np.sqrt(np.mean(rate**2))) / (2 * np.pi * size)


def _not_one_rig(one: str, other: str, ratio: float) -> str:
    return (
        f"{one} and {other}: under the same voltage the first moves {ratio:.3g} times as far as the second, so "
        "they are not of one rig in one setting; check the units, the amplifier's gain and the sensor's range, "
        "or fit them apart"
    )


def refuse_unidentifiable(
    solved: Solved, drives: Sequence[np.ndarray], fast: bool, may_drop: bool = False
) -> str | None:
    """Refuse, in a `DataError`, runs that do not show the dynamics they are fitted with; `fast` if one is faster.

    `drives` are what the hysteresis alone would give for each run, shape `(n,)`. Where a mechanics may be left out
    (`may_drop`) that the runs do not show, though they are sampled finely enough, its name is returned instead.
    """
    stage = solved.stage
    named, value, derivative = solved.problem.chain.parameters(solved.z)
    slope = np.abs(derivative) / np.maximum(np.abs(value), 1e-300)
    # Beside columns as they are, which come first.
    own = np.diagonal(np.asarray(solved.weighing.total(solved.sums).gram))[-len(named) :]
    spread = solved.weighing.least_um / np.sqrt(np.maximum(own, 1e-300))
    # At a bound the slope vanishes, however far the coordinate may run.
    unseen = (spread * slope > UNSEEN) | (spread > 5)
    endings = ".time_constant_s", ".natural_frequency_Hz"
    modes = named_parts(stage, Mechanics)
    lines = {f"{name}.natural_frequency_Hz" for name, _ in modes if not _shows_mode(solved, name)}
    each = zip(named, unseen, strict=True)
    poles = [(name, bool(lost) or name in lines) for (name, _), lost in each if name.endswith(endings)]
    if not poles:
        return None
    unidentified = [name for name, lost in poles if lost]
    sources = ", ".join(run.record.source for run in solved.runs)
    fastest = max(solved.runs, key=lambda run: run.rate_Hz)
    mechanics = [(name, float(part.natural_frequency_Hz)) for name, part in modes]
    beyond = [(name, value) for name, value in mechanics if value > _HIGHEST_RESONANCE * fastest.rate_Hz]
    # A ringing is seen beside a gain of another size, too, which only the first compares with none.
    quiet = {name for name, _ in beyond} | {line.rpartition(".")[0] for line in lines}
    seen = shows_poles(solved, drives) or any(name not in quiet for name, _ in mechanics)
    some = bool(unidentified) and (len(unidentified) == len(poles) or not fast)
    lacking = mechanics and (some or beyond) and named_parts(stage, Driver)
    if may_drop and seen and lacking and all(map(_resolved, solved.runs)):
        return (beyond or mechanics)[0][0]
    # A driver beside a mode that is shown may as well be too quick to be.
    quick = modes and all(name.endswith(".time_constant_s") for name in unidentified)
    if unidentified and not fast and len(unidentified) < len(poles) and not quick:
        raise DataError(
            f"{sources}: these runs are all about as slow, and do not show {', '.join(unidentified)}; {_BEYOND}"
        )
    if len(unidentified) == len(poles) or not seen:
        noise = solved.weighing.noise_um
        loudest = int(np.argmax(noise))
        if noise[loudest] > 3.0 * min(noise):  # it moves in ways that its samples do not show
            loud = solved.runs[loudest]
            # What is sampled too slowly may well seem to move further, or less far.
            moved = check_gains(stage, solved.runs, refuse=_resolved(loud))
            why, remedy = f"sampled at {loud.rate_Hz:.4g} Hz, which seems too slow for what moves in it", _FASTER
            if _resolved(loud):
                why = "no lag and no resonance was found that explains what moves in it"
                remedy = "record it for longer, with a slower chirp or a longer period"
            raise DataError(
                f"{loud.record.source}: {why}: {noise[loudest]:.3g} um of it stay unexplained, "
                f"{noise[loudest] / min(noise):.3g} times as much as of the quietest run; {remedy}, {OR_ALONE}"
                + "; ".join([BESIDE_A_LAG, *moved])
            )
        raise DataError(
            f"{sources}: no delay and no ringing is told from the hysteresis here, so these runs hold nothing "
            f"of the driver and the mechanics; {_BEYOND}, check that voltage and displacement are not exchanged, "
            f"{OR_ALONE}"
        )
    if beyond:
        raise DataError(
            f"{fastest.record.source}: sampled at {fastest.rate_Hz:.4g} Hz, and what moves there is explained best "
            f"by a resonance beyond half of that, so these runs do not show where it is: {_FASTER}, {OR_ALONE}"
            f"{BESIDE_A_LAG}"
        )
    return None


def refuse_undersampled(stage: Stage, runs: Sequence[Run], left: Sequence[Misfit]) -> None:
    """Refuse, in a `DataError`, a resonance that runs cannot show: sampled too slowly for it, they leave much."""
    finest = max(run.rate_Hz for run in runs)
    for _, part in named_parts(stage, Mechanics):
        resonance = float(part.natural_frequency_Hz)
        for run, one in zip(runs, left, strict=True):
            blind = _HIGHEST_RESONANCE * finest < resonance
            where = "far beyond" if resonance > 2 * run.rate_Hz else f"near {resonance:.3g} Hz"
            if one.far and (blind or (run.rate_Hz < 5.0 * resonance and not _resolved(run))):
                raise DataError(
                    f"{one.source}: sampled at {run.rate_Hz:.4g} Hz, which is too slow for what moves in it: "
                    f"{one.share_pct:.3g} % of its stroke stay unexplained, {one.times_noise:.3g} times the sensor's "
                    f"noise, and the resonance would lie {where}; {_FASTER}, {OR_ALONE}"
                    f"{BESIDE_A_LAG}"
                )


def _resolved(run: Run) -> bool:
    """Whether the command is sampled so finely that little of it lies in the upper half of the band."""
    voltage = run.record.voltage_V
    # By differences, so that a slow motion of large amplitude does not hide what is fast.
    change = np.diff(voltage)
    power = np.abs(np.fft.rfft((change - change.mean()) * np.hanning(len(change)))) ** 2
    return float(power[len(power) // 2 :].sum()) < 0.1 * float(power.sum())


def implausible(parameters: Sequence[ParameterEstimate], sources: Sequence[str]) -> tuple[str, float] | None:
    """Find poles that no piezo stage has: a sentence, and the factor that takes times in the suspected unit to s."""
    for one in parameters:
        low, high = _USUAL_RANGES.get(one.name.rpartition(".")[2], (-np.inf, np.inf))
        if not low <= one.value <= high:
            # Slow poles and long times come of numbers that are too large.
            large = (one.value < low) == (one.unit == "Hz")
            units, factor = ("ms instead of s", 1e-3) if large else ("s instead of ms", 1e3)
            return (
                f"{', '.join(sources)}: {one.name} comes out as {one.value:.3g} {one.unit}, where piezo stages have "
                f"{low:g} to {high:g}: the time is probably in another unit than its column says, for example in "
                f"{units}"
            ), factor
    return None


def shows_poles(solved: Solved, drives: Sequence[np.ndarray]) -> bool:
    """Whether poles make the run that shows them best likelier by far, by the logarithm of the likelihood ratio.

    Slow runs may become less likely: the hysteresis read off them holds the driver's lag, which now counts twice.
    """
    ratios = []
    for run, drive, noise in zip(solved.runs, drives, solved.weighing.noise_um, strict=True):
        x, y = drive[run.fitted] - drive[run.fitted].mean(), run.displacement_um[run.fitted]
        left = y - y.mean() - x * (x @ y / (x @ x))
        ratios.append(2 * run.fitted.sum() / correlation_samples([left]) * float(np.log(np.std(left) / noise)))
    return max(ratios) >= _CHANCE


def _shows_mode(solved: Solved, name: str) -> bool:
    """Whether what a mode does to the command makes some run likelier by far, beside motions that it is free to make.

    Free motions of a mode without damping follow any line in the noise.
    """
    stage, drops = solved.stage, []
    weighing = solved.weighing
    for run, noise_um, correlation in zip(solved.runs, weighing.noise_um, weighing.correlation, strict=True):
        done_um = simulate_stage(stage, run) - simulate_stage(stage.without(name), run)
        instead = replace(run, record=replace(run.record, displacement_um=run.displacement_um + done_um))
        left, without = (residual_of(stage, one)[run.fitted] for one in (run, instead))
        size = noise_um**2 * correlation
        if correlation > _SLOW:
            # What changes slowly hides what a mode does at its frequency, but not beside what each sample brings.
            noise = learn_noise(left - left.mean(), 0.0)
            left, without, size = noise.whiten(left), noise.whiten(without), 1.0
        drops.append(float(without @ without - left @ left) / size)
    return max(drops) >= _CHANCE


def check_gains(stage: Stage, runs: Sequence[Run], refuse: bool = False) -> list[str]:
    """Find runs that move further, or less far, than others: a remark, or a `DataError` where to `refuse` it."""
    predicted = [simulate_stage(stage, run)[run.fitted] for run in runs]
    high, low, ratio = compare_gains(predicted, [residual_of(stage, run)[run.fitted] for run in runs])
    one, other = runs[high].record.source, runs[low].record.source
    if refuse and ratio > 1 + _REFUSED:
        raise DataError(_not_one_rig(one, other, ratio))
    if ratio > 1.05:
        return [
            f"under the same voltage {one} moves {ratio:.3g} times as far as {other}: "
            "if both are of one rig, its gain depends on amplitude or rate more than the hysteresis explains"
        ]
    return []
