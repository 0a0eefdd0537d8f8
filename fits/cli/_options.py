"""Options that several commands have, each declared once; a command's own file declares what it has alone."""

from collections.abc import Callable
from typing import Any

import click

_STATES = ["negative", "positive", "demagnetised"]
SEEDS = click.IntRange(0, 2**32 - 1)

model = click.argument("model", metavar="MODEL.json")
reference = click.argument("reference", metavar="REFERENCE.csv")
runs = click.argument("runs", metavar="RUN.csv [MORE.csv ...]", nargs=-1, required=True)
out_folder = click.option("--out", required=True, metavar="DIR", help="Folder to write to; it is made if need be.")
_columns = click.option(
    "--columns",
    metavar="NAME=SOURCE,...",
    default="",
    help="Which columns to read, such as voltage_V=u1_V,displacement_um=-height[nm]; a source may be the number of a "
    "column, from 1, and numbers alone, such as 1,4, are the columns that are needed, in their order.",
)
_sample_rate = click.option(
    "--sample-rate",
    type=float,
    metavar="HZ",
    help="Samples are even, so many a second, instead of a column of times.",
)
_missing = click.option(
    "--missing",
    type=click.Choice(["refuse", "drop"]),
    default="refuse",
    show_default=True,
    help="What to do with rows in which a number is missing.",
)
limits = click.option("--limits", metavar="LOW,HIGH", help="Voltages allowed, in V; the model's range by default.")
limit = click.option(
    "--limit",
    multiple=True,
    metavar="NAME=LOW:HIGH",
    help="What the rig may be asked for, such as displacement=0:40um or slew=2kV/s; again for more of voltage, slew, "
    "displacement, velocity, acceleration and current (per farad of the piezo). By default what the runs reached.",
)
margin = click.option(
    "--margin",
    type=float,
    default=0.02,
    show_default=True,
    help="Share of its range by which what is predicted may go beyond what the runs reached.",
)
axis = click.option(
    "--axis",
    type=click.Choice(["x", "y", "z", "alpha", "beta", "gamma", "all"]),
    default="all",
    show_default=True,
    help="Which motion.",
)
json_output = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")


def columns(command: Callable[..., Any]) -> Callable[..., Any]:
    """Declare how files are read, the same for every command that reads some."""
    return _columns(_sample_rate(_missing(command)))


def out_csv(metavar: str) -> Callable[[Any], Any]:
    words = "Table to write: CSV, which .gz compresses, or what a name that ends in .npz or .parquet says."
    return click.option("--out", required=True, metavar=metavar, help=words)


def plots(what: str) -> Callable[[Any], Any]:
    """Declare the options of pictures: where, and in what format."""
    folder = click.option("--plots", metavar="DIR", help=f"Folder for {what}; it is made if need be.")
    form = picture_format("--plots")
    return lambda command: folder(form(command))


def picture_format(of: str) -> Callable[[Any], Any]:
    forms = click.Choice(["png", "svg", "pdf"])
    return click.option("--format", "form", type=forms, default="png", show_default=True, help=f"Of {of}.")


def holdout(what: str) -> Callable[[Any], Any]:
    return click.option("--holdout", multiple=True, metavar="FRACTION|FILE", help=what)


def initial(what: str, default: str | None = "negative", **more: Any) -> Callable[[Any], Any]:
    """Declare the option of the memory before something; one that may be unknown is by default."""
    states = _STATES if default == "negative" else ["unknown", *_STATES]
    if default:
        more |= {"default": default, "show_default": True}
    return click.option("--initial", type=click.Choice(states), help=f"Memory before {what}.", **more)
