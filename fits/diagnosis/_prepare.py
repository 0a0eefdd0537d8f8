"""All that scores and fits of effects need: the fitted plain stage, its noise, and every effect simulated."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from fits._record import Record
from fits.diagnosis._baseline import Baseline, fit_baseline
from fits.diagnosis._candidates import Bench, Probe, applicable, probes_of, scales_of
from fits.diagnosis._faults import SINGLE, Faults, find_faults
from fits.diagnosis._projector import Projector, learn_roughness
from fits.diagnosis._regression import Regression, regress
from microid import EFFECTS


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
    progress("fitting the plain stage")
    baseline = fit_baseline(records, aside, fraction, initial, progress)
    progress("reading the noise")
    regression = regress(baseline)
    faults = find_faults(regression)
    if faults.repaired:
        progress("fitting the plain stage again, without single bad samples")
        baseline = fit_baseline(faults.clean(records), aside, fraction, initial, progress)
        regression = regress(baseline)
        faults = replace(find_faults(regression), spikes=faults.spikes, heights_um=faults.heights_um)
    progress("simulating every effect")
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
    progress("learning how rough the density is")
    signatures = [column for probe in probes for column in probe.signatures]
    rough = learn_roughness(Projector(regression, faults.noise), signatures)
    projector = Projector(regression, faults.noise, rough)
    return Prepared(baseline, regression, bench, projector, tuple(probes), faults, tuple(skipped))
