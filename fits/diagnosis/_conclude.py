"""From what the selection found to a diagnosis: verdict, extension, gain and what else is to be said."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from fits.diagnosis._certainty import Certainty
from fits.diagnosis._effects import drop_programs
from fits.diagnosis._experiment import Request, suggest
from fits.diagnosis._explanation import Selection
from fits.diagnosis._extension import (
    Compared,
    Extension,
    extend_stage,
    feedforward,
    gain_of,
    is_own,
    plain_stage,
    predicts_worse,
    without_effects,
)
from fits.diagnosis._findings import before_the_runs, bounds, causes_of, with_held_gain
from fits.diagnosis._misfit import SHOWN, faults_beside, worth_naming
from fits.diagnosis._noise import Faults, name_faults
from fits.diagnosis._prepare import BEHIND, ONE_WAY, Prepared, of_half_a_sample, of_holds_aside
from fits.diagnosis._residual_tests import explain, further_regressors, irregular, run_regressors
from fits.diagnosis._result import Diagnosis, FoundCause, Gain, RunView, Step, Test, Verdict
from fits.diagnosis._thresholds import Thresholds
from fits.io._length import length
from fits.io._limits import measured_ranges
from fits.io._record import Record
from fits.loop._known import known_samples
from fits.stats._held import held_gain
from microid.effects import card_of

_OWN_LAG = (
    "the plain stage has no dynamics, which these runs do not show apart: the lag may be that of the driver and of "
    "the mechanics, which every stage has"
)
_OF_NO_USE = "something else is left, and what was held out is predicted no better with what all runs have of that"
# Part of the stroke below which a change of the feedforward is rounding.
_MET = 1e-9


def conclude(
    ready: Prepared,
    found: Selection,
    records: Sequence[Record],
    false_alarm: float,
    progress: Callable[[str], None],
    request: Request | None,
    has_time: Callable[[], bool] = lambda: True,
) -> Diagnosis:
    """Decide on the verdict, extend the stage, measure the gain, and say what else is to be said.

    `records` are those whose warnings are passed on; for `false_alarm` and `request` see `diagnose`. There is no
    request where the time is over, and where it no longer `has_time` intervals are not followed.
    """
    # With the noise that was found in the end.
    ready = replace(ready, projector=found.first)
    baseline, thresholds = ready.baseline, ready.reading.thresholds
    found, beside, quiet = faults_beside(ready, found)
    # What there is to be explained is all that the sensor does not make, the model's discrepancy, too.
    noise_um = float(np.sqrt(np.mean([n.total_um**2 for n in beside.noise])))
    # Rounding repeats itself with the position and comes in bursts; it is a cause of its own.
    rounding_um = ready.faults.quantum_um / 12**0.5
    rounded = beside.is_rounded(thresholds)
    # A floor's vibration is noise, however slow it is: what moves along with it by chance is no misfit.
    itself = beside.band.alone or beside.rings_itself(baseline.resonance_Hz, thresholds)
    shaken = beside.is_narrow(thresholds) and (bool(found.causes) or not itself)
    noise = found.projector.noise if shaken else beside.noise
    found, told, misfit, repeated, minor = worth_naming(ready, found, noise, rounded)
    rest_noise, left_over = misfit.rest_noise, misfit.is_left_over
    unit_um = told.first.unit_um(told.plain.residual)
    progress(Step.EXTENSION)
    extension = extend_stage(ready, found, found.model if found.causes else None)
    model, kept, remarks = found.model, found.causes, [*_remarks(ready, records)]
    weak = max((cause.z for cause in kept), default=0.0) < thresholds.strong_z
    # What is small beside the noise may be an error of the plain stage that is too small to show.
    small = misfit.explained < thresholds.rest_noise**2 * misfit.count
    # Of what one run had of its own other runs show nothing, unless it is so little that it may be what they lack.
    repeats = not any(map(is_own, extension.effects))
    seen = extension.compared if repeats or (weak and small) else extension.compared[: len(baseline.runs)]
    # Beside a rest of another kind any evidence looks large; of what one run had of its own others say nothing.
    doubts = int(weak) + int(small) + int(left_over and repeats)
    worse = predicts_worse(seen, _may_be_worse_z(doubts, thresholds), thresholds.worse_share)
    if kept and (misfit.share < thresholds.explained_share or worse):
        why = f"what was held out is predicted {'no better' if doubts else 'worse'} with that"
        if misfit.share < thresholds.explained_share:
            share = "hardly any" if misfit.share < SHOWN else f"only {100 * misfit.share:.0f} %"
            why = f"that explains {share} of it"
        remarks.append(not_named([cause.name for cause in kept], why))
        model, kept = found.plain, ()
        rest_noise, left_over = misfit.unnamed(weak or small)
        extension = extend_stage(ready, found, None)
    remarks += minor
    estimated = any(run.has_past for run in baseline.runs)
    if kept and not repeats and predicts_worse(extension.compared[len(baseline.runs) :], 0.0, 0.0):
        told_of = {
            one.name for one in extension.effects if is_own(one) and not (estimated and card_of(one.name).past)
        }
        own = ", ".join(sorted(name.replace("_", " ") for name in told_of))
        others = extend_stage(ready, found, model, own=False)
        plain = not others.effects or predicts_worse(others.compared[len(baseline.runs) :], 0.0, 0.0)
        extension = without_effects(ready, extension) if plain else others
        how = "the stage is left plain" if plain else "the extended stage is without"
        if plain and left_over and not all(_is_of_each_run(cause.name) for cause in kept):
            # What all runs would have in common is none of what there is.
            remarks.append(not_named([cause.name for cause in kept], _OF_NO_USE))
            model, kept = found.plain, ()
            rest_noise, left_over = misfit.unnamed(weak or small)
        elif own:
            remarks.append(f"{own}: not the same in the runs held out, so that {how}")
    remarks += of_holds_aside(baseline.stage.hold, [one.run for one in extension.compared[len(baseline.runs) :]])
    # Up to its own size rounding makes structure, too.
    left_over = left_over and not (rounded and rest_noise * unit_um < rounding_um)
    cyclic = (
        not (rounded or any(card_of(cause.name).origin for cause in kept))
        and repeated.z > thresholds.cycles
        and repeated.drop > thresholds.minor_share * max(misfit.excess, repeated.drop)
    )
    if cyclic:
        remarks.append(
            f"what is left repeats itself every {length(repeated.period_um)} of the position, as the error of an "
            "interferometer or an encoder does, and a hysteresis of few plays"
        )
    rest_um = rest_noise * unit_um if left_over else 0.0
    faults = _standing(beside if kept else quiet, extension.compared, rest_um, thresholds.spike_z)
    unlike, in_bursts = irregular(told.first, told.plain.residual, thresholds)
    bursts = in_bursts and not kept and not rounded
    rings = faults.makes_noise(thresholds) and faults.rings_itself(baseline.resonance_Hz, thresholds)
    lone = faults.band.alone and faults.makes_noise(thresholds) and not cyclic
    named = name_faults(faults, cyclic, bursts or rings or lone, thresholds)
    removed = misfit.share, misfit.explained / misfit.count * unit_um**2
    causes = causes_of(kept, model, found, removed, named, ready.faults, has_time)
    if kept and not has_time():
        remarks.append(
            "the time was over: intervals of what was found are those of its curvature, and may be too narrow"
        )
    if estimated:
        # It is fitted as one more part of the past that is estimated, which is beside all that is asked.
        causes = tuple(one for one in causes if not card_of(one.name).past)
        if kept and all(card_of(one.name).past for one in kept):
            extension = extend_stage(ready, found, None)
    bound = {law.form.name.replace("_", " ") for law, x in zip(model.laws, model.x, strict=True) if law.at_bound(x)}
    if bound:
        remarks.append(
            f"{', '.join(sorted(bound))}: a parameter ended at the bound of what such an effect may have, so that "
            "something else that looks alike may be there instead"
        )
    late = any(card_of(cause.name).lag or card_of(cause.name).delay for cause in kept)
    if late and not baseline.dynamic and BEHIND not in remarks:
        remarks.append(_OWN_LAG)
    if not late:
        remarks = [one for one in remarks if one != BEHIND]
    remarks += before_the_runs(model, thresholds.chance_z)
    if (held := held_gain([run.record for run in baseline.runs])) is not None:
        causes = with_held_gain(held, causes)
        remarks.append(held.sentence)
    drop_programs(records)
    ahead = None if request is None else suggest(ready, found, causes, request, progress)
    if request is None:
        remarks.append(
            "the time was over: what else may be there was perhaps not asked to the end, and no next experiment was "
            "sought; give it a larger budget"
        )
    elif ahead is None and any(cause.also_consistent for cause in causes):
        remarks.append(
            "no program of this length that stays within the limits tells the class apart; allow a longer one, or "
            "wider limits where the rig has them"
        )
    # Faults of samples and noise explain nothing that is reproducible, but a narrow band may look as if it were.
    in_band = any(
        card_of(one.name).statistic == "band" and one.share_of_misfit > thresholds.explained_share for one in causes
    )
    if bursts:
        remarks.append("what is left comes in bursts that no effect of the library makes")
    elif rings:
        remarks.append(
            f"what is left rings near {faults.band.frequency_Hz:.4g} Hz, where the stage itself does after all that "
            "its model lacks: a vibration of the floor there cannot be told from that"
        )
    elif lone:
        remarks.append(
            f"what is left has a line near {faults.band.frequency_Hz:.4g} Hz, of {length(faults.band.size_um)}, that "
            "other runs would show and do not: no vibration of the floor, but perhaps something faster that sampling "
            "folds there"
        )
    if lone:
        left_over, rest_noise = True, max(rest_noise, faults.band.size_um / unit_um)
    if bursts or rings:
        left_over = True
        left = told.model if kept else told.plain
        excess = left.cost / max(told.first.count - told.first.freedom, 1.0) - 1
        rest_noise = max(rest_noise, max(excess, 0.0) ** 0.5)
    unexplained_um = rest_noise * unit_um if left_over else 0.0
    moving = [cause for cause in causes if not card_of(cause.name).statistic]
    remarks += of_half_a_sample(causes, baseline.runs)
    compared = extension.compared
    if baseline.aside:
        # What was kept aside of the fitted runs has been looked at.
        last = len(baseline.runs)
        compared = (*(replace(one, held_out=one.held_out & False) for one in compared[:last]), *compared[last:])
    gain, silent = _gain(found, extension, compared, noise_um)
    if silent:
        some = ", ".join(silent).replace("_", " ")
        remarks.append(
            f"{some}: of what differs from run to run the extended stage has only what all have in "
            "common, so that it may explain these runs and not the next"
        )
    sure = Certainty(found.first, found.plain, found.bench, baseline)
    before = after = sure.parameters()
    band = extended_band = sure.predictions(plain_stage(ready), [one.before_um for one in extension.compared])
    if extension.effects:
        sure = Certainty(found.projector, model, found.bench, extension.baseline)
        after = sure.parameters(causes)
        left_um = [one.after_um for one in extension.compared]
        extended_band = sure.predictions(extension.stage, left_um, extension.own)
    likely = {cause.name for cause in causes} | {rival.name for cause in kept for rival in cause.rivals}
    return Diagnosis(
        verdict=verdict_of(causes, unexplained_um, bool(moving) or in_band),
        noise_um=noise_um,
        noise_source=ready.faults.source,
        noise_samples=float(np.mean([noise.correlation_samples for noise in found.projector.noise])),
        causes=causes,
        unexplained_rms_um=unexplained_um,
        upper_bounds=bounds(found, ready, found.left if kept else found.scores, likely),
        tests=(*_tests(ready, told), *unlike),
        gain=gain,
        next_experiment=ahead,
        remarks=tuple(remarks),
        baseline=plain_stage(ready),
        extended=extension.stage,
        runs=tuple(map(_run_view, compared)),
        false_alarm=false_alarm,
        baseline_parameters=before,
        extended_parameters=after,
        baseline_uncertainty=band,
        extended_uncertainty=extended_band,
        details={
            "selection": found,
            "ready": ready,
            "reached": [
                measured_ranges(run.record, float(np.mean(left[run.known])))
                for run, left in zip(baseline.runs, ready.regression.residuals, strict=True)
            ],
        },
    )


def verdict_of(causes: Sequence[FoundCause], left_um: float, explained: bool) -> Verdict:
    """The verdict, where so much is left beyond noise, root mean square, and more than noise was `explained`.

    A few bad samples or coarse readings are no answer to more than they make.
    """
    made_um = float(np.hypot.reduce([cause.rms_um for cause in causes], initial=0.0))
    if left_um > 0 and not explained and not made_um >= left_um:
        return "unexplained"
    return "effect_found" if causes else "no_effect"


def _is_of_each_run(name: str) -> bool:
    """Whether an effect differs from run to run, so that those held out say nothing of it."""
    return card_of(name).independent or card_of(name).per_run


def not_named(suspects: Sequence[str], why: str) -> str:
    """Say which effects came nearest, and why they are not named."""
    none = "it is not named" if len(suspects) == 1 else "none of them is named"
    return f"{', '.join(suspects).replace('_', ' ')} came nearest to what is left, but {why}: {none}"


def _tests(ready: Prepared, found: Selection) -> tuple[Test, ...]:
    """What the residual of the plain stage depends on."""
    runs, residual = ready.baseline.runs, found.plain.residual
    regressors = [*run_regressors(runs, ready.bench.plain), *further_regressors(runs)]
    seen = explain(found.first, np.zeros((len(residual), 0)), residual, regressors)
    cost = max(found.plain.cost, 1e-300)
    return tuple(
        Test.of(one.regressors.name, one.z, one.p, max(one.drop - one.freedom, 0.0) / cost, one.regressors.sentence)
        for one in seen
    )


def _run_view(one: Compared) -> RunView:
    record = one.run.record
    time_s, voltage_V, used = np.asarray(record.time_s), np.asarray(record.voltage_V), one.run.fitted & ~one.held_out
    seen = one.run.displacement_um, one.before_um, one.after_um, used
    return RunView(record.source, time_s, voltage_V, *seen, tuple(record.extra))


def _gain(
    found: Selection, extension: Extension, compared: Sequence[Compared], noise_um: float
) -> tuple[Gain, list[str]]:
    """The gain, with that of the feedforward, and names of effects of which runs had more than the stage has."""
    baseline = found.bench.baseline
    gain = gain_of(compared, noise_um, "whole runs" if baseline.aside else "the last part of each run")
    # What only the readings have is not to be compensated.
    moving = [effect for effect in extension.effects if effect.place not in ("time", "sensor", "noise")]
    if moving:
        before, after = feedforward(found.bench, moving)
        # A command that is played slowly does not meet what only fast ones do.
        if before > _MET * baseline.stroke_um:
            gain = replace(gain, feedforward_before_um=before, feedforward_after_um=after)
    own = {one.name for one in extension.effects if one.per_run and not one.past and len(baseline.runs) > 1}
    return gain, sorted(own)


def _standing(faults: Faults, compared: Sequence[Compared], rest_um: float, spike_z: float) -> Faults:
    """Faults of samples and noise beside a rest, which may make what looked like a bad sample."""
    # Where much is left, a small one would stand out of zero by that alone.
    spikes = tuple(
        bad & (np.minimum(np.abs(one.after_um + um), np.abs(um)) > spike_z * float(np.hypot(noise.total_um, rest_um)))
        for bad, um, one, noise in zip(faults.spikes, faults.heights_um, compared, faults.noise, strict=False)
    )
    return replace(faults, spikes=spikes)


def _may_be_worse_z(doubts: int, thresholds: Thresholds) -> float:
    """Standard deviations by which causes may predict worse, negative where they must predict better.

    What is doubtful needs the support of what was held out, and what is so for more than one reason needs more of it.
    """
    return thresholds.worse_z * (1.0, -0.5, -1.0)[min(doubts, 2)]


def _remarks(ready: Prepared, records: Sequence[Record]) -> tuple[str, ...]:
    """What the user should know of the records and the fit."""
    baseline = ready.baseline
    said = [warning for record in records for warning in record.warnings]
    said += baseline.remarks
    pasts = [
        run.record.source
        for run in baseline.runs
        if run.has_past and not known_samples(run.record.voltage_V, *baseline.range_V).all()
    ]
    if pasts:
        said.append(
            f"{', '.join(pasts)}: what the rig went through before is unknown and estimated beside the rest, so that "
            "it is not taken for an effect; state the initial memory to have it tested"
        )
    if ONE_WAY not in said and not baseline.aside and not any(run.held_out.any() for run in baseline.runs):
        said.append("nothing was held out, so the gain is not measured: hold out a part, or a run")
    return tuple(dict.fromkeys(said))
