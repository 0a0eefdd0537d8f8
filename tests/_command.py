"""Running the `microid` command in tests."""

import re

from click.testing import CliRunner

from fits.cli._main import cli

OFF = {"MICROID_CACHE": "off"}


def run(*arguments):
    return CliRunner(env=OFF).invoke(cli, [str(argument) for argument in arguments])


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def refused(result, *words):
    assert result.exit_code == 2
    assert result.stdout == ""
    progress = re.compile(r"(\[[#.]+\])? +\d+\.\d s  ")
    lines = [line for line in result.stderr.splitlines() if not progress.match(line)]
    assert len(lines) == 1
    for word in words:
        assert word in lines[0]
