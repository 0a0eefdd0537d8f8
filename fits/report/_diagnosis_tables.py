"""The tables and figures of a diagnosis, as HTML."""

import math
from collections.abc import Sequence
from html import escape

from fits.diagnosis._result import Bound, Diagnosis, Experiment, FoundCause
from fits.diagnosis._words import (
    SIGMA,
    Lengths,
    chance,
    estimate,
    listed,
    number,
    parameter_name,
    percent,
    plain,
    shown_unit,
    sigmas,
)


def section(title: str, *content: str) -> str:
    return "\n".join(["<section>", f"<h2>{escape(title)}</h2>", *(each for each in content if each), "</section>"])


def _facts(pairs: Sequence[tuple[str, str]]) -> str:
    items = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in pairs)
    return f'<dl class="facts">{items}</dl>'


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]], numeric: Sequence[bool], stack: bool = False) -> str:
    """A table whose first column names the rows; `stack` lets a phone show one row as a block."""
    kinds = [' class="n"' if right else "" for right in numeric]
    head = "".join(f'<th scope="col"{kind}>{escape(name)}</th>' for name, kind in zip(heads, kinds, strict=True))
    body = []
    for row in rows:
        cells = [f'<th scope="row">{escape(row[0])}</th>']
        for name, text, kind in zip(heads[1:], row[1:], kinds[1:], strict=True):
            of = f' data-of="{escape(name)}"' if kind else ""
            cells.append(f"<td{kind}{of}>{escape(text)}</td>")
        body.append(f"<tr>{''.join(cells)}</tr>")
    style = ' class="stack"' if stack else ""
    inner = f"<thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody>"
    return f'<div class="scroll"><table{style}>{inner}</table></div>'


def causes_section(diagnosis: Diagnosis, length: Lengths) -> str:
    """What was found: evidence, share, parameters with their intervals, and what cannot be told from it."""
    if not diagnosis.causes:
        return ""
    title = "The cause" if len(diagnosis.causes) == 1 else "The causes, most important first"
    return section(title, *(_cause(cause, length) for cause in diagnosis.causes))


def _cause(cause: FoundCause, length: Lengths) -> str:
    facts = [
        ("Evidence", f"{sigmas(cause.z)} {SIGMA}"),
        ("Probability by chance", chance(cause.p_family)),
        ("Share of the misfit", percent(cause.share_of_misfit)),
        ("Size in the displacement, rms", length(cause.rms_um)),
    ]
    rows = []
    for each in cause.parameters:
        unit = shown_unit(each.unit)
        value, sd, interval = estimate(each)
        rows.append([parameter_name(each), value, sd, interval, unit or "1"])
    heads = ("Parameter", "Estimate", "Standard deviation", "95 % interval", "Unit")
    table = _table(heads, rows, (False, True, True, True, True), stack=True) if rows else ""
    form = f'<p class="small">Model: {escape(plain(cause.form))}.</p>' if cause.form else ""
    also = (
        f"<p>These records would also be consistent with <strong>{escape(listed(cause.also_consistent, 'or'))}"
        "</strong>.</p>"
        if cause.also_consistent
        else "<p>No other effect of the library is consistent with these records in its place.</p>"
    )
    name = f"<h3>{escape(plain(cause.name).capitalize())}</h3>"
    return "\n".join(['<div class="cause">', name, form, _facts(facts), table, also, "</div>"])


def gain_section(diagnosis: Diagnosis, length: Lengths) -> str:
    """What the extension is worth on data that were not used."""
    gain = diagnosis.gain
    before, after = gain.heldout_rms_before_um, gain.heldout_rms_after_um
    if not math.isfinite(before):
        words = "Nothing was held out, so how well either stage predicts new data is not known."
        return section("How much better it predicts", f"<p>{words}</p>")
    if not diagnosis.causes:
        words = f"On data that were not used, the plain stage errs by {length(before)}, root mean square."
        entries = [("before", "plain stage", before), ("noise", "noise floor", gain.noise_um)]
        return section(
            "How well it predicts", f"<p>{escape(words)}{_source(gain.source)}</p>", _bars(entries, length)
        )
    difference = before - after
    size = length.bare(abs(difference))
    if math.isfinite(gain.sd_of_difference_um):
        size += f" ± {number(length.per_um * gain.sd_of_difference_um, 2)}"
    words = f"On data that were not used, the error rises by {size} {length.unit}, root mean square."
    if difference > 0:
        words = (
            f"On data that were not used, the error falls by {size} {length.unit}, root mean square: by "
            f"{percent(difference / before)}."
        )
    entries = [
        ("before", "plain stage", before),
        ("after", "with what was found", after),
        ("noise", "noise floor", gain.noise_um),
    ]
    further = []
    if math.isfinite(gain.heldout_max_before_um) and math.isfinite(gain.heldout_max_after_um):
        largest = gain.heldout_max_before_um, gain.heldout_max_after_um
        further.append(("Largest error, before → after", _arrow(*largest, length)))
    if math.isfinite(gain.feedforward_before_um) and math.isfinite(gain.feedforward_after_um):
        driven = gain.feedforward_before_um, gain.feedforward_after_um
        further.append(("Error under feedforward, rms, before → after", _arrow(*driven, length)))
    return section(
        "How much better it predicts",
        f"<p>{escape(words)}{_source(gain.source)}</p>",
        _bars(entries, length),
        _facts(further) if further else "",
    )


def _source(source: str) -> str:
    return f" Held out: {escape(source.rstrip('.'))}." if source else ""


def _arrow(before_um: float, after_um: float, length: Lengths) -> str:
    return f"{length.bare(before_um)} → {length.bare(after_um)} {length.unit}"


def _bars(entries: Sequence[tuple[str, str, float]], length: Lengths) -> str:
    known = [entry for entry in entries if math.isfinite(entry[2])]
    longest = max((size for _, _, size in known), default=0.0) or 1.0
    items = "".join(
        f'<li><span>{escape(words)}</span><span class="bar {kind}" style="width: {100 * size / longest:.1f}%"></span>'
        f'<span class="n">{escape(length(size))}</span></li>'
        for kind, words, size in known
    )
    return f'<ul class="bars">{items}</ul>'


def bounds_section(diagnosis: Diagnosis, length: Lengths) -> str:
    """What was not found, and how large it may still be."""
    asked = [bound for bound in diagnosis.upper_bounds if not bound.reason]
    silent = [bound for bound in diagnosis.upper_bounds if bound.reason]
    if not asked and not silent:
        return ""

    def order(bound: Bound) -> float:
        return -bound.bound_um if math.isfinite(bound.bound_um) else math.inf

    rows = [
        [
            plain(bound.name).capitalize(),
            sigmas(bound.z),
            percent(bound.absorbed_fraction),
            length.bare(bound.bound_um),
        ]
        for bound in sorted(asked, key=order)
    ]
    words = (
        "None of these was found. At 95 %, each is smaller than its bound, root mean square in the displacement. "
        "Followed is the part of an effect that the plain stage takes up by changing its own parameters: that part "
        "cannot be seen, and an effect that is followed almost wholly may be large."
    )
    heads = ("Effect", f"Evidence ({SIGMA})", "Followed", f"Bound ({length.unit})")
    table = _table(heads, rows, (False, True, True, True)) if rows else ""
    reasons = "".join(
        f"<li><strong>{escape(plain(bound.name).capitalize())}</strong>: {escape(bound.reason.rstrip('.'))}.</li>"
        for bound in silent
    )
    unasked = f'<h3>Not asked about</h3>\n<ul class="plain">{reasons}</ul>' if reasons else ""
    return section("What could not be seen", f"<p>{words}</p>" if rows else "", table, unasked)


def tests_section(diagnosis: Diagnosis) -> str:
    """Ways of looking at the residual of the plain stage."""
    if not diagnosis.tests:
        return ""
    rows = [
        [plain(test.name).capitalize(), sigmas(test.statistic), chance(test.p), percent(test.share), test.sentence]
        for test in diagnosis.tests
    ]
    heads = ("Against", f"Evidence ({SIGMA})", "By chance", "Share", "What it says")
    words = "<p>Without any effect in mind: does the residual of the plain stage depend on anything?</p>"
    table = _table(heads, rows, (False, True, True, True, False), stack=True)
    return section("Tests of the residual", words, table)


def experiment_facts(ahead: Experiment) -> str:
    """What the next experiment would tell apart, and by how much."""
    pairs = []
    if ahead.time_s.size > 1:
        lowest, highest = number(float(ahead.voltage_V.min())), number(float(ahead.voltage_V.max()))
        pairs.append(("Duration", f"{number(float(ahead.time_s[-1] - ahead.time_s[0]))} s"))
        pairs.append(("Voltage", f"{lowest} to {highest} V"))
    if ahead.separates:
        pairs.append(("Tells apart", listed(ahead.separates)))
    if math.isfinite(ahead.predicted_z):
        pairs.append(("Predicted separation", f"{sigmas(ahead.predicted_z)} {SIGMA}"))
    if math.isfinite(ahead.present_z):
        pairs.append(("In the records at hand", f"{sigmas(ahead.present_z)} {SIGMA}"))
    return _facts(pairs)


def experiment_limits(ahead: Experiment) -> str:
    """What the next experiment is predicted to reach, beside the limits."""
    if not ahead.extremes:
        return ""

    def span(low: float, high: float, unit: str) -> str:
        return f"{number(low)} to {number(high)} {unit}"

    rows = [
        (one.name, span(one.low, one.high, one.unit), span(one.lowest, one.highest, one.unit))
        for one in ahead.extremes
    ]
    words = (
        "<p>Predicted for the plain stage and for each candidate, and for what else the records allow them to be. "
        "Limits that nobody stated are what the records reached. The current is that of each farad of the piezo.</p>"
    )
    return words + _table(("Quantity", "Predicted", "Limits"), rows, (False, True, True), stack=True)
