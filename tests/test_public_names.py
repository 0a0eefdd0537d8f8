"""What is public: the names that packages list, where each is defined, and what their docstrings tell."""

import ast
import dataclasses
import importlib
import importlib.metadata
import inspect
import pkgutil
import re
import runpy
import typing

import numpy as np
import pytest
from test_architecture import PACKAGES, ROOT, relative

import microid

# Modules in which names are public, each name in one of them.
MODULES = [
    *PACKAGES,
    *(f"microid.{name}" for name in ("control", "densities", "effects", "hysteresis", "kinetostatics")),
]


def listed(package):
    """Public names that a package's `__init__.py` lists by hand, each with the module it comes from."""
    tree = ast.parse((ROOT / package.replace(".", "/") / "__init__.py").read_text(encoding="utf-8"))
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in PACKAGES:
            for alias in node.names:
                if (alias.asname or "").startswith("_"):
                    continue
                if f"{node.module}.{alias.name}" in MODULES:
                    continue
                assert alias.name not in names, f"{package} lists {alias.name} twice"
                names[alias.name] = node.module
    return names


def is_defined(value):
    """Whether a name stands for a class or a function of its module, not for a constant or the name of a type."""
    return callable(value) and typing.get_origin(value) is None


@pytest.mark.parametrize("package", MODULES)
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
    import fits

    assert microid.__version__ == fits.__version__ == importlib.metadata.version("microid")
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = microid.nothing


def test_names_that_fits_looks_up_late_are_the_ones_it_declares():
    import fits

    assert listed("fits") == fits._HOMES
    assert dir(fits) == sorted(fits.__all__)
    assert listed("microid").items() <= microid._HOMES.items()
    with pytest.raises(AttributeError, match="'fits' has no attribute 'nothing'"):
        fits.nothing


@pytest.mark.parametrize("package", MODULES)
def test_public_names_are_in_all(package):
    assert sorted(importlib.import_module(package).__all__) == sorted(listed(package))


def test_a_model_is_public_in_one_place():
    homes = [name for name in MODULES if name.startswith("microid")]
    every = [name for home in homes for name in listed(home)]
    # What registers a plug-in is in the folder of its kind.
    assert {name for name in every if every.count(name) > 1} == {"register"}
    assert len(listed("microid")) < 60
    # Found without being imported by itself.
    assert all(getattr(microid, home.partition(".")[2]).__name__ == home for home in homes[1:])


def test_everything_that_microid_defines_without_an_underscore_is_public():
    names = {name for home in MODULES if home.startswith("microid") for name in listed(home)}
    for path in (ROOT / "microid").rglob("*.py"):
        defined = ast.parse(path.read_text(encoding="utf-8")).body
        found = {node.name for node in defined if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        if path.stem in ("_late", "_plugins"):  # how packages import their own
            continue
        public = {name for name in found if name[0] != "_"}
        if path.parent.name == "effects" and path.stem[0] != "_":
            # An effect is public by being registered, so that a new one is one new file.
            effects = {effect.__name__: effect.__module__ for effect in microid.effects.EFFECTS}
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


@pytest.mark.parametrize("package", MODULES)
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


def silent_numbers(value):
    """Numbers whose name has no unit, and of which the docstring does not tell."""
    words = (inspect.getdoc(value) or "").lower()
    unnamed = (name for name in numbers_of(value) if not UNIT.search(name))
    return [name for name in unnamed if not any(part[:4] in words for part in name.lower().split("_"))]


@pytest.mark.parametrize("package", MODULES)
def test_public_numbers_have_a_unit_in_their_name_or_their_docstring_tells_of_them(package):
    module = importlib.import_module(package)
    values = {name: getattr(module, name) for name in module.__all__}
    silent = {name: silent_numbers(value) for name, value in values.items() if is_defined(value)}
    assert {name: numbers for name, numbers in silent.items() if numbers} == {}


@pytest.mark.parametrize("package", [name for name in MODULES if name != "data_synth"])
def test_the_site_has_every_public_name_in_a_group_and_words_of_each(package):
    conf = runpy.run_path(str(ROOT / "docs" / "site" / "conf.py"))
    module, source = importlib.import_module(package), ["# Names\n"]
    groups = dict(conf["groups_of"](module))
    assert sorted(name for names in groups.values() for name in names) == sorted(module.__all__)
    assert all(names == sorted(names) for names in groups.values())
    # Of a constant without words below it there is an error.
    conf["grouped"](None, f"docs/site/names/{package}", source)
    shown = re.findall(r"^\.\. (?:autoclass|autoexception|autofunction|data):: (\w+)$", source[0], re.MULTILINE)
    assert sorted(shown) == sorted(module.__all__)
    assert f"names/{package}\n" in (ROOT / "docs" / "site" / "index.md").read_text(encoding="utf-8")
    with pytest.raises(AssertionError, match="from nowhere"):
        conf["words_of"](module, "nothing")


# What says in a docstring in which unit a number is, or that it has none, or where that stands.
TOLD = re.compile(
    r"\b(um|V|s|Hz|N|mm|rad|urad|deg|unit|units|output_unit|%|part|share|ratio|stiffness|gains?|probability|cell|limits|"
    r"[Mm]atrices|[Cc]oordinates|[Cc]orrelation|[Nn]umber|[Pp]art|norm)\b|[Ss]ee `|`command_V`|_(um|V|mm|rad)\b"
)


def results_without_unit(owner, value):
    """Functions and properties of a class, and a function itself, that give numbers in no unit that is told."""
    members = (
        {owner: value}
        if not inspect.isclass(value)
        else {
            f"{owner}.{name}": getattr(member, "__func__", member)
            for name, member in vars(value).items()
            if name[0] != "_"
        }
    )
    for name, member in members.items():
        function = member.fget if isinstance(member, property) else member
        if not inspect.isfunction(function):
            continue
        given = str(inspect.signature(function).return_annotation)
        words = inspect.getdoc(function) or ""
        if re.search(r"\b(float|ndarray|NDArray|Array|Float)\b", given) and not (
            UNIT.search(name) or TOLD.search(words)
        ):
            yield name


@pytest.mark.parametrize("package", MODULES)
def test_results_have_a_unit_in_their_name_or_their_docstring_tells_it(package):
    module = importlib.import_module(package)
    values = {name: getattr(module, name) for name in module.__all__}
    found = [one for name, value in values.items() if is_defined(value) for one in results_without_unit(name, value)]
    assert found == []


def test_a_number_without_a_unit_is_seen():
    def push(force: float, voltage_V: float, travel: np.ndarray) -> float:
        """Push by a force in N."""

    assert numbers_of(push) == ["force", "voltage_V", "travel"]
    assert silent_numbers(push) == ["travel"]
    assert sum(len(numbers_of(getattr(microid.control, name))) for name in ("PID", "simulate_loop")) > 10
    assert list(results_without_unit("push", push)) == []
    push.__doc__ = "Push."
    assert list(results_without_unit("push", push)) == ["push"]
    push.__doc__ = None
    assert dict(documented("push", push)) == {"push": False}
