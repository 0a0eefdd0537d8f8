"""All that scores and fits of effects need: the fitted plain stage, its noise, and every effect simulated."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits._record import Record
from fits._run import UNSWEPT
from fits.diagnosis._baseline import Baseline, fit_baseline
from fits.diagnosis._candidates import Bench, Probe, applicable, probes_of, scales_of
from fits.diagnosis._faults import SINGLE, Faults, find_faults
from fits.diagnosis._projector import Projector, learn_roughness
from fits.diagnosis._regression import Regression, regress
from fits.diagnosis._score import Scored, score
from fits.diagnosis._unswept import unswept
from microid import EFFECTS

# Decrease of the sum of squares, in noise variances, from which on a delay is looked into, and the part of it that a
# command held in steps must explain to be taken for it: then what looked like a delay is half a sample.
_LATE, _AS_WELL = 25.0, 0.97
_STEPS = (
    "the command is taken to be held between samples, as a converter does, since the readings are late by half a "
    "sample; a delay of that length would look the same"
)
_FIRST = (
    "the voltage's first way through its range differs from later ones, as after a rest or a demagnetisation, and was "
    "not used"
)
# Part of its range through which the voltage goes up, and down, in what is fitted.
_BOTH_WAYS = 0.5
_ONE_WAY = (
    "nothing was held out, since the voltage goes through its range both ways only in what would have been: the gain "
    "is not measured"
)


@dataclass(frozen=True)
class Prepared:
    """All that scores and fits need: the fitted baseline, its regression, noise and probes."""

    baseline: Baseline
    regression: Regression
    bench: Bench
    projector: Projector
    probes: tuple[Probe, ...]
    faults: Faults
    skipped: tuple[tuple[str, str], ...]


def prepare_diagnosis(
    records: Sequence[Record],
    aside: Sequence[Record],
    fraction: float,
    initial: str,
    progress: Callable[[str], None],
) -> Prepared:
    """Fit the plain stage, learn the noise, and simulate every probe of every effect."""
    said: tuple[str, ...] = ()
    if fraction > 0 and not _covered(records, fraction) and _covered(records, 0.0):
        fraction, said = 0.0, (_ONE_WAY,)
    progress("fitting the plain stage")
    baseline = fit_baseline(records, aside, fraction, initial, progress)
    progress("reading the noise")
    regression = regress(baseline)
    faults = find_faults(regression)
    if faults.repaired:
        progress("fitting the plain stage again, without single bad samples")
        records = faults.clean(records)
        baseline = fit_baseline(records, aside, fraction, initial, progress)
        regression = regress(baseline)
        faults = replace(find_faults(regression), spikes=faults.spikes, heights_um=faults.heights_um)
    progress("simulating every effect")
    bench, probes, skipped = _probed(baseline, faults)
    projector = Projector(regression, faults.noise)
    if initial == "unknown" and unswept(baseline, projector, max(one.z for one in _scores(projector, probes))):
        progress("fitting the plain stage again, without the first way of each run")
        initial = UNSWEPT
        baseline = fit_baseline(records, aside, fraction, initial, progress)
        regression = regress(baseline)
        faults = replace(find_faults(regression), spikes=faults.spikes, heights_um=faults.heights_um)
        bench, probes, skipped = _probed(baseline, faults)
        projector = Projector(regression, faults.noise)
        said = (*said, _FIRST)
    late = max((one.drop for one in _scores(projector, probes, "transport_delay")), default=0.0)
    if baseline.dynamic and late > _LATE:
        progress("fitting the plain stage again, its command held in steps")
        steps = regress(fit_baseline(records, aside, fraction, initial, progress, "zero"))
        if _left(projector) - _left(Projector(steps, faults.noise)) > _AS_WELL * late:
            baseline, regression = replace(steps.baseline, remarks=(*steps.baseline.remarks, _STEPS)), steps
            faults = replace(find_faults(regression), spikes=faults.spikes, heights_um=faults.heights_um)
            bench, probes, skipped = _probed(baseline, faults)
    baseline = replace(baseline, remarks=(*baseline.remarks, *said))
    progress("learning how rough the density is")
    signatures = [column for probe in probes for column in probe.signatures]
    rough = learn_roughness(Projector(regression, faults.noise), signatures)
    projector = Projector(regression, faults.noise, rough)
    return Prepared(baseline, regression, bench, projector, tuple(probes), faults, tuple(skipped))


def _covered(records: Sequence[Record], fraction: float) -> bool:
    """Whether the voltage goes both ways through much of its range in what is not held out."""
    parts = [record.voltage_V[: len(record) - round(fraction * len(record))] for record in records]
    span_V = float(np.ptp(np.concatenate([record.voltage_V for record in records])))
    moves_V = np.concatenate([np.diff(part) for part in parts])
    return min(float(moves_V[moves_V > 0].sum()), -float(moves_V[moves_V < 0].sum())) > _BOTH_WAYS * span_V


def _probed(baseline: Baseline, faults: Faults) -> tuple[Bench, list[Probe], list[tuple[str, str]]]:
    """Simulate every probe of every effect that can be asked about, and say of the others why not."""
    bench = Bench(baseline)
    probes: list[Probe] = []
    skipped = []
    scales = scales_of(bench, min(noise.total_um for noise in faults.noise))
    for form in EFFECTS:
        reason = applicable(baseline, form)
        if reason is not None:
            skipped.append((form.name, reason))
            continue
        own = list(probes_of(bench, form, scales))
        if not own:
            why = "the runs are too short or too plain to show it"
            skipped.append((form.name, "nothing of it was found, sample by sample" if form.name in SINGLE else why))
        probes += own
    return bench, probes, skipped


def _scores(projector: Projector, probes: Sequence[Probe], name: str | None = None) -> tuple[Scored, ...]:
    asked = [probe for probe in probes if name in (None, probe.name)]
    return score(projector, asked, projector.off(projector.residual))


def _left(projector: Projector) -> float:
    left = projector.off(projector.residual)
    return float(left @ left)
