"""The resonance of the plain stage, asked for again beside the cause that hid it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fits.diagnosis._comparison import criterion
from fits.diagnosis._effects import Bench
from fits.diagnosis._explanation import Selection
from fits.diagnosis._extension import shared_effects
from fits.diagnosis._lag_place import rings_by_command
from fits.diagnosis._noise import find_faults
from fits.diagnosis._prepare import Prepared, Reading, decide_plain_stage, fit_plain_stage, prepared
from fits.diagnosis._refit import refit
from fits.diagnosis._regression import regress
from fits.diagnosis._thresholds import Thresholds
from fits.io._errors import DataError
from fits.io._record import Record
from fits.loop._result import FitError


def look_again(
    ready: Prepared, found: Selection, progress: Callable[[str], None], has_time: Callable[[], bool]
) -> tuple[Prepared, Prepared] | None:
    """Fit the plain stage with the resonance that the records show without their largest cause.

    Beside a cause that is many times what a resonance makes, a plain stage shows none. What comes first is that plain
    stage, and second where it belongs beside the cause, from where effects are asked for: a fit without any may end
    too far from there. None where the stage has a resonance, or shows none so either, or no cause explains most of
    the misfit.
    """
    cleaned = None if ready.baseline.resonance_Hz is not None else without_largest(ready, found)
    if cleaned is None or not has_time():
        return None
    progress("fitting the plain stage again, to what the largest cause leaves")
    try:
        there = fit_plain_stage(cleaned, tuple(run.hold for run in ready.baseline.runs), progress)
        if not (rings_by_command(there) and has_time()):
            return None
        cleaned, there, said = decide_plain_stage(cleaned, progress, has_time, there.regression.baseline.problem)
        reading = replace(ready.reading, fraction=cleaned.fraction)
        plain = fit_plain_stage(reading, there.holds, progress, there.regression.baseline.problem, there.faults)
    except (DataError, FitError):
        # What a cause leaves may be no loop any more.
        return None
    baseline, beside = plain.regression.baseline, there.regression.baseline
    alike = [type(part) for part in baseline.stage.parts] == [type(part) for part in beside.stage.parts]
    if not (rings_by_command(there) and alike) or len(baseline.columns_um) != len(beside.columns_um):
        return None
    z = np.asarray(baseline.chain.coordinates.of(beside.stage))
    moved = replace(baseline, z=z, columns_um=beside.columns_um, prior=beside.prior, hyper=beside.hyper)
    second = prepared(reading, replace(plain, regression=regress(moved)), said, progress)
    baseline = replace(baseline, remarks=second.baseline.remarks)
    return replace(second, baseline=baseline, regression=plain.regression, bench=plain.bench), second


def is_better(found: Selection, other: Selection, thresholds: Thresholds) -> bool:
    """Whether another selection, beside another plain stage, explains and predicts the runs better."""
    same, model = found.projector.beside(other.projector.noise), found.model
    there = refit(found.bench, same, model.laws, model.x, 0)
    return criterion(other.projector, other.model) < criterion(same, there) - thresholds.tie


def without_largest(ready: Prepared, found: Selection) -> Reading | None:
    """The records without what the cause that was found first makes of them.

    None where it explains less than most of the misfit, or leaves nothing but noise. A narrow band may be what the
    plain stage lacks.
    """
    thresholds, model, projector = ready.reading.thresholds, found.model, found.projector
    if not found.causes:
        return None
    beside = find_faults(projector.regression, model.change_um, thresholds)
    if model.is_noise(projector, thresholds.chance_z) and not beside.is_narrow(thresholds):
        return None
    name = found.causes[0].name
    laws = [k for k, law in enumerate(model.laws) if law.form.name == name]
    # Others may stand in for what the plain stage lacks.
    alone = refit(found.bench, projector, [model.laws[k] for k in laws], [model.x[k] for k in laws], 4)
    misfit = found.plain.cost - projector.count + projector.freedom
    if found.plain.cost - alone.cost < (1 - thresholds.minor_share) * misfit:
        return None
    behind, effects = Bench(found.bench.baseline, aside=True), shared_effects(alone, len(alone.change_um))
    aside_um = [behind.respond_in(k, effects) - plain for k, plain in enumerate(behind.plain)]

    def cleaned(record: Record, change_um: np.ndarray) -> Record:
        assert record.displacement_um is not None
        return replace(record, displacement_um=record.displacement_um - change_um)

    reading = ready.reading
    return replace(
        reading,
        records=list(map(cleaned, reading.records, alone.change_um)),
        aside=list(map(cleaned, reading.aside, aside_um)),
    )
