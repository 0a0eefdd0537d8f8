"""Designs of stages as TOML files."""

import math
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp

import microid as m
from fits.io._atomic import atomic_write_text
from fits.io._errors import DataError, shown
from fits.io._read_file import MOST_TOML_BYTES, parse_toml, read_text
from fits.machining._design import TOLERANCE_MM, Design, Together, default_tolerance, nearest

SCHEMA = "microid.stage/1"
_DEGREE = math.pi / 180
# What to multiply by, or to divide by where that is exact.
_LENGTH = {"mm": (1.0, 1.0), "um": (1.0, 1e3), "m": (1e3, 1.0)}
_STROKE = {"um": (1.0, 1.0), "mm": (1e3, 1.0), "m": (1e6, 1.0)}
_ANGLE = {"rad": (1.0, 1.0), "mrad": (1.0, 1e3), "deg": (_DEGREE, 1.0)}
_INERTIA = {"kg mm^2": (1.0, 1.0), "kg m^2": (1e6, 1.0)}
_MASS = {"kg": (1.0, 1.0), "g": (1.0, 1e3)}
_MODULUS = {"GPa": (1.0, 1.0), "MPa": (1.0, 1e3)}
_NUMBER: dict[str, tuple[float, float]] = {}
_Units = Mapping[str, tuple[float, float]]

# Key, units (the first is the one written), field of `microid.Actuation`, and meaning.
_ACTUATION: tuple[tuple[str, _Units, str, str], ...] = (
    ("piezo_stiffness", {"N/um": (1.0, 1.0), "N/m": (1.0, 1e6)}, "piezo_N_per_um", "of a piezo, small signal"),
    ("free_stroke", _STROKE, "free_stroke_um", "elongation of a piezo without a load at the highest voltage"),
    ("voltage", {"V": (1.0, 1.0)}, "voltage_V", "the highest"),
    ("mass_xy", _MASS, "mass_xy_kg", "moved along x or y"),
    ("mass_z", _MASS, "mass_z_kg", "moved along z"),
    ("inertia_tilt", _INERTIA, "inertia_tilt_kg_mm2", "turned about x or y"),
    ("inertia_rotor", _INERTIA, "inertia_rotor_kg_mm2", "turned about z"),
    ("damping_ratio", _NUMBER, "damping_ratio", "of all axes"),
)
_TABLES = ("schema", "level", "geometry", "material", "actuation", "together")


def read_design(path: str | os.PathLike[str]) -> Design:
    """Read the design of a stage.

    Parameters
    ----------
    path
        TOML as `write_design` writes it. Lengths may be in mm, um or m and angles in rad, mrad or deg; a tolerance is
        in the unit of its dimension, and 0.02 mm, for an angle over its leg, where none is given.

    Returns
    -------
    Design
        In mm and rad.

    Raises
    ------
    DataError
        If the file cannot be read, or for the first thing in it that is not as it should be.
    """
    name = os.fspath(path)
    text = read_text(path, "the TOML file of a stage", MOST_TOML_BYTES)
    table = parse_toml(text, name)
    try:
        return _design(table)
    except DataError as error:
        sentence = str(error)
        line = _line_of(text, sentence.partition(":")[0])
        raise DataError(f"{name}{'' if line is None else f', line {line}'}: {sentence}") from None


def write_design(design: Design, path: str | os.PathLike[str]) -> None:
    """Write the design of a stage as TOML, which `read_design` reads back to the last digit.

    Raises
    ------
    DataError
        As `atomic_path`.
    """
    atomic_write_text(path, design_text(design))


def design_text(design: Design) -> str:
    """Put the design of a stage into TOML."""
    lines = [
        f'schema = "{SCHEMA}"',
        "# 0: Euler-Bernoulli leaves between rigid blocks; 1: elastic roots, shear, links.",
    ]
    lines += [f"level = {design.level}", "", "[geometry]"]
    platform = ""
    for name, dimension in m.DIMENSIONS.items():
        if dimension.platform != platform:
            platform = dimension.platform
            lines.append(f"# {platform.capitalize()} platform")
        value = f"value = {float(design.geometry[name])!r}, unit = {_quoted(dimension.unit)}"
        entry = f"{name} = {{ {value}, tolerance = {float(design.tolerance[name])!r} }}"
        lines.append(f"{entry}  # {dimension.meaning}")
    modulus = f"value = {float(design.youngs_modulus_GPa)!r}, unit = {_quoted('GPa')}"
    lines += ["", "[material]", f"youngs_modulus = {{ {modulus} }}  # of all flexures"]
    lines += [f"guides = {float(design.guides)!r}  # guiding legs of a translation in x or y", "", "[actuation]"]
    for key, units, field, meaning in _ACTUATION:
        number = repr(float(getattr(design.actuation, field)))
        unit = next(iter(units), None)
        written = number if unit is None else f"{{ value = {number}, unit = {_quoted(unit)} }}"
        lines.append(f"{key} = {written}  # {meaning}")
    for group in design.together:
        names = ", ".join(map(_quoted, group.dimensions))
        lines += ["", "[[together]]", f"dimensions = [{names}]  # whose errors go together"]
        lines.append(f"correlation = {float(group.correlation)!r}")
    return "\n".join([*lines, ""])


def _quoted(text: str) -> str:
    return f'"{text}"'


def _design(table: Mapping[str, Any]) -> Design:
    """Build a design; a `DataError` begins with the place of its cause, such as `geometry.t2`."""
    # First of all: keys of another file are not ours to show.
    if table.get("schema") != SCHEMA:
        found = shown(table["schema"]) if "schema" in table else "none"
        raise DataError(f"schema: expected {_quoted(SCHEMA)}, found {found}; give that, or another file.")
    _keys(table, _TABLES, "", optional=("together",))
    level = table["level"]
    if isinstance(level, bool) or not isinstance(level, int) or level not in (0, 1):
        raise DataError(f"level: expected 0 or 1, found {shown(level)}; give one of them.")
    geometry = _table(table["geometry"], "geometry")
    _keys(geometry, [*m.DIMENSIONS], "geometry.")
    sizes, tolerance = {}, {}
    for name, dimension in m.DIMENSIONS.items():
        scale = _ANGLE if dimension.unit == "rad" else _LENGTH
        sizes[name], given = _quantity(geometry[name], f"geometry.{name}", scale, tolerated=True)
        if given is not None:
            tolerance[name] = given
    for name in m.DIMENSIONS:
        leg = m.DIMENSIONS[name].leg
        if name not in tolerance and (leg is None or sizes[leg] > 0):
            tolerance[name] = default_tolerance(name, sizes, TOLERANCE_MM)
    material = _table(table["material"], "material")
    _keys(material, ("youngs_modulus", "guides"), "material.")
    actuation = _table(table["actuation"], "actuation")
    _keys(actuation, [key for key, *_ in _ACTUATION], "actuation.")
    moved = {}
    for key, units, field, _ in _ACTUATION:
        place = f"actuation.{key}"
        moved[field], _ = _quantity(actuation[key], place, units) if units else (_number(actuation[key], place), None)
        if not moved[field] > 0:
            raise DataError(f"{place}: expected a number above 0, found {moved[field]:g}; correct it.")
    return Design(
        geometry=m.Geometry(**{m.DIMENSIONS[name].field: jnp.asarray(size) for name, size in sizes.items()}),
        tolerance=tolerance,
        level=level,
        guides=_number(material["guides"], "material.guides"),
        youngs_modulus_GPa=_quantity(material["youngs_modulus"], "material.youngs_modulus", _MODULUS)[0],
        actuation=m.Actuation(**{field: jnp.asarray(value) for field, value in moved.items()}),
        together=_groups(table.get("together", [])),
    )


def _groups(found: Any) -> tuple[Together, ...]:
    if not isinstance(found, list):
        raise DataError(f"together: expected tables [[together]], found {shown(found)}; double the brackets.")
    groups = []
    for k, item in enumerate(found):
        place = f"together[{k}]"
        group = _table(item, place)
        _keys(group, ("dimensions", "correlation"), f"{place}.")
        names = group["dimensions"]
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise DataError(
                f'{place}.dimensions: expected a list of names, found {shown(names)}; write ["t1", "t2"].'
            )
        groups.append(Together(tuple(names), _number(group["correlation"], f"{place}.correlation")))
    return tuple(groups)


def _keys(table: Mapping[str, Any], known: Sequence[str], above: str, optional: Sequence[str] = ()) -> None:
    """Refuse unknown and missing keys; of both, a misspelt one explains the missing one."""
    for key in table:
        if key not in known:
            raise DataError(f"{above}{_plain(key)}: expected a known key, found {shown(key)}; {nearest(key, known)}")
    for key in known:
        if key not in table and key not in optional:
            raise DataError(f"{above}{key}: expected this key, found none; add it.")


def _table(found: Any, place: str) -> Mapping[str, Any]:
    if not isinstance(found, dict):
        raise DataError(f"{place}: expected a table, found {shown(found)}; write [{place}] and its keys below.")
    return found


def _quantity(found: Any, place: str, units: _Units, tolerated: bool = False) -> tuple[float, float | None]:
    """Value and tolerance in the first of some units."""
    first = next(iter(units))
    if not isinstance(found, dict):
        raise DataError(
            f"{place}: expected a value with its unit, found {shown(found)}; write {{ value = 1.0, unit = "
            f"{_quoted(first)} }}."
        )
    optional = ("tolerance",)
    _keys(found, ("value", "unit", *(optional if tolerated else ())), f"{place}.", optional)
    unit = found["unit"]
    if not isinstance(unit, str) or unit.replace("µ", "u").replace("μ", "u") not in units:
        raise DataError(f"{place}.unit: expected one of {', '.join(units)}, found {shown(unit)}; convert the value.")
    times, over = units[unit.replace("µ", "u").replace("μ", "u")]
    value = _number(found["value"], f"{place}.value") * times / over
    if "tolerance" not in found:
        return value, None
    return value, _number(found["tolerance"], f"{place}.tolerance") * times / over


def _number(found: Any, place: str) -> float:
    try:
        number = math.nan if isinstance(found, bool) or not isinstance(found, int | float) else float(found)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise DataError(f"{place}: expected a finite number, found {shown(found)}; give one without quotes.")
    return number


def _plain(key: str) -> str:
    return shown(key)[1:-1]


def _line_of(text: str, place: str) -> int | None:
    """Line of a place such as `geometry.t2.unit`, or of the nearest table or key around it."""
    wanted = place.split(".")
    best: tuple[int, int | None] = (0, None)
    table: list[str] = []
    groups = 0
    for number, line in enumerate(text.splitlines(), start=1):
        header = re.match(r"\s*\[+\s*([^\[\]]*?)\s*\]+", line)
        key = re.match(r"\s*([A-Za-z0-9_.\"'-]+)\s*=", line)
        if header:
            table = header[1].replace('"', "").split(".")
            if line.lstrip().startswith("[["):
                table, groups = [f"{table[0]}[{groups}]"], groups + 1
            here = table
        elif key:
            here = [*table, *key[1].replace('"', "").replace("'", "").split(".")]
        else:
            continue
        if len(here) > best[0] and here == wanted[: len(here)]:
            best = len(here), number
    return best[1]
