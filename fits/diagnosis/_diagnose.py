"""From records to a diagnosis: what is wrong, why, and what is gained by adding it."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import jax
import numpy as np

from fits.diagnosis._baseline import with_paths
from fits.diagnosis._conclude import conclude
from fits.diagnosis._experiment import Request
from fits.diagnosis._explanation import Selection
from fits.diagnosis._prepare import Prepared, Reading, prepare_diagnosis
from fits.diagnosis._records import excerpts, joined
from fits.diagnosis._result import Diagnosis, Step
from fits.diagnosis._second_look import is_better, look_again
from fits.diagnosis._select import select
from fits.diagnosis._thresholds import THRESHOLDS, Thresholds
from fits.io._errors import DataError
from fits.io._given import AnyRuns, holdout_given, records_given
from fits.io._limits import MARGIN, UNITS
from fits.io._record import refuse_repeats
from fits.io._threads import one_thread
from fits.loop._lost import without_lost
from fits.stage._solve import Problem
from microid.effects import card_of

# Where whole runs are held out, this part of the others is still kept aside, to check what is found.
_CHECK = 0.12
# Parts of the budget after which the stage is not fitted in yet another way, no more effects are asked for as what
# was found is refined in the rest, and intervals of what was found are not followed.
_PREPARED, _ASKED, _REFINED = 0.5, 0.65, 0.85
# What is no part of the noise that is said, and is predicted as little.
_UNRULY = ("band", "jitter", "spikes")
# Mean square of the errors in what was held out, in noise variances, that no chance explains.
_UNLIKE = 1.5
_ALL = (
    "what was held out is predicted far worse than noise allows, and the causes show only there: it was used to find "
    "them, so that the gain is not measured on new data"
)
_UNKNOWN = (
    "no effect is left in what was fitted, and the runs held out are off by {:.2g} times the noise: where they go "
    "the hysteresis is not known, or something shows only there; to ask for it, diagnose them with the others"
)
_UNSEEN = (
    "no effect is left in what was fitted, and what was held out is off by {:.2g} times the noise: the hysteresis "
    "there is not known from the rest, or something shows only there; to ask for it, diagnose with nothing held out"
)


@one_thread
def diagnose(
    records: AnyRuns,
    *,
    holdout: float | AnyRuns = 0.2,
    false_alarm: float = 0.01,
    duration_s: float | None = None,
    initial: str = "unknown",
    limits: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    margin: float = MARGIN,
    seed: int = 0,
    budget_s: float = 300.0,
    thresholds: Thresholds = THRESHOLDS,
    progress: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """Say what the simulation of a stage gets wrong, name the cause, extend the model and measure the gain.

    The plain stage is fitted to all runs. Each effect of `microid.effects.EFFECTS` is then asked for by a score test:
    its signature in these very runs, projected off everything that the re-fitted stage can follow. The leaders are
    fitted jointly with the stage, one cause at a time, until chance explains the rest.

    Parameters
    ----------
    records
        Runs of one rig, slow and fast ones together, as for `fit`. Those whose time goes on from the one before,
        without a gap, are one run.
    holdout
        Fraction at the end of every run that is only predicted, or records that are.
    false_alarm
        Probability of naming a cause where there is none.
    duration_s
        Length of the experiment that is suggested next; that of the longest run by default.
    initial
        Memory before each run: `unknown`, `negative`, `positive` or `demagnetised`.
    limits
        What the next experiment may reach, lowest and highest by name: voltage (V), slew (V/s), displacement (um),
        velocity (um/s), acceleration (um/s^2), current of the driver per farad of the piezo (A/F). Of what is not
        stated, as far as the records went.
    margin
        By how much of its range a predicted quantity may go beyond what the records reached.
    seed
        Of the draws that calibrate the false alarms.
    budget_s
        Seconds for all of it: after two thirds nothing more is asked, the best answer so far is refined, and what
        was not asked is said.
    thresholds
        What else decides.
    progress
        Told what is being done, a sentence at a time.

    Returns
    -------
    Diagnosis
        Its verdict is `no_effect`, `effect_found` or `unexplained`.

    Raises
    ------
    DataError
        If the records cannot be diagnosed.
    FitError
        If the plain stage cannot be fitted: there is nothing to diagnose then.
    RuntimeError
        If JAX computes in single precision.

    Notes
    -----
    Of more than 40,000 samples a part is read, which a remark says: windows spread over each record, and means of
    neighbours in them where cycles of the command are too long otherwise. Of 20,000 or more, all that JAX has
    compiled in this process is freed now and then (`jax.clear_caches`), and compiled again where it is used.
    """
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError('estimation needs float64: jax.config.update("jax_enable_x64", True)')
    records, holdout = without_lost(records_given(records), holdout_given(holdout))
    if not records:
        raise DataError("there is no record to diagnose")
    if not 0 < false_alarm <= 0.5:
        raise DataError(f"the probability of a false alarm is {false_alarm:g}: choose it above 0 and up to 0.5")
    aside = () if isinstance(holdout, int | float) else tuple(holdout)
    fraction = float(holdout) if isinstance(holdout, int | float) else _CHECK
    if not 0 <= fraction <= 0.9:
        raise DataError(f"the fraction held out is {fraction:g}: choose it between 0 and 0.9")
    unknown = set(limits) - set(UNITS)
    if unknown or not margin >= 0:
        raise DataError(f"expected limits of {', '.join(UNITS)} and a margin of 0 or more; correct them")
    refuse_repeats([*records, *aside])
    if not budget_s > 0:
        raise DataError(f"the budget is {budget_s:g} s: give it a positive time")
    (records, shortened), (aside, also) = map(excerpts, with_paths(joined(records), aside))
    rng, begin_s = np.random.default_rng(seed), time.monotonic()
    end_s = begin_s + budget_s

    def before(part: float) -> Callable[[], bool]:
        return lambda: time.monotonic() < begin_s + part * budget_s

    has_time = before(_ASKED)

    def chosen(ready: Prepared) -> Selection:
        progress(Step.SELECTION)
        stage = ready.bench, ready.projector, ready.probes
        return select(*stage, false_alarm, rng, progress, thresholds, has_time)

    def selected(reading: Reading, onward: Problem | None = None) -> tuple[Prepared, Selection]:
        ready = prepare_diagnosis(reading, progress, before(_PREPARED), onward)
        return ready, chosen(ready)

    def answer(reading: Reading, *remarks: str) -> Diagnosis:
        ready, found = selected(reading)
        if (better := found.plain_instead(thresholds)) is not None and has_time():
            progress("fitting the plain stage again, from where it has gone beside an effect that explains little")
            there, other = selected(reading, better)
            # From far away it may not have found back.
            ready, found = (there, other) if other.left_um < found.left_um else (ready, found)
        elif (again := look_again(ready, found, progress, before(_PREPARED))) is not None:
            plain, beside = again
            other = chosen(beside)
            if is_better(found, other, thresholds):
                ready, found = plain, other
        remarks = (*shortened, *also, *ready.baseline.remarks, *remarks)
        ready = replace(ready, baseline=replace(ready.baseline, remarks=remarks))
        request = Request(duration_s, limits, margin, has_time) if has_time() else None
        return conclude(ready, found, [*records, *aside], false_alarm, progress, request, before(_REFINED))

    reading = Reading(records, aside, fraction, initial, thresholds)
    diagnosis = answer(reading)
    gain = diagnosis.gain
    # A vibration is noise, and so are bad samples: nothing that was held out would tell more of them.
    unruly = [cause.rms_um for cause in diagnosis.causes if card_of(cause.name).statistic in _UNRULY]
    heard_um2 = gain.noise_um**2 + sum(rms_um**2 for rms_um in unruly)
    least_um2 = max(_UNLIKE * heard_um2, (1 - thresholds.minor_share) * gain.heldout_rms_before_um**2)
    if gain.heldout_rms_after_um**2 > least_um2 and not aside and 2 * time.monotonic() - begin_s < end_s:
        progress("asking again with what was held out, which noise and causes do not explain")
        whole = answer(replace(reading, fraction=0.0), _ALL)
        if max((cause.z for cause in whole.causes), default=0.0) > thresholds.strong_z:
            return whole
    off, said = gain.heldout_rms_after_um**2 / heard_um2, _UNKNOWN if aside else _UNSEEN
    if off > _UNLIKE and not diagnosis.unexplained_rms_um > 0:
        diagnosis = replace(diagnosis, remarks=(*diagnosis.remarks, said.format(off**0.5)))
    return diagnosis
