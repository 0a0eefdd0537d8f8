"""What a diagnosis asks its reader to do, what it has read, and what became of the stage."""

import math
import shlex
from collections.abc import Sequence
from itertools import chain

import numpy as np

from fits.diagnosis._result import Diagnosis, RunView
from fits.io.columns import COLUMNS
from fits.io.columns.path import PATH
from fits.report._words import (
    NOISY,
    NONE,
    estimate,
    length,
    listed,
    number,
    parameter_name,
    percent,
    plain,
)
from microid.effects import AbstractEffect, card_of


def next_steps(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Sentences that say what to do now, each with the command to paste, which may be empty."""
    ahead = diagnosis.next_experiment
    steps = [_use(diagnosis)]
    # Of the parts that are there: another form of the same effect may do without.
    needs = {column: None for part in diagnosis.extended.parts for column in getattr(part, "needs", ())}
    if needs and "extended.json" in steps[0][1]:
        steps.append((f"What was found needs more columns in reference.csv: {', '.join(needs)}.", ""))
    if ahead is not None and ahead.time_s.size > 1:
        fitted = [run.source for run in diagnosis.runs if run.fitted.any()]
        aside = [("--holdout", run.source) for run in diagnosis.runs if not run.fitted.any()]
        again = ["microid", "diagnose", *fitted, "answer.csv", *chain(*aside), "--out", "again"]
        words = "lay next_experiment.csv on the rig, record answer.csv, and diagnose all runs together"
        begin = "To be surer that there is no effect, p" if diagnosis.verdict == "no_effect" else "P"
        steps.append((f"{begin}{words}. {ahead.purpose}", shlex.join(again)))
    elif diagnosis.verdict == "unexplained":
        steps.append(("Record a run at another speed, with holds and with the temperature, and diagnose again.", ""))
    return steps


def _use(diagnosis: Diagnosis) -> tuple[str, str]:
    """Which stage to go on with, and why."""
    gain, modelled = diagnosis.gain, [one.name for one in diagnosis.causes if not card_of(one.name).statistic]
    before, after = gain.heldout_rms_before_um, gain.heldout_rms_after_um
    own = [name for name in modelled if _is_own(diagnosis, name)]
    lasting = [name for name in modelled if name not in own]
    name, once = (
        "baseline.json",
        f"what a run has of {listed(own)} says nothing of the next, so see to that on the rig",
    )
    if modelled and not lasting:
        words = f"Keep to the plain stage: {once}"
    elif modelled and not (after >= before):
        name, words = "extended.json", f"Compensate with the extended stage, which has {listed(lasting)}"
        if own:
            words += f"; {once}"
        if read := [name for name in lasting if card_of(name).place in ("sensor", "time")]:
            words += (
                f". Only the readings have {listed(read)}: they follow the reference, and the stage is off by that"
            )
        if not math.isfinite(after):
            words += ". Hold a run out first to learn what that is worth on new data"
    elif modelled:
        words = f"Keep to the plain stage: with {listed(modelled)} it predicts data that were not used no better"
    elif diagnosis.verdict == "unexplained":
        size_um, where = diagnosis.unexplained_rms_um, "left beyond the noise in the fit"
        if math.isfinite(before):
            size_um, where = before, "erred, noise included, on data that were not used"
        words = f"Expect errors of {length(size_um)}, root mean square, from the plain stage: by so much it {where}"
    elif diagnosis.causes:
        named = listed([one.name for one in diagnosis.causes])
        words = f"Mend this where it arises: {named}. It is in the readings, and no model of the stage takes it away"
    else:
        words = "Use the plain stage: these records need no more"
        if before > NOISY * gain.noise_um:
            words = (
                f"Use the plain stage only where the fitted records went: what was not used it predicts to "
                f"{length(before)}, root mean square, over a noise floor of {length(gain.noise_um)}"
            )
    return f"{words}.", f"microid compensate {name} reference.csv --dynamic --out voltage.csv"


def _is_own(diagnosis: Diagnosis, name: str) -> bool:
    """Whether a run has an effect of its own, so that the extended stage foretells it in no other."""
    parts = [part for part in diagnosis.extended.parts if isinstance(part, AbstractEffect) and part.name == name]
    held = any(np.any(getattr(part, strength)) for part in parts for strength in part.strength)
    alone = sum(bool(run.fitted.any()) for run in diagnosis.runs) == 1
    # A hum begins at any phase, and one run does not say what it has in common with others.
    form = parts[0] if parts else card_of(name)
    return form.independent or (form.per_run and alone) or bool(parts and form.strength and not held)


def runs_read(runs: Sequence[RunView], paths: Sequence[str] = ()) -> list[tuple[str, ...]]:
    """Name or path, samples, rate, duration in s, range of the command in V, channels and use of every run.

    The path of the command, which is no channel of a file but made of its voltages, is left out.
    Paths are those that were given, in the order of the runs.
    """
    rows: list[tuple[str, ...]] = []
    for k, run in enumerate(runs):
        share = float(run.fitted.mean()) if run.fitted.size else 0.0
        use = "held out" if share == 0 else "fitted" if share == 1 else f"{percent(share)} fitted"
        span_s, volts = (number(float(np.ptp(one))) if one.size else NONE for one in (run.time_s, run.voltage_V))
        name = paths[k] if len(paths) == len(runs) and paths[k].endswith(run.source) else run.source
        channels = ", ".join(("voltage", "displacement", *(_channel(key) for key in run.extra if key != PATH)))
        rows.append((name or NONE, f"{run.time_s.size}", _rate_Hz(run.time_s), span_s, volts, channels, use))
    return rows


def _channel(key: str) -> str:
    """Name a further column, without its unit where that is known."""
    return plain(next((each.quantity.stem for each in COLUMNS.values() if each.quantity.column == key), key))


def _rate_Hz(time_s: np.ndarray) -> str:
    """Write the sampling rate in Hz, where there is one."""
    steps = np.diff(time_s)
    if not steps.size:
        return NONE
    step = float(np.median(steps))
    return f"{1 / step:.6g}" if np.max(np.abs(steps - step)) < 0.01 * step else f"uneven, about {1 / step:.3g}"


def partly_fitted(runs: Sequence[RunView], held_out: bool) -> str:
    """What became of the part of a run that was not fitted; nothing where there is none."""
    if not any(0 < run.fitted.mean() < 1 for run in runs if run.fitted.size):
        return ""
    if not held_out:
        return "What was not fitted are bad samples, and those that depend on an unknown past; nothing was held out."
    end = "was looked at to choose among causes" if any(not run.fitted.any() for run in runs) else "was held out"
    others = "bad samples, and those that depend on an unknown past, count for neither"
    return f"Of a run that is fitted in part the end {end}; {others}."


def stage_parameters(diagnosis: Diagnosis) -> list[tuple[str, ...]]:
    """Heads and rows of a table: what was fitted of the plain stage, and beside causes of both, with intervals."""
    after = {one.name: one for one in diagnosis.extended_parameters if diagnosis.causes}
    sides = ("Plain", "Extended") if after else ("Estimate",)
    rows: list[tuple[str, ...]] = [("Parameter", *(head for side in sides for head in (side, "95 % interval")))]
    for one in diagnosis.baseline_parameters:
        cells = (cell for each in (one, after.get(one.name, one))[: len(sides)] for cell in estimate(each)[::2])
        rows.append((parameter_name(one), *cells))
    return rows
