"""A diagnosis as one page that needs nothing else: pictures are in it, and it opens without a network."""

import math
from collections.abc import Sequence
from typing import Any

from jinja2 import Environment

from fits.diagnosis._result import KINDS, Diagnosis, Experiment
from fits.diagnosis._thresholds import THRESHOLDS
from fits.plots._diagnosis import fingerprint, program, residuals, shown_runs
from fits.report import _words
from fits.report._next_steps import next_steps, partly_fitted, runs_read, stage_parameters
from fits.report._page import environment, unbroken
from fits.report._words import (
    SIGMA,
    chance,
    estimate,
    heading,
    length,
    listed,
    number,
    parameter_name,
    percent,
    plain,
    shown_unit,
    sigmas,
    spread,
)


def report_html(diagnosis: Diagnosis, when: str = "", paths: Sequence[str] = ()) -> str:
    """Write a diagnosis as an HTML page for screen, phone and paper, all in one; the same one gives the same text.

    It says `when` the runs were read and from which `paths`, in their order, where that is given.
    """
    causes, ahead = diagnosis.causes, diagnosis.next_experiment
    named = [cause.name for cause in causes] or [""]
    asked = [one for one in diagnosis.upper_bounds if not one.reason]
    unnamed = any(one.z > THRESHOLDS.strong_z for one in asked)
    asked.sort(key=lambda one: -one.bound_um if math.isfinite(one.bound_um) else math.inf)
    gain = diagnosis.gain
    bounds = [
        (heading(one.name), sigmas(one.z), percent(one.absorbed_fraction), length(one.bound_um)) for one in asked
    ]
    tests = [
        (heading(one.name), sigmas(one.statistic), chance(one.p), share, one.sentence)
        for one in diagnosis.tests
        # What compares samples with one another explains no part of them.
        for share in [percent(one.share) if one.share > 0 else _words.NONE]
    ]
    extremes = [
        (one.name, _span(one.low, one.high, one.unit), _span(one.lowest, one.highest, one.unit))
        for one in (ahead.extremes if ahead else ())
    ]
    further = _arrow("Largest error", gain.heldout_max_before_um, gain.heldout_max_after_um)
    driven = gain.feedforward_before_um, gain.feedforward_after_um
    further += _arrow("Predicted error under feedforward, rms", *driven)
    template = _with_words().get_template("diagnosis.html")
    return unbroken(
        template.render(
            diagnosis=diagnosis,
            ahead=ahead,
            kind=KINDS[diagnosis.verdict],
            when=when,
            steps=next_steps(diagnosis),
            runs=runs_read(diagnosis.runs, paths),
            partly=partly_fitted(diagnosis.runs, math.isfinite(diagnosis.gain.heldout_rms_before_um)),
            parameters=stage_parameters(diagnosis),
            tiles=_tiles(diagnosis),
            residuals=residuals(diagnosis),
            some_aside=any((~run.fitted).any() for run in diagnosis.runs),
            left_out=len(diagnosis.runs) - len(shown_runs(diagnosis.runs)),
            views=[fingerprint(diagnosis, name, k) for k, name in enumerate(named)],
            gained=_gained(diagnosis),
            bars=_bars(diagnosis),
            further=further,
            bounds=bounds,
            strong_z=THRESHOLDS.strong_z if unnamed else math.nan,
            most_causes=THRESHOLDS.most_causes,
            tests=tests,
            program=program(ahead) if ahead else None,
            ahead_facts=_facts(ahead) if ahead else (),
            extremes=extremes,
            weakest=max((cause.p_family for cause in causes), default=math.nan),
        )
    )


def _with_words() -> Environment:
    """Templates, and the words of a diagnosis in them."""
    made = environment()
    for name in (
        "headline",
        "verdict_sentence",
        "plain",
        "heading",
        "listed",
        "sigmas",
        "chance",
        "percent",
        "number",
        "whole",
    ):
        made.filters[name] = getattr(_words, name)
    made.filters["length_of"] = length
    made.filters["without_dot"] = lambda text: text.rstrip(".")
    made.filters["parameter_row"] = lambda one: (parameter_name(one), *estimate(one))
    made.tests["finite"] = math.isfinite
    made.globals["SIGMA"] = SIGMA
    return made


def _tiles(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Key figures at the top of the page, by name."""
    gain, tiles = diagnosis.gain, []
    for first in diagnosis.causes[:1]:
        tiles += [
            (f"Evidence for {plain(first.name)}", f"{sigmas(first.z)} {SIGMA}"),
            (f"Share of the {_words.whole(first.name)} it explains", percent(first.share_of_misfit)),
            *_arrow("Error on unused data", gain.heldout_rms_before_um, gain.heldout_rms_after_um),
        ]
    if not diagnosis.causes:
        tiles.append(
            ("Residual of the plain stage in the fit, rms", length(_words.rms_um(diagnosis.runs, "before_um")))
        )
    if diagnosis.verdict == "unexplained":
        tiles.append(("Unexplained, beyond the noise, rms", length(diagnosis.unexplained_rms_um)))
    return [*tiles, ("Noise floor, rms", length(diagnosis.noise_um))]


def _arrow(name: str, before_um: float, after_um: float) -> list[tuple[str, str]]:
    """How a size changes; nothing where one of the two is not known."""
    if not (math.isfinite(before_um) and math.isfinite(after_um)):
        return []
    return [(f"{name}, before → after", f"{length(before_um)} → {length(after_um)}")]


def _gained(diagnosis: Diagnosis) -> str:
    """What the extension is worth on data that were not used."""
    gain = diagnosis.gain
    before = gain.heldout_rms_before_um
    if not diagnosis.causes or gain.heldout_rms_after_um == before:
        return f"On data that were not used, the plain stage errs by {length(before)}, root mean square."
    difference, sd = before - gain.heldout_rms_after_um, gain.sd_of_difference_um
    size = spread(abs(difference), sd)
    way, part = ("falls", f": by {percent(difference / before)}") if difference > 0 else ("rises", "")
    doubt = ", which may be chance" if abs(difference) < 2 * sd else ""
    return f"On data that were not used, the error {way} by {size}, root mean square{part}{doubt}."


def _bars(diagnosis: Diagnosis) -> list[tuple[str, str, float, float]]:
    """Kind, words, size and width in percent of each bar; none where nothing was held out."""
    gain = diagnosis.gain
    if not math.isfinite(gain.heldout_rms_before_um):
        return []
    found = [("after", "with what was found", gain.heldout_rms_after_um)] if diagnosis.causes else []
    entries = ("before", "plain stage", gain.heldout_rms_before_um), *found, ("noise", "noise floor", gain.noise_um)
    known = [one for one in entries if math.isfinite(one[2])]
    longest = max(size for _, _, size in known) or 1.0
    return [(*one, 100 * one[2] / longest) for one in known]


def _span(low: float, high: float, unit: str) -> str:
    return f"{number(low)} to {number(high)} {shown_unit(unit)}"


def _facts(ahead: Experiment) -> list[tuple[str, Any]]:
    """Figures of the next experiment, by name."""
    pairs = []
    if ahead.time_s.size > 1:
        pairs.append(("Duration", f"{number(float(ahead.time_s[-1] - ahead.time_s[0]))} s"))
        pairs.append(("Voltage", _span(float(ahead.voltage_V.min()), float(ahead.voltage_V.max()), "V")))
    if ahead.separates:
        pairs.append(("Tells apart" if len(ahead.separates) > 1 else "Would show", listed(ahead.separates)))
    if len(ahead.separates) == 1:
        return pairs
    evidence = {"Predicted separation": ahead.predicted_z, "In the records at hand": ahead.present_z}
    return pairs + [(name, f"{sigmas(z)} {SIGMA}") for name, z in evidence.items() if math.isfinite(z)]
