"""The command `microid sweep`: the work."""

from pathlib import Path

import click

from fits.cli._common import stopped
from fits.cli._files import progress_to_stderr
from fits.io._atomic import finite_json
from fits.io._file_set import file_set
from fits.io._jax_setup import start_jax


def run_sweep(*, file: str, out: str, resume: bool, cluster: str | None, as_json: bool, quiet: bool) -> None:
    """Do `microid sweep SWEEP.toml`; the options are the command's."""
    start_jax()
    from fits.sweeps._run import run_sweep as run_all
    from fits.sweeps._spec import read_sweep
    from fits.sweeps._store import RESULTS, TABLE

    progress = progress_to_stderr(quiet)
    sweep = read_sweep(file)
    try:
        outcome = run_all(sweep, out, resume=resume, cluster=cluster, progress=progress)
    except KeyboardInterrupt as stop:
        stopped(stop, "what was computed is kept; go on with --resume")
    files = [str(Path(out) / name) for name in (RESULTS, TABLE)]
    if as_json:
        content = {
            "out": out,
            "rows": outcome.rows,
            "failed": outcome.failed,
            "computed": outcome.computed,
            "chunks_computed_again": outcome.again,
            "seconds": outcome.seconds,
            "files": files,
        }
        click.echo(finite_json(content))
        return
    failed = f", {outcome.failed:,} of them failed" if outcome.failed else ""
    click.echo(f"{outcome.rows:,} rows{failed}; {outcome.computed:,} computed in {outcome.seconds:.1f} s")
    click.echo("\n".join(f"results  {name}" for name in files))


def show_sweep(*, folder: str, best: str | None, largest: bool, plots: str | None, as_json: bool) -> None:
    """Do `microid sweep show`; the options are the command's."""
    from fits.sweeps._show import describe, summarise

    summary = summarise(folder, best, largest)
    drawn: list[Path] = []
    with file_set() as files:
        drawings = files.folder(plots)
        if drawings is not None:
            from fits.plots._sweep import plot_sweep

            drawn = plot_sweep(folder, drawings, best)
    if as_json:
        click.echo(finite_json(summary))
        return
    click.echo("\n".join([describe(summary), *(f"plot  {Path(plots or '') / path.name}" for path in drawn)]))
