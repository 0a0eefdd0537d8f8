"""From records to a diagnosis: what is wrong, why, and what is gained by adding it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import jax
import numpy as np

from fits.diagnosis._conclude import conclude
from fits.diagnosis._experiment import Wish
from fits.diagnosis._prepare import HOLDS, Prepared, prepare_diagnosis
from fits.diagnosis._result import Diagnosis
from fits.diagnosis._select import Selection, select
from fits.diagnosis._steps import Step
from fits.diagnosis._virgin import VirginCurveError
from fits.io._errors import DataError
from fits.io._limits import MARGIN, UNITS
from fits.io._record import Record, refuse_repeats
from fits.loop._run import VIRGIN

# Where whole runs are held out, this part of the others is still kept aside, to check what is found.
_CHECK = 0.12
# Mean square of the errors in what was held out, in noise variances, that no chance explains.
_UNLIKE = 1.5
# Evidence of a cause that is found there, in standard deviations: less does not make up for having nothing held out.
_STRONG = 8.0
_ALL = (
    "what was held out is predicted far worse than noise allows, and the causes show only there: it was used to find "
    "them, so that the gain is not measured on new data"
)


def diagnose(
    records: Sequence[Record],
    *,
    holdout: float | Sequence[Record] = 0.2,
    false_alarm: float = 0.01,
    duration_s: float | None = None,
    initial: str = "unknown",
    limits: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    margin: float = MARGIN,
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """Say what the simulation of a stage gets wrong, name the cause, extend the model and measure the gain.

    The plain stage is fitted to all runs. Each effect of `microid.EFFECTS` is then asked for by a score test: its
    signature in these very runs, projected off everything that the re-fitted stage can follow. The leaders are fitted
    jointly with the stage, one cause at a time, until chance explains the rest.

    Parameters
    ----------
    records
        Runs of one rig, slow and fast ones together.
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
    """
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError('estimation needs float64: jax.config.update("jax_enable_x64", True)')
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
    rng = np.random.default_rng(seed)
    ready = prepare_diagnosis(records, aside, fraction, initial, progress)

    def selected(ready: Prepared, guessed: bool) -> Selection:
        progress(Step.SELECTION)
        return select(ready.bench, ready.projector, ready.probes, false_alarm, rng, progress, guessed)

    try:
        found = selected(ready, initial == "unknown")
    except VirginCurveError:
        initial = VIRGIN
        ready = prepare_diagnosis(records, aside, fraction, initial, progress)
        found = selected(ready, False)
    if ready.doubted and not found.model.is_noise(found.projector):
        progress("asking again with the command in lines between samples")
        lines = prepare_diagnosis(records, aside, fraction, initial, progress, HOLDS[:1])
        try:
            beside = selected(lines, initial == "unknown")
            ready, found = (lines, beside) if beside.left_um < found.left_um else (ready, found)
        except VirginCurveError:
            progress("a first way from an unknown state explains what is left then")
    if not found.causes and not aside and ready.projector.ahead(found.model.change_um) > _UNLIKE:
        progress("asking again with what was held out, which noise does not explain")
        whole = prepare_diagnosis(records, (), 0.0, initial, progress)
        beside = selected(whole, False)
        if max((cause.z for cause in beside.causes), default=0.0) > _STRONG:
            said = (*whole.baseline.remarks, _ALL)
            ready, found = replace(whole, baseline=replace(whole.baseline, remarks=said)), beside
    return conclude(ready, found, [*records, *aside], false_alarm, progress, Wish(duration_s, limits, margin))
