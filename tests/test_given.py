"""Runs given in Python: one or several, as records, tables or names of files; and those that no fit can use."""

import jax
import numpy as np
import pandas as pd
import pytest

import fits
from fits.io._given import records_given

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
