"""The command `microid control`: its options, and the work."""

import importlib.util
import pkgutil
from pathlib import Path
from typing import Any

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.cli import _options as options
from fits.io._errors import DataError
from fits.io._file_set import file_set

# Finer steps, of um or V, are none.
_FINEST, _LARGEST = 1e-9, 1e9
# Fields of the goal by the options that state them.
_LIMITS = {"gain_margin": "gain_margin_min", "phase_margin": "phase_margin_min_deg"}
_LIMITS |= {"peak": "sensitivity_peak_max", "overshoot": "overshoot_max_pct"}
# The least that options may be.
_LEAST = dict.fromkeys(("noise", "effort", "rate", "skip"), 0.0)
_LEAST |= {"gain_margin": 1.0, "phase_margin": 1.0, "peak": 1.0, "overshoot": 0.0}


def _names() -> list[str]:
    """Controllers by the names of their files, as importing them would start JAX; the default one first."""
    spec = importlib.util.find_spec("microid")
    folders = [str(Path(folder) / "control") for folder in (spec.submodule_search_locations if spec else None) or ()]
    names = [found.name.replace("_", "-") for found in pkgutil.iter_modules(folders) if found.name[0] != "_"]
    return sorted(names, key=lambda name: (name != "pid", name))


@click.command()
@options.model
@options.reference
@options.out_csv("RUN.csv")
@options.plots("plots")
@click.option(
    "--controller",
    type=click.Choice(_names()),
    default="pid",
    show_default=True,
    help="Which controller; all others are made around a PID controller.",
)
@click.option(
    "--gains",
    metavar="KP,KI,KD|FILE",
    help="Gains in V/um, V/(um s) and V s/um, or what --json printed; tuned by default. Limits stated beside them "
    "are checked, default ones remarked on.",
)
@click.option(
    "--feedforward",
    type=click.Choice(["none", "static", "dynamic"]),
    default="static",
    show_default=True,
    help="What is added to the feedback: nothing, the inverse of the hysteresis, or of the whole stage.",
)
@click.option(
    "--frequency", type=float, multiple=True, metavar="HZ", help="Of a resonator; the reference's own by default."
)
@click.option("--noise", type=float, default=0.0, metavar="UM", help="Standard deviation of sensor noise, in um.")
@click.option("--delay", type=click.IntRange(0, 100), default=0, metavar="SAMPLES", help="Age of a reading.")
@click.option("--resolution", type=float, metavar="UM", help="Steps of the sensor, in um.")
@click.option("--resolution-voltage", type=float, metavar="V", help="Steps of the amplifier's command, in V.")
@options.limits
@options.limit
@options.margin
@options.initial("the reference")
@click.option(
    "--plants",
    type=click.IntRange(1, 100),
    help="Models drawn from the uncertainty of the fit, all to be controlled (default 4, or 1 without one).",
)
@click.option("--overshoot", type=float, metavar="PCT", help="Largest overshoot, in percent of the range.")
@click.option("--gain-margin", type=float, help="Least gain margin (default 2).")
@click.option("--phase-margin", type=float, help="Least phase margin, in degrees (default 30).")
@click.option("--peak", type=float, help="Largest peak of the sensitivity (default 2).")
@click.option("--effort", type=float, default=0.0, metavar="UM/V", help="Weight of the feedback in the cost.")
@click.option("--rate", type=float, default=0.0, metavar="UM/V", help="Weight of the command's steps in the cost.")
@click.option("--skip", type=float, default=0.0, metavar="S", help="Time at the beginning that does not count, in s.")
@click.option("--starts", type=click.IntRange(1, 100), default=2, show_default=True, help="Places to tune from.")
@click.option("--seed", type=options.SEEDS, default=0, help="Of noise, plants and starts (default 0).")
@options.columns
@options.json_output
@common.in_sentences
def control(given: common.Given) -> None:
    """Tune a controller on a model, and run it along a reference.

    REFERENCE.csv needs the columns time_s, in even steps, and displacement_um: what the sensor is to read, with the
    model's offset_um at rest at the lowest voltage: 0 for the models of diagnose. The run has time_s, reference_um,
    displacement_um, measured_um, command_V and error_um. The least error is sought within all limits, for every
    plant; a loop that is unstable or beyond a limit is refused. What --json prints makes the same controller again
    with --gains, for the same model, reference and seed.
    """
    import numpy as np

    for name, least in _LEAST.items():
        value = getattr(given, name)
        if value is not None and not least <= value <= _LARGEST:
            raise DataError(f"{_option(name)}: expected a number from {least:g} to {_LARGEST:g}, found {value:g}.")
    for name in ("resolution", "resolution_voltage"):
        step = getattr(given, name)
        if step is not None and not _FINEST <= step <= _LARGEST:
            steps = f"{_FINEST:g} to {_LARGEST:g}, found {step:g}"
            raise DataError(f"{_option(name)}: expected {steps}; leave it out for none.")
    late.check_table_name(given.out)
    stated = {_option(name): getattr(given, name) for name in _LIMITS}
    volts, allowed_here = common.parse_rig_limits(given.limits, given.limit, given.margin)
    wanted = late.read_reference(given.reference, **common.reading(given))
    # What is no model is refused at once.
    late.read_model_text(given.model)
    late.start_jax()
    tuned_to = [name for name, each in late.CONTROLLERS.items() if "frequency_Hz" in each.own]
    if given.frequency and given.controller not in tuned_to:
        raise DataError(
            f"--frequency: expected --controller {' or '.join(tuned_to)} with it, found {given.controller}; leave it "
            "out."
        )
    read = [given.model, given.reference, given.gains]
    common.refuse_overwriting(given.out, [path for path in read if path is not None])
    progress = common.progress_to_stderr(given.quiet)
    known_gains = None if given.gains is None else late.read_gains(given.gains)
    loaded = late.load_model(given.model)
    plant = common.stage_or_preisach(given.model, loaded)
    with file_set() as files:
        unfinished, drawings = files.file(given.out), files.folder(given.plots)
        ready = late.setup(plant, wanted, given.feedforward, initial=given.initial, limits_V=volts)
        skipped = round(given.skip / ready.interval_s)
        if skipped > len(wanted) - 2:
            longest = f"the reference's {wanted.time_s[-1]:g} s"
            raise DataError(f"--skip: expected less than {longest}, found {given.skip:g} s.")
        count = given.plants or (1 if loaded.uncertainty is None else 4)
        plants = late.draw_plants(plant, count, uncertainty=loaded.uncertainty, seed=given.seed)
        stages = [one.with_hold("zero") for one in plants]
        limits_of = {field: bound for name, field in _LIMITS.items() if (bound := getattr(given, name)) is not None}
        goal = late.Goal(given.effort, given.rate, **limits_of)
        rng = np.random.default_rng(given.seed)
        loop = late.Loop(ready, stages, given.noise, given.delay, given.resolution, skipped)
        noise = rng.normal(0, given.noise, len(wanted)) if given.noise else None
        tune = late.Maker(loop, goal, given.starts, given.seed, noise, progress)
        try:
            made = tune.make(given.controller, known_gains, given.frequency)
        except late.FitError as error:
            raise DataError(f"{given.model}: {error}.") from error
        every = loop.margins(made.controller)
        if not all(bool(one.stable) for one in every):
            raise DataError(
                f"{given.model}: the loop is unstable with these gains, its largest pole has modulus "
                f"{max(float(one.radius) for one in every):.6g}; lower --gains, or leave them out to have them tuned."
            )
        progress("run")
        heard = rng.normal(0, given.noise, len(wanted)) if given.noise else None
        played = [loop.run(made.controller, heard, given.resolution_voltage, one) for one in loop.plants]
        run = played[0]
        if not all(np.all(np.isfinite(one.error_um)) for one in played):
            raise DataError(f"{given.model}: the loop is unstable, its displacement has no bounds; lower --gains.")
        passed = late.passed_limits(goal, every, played[:1] if given.overshoot is None else played)
        in_motion = bool({"velocity", "acceleration", "current"} & set(allowed_here))
        predicted = []
        for one, ran in zip(loop.plants, played, strict=True):
            program = late.Record(wanted.time_s, np.asarray(ran.command_V), None, source=wanted.source)
            moved_um = np.asarray(ran.displacement_um)
            predicted.append(late.predicted_ranges(one, program, moved_um, given.initial, in_motion))
        # Sensor noise alone makes a loop's command jump from sample to sample.
        limits = late.reached_in(loaded.report), allowed_here, given.margin
        said = late.check_command(wanted.source, late.joined(predicted), *limits, spared=("slew",))
        more = [*made.remarks, *said, *_judged(passed, stated, given.controller, known_gains is not None)]
        names = ("time_s", "reference_um", "displacement_um", "measured_um", "command_V", "error_um")
        table = {name: np.asarray(getattr(run, name)) for name in names}
        late.write_table(unfinished, table | {"time_s": wanted.time_s})
        to_draw = run, made.controller, loop.plants
        how: dict[str, Any] = {"delay": given.delay, "goal": goal, "form": given.form}
        drawn = [] if drawings is None else late.plot_control(*to_draw, drawings, **how)
        about = {"controller": given.controller, "feedforward": given.feedforward}
        about |= {"out": given.out, "plots": common.paths_in(given.plots, drawn)}
        dynamic = given.feedforward == "dynamic"
        place: dict[str, Any] = {"initial": given.initial, "limits_V": volts}
        alone_um = None if dynamic else late.inverse_alone(plant, wanted, loop, **place)
        # Before the file is in its place: what cannot be told is not left behind either.
        remarks = [*wanted.warnings, *ready.remarks, *more]
        summary = late.control_json(loop, made, played, about, remarks, alone_um)
        told = late.finite_json(summary) if given.as_json else late.describe_control(summary)
    click.echo(told)


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _judged(passed: dict[str, str], stated: dict[str, float | None], kind: str, given: bool) -> list[str]:
    """What is said of limits that are passed; those that were asked for are not."""
    remarks = []
    for option, words in passed.items():
        if stated[option] is None:
            remarks.append(f"a limit that tuning keeps by default is passed: {words} ({option})")
        elif given:
            raise DataError(f"{option}: {words}; choose other --gains, or leave them out to have them tuned.")
        elif late.CONTROLLERS[kind].learns:
            raise DataError(f"{option}: {words} while {kind} learns; relax it, or choose pid.")
        else:
            # Tuning kept it under the noise it heard.
            remarks.append(f"in this run, under fresh noise, a limit is passed: {words} ({option})")
    return remarks
