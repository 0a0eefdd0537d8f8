"""Programs that are kept between calls of the command: tracing a stage takes longer than to compute what it does."""

import functools
import hashlib
import io
import os
import pickle
import sys
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.export
import jax.numpy as jnp
import numpy as np

_P = ParamSpec("_P")
_R = TypeVar("_R")
# Packages of which a program depends on no more than the version, and those that may change from call to call.
_OTHERS = "jax", "jaxlib", "equinox", "lineax", "optimistix", "numpy"
_OWN = "microid", "fits"
_KNOWN = {*_OTHERS, *_OWN, "builtins"}
# What nobody has used for a month is removed; file systems note at least once a day that a file was read.
_UNUSED_s = 30 * 86400.0
# Where programs are kept, since `keep_in`.
_place: list[Path] = []
# Programs that this process holds, the last used at the end, and how many at most: each takes some megabytes.
_held: OrderedDict[Any, Future[Callable[..., Any]]] = OrderedDict()
_MOST = 96
_lock = threading.Lock()


@dataclass(frozen=True)
class _Place:
    """Where the array of such a number belongs in a result."""

    number: int


class _Unknown(Exception):
    """Something that a name does not tell: it may be another in the next call."""


class _Key(pickle.Pickler):
    """Writes what decides what is traced: equal bytes are of equal programs."""

    def __init__(self, file: io.BytesIO):
        super().__init__(file)
        # Without it equal values that are one object, or two, would be written differently.
        self.fast = True

    def reducer_override(self, value: Any) -> Any:
        # A class or a function is written as no more than its name.
        if hasattr(value, "__qualname__") and str(value.__module__).partition(".")[0] not in _KNOWN:
            raise _Unknown
        return NotImplemented


def keep_in(folder: Path | None) -> None:
    """Keep the programs of all `kept` functions in a folder from now on; None keeps none."""
    _place[:] = [] if folder is None else [folder]


def kept(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a function as `equinox.filter_jit` does, and where programs are kept, trace it in the first call only.

    Programs are told apart by the name of the function, all that is no array, the shapes of arrays, versions,
    settings, and every line of this package: of a function or class of another nothing is kept. A process holds those
    that it used last.
    """
    plain = eqx.filter_jit(function)

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        leaves, form = jax.tree.flatten((args, kwargs))
        arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
        if any(isinstance(array, jax.core.Tracer) for array in arrays):
            return plain(*args, **kwargs)
        kinds = tuple(
            (leaf.shape, leaf.dtype, leaf.weak_type) if eqx.is_array(leaf) else (type(leaf), leaf) for leaf in leaves
        )
        asked = function, *_place, form, kinds
        with _lock:
            is_new = asked not in _held
            program = _held.setdefault(asked, Future())
            _held.move_to_end(asked)
            if len(_held) > _MOST:
                _held.popitem(last=False)
        if is_new:
            try:
                program.set_result(_compiled(function, args, kwargs))
            except BaseException as error:
                _held.pop(asked, None)
                program.set_exception(error)
        return program.result()(arrays)

    return call


def forget_programs() -> None:
    """Free all that this process has compiled."""
    _held.clear()
    jax.clear_caches()


def _kind(array: Any) -> tuple[Any, ...]:
    return array.shape, str(array.dtype), getattr(array, "weak_type", False)


def _compiled(function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Callable[..., Any]:
    """A function compiled for arguments like these: traced, or read from the folder where there is one.

    What is compiled is held by nobody else, unlike what `jax.jit` compiles when it is called.
    """
    arrays, static = eqx.partition((args, kwargs), eqx.is_array)
    leaves = jax.tree.leaves(arrays)
    exported = _exported(_place[0], function, arrays, static) if _place else None
    if exported is None:
        flat, given = _flat(function, arrays, static)
        compiled = flat.lower(*leaves).compile()
        places, rest = given
    else:
        stored, places, rest = exported

        def program(*leaves: Any) -> Any:
            return stored.call(*leaves)

        program.__name__ = function.__name__
        compiled = jax.jit(program).lower(*leaves).compile()
    # What it gives beside arrays is the same each time.
    given, form = jax.tree.flatten(eqx.combine(jax.tree.map(_Place, places), rest))

    def call(leaves: Sequence[Any]) -> Any:
        values = compiled(*leaves)
        if exported is not None:
            # Their values alone: they come bound to a device, for which others would be compiled once more.
            values = [jnp.asarray(np.asarray(value)) for value in values]
        return jax.tree.unflatten(form, [values[one.number] if isinstance(one, _Place) else one for one in given])

    return call


def _exported(folder: Path, function: Callable[..., Any], arrays: Any, static: Any) -> tuple[Any, Any, Any] | None:
    """A program from the folder, traced anew if it is not there; None where it cannot be kept.

    With it come the places of the arrays that it gives, and what else it gives.
    """
    if function.__module__.partition(".")[0] not in _OWN:
        return None
    content = io.BytesIO()
    try:
        _Key(content).dump((function.__module__, function.__qualname__, jax.tree.map(_kind, arrays), static))
    except (_Unknown, pickle.PicklingError, AttributeError, TypeError, RecursionError):
        return None
    file = folder / hashlib.sha256(_circumstances() + content.getvalue()).hexdigest()
    found = _read(file)
    if found is None:
        try:
            found = _traced(function, arrays, static)
        except (ValueError, NotImplementedError):
            # What calls back into Python cannot be exported.
            return None
        _write(file, found)
    return found


def _traced(function: Callable[..., Any], arrays: Any, static: Any) -> tuple[Any, Any, Any]:
    flat, given = _flat(function, arrays, static)
    exported = jax.export.export(flat)(*jax.tree.leaves(arrays))
    # Nobody differentiates it, and the function that would cannot be written.
    return replace(exported, _get_vjp=None), *given


def _flat(function: Callable[..., Any], arrays: Any, static: Any) -> tuple[Any, list[Any]]:
    """A function of the arrays alone, and where tracing it puts their places in the result and what else it gives."""
    form = jax.tree.structure(arrays)
    given: list[Any] = []

    def flat(*leaves: Any) -> list[Any]:
        args, kwargs = eqx.combine(jax.tree.unflatten(form, leaves), static)
        result, rest = eqx.partition(function(*args, **kwargs), eqx.is_array)
        values, structure = jax.tree.flatten(result)
        given[:] = jax.tree.unflatten(structure, range(len(values))), rest
        return values

    flat.__name__ = function.__name__
    return jax.jit(flat), given


def _read(file: Path) -> tuple[Any, Any, Any] | None:
    """A program of the folder; None where there is none, or not all of it."""
    try:
        stated, content = file.read_bytes().split(b"\n", 1)
    except (OSError, ValueError):
        return None
    if stated != hashlib.sha256(content).hexdigest().encode():
        return None
    return pickle.loads(content)


def _write(file: Path, found: tuple[Any, Any, Any]) -> None:
    _remove_unused(file.parent)
    try:
        content = pickle.dumps(found)
        file.parent.mkdir(mode=0o700, exist_ok=True)
        # No output of a command: it need not be on the disk, nor be logged. `_read` knows what was cut off.
        with tempfile.NamedTemporaryFile(dir=file.parent, delete=False) as temporary:
            temporary.write(hashlib.sha256(content).hexdigest().encode() + b"\n" + content)
        os.replace(temporary.name, file)
    except (OSError, pickle.PicklingError, AttributeError, TypeError):
        # It is made anew in the next call.
        return


@functools.cache
def _remove_unused(folder: Path) -> None:
    """Remove, once in each process that keeps something new, what has not been used for long.

    Around the folder of what is kept here is that of what JAX has compiled.
    """
    for file in (*folder.glob("*"), *folder.parent.glob("*-cache")):
        # Another process may have removed it.
        with suppress(OSError):
            found = file.stat()
            if time.time() - max(found.st_atime, found.st_mtime) > _UNUSED_s:
                file.unlink()


@functools.cache
def _circumstances() -> bytes:
    """All that decides what is traced beside the arguments: versions, settings, and each line of this package."""
    stated = [sys.version, jax.default_backend(), str(jax.config.read("jax_enable_x64"))]
    stated += [f"{name} {version(name)}" for name in _OTHERS]
    stated += [f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith(("JAX_", "EQX_"))]
    lines = hashlib.sha256("\n".join(stated).encode())
    for package in _OWN:
        spec = find_spec(package)
        assert spec is not None
        assert spec.origin is not None
        for file in sorted(Path(spec.origin).parent.rglob("*.py")):
            lines.update(f"\n{package} {file.name}\n".encode() + file.read_bytes())
    return lines.digest()
