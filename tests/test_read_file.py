"""What is read of files that are endless, enormous, deep or none of anybody's business."""

import gzip
import json
import os
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from _command import refused, run
from _fuzz import hashed
from _models import random_model
from _sweeps import parsed, small

import data_synth
import fits
import fits.io._open_table
import fits.io._read_file
import microid as m
from fits import DataError, Uncertainty
from fits.control._gains import read_gains
from fits.io._atomic import write_csv
from fits.io._read_file import MOST_DEPTH, parse_json, parse_toml
from fits.loop._design import Grid
from fits.sweeps._spec import read_sweep

HEAD = "time_s,voltage_V,displacement_um"


def sentence(read, *arguments):
    with pytest.raises((DataError, data_synth.ScenarioError)) as caught:
        read(*arguments)
    text = str(caught.value)
    assert "\n" not in text
    assert len(text) <= 1000
    return text


def rows(columns):
    return "\n".join([HEAD, *(",".join(map(repr, row)) for row in zip(*columns, strict=True)), ""])


def loop(n=60):
    angle = np.arange(n) / 5
    return [(0.01 * np.arange(n)).tolist(), (50 - 50 * np.cos(angle)).tolist(), (10 - 10 * np.cos(angle)).tolist()]


READERS = {
    "csv": fits.read_csv,
    "reference": fits.read_reference,
    "idle": fits.read_idle,
    "response": fits.read_response,
    "multisine": fits.read_multisine,
    "model": fits.load_model,
    "design": fits.read_design,
    "sweep": read_sweep,
    "gains": lambda path: read_gains(str(path)),
    "scenario": lambda path: data_synth.load_scenario(str(path)),
}


@pytest.mark.parametrize("name", READERS)
def test_only_regular_files_are_read(tmp_path, name):
    """A pipe that nobody writes to would be waited for, and a device read, for ever."""
    pipe, device = tmp_path / "pipe.toml", tmp_path / "zero.toml"
    os.mkfifo(pipe)
    device.symlink_to("/dev/zero")
    for path in (pipe, device):
        assert "a device or a pipe" in sentence(READERS[name], path)
    (tmp_path / "folder.toml").mkdir()
    assert "folder" in sentence(READERS[name], tmp_path / "folder.toml")


@pytest.mark.parametrize("packed", [False, True])
def test_no_more_is_read_or_unpacked_than_is_stated(tmp_path, monkeypatch, packed):
    monkeypatch.setattr(fits.io._open_table, "MOST_CSV_BYTES", 3_000_000)
    text = rows(loop()).encode()
    path = tmp_path / ("run.csv.gz" if packed else "run.csv")
    for size, fits_in in ((2_999_999, True), (3_000_001, False)):
        whole = text + b"#" * (size - len(text))
        path.write_bytes(gzip.compress(whole) if packed else whole)
        if fits_in:
            assert len(fits.read_csv(path)) == 60
        else:
            assert "at most 3 MB" in sentence(fits.read_csv, path)


def test_a_small_file_that_unpacks_to_gigabytes_takes_little_memory(tmp_path):
    """In a process that may have no more than 3 GB, of 5 GB."""
    path = tmp_path / "bomb.csv.gz"
    block = gzip.compress(b"0" * 50_000_000, 9)
    path.write_bytes(gzip.compress(HEAD.encode() + b"\n") + 100 * block)
    code = (
        "import resource, sys, fits, fits.io._open_table\n"
        "fits.io._open_table.MOST_CSV_BYTES = 50_000_000\n"
        "resource.setrlimit(resource.RLIMIT_AS, (3 * 10**9, 3 * 10**9))\n"
        "try: fits.read_csv(sys.argv[1])\nexcept fits.DataError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=False)
    assert "at most 50 MB" in done.stdout, done.stderr[-500:]


def test_columns_are_bounded_in_headers_and_rows(tmp_path):
    path = tmp_path / "wide.csv"
    path.write_text(f"{HEAD}\n" + ",".join(["1"] * 200_000) + "\n")
    assert "found 200000" in sentence(fits.read_csv, path)
    path.write_text(",".join(f"c{k}" for k in range(200_000)) + "\n1\n")
    assert "up to 1,000 columns" in sentence(fits.read_csv, path)


def nested(depth):
    return "[" * depth + "1" + "]" * depth


def test_depth_integers_and_characters_are_bounded():
    assert parse_json(nested(MOST_DEPTH), "x", "a list")
    assert parse_toml(f"a = {nested(MOST_DEPTH)}", "x")
    for depth in (MOST_DEPTH + 2, 600, 2000, 200_000):
        assert "32 nested levels" in sentence(parse_json, nested(depth), "x", "a list")
        assert "32 nested levels" in sentence(parse_toml, f"a = {nested(depth)}", "x")
    assert parse_json(f"[{2**63 - 1}]", "x", "a list") == [2**63 - 1]
    for digits in (19, 400, 5000):
        number = "9" * digits
        for text in (sentence(parse_json, f"[{number}]", "x", "a list"), sentence(parse_toml, f"a = {number}", "x")):
            assert "an integer" in text
            assert "sys." not in text
    for bad in ('["\\ud800"]', '{"\\udfff": 1}', "[1e999]", "[NaN]", '{"a": 1, "a": 2}', "[", "1.5.2"):
        assert sentence(parse_json, bad, "x", "a list").startswith("x: ")
    for bad in (nested(MOST_DEPTH + 2), nested(2000), "9" * 19, "9" * 5000):
        sentence(data_synth.parse_scenario, f"name = {bad}")


LIMITS = [
    (0, 3, "1e12", "from -1e+11 to 1e+11 s"),
    (1, 3, "1e308", "from -1e+09 to 1e+09 V"),
    (2, 3, "-2e9", "from -1e+09 to 1e+09 um"),
    (0, 1, "5e-324", "time steps of at least 1e-12 s"),
]


@pytest.mark.parametrize(("column", "row", "cell", "words"), LIMITS)
def test_a_cell_that_no_rig_has_is_refused_with_its_line(tmp_path, column, row, cell, words):
    columns = loop()
    columns[column][row] = float(cell)
    if column == 0 and row == 3:
        columns[0] = [t if k < row else float(cell) + k for k, t in enumerate(columns[0])]
    path = tmp_path / "run.csv"
    path.write_text(rows(columns))
    text = sentence(fits.read_csv, path)
    assert words in text
    assert f"line {row + 2}, column '{HEAD.split(',')[column]}'" in text


@pytest.mark.parametrize(("column", "factor"), [(1, 1e-320), (1, 1e306), (2, 1e-318), (2, 1e12), (0, 1e-320)])
def test_columns_scaled_beyond_measure_are_refused(tmp_path, column, factor):
    columns = loop()
    columns[column] = [factor * value for value in columns[column]]
    path = tmp_path / "run.csv"
    path.write_text(rows(columns))
    assert f"column '{HEAD.split(',')[column]}'" in sentence(fits.read_csv, path)


def test_steps_that_double_precision_does_not_resolve_are_refused(tmp_path):
    columns, path = loop(), tmp_path / "run.csv"
    for step_s, start_s, resolved in ((1e-4, 1.7e9, True), (5e-7, 1.7e9, False), (5e-7, 0.0, True)):
        columns[0] = (start_s + step_s * np.arange(60)).tolist()
        path.write_text(rows(columns))
        if resolved:
            assert len(fits.read_csv(path)) == 60
        else:
            assert "which is what double precision resolves" in sentence(fits.read_csv, path)


def test_results_that_are_not_finite_are_not_written(tmp_path):
    path = tmp_path / "out.csv"
    for bad in (np.nan, np.inf, -np.inf):
        text = sentence(write_csv, path, {"time_s": np.arange(3.0), "voltage_V": np.array([0.0, bad, 1.0])})
        assert "voltage_V" in text
        assert "sample 2" in text
        assert list(tmp_path.iterdir()) == []


@pytest.fixture
def model_file(tmp_path, rng):
    """A stage in a file, as JSON to be changed, and what writes it with its right sum."""
    path = tmp_path / "model.json"
    whole = m.Stage.of(driver=m.Driver(1e-3), hysteresis=random_model(rng), mechanics=m.Mechanics(100.0, 0.1))
    fits.save_model(path, whole, None, {})
    content = json.loads(path.read_text())

    def write(change):
        change(content)
        path.write_bytes(hashed(json.dumps(content).encode()))
        return path

    return write


CHANGES = {
    "part": (lambda c: c["model"]["parts"].__setitem__(0, 5.0), "parts[0]: expected an object"),
    "substeps": (lambda c: c["model"].update(substeps=10**9), "up to 1000"),
    "weights": (lambda c: c["model"]["parts"][1]["density"]["packed_um"]["value"].__setitem__(0, 1e308), "1e+30"),
    "offset": (lambda c: c["model"]["parts"][1]["offset_um"].update(value=1e300), "1e+30"),
    "deep": (lambda c: c["fit"].update(x=json.loads(nested(600))), "nested levels"),
    "half a character": (lambda c: c["fit"].update(x="\ud800"), "half of one"),
    "shape": (lambda c: c["model"]["parts"][0]["gain"].update(value=[1.0, 2.0]), "single number"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_model_files_with_nonsense_are_refused_in_words_of_the_program(model_file, name):
    change, words = CHANGES[name]
    text = sentence(fits.load_model, model_file(change))
    assert words in text
    assert "jaxtyping" not in text
    assert "Float[" not in text


def test_a_report_that_is_none_is_refused_by_info(tmp_path, rng):
    model = random_model(rng)
    grid = Grid(model.density.lower_V, model.density.upper_V, 7)
    columns = np.zeros((2, grid.columns))
    uncertainty = Uncertainty(jnp.asarray(columns), jnp.zeros(2), jnp.asarray(0.1), grid)
    fits.save_model(tmp_path / "m.json", model, uncertainty, {})
    refused(run("info", tmp_path / "m.json"), "report")
    assert run("info", tmp_path / "m.json", "--json").exit_code == 0


@pytest.mark.parametrize("command", ["simulate", "compensate"])
@pytest.mark.parametrize("last", ["1e308", "5e-324"])
def test_times_beyond_measure_write_nothing(tmp_path, model_file, command, last):
    model = model_file(lambda content: None)
    column = "voltage_V" if command == "simulate" else "displacement_um"
    (tmp_path / "p.csv").write_text(f"time_s,{column}\n0,60\n{last},61\n")
    refused(run(command, model, tmp_path / "p.csv", "--out", tmp_path / "out.csv"), "p.csv", "time_s")
    assert not (tmp_path / "out.csv").exists()


def test_a_sweep_does_not_show_what_is_in_other_files(seed):
    secret = b"root:$6$salt$hash:19000:0\nmore,secret\n"
    listed = small(seed).replace("[design]", "[list]\nfile = 'rows.csv'\n[design]")
    program = small(seed).replace('shape = "sine"\nsamples = 60\ninterval_s = 1e-3', 'file = "rows.csv"')
    program = "\n".join(line for line in program.splitlines() if "_V =" not in line and "frequency_Hz =" not in line)
    for text in (listed, program):
        found = sentence(lambda text=text: parsed(text, rows=secret))
        assert "rows.csv" in found
        assert not any(word in found for word in ("root", "salt", "secret"))


def test_a_chunk_has_the_rows_that_are_asked_for_or_is_refused(seed):
    assert "multiple of 256" in sentence(parsed, small(seed, chunk=16))
    assert parsed(small(seed, chunk=512)).chunk_rows == 512


def test_long_words_are_cut_in_sentences(tmp_path):
    for name in ("x" * 7000, "y " * 4000):
        text = sentence(parsed, f'schema = "microid.sweep/1"\nkind = "simulate"\n"{name}" = 1\n')
        assert text.startswith("sweep.toml: ")
        path = tmp_path / "stage.toml"
        path.write_text(f'schema = "{name}"\n')
        sentence(fits.read_design, path)


def test_a_mapping_without_the_columns_is_not_told_of_separators(tmp_path):
    """As a text is whose only column is its whole lines."""
    with pytest.raises(
        fits.DataError, match="mapping, column 'time_s': expected this column, found 'a'; name what is"
    ):
        fits.read_table({"a": [1, 2]})
    (tmp_path / "one.csv").write_text("a\n1\n2\n")
    with pytest.raises(fits.DataError, match="separate the columns by commas"):
        fits.read_table(tmp_path / "one.csv")
