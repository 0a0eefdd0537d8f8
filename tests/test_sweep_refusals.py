"""What is refused in one sentence: wrong texts, wrong folders, broken results, options in any order."""

import copy
import json
import shutil
import subprocess
import sys
import tomllib

import numpy as np
import pytest
from _command import refused, run
from _sweeps import parsed, small

from fits import DataError
from fits.sweeps import _run
from fits.sweeps._run import run_sweep
from fits.sweeps._show import open_sweep, summarise
from fits.sweeps._spec import chunk_rows, parse_sweep, read_sweep
from fits.sweeps._store import opened
from fits.sweeps._types import Rows
from fits.sweeps.kinds import examples

EXAMPLES = {kind: file.read_text() for kind, file in examples().items()}
HEAD = 'schema = "microid.sweep/1"\nkind = "simulate"\n'
LIST = HEAD + '[list]\nfile = "rows.csv"\n'
CONTROL = (
    HEAD.replace("simulate", "control") + '[controller]\n{controller}\n[reference]\nshape = "step"\n{reference}\n'
)
GAIN = '[[axis]]\nparameter = "controller.proportional_V_per_um"\nvalues = [0.1]\n'


def axis(text):
    return f'{HEAD}[[axis]]\nparameter = "program.amplitude_V"\n{text}\n'


@pytest.mark.parametrize("line", ["5.0", "1.5,0.1,2.0", ""])
def test_a_row_of_a_list_with_other_columns_is_refused_with_its_line(line):
    rows = f"program.amplitude_V,mechanics.damping_ratio\n1.5,0.1\n\n{line}\n2.5,0.2\n".encode()
    if not line:
        assert len(parsed(LIST, rows=rows).plan) == 2
        return
    with pytest.raises(DataError, match=r"rows.csv, line 4: expected 2 numbers, found"):
        parsed(LIST, rows=rows)


def test_headers_of_lists_may_have_quotes_and_blank_lines_before_them():
    sweep = parsed(
        LIST, rows=b'\n"program.amplitude_V", "mechanics.damping_ratio"\n'.replace(b", ", b",") + b"1.5,0.1\n"
    )
    assert tuple(axis.parameter for axis in sweep.plan.axes) == ("program.amplitude_V", "mechanics.damping_ratio")


WRONG = (3, 10**400, "", "x\0y", "**.csv", [3], {"a": 1}, True, float("nan"), [[1]], [{}])


def places(table, at=()):
    for key, value in table.items() if isinstance(table, dict) else enumerate(table):
        yield (*at, key)
        if isinstance(value, dict | list):
            yield from places(value, (*at, key))


@pytest.mark.parametrize("kind", sorted(EXAMPLES))
def test_values_of_any_type_in_any_place_are_taken_or_refused(kind, tmp_path, monkeypatch):
    def load(name):
        raise DataError(f"{name}: cannot be read")

    whole = tomllib.loads(EXAMPLES[kind])
    added, sentences = ("list", "records", "outputs", "fit", "diagnose", "controller"), []
    if kind == "fit":
        (tmp_path / "a.csv").write_text("")
        whole = {key: value for key, value in whole.items() if key not in ("model", "initial", "program", "design")}
        whole["axis"] = [{"parameter": "fit.holdout", "values": [0.1, 0.2]}]
        whole["records"] = {"files": "*.csv", "columns": ""}
    for place in [*places(whole), *((key,) for key in added if key not in whole)]:
        for wrong in WRONG:
            table = inner = copy.deepcopy(whole)
            for key in place[:-1]:
                inner = inner[key]
            inner[place[-1]] = wrong
            monkeypatch.setattr("fits.sweeps._spec.parse_toml", lambda *_, table=table: table)
            try:
                parse_sweep("", "sweep.toml", load, tmp_path)
            except DataError as error:
                sentences.append(str(error))
    assert not [sentence for sentence in sentences if "\n" in sentence]
    assert sentences


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (axis("values = [1.0]\ncount = 3"), "an axis with values has no count"),
        (axis("low = 1\nhigh = 2\nsd = 1\n[design]\nmethod = 'sobol'\nrows = 4"), "has no sd"),
        (axis("low = 1\nhigh = 2\nzip = 'a'\n[design]\nmethod = 'sobol'\nrows = 4"), "is not zipped"),
        (axis("mean = 1\nsd = 2\nzip = 'a'\n[design]\nmethod = 'sobol'\nrows = 4"), "has no zip"),
        (axis("low = 1\nhigh = 2\ncount = 1000000000000"), "up to 1,000,000 values"),
        (axis("values = [1.0]\n[program]\nshape = 'step'\nsamples = 10\ninterval_s = 0.1\nstep_s = 1.0"), "0.9 s"),
        (CONTROL.format(controller="lower_V = 100\nupper_V = 20", reference="") + GAIN, "less than upper_V"),
        (CONTROL.format(controller="proportional_V_per_um = -5", reference="") + GAIN, "expected 0 to inf V/um"),
        (CONTROL.format(controller="filter_s = -1", reference="") + GAIN, "controller.filter_s"),
        (CONTROL.format(controller="", reference="step_s = 9.0") + GAIN, "reference.step_s"),
    ],
)
def test_what_has_no_effect_or_no_meaning_is_refused(text, words):
    with pytest.raises(DataError) as error:
        parsed(text)
    assert words in str(error.value)


def test_a_stated_chunk_is_no_larger_than_the_sweep(seed):
    assert chunk_rows(parsed(small(seed, rows=2, chunk=10**9))) == 256
    wide = small(seed, rows=10**9, chunk=10**12).replace("[design]", "[outputs]\ntraces = true\n[design]")
    assert chunk_rows(parsed(wide)) * 60 * 8 < 2**31


def made_up(sweep, chunk, tell=lambda _: None):
    """Rows without any computing: figures are the first parameter, and each seventh row has failed."""
    from fits.sweeps._spec import rows_of

    rows = rows_of(sweep, chunk)
    values = sweep.plan.values(rows)
    first = next(iter(values.values()))
    outputs = {output.name: first.copy() for output in sweep.facts.outputs} | values
    outputs["status"] = np.where(rows % 7 == 6, 2, 1).astype("i1")
    tell(len(rows))
    return Rows(outputs, tuple("wrong" if row % 7 == 6 else "" for row in rows))


@pytest.fixture(scope="module")
def once(tmp_path_factory):
    """A folder with a sweep of made-up rows that has run."""
    folder = tmp_path_factory.mktemp("once")
    (folder / "sweep.toml").write_text(small(1))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(_run, "compute_chunk", made_up)
        run_sweep(read_sweep(folder / "sweep.toml"), str(folder / "out"))
    return folder


@pytest.fixture
def kept(once, tmp_path, monkeypatch):
    """A sweep of made-up rows, its text in a file, and its folder."""
    monkeypatch.setattr(_run, "compute_chunk", made_up)
    shutil.copytree(once, tmp_path, dirs_exist_ok=True)
    return tmp_path / "sweep.toml", tmp_path / "out"


@pytest.mark.parametrize("cluster", ["local:x", "local:0", "local:99999"])
def test_a_wrong_cluster_leaves_no_folder(tmp_path, seed, cluster):
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    (tmp_path / "sweep.toml").write_text(small(seed))
    result = run("sweep", tmp_path / "sweep.toml", "--out", tmp_path / "out", "--cluster", cluster)
    refused(result, "expected local:N")
    assert result.stderr.startswith("cluster: ")
    assert not (tmp_path / "out").exists()


def test_options_may_come_first(kept):
    file, out = kept
    assert "0 computed" in run("sweep", "--resume", "--out", out, file).stdout


def test_what_a_killed_process_left_is_no_other_file(kept, tmp_path):
    file, _ = kept
    out = tmp_path / "begun"
    (out / "ledger").mkdir(parents=True)
    # Names as a process made them that has ended since.
    code = "from fits.io._temporary import temporary_name; print(temporary_name('.json'))"
    ended = [
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.strip()
        for _ in range(2)
    ]
    left = [out / ended[0], out / "ledger" / ended[1]]
    for path in left:
        path.write_text("{")
    run_sweep(read_sweep(file), str(out))
    assert not any(path.exists() for path in left)
    left[1].write_text("{")
    assert summarise(out)["chunks_done"] == 3
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / ".mine-about.json").write_text("{")
    refused(run("sweep", file, "--out", tmp_path / "full"), "other files")


@pytest.mark.parametrize("broken", ["cut", "missing", "array", "metadata"])
def test_broken_results_are_a_sentence_and_are_mended(kept, broken):
    file, out = kept
    store = out / "results.zarr"
    before = open_sweep(out).load()
    if broken == "cut":
        path = store / "stroke_um" / "1"
        path.write_bytes(path.read_bytes()[:20])
    elif broken == "missing":
        shutil.rmtree(store)
    elif broken == "array":
        (store / "stroke_um" / ".zarray").unlink()
    else:
        (store / ".zmetadata").write_text("[")
    if broken != "array":
        refused(run("sweep", "show", out), "results.zarr is missing or broken", "resume")
    assert run("sweep", file, "--out", out, "--resume").exit_code == 0
    assert open_sweep(out).load().equals(before)


@pytest.mark.parametrize("text", ["[]", "{", '{"schema": "microid.sweep.results/1"}'])
def test_a_broken_description_is_a_sentence(kept, text):
    file, out = kept
    (out / "about.json").write_text(text)
    refused(run("sweep", "show", out), "run the sweep again")
    refused(run("sweep", file, "--out", out, "--resume"), "run the sweep again")


def test_reasons_are_texts_in_all_rows(kept):
    _, out = kept
    reasons = open_sweep(out)["reason"].values
    assert reasons[:7].tolist() == ["", "", "", "", "", "", "wrong"]


def test_rows_that_are_not_there_have_empty_reasons(tmp_path, seed):
    with opened(parsed(small(seed)), str(tmp_path / "out"), False):
        pass
    assert set(open_sweep(tmp_path / "out")["reason"].values) == {""}


def test_what_is_infinite_is_neither_best_nor_in_a_mean(kept, monkeypatch, tmp_path):
    file, _ = kept

    def endless(sweep, chunk, tell):
        rows = made_up(sweep, chunk, tell)
        rows.outputs["stroke_um"][::2] = np.inf
        rows.outputs["stroke_um"][1::5] = np.nan
        return rows

    monkeypatch.setattr(_run, "compute_chunk", endless)
    out = tmp_path / "endless"
    run_sweep(read_sweep(file), str(out))
    options = ("--best", "stroke_um", "--largest", "--plots", tmp_path / "plots", "--json")
    best = json.loads(run("sweep", "show", out, *options).stdout)["best"]["rows"]
    found = open_sweep(out)["stroke_um"].values[open_sweep(out)["status"].values == 1]
    assert [row["stroke_um"] for row in best] == sorted(found[np.isfinite(found)], reverse=True)[:5]


def test_changed_records_are_noticed(tmp_path, monkeypatch):
    for name in ("a", "b"):
        (tmp_path / f"{name}.csv").write_text("time_s,voltage_V,displacement_um\n0,1,2\n")
    file, out = tmp_path / "sweep.toml", tmp_path / "out"
    file.write_text('schema = "microid.sweep/1"\nkind = "fit"\n[records]\nfiles = "*.csv"\n')
    sweep = read_sweep(file)
    with opened(sweep, str(out), False), opened(read_sweep(file), str(tmp_path / "other"), False):
        pass
    with opened(sweep, str(out), True):
        pass
    (tmp_path / "b.csv").write_text("time_s,voltage_V,displacement_um\n0,1,3\n")
    with pytest.raises(DataError, match="other files"), opened(sweep, str(out), True):
        pass


def test_a_checkout_is_told_from_others(monkeypatch):
    from importlib.metadata import PackageNotFoundError

    from fits.sweeps import _store

    def version(name):
        if name == "microid":
            raise PackageNotFoundError(name)
        return "1"

    monkeypatch.setattr(_store, "version", version)
    before = _store.versions.__wrapped__()["microid"]
    assert before.startswith("checkout ")
    monkeypatch.setattr(_store.Path, "read_bytes", lambda path: b"other")
    assert _store.versions.__wrapped__()["microid"] != before
