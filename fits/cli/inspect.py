"""The command `microid inspect`: its options, and the work."""

from dataclasses import asdict

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.cli import _options as options
from fits.io._file_set import file_set
from fits.io._printable import printable


@click.command()
@click.argument("file", metavar="FILE")
@options.plots("a plot of the channels")
@options.json_output
@common.in_sentences
def inspect(given: common.Given) -> None:
    """Say what a file of measurements holds, and which command reads it.

    FILE is a CSV or another text, or of LabVIEW, TDMS, MATLAB, HDF5, NumPy, JSON or Parquet. Uses in brackets are
    guessed.
    """
    found = late.inspect_table(given.file)
    rate = "of unknown rate" if found.rate_Hz is None else f"{found.rate_Hz:.6g} Hz"
    rate += "" if found.rate_Hz is None or found.even else " in the median, uneven"
    lines = [f"{found.path}: {found.rows} rows, {rate}", _row("", "channel", "unit", "from", "to", "use")]
    for each in found.channels:
        low, high = ("-" if value is None else f"{value:.6g}" for value in (each.lowest, each.highest))
        use = f"({each.use})" if each.guessed else each.use
        words = "; ".join(filter(None, [use, f"found {each.problem}" if each.problem else ""]))
        lines.append(_row(str(each.number), each.name, each.unit or "-", low, high, words))
    lines += [f"Note: {remark}" for remark in found.remarks]
    lines += ["", found.command or "no columns of voltage and displacement were found; name them with --columns"]
    drawn = []
    with file_set() as files:
        drawings = files.folder(given.plots)
        if drawings is not None:
            drawn = common.paths_in(given.plots, late.plot_channels(found, drawings, given.form))
    lines += [f"plot   {place}" for place in drawn]
    common.print_result(given, {**asdict(found), "plots": drawn}, map(printable, lines))


def _row(number: str, name: str, unit: str, low: str, high: str, use: str) -> str:
    return f"{number:>4} {name[:28]:28} {unit:>5} {low:>12} {high:>12}  {use}".rstrip()
