"""What `microid` declares of its parts, taken off its files: importing them would start JAX."""

import __future__

import ast
import builtins
import importlib.util
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

# The method of an effect that is its form in NumPy.
_METHOD = "in_numpy"


@dataclass(frozen=True)
class Declared:
    """What `microid.param` says of a field: its unit, scale and bounds, and how many values it has."""

    unit: str
    scale: float = 1.0
    lower: float = -math.inf
    upper: float = math.inf
    default: float | None = None
    shape: tuple[int, ...] = ()

    def slope(self, value: float) -> float:
        """Derivative of the parameter by its coordinate, at a value off its bounds; see `microid.Coordinates`."""
        below, above = value - self.lower, self.upper - value
        if math.isfinite(below) and math.isfinite(above):
            return below * above / (self.upper - self.lower)
        return self.scale * -math.expm1(-min(below, above) / self.scale)

    def inside(self, value: float) -> bool:
        """Whether a value is off its bounds: on them, coordinates are infinite."""
        return self.lower + 1e-6 * self.scale < value < self.upper - 1e-6 * self.scale


@dataclass(frozen=True)
class Form:
    """An effect in NumPy: its fields in their order, None for what is given, and what it does.

    `gives` is the unit of what comes out, and fields of the `history` are zero in this form.
    """

    fields: Mapping[str, Declared | None]
    gives: str
    history: tuple[str, ...]
    run: Callable[..., Any]


def tools() -> ModuleType:
    """The module `microid._in_numpy`, without the package around it."""
    name = f"microid._{_METHOD}"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, _folder() / f"_{_METHOD}.py")
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


@cache
def declared() -> dict[str, dict[str, Declared]]:
    """Fields of the linear parts of `microid` by the names of both, in their order."""
    classes = _classes((_folder() / "_plant.py").read_text(encoding="utf-8"))
    space = {"param": Declared}
    return {each.name: {name: said for name, said in _fields(each, space) if said} for each in classes}


@cache
def form_of(kind: str) -> Form:
    """The form in NumPy of the effect whose class has this name; a `LookupError` where it has none.

    Of its file no more is run than imports of NumPy and `microid._in_numpy`, constants and functions.
    """
    for file in sorted((_folder() / "effects").glob("[!_]*.py")):
        text = file.read_text(encoding="utf-8")
        found = [each for each in _classes(text) if each.name == kind] if f"class {kind}(" in text else []
        methods = [node for each in found for node in each.body if getattr(node, "name", "") == _METHOD]
        if methods:
            space = _space(ast.parse(text), str(file))
            stated = {key: ast.literal_eval(value) for key, value in _class_variables(found[0], "gives", "history")}
            _run(methods, str(file), space)
            return Form(dict(_fields(found[0], space)), stated["gives"], stated.get("history", ()), space[_METHOD])
    raise LookupError(f"{kind} has no form in NumPy")


def _folder() -> Path:
    package = importlib.util.find_spec("microid")
    assert package is not None
    assert package.origin is not None
    return Path(package.origin).parent


def _classes(text: str) -> list[ast.ClassDef]:
    return [node for node in ast.parse(text).body if isinstance(node, ast.ClassDef)]


def _space(tree: ast.Module, file: str) -> dict[str, Any]:
    """Names of a file that a form may use; those that take more than NumPy are missing."""
    space: dict[str, Any] = {"np": np, "math": math, "param": Declared, "array": lambda **_: None}
    kept: list[ast.stmt] = []
    known = {*space, *dir(builtins)}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module == f"microid._{_METHOD}":
            space |= {alias.asname or alias.name: getattr(tools(), alias.name) for alias in node.names}
        elif isinstance(node, ast.FunctionDef) and not node.decorator_list:
            kept.append(node)
        elif isinstance(node, ast.Assign) and {
            one.id for one in ast.walk(node.value) if isinstance(one, ast.Name)
        } <= {*known, *space}:
            kept.append(node)
            known |= {one.id for target in node.targets for one in ast.walk(target) if isinstance(one, ast.Name)}
    _run(kept, file, space)
    return space


def _run(nodes: list[Any], file: str, space: dict[str, Any]) -> None:
    """Run statements of a file, whose annotations are left as they stand."""
    flags = __future__.annotations.compiler_flag
    exec(compile(ast.Module(nodes, []), file, "exec", flags, dont_inherit=True), space)


def _class_variables(of: ast.ClassDef, *names: str) -> Iterator[tuple[str, ast.expr]]:
    for node in of.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.target.id in names:
            assert node.value is not None
            yield node.target.id, node.value


def _fields(of: ast.ClassDef, space: dict[str, Any]) -> Iterator[tuple[str, Declared | None]]:
    """Fields that are declared by a call, such as of `param`, evaluated there."""
    for node in of.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.value, ast.Call) and isinstance(node.target, ast.Name):
            said = eval(compile(ast.Expression(node.value), of.name, "eval"), dict(space))
            axes = [one.value for one in ast.walk(node.annotation) if isinstance(one, ast.Constant)]
            shape = tuple(int(length) for length in str(axes[-1]).split()) if axes else ()
            yield node.target.id, said and Declared(**{**vars(said), "shape": shape})
