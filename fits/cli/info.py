"""The command `microid info`: its options, and the work."""

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.cli import _options as options
from fits.io._errors import DataError


@click.command()
@options.model
@options.json_output
@common.in_sentences
def info(given: common.Given) -> None:
    """Say what a model file holds."""
    late.start_jax()
    loaded = late.load_model(given.model)
    named = loaded.model.named if isinstance(loaded.model, late.Stage) else str
    parameters = [
        {"path": named(row.path), "shape": list(row.shape), "unit": row.spec.unit}
        for row in late.parameter_table(loaded.model)
    ]
    kind = type(loaded.model).__name__
    lines = [f"{kind}, written by {loaded.written_by}"]
    for row in parameters:
        lines.append(f"  {row['path']:28} {'x'.join(map(str, row['shape'])) or '1':>8} {row['unit']}")
    if not given.as_json:
        lines += ["", _known_of_fit(given.model, loaded)]
    content = {"written_by": loaded.written_by, "model": kind, "parameters": parameters, "fit": loaded.report}
    common.print_result(given, content, lines)


def _known_of_fit(path: str, loaded: "late.ModelFile") -> str:

    if loaded.uncertainty is None:
        return "written by 'microid diagnose', whose report says how well it predicts"
    try:
        return late.describe(loaded.report)
    except (LookupError, TypeError, ValueError, AttributeError):
        # The format does not say what a report holds, and the words are made for that of a fit.
        raise DataError(f"{path}: its report is not that of a fit; fit again, or add --json to see it.") from None
