import itertools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from _command import whole_picture
from _diagnosis import diagnosis

import fits
import microid
from fits import DataError, FitResult, FitStatus, LevelTrial, Record, RunReport, Uncertainty
from fits.io._summary import AbstractSummary
from fits.loop._design import Grid
from fits.loop._run import prepare_run
from fits.plots._fit import _response, linear_gain, linear_parts, predicted_um
from fits.plots._results import picture_of
from fits.plots._style import legend, thinned
from fits.stage._start import MeasuredResponse

LOWER_V, UPPER_V, LEVELS = 0.0, 100.0, 9


@pytest.fixture(scope="module")
def model():
    lower, upper = jnp.asarray(LOWER_V), jnp.asarray(UPPER_V)
    density = microid.densities.GridDensity.start(lower, upper, LEVELS, jnp.asarray(15.0), jax.random.key(0))
    return microid.Preisach(density, microid.Reversible(jnp.full(LEVELS, 0.2), lower, upper), jnp.asarray(3.0))


def record(rng, model, voltage, offset_um=0.0, source="run.csv", start=None):
    noise = rng.normal(scale=0.05, size=len(voltage))
    displacement = np.asarray(eqx.filter_jit(model)(jnp.asarray(voltage), start)) + offset_um + noise
    return Record(np.arange(len(voltage)) / 100, voltage, displacement, source=source)


def result_of(model, reports, rng):
    grid = Grid(jnp.asarray(LOWER_V), jnp.asarray(UPPER_V), LEVELS)
    columns = jnp.asarray(rng.normal(scale=1e-3, size=(2, grid.columns)))
    uncertainty = Uncertainty(columns, jnp.zeros(2), jnp.asarray(0.01), grid)
    trial = LevelTrial(LEVELS, 0.05)
    return FitResult(model, uncertainty, FitStatus.CONVERGED, (), tuple(reports), None, 1.0, (trial,))


def report(source, offset_um=3.0, held_out=True, start=None):
    errors = fits.errors(np.array([0.0, 1.0]), np.array([0.1, 1.0]))
    start = microid.negative_saturation(LOWER_V) if start is None else start
    return RunReport(source, offset_um, errors, errors if held_out else None, 0, start, 10.0, 10.0, {}, 0.05, 1.0, 1)


def waves(samples, cycles):
    return UPPER_V / 2 * (1 - np.cos(np.linspace(0, 2 * np.pi * cycles, samples)))


def test_a_fit_is_drawn_in_four_pictures_that_fit_columns(tmp_path, rng, model):
    settings = dict(mpl.rcParams)
    measured = record(rng, model, waves(3000, 3))
    result = result_of(model, [report("run.csv")], rng)
    paths = fits.plot_fit(result, [measured], tmp_path, holdout=0.3)
    assert sorted(path.name for path in paths) == ["density.png", "everett.png", "heldout.png", "loops.png"]
    assert sorted(paths) == sorted(tmp_path.iterdir())
    for path in paths:
        width_mm = whole_picture(path).shape[1] / 200 * 25.4
        assert min(abs(width_mm - 90), abs(width_mm - 180)) < 1
    assert dict(mpl.rcParams) == settings
    assert plt.get_fignums() == []


def test_nothing_held_out_is_not_drawn(tmp_path, rng, model):
    result = result_of(model, [report("run.csv", held_out=False)], rng)
    paths = fits.plot_fit(result, [record(rng, model, waves(500, 2))], tmp_path, holdout=0.0)
    assert sorted(path.name for path in paths) == ["density.png", "everett.png", "loops.png"]


def test_several_runs_and_an_unknown_start(tmp_path, rng, model, monkeypatch):
    drawn = {}

    def remember_curves(picture, path):
        drawn[path.stem] = [[line.get_xydata() for line in axes.lines] for axes in picture.axes]
        return path

    monkeypatch.setattr("fits.plots._style.save", remember_curves)
    start = microid.demagnetised(LOWER_V, UPPER_V)
    first = record(rng, model, np.concatenate([np.linspace(50, 100, 400), waves(1600, 2)]), 5.0, "a.csv", start)
    others = [record(rng, model, waves(9000, 2), 0.0, f"{name}.csv") for name in "bcd"]
    aside = [record(rng, model, waves(700, 1.4), -2.0, "e.csv")]
    reports = [report("a.csv", 8.0, start=start), *(report(f"{name}.csv") for name in "bcd"), report("e.csv", 1.0)]
    fits.plot_fit(result_of(model, reports, rng), [first, *others], tmp_path, holdout=aside)

    # Three of four runs side by side, values above errors; the curves lie within the noise of each other.
    assert len(drawn["loops"]) == 6
    fitted, measured = drawn["loops"][0]
    assert len(measured) == 2000
    assert np.abs(measured[:, 1] - first.displacement_um).max() == 0
    assert np.abs(fitted[:, 1] - measured[:, 1]).max() < 6 * 0.05
    error = drawn["loops"][3][1]
    assert len(error) == 2000  # what the past before them adds is estimated
    assert 0.03 < error[:, 1].std() < 0.07
    measured, predicted = drawn["heldout"][0]
    assert np.array_equal(measured[:, 0], aside[0].time_s)
    assert np.abs(predicted[:, 1] - measured[:, 1]).max() < 6 * 0.05
    error, upper, lower, with_noise, _ = drawn["heldout"][1]
    assert np.array_equal(upper[:, 1], -lower[:, 1])
    assert np.all(upper[:, 1] > 1.95 * 0.01)
    assert np.mean(np.abs(error[:, 1]) < with_noise[:, 1]) > 0.9


def test_measurement_and_model_look_the_same_in_all_pictures(tmp_path, rng, model, monkeypatch):
    """Also in what a fit shows by itself, where the slowest run lies under the model."""
    styles = []

    def remember_styles(picture, path):
        lines = [line for axes in picture.axes for line in axes.lines if line.get_label() in ("measured", "model")]
        styles.extend((line.get_label(), line.get_color()) for line in lines)
        return path

    monkeypatch.setattr("fits.plots._style.save", remember_styles)
    slow = record(rng, model, waves(3000, 2))
    result = result_of(model, [report("run.csv")], rng)
    fits.plot_fit(result, [slow], tmp_path, holdout=0.3)
    fast = record(rng, model, waves(200, 2), offset_um=5.0)
    picture = replace(result, runs=(report("fast.csv", 8.0), report("run.csv")), records=(fast, slow)).plot()
    remember_styles(picture, None)
    assert sorted(set(styles)) == [("measured", "0.65"), ("model", "0.0")]
    assert len(styles) == 6
    measured = picture.axes[0].lines[0].get_xydata()
    np.testing.assert_array_equal(measured[:, 0], slow.voltage_V)
    # In the offset of the first run, as the model is.
    np.testing.assert_allclose(measured[:, 1], slow.displacement_um + 5.0, atol=1e-9)
    assert [text.get_text() for text in picture.legends[0].get_texts()] == ["measured", "model"]
    lines_Hz = np.linspace(10, 200, 9)
    seen = MeasuredResponse(lines_Hz, linear_gain(fits.default_stage(), lines_Hz), np.full(9, 0.99))
    for axes in _response(fits.default_stage(), "fast.csv", seen).axes:
        assert (axes.lines[0].get_color(), axes.lines[0].get_linewidth()) == ("0.0", 0.5)
        (shades,) = {tuple(row) for row in axes.collections[0].to_rgba(axes.collections[0].get_array())}
        assert 0.4 < shades[0] < 0.7


def test_a_run_that_is_missing_and_a_folder_that_is(tmp_path, rng, model):
    measured = record(rng, model, waves(500, 2))
    result = result_of(model, [report("run.csv")], rng)
    with pytest.raises(ValueError, match="the result has 1 runs, and 2"):
        fits.plot_fit(result, [measured, measured], tmp_path)
    with pytest.raises(DataError, match="does not exist"):
        fits.plot_fit(result, [measured], tmp_path / "none")
    assert list(tmp_path.iterdir()) == []


def test_a_vanishing_density_is_drawn(tmp_path, rng, model):
    empty = eqx.tree_at(lambda m: m.density.packed_um, model, jnp.zeros_like(model.density.packed_um))
    result = replace(result_of(empty, [report("run.csv")], rng))
    assert len(fits.plot_fit(result, [record(rng, empty, waves(500, 2))], tmp_path)) == 4


def test_thinning_keeps_every_extreme(rng):
    values = rng.normal(size=rng.integers(100_000, 200_000))
    kept = thinned(values)
    assert len(kept) < 7000
    assert np.all(np.diff(kept) > 0)
    assert {0, len(values) - 1} <= set(kept)
    edges = np.linspace(0, len(values), 301).astype(int)
    for low, high in itertools.pairwise(edges):
        inside = kept[(kept >= low) & (kept < high)]
        # Stretches do not end at these edges: what is kept is at least as extreme as all but a stretch at either end.
        inner = values[low + 70 : high - 70]
        assert values[inside].max() >= inner.max()
        assert values[inside].min() <= inner.min()
    short = rng.normal(size=10)
    assert np.array_equal(thinned(short), np.arange(10))


def test_every_result_with_a_summary_is_drawn_by_itself(rng, model, tmp_path):
    """The figure is the caller's: nothing is written, and no window of Matplotlib's is open."""
    results = {each for each in AbstractSummary.__subclasses__() if each.__module__.startswith("fits.")}
    assert results <= set(picture_of.registry)
    design = fits.paper_design()
    stage = fits.default_stage().swap("hysteresis", model)
    fitted = result_of(model, [report("run.csv")], rng)
    for number, result in enumerate(
        (diagnosis(rng), fits.sensitivities(design, ("x",)), fitted, replace(fitted, model=stage))
    ):
        picture = result.plot()
        assert isinstance(picture, mpl.figure.Figure)
        picture.savefig(tmp_path / f"{number}.png", dpi=200)
        whole_picture(tmp_path / f"{number}.png")
    assert plt.get_fignums() == []
    loop, gain = picture.axes
    # The static gain of driver and mechanics is 1 far below the resonance, and falls beyond it.
    low, *_, high = gain.lines[0].get_ydata()
    assert (low, high < 0.02) == (pytest.approx(1.0, abs=1e-3), True)
    np.testing.assert_allclose(loop.lines[0].get_ydata()[0], 3.0, atol=1e-9)


@pytest.mark.parametrize(("form", "first"), [("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_pictures_are_written_as_vectors_on_demand(rng, model, tmp_path, form, first):
    measured = record(rng, model, waves(500, 2))
    paths = fits.plot_fit(result_of(model, [report("run.csv")], rng), [measured], tmp_path, holdout=0.3, form=form)
    assert [path.suffix for path in paths] == [f".{form}"] * 4
    assert all(path.read_bytes().startswith(first) for path in paths)


def test_a_legend_shows_a_dot_that_can_be_seen():
    picture, axes = plt.subplots()
    axes.plot([0, 1], ".", markersize=0.8, label="measured")
    axes.plot([0, 1], "x", markersize=6, label="failed")
    legend(picture, (axes,))
    assert [line.get_markersize() for line in picture.legends[0].get_lines()] == [2.5, 6]
    plt.close(picture)


def test_a_stage_is_drawn_only_where_its_history_is_known(rng, model):
    """Its free motions, fitted where they have died away, were drawn 70 mm high before."""
    stage = microid.Stage.of(
        hysteresis=model, lag=microid.Lag(jnp.asarray(2e-3)), mechanics=microid.Mechanics(150.0, 0.14)
    )
    time_s = np.arange(2000) / 1500
    voltage_V = 50 + np.minimum(time_s, 0.4) * 120 * np.sin(2 * np.pi * 4 * time_s)
    moved_um = np.asarray(eqx.filter_jit(stage)(jnp.asarray(time_s), jnp.asarray(voltage_V)))
    run = prepare_run(
        Record(time_s, voltage_V, moved_um + rng.normal(scale=1e-3, size=2000)), (LOWER_V, UPPER_V), "unknown", 0.0
    )
    known = run.known
    assert 0 < known.sum() < len(known)
    assert not known[0]
    drawn = predicted_um(stage, run)
    assert np.isnan(drawn[~known]).all()
    np.testing.assert_allclose(drawn[known], run.displacement_um[known], atol=0.1)


def test_what_moves_in_a_stage_is_named_as_it_is(model):
    driver, lag, mechanics = microid.Driver(1e-3), microid.Lag(1e-3), microid.Mechanics(150.0, 0.1)
    stages = {
        "driver and mechanics": {"driver": driver, "hysteresis": model, "mechanics": mechanics},
        "lag and mechanics": {"hysteresis": model, "lag": lag, "mechanics": mechanics},
        "static gain": {"hysteresis": model, "sensor": microid.Sensor()},
    }
    assert [linear_parts(microid.Stage.of(**parts)) for parts in stages.values()] == [*stages]
