"""Options of fits and diagnoses as axes: numbers of levels and initial states, as words in the results."""

import json
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from _command import refused, run
from _sweeps import parsed

from fits import DataError, fit
from fits.loop._design import branch_table
from fits.loop._known import known_samples
from fits.loop._prior import roughness
from fits.loop._run import initial_state
from fits.plots._sweep import _edges, _heat, _logarithmic, _parallel, _Rows, _wrapped
from fits.sweeps._run import run_sweep
from fits.sweeps._show import open_sweep
from fits.sweeps._spec import chunk_count, compute_chunk
from fits.sweeps._types import Block
from fits.sweeps.kinds.fit import fit_batch
from microid import Staircase

HEAD = """
schema = "microid.sweep/1"
kind = "{kind}"
seed = {seed}
initial = "negative"
[{kind}]
{options}
[program]
shape = "decay"
samples = 200
interval_s = 0.02
offset_V = 60.0
amplitude_V = 60.0
frequency_Hz = 1.0
"""
LEVELS = '[[axis]]\nparameter = "fit.levels"\nvalues = {levels}\n'
INITIAL = '[[axis]]\nparameter = "{kind}.initial"\nvalues = {words}\n'
WORDS = ["unknown", "negative", "positive", "demagnetised"]


def text(seed, *axes, kind="fit", options=""):
    return HEAD.format(kind=kind, seed=seed, options=options) + "".join(axes)


def words(chosen, kind="fit"):
    return INITIAL.format(kind=kind, words=json.dumps(chosen))


def records_of(sweep, rows):
    relative = tuple(axis.parameter for axis in sweep.plan.axes if axis.relative)
    block = Block(sweep.plan.values(rows), relative, rows, sweep.plan.repeat_of(rows), sweep.seed)
    return sweep.job.records.records(block)


def batch_of(record, levels, initial, smoothness=0.01, holdout=0.2):
    """The same regression in a batch that holds one record throughout."""
    v, n = record.voltage_V, len(record)
    limits = v.min(), v.max()
    known = np.ones(n, dtype=bool) if initial != "unknown" else known_samples(v, *limits)
    weight = known & (np.arange(n) < n - round(holdout * n))
    start = initial_state(initial, *limits)
    numbers = (v, record.displacement_um, weight.astype(float), np.array(limits), np.array(smoothness))
    rows = (jnp.asarray(np.stack([each] * 32)) for each in numbers)
    start = Staircase(jnp.stack([start.extremes_V] * 32), jnp.stack([jnp.asarray(start.count)] * 32))
    return fit_batch(levels, jnp.asarray(branch_table(levels)), roughness(levels), *rows, start)


@pytest.mark.study
def test_rows_of_a_batch_have_their_own_levels_and_initial_state(seed):
    sweep = parsed(text(seed, words(WORDS), LEVELS.format(levels=[5, 8])))
    found = compute_chunk(sweep, 0)
    assert set(found.reasons) == {""}
    assert found.outputs["fit.initial"].tolist() == [word for word in WORDS for _ in range(2)]
    assert found.outputs["levels"].tolist() == found.outputs["fit.levels"].tolist() == [5, 8] * 4
    for row, record in enumerate(records_of(sweep, np.arange(8))):
        alone = batch_of(record, (5, 8)[row % 2], WORDS[row // 2])
        assert found.outputs["noise_um"][row] == pytest.approx(float(alone["noise_um"][0]), rel=1e-10)
        assert found.outputs["offset_um"][row] == pytest.approx(float(alone["offset_um"][0]), rel=1e-10)
        assert found.outputs["loops_um"][row] > 0
    # The stage began at negative saturation, and what begins with another memory leaves more.
    noise = dict(zip(WORDS, found.outputs["noise_um"][1::2], strict=True))
    assert noise["negative"] < 0.9 * noise["positive"]


@pytest.mark.study
def test_rows_do_not_depend_on_chunks_and_words_are_kept_as_such(tmp_path, seed):
    noise = '[[axis]]\nparameter = "records.noise_um"\nlow = 0.01\nhigh = 0.1\ncount = 20\n'
    whole = text(seed, noise, words(["negative", "unknown"]), LEVELS.format(levels=[5, 8]))
    sweeps = [parsed(f"{whole}[run]\nchunk_rows = {rows}\n") for rows in (32, 64)]
    assert [chunk_count(sweep) for sweep in sweeps] == [3, 2]
    for sweep, name in zip(sweeps, ("a", "b"), strict=True):
        run_sweep(sweep, str(tmp_path / name))
    tables = [pd.read_parquet(tmp_path / name / "results.parquet") for name in ("a", "b")]
    assert tables[0].equals(tables[1])
    assert tables[0]["fit.initial"].tolist() == ["negative", "negative", "unknown", "unknown"] * 20
    found = open_sweep(tmp_path / "a")
    assert "fit.initial" in found.coords
    chosen = found["noise_um"].where(found["fit.initial"] == "unknown", drop=True)
    assert chosen.sizes["row"] == 40
    plots = ("--plots", tmp_path / "plots")
    best = json.loads(run("sweep", "show", tmp_path / "a", "--best", "noise_um", *plots, "--json").stdout)["best"]
    assert best["rows"][0]["fit.initial"] in ("negative", "unknown")
    # Parallel coordinates, and a map of each pair of three axes.
    assert len(list((tmp_path / "plots").iterdir())) == 5
    assert "fit.initial negative" in run("sweep", "show", tmp_path / "a", "--best", "noise_um").stdout


def test_rows_one_by_one_ask_for_their_own_options(monkeypatch, seed):
    asked = []

    def fitted(records, **options):
        asked.append(options)
        figures = SimpleNamespace(e_rms_pct=1.0, e_max_pct=2.0)
        report = SimpleNamespace(offset_um=0.0, in_sample=figures, held_out=None)
        weights = np.tril(np.arange(options["levels"] ** 2.0).reshape(2 * [options["levels"]]))
        return SimpleNamespace(runs=[report], noise_um=0.1, weights_um=weights)

    monkeypatch.setattr("fits.sweeps.kinds.fit.fit", fitted)
    options = 'method = "one_by_one"\n'
    sweep = parsed(text(seed, words(["negative", "unknown"]), LEVELS.format(levels=[6, 9]), options=options))
    for chunk in range(chunk_count(sweep)):
        assert set(compute_chunk(sweep, chunk).reasons) == {""}
    assert [(each["initial"], each["levels"]) for each in asked] == [
        (word, levels) for word in ("negative", "unknown") for levels in (6, 9)
    ]
    kept = parsed(text(seed, words(["negative"]), options=f"{options}levels = 6\nweights = true\n"))
    weights = compute_chunk(kept, 0).outputs["weights_um"]
    assert weights.shape == (1, 21)
    assert weights[0, :4].tolist() == [0.0, 6.0, 7.0, 12.0]


@pytest.mark.study
def test_a_row_one_by_one_is_that_of_fit(seed):
    options = 'method = "one_by_one"\n'
    sweep = parsed(text(seed, words(["unknown", "negative"]), LEVELS.format(levels=[6, 9]), options=options))
    (record,) = records_of(sweep, np.array([2]))
    found, alone = compute_chunk(sweep, 2), fit([record], levels=6, initial="negative")
    assert found.reasons == ("",)
    assert found.outputs["noise_um"] == [alone.noise_um]
    assert found.outputs["offset_um"] == [alone.runs[0].offset_um]


def test_diagnoses_ask_for_their_own_options(monkeypatch, seed):
    asked = []

    def diagnose(records, **options):
        asked.append((options["initial"], options["holdout"], options["false_alarm"]))
        raise DataError("enough")

    monkeypatch.setattr("fits.diagnosis._diagnose.diagnose", diagnose)
    holdout = '[[axis]]\nparameter = "diagnose.holdout"\nvalues = [0.1, 0.3]\n'
    sweep = parsed(text(seed, words(["positive", "unknown"], "diagnose"), holdout, kind="diagnose"))
    found = [compute_chunk(sweep, row) for row in range(4)]
    assert asked == [(word, share, 0.01) for word in ("positive", "unknown") for share in (0.1, 0.3)]
    assert found[3].outputs["diagnose.initial"].tolist() == ["unknown"]


def test_a_list_may_hold_words(seed):
    listed = text(seed, '[list]\nfile = "rows.csv"\n')
    sweep = parsed(listed, rows=b"fit.initial,fit.levels\npositive,5\n unknown ,8\n")
    assert sweep.plan.values(np.arange(2))["fit.initial"].tolist() == [2, 0]
    with pytest.raises(DataError, match=r"rows.csv, line 3: expected one of .* did you mean negative"):
        parsed(listed, rows=b"fit.initial,fit.levels\npositive,5\nnegativ,8\n")
    with pytest.raises(DataError, match=r"rows.csv, line 2: expected 2 values, found \"positive\""):
        parsed(listed, rows=b"fit.initial,fit.levels\npositive\n")
    with pytest.raises(DataError, match=r"rows.csv: fit.levels is a whole number, found 5.5"):
        parsed(listed, rows=b"fit.initial,fit.levels\npositive,5.5\n")


@pytest.mark.study
def test_numbers_of_levels_out_of_bounds_fail_as_rows(seed):
    found = compute_chunk(parsed(text(seed, LEVELS.format(levels=[5, 64]))), 0)
    assert found.reasons[0] == ""
    assert found.reasons[1].startswith("fit.levels = 64 lies outside its bounds, 4 to 32")


@pytest.mark.parametrize(
    ("axis", "sentence"),
    [
        ('parameter = "fit.initial"\nvalues = ["negativ"]', "did you mean negative?"),
        (
            'parameter = "fit.initial"\nvalues = [1]',
            "expected one of unknown, negative, positive, demagnetised, found 1",
        ),
        ('parameter = "fit.initial"\nvalues = "negative"', "expected a list of words"),
        (
            'parameter = "fit.initial"\nlow = 0\nhigh = 3\ncount = 4',
            "is a choice of words, which are listed; give values",
        ),
        ('parameter = "fit.initial"\nmean = 0\nsd = 3', "is a choice of words, which are listed; give values"),
        ('parameter = "fit.initial"\nrelative = true\nvalues = ["unknown"]', "which no factor changes"),
        ('parameter = "fit.levels"\nvalues = [5, 6.5]', "fit.levels is a whole number, found 6.5; give whole values"),
        ('parameter = "fit.levels"\nvalues = ["many"]', 'expected a finite number, found "many"'),
        ('parameter = "fit.levels"\nlow = 4\nhigh = 9\ncount = 3', "is a whole number, found 6.5"),
        ('parameter = "fit.levels"\nlow = 4\nhigh = 9', "is a whole number, which is not drawn; give values"),
        ('parameter = "fit.levels"\nrelative = true\nvalues = [0.5]', "which no factor changes"),
        ('parameter = "fit.method"\nvalues = ["batch"]', 'there is no parameter "fit.method"'),
        ('parameter = "fit.levels"\nvalues = [5]\n[fit]\nweights = true', "leave out one of the two"),
        ('parameter = "fit.levels"\nvalues = [5]\n[fit]\nsamples = 300', "the samples of their program"),
        ('parameter = "fit.levels"\nvalues = [5]\n[fit]\nmethod = "one_by_one"\nsmoothness = 0.1', "leave it out"),
        ('parameter = "fit.levels"\nvalues = [3, 40]', "all values lie outside the bounds of fit.levels, 4 to 32;"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_sentence(tmp_path, axis, sentence):
    file = tmp_path / "sweep.toml"
    file.write_text(f'schema = "microid.sweep/1"\nkind = "fit"\n[[axis]]\n{axis}\n')
    refused(run("sweep", file, "--out", tmp_path / "out"), sentence)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("values", "logarithmic"),
    [([6.0, 8.0, 10.0], False), (np.geomspace(5, 500, 7), True), ([0.0, 1.0, 2.0], False), ([1.0, 2.0, 9.0], False)],
)
def test_heat_maps_have_a_cell_around_each_value(values, logarithmic):
    values = np.asarray(values)
    assert _logarithmic(values) == logarithmic
    shown = np.log10(values) if logarithmic else values
    assert np.histogram(np.repeat(shown, 3), _edges(shown))[0].tolist() == [3] * len(values)


@pytest.mark.parametrize("values", [[10.0, 20.0, 40.0, 60.0], [1.0, 10.0, 100.0]])
def test_few_values_of_a_heat_map_have_their_ticks(values):
    """Cells reach from 5 to 70 for 10 to 60, which is nowhere else to be seen."""
    swept = {"program.amplitude_V": np.repeat(values, 2), "mechanics.gain": np.tile([1.0, 2.0], len(values))}
    heat, _ = _heat(_Rows(swept, {}, "width_pct", np.arange(2.0 * len(values))), tuple(swept)).axes
    assert heat.get_xticks().tolist() == values
    assert [text.get_text() for text in heat.get_xticklabels()] == [f"{value:g}" for value in values]
    assert heat.get_yticks().tolist() == [1.0, 2.0]
    assert heat.get_xticks(minor=True).size == 0


def test_rows_that_failed_are_drawn_as_such_and_names_whole():
    swept = {"mechanics.gain": np.repeat([1.0, 2.0], 4), "program.shape": np.tile([0, 1, 0, 1], 2)}
    values = np.array([np.nan, 2.0, 3.0, 5.0, 6.0, 7.0, np.nan, 9.0])
    rows = _Rows(swept, {"program.shape": np.array(["sine", "triangle"])}, "width_pct", values)
    heat, bar = _heat(rows, tuple(swept)).axes
    (failed,) = heat.lines
    assert failed.get_xydata().tolist() == [[1.0, 0.0], [2.0, 0.0]]
    # Means by hand: what failed has no part in them.
    np.testing.assert_allclose(heat.collections[0].get_array(), [[3.0, 6.0], [3.5, 8.0]])
    assert bar.get_ylabel() == "mean width_pct"
    axes, key = _parallel(rows).axes
    assert key.get_ylabel() == "width_pct"
    said = [text.get_text() for text in axes.texts]
    for words in ("mechanics.gain", "program.shape", "width_pct", "sine", "triangle", "1", "2", "9"):
        assert words in said
    red = [line for line in axes.lines if line.get_color() is not None and tuple(line.get_color()[:1]) == (0.8,)]
    assert len(red) == 3  # two rows, and the key
    # Few values have a tick each, and none stands between them.
    assert "1.5" not in said
    assert _wrapped("hysteresis.density.packed_um", 12) == "hysteresis.\ndensity.\npacked_um"


def test_cells_without_a_row_are_said_to_be_white():
    swept = {"mechanics.gain": np.array([1.0, 2.0, 2.0]), "program.bias_V": np.array([0.0, 0.0, 5.0])}
    for keep, words in ((slice(3), "white: no row"), (slice(2), ""), (slice(1, 3), "")):
        some = {name: values[keep] for name, values in swept.items()}
        rows = _Rows(some, {}, "width_pct", np.array([1.0, 2.0, 3.0])[keep])
        assert _heat(rows, tuple(some)).axes[0].get_title("left") == words


def test_help_shows_the_options_of_a_sweep():
    told = run("sweep", "--help").stdout
    for option in ("--out DIR", "--resume", "--cluster", "--json", "--quiet"):
        assert option in told


def test_logarithmic_parameters_have_logarithmic_coordinates_and_failures_at_the_rim_are_whole():
    swept = {"controller.gain": np.geomspace(5, 500, 9), "mechanics.gain": np.arange(9.0)}
    rows = _Rows(swept, {}, "width_pct", np.append(np.arange(8.0), np.nan))
    axes, _ = _parallel(rows).axes
    assert {"5", "15.8", "50", "158", "500"} <= {text.get_text() for text in axes.texts}
    np.testing.assert_allclose([line.get_ydata()[0] for line in axes.lines[:9]], np.linspace(0, 1, 9))
    (failed,) = _heat(rows, tuple(swept)).axes[0].lines
    assert not failed.get_clip_on()
