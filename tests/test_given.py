"""Runs given in Python: one or several, as records, tables or names of files; and those that no fit can use."""

import ast
import re

import jax
import numpy as np
import pandas as pd
import pytest
from _models import random_model

import fits
from fits.io._given import records_given
from fits.io._inspect import inspect_table
from fits.io._units import parse_columns

TIME_s = 0.01 * np.arange(300)
VOLTAGE_V = 50 - 50 * np.cos(6 * TIME_s)
COLUMNS = {"time_s": TIME_s, "voltage_V": VOLTAGE_V, "displacement_um": 0.1 * VOLTAGE_V}
ENTRIES = (fits.fit, fits.fit_stage, fits.fit_slow, fits.diagnose)


def record(**changed):
    return fits.Record(**(COLUMNS | changed), source="run.csv")


def forms(folder):
    path = folder / "run.csv"
    frame = pd.DataFrame(COLUMNS)
    frame.to_csv(path, index=False)
    return {"record": record(), "frame": frame, "mapping": COLUMNS, "path": path, "name": str(path)}


def test_one_run_of_any_kind_is_taken_and_so_are_several(tmp_path):
    for name, run in forms(tmp_path).items():
        for count, given in ((1, run), (1, [run]), (2, (run, run)), (2, iter([run, run]))):
            found = records_given(given)
            assert len(found) == count, name
            assert np.array_equal(found[0].voltage_V, VOLTAGE_V), name
            assert np.array_equal(found[-1].displacement_um, COLUMNS["displacement_um"]), name
    xarray = pytest.importorskip("xarray")
    assert len(records_given(xarray.Dataset({name: ("row", each) for name, each in COLUMNS.items()}))[0]) == 300


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.__name__)
def test_runs_that_cannot_be_used_are_refused_in_a_sentence(entry):
    assert jax.config.read("jax_enable_x64")
    empty, commanded = record()[:0], record(displacement_um=None)
    for given, held, words in (
        (empty, 0.2, "run.csv: there are no samples"),
        ([record(), empty], 0.2, "run.csv: there are no samples"),
        (record(), [empty], "run.csv: there are no samples"),
        (commanded, 0.2, "run.csv: a displacement column is needed"),
        (record(), commanded, "run.csv: a displacement column is needed"),
        (7, 0.2, "found int"),
        ([], 0.2, "there is no record"),
    ):
        with pytest.raises(fits.DataError, match=words):
            entry(given, holdout=held)


@pytest.mark.parametrize(
    ("name", "at", "value", "words"),
    [
        (
            "displacement_um",
            5,
            np.nan,
            r"run.csv: displacement_um\[5\]: expected a finite number, found nan",
        ),
        ("voltage_V", 7, np.inf, r"voltage_V\[7\]: expected a finite number, found inf"),
        ("time_s", 9, 0.08, r"time_s\[9\]: expected a time after 0.08 s, found 0.08 s; sort the samples"),
    ],
)
def test_a_record_refuses_what_no_model_fits(name, at, value, words):
    odd = COLUMNS[name].copy()
    odd[at] = value
    with pytest.raises(fits.DataError, match=words):
        record(**{name: odd})


def test_a_reference_refuses_them_too():
    with pytest.raises(fits.DataError, match=r"displacement_um\[0\]: expected a finite number"):
        fits.Reference([0.0, 1.0], [np.nan, 1.0])
    with pytest.raises(fits.DataError, match=r"time_s\[1\]: expected a time after 0 s"):
        fits.Reference([0.0, 0.0], [0.0, 1.0])


FRAME = pd.DataFrame(COLUMNS)


def turned(frame):
    return frame.assign(displacement_um=-frame["displacement_um"])


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (FRAME.rename(columns={"voltage_V": "drive"}), r"fits\.read_table\(data, {'voltage_V': 'drive\[UNIT\]'}\)"),
        (FRAME.rename(columns={"displacement_um": "displacement"}), "{'displacement_um': 'displacement\\[UNIT\\]'}"),
        (FRAME.assign(voltage_V=np.nan), r'with fits\.read_table\(data, missing="drop"\)'),
    ],
)
def test_refusals_of_a_frame_say_what_to_write_in_python(frame, words):
    """And what they say works, once the unit stands there."""
    for entry in (fits.read_table, fits.fit):
        with pytest.raises(fits.DataError, match=words) as caught:
            entry(frame)
        assert "--" not in str(caught.value)
    if said := re.search(r"read_table\(data, ({.*?})\)", str(caught.value)):
        stated = ast.literal_eval(said[1].replace("UNIT", "V" if "drive" in frame else "um"))
        np.testing.assert_array_equal(fits.read_table(frame, stated).voltage_V, VOLTAGE_V)


def test_warnings_of_a_frame_say_what_to_write_in_python(tmp_path):
    (warning,) = fits.read_table(turned(FRAME)).warnings
    assert "fits.read_table(data, {'displacement_um': '-displacement_um'})" in warning
    turned(FRAME).to_csv(tmp_path / "run.csv", index=False)
    (warning,) = fits.read_table(tmp_path / "run.csv").warnings
    call = f"fits.read_table({str(tmp_path / 'run.csv')!r}, {{'displacement_um': '-displacement_um'}})"
    assert call in warning
    (again,) = fits.read_runs([tmp_path / "run.csv"])
    assert again.warnings[0] == warning.replace(call, "fits.read_runs(data, {'displacement_um': '-displacement_um'})")
    FRAME.rename(columns={"voltage_V": "drive"}).to_csv(tmp_path / "other.csv", index=False)
    for entry in (fits.read_table, fits.fit):
        with pytest.raises(fits.DataError, match=r"other\.csv', {'voltage_V': 'drive\[UNIT\]'}\)"):
            entry(tmp_path / "other.csv")


def test_columns_are_named_as_for_the_option_or_by_numbers(tmp_path):
    path = tmp_path / "numbers.csv"
    FRAME.to_csv(path, index=False, header=False)
    for columns in ("1,2,3", {"time_s": 1, "voltage_V": 2, "displacement_um": 3}):
        np.testing.assert_array_equal(fits.read_table(path, columns).voltage_V, VOLTAGE_V)
    with pytest.raises(fits.DataError, match="missing: expected refuse or drop, found 'skip'"):
        fits.read_table(FRAME, missing="skip")


def test_programs_and_references_are_given_as_runs_are(tmp_path):
    law = random_model(np.random.default_rng(1))
    ends = float(law.density.lower_V), float(law.density.upper_V)
    frame = pd.DataFrame({"time_s": TIME_s, "voltage_V": np.interp(VOLTAGE_V, [0, 100], ends)})
    frame.to_csv(tmp_path / "program.csv", index=False)
    played = fits.predict(law, fits.Record(TIME_s, frame["voltage_V"], None)).displacement_um
    for program in (frame, tmp_path / "program.csv", dict(frame)):
        np.testing.assert_allclose(fits.predict(law, program).displacement_um, played, rtol=0, atol=1e-12)
    wanted = {"time_s": TIME_s, "displacement_um": played}
    found = fits.compensate(law, wanted, clip=True)
    np.testing.assert_allclose(found.displacement_um, played, atol=1e-6)


def test_a_model_is_given_as_itself_as_a_fit_or_by_the_name_of_its_file(tmp_path):
    found = fits.fit(FRAME, levels=8)
    fits.save_model(tmp_path / "m.json", found.model, found.uncertainty, fits.fit_report(found))
    wanted = {"time_s": TIME_s, "displacement_um": found.runs[0].offset_um + 5 + 3 * np.sin(TIME_s)}
    voltage_V = fits.compensate(found.model, wanted, clip=True).voltage_V
    alone = fits.predict(found.model, FRAME, uncertainty=found.uncertainty)
    for model in (found.model, found, fits.load_model(tmp_path / "m.json"), tmp_path / "m.json"):
        np.testing.assert_array_equal(fits.compensate(model, wanted, clip=True).voltage_V, voltage_V)
        assert fits.export_c(model, tmp_path / "c")[0].exists()
        if model is not found.model:
            np.testing.assert_array_equal(fits.predict(model, FRAME).displacement_sd_um, alone.displacement_sd_um)
    first, *others = fits.draw_plants(found, 3)
    assert len(others) == 2
    assert fits.relay_start(tmp_path / "m.json", 1e-3) == fits.relay_start([first], 1e-3)
    with pytest.raises(fits.DataError, match="expected a Preisach model or a stage"):
        fits.relay_start([first, 3], 1e-3)
    for model, words in ((tmp_path / "none.json", "none.json: no such file"), (3, "found a int")):
        for use in (lambda one: fits.compensate(one, wanted), lambda one: fits.predict(one, FRAME)):
            with pytest.raises(fits.DataError, match=words):
                use(model)


def test_a_fraction_may_be_of_any_type_and_runs_without_a_name_get_one():
    plain = fits.fit(FRAME, levels=8, holdout=0.5).runs[0]
    for half in (np.float32(0.5), np.array(0.5)):
        assert fits.fit(FRAME, levels=8, holdout=half).runs[0] == plain
    for several in (np.array([0.2, 0.3]), [0.2, 0.3]):
        with pytest.raises(fits.DataError, match="holdout: expected one fraction, or runs, found a list of numbers"):
            fits.fit(FRAME, holdout=several)
    still = fits.Record(TIME_s, VOLTAGE_V, np.zeros(300))
    with pytest.raises(fits.DataError, match=r"^run 1: nothing moves"):
        fits.fit(still)
    with pytest.raises(fits.DataError, match=r"^run 1 and run 2 hold the same samples"):
        fits.fit([fits.Record(**COLUMNS), fits.Record(**COLUMNS)])


def test_a_record_says_what_it_holds_and_is_drawn():
    warned = fits.Record(TIME_s, VOLTAGE_V, None, {"temperature_degC": TIME_s}, "run.csv", ("a gap.",))
    lines = repr(warned).splitlines()
    assert lines[0] == "run.csv: 300 samples in 2.99 s, 100 Hz"
    assert [line.split() for line in lines[1:3]] == [
        ["voltage_V", "0", "to", f"{VOLTAGE_V.max():.6g}"],
        ["temperature_degC", "0", "to", "2.99"],
    ]
    assert lines[3:] == ["Note: a gap."]
    assert warned._repr_html_() == f"<pre>{warned.summary()}</pre>"
    assert repr(warned[:0]) == "run.csv: no samples"
    for one, panels in ((warned, 1), (record(), 2), (fits.Reference(TIME_s, VOLTAGE_V), 1)):
        picture = one.plot()
        assert len(picture.axes) == panels
        np.testing.assert_array_equal(picture.axes[-1].lines[0].get_xdata(), TIME_s)


def test_what_holds_no_numbers_is_no_record():
    with pytest.raises(fits.DataError, match="voltage_V: expected an array of numbers, found something else"):
        record(voltage_V=["high"] * 300)
    for complex_V in (1j * VOLTAGE_V, list(1j * VOLTAGE_V), VOLTAGE_V + 0j):
        with pytest.raises(fits.DataError, match="voltage_V: expected real numbers, found complex ones"):
            record(voltage_V=complex_V)


def test_one_column_is_no_run():
    for column, name in ((pd.Series(VOLTAGE_V), "Series"), (VOLTAGE_V, "ndarray")):
        with pytest.raises(fits.DataError, match=f"mapping of arrays, found {name}; give one of these, such as"):
            fits.fit(column)


def test_a_program_without_samples_is_refused():
    empty = fits.Record(np.zeros(0), np.zeros(0), None, source="none.csv")
    model = random_model(np.random.default_rng(1))
    with pytest.raises(fits.DataError, match=r"none\.csv: there are no samples"):
        fits.predict(model, empty)
    with pytest.raises(fits.DataError, match="the reference: there are no samples"):
        fits.compensate(model, fits.Reference(np.zeros(0), np.zeros(0)))


def test_one_row_is_inspected(tmp_path):
    path = tmp_path / "one.csv"
    path.write_text("time_s,voltage_V,displacement_um\n0,0,0\n")
    assert inspect_table(path).rows == 1


def test_words_beside_the_first_rows_are_no_header(tmp_path):
    rows = [f",,{t!r},{v!r},{y!r}" for t, v, y in zip(*(map(float, COLUMNS[name]) for name in COLUMNS), strict=True)]
    rows[:2] = [f"{words}{row[1:]}" for words, row in zip(["Record Length,300", "Points,300"], rows, strict=False)]
    path = tmp_path / "scope.csv"
    path.write_text("\n".join(rows))
    found = fits.read_csv(path, columns=parse_columns("time_s=3[s],voltage_V=4[V],displacement_um=5[um]"))
    np.testing.assert_array_equal(found.voltage_V, VOLTAGE_V)
