"""Tornado plots and the curves of Fig. 7, against gains in plain NumPy."""

import dataclasses

import numpy as np
import pytest
from _command import whole_picture
from _gain_formulas import ARGUMENTS, TABLE_1, gains, slopes
from matplotlib.text import Text

import fits
import fits.plots._machining
from fits.plots._machining import _spaced

LEG = {"alpha1": "la1", "alpha2": "la2", "alpha3": "la3"}
AXES = ("z", "alpha", "gamma")
CLAIMS = (
    fits.Claim(("x", "y"), "is elsewhere", "agree", 1.0, "%", "Not drawn."),
    fits.Claim(("z",), "la2 rises, then falls", "disagree", 0.1, "%", "Off a line by 0.1 %. The rest is too long."),
    fits.Claim(("alpha", "beta"), "l5 can be neglected", "agree", 1.0, "%", "Place 5, with -0.024 %."),
    fits.Claim(("z", "alpha", "beta"), "t4 is odd", "partly", 1.0, "", "The same of both."),
)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Figures and files of the paper's stage, and of one with tolerances of its own."""
    return {
        "paper": draw(fits.paper_design(), (*AXES, "beta"), tmp_path_factory.mktemp("paper")),
        "other": draw(other(), ("alpha", "z"), tmp_path_factory.mktemp("other")),
    }


def other():
    design = fits.paper_design()
    return dataclasses.replace(design, tolerance=design.tolerance | {"t4": 0.05, "l5": 0.0}, guides=6.0)


def draw(design, axes, folder):
    figures = []
    save = fits.plots._style.save

    def remember(picture, path):
        figures.append(picture)
        return save(picture, path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fits.plots._style.save", remember)
        patch.setattr(fits.plots._machining, "paper_claims", lambda _: CLAIMS)
        paths = fits.plot_sensitivity(design, fits.sensitivities(design, axes), folder)
    return paths, figures


def panels(figure):
    return [axes for axes in figure.axes if axes.axison]


def exact(axis, name, error):
    """Relative change of the gain."""
    return gains(axis, TABLE_1 | {name: TABLE_1[name] + error}) / gains(axis, TABLE_1) - 1


def full_stroke(axis):
    scale = 1e6 if axis in ("alpha", "gamma") else 1.0
    return scale * 40 * gains(axis, TABLE_1, piezo=50.0)


def test_files_are_whole_pictures(drawn):
    for paths, _ in drawn.values():
        assert [path.name for path in paths] == ["tornado.png", "machining_error.png"]
        for path in paths:
            whole_picture(path)


def test_curves_are_those_of_the_exact_gains(drawn):
    curves = panels(drawn["paper"][1][1])
    assert len(curves) == len(AXES)
    for axes, axis in zip(curves, AXES, strict=True):
        names = ARGUMENTS[axis]
        found = [line for line in axes.lines if len(line.get_xdata()) > 2]
        assert len(found) == len(names)
        width_mm = 0.02
        wanted = np.array(
            [
                full_stroke(axis) * exact(axis, name, share * width_mm / TABLE_1.get(LEG.get(name), 1.0))
                for name in names
                for share in (-1, 0.5, 1)
            ]
        ).reshape(-1, 3)
        ys = np.array([line.get_ydata()[[0, 30, 40]] for line in found])
        for line in found:
            np.testing.assert_allclose(line.get_xdata()[[0, 20, 40]], [-width_mm, 0, width_mm], atol=1e-15)
        order = np.argsort(wanted[:, 2])
        np.testing.assert_allclose(ys, wanted[order], rtol=5e-5, atol=1e-9 * full_stroke(axis))
        unit = "µrad" if axis in ("alpha", "gamma") else "µm"
        assert axes.get_ylabel() == f"output error ({unit})"
        labels = {
            text.get_text().split()[0]: float(text.get_text().split()[1].replace("\N{MINUS SIGN}", "-"))
            for text in axes.texts
        }
        assert len(labels) == len(names)
        np.testing.assert_allclose(sorted(labels.values()), sorted(wanted[:, 2]), rtol=6e-3)


def test_bars_are_of_first_order_and_marks_exact(drawn):
    column = panels(drawn["paper"][1][0])
    for axes, axis in zip(column, AXES, strict=True):
        names = ARGUMENTS[axis]
        tolerance = np.array([0.02 / TABLE_1.get(LEG.get(name), 1.0) for name in names])
        changes = 100 * slopes(axis, TABLE_1, names) * tolerance / gains(axis, TABLE_1)
        ranked = np.argsort(-np.abs(changes), kind="stable")
        plus, minus = axes.containers
        np.testing.assert_allclose([bar.get_width() for bar in plus], changes[ranked], rtol=1e-6)
        np.testing.assert_allclose([bar.get_width() for bar in minus], -changes[ranked], rtol=1e-6)
        marks = [line.get_xdata() for line in axes.lines if line.get_marker() == "D"]
        for mark, sign in zip(marks, (1, -1), strict=True):
            wanted = [100 * exact(axis, names[i], sign * tolerance[i]) for i in ranked]
            np.testing.assert_allclose(np.sort(mark), np.sort(wanted), rtol=1e-6)


def test_no_two_labels_lie_upon_each_other(drawn):
    for _, figures in drawn.values():
        for figure in figures:
            figure.draw_without_rendering()
            for axes in panels(figure):
                # Of a label without its leader.
                boxes = [Text.get_window_extent(text) for text in axes.texts if text.get_text()]
                ticks = [text.get_window_extent() for text in axes.get_yticklabels()]
                for k, box in enumerate(boxes):
                    # Of two lines of text the ascent of one may reach into the descent of the other.
                    inside = box.shrunk(0.98, 0.8)
                    assert not any(inside.overlaps(each.shrunk(0.98, 0.8)) for each in (*boxes[k + 1 :], *ticks))


def test_the_papers_words_stand_below_the_papers_stage_alone(drawn):
    paper, elsewhere = (figures[1] for _, figures in drawn.values())
    z, alpha, gamma = ([text.get_text() for text in axes.texts] for axes in paper.axes if not axes.axison)
    symbols = ["$l_{a2}$ rises, then falls", "$l_{5}$ can be neglected", "$t_{4}$ is odd"]
    heading = "The paper's reading of its Fig. 7, and this stage:"
    assert z == [heading, rf"$\bf{{disagree}}$: {symbols[0]}", "   Off a line by 0.1 %"]
    assert alpha == [
        heading,
        rf"$\bf{{agree}}$: {symbols[1]}",
        "   Place 5, with \N{MINUS SIGN}0.024 %",
        rf"$\bf{{partly}}$: {symbols[2]}",
        "   The same of both",
    ]
    assert gamma == []
    assert not [text for axes in elsewhere.axes if not axes.axison for text in axes.texts]


def test_each_curve_ends_at_its_own_tolerance(drawn):
    alpha = panels(drawn["other"][1][1])[0]
    ends_mm = sorted(line.get_xdata()[-1] for line in alpha.lines if len(line.get_xdata()) > 2)
    np.testing.assert_allclose(ends_mm, [0, 0.02, 0.02, 0.02, 0.05])
    assert alpha.get_xlim() == pytest.approx((-0.05, 0.05))


def test_a_stage_without_tolerances_and_a_folder_that_is_missing(tmp_path):
    design = dataclasses.replace(fits.paper_design(0.0), guides=6.0)
    report = fits.sensitivities(design, ("z",))
    assert len(fits.plot_sensitivity(design, report, tmp_path)) == 2
    with pytest.raises(fits.DataError, match="missing"):
        fits.plot_sensitivity(design, report, tmp_path / "missing")


def test_labels_move_apart_by_no_more_than_they_must(rng):
    wanted = np.sort(rng.normal(size=8))
    found = _spaced(wanted, 0.5)
    assert np.all(np.diff(found) > 0.5 - 1e-12)
    # The mean of labels that push each other stays; those far from all others do not move.
    assert found.mean() == pytest.approx(wanted.mean())
    np.testing.assert_allclose(_spaced(10 * np.arange(4.0), 0.5), 10 * np.arange(4.0))


def test_a_panel_by_itself_has_no_letter_and_no_room_for_words_that_are_not_there(tmp_path, monkeypatch):
    design = other()
    _, (_, several) = draw(design, ("alpha", "z"), tmp_path)
    assert [axes.get_title(loc="left")[:4] for axes in panels(several)] == ["(a) ", "(b) "]
    monkeypatch.setattr(fits.plots._machining, "paper_claims", lambda _: ())
    figures = []
    monkeypatch.setattr("fits.plots._style.save", lambda picture, path: figures.append(picture) or path)
    fits.plot_sensitivity(design, fits.sensitivities(design, ("x",)), tmp_path)
    (alone,) = panels(figures[1])
    assert alone.get_title(loc="left").startswith("x: full stroke")
    figures[1].draw_without_rendering()
    # In inches from the foot to the letters of the axis.
    assert alone.get_tightbbox().y0 / figures[1].dpi < 0.25
