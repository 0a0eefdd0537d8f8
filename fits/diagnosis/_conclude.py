"""From what the selection found to a diagnosis: verdict, extension, gain and what else is to be said."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from fits.diagnosis._candidates import Bench
from fits.diagnosis._evaluate import simulate
from fits.diagnosis._experiment import Wish, suggest
from fits.diagnosis._extend import Compared, extended_stage, feedforward, gain_of, left_of, shared_effects
from fits.diagnosis._faults import Faults, find_faults, name_faults
from fits.diagnosis._findings import bounds, causes_of
from fits.diagnosis._floor import SPIKE
from fits.diagnosis._irregular import irregular
from fits.diagnosis._prepare import ONE_WAY, Prepared
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit
from fits.diagnosis._regression import Regression, regress
from fits.diagnosis._regulated import held_creep, told_by
from fits.diagnosis._result import Diagnosis, RunView, Test
from fits.diagnosis._select import Selection
from fits.diagnosis._steps import Step
from fits.diagnosis._structure import cycles, further_views, look, together, views
from fits.io._limits import measured_ranges
from fits.io._record import Record
from microid import AbstractEffect, Stage

# Causes explain at least this part of what is reproducible, or the true ones are not in the library; with less than
# the second part they have nothing to do with it.
_SHARE, _RATHER = 0.65, 0.3
# Standard deviations by which a sum of squares exceeds its mean by chance.
_SPREAD = 3.0
# What is left counts as unexplained above this size, in noise, and with less than this probability by chance.
_REST, _CHANCE = 0.3, 1e-6
# What was kept aside must not be predicted so many times worse, in squares; or not worse beyond chance by causes with
# less evidence than this, in standard deviations: what else is not simulated may lend them as much.
_WORSE, _WEAK = 1.1, 8.0
# Standard deviations from which on a difference counts, and samples that are taken to err alike.
_SURELY, _BLOCK = 1.5, 25
# Part of the noise above which a narrow band is what is seen in every way of looking.
_BAND = 0.75
# A way of looking has seen something below this probability by chance.
_SEEN = 1e-3
# Evidence for a period in the position, in e-folds of chance, and the part of what is left that it explains.
_CYCLIC, _PART = 50.0, 0.3
# Part of the stroke below which a change of the feedforward is rounding.
_MET = 1e-9
# Part of the noise variance from which on it is that of rounding.
_ROUNDED = 0.5


def conclude(
    ready: Prepared,
    found: Selection,
    records: Sequence[Record],
    false_alarm: float,
    progress: Callable[[str], None],
    wish: Wish,
) -> Diagnosis:
    """Decide on the verdict, extend the stage, measure the gain, and say what else is to be said.

    `records` are those whose warnings are passed on, `false_alarm` and `wish` are what was asked
    for; see `diagnose`.
    """
    # With the noise that was found in the end.
    ready = replace(ready, projector=found.first)
    projector, bench, baseline = ready.projector, ready.bench, ready.baseline
    ways = views(baseline.runs, bench.plain)
    none = np.zeros((len(found.plain.residual), 0))
    seen = look(projector, none, found.plain.residual, [*ways, *further_views(baseline.runs)])
    # What the causes explain and what is left to be seen in any way is what there is to be explained.
    explained = found.explained
    rest, rest_freedom = together(found.projector, found.model.basis(), found.model.residual, ways)
    period_um, cycle_z, cycle_drop = cycles(found.projector, found.model.residual, bench.plain)
    noise_um = float(np.sqrt(np.mean([n.total_um**2 for n in found.projector.noise])))
    # Rounding repeats itself with the position and comes in bursts; it is a cause of its own.
    rounded = ready.faults.quantum_um**2 / 12 > _ROUNDED * noise_um**2
    rest = max(rest, 0.0 if rounded else cycle_drop)
    beyond = max(rest - rest_freedom - _SPREAD * (2 * rest_freedom) ** 0.5, 0.0)
    misfit = max(explained + beyond, 1e-300)
    rest_share = (max(rest - rest_freedom, 0.0) / projector.count) ** 0.5
    chance = stats.chi2.sf(rest, rest_freedom)
    left_over = rest_share > _REST and chance < _CHANCE
    share = explained / misfit
    progress(Step.EXTENSION)
    extended, compared, effects = _extended(ready, found, found.model if found.causes else None)
    model, kept, remarks = found.model, found.causes, list(_remarks(ready, records))
    weak = max((cause.z for cause in kept), default=0.0) < _WEAK
    if kept and (share < _SHARE or _worse(compared[: len(baseline.runs)], weak)):
        suspects = ", ".join(cause.name for cause in kept)
        why = f"explains only {share:.0%} of what is left" if share < _SHARE else "predicts what was kept aside worse"
        remarks.append(f"{suspects} came nearest to what is left, but {why}: none of them is named")
        model, kept = found.plain, ()
        rest_share = (max(explained + max(rest - rest_freedom, 0.0), 0.0) / projector.count) ** 0.5
        # What is beyond chance is there, however small it is, unless nearly all of the rest is of another kind.
        left_over = rest_share > _REST or not (weak or share < _RATHER)
        extended, compared, effects = _extended(ready, found, None)
    cyclic = not rounded and cycle_z > _CYCLIC and cycle_drop > _PART * max(rest - rest_freedom, cycle_drop)
    if cyclic:
        remarks.append(
            f"what is left repeats itself every {period_um:.3g} um of the position, as the error of an "
            "interferometer or an encoder does"
        )
    faults = name_faults(_beside(ready, found, model, compared) if kept else ready.faults, cyclic)
    causes = causes_of(kept, model, found.projector, found.bench, misfit, faults, ready.faults)
    if (held := held_creep([run.record for run in baseline.runs])) is not None:
        causes = told_by(held, causes)
        remarks.append(held.sentence)
    ahead = suggest(ready, found, causes, wish, progress)
    if ahead is None and any(cause.also_consistent for cause in causes):
        remarks.append(
            "no program of this length that stays within the limits tells the class apart; allow a longer one, or "
            "wider limits where the rig has them"
        )
    # Faults of samples and noise explain nothing that is reproducible, but a narrow band may look as if it were.
    explained_all = any(one.name == "floor_vibration" and one.share_of_misfit > _BAND for one in causes)
    unlike, bursts = irregular(projector, found.plain.residual)
    if bursts and not kept and not rounded:
        remarks.append("what is left comes in bursts that no effect of the library makes")
        explained_all, left_over = False, True
        excess = found.plain.cost / max(projector.count - projector.freedom, 1.0) - 1
        rest_share = max(rest_share, max(excess, 0.0) ** 0.5)
    open_ = left_over and not kept and not explained_all
    verdict = "unexplained" if open_ else "effect_found" if causes else "no_effect"
    if baseline.aside:
        # What was kept aside of the fitted runs has been looked at.
        compared = [
            one if k >= len(baseline.runs) else replace(one, held_out=one.held_out & False)
            for k, one in enumerate(compared)
        ]
    source = "the last part of each run" if not baseline.aside else "whole runs"
    gain = gain_of(compared, noise_um, source)
    if effects:
        # What only the readings have is not to be compensated.
        moving = [effect for effect in effects if effect.place not in ("time", "sensor", "noise")]
        if moving:
            before, after = feedforward(found.bench, moving)
            # A command that is played slowly does not meet what only fast ones do.
            if before > _MET * baseline.stroke_um:
                gain = replace(gain, feedforward_before_um=before, feedforward_after_um=after)
        silent = sorted({effect.name for effect in effects if effect.per_run and len(baseline.runs) > 1})
        if silent:
            remarks.append(
                f"{', '.join(silent)}: of what differs from run to run the extended stage has only what all have in "
                "common, so that it may explain these runs and not the next"
            )
    names = {cause.name for cause in causes} | {rival.name for cause in kept for rival in cause.rivals}
    tests = tuple(
        Test(
            one.view.name,
            one.z,
            one.p,
            max(one.drop - one.freedom, 0.0) / max(found.plain.cost, 1e-300),
            one.view.sentence if one.p < _SEEN else f"no sign of this: {one.view.sentence}",
        )
        for one in seen
    ) + tuple(
        Test(one.name, one.z, one.p, 0.0, one.sentence if one.p < _SEEN else f"no sign of this: {one.sentence}")
        for one in unlike
    )
    return Diagnosis(
        verdict=verdict,  # type: ignore[arg-type]
        noise_um=noise_um,
        noise_source=ready.faults.source,
        noise_samples=float(np.mean([noise.correlation_samples for noise in found.projector.noise])),
        causes=causes,
        unexplained_rms_um=rest_share * noise_um if left_over else 0.0,
        upper_bounds=bounds(found, ready, found.left if kept else found.scores, names),
        tests=tests,
        gain=gain,
        next_experiment=ahead,
        remarks=tuple(remarks),
        baseline=baseline.stage.with_substeps(_substeps(ready, False)),
        extended=extended,
        runs=tuple(
            RunView(
                one.run.record.source,
                np.asarray(one.run.record.time_s),
                np.asarray(one.run.record.voltage_V),
                one.run.displacement_um,
                one.before_um,
                one.after_um,
                one.run.fitted & ~one.held_out,
            )
            for one in compared
        ),
        false_alarm=false_alarm,
        details={
            "selection": found,
            "ready": ready,
            "cycles": (period_um, cycle_z),
            "rest": rest_share,
            "share": share,
            "reached": [
                measured_ranges(run.record, float(np.mean(left[run.known])))
                for run, left in zip(baseline.runs, ready.regression.residuals, strict=True)
            ],
        },
    )


def _beside(ready: Prepared, found: Selection, model: Refit, compared: Sequence[Compared]) -> Faults:
    """Faults of samples and noise, as they are beside the causes, which may explain what looked like a bad sample."""
    now = find_faults(found.projector.regression, model.change_um)
    standing = tuple(
        bad & (np.abs(one.after_um + height_um) > SPIKE * noise.total_um)
        for bad, height_um, one, noise in zip(
            ready.faults.spikes, ready.faults.heights_um, compared, now.noise, strict=False
        )
    )
    return replace(now, spikes=standing, heights_um=ready.faults.heights_um)


def _worse(compared: Sequence[Compared], weak: bool) -> bool:
    """Whether the extended stage predicts what was kept aside of the fitted runs worse than the plain one."""
    held = [one for one in compared if one.held_out.any()]
    if not held:
        return False
    before, after = (
        np.concatenate([values[one.held_out] for one, values in zip(held, pick, strict=True)]) ** 2
        for pick in ([one.before_um for one in held], [one.after_um for one in held])
    )
    if np.sum(after) > _WORSE * np.sum(before):
        return True
    sums = np.add.reduceat(after - before, np.arange(0, len(before), _BLOCK))
    return bool(weak and np.sum(sums) > _SURELY * np.linalg.norm(sums - np.mean(sums)))


def _remarks(ready: Prepared, records: Sequence[Record]) -> tuple[str, ...]:
    """What the user should know of the records and the fit."""
    baseline = ready.baseline
    said = [warning for record in records for warning in record.warnings]
    said += [*baseline.remarks, *ready.faults.remarks]
    for run in baseline.runs:
        lost = int(np.sum(~run.known))
        if lost:
            said.append(
                f"{run.record.source}: the first {lost} samples depend on what the rig went through before and were "
                "not used, so that an unknown initial state is not taken for an effect; state it with --initial to "
                "have it tested"
            )
    if ONE_WAY not in said and not baseline.aside and not any(run.held_out.any() for run in baseline.runs):
        said.append("nothing was held out, so the gain is not measured: hold out a part, or a run with --holdout")
    return tuple(dict.fromkeys(said))


def _extended(
    ready: Prepared, found: Selection, model: Refit | None
) -> tuple[Stage, list[Compared], list[AbstractEffect]]:
    """Let the plain stage follow what the effects leave, and fit the effects again beside it."""
    baseline = ready.baseline
    runs = len(baseline.runs)
    if model is None or not model.laws:
        stage = baseline.stage.with_substeps(_substeps(ready, False))
        return stage, _compare(ready, ready.bench, None, ready.regression), []
    # What followed along the tangent is put into the stage itself.
    bare = Projector(found.projector.regression, found.projector.noise)
    regression = regress(bare.move(bare.residual - bare.join(model.change_um)), ())
    bench = Bench(regression.baseline)
    effects = shared_effects(model, runs)
    stage = extended_stage(regression.baseline, effects, _substeps(ready, found.finest))
    return stage, _compare(ready, bench, model, regression, found.finest), effects


def _substeps(ready: Prepared, finest: bool) -> int:
    """Steps between samples that a stage needs."""
    return max(run.samples.stride for run in (ready.baseline.finest if finest else ready.baseline.fine))


def _compare(
    ready: Prepared, bench: Bench, model: Refit | None, regression: Regression, finest: bool = False
) -> list[Compared]:
    """Residuals of the plain stage and of the extended one in all runs, those held out whole last."""
    runs = len(bench.prepared)
    change = [np.zeros_like(plain) for plain in bench.plain] if model is None else model.change_um
    found = []
    for k, run in enumerate(ready.baseline.runs):
        plain = run.displacement_um - ready.regression.residuals[k]
        better = run.displacement_um - regression.residuals[k] + change[k]
        own, using = ready.regression.own[k], run.fitted
        found.append(Compared(run, left_of(run, own, plain, using), left_of(run, own, better, using), run.held_out))
    if ready.baseline.aside:
        shared = shared_effects(model, runs) if model is not None else []
        behind = Bench(bench.baseline, aside=True, finest=finest)
        for run, change_um in zip(ready.baseline.fine_aside, behind.change(shared), strict=True):
            plain = simulate(ready.baseline.stage, run)
            better = simulate(bench.baseline.stage, run) + change_um
            own, using = np.ones((len(run.record), 1)), run.known
            found.append(Compared(run, left_of(run, own, plain, using), left_of(run, own, better, using), using))
    return found
