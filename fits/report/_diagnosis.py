"""A diagnosis as one page that needs nothing else: pictures are in it, and it opens without a network."""

import math
from collections.abc import Sequence
from html import escape
from importlib.resources import files

from fits.diagnosis._result import Diagnosis
from fits.diagnosis._words import (
    SIGMA,
    Lengths,
    chance,
    headline,
    number,
    percent,
    plain,
    rms_um,
    sigmas,
    verdict_sentence,
)
from fits.io._version import written_by
from fits.plots._diagnosis import Picture, fingerprint, program, residuals, shown_runs
from fits.report._diagnosis_tables import (
    bounds_section,
    causes_section,
    experiment_facts,
    experiment_limits,
    gain_section,
    section,
    tests_section,
)

_KINDS = {
    "no_effect": "no effect found",
    "effect_found": "effect found",
    "unexplained": "unexplained error",
}


def report_html(diagnosis: Diagnosis) -> str:
    """Write a diagnosis as a page for people: on a screen, a phone or paper.

    Parameters
    ----------
    diagnosis
        From `diagnose`.

    Returns
    -------
    str
        HTML, with style and pictures in it. The same diagnosis gives the same text.
    """
    length = Lengths(diagnosis)
    style = files("fits.report").joinpath("report.css").read_text(encoding="utf-8")
    sections = [
        _verdict(diagnosis, length),
        _main_picture(diagnosis, length),
        causes_section(diagnosis, length),
        _why(diagnosis, length),
        gain_section(diagnosis, length),
        bounds_section(diagnosis, length),
        tests_section(diagnosis),
        _next(diagnosis),
        _remarks(diagnosis),
        _how_to_read(diagnosis, length),
    ]
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<link rel="icon" href="data:,">',
            f"<title>Diagnosis: {escape(headline(diagnosis))}</title>",
            f"<style>\n{style}</style>",
            "</head>",
            "<body>",
            "<main>",
            *filter(None, sections),
            f"<footer>Written by {escape(written_by())}.</footer>",
            "</main>",
            "</body>",
            "</html>",
            "",
        ]
    )


def _paragraph(text: str, kind: str = "") -> str:
    if not text:
        return ""
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def _figure(picture: Picture | None, caption: str = "", above: str = "") -> str:
    if picture is None:
        return ""
    under = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return (
        f'<figure>{above}<div class="wide">{picture.wide}</div><div class="narrow">{picture.narrow}</div>'
        f"{under}</figure>"
    )


def _key(entries: Sequence[tuple[str, str]]) -> str:
    items = "".join(f'<li class="{kind}">{escape(words)}</li>' for kind, words in entries)
    return f'<ul class="key">{items}</ul>'


def _verdict(diagnosis: Diagnosis, length: Lengths) -> str:
    gain, tiles = diagnosis.gain, []
    if diagnosis.causes:
        first = diagnosis.causes[0]
        tiles.append((f"Evidence for {plain(first.name)}", f"{sigmas(first.z)} {SIGMA}"))
        tiles.append(("Share of the misfit it explains", percent(first.share_of_misfit)))
        if math.isfinite(gain.heldout_rms_before_um) and math.isfinite(gain.heldout_rms_after_um):
            before, after = length.bare(gain.heldout_rms_before_um), length.bare(gain.heldout_rms_after_um)
            tiles.append(("Error on unused data, before → after", f"{before} → {after} {length.unit}"))
    else:
        tiles.append(("Residual of the plain stage, rms", length(rms_um(diagnosis.runs, "before_um"))))
    if diagnosis.verdict == "unexplained":
        tiles.append(("Unexplained, rms", length(diagnosis.unexplained_rms_um)))
    tiles.append(("Noise floor, rms", length(diagnosis.noise_um)))
    shown = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in tiles)
    sources = list(dict.fromkeys(run.source for run in diagnosis.runs if run.source))
    told = ", ".join(sources[:6]) + (f" and {len(sources) - 6} more" if len(sources) > 6 else "")
    return "\n".join(
        [
            "<header>",
            _paragraph(f"Diagnosis of a stage · {_KINDS[diagnosis.verdict]}{f' · {told}' if told else ''}", "kind"),
            f"<h1>{escape(headline(diagnosis))}</h1>",
            _paragraph(verdict_sentence(diagnosis), "lead"),
            f'<dl class="tiles">{shown}</dl>',
            "</header>",
        ]
    )


def _main_picture(diagnosis: Diagnosis, length: Lengths) -> str:
    picture = residuals(diagnosis, length)
    if picture is None:
        return ""
    entries = [("before stroke", "plain stage")]
    if diagnosis.causes:
        entries.append(("after stroke", "with what was found"))
    if math.isfinite(diagnosis.noise_um):
        entries.append(("noise", "noise, ± 2 standard deviations"))
    if any((~run.fitted).any() for run in diagnosis.runs):
        entries.append(("aside", "not used for the fit"))
    left_out = len(diagnosis.runs) - len(shown_runs(diagnosis.runs))
    caption = "Measurement less model. Dense curves are drawn by the extremes of short stretches."
    if left_out:
        caption += f" The runs with the largest residuals are shown; {left_out} more are not."
    return section("What the model leaves over", _figure(picture, caption, _key(entries)))


def _why(diagnosis: Diagnosis, length: Lengths) -> str:
    if not diagnosis.causes:
        seen = fingerprint(diagnosis, "", length, 0)
        if seen is None:
            return ""
        words = "Over the voltage, an effect of hysteresis or driver would stand out as a loop or a curve."
        return section("How the residual looks", _paragraph(words), _figure(seen[0], seen[1], _key(_curves(False))))
    content = []
    for place, cause in enumerate(diagnosis.causes):
        if len(diagnosis.causes) > 1:
            content.append(f"<h3>{escape(plain(cause.name).capitalize())}</h3>")
        content.append(_paragraph(cause.fingerprint))
        seen = fingerprint(diagnosis, cause.name, length, place)
        if seen is not None:
            content.append(_figure(seen[0], seen[1], _key(_curves(True))))
        content.append(_paragraph(f"Source: {cause.source.rstrip('.')}." if cause.source else "", "small"))
    return section("Why this cause" if len(diagnosis.causes) == 1 else "Why these causes", *content)


def _curves(extended: bool) -> list[tuple[str, str]]:
    return [("before stroke", "plain stage"), *([("after stroke", "with what was found")] if extended else [])]


def _next(diagnosis: Diagnosis) -> str:
    ahead = diagnosis.next_experiment
    if ahead is None:
        words = "No further experiment is proposed."
        return section("What to measure next", _paragraph(words))
    return section(
        "What to measure next",
        _paragraph(ahead.purpose),
        _figure(program(ahead), ahead.kind),
        experiment_facts(ahead),
        experiment_limits(ahead),
        _paragraph(f"A further column would help: {ahead.extra_column}" if ahead.extra_column else ""),
    )


def _remarks(diagnosis: Diagnosis) -> str:
    if not diagnosis.remarks:
        return ""
    items = "".join(f"<li>{escape(remark)}</li>" for remark in diagnosis.remarks)
    return section("Remarks", f'<ul class="plain">{items}</ul>')


def _how_to_read(diagnosis: Diagnosis, length: Lengths) -> str:
    sentences = (
        "A plain stage, with driver, hysteresis and mechanics, was fitted to the runs, and its residual is what is "
        "asked about here.",
        "Each effect of a library of physical effects was simulated; what the plain stage can follow of it by "
        "changing its own parameters was taken away, and only the rest counts as evidence.",
        "Evidence is in standard deviations of the noise, and the probability beside it allows for having asked "
        "about all effects at once.",
        "What was found was fitted together with the stage, and both were judged on data that the fit did not see.",
        f"The threshold is set so that {percent(diagnosis.false_alarm)} of records that hold no effect are given a "
        "cause by chance; an effect that is not named is bounded, not excluded.",
    )
    terms = (
        f"The noise floor is {escape(length(diagnosis.noise_um))}"
        f"{f', from {escape(diagnosis.noise_source)}' if diagnosis.noise_source else ''}"
    )
    worth = diagnosis.noise_samples
    if math.isfinite(worth) and worth > 1.05:
        terms += f"; {escape(number(worth))} samples are worth one independent one"
    strongest = max((cause.p_family for cause in diagnosis.causes), default=math.nan)
    if math.isfinite(strongest):
        terms += f"; the least certain cause has a probability by chance that is {escape(chance(strongest))}"
    return section("How to read this", _paragraph(" ".join(sentences)), f'<p class="small">{terms}.</p>')
