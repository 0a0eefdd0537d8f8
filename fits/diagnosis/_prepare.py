"""All that scores and fits of effects need: the fitted plain stage, its noise, and every effect simulated."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

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
from microid import EFFECTS, Hold

# Decrease of the sum of squares, in noise variances, from which on a delay is looked into, and the part of it that a
# command held in steps must explain to be taken for it: then what looked like a delay is half a sample. Or steps
# leave, beside a delay of their own, less than lines do, by such a part.
_LATE, _AS_WELL, _BETTER = 25.0, 0.97, 0.03
_HOLDS: tuple[Hold, ...] = ("first", "zero")
_STEPS = (
    "the command is taken to be held between samples, as a converter does, since the readings are late by half a "
    "sample; a delay of that length would look the same"
)
_FIRST = (
    "the voltage's first way through its range differs from later ones, as after a rest or a demagnetisation, and "
    "was not used"
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


@dataclass(frozen=True)
class _Fitted:
    """The plain stage, fitted to runs in one way."""

    regression: Regression
    faults: Faults

    @cached_property
    def projector(self) -> Projector:
        return Projector(self.regression, self.faults.noise)

    @cached_property
    def probed(self) -> tuple[Bench, list[Probe], list[tuple[str, str]]]:
        return _probed(self.regression.baseline, self.faults)

    def left(self) -> float:
        """Sum of squares that is left."""
        left = self.projector.off(self.projector.residual)
        return float(left @ left)

    def best(self, name: str | None = None) -> Scored | None:
        """What has most evidence, of one effect or of all."""
        asked = [probe for probe in self.probed[1] if name in (None, probe.name)]
        scores = score(self.projector, asked, self.projector.off(self.projector.residual))
        return max(scores, key=lambda one: one.z, default=None)


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

    def fitted(hold: Hold) -> _Fitted:
        regression = regress(fit_baseline(records, aside, fraction, initial, progress, hold))
        faults = find_faults(regression)
        if not faults.repaired:
            return _Fitted(regression, faults)
        progress("fitting the plain stage again, without single bad samples")
        regression = regress(fit_baseline(faults.clean(records), aside, fraction, initial, progress, hold))
        found = find_faults(regression)
        return _Fitted(regression, replace(found, spikes=faults.spikes, heights_um=faults.heights_um))

    progress("fitting the plain stage")
    here = fitted("first")
    progress("simulating every effect")
    for hold in _HOLDS:
        if hold != "first":
            late = here.best("transport_delay")
            if not here.regression.baseline.dynamic or late is None or late.drop <= _LATE:
                break
            progress("fitting the plain stage again, its command held in steps")
            steps = fitted(hold)
            # With the same noise, they compare: with a delay beside each, too.
            same = _Fitted(steps.regression, here.faults)
            more = same.best("transport_delay")
            beside = here.left() - late.drop - (same.left() - (more.drop if more is not None else 0.0))
            if here.left() - same.left() <= _AS_WELL * late.drop and beside <= _BETTER * late.drop:
                break
            here, said = steps, (*said, _STEPS)
        most = here.best()
        if initial == "unknown" and most is not None and unswept(here.projector, most.z):
            progress("fitting the plain stage again, without the first way of each run")
            initial = UNSWEPT
            here, said = fitted(hold), (*said, _FIRST)
    bench, probes, skipped = here.probed
    baseline = replace(here.regression.baseline, remarks=(*here.regression.baseline.remarks, *said))
    progress("learning how rough the density is")
    rough = learn_roughness(here.projector, [column for probe in probes for column in probe.signatures])
    projector = Projector(here.regression, here.faults.noise, rough)
    return Prepared(baseline, here.regression, bench, projector, tuple(probes), here.faults, tuple(skipped))


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
