"""What is public: the names that packages list, where each is defined, and what their docstrings tell."""

import ast
import dataclasses
import importlib
import importlib.metadata
import inspect
import pkgutil
import re
import typing

import pytest
from test_architecture import PACKAGES, ROOT, relative

import microid


def listed(package):
    """Public names that a package's `__init__.py` lists by hand, each with the module it comes from."""
    tree = ast.parse((ROOT / package.replace(".", "/") / "__init__.py").read_text(encoding="utf-8"))
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in PACKAGES:
            for alias in node.names:
                if (alias.asname or "").startswith("_"):
                    continue
                grouped = package in ("fits", "microid") and alias.asname is None
                assert grouped or alias.asname == alias.name, (
                    f"{package} lists {alias.name} without `as {alias.name}`"
                )
                assert alias.name not in names, f"{package} lists {alias.name} twice"
                names[alias.name] = node.module
    return names


def is_defined(value):
    """Whether a name stands for a class or a function of its module, not for a constant or the name of a type."""
    return callable(value) and typing.get_origin(value) is None


@pytest.mark.parametrize(
    "package", [*PACKAGES, "microid.control", "microid.densities", "microid.effects", "microid.hysteresis"]
)
def test_public_names_are_the_listed_ones(package):
    module, names = importlib.import_module(package), listed(package)
    assert names
    for name, home in names.items():
        value = getattr(module, name)
        assert value is getattr(importlib.import_module(home), name)
        if is_defined(value):
            assert value.__module__.startswith(home), f"{package} lists {name} from where it is not defined"
    submodules = {found.name for found in pkgutil.iter_modules(module.__path__)}
    public = {name for name in dir(module) if not name.startswith("_")} - submodules
    assert public - {"TYPE_CHECKING", "Any", "Path", "ast", "importlib", "pkgutil"} == set(names)


def test_the_version_is_that_of_the_package():
    assert microid.__version__ == importlib.metadata.version("microid")
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = microid.nothing


def test_names_that_fits_looks_up_late_are_the_ones_it_declares():
    import fits

    assert listed("fits") == fits._HOMES
    assert dir(fits) == sorted(fits.__all__)
    with pytest.raises(AttributeError, match="'fits' has no attribute 'nothing'"):
        fits.nothing


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_are_in_all(package):
    assert sorted(importlib.import_module(package).__all__) == sorted(listed(package))


def test_everything_that_microid_defines_without_an_underscore_is_public():
    names = set(listed("microid")) | set(listed("microid.densities")) | set(listed("microid.hysteresis"))
    names |= set(listed("microid.effects"))
    for path in (ROOT / "microid").rglob("*.py"):
        defined = ast.parse(path.read_text(encoding="utf-8")).body
        found = {node.name for node in defined if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        if path.stem == "_plugins":  # for packages of microid alone
            continue
        public = {name for name in found if name[0] != "_"}
        if path.parent.name == "effects" and path.stem[0] != "_":
            # An effect is public by being registered, so that a new one is one new file.
            effects = {effect.__name__: effect.__module__ for effect in microid.EFFECTS}
            assert public == {name for name, home in effects.items() if home == f"microid.effects.{path.stem}"}
            continue
        assert public <= names, relative(path)


def test_modules_are_private():
    for package in PACKAGES:
        # Each file there is a plug-in, and named after what it adds.
        public = ("cli", "columns", "control", "densities", "effects", "formats", "hysteresis", "kinds")
        for path in (ROOT / package).rglob("*.py"):
            assert path.name.startswith("_") or path.parent.name in public, relative(path)


def documented(owner, value):
    """The value, and what a class defines itself, as pairs of a name and whether there is a docstring."""
    yield owner, bool(inspect.getdoc(value))
    if inspect.isclass(value):
        for name, member in vars(value).items():
            function = getattr(member, "__func__", member)
            if not name.startswith("_") and (inspect.isfunction(function) or isinstance(member, property)):
                yield f"{owner}.{name}", bool(inspect.getdoc(member))


@pytest.mark.parametrize(
    "package", [*PACKAGES, "microid.control", "microid.densities", "microid.effects", "microid.hysteresis"]
)
def test_public_names_have_docstrings(package):
    module = importlib.import_module(package)
    values = {name: getattr(module, name) for name in listed(package)}
    callables = {name: value for name, value in values.items() if is_defined(value)}
    missing = [name for key, value in callables.items() for name, has in documented(key, value) if not has]
    assert missing == []


UNIT = re.compile(r"_(V|um|s|ms|Hz|pct|deg|mm|rad|GPa|MB|degC|[a-zA-Z]+_per_\w+)$")


def numbers_of(value):
    """Names of the fields of a class, or the arguments of a function, that are real numbers or arrays of them."""
    if inspect.isclass(value):
        kinds = (
            {each.name: each.type for each in dataclasses.fields(value)} if dataclasses.is_dataclass(value) else {}
        )
    else:
        kinds = {name: each.annotation for name, each in inspect.signature(value).parameters.items()}
    real = re.compile(r"\b(float|ndarray|NDArray|Array|Float)\b")
    return [name for name, kind in kinds.items() if name[0] != "_" and real.search(str(kind))]


@pytest.mark.parametrize("package", ["microid", "fits"])
def test_public_numbers_have_a_unit_in_their_name_or_their_docstring_tells_of_them(package):
    module, silent, seen = importlib.import_module(package), [], 0
    for name in module.__all__:
        value = getattr(module, name)
        for number in numbers_of(value) if is_defined(value) else ():
            seen += 1
            told = any(word[:4] in inspect.getdoc(value).lower() for word in number.lower().split("_"))
            silent += [] if UNIT.search(number) or told else [f"{name}.{number}"]
    assert seen > 100
    assert silent == []
