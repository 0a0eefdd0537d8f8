"""Designs of stages as TOML files."""

import math
import os
import re
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import msgspec

from fits.io._atomic import atomic_write_text
from fits.io._errors import DataError, shown
from fits.io._read_file import MOST_TOML_BYTES, parse_toml, read_text
from fits.io._typed import typed
from fits.machining._design import TOLERANCE_MM, Design, Together, lever_mm
from microid import kinetostatics as ks

SCHEMA = "microid.stage/1"
# What to multiply by, or to divide by where that is exact.
_LENGTH = {"mm": (1.0, 1.0), "um": (1.0, 1e3), "m": (1e3, 1.0)}
_STROKE = {"um": (1.0, 1.0), "mm": (1e3, 1.0), "m": (1e6, 1.0)}
_ANGLE = {"rad": (1.0, 1.0), "mrad": (1.0, 1e3), "deg": (math.pi / 180, 1.0)}
_INERTIA = {"kg mm^2": (1.0, 1.0), "kg m^2": (1e6, 1.0)}
_MASS = {"kg": (1.0, 1.0), "g": (1.0, 1e3)}
_MODULUS = {"GPa": (1.0, 1.0), "MPa": (1.0, 1e3)}
_Units = Mapping[str, tuple[float, float]]

# Key, units (the first is the one written), field of `microid.kinetostatics.Actuation`, and meaning.
_ACTUATION: tuple[tuple[str, _Units, str, str], ...] = (
    ("piezo_stiffness", {"N/um": (1.0, 1.0), "N/m": (1.0, 1e6)}, "piezo_N_per_um", "of a piezo, small signal"),
    ("free_stroke", _STROKE, "free_stroke_um", "elongation of a piezo without a load at the highest voltage"),
    ("voltage", {"V": (1.0, 1.0)}, "voltage_V", "the highest"),
    ("mass_xy", _MASS, "mass_xy_kg", "moved along x or y"),
    ("mass_z", _MASS, "mass_z_kg", "moved along z"),
    ("inertia_tilt", _INERTIA, "inertia_tilt_kg_mm2", "turned about x or y"),
    ("inertia_rotor", _INERTIA, "inertia_rotor_kg_mm2", "turned about z"),
    ("damping_ratio", {}, "damping_ratio", "of all axes"),
)


class _Quantity(msgspec.Struct):
    value: float
    unit: str


class _Dimension(msgspec.Struct):
    value: float
    unit: str
    tolerance: float | None = None


class _Material(msgspec.Struct):
    youngs_modulus: _Quantity
    guides: float


class _Group(msgspec.Struct):
    dimensions: list[str]
    correlation: float


_Geometry = msgspec.defstruct("_Geometry", [(name, _Dimension) for name in ks.DIMENSIONS])
_Actuation = msgspec.defstruct("_Actuation", [(key, _Quantity if units else float) for key, units, *_ in _ACTUATION])


class _Stage(msgspec.Struct):
    schema: str
    level: int
    geometry: _Geometry  # type: ignore[valid-type]
    material: _Material
    actuation: _Actuation  # type: ignore[valid-type]
    together: list[_Group] = []


def read_design(path: str | os.PathLike[str]) -> Design:
    """Read the design of a stage, in mm and rad, from TOML as `write_design` writes it.

    Lengths may be in mm, um or m and angles in rad, mrad or deg; a tolerance is in the unit of its dimension, and
    0.02 mm, for an angle over its leg, where none is given. A `DataError` says that the file cannot be read, or names
    the first thing in it that is not as it should be.
    """
    name = os.fspath(path)
    text = read_text(path, "the TOML file of a stage", MOST_TOML_BYTES)
    table = parse_toml(text, name)
    try:
        return _design(table)
    except DataError as error:
        line = _line_of(text, str(error).partition(":")[0])
        raise DataError(f"{name}{'' if line is None else f', line {line}'}: {error}") from None


def write_design(design: Design, path: str | os.PathLike[str]) -> None:
    """Write a design as TOML, which `read_design` reads back to the last digit; errors are those of `atomic_path`."""
    atomic_write_text(path, design_text(design))


def design_text(design: Design) -> str:
    levels = "# 0: Euler-Bernoulli leaves between rigid blocks; 1: elastic roots, shear, links."
    lines = [f'schema = "{SCHEMA}"', levels, f"level = {design.level}", "", "[geometry]"]
    platform = ""
    for name, dimension in ks.DIMENSIONS.items():
        if dimension.platform != platform:
            platform = dimension.platform
            lines.append(f"# {platform.capitalize()} platform")
        tolerance = f", tolerance = {float(design.tolerance[name])!r}"
        written = _written(design.geometry[name], dimension.unit, tolerance)
        lines.append(f"{name} = {written}  # {dimension.meaning}")
    lines += ["", "[material]", f"youngs_modulus = {_written(design.youngs_modulus_GPa, 'GPa')}  # of all flexures"]
    lines += [f"guides = {float(design.guides)!r}  # guiding legs of a translation in x or y", "", "[actuation]"]
    for key, units, field, meaning in _ACTUATION:
        lines.append(f"{key} = {_written(getattr(design.actuation, field), next(iter(units), None))}  # {meaning}")
    for group in design.together:
        names = ", ".join(f'"{name}"' for name in group.dimensions)
        lines += ["", "[[together]]", f"dimensions = [{names}]  # whose errors go together"]
        lines.append(f"correlation = {float(group.correlation)!r}")
    return "\n".join([*lines, ""])


def _written(value: Any, unit: str | None, more: str = "") -> str:
    number = repr(float(value))
    return number if unit is None else f'{{ value = {number}, unit = "{unit}"{more} }}'


def _design(table: Mapping[str, Any]) -> Design:
    """Build a design; a `DataError` begins with the place of its cause, such as `geometry.t2`."""
    # First of all: keys of another file are not ours to show.
    if table.get("schema") != SCHEMA:
        found = shown(table["schema"]) if "schema" in table else "none"
        raise DataError(f'schema: expected "{SCHEMA}", found {found}; give that, or another file.')
    stage = typed(table, _Stage)
    sizes, tolerance = {}, {}
    for name, dimension in ks.DIMENSIONS.items():
        written = getattr(stage.geometry, name)
        units = _ANGLE if dimension.unit == "rad" else _LENGTH
        sizes[name] = _converted(written.value, written.unit, units, f"geometry.{name}")
        if written.tolerance is not None:
            tolerance[name] = _converted(written.tolerance, written.unit, units, f"geometry.{name}")
    geometry = ks.Geometry(**{ks.DIMENSIONS[name].field: jnp.asarray(size) for name, size in sizes.items()})
    # A leg of no length is refused below.
    usual = {name: TOLERANCE_MM / (lever_mm(geometry, name) or 1.0) for name in ks.DIMENSIONS}
    moved = {}
    for key, scale, field, _ in _ACTUATION:
        number, place = getattr(stage.actuation, key), f"actuation.{key}"
        moved[field] = _converted(number.value, number.unit, scale, place) if scale else number
        if not moved[field] > 0:
            raise DataError(f"{place}: expected a number above 0, found {moved[field]:g}; correct it.")
    modulus = stage.material.youngs_modulus
    return Design(
        geometry=geometry,
        tolerance=usual | tolerance,
        level=stage.level,
        guides=stage.material.guides,
        youngs_modulus_GPa=_converted(modulus.value, modulus.unit, _MODULUS, "material.youngs_modulus"),
        actuation=ks.Actuation(**{field: jnp.asarray(value) for field, value in moved.items()}),
        together=tuple(Together(tuple(group.dimensions), group.correlation) for group in stage.together),
    )


def _converted(value: float, unit: str, units: _Units, place: str) -> float:
    """A value in the first of some units."""
    plain = unit.replace("µ", "u").replace("μ", "u")
    if plain not in units:
        raise DataError(f"{place}.unit: expected one of {', '.join(units)}, found {shown(unit)}; convert the value.")
    times, over = units[plain]
    return value * times / over


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
