"""The rules of the house: who imports whom, what is public, what a class may inherit, what an import may do."""

import ast
import importlib
import importlib.metadata
import inspect
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("microid", "fits", "data_synth")
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
# Which of the three packages may be imported by which, and what the virtual bench must not need.
FORBIDDEN = {
    "microid": {"fits", "data_synth", "numba", "pandas", "scipy", "matplotlib", "click"},
    "fits": set(),
    "data_synth": {"microid", "fits", "jax", "jaxlib", "equinox", "optimistix", "lineax", "diffrax", "jaxtyping"},
}


def relative(path):
    return path.relative_to(ROOT).as_posix()


def imports(tree):
    """Every package that is imported, by statement or by name, with the functions around the place."""

    def walk(node, around):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            around = (*around, node.name)
        if isinstance(node, ast.Import):
            yield from ((alias.name.partition(".")[0], around) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports name their package in full"
            yield (node.module or "").partition(".")[0], around
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in (
            "import_module",
            "__import__",
            "run_module",
        ):
            yield from (
                (text.value.partition(".")[0], around)
                for text in ast.walk(node)
                if isinstance(text, ast.Constant) and isinstance(text.value, str)
            )
        for child in ast.iter_child_nodes(node):
            yield from walk(child, around)

    return list(walk(tree, ()))


@pytest.mark.parametrize("path", FILES, ids=relative)
def test_imports_go_down_the_floors(path):
    package = path.relative_to(ROOT).parts[0]
    for imported, around in imports(ast.parse(path.read_text(encoding="utf-8"))):
        assert imported not in FORBIDDEN[package], f"{relative(path)} imports {imported}"
        if package == "fits" and imported == "data_synth":
            # The commands that write examples, and nothing that estimates.
            commands = [name for name in (path.stem, *around) if "synth" in name or "paper" in name]
            room = path.relative_to(ROOT).parts[1]
            assert room == "paper" or (room == "cli" and commands), f"{relative(path)} imports data_synth"


def test_the_walk_sees_imports_of_every_kind():
    tree = ast.parse(
        "import a.b, c as d\nfrom e.f import g\ndef synth():\n    import h\n    import_module('i.j')\n"
        "importlib.import_module(f'k.{x}')\n__import__('l')\n"
    )
    found = dict(imports(tree))
    assert found == {"a": (), "c": (), "e": (), "h": ("synth",), "i": ("synth",), "k": (), "l": ()}


@pytest.mark.parametrize("path", FILES, ids=relative)
def test_files_stay_short(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 350


@pytest.mark.parametrize("path", sorted(Path(__file__).parent.glob("*.py")), ids=relative)
def test_tests_stay_short(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 350


def classes():
    found = {}
    for package in PACKAGES:
        for info in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
            if info.name.endswith("__main__"):
                continue
            for value in vars(importlib.import_module(info.name)).values():
                if inspect.isclass(value) and value.__module__.partition(".")[0] in PACKAGES:
                    found[f"{value.__module__}.{value.__qualname__}"] = value
    return found


def is_abstract(cls):
    # Abstract fields of equinox count as abstract methods do.
    missing = (
        getattr(cls, name, ()) for name in ("__abstractmethods__", "__abstractvars__", "__abstractclassvars__")
    )
    return any(missing) or getattr(cls, "_is_protocol", False)


def overridden(cls):
    """Names that a class defines although a class above it, of ours, has already implemented them."""
    for base in cls.__mro__[1:]:
        if base.__module__.partition(".")[0] in PACKAGES:
            for name, above in vars(base).items():
                implemented = inspect.isroutine(above) or isinstance(above, property)
                own = not (name.startswith("__") and name.endswith("__"))
                if implemented and own and name in vars(cls) and not getattr(above, "__isabstractmethod__", False):
                    yield f"{base.__name__}.{name}"


def test_classes_are_abstract_or_final():
    found = classes()
    assert len(found) > 20
    for name, cls in found.items():
        ours = [base for base in cls.__mro__[1:] if base.__module__.partition(".")[0] in PACKAGES]
        assert all(is_abstract(base) for base in ours), f"{name} inherits from a concrete class"
        assert list(overridden(cls)) == [], f"{name} overrides what is implemented"


def run_python(code, **environment):
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )


IMPORTS = """
import importlib, inspect, pkgutil, sys
import numpy as np
kept = []
for package in ("microid", "fits", "data_synth"):
    modules = [importlib.import_module(package)]
    for info in pkgutil.walk_packages(modules[0].__path__, package + "."):
        if not info.name.endswith("__main__"):
            modules.append(importlib.import_module(info.name))
    for module in modules:
        values = dict(vars(module))
        for name, function in list(values.items()):
            if inspect.isfunction(function):
                for parameter in inspect.signature(function).parameters.values():
                    values[f"{name}({parameter.name})"] = parameter.default
        kept += [f"{module.__name__}.{k}" for k, v in values.items() if isinstance(v, np.ndarray)]
assert not kept, f"arrays in module scope or default arguments: {kept}"
import jax
assert not jax.config.jax_enable_x64, "an import switched float64 on"
try:
    jax.numpy.zeros(1)
except RuntimeError as error:
    assert "no_such_platform" in str(error)
else:
    raise AssertionError("this test is blind: JAX has started on a platform that does not exist")
"""


def test_imports_start_no_backend_and_make_no_arrays():
    """On a platform that does not exist JAX refuses to start, so any array made by an import is an error."""
    done = run_python(IMPORTS, JAX_PLATFORMS="no_such_platform")
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


SHAPES = """
import sys, types, typing
from beartype import beartype
from jaxtyping import install_import_hook

def check(function):
    # beartype knows Self in classes only, and the hook decorates functions.
    hints = getattr(function, "__annotations__", {})
    hints.update({name: typing.Any for name, hint in hints.items() if "typing.Self" in repr(hint)})
    return beartype(function)

sys.modules["checker"] = types.SimpleNamespace(check=check)
with install_import_hook("microid", "checker.check"):
    import microid as m
    # Names are imported on their first use.
    used = [getattr(m, name) for name in dir(m)]
import equinox as eqx, jax, jax.numpy as jnp, numpy as np
from jaxtyping import TypeCheckError

lower, upper, stroke = jnp.array(-1.0), jnp.array(9.0), jnp.array(3.0)
voltage = np.linspace(-1.0, 9.0, 12, dtype=np.float32)

def everything(model, voltage):
    memory = m.remember(voltage, m.demagnetised(-1.0, 9.0, 2.0, 9))
    end = memory.end()
    coordinates = m.Coordinates(model)
    loss = lambda vector, v: jnp.sum(coordinates(vector)(v, m.positive_saturation(-1.0, 9.0)))
    vector = coordinates.of(model)
    both = jax.grad(loss, argnums=(0, 1))(vector, voltage), jax.jvp(loss, (vector, voltage), (vector, voltage))
    return (
        model(voltage), model(voltage, end), model.respond(memory), both, model.weights_um,
        model.everett(voltage, voltage[0]), model.everett.intervals, model.density(voltage, voltage[:1, None]),
        model.reversible(voltage[None]), model.density.levels_V, memory.end(5),
    )

for name, family in m.densities.FAMILIES.items():
    density = family.start(lower, upper, 6, stroke, jax.random.key(0))
    model = m.Preisach(density, m.Reversible(jnp.ones(6), -1.0, 9.0), 0.5)
    eqx.filter_eval_shape(everything, model, voltage)
    many = jax.vmap(lambda v: model(v))
    jax.eval_shape(many, voltage[None])
    assert m.parameter_table(model)

for wrong in (voltage[None], voltage[0], np.arange(3)):
    try:
        eqx.filter_eval_shape(model, wrong)
    except TypeCheckError:
        pass
    else:
        raise AssertionError(f"nothing checks shapes: {wrong.shape}, {wrong.dtype}")
"""


@pytest.mark.study
def test_shapes_are_as_annotated():
    """All of `microid` under a run-time type checker; tracing is enough, nothing is compiled for it."""
    done = run_python(SHAPES)
    assert done.returncode == 0, done.stderr[-3000:]
