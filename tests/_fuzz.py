"""Ways to spoil files, by their kind: bytes, lines, cells, columns, structure and numbers."""

import gzip
import hashlib
import json
from pathlib import Path

import numpy as np

WEIRD = (
    *("1e308", "-1e308", "1e306", "5e-324", "-0", "nan", "inf", "-inf", "1e999", "9" * 400, "9" * 5000),
    *(
        "1e-300",
        "1e-318",
        "",
        " ",
        "abc",
        "\uff11\uff12",
        "1_000",
        "0x10",
        "true",
        "1,5",
        '"',
        "'",
        "1e9",
        "1e12",
        "1e30",
        "-1",
    ),
    *(
        "1e17",
        "0",
        "1" + "0" * 18,
        "x" * 7000,
        "\x00",
        "µ",
        "😀",
        ";",
        "#",
        "=",
        "[",
        "\ufeff",
        "1e1e1",
        "--1",
        "1e-9",
    ),
)


def spoilt(rng: np.random.Generator, name: str, data: bytes) -> bytes:
    """Spoil a file once to three times, by its kind."""
    ways = {".csv": CSV, ".json": JSON, ".toml": TOML}[Path(name).suffix]
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        data = ways[rng.integers(len(ways))](rng, data)
    return hashed(data) if Path(name).suffix == ".json" and rng.uniform() < 0.9 else data


def weird(rng):
    if rng.uniform() < 0.4:  # what a file may well hold
        return f"{rng.choice([0, 1, 7.5, 50, 99.5, 1e3, 1e6, 1e-3, 1e-6]) * rng.choice([1, 1, -1]):g}"
    return str(rng.choice(np.array(WEIRD, dtype=object)))


def lines_of(data):
    return data.decode("utf-8", errors="replace").split("\n")


def flipped(rng, data):
    found = bytearray(data)
    for place in rng.integers(0, max(len(found), 1), int(rng.integers(1, 6))):
        if found:
            found[place] = int(rng.integers(256))
    return bytes(found)


def cut(rng, data):
    return data[: int(rng.integers(0, len(data) + 1))]


def lines_moved(rng, data):
    lines = lines_of(data)
    for _ in range(int(rng.integers(1, 4))):
        i, j = rng.integers(0, len(lines), 2)
        way = int(rng.integers(3))
        if way == 0 and len(lines) > 1:
            lines.pop(i)
        elif way == 1:
            lines.insert(j, lines[i])
        else:
            lines[i], lines[j] = lines[j], lines[i]
    return "\n".join(lines).encode()


def inserted(rng, data):
    place = int(rng.integers(0, len(data) + 1))
    return data[:place] + weird(rng).encode() + data[place:]


def cells(rng, data):
    table = [line.split(",") for line in lines_of(data)]
    for _ in range(int(rng.choice([1, 1, 2, 5]))):
        row = table[rng.integers(len(table))]
        row[rng.integers(len(row))] = weird(rng)
    return "\n".join(map(",".join, table)).encode()


def column(rng, data):
    """Every cell of a column scaled, shifted, made one value, or left out."""
    head, *rows = [line.split(",") for line in lines_of(data)]
    at, way = int(rng.integers(len(head))), int(rng.integers(5))
    factor = float(10.0 ** rng.choice([-318, -306, -100, -20, -9, -6, -3, -1, -0.1, 0.1, 1, 3, 6, 9, 20, 100, 306]))
    factor, shift = float(rng.choice([-1, 1, 1, 1])) * factor, float(rng.choice([1, -5, 1e3, 1e9, 1e15, 1e300, -1e6]))
    for row in rows:
        try:
            value = float(row[at])
        except (ValueError, IndexError):
            continue
        row[at] = repr((value * factor, value + shift, 7.5, value, value)[way])
        if way == 3:
            row.pop(at)
        elif way == 4:
            row += [weird(rng)] if rng.uniform() < 0.02 else ["1"]
    if way == 3:
        head.pop(at)
    elif way == 4:
        head += [str(rng.choice(["temperature_C", "other_um", "extra", "voltage_mV", ""]))]
    return "\n".join(map(",".join, [head, *rows])).encode()


def header(rng, data):
    head, *rows = lines_of(data)
    names = head.split(",")
    known = ["time_ms", "voltage_kV", "displacement_m", "displacement_um", "t", "", "1", "time_s", "a" * 5000]
    names[rng.integers(len(names))] = str(rng.choice([*known, weird(rng)[:50]]))
    return "\n".join([",".join(names), *rows]).encode()


def dialect(rng, data):
    text = data.decode("utf-8", errors="replace")
    way = int(rng.integers(9))
    if way == 0:
        return text.replace(",", ";").encode()
    if way == 1:
        return text.replace(",", "\t").replace(".", ",").encode()
    if way == 2:
        return text.encode("utf-16", errors="replace")
    if way == 3:
        return b"\xef\xbb\xbf" + data
    if way == 4:
        return b"\xff\xfe" + data
    if way == 5:
        return text.replace("_um", "_µm").encode("latin-1", errors="replace")
    if way == 6:
        packed = gzip.compress(data)
        return packed[: int(rng.integers(1, len(packed) + 1))] if rng.uniform() < 0.5 else packed
    if way == 7:
        return text.replace(",", ", ,").encode()
    return text.replace("\n", str(rng.choice(["\r", "\r\n", "\n\n", "\x0b"]))).encode()


def places_of(value, path=()):
    """Every place in a nest of objects and lists, but for those within long lists of numbers."""
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value[:8]) if isinstance(value, list) else ()
    for key, item in items:
        yield from places_of(item, (*path, key))


def nested(depth):
    found = 1.0
    for _ in range(depth):
        found = [found]
    return found


def structure(rng, data):
    """Something in JSON is replaced, left out or added."""
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        return flipped(rng, data)
    places = [path for path in places_of(content) if path]
    if not places:
        return flipped(rng, data)
    *above, key = places[rng.integers(len(places))]
    owner = content
    for step in above:
        owner = owner[step]
    numbers = [0, 1, -1, 1e308, -1e308, 1e300, 5e-324, 1e-310, 1e30, 1e9, 10**9, 10**18, 10**30, 2.5, 1e-9]
    others = [None, True, "", "text", "\ud800", "😀", [], {}, [1, 2], [[1], [2, 3]], {"type": "Piezo"}, "x" * 7000]
    value = owner[key]
    choices = [*numbers, *numbers, *others, nested(40), nested(600)]
    way = int(rng.integers(6))
    if way == 0 and isinstance(owner, dict):
        owner[f"{key}x"] = owner.pop(key)
    elif way == 1:
        del owner[key]
    elif way == 2 and isinstance(value, list) and value:
        value[int(rng.integers(len(value)))] = choices[rng.integers(len(choices))]
    elif way == 3 and isinstance(value, float):
        owner[key] = value * float(rng.choice([1.5, 0.5, 10, 1e3, 1e-3, -1, 1e6, 1e-6, 1e300, 1e-300, 0]))
    else:
        owner[key] = choices[rng.integers(len(choices))]
    return json.dumps(content).encode()


def token(rng, data):
    """A number of a JSON text becomes one that no float is, or a key stands twice."""
    text = data.decode("utf-8", errors="replace")
    at = int(rng.integers(len(text) + 1))
    tokens = ["1e999", "NaN", "-Infinity", "9" * 5000, "1" + "0" * 400, "-0", "[" * 600, '"a":1,"a":1,', '"\\ud800"']
    place = text.find("0.", at)
    return (text[:place] + str(rng.choice(tokens)) + text[place + 3 :]).encode()


def hashed(data):
    """Give a changed model file its right sum, so that what it holds is looked at."""
    try:
        content = json.loads(data)
        rest = {key: value for key, value in content.items() if key != "sha256"}
        text = json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (ValueError, RecursionError, AttributeError, TypeError):
        return data
    if "sha256" not in content:
        return data
    return json.dumps(content | {"sha256": hashlib.sha256(text.encode("ascii")).hexdigest()}).encode()


def toml_value(rng, data):
    lines = lines_of(data)
    places = [k for k, line in enumerate(lines) if "=" in line]
    if not places:
        return flipped(rng, data)
    k = places[rng.integers(len(places))]
    key, _, old = lines[k].partition("=")
    values = ["0.5", "2", "3.0", "40", "0.01", "1000", "1e6", "1e-6", "100000", "1e5", "0.1", "10.0", "-5"]
    values += ["nan", "-inf", "1e308", "5e-324", "0", "-1", "1e12", "1000000000", "[]", "{}", "[1, 2]", "true", '"x"']
    values += ["9" * 5000, "9" * 100, "[" * 2000 + "]" * 2000, "[" * 100 + "]" * 100, "1979-05-27", "0x1F", "1e-300"]
    values += ['"' + "y" * 7000 + '"', "[" + "1," * 3000 + "]", '"\\uD800"', "'''a'''", "a.b.c", weird(rng)]
    if "value" in old and rng.uniform() < 0.7:  # a quantity with its unit
        first = old.find("value =") + 8
        new = old[:first] + str(rng.choice(values)) + old[old.find(",", first) :]
    else:
        new = str(rng.choice(values))
    lines[k] = f"{key}= {new}"
    return "\n".join(lines).encode()


def toml_key(rng, data):
    lines = lines_of(data)
    k = int(rng.integers(len(lines)))
    if lines[k].startswith("["):
        lines[k] = str(rng.choice(["[x]", "[[runs]]", "[run]", "[[axis]]", "[a.b.c]", "[]", lines[k].strip("[]")]))
    else:
        lines[k] = f"{rng.choice(['x', 'value', 'seed', 'a.a.a', 'kind', 'rows'])}{lines[k][int(rng.integers(4)) :]}"
    return "\n".join(lines).encode()


ANY = (flipped, cut, lines_moved, inserted)
CSV = (*ANY, cells, cells, cells, cells, column, column, column, header, dialect)
JSON = (flipped, cut, inserted, structure, structure, structure, structure, structure, structure, token)
TOML = (*ANY, toml_value, toml_value, toml_value, toml_value, toml_value, toml_key)
