"""Pages for people: their blocks, and the page of commands and options, which `python tests/_docs.py` writes."""

import re
import textwrap
from pathlib import Path

import click

from fits.cli._main import cli

ROOT = Path(__file__).parents[1]
REFERENCE = ROOT / "docs" / "reference.md"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
# Options that mean the same in all commands that have them.
SHARED = ("columns", "sample_rate", "missing", "limit", "limits", "margin", "as_json", "quiet", "verbose")
HEAD = """# Reference: commands and options

`microid COMMAND --help` says the same; `-h` is `--help`, and `microid --version` prints the version. Results go to
stdout, or to the files that are named; progress and refusals go to stderr. Status 0 means done, 2 bad input, in one
sentence and without an output file, 130 and 143 stopped. This page is written by `python tests/_docs.py`.

The tab key completes commands and options once `eval "$(_MICROID_COMPLETE=bash_source microid)"` stands in
`~/.bashrc`; in `~/.zshrc` it is `zsh_source`, and fish reads what `_MICROID_COMPLETE=fish_source microid` prints.

## Options that many commands have
"""


def blocks(page):
    """Languages and texts of the fenced blocks of a page, in order."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def prose(page):
    """A page without its fenced blocks."""
    return re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def commands():
    """Names and commands, those within a command included."""
    for name, command in sorted(cli.commands.items()):
        yield name, command
        if isinstance(command, click.Group):
            for inner in sorted(command.commands):
                yield f"{name} {inner}", command.commands[inner]


def options_of(command):
    return [each for each in command.params if isinstance(each, click.Option)]


def _coded(text):
    """Help with its options as code, whose two hyphens a site would show as a dash."""
    return re.sub(r"(?<![\w`-])--[a-z][a-z-]*", r"`\g<0>`", text)


def _row(option):
    if option.metavar:
        kind = f" {option.metavar}"
    elif isinstance(option.type, click.Choice):
        kind = f" {'|'.join(map(str, option.type.choices))}"
    else:
        number = isinstance(option.type, click.types.IntParamType | click.types.FloatParamType)
        kind = "" if option.is_flag else " N" if number else " NAME"
    text = option.help + (f" Default: {option.default}." if option.show_default else "")
    label = f"{' / '.join(option.opts)}{kind}".replace("|", " or ")
    return f"| `{label}` | {_coded(text.replace('|', ' or '))} |"


def _table(options):
    return ["", "| option | meaning |", "|---|---|", *map(_row, options)] if options else []


def reference_page():
    """The text of the page, from what the commands declare."""
    shared = {option.name: option for _, command in commands() for option in options_of(command)}
    lines = [HEAD.rstrip(), *_table([shared[name] for name in SHARED])]
    for name, command in commands():
        usage = command.collect_usage_pieces(click.Context(command, info_name=name))
        lines += ["", f"## microid {name}", "", f"`microid {name} {' '.join(usage)}`"]
        for paragraph in command.help.split("\n\n"):
            lines += ["", textwrap.fill(_coded(" ".join(paragraph.split())), 118, break_on_hyphens=False)]
        own = [option for option in options_of(command) if option.name not in SHARED]
        also = [f"`{option.opts[-1]}`" for option in options_of(command) if option.name in SHARED]
        lines += _table(own) + (["", f"Also: {', '.join(also)}."] if also else [])
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)) + "\n"


if __name__ == "__main__":
    REFERENCE.write_text(reference_page(), encoding="utf-8")
