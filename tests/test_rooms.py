"""The rooms of `fits`: what each may import."""

import ast
import re

import pytest
from test_architecture import ROOT, imports, relative

import microid

# The rooms of `fits`; each may import from those before it.
ROOMS = (
    "io",
    "stats",
    "loop",
    "stage",
    "control",
    "machining",
    "diagnosis",
    "sweeps",
    "plots",
    "report",
    "paper",
    "cli",
)


# Imported by name and when it is used: a result's `plot()` is where `summary()` is, and its picture where all are.
BY_NAME = {"fits/io/_summary.py": {"plots"}}


def rooms_of(path):
    """Rooms of `fits` that a file imports from, by statement or by name."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        if isinstance(node, ast.Constant) and str(node.value).startswith("fits.") and " " not in str(node.value):
            names = [node.value]
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        for name in names:
            package, _, rest = name.partition(".")
            if package == "fits":
                assert rest, f"{relative(path)} imports the public names of fits, and so all of it"
                yield rest.partition(".")[0]


@pytest.mark.parametrize("path", sorted((ROOT / "fits").glob("*/**/*.py")), ids=relative)
def test_rooms_of_fits_import_only_those_below(path):
    room = path.relative_to(ROOT).parts[1]
    above = {*ROOMS[ROOMS.index(room) + 1 :]} - BY_NAME.get(relative(path), set())
    found = set(rooms_of(path))
    assert not found & above, f"{relative(path)} imports from {', '.join(sorted(found & above))}"
    assert found <= set(ROOMS)
    # Pictures are drawn in one room alone.
    drawn = "matplotlib" in {name for name, _ in imports(ast.parse(path.read_text(encoding="utf-8")))}
    assert room == "plots" or not drawn, f"{relative(path)} imports matplotlib"


def test_no_effect_is_known_by_its_name_in_fits():
    """What is known of an effect stands on its card, in its own file."""
    names = {effect.name for effect in microid.effects.EFFECTS}
    # A name of one word may also be a word of a sentence.
    compound = {name for name in names if "_" in name}
    assert len(compound) > 10
    for path in (ROOT / "fits").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found = {name for name in compound if name in node.value} | ({node.value} & names)
                assert not found, f"{relative(path)}:{node.lineno} names {', '.join(found)}"
            imported = getattr(node, "module", None) if isinstance(node, ast.ImportFrom) else None
            assert not (imported or "").startswith("microid.effects."), f"{relative(path)} imports from {imported}"


def test_rooms_are_what_the_folder_shows():
    here = {path.name for path in (ROOT / "fits").iterdir() if path.name != "__pycache__"}
    assert here == {*ROOMS, "__init__.py", "__main__.py"}


# What only the command calls, or reads for it, and how files are read.
OF_THE_COMMAND = {
    *("fits/report/_control.py", "fits/report/_model_words.py", "fits/report/_next_steps.py"),
    *("fits/control/_gains.py", "fits/control/_tune_problem.py", "fits/io/_in_python.py", "fits/io/_inspect.py"),
    *("fits/io/_limits.py", "fits/io/_read_csv.py", "fits/io/_table.py", "fits/io/_text_table.py"),
    "fits/io/_units.py",
}


def test_sentences_that_python_reads_too_name_no_options_of_the_command():
    paths = [path for path in (ROOT / "fits").rglob("*.py") if path.parent.name != "cli"]
    assert {relative(path) for path in paths} >= OF_THE_COMMAND
    for path in paths:
        if relative(path) not in OF_THE_COMMAND:
            strings = [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
            texts = [str(node.value) for node in strings if isinstance(node, ast.Constant)]
            options = {found for text in texts for found in re.findall(r"(?<![\w-])--[a-z][a-z-]*", text)}
            # What a docstring tells of the command is told to who reads the code.
            assert options <= {"--example", "--write-stage"}, f"{relative(path)} names {', '.join(sorted(options))}"
