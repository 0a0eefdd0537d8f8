import gzip
import itertools
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from fits.io._errors import DataError
from fits.io._read_csv import read_runs
from fits.io._read_csv import read_table as read_csv
from fits.io._units import parse_columns

N = 60
TIME = [i / 2 for i in range(N)]  # dyadic numbers: exact in binary and in decimal
VOLT = [(i if i < 30 else N - i) / 4 for i in range(N)]
DISP = [v / 2 - 8 for v in VOLT]
HEAD = "time_s,voltage_V,displacement_um"
ROWS = [f"{t},{v},{y}" for t, v, y in zip(TIME, VOLT, DISP, strict=True)]


def csv_text(head=HEAD, rows=ROWS):
    return "\n".join([head, *rows]) + "\n"


def with_row(line, row, head=HEAD):
    """The good file with one line replaced; the header is line 1."""
    rows = list(ROWS)
    rows[line - 2] = row
    return csv_text(head, rows)


def with_column(name, cells):
    return csv_text(f"{HEAD},{name}", [f"{row},{cell}" for row, cell in zip(ROWS, cells, strict=True)])


def saved(folder, content, name="a.csv"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def assert_good(record):
    assert record.time_s.tolist() == TIME
    assert record.voltage_V.tolist() == VOLT
    assert record.displacement_um.tolist() == DISP
    assert record.warnings == ()
    for array in (record.time_s, record.voltage_V, record.displacement_um, *record.extra.values()):
        assert array.dtype == np.float64
        assert not array.flags.writeable


def refusal(path, **options):
    with pytest.raises(DataError) as caught:
        read_csv(path, **options)
    return str(caught.value)


def assert_one_sentence(message):
    assert "\n" not in message
    assert ". " not in message
    assert message.endswith(".")


DIALECTS = [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ",")]
ENCODINGS = ["utf-8", "utf-8-sig", "utf-16", "utf-16-be", "latin-1"]


@pytest.mark.parametrize(
    ("dialect", "encoding", "end", "tail", "packed"),
    list(itertools.product(DIALECTS, ENCODINGS, ["\n", "\r\n", "\r"], [False, True], [False, True])),
)
def test_every_dialect_and_encoding(tmp_path, dialect, encoding, end, tail, packed):
    separator, decimal = dialect
    table = [["time_s", "voltage_V", "displacement_µm"]]
    table += [[repr(x).replace(".", decimal) for x in row] for row in zip(TIME, VOLT, DISP, strict=True)]
    text = "".join(separator.join(row) + (separator if tail else "") + end for row in table)
    data = (("\ufeff" if encoding == "utf-16-be" else "") + text).encode(encoding)
    path = saved(tmp_path, gzip.compress(data) if packed else data, "a.csv.gz" if packed else "a.csv")
    assert_good(read_csv(path))


ACCEPTED = {
    "plain": csv_text(),
    "no newline at the end": csv_text().rstrip(),
    "comments and blanks": "# 1\n\n% a\n" + csv_text(rows=["", "# x, y", *ROWS[:9], "  ", "%", *ROWS[9:], "# end"]),
    "quoted header": csv_text('"time_s","voltage_V","displacement_um"'),
    "spaces": csv_text(" time_s , voltage_V ,displacement_um ", [row.replace(",", " , ") for row in ROWS]),
    "quoted cells": csv_text(rows=['"' + row.replace(",", '","') + '"' for row in ROWS]),
    "Excel separator line": "sep=;\n" + csv_text().replace(",", ";"),
    "trailing separators, body only": csv_text(rows=[row + ",," for row in ROWS]),
    "trailing separators, header only": csv_text(HEAD + ",,"),
    "trailing separators, some rows": csv_text(rows=[row + ("," if i % 2 else "") for i, row in enumerate(ROWS)]),
    "rows of empty cells (Excel)": csv_text(rows=[*ROWS, ",,", ",,"]),
    "other order": csv_text("voltage_V,displacement_um,time_s", [re.sub("(.*?),(.*)", r"\2,\1", r) for r in ROWS]),
    "brackets": csv_text("Time [s],Voltage (V),Displacement [µm]"),
    "preamble": "Model,TDS\nSerial,5\n\n" + csv_text(),
    "units line": csv_text(rows=["s,V,um", *ROWS]),
    "plus signs and exponents": csv_text(rows=[f"+{t},{v:e},{y}" for t, v, y in zip(TIME, VOLT, DISP, strict=True)]),
}  # fmt: skip


@pytest.mark.parametrize("text", ACCEPTED.values(), ids=ACCEPTED)
def test_accepted_forms(tmp_path, text):
    assert_good(read_csv(saved(tmp_path, text)))


# Column header, cell text, canonical column and its value by hand. Quotients are the nearest doubles.
UNITS = [
    ("time_ms", "100.5", "time_s", 0.1005),
    ("time_us", "7", "time_s", 7e-6),
    ("time_ns", "3", "time_s", 3e-9),
    ("voltage_mV", "0.1", "voltage_V", 1e-4),
    ("voltage_uV", "3", "voltage_V", 3e-6),
    ("voltage_kV", "0.25", "voltage_V", 250.0),
    ("displacement_nm", "125", "displacement_um", 0.125),
    ("displacement_pm", "5", "displacement_um", 5e-6),
    ("displacement_mm", "0.5", "displacement_um", 500.0),
    ("displacement_m", "2.5e-05", "displacement_um", 25.0),
    ("temperature_degC", "21.5", "temperature_degC", 21.5),
    ("temperature_C", "21.5", "temperature_degC", 21.5),
    ("temperature_K", "273.15", "temperature_degC", 0.0),
    ("y_displacement_nm", "500", "y_displacement_um", 0.5),
    ("drive_monitor_mV", "1500", "drive_monitor_V", 1.5),
    ("current_mA", "12", "current_A", 0.012),
]


@pytest.mark.parametrize(("header", "cell", "column", "value"), UNITS)
def test_units_are_converted_by_suffix(tmp_path, header, cell, column, value):
    stem = header.rsplit("_", 1)[0]
    names = [name for name in HEAD.split(",") if not name.startswith(stem + "_")] + [header]
    rows = [["-1"] * (len(names) - 1) + [cell]] + [[str(101.0 + i)] * len(names) for i in range(N)]
    record = read_csv(saved(tmp_path, "\n".join(",".join(row) for row in [names, *rows])))
    found = record.extra[column] if column in record.extra else getattr(record, column)
    assert found[0] == value


def test_extra_columns_are_kept_and_text_is_dropped_with_a_warning(tmp_path):
    cells = [f"{i},ok,{'' if i == 4 else i}" for i in range(N)]
    path = saved(tmp_path, with_column("count,note,holey", cells))
    record = read_csv(path)
    assert list(record.extra) == ["count"]
    assert record.extra["count"].tolist() == list(range(N))
    assert record.source == "a.csv"
    note, holey = record.warnings
    assert note.startswith(f"{path}, line 2, column 'note': dropped, because 'ok' is not a number")
    assert holey.startswith(f"{path}, line 6, column 'holey': dropped, because an empty cell is not a number")


FREE = csv_text("t_ms,u1_V,height")
MAPPINGS = [
    ({"time_s": "t_ms", "voltage_V": "u1_V", "displacement_um": "height[nm]"}, 1e3, 1e3),
    ({"time_s": "t_ms[s]", "voltage_V": "u1_V", "displacement_um": "-height [ um ]"}, 1.0, -1.0),
]


def test_a_scale_says_what_one_is(tmp_path):
    """A drive in %, of which 100 are 120 V, and a converter whose last digit is 0.25 nm."""
    path = saved(tmp_path, csv_text("time_s,drive,counts"))
    record = read_csv(path, parse_columns("voltage_V=drive[1.5V],displacement_um=-counts[2.5e-1 nm]"))
    assert record.voltage_V.tolist() == [1.5 * v for v in VOLT]
    assert record.displacement_um.tolist() == [-0.25 * y / 1e3 for y in DISP]
    assert "out of V, mV" in refusal(path, columns=parse_columns("voltage_V=drive[0V],displacement_um=counts[um]"))


@pytest.mark.parametrize(("columns", "time_divisor", "divisor"), MAPPINGS)
def test_mapping_states_unit_and_sign(tmp_path, columns, time_divisor, divisor):
    record = read_csv(saved(tmp_path, FREE), columns)
    assert record.time_s.tolist() == [t / time_divisor for t in TIME]
    assert record.voltage_V.tolist() == VOLT
    assert record.displacement_um.tolist() == [y / divisor for y in DISP]
    assert dict(record.extra) == {}


def test_mapped_columns_replace_those_of_the_same_name(tmp_path):
    path = saved(tmp_path, with_column("u_mV", [1000 * v for v in VOLT]))
    record = read_csv(path, {"voltage_V": "u_mV"})
    assert_good(record)
    assert dict(record.extra) == {}
    swapped = read_csv(path, parse_columns("voltage_V=displacement_um[V], displacement_um=voltage_V[um]"))
    assert (swapped.voltage_V.tolist(), swapped.displacement_um.tolist()) == (DISP, VOLT)


def test_a_header_with_a_minus_or_brackets_may_be_named_literally(tmp_path):
    path = saved(tmp_path, csv_text("time_s,-u_V,y[nm]"))
    record = read_csv(path, {"voltage_V": "-u_V", "displacement_um": "-y[nm]"})
    assert record.voltage_V.tolist() == VOLT
    assert record.displacement_um.tolist() == [-y / 1e3 for y in DISP]


@pytest.mark.parametrize("text", ["voltage_V", "voltage_V=", "=u", "volt=u_V", "voltage_V=a_V,voltage_V=b_V"])
def test_bad_column_options_are_refused(text):
    with pytest.raises(DataError, match=r"^--columns: ") as caught:
        parse_columns(text)
    assert_one_sentence(str(caught.value))


def test_column_option():
    columns = {"voltage_V": "u1_V", "displacement_um": "-h[m]"}
    assert parse_columns(" voltage_V = u1_V ,displacement_um=-h[m], ") == columns
    assert parse_columns("") == {}


def test_a_voltage_programme_may_be_short_and_constant(tmp_path):
    record = read_csv(saved(tmp_path, "time_s,voltage_V\n0,1\n1,1\n"), required=("time_s", "voltage_V"))
    assert record.displacement_um is None
    assert record.voltage_V.tolist() == [1.0, 1.0]


def test_runs(tmp_path):
    paths = [saved(tmp_path, csv_text(), "a.csv"), saved(tmp_path, csv_text(), "b.csv")]
    runs = read_runs(paths)
    assert [run.source for run in runs] == ["a.csv", "b.csv"]
    assert [run.source for run in read_runs(str(paths[0]))] == ["a.csv"]
    with pytest.raises(DataError, match="at least one CSV file"):
        read_runs([])


GERMAN = csv_text().replace(",", ";").replace(".", ",")
REFUSED = {
    # content, line, column, words that must be there
    "empty": (b"", 1, None, "empty file"),
    "only blanks": ("\n \n", 1, None, "empty file"),
    "only comments": ("# a\n", 1, None, "only comments"),
    "header only": ("# a\n" + HEAD + "\n\n", 2, None, "rows of numbers"),
    "NUL bytes": (csv_text().encode() + b"\0\0\0", 62, None, "binary"),
    "binary without NUL": (b"\x89PNG\r\n\x1a\x01\xff", 2, None, "binary"),
    "Excel workbook": (b"PK\x03\x04abc", 1, None, "Excel workbook"),
    "cut UTF-16": (csv_text().encode("utf-16")[:-1], 1, None, "UTF-16"),
    "no header": ("# a\n" + "\n".join(ROWS), 2, None, "header such as time_s,voltage_V,displacement_um"),
    "missing column": (csv_text("time_s,u1_V,displacement_um"), 1, "voltage_V", "--columns voltage_V=u1_V"),
    "missing unit": (csv_text("time_s,voltage,displacement_um"), 1, "voltage_V", r"voltage_V=voltage\[UNIT\]"),
    "unknown unit": (csv_text("time_s,voltage_V,displacement_inch"), 1, "displacement_um", "'inch' .*um, nm, mm"),
    "unknown separator": (csv_text().replace(",", "&"), 1, "time_s", "separate the columns by commas"),
    "preamble": ("Model,TDS\n" + with_row(2, "x,y,3"), 3, "time_s", "put # before the line"),
    "scope": (csv_text("TIME,CH1,CH2"), 1, "time_s", r"voltage_V=CH1\[UNIT\],displacement_um=CH2\[UNIT\]"),
    "two units": (with_column("voltage_mV", TIME), 1, "voltage_mV", "found also 'voltage_V'"),
    "duplicate": (with_column("voltage_V", TIME), 1, "voltage_V 4", "found also 'voltage_V'; choose one"),
    "text": (with_row(9, "3.5,oops,1"), 9, "voltage_V", "found 'oops'; correct the cell"),
    "text in quotes": (with_row(9, '3.5,"oops",1'), 9, "voltage_V", "found 'oops'"),
    "units line": (with_row(2, "s,V,oz"), 1, "displacement_um", r"'displacement_um\[oz\]'"),
    "underscore": (with_row(9, "3.5,1_0,1"), 9, "voltage_V", "found '1_0'"),
    "empty cell": (with_row(9, "3.5,,1"), 9, "voltage_V", "an empty cell"),
    "NaN": (with_row(9, "3.5,1,NaN"), 9, "displacement_um", "finite number, found 'NaN'"),
    "infinity": (with_row(9, "3.5,-inf,1"), 9, "voltage_V", "finite number, found '-inf'"),
    "overflow": (with_row(9, "3.5,1e400,1"), 9, "voltage_V", "finite number, found '1e400'"),
    "unit overflow": (with_row(9, "3.5,1,1e307", "time_s,voltage_V,displacement_m"), 9, "displacement_m", "inf"),
    "too few cells": (with_row(9, "3.5,1"), 9, "displacement_um", "expected 3 cells .* line 1, found 2"),
    "too many cells": (with_row(9, "3.5,1,2,3"), 9, "displacement_um", "expected 3 cells .* line 1, found 4"),
    "too many in the first row": (with_row(2, "3.5,1,2,3"), 2, "displacement_um", "found 4"),
    "too few for an extra": (with_column("n", TIME).replace("75,-7.125,3.5\n", "75,-7.125\n", 1), 9, "n", "found 3"),
    "commas as decimals": (csv_text(rows=[f"{i},0,{i},5,0,5" for i in VOLT]), 2, "displacement_um", "need ; or tab"),
    "mixed decimals": (GERMAN.replace("3,5;1,75", "3,5;1.75", 1), 9, "voltage_V", "one decimal mark"),
    "time repeats": (with_row(9, "3.0,1,1"), 9, "time_s", "found 3 s twice"),
    "time goes back": (with_row(9, "2.75,1,1"), 9, "time_s", "found 2.75 s after 3 s"),
    "time restarts": (csv_text(rows=ROWS + ROWS), 62, "time_s", "restart at 0 s after 29.5 s; split the file"),
    "too few samples": (csv_text(rows=ROWS[:49]), 50, None, "at least 50 samples, found 49"),
    "constant voltage": (csv_text(rows=[f"{t},1,{t}" for t in TIME]), 2, "voltage_V", "found 1 in every .* line 61"),
    "constant displacement": (csv_text(rows=[f"{t},{t},7.5" for t in TIME]), 2, "displacement_um", "found 7.5 in"),
    "NaN in an optional quantity": (with_column("temperature_K", ["nan", *TIME[1:]]), 2, "temperature_K", "'nan'"),
}  # fmt: skip


@pytest.mark.parametrize(("content", "line", "column", "words"), REFUSED.values(), ids=REFUSED)
def test_refusals_name_file_line_and_column(tmp_path, monkeypatch, content, line, column, words):
    saved(tmp_path, content)
    monkeypatch.chdir(tmp_path)
    message = refusal("a.csv")
    assert message.startswith(f"a.csv, line {line}" + (f", column '{column}': " if column else ": "))
    assert re.search(words, message), message
    assert_one_sentence(message)


WRONG_FILES = {
    "missing": ("none.csv", None, "no such file"),
    "folder": (".", None, "found a folder"),
    "cut gzip": ("a.csv.gz", gzip.compress(csv_text().encode())[:-20], "damage"),
    "flipped gzip": ("a.csv.gz", gzip.compress(csv_text().encode())[:40] + b"x" * 400, "damage"),
    "not gzip": ("a.csv.gz", csv_text().encode(), "damage"),
    "cut gzip without .gz": ("a.csv", gzip.compress(csv_text().encode())[:-20], "damage"),
}


@pytest.mark.parametrize(("name", "content", "words"), WRONG_FILES.values(), ids=WRONG_FILES)
def test_files_that_cannot_be_read(tmp_path, monkeypatch, name, content, words):
    monkeypatch.chdir(tmp_path)
    if content is not None:
        saved(tmp_path, content, name)
    message = refusal(name)
    assert message.startswith(f"{name}: ")
    assert words in message
    assert_one_sentence(message)


BAD_MAPPINGS = [
    ({"voltage_V": "u2_V"}, "column 'u2_V'.*the nearest are 'u1_V'"),
    ({"voltage_V": "u1_V", "displacement_um": "height"}, r"found no unit.*displacement_um=height\[um\]"),
    ({"voltage_V": "u1_V", "displacement_um": "height[ft]"}, "out of um, nm, mm, m, pm .*found unit 'ft'"),
    ({"voltage_V": "t_ms"}, "out of V, mV, uV, kV .*found unit 'ms'"),
    ({"volts": "u1_V"}, "'volts' is not a column of a record; name one of time_s, voltage_V"),
    ({"time_s": "t_ms"}, r"column 'voltage_V'.*--columns 'voltage_V=u1_V,displacement_um=height\[UNIT\]"),
]


@pytest.mark.parametrize(("columns", "words"), BAD_MAPPINGS)
def test_bad_mappings_are_refused(tmp_path, columns, words):
    message = refusal(saved(tmp_path, FREE), columns=columns)
    assert re.search(words, message), message
    assert_one_sentence(message)


@pytest.mark.parametrize("above", [[], ["# rig"], ["# rig", "", "% a", "  ", "#,,,"]])
@pytest.mark.parametrize("within", [[], ["", "# pause", "  % x", " "]])
def test_lines_are_counted_as_an_editor_does(tmp_path, above, within):
    lines = [*above, HEAD, *ROWS[:20], *within, *ROWS[20:40], "20,bad,0", *ROWS[41:]]
    for end in ("\n", "\r\n"):
        message = refusal(saved(tmp_path, end.join(lines)))
        assert f", line {lines.index('20,bad,0') + 1}, column 'voltage_V'" in message


FLOATS, TIMES = st.floats(-1e9, 1e9), st.integers(-(10**12), 10**12).map(lambda count: count * 1e-3)


@settings(max_examples=100, deadline=None, database=None)
@given(
    st.lists(st.tuples(TIMES, FLOATS, FLOATS), min_size=50, max_size=60, unique_by=lambda row: row[0]),
    st.sampled_from(DIALECTS),
)
def test_every_float_is_read_exactly(table, dialect):
    separator, decimal = dialect
    columns = tuple(zip(*sorted(table), strict=True))
    assume(all(max(column) - min(column) > 1e-9 for column in columns))
    rows = [separator.join(map(repr, row)).replace(".", decimal) for row in zip(*columns, strict=True)]
    with tempfile.TemporaryDirectory() as folder:
        record = read_csv(saved(Path(folder), csv_text(HEAD.replace(",", separator), rows)))
    arrays = (record.time_s, record.voltage_V, record.displacement_um)
    for found, expected in zip(arrays, columns, strict=True):
        assert found.tobytes() == np.array(expected).tobytes()  # bytes tell -0.0 from 0.0


def test_pandas_is_imported_only_when_a_file_is_read():
    code = "import sys, fits.io._read_csv, fits.io._atomic; assert 'pandas' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[1])
