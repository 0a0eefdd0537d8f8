"""The pictures of a diagnosis, as SVG that stands in a page.

Each is drawn twice, for a wide column and for a phone, so that its text is never scaled away; the page shows one.
"""

import html
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import StringIO

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.text import Text

from fits.diagnosis._result import Diagnosis, Experiment, RunView
from fits.io._length import length_unit
from fits.plots._residual_views import VIEWS
from fits.plots._style import label, panels, thinned, verbatim
from fits.stats._noise import stretches
from microid.effects import card_of

# Colours of Okabe and Ito, which colour-blind readers can tell apart.
BEFORE, AFTER = "#d55e00", "#0072b2"
ASIDE, INK = "#f4f1e4", "#22272e"
# Width of the column and of a phone, in CSS pixels over 96.
_WIDE_in, _NARROW_in = 7.3, 3.4
# Points of all curves of one picture together.
_POINTS = 5000


@dataclass(frozen=True)
class Picture:
    """One picture in both widths, and what it is about, in words, for those who cannot see it."""

    wide: str
    narrow: str


def _drawn(name: str, words: str, draw: Callable[[float], Figure], zoom: bool = False) -> Picture:
    return Picture(*(_svg(draw(width), f"{name}-{width:.0f}-", words, zoom) for width in (_WIDE_in, _NARROW_in)))


def _svg(picture: Figure, prefix: str, words: str, zoom: bool = False) -> str:
    """Write a figure as one `svg` element whose names do not meet those of other figures.

    With `zoom` the page's script finds there what it stretches of each panel, and from where to where that goes.
    """
    for k, axes in enumerate(picture.axes if zoom else ()):
        axes.xaxis.set_gid(f"ticks{k}")
        for n, each in enumerate([*axes.lines, *axes.patches]):
            each.set_gid(f"zoom{k}-{n}")
    spans = f' data-spans="{[[*map(float, axes.get_xlim())] for axes in picture.axes]}"' if zoom else ""
    for axes in picture.axes:
        axes.tick_params(width=0.6, length=2.5, color=INK)
        axes.spines[:].set(linewidth=0.6, color=INK)
    for each in picture.findobj(Text):
        each.set_fontsize(8.5)
        if each.get_color() in ("black", "k"):
            each.set_color(INK)
    out = StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": prefix}):
        nothing = {"Date": None, "Creator": None, "Format": None, "Type": None}
        picture.savefig(out, format="svg", metadata=nothing, transparent=True)
    text = out.getvalue()
    text = re.sub(r'( id="|href="#|url\(#)', lambda found: found[1] + prefix, text[text.index("<svg") :])
    # A tenth of a point is finer than any screen.
    digits = re.compile(r"(\d\.\d)\d+")
    text = re.sub(r' d="[^"]*"', lambda found: digits.sub(r"\1", found[0]).replace("\n", ""), text)
    for size in ("width", "height"):
        text = re.sub(rf'(<svg[^>]*?) {size}="[^"]*"', r"\1", text, count=1)
    return text.replace("<svg", f'<svg role="img" aria-label="{html.escape(words)}"{spans}', 1).strip()


def shown_runs(runs: Sequence[RunView]) -> list[RunView]:
    """Choose the six runs with the largest residuals, in their order: nobody scrolls through more."""
    runs = [run for run in runs if run.time_s.size > 1]
    sizes = [np.nanmean(run.before_um**2) if np.isfinite(run.before_um).any() else 0.0 for run in runs]
    keep = sorted(np.argsort(sizes)[::-1][:6])
    return [runs[k] for k in keep]


def residuals(diagnosis: Diagnosis) -> Picture | None:
    """Residual of the plain and the extended stage over time; None where there are no runs."""
    words = "Residual over time before and after the extension, with the band of the noise"
    if not shown_runs(diagnosis.runs):
        return None
    return _drawn("residuals", words, lambda width_in: residual_figure(diagnosis, width_in), True)


def residual_figure(diagnosis: Diagnosis, width_in: float = _WIDE_in) -> Figure:
    """The same as a figure of a width; the band is that of two standard deviations of the noise."""
    runs = shown_runs(diagnosis.runs)
    # Where there is room, as many as show when a stretch is enlarged.
    points = max((3 if width_in == _WIDE_in else 1) * _POINTS // (2 * len(runs)), 200)
    # What is left out at the start of a run, as its past is unknown, may be off by much more than all that counts.
    shown = [(run.before_um, run.after_um)[side][np.argmax(run.fitted) :] for run in runs for side in (0, 1)]
    highest_um = max((float(np.nanmax(np.abs(one))) for one in shown if np.isfinite(one).any()), default=0.0)
    highest_um = max(highest_um, 2.2 * diagnosis.noise_um if np.isfinite(diagnosis.noise_um) else 0.0)
    per_um, unit = _scale(highest_um)
    height_in = 0.55 + 1.35 * len(runs) + (0.5 if len(runs) == 1 else 0)
    picture, grid = panels(width_in, height_in, len(runs), sharey=True, squeeze=False)
    for axes, run in zip(grid[:, 0], runs, strict=True):
        # Shaded is what was not used for the fit; single samples without a value are not what was held out.
        for begin, end in stretches(~np.asarray(run.fitted, bool)):
            if end - begin > 0.01 * run.time_s.size:
                axes.axvspan(run.time_s[begin], run.time_s[end - 1], color=ASIDE, linewidth=0)
        band = 2.0 * diagnosis.noise_um * per_um
        curves = [(run.before_um, BEFORE, 0.8, "plain stage")]
        curves += [(run.after_um, AFTER, 0.7, "with what was found")] if diagnosis.causes else []
        for values, colour, line, name in curves:
            keep = thinned(values, points)
            axes.plot(run.time_s[keep], per_um * values[keep], color=colour, linewidth=line, label=name)
        if np.isfinite(band):
            # Over the curves, which else hide the band, and as light as in the key.
            axes.axhspan(-band, band, color=INK, alpha=0.16, linewidth=0, zorder=2.5)
            for edge in (-band, band):
                axes.axhline(edge, color=INK, linewidth=0.6, linestyle=(0, (4, 3)), zorder=3)
        axes.set_xlim(run.time_s[0], run.time_s[-1])
        if highest_um > 0:
            axes.set_ylim(-1.08 * per_um * highest_um, 1.08 * per_um * highest_um)
        axes.set_title(verbatim(run.source, int(12 * width_in)), loc="left")
        label(axes, y=f"residual ({unit})" if len(runs) < 3 or width_in == _WIDE_in else unit)
    label(grid[-1, 0], "time (s)")
    return picture


def _scale(highest_um: float) -> tuple[float, str]:
    """How many of the unit of an axis are in 1 µm, and the unit as it is drawn."""
    per_um, unit = length_unit(highest_um)
    return per_um, unit.replace("u", "µ")


def _in_fit(run: RunView) -> RunView:
    """A run from its first to its last fitted sample, without residuals where others are between."""
    at = np.flatnonzero(run.fitted)
    part = slice(at[0], at[-1] + 1)
    before_um, after_um = (np.where(run.fitted, each, np.nan)[part] for each in (run.before_um, run.after_um))
    driven = run.time_s[part], run.voltage_V[part], run.measured_um[part]
    return RunView(run.source, *driven, before_um, after_um, run.fitted[part])


def fingerprint(diagnosis: Diagnosis, name: str, number: int) -> tuple[Picture, str] | None:
    """The residual against the variable that shows an effect, and what is drawn in words; None where runs do not."""
    runs = [_in_fit(run) for run in diagnosis.runs if run.fitted.any()]
    sides: list[tuple[str, Callable[[RunView], np.ndarray]]] = [(BEFORE, lambda run: run.before_um)]
    if diagnosis.causes:
        sides.append((AFTER, lambda run: run.after_um))
    for view in (VIEWS[card_of(name).view if name else "voltage"], VIEWS["voltage"]):
        try:
            seen = [(colour, curve) for colour, of in sides for curve in view.look(runs, of)]
            break
        except ValueError:
            continue
    else:
        return None

    per_um, unit = _scale(max(float(np.abs(curve.y).max()) for _, curve in seen))

    def draw(width_in: float) -> Figure:
        picture, axes = panels(width_in, 2.7 if width_in == _WIDE_in else 2.5)
        if not view.spectrum:
            axes.axhline(0.0, color=INK, linewidth=0.5)
        for colour, curve in seen:
            if curve.low is not None and curve.high is not None:
                axes.fill_between(
                    curve.x, per_um * curve.low, per_um * curve.high, color=colour, alpha=0.14, linewidth=0
                )
            axes.plot(curve.x, per_um * curve.y, "--" if curve.downwards else "-", color=colour, linewidth=1.3)
        if view.logarithmic:
            axes.set_xscale("log")
        if view.spectrum:
            axes.set_yscale("log")
        label(axes, view.x_label, f"{view.y_label} ({unit}{view.per})")
        return picture

    words = f"{view.y_label.capitalize()} against {view.x_label}, before and after the extension"
    caption = view.caption
    if diagnosis.causes and name and card_of(name).statistic:
        caption += " What is part of the noise stays in both: no model takes it away."
    return _drawn(f"fingerprint{number}", words, draw), caption


def program(ahead: Experiment) -> Picture | None:
    """The voltage of the next experiment; None where it has no samples."""
    if ahead.time_s.size < 2:
        return None

    def draw(width_in: float) -> Figure:
        picture, axes = panels(width_in, 2.0)
        keep = thinned(ahead.voltage_V, _POINTS // 2)
        axes.plot(ahead.time_s[keep], ahead.voltage_V[keep], color=INK, linewidth=0.9)
        axes.set_xlim(ahead.time_s[0], ahead.time_s[-1])
        label(axes, "time (s)", "voltage (V)")
        return picture

    return _drawn("program", "Voltage of the next experiment over time", draw, True)
