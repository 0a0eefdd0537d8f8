"""Pictures of machining errors (Fig. 7 of the paper), of measuring errors (its Fig. 8), and of error budgets."""

import re
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from fits.io._errors import AnyPath
from fits.io._printable import plain
from fits.io._record import Reference
from fits.machining._budget import Budget
from fits.machining._claims import Claim, paper_claims
from fits.machining._design import Design, lever_mm, paper_design
from fits.machining._idle import IdleNoise
from fits.machining._sensitivity import AxisSensitivity, SensitivityReport, gains_at
from fits.plots._style import DARK, LIGHT, MEASURED, MODEL, WIDE_in, curve, figure, label, legend, save_all, verbatim
from microid import kinetostatics as ks

AXIS_SIGNS: dict[ks.Axis, str] = {"alpha": r"$\alpha$", "beta": r"$\beta$", "gamma": r"$\gamma$"}
UNIT_SIGNS = {"um": "µm", "urad": "µrad"}
# Odd, so that the nominal dimensions are among the steps.
_STEPS = 41
_LINE_in = 0.125
_SMALL_pt = 6
_CHARACTERS = 64
_DIMENSION = re.compile(
    rf"\b(?:{'|'.join({name for motion in ks.MOTIONS.values() for name in motion.dimensions})})\b"
)
# A thin line from a label to its curve; without `patchA` it would end at the frame of the label.
_LEADER: dict[str, Any] = {"arrowstyle": "-", "color": "0.5", "linewidth": 0.4, "patchA": None}
_LEADER |= {"shrinkA": 1.5, "shrinkB": 0, "relpos": (0, 0.5)}


@dataclass(frozen=True)
class _Panel:
    """One motion, or two that are alike: sensitivities of the first, the names of all, and curves by dimension.

    A curve is the relative change of the output over errors from minus to plus one tolerance, shape `(s,)`.
    """

    axis: AxisSensitivity
    title: str
    curves: dict[str, NDArray[np.float64]]


def plot_sensitivity(design: Design, report: SensitivityReport, folder: AnyPath, *, form: str = "png") -> list[Path]:
    """Draw which dimensions matter, and the output error over the machining error of each (Fig. 7).

    Where the design has the paper's dimensions, what the paper reads in its figure is judged below each panel. The
    report is that of the design, from `sensitivities`. `tornado` and `machining_error` are written into an existing
    folder, in the form `png` (200 dots per inch), `svg` or `pdf`; a `DataError` says if they cannot be.
    """
    panels = _panels(report, lambda axis: _curves(design, axis))
    paper = paper_design()
    same = all(float(design.geometry[name]) == float(paper.geometry[name]) for name in ks.DIMENSIONS)
    same = same and design.guides == paper.guides and design.tolerance == paper.tolerance
    claims = paper_claims(design) if same else ()
    pictures = {"tornado": _tornado(panels), "machining_error": _machining_error(design, panels, claims)}
    return save_all(pictures, folder, form)


def tornado(report: SensitivityReport) -> Figure:
    """Draw which dimensions matter, to first order."""
    return _tornado(_panels(report, lambda _: {}))


def _panels(report: SensitivityReport, curves: Callable[[ks.Axis], dict[str, NDArray[np.float64]]]) -> list[_Panel]:
    groups = report.alike()
    titles = (", ".join(AXIS_SIGNS.get(each.axis, each.axis) for each in axes) for axes in groups)
    return [_Panel(axes[0], title, curves(axes[0].axis)) for axes, title in zip(groups, titles, strict=True)]


def _curves(design: Design, axis: ks.Axis) -> dict[str, NDArray[np.float64]]:
    names = ks.MOTIONS[axis].dimensions
    shares = np.linspace(-1, 1, _STEPS)
    errors = np.concatenate([np.outer(shares, row) for row in np.diag([design.tolerance[name] for name in names])])
    gains = gains_at(design, axis, errors).reshape(len(names), _STEPS)
    nominal = gains[0, _STEPS // 2]
    return {name: gains[i] / nominal - 1 for i, name in enumerate(names)}


def _tornado(panels: Sequence[_Panel]) -> Figure:
    rows = [len(panel.axis.dimensions) for panel in panels]
    picture = figure(WIDE_in, 0.75 + 0.17 * sum(rows) + 0.3 * len(rows))
    column = np.atleast_1d(picture.subplots(len(panels), 1, sharex=True, height_ratios=[n + 0.6 for n in rows]))
    for axes, panel in zip(column, panels, strict=True):
        _draw_bars(axes, panel)
        axes.tick_params(axis="x", labelbottom=axes is column[-1])
    reach = 1.06 * max(np.abs(panel.axis.dimensions[0].relative_change_pct) for panel in panels) or 1.0
    column[-1].set_xlim(-reach, reach)
    label(column[-1], x="change of the output at a fixed elongation of the piezo (%)")
    legend(picture, column[:1])
    return picture


def _draw_bars(axes: Axes, panel: _Panel) -> None:
    effects = panel.axis.dimensions
    places = range(len(effects))
    changes = np.array([effect.relative_change_pct for effect in effects])
    # Of a report without its design there are none.
    ends = [panel.curves[effect.name][[0, -1]] for effect in effects if panel.curves]
    exact = 100 * np.array(ends).reshape(-1, 2)
    for name, values, color in (("plus", changes, "0.45"), ("minus", -changes, "0.9")):
        words = f"{name} one tolerance, first order"
        axes.barh(places, values, 0.72, color=color, label=words, linewidth=0.4, edgecolor=DARK)
    marks: dict[str, Any] = {"markersize": 3, "color": "0.0", "markeredgewidth": 0.6}
    for name, values, color in (("plus", exact[:, 1], "0.0"), ("minus", exact[:, 0], "1.0")):
        words = f"{name}, exact" if panel.curves else ""
        axes.plot(values, places[: len(values)], "D", label=words, markerfacecolor=color, **marks)
    axes.axvline(0, color=DARK, linewidth=0.6)
    axes.set_ylim(len(effects) - 0.4, -0.6)
    units = ["mrad" if effect.unit == "rad" else "µm" for effect in effects]
    named = [f"{symbol(e.name)} ± {1e3 * e.tolerance:.3g} {unit}" for e, unit in zip(effects, units, strict=True)]
    axes.set_yticks(places, named)
    beside: dict[str, Any] = {"transform": axes.get_yaxis_transform(), "ha": "right", "va": "center", "fontsize": 7}
    for place, effect in zip(places, effects, strict=True):
        axes.text(1.10, place, _signed(f"{effect.relative_change_pct:+.3f} %"), **beside)
        axes.text(1.20, place, _signed(f"{100 * effect.share_of_variance:.1f} %"), **beside)
    for x, words in ((1.10, "change"), (1.20, "share of\nvariance")):
        axes.text(x, 1.0, words, transform=axes.transAxes, ha="right", va="bottom", fontsize=_SMALL_pt)
    axis = panel.axis
    title = f"{panel.title}: root sum of squares {axis.rss_pct:.2f} %, worst case {axis.worst_case_pct:.2f} %"
    label(axes, title=title, size_pt=8)
    axes.tick_params(axis="y", length=0)


def _machining_error(design: Design, panels: Sequence[_Panel], claims: Sequence[Claim]) -> Figure:
    """Fig. 7: panels in two columns, each with its claims below."""
    columns = min(2, len(panels))
    lines = [_claim_lines(panel, claims) for panel in panels]
    heights = []
    for k in range(0, len(panels), columns):
        # Where the paper says nothing there is nothing below.
        heights += [2.3, max(0.01, _LINE_in * max(map(len, lines[k : k + columns])))]
    width_in = WIDE_in * (1 if columns > 1 else 0.55)
    picture = figure(width_in, sum(heights) + 0.55 * len(heights) / 2 + 0.25, gap=0.06)
    grid = picture.add_gridspec(len(heights), columns, height_ratios=heights)
    for k, panel in enumerate(panels):
        row, column = divmod(k, columns)
        axes = picture.add_subplot(grid[2 * row, column])
        _draw_curves(axes, design, panel)
        stroke = f"{plain(panel.axis.stroke)} {UNIT_SIGNS[panel.axis.output_unit]}"
        letter = f"({'abcdef'[k]}) " if len(panels) > 1 else ""
        label(axes, title=f"{letter}{panel.title}: full stroke {stroke}", size_pt=8)
        below = picture.add_subplot(grid[2 * row + 1, column])
        below.set_axis_off()
        for number, (words, color) in enumerate(lines[k]):
            place: dict[str, Any] = {"xytext": (0, -72 * _LINE_in * number), "textcoords": "offset points"}
            below.annotate(
                words, (0, 1), **place, xycoords="axes fraction", va="top", fontsize=_SMALL_pt, color=color
            )
    kinds = [picture.axes[0].plot([], [], style, color="0.0", linewidth=0.8)[0] for style in ("-", "--")]
    names = ["length", "angle, by the error across its leg"]
    picture.legend(kinds, names, loc="outside upper center", ncols=2, frameon=False)
    return picture


def _draw_curves(axes: Axes, design: Design, panel: _Panel) -> None:
    unit = UNIT_SIGNS[panel.axis.output_unit]
    effects = sorted(panel.axis.dimensions, key=lambda effect: panel.curves[effect.name][-1])
    curves = {effect.name: panel.axis.stroke * panel.curves[effect.name] for effect in effects}
    ends_mm = {effect.name: effect.tolerance * lever_mm(design.geometry, effect.name) for effect in effects}
    widest_mm = max(ends_mm.values()) or 1.0
    reach = 1.08 * max(float(np.abs(curve).max()) for curve in curves.values()) or 1.0
    axes.set_xlim(-widest_mm, widest_mm)
    axes.set_ylim(-reach, reach)
    axes.axhline(0, color=LIGHT, linewidth=0.6)
    axes.axvline(0, color=LIGHT, linewidth=0.6)
    # Labels are apart by a part of the panel's height.
    heights = _spaced(np.array([curve[-1] for curve in curves.values()]), 0.085 * 2 * reach)
    for effect, height in zip(effects, heights, strict=True):
        curve, end_mm = curves[effect.name], ends_mm[effect.name]
        style = "-" if effect.unit == "mm" else "--"
        leads = effect.name == panel.axis.dimensions[0].name
        axes.plot(end_mm * np.linspace(-1, 1, _STEPS), curve, style, color="0.0", linewidth=1.4 if leads else 0.8)
        axes.annotate(
            f"{symbol(effect.name)}  {_signed(f'{curve[-1]:+#.3g}'.rstrip('.'))}",
            (end_mm, curve[-1]),
            (1.07, height),
            textcoords=axes.get_yaxis_transform(),
            va="center",
            fontsize=7,
            arrowprops=_LEADER,
        )
    label(axes, "machining error (mm)", f"output error ({unit})")


def _spaced(wanted: NDArray[np.float64], gap: float) -> NDArray[np.float64]:
    """Places nearest to increasing ones, at least a gap from each other."""
    steps = gap * np.arange(len(wanted))
    return np.asarray(isotonic_regression(wanted - steps).x) + steps


def _claim_lines(panel: _Panel, claims: Sequence[Claim]) -> list[tuple[str, str]]:
    """What the paper says of a motion with our verdict in bold and the figures for it: lines and their colours."""
    lines: list[tuple[str, str]] = []
    for claim in claims:
        # One on several motions stands below the last of them.
        if panel.axis.axis in claim.axes and (panel.axis.axis == claim.axes[0]) == (len(claim.axes) < 3):
            reason = claim.reason.partition(". ")[0].rstrip(".")
            room = " " * len(f"{claim.verdict}: ")
            first, *more = textwrap.wrap(claim.statement, _CHARACTERS, initial_indent=room, subsequent_indent="   ")
            lines.append((rf"$\bf{{{claim.verdict}}}$: {_with_symbols(first[len(room) :])}", DARK))
            lines += [(_with_symbols(line), DARK) for line in more]
            lines += [(_with_symbols(f"   {line}"), "0.4") for line in textwrap.wrap(reason, _CHARACTERS - 3)]
    return [("The paper's reading of its Fig. 7, and this stage:", DARK), *lines] if lines else []


def _with_symbols(words: str) -> str:
    """Words with the symbols of dimensions and axes."""
    found = _DIMENSION.sub(lambda name: symbol(name[0]), _signed(words))
    return re.sub(r"\balpha\b", r"$\\alpha$", found)


def _signed(words: str) -> str:
    """Words with minus signs before numbers, where there were hyphens."""
    return re.sub(r"-(?=\d)", "\N{MINUS SIGN}", words)


def symbol(name: str) -> str:
    """Symbol of a dimension as the paper prints it."""
    stem = name.rstrip("0123456789")
    index = name[len(stem) :]
    stem, index = ("l", f"a{index}") if stem == "la" else (stem, index)
    stem = rf"\{stem}" if stem == "alpha" else stem
    return f"${stem}_{{{index}}}$" if index else f"${stem}$"


def plot_budget(found: Budget, folder: AnyPath, *, form: str = "png") -> list[Path]:
    """Draw the parts of the worst case of each axis in percent of its stroke, and the root sum of squares.

    `budget` is written into an existing folder, in the form `png` (200 dots per inch), `svg` or `pdf`; a `DataError`
    says if it cannot be.
    """
    return save_all({"budget": budget_bars(found)}, folder, form)


def budget_bars(found: Budget) -> Figure:
    """The picture of `plot_budget`."""
    axes = list(found.axes.values())
    places = range(len(axes))
    picture = figure(WIDE_in, 0.9 + 0.34 * len(axes))
    bars = picture.subplots()
    ends = [0.0] * len(axes)
    parts = [(abs(axis.driving), axis.machining_worst_case, axis.measuring or 0.0) for axis in axes]
    shades = {"driving": "0.3", "machining": "0.65", "measuring": "0.95"}
    for (part, color), sizes in zip(shades.items(), zip(*parts, strict=True), strict=True):
        widths = [100 * size / axis.stroke for size, axis in zip(sizes, axes, strict=True)]
        bars.barh(places, widths, 0.62, ends, color=color, edgecolor=DARK, linewidth=0.4, label=f"{part}, largest")
        ends = [end + width for end, width in zip(ends, widths, strict=True)]
    squares = [100 * axis.root_sum_square / axis.stroke for axis in axes]
    mark: dict[str, Any] = {"markersize": 4, "color": "1.0", "markeredgecolor": "0.0", "markeredgewidth": 0.8}
    bars.plot(squares, places, "D", label="root sum of squares of all", **mark)
    for place, axis in enumerate(axes):
        unit = UNIT_SIGNS[axis.output_unit]
        words = f"{plain(axis.worst_case, 3)} {unit} of {plain(axis.stroke)} {unit}"
        words += "" if axis.measuring is not None else ", sensor unknown"
        bars.annotate(words, (ends[place], place), (4, 0), textcoords="offset points", va="center", fontsize=7)
    bars.set_xlim(0, 1.35 * max(ends))
    bars.set_ylim(len(axes) - 0.4, -0.6)
    bars.set_yticks(places, [AXIS_SIGNS.get(axis.axis, axis.axis) for axis in axes])
    bars.tick_params(axis="y", length=0)
    label(bars, x="error (% of the stroke)")
    legend(picture, [bars])
    return picture


def plot_idle(reference: Reference, noise: IdleNoise, folder: AnyPath, *, form: str = "png") -> list[Path]:
    """Draw an idle record with its histogram, its spectrum with the lines found, and its Allan deviation.

    The noise is that of the record, from `idle_noise`. `idle` is written into an existing folder, in the form `png`
    (200 dots per inch), `svg` or `pdf`; a `DataError` says if it cannot be.
    """
    picture = figure(WIDE_in, 4.8, gap=0.08)
    grid = picture.add_gridspec(2, 8)
    readings = picture.add_subplot(grid[0, :7])
    histogram = picture.add_subplot(grid[0, 7], sharey=readings)
    spectrum, allan = picture.add_subplot(grid[1, :4]), picture.add_subplot(grid[1, 4:])
    _draw_readings(readings, histogram, reference, noise)
    _draw_spectrum(spectrum, noise)
    _draw_allan(allan, noise)
    legend(picture, (readings,))
    return save_all({"idle": picture}, folder, form)


def _draw_readings(axes: Axes, margin: Axes, reference: Reference, noise: IdleNoise) -> None:
    values, half = reference.displacement_um, noise.error_um()
    curve(axes, reference.time_s, values, "readings", **MEASURED | {"linewidth": 0.4})
    for more, style, name in ((-half, ":", ""), (0.0, "-", "offset"), (half, ":", "offset ± measuring error")):
        for each in (axes, margin):
            each.axhline(noise.mean_um + more, color=DARK, linestyle=style, linewidth=0.8, label=name)
    label(axes, "time (s)", "displacement (µm)", verbatim(reference.source) or "readings")
    margin.hist(values, _edges(noise, values), orientation="horizontal", color=LIGHT)
    margin.tick_params(labelleft=False)
    margin.set_xticks([])
    label(margin, "count")


def _edges(noise: IdleNoise, values: np.ndarray) -> list[float]:
    """Bins of the histogram: of whole quanta where readings have one, so that no bin is empty by construction."""
    low, high = float(values.min()), float(values.max())
    width = (high - low) / min(40.0, np.sqrt(len(values)))
    if noise.resolution_um is None:
        return np.arange(low, high + width, width).tolist()
    width = noise.resolution_um * np.ceil(width / noise.resolution_um)
    return np.arange(low - noise.resolution_um / 2, high + width, width).tolist()


def _draw_spectrum(axes: Axes, noise: IdleNoise) -> None:
    density = noise.asd_um_per_rtHz
    curve(axes, noise.frequency_Hz, density, **MODEL)
    axes.set(xscale="log", yscale="log")
    at_Hz = [line.frequency_Hz for line in noise.lines[:5]]
    if at_Hz:
        tops = [float(density[np.argmin(np.abs(noise.frequency_Hz - each))]) for each in at_Hz]
        axes.plot(at_Hz, tops, "v", color=DARK, markersize=3.5)
        for x, y in zip(at_Hz, tops, strict=True):
            axes.annotate(f"{x:.4g} Hz", (x, y), (3, 1), textcoords="offset points", fontsize=6)
    label(axes, "frequency (Hz)", "amplitude density (µm/√Hz)", "spectrum")


def _draw_allan(axes: Axes, noise: IdleNoise) -> None:
    time_s, deviation, sd = noise.averaging_s, noise.adev_um, noise.adev_sd_um
    axes.loglog(time_s, deviation, **MODEL | {"linewidth": 1.0})
    seen = deviation > 0
    low = np.maximum(deviation - sd, 0.1 * deviation)
    axes.fill_between(time_s[seen], low[seen], (deviation + sd)[seen], color=LIGHT, linewidth=0)
    axes.plot(time_s, deviation[0] * np.sqrt(time_s[0] / time_s), ":", color=DARK, linewidth=0.8, label="white noise")
    axes.plot(noise.bias_instability_s, noise.bias_instability_um, "o", color=DARK, markersize=3, label="minimum")
    axes.legend(frameon=False)
    label(axes, "averaging time (s)", "Allan deviation (µm)", "Allan deviation")
