"""All of the paper's compensation again, on the virtual bench: figures, pictures and a page."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import data_synth
from fits.control._compensate import simulate_model
from fits.io._atomic import finite_json
from fits.io._record import Reference
from fits.machining._design import paper_design
from fits.machining._idle import idle_noise
from fits.machining._sensitivity import sensitivities
from fits.paper._gains import INTERVAL_s
from fits.paper._runs import (
    LEVELS,
    TRAINING_RUNS,
    Identified,
    LEAD_s,
    PaperRun,
    PaperStand,
    compensated,
    identify,
    identify_modes,
)
from fits.paper._tables import AXIS_TITLES, PAPER, Measured, PaperResult, paper_json, paper_page, render
from fits.plots._control import plot_inverse, plot_loop, plot_steps, plot_tracking
from fits.plots._machining import plot_idle, plot_sensitivity
from fits.stats._metrics import errors, loop_width_pct
from microid.control import step_metrics, tracking_errors

_IDLE_SAMPLES, _IDLE_RATE_Hz = 20_000, 1000.0


def paper_result(
    seeds: int, seed: int, folder: Path, progress: Callable[[str], None], form: str = "png"
) -> PaperResult:
    """Run everything, and write the page, the JSON file and the pictures of a form into an existing folder."""
    result = PaperResult(seed, seeds, assumed=_assumed())
    piezo = data_synth.PaperPiezo()
    # A generator each, so that one more run changes nothing elsewhere.
    loops, *others = np.random.default_rng(seed).spawn(2 + 2 * len(data_synth.PAPER_AXES))
    idle = others.pop()
    with tempfile.TemporaryDirectory() as records:
        progress(f"identifying the hysteresis from {seeds} noisy CSVs")
        identified = identify(piezo, loops.spawn(seeds), Path(records))
        stands, noises = {}, {}
        for k, (name, axis) in enumerate(data_synth.PAPER_AXES.items()):
            progress(f"identifying the response of axis {name}")
            modes = identify_modes(axis, piezo, seeds, others[2 * k], Path(records))
            stands[name], noises[name] = PaperStand(axis, piezo, identified, modes), others[2 * k + 1]
    steps = dict[str, PaperRun]()
    for scheme in PAPER["table2"]:
        progress(f"step, {scheme}")
        steps[scheme] = stands["x"].step(scheme, None)
        noisy = stands["x"].step(scheme, noises["x"].spawn(1)[0])
        result.table2[scheme] = _steps(steps[scheme], noisy, PAPER["table2"][scheme])
    tracks: dict[str, dict[str, PaperRun]] = {}
    for name, stand in stands.items():
        said = PAPER["table3"] if name == "x" else PAPER["table4"][name]
        found = result.table3 if name == "x" else result.table4.setdefault(name, {})
        runs = tracks[name] = {}
        for scheme in said:
            progress(f"tracking along {name}, {scheme}")
            runs[scheme] = stand.track(scheme, noises[name].spawn(1)[0])
            found[scheme] = _tracking(runs[scheme], said[scheme])
    progress("drawing")
    fits = [one.fit.runs[0] for one in identified]
    loops_um = [compensated(one, piezo) for one in identified]
    result.figures = {
        "fig6": _of_loops("fig6", [(run.loop_measured_pct, run.in_sample) for run in fits]),
        "fig9": _of_loops("fig9", [(loop_width_pct(um, end), errors(um, end)) for um, _, end in loops_um]),
    }
    loop, inverse = _draw_loops(identified[0], piezo, folder, form)
    other_axes = {title: tracks[name] for name, title in AXIS_TITLES.items()}
    pictures = [
        ("Fig. 6: the hysteresis and its model", loop),
        *_draw_errors(idle, folder, form),
        ("Fig. 9: the inverse model", inverse),
        ("Fig. 10: a step by scheme", _draw_steps(steps, folder / f"fig10.{form}")),
        ("Fig. 11: tracking along X, Y", _draw_tracks({"X, Y": tracks["x"]}, folder / f"fig11.{form}")),
        ("Fig. 12: tracking along and about the other axes", _draw_tracks(other_axes, folder / f"fig12.{form}")),
    ]
    (folder / "paper.json").write_text(f"{finite_json(paper_json(result))}\n", encoding="utf-8")
    page = paper_page(result, [(caption, path.name) for caption, path in pictures])
    (folder / "paper.md").write_text(page, encoding="utf-8")
    return result


_step_metrics = eqx.filter_jit(step_metrics)
_tracking_errors = eqx.filter_jit(tracking_errors)


def _steps(run: PaperRun, noisy: PaperRun, said: dict[str, float]) -> dict[str, Measured]:
    time_s, way_um = jnp.asarray(np.arange(len(run.reference_um)) * INTERVAL_s), float(run.reference_um[-1])
    ours, beside = (
        [_step_metrics(time_s, jnp.asarray(one), jnp.asarray(way_um)) for one in each.displacement_um]
        for each in (run, noisy)
    )

    def distance_um(name: str, values: np.ndarray) -> np.ndarray | None:
        if name == "settling_time_s":
            return None
        return np.abs(way_um - values) if name == "settling_value_um" else way_um / 100 * values

    return _measured(said, ours, beside, distance_um)


def _tracking(run: PaperRun, said: dict[str, float]) -> dict[str, Measured]:
    reference_um = jnp.asarray(run.reference_um)
    ours, beside = (
        [_tracking_errors(reference_um, jnp.asarray(one)) for one in each]
        for each in (run.displacement_um, run.reading_um)
    )
    share_um = np.ptp(run.reference_um) / 100
    return _measured(said, ours, beside, lambda _, values: share_um * values)


def _measured(
    said: dict[str, float], ours: list[Any], beside: list[Any], distance_um: Callable[..., np.ndarray | None]
) -> dict[str, Measured]:
    """Figures by seed, and whether the distance that each stands for is less than single readings show."""
    sensor = data_synth.PaperSensor()
    smallest_um = max(sensor.noise_um, sensor.resolution_um)
    found = {}
    for name, paper in said.items():
        values, others = (np.array([float(getattr(one, name)) for one in each]) for each in (ours, beside))
        distances_um = distance_um(name, values)
        hidden = distances_um is not None and bool(np.median(distances_um) < smallest_um)
        found[name] = Measured(paper, values, others, hidden)
    return found


def _of_loops(figure: str, found: list[tuple[float | None, Any]]) -> dict[str, Measured]:
    """Widths and errors of loops by seed, beside those of a figure of the paper."""
    rows = [(width or np.nan, off.e_max_pct, off.e_rms_pct) for width, off in found if off is not None]
    said = PAPER["figures"][figure].items()
    return {name: Measured(paper, values) for (name, paper), values in zip(said, np.array(rows).T, strict=True)}


def _draw_loops(one: Identified, piezo: data_synth.PaperPiezo, folder: Path, form: str) -> tuple[Path, Path]:
    voltage_V, measured_um = one.record.voltage_V, one.record.displacement_um
    assert measured_um is not None
    fitted_um = simulate_model(one.fit.model, one.record, "negative")
    fitted = plot_loop(voltage_V, measured_um, fitted_um, folder / f"fig6.{form}")
    # Up to the end of the second full loop.
    end = 1 + int(np.flatnonzero(voltage_V == voltage_V.min())[2])
    return fitted, plot_inverse(voltage_V[:end], measured_um[:end], *compensated(one, piezo), folder / f"fig9.{form}")


def _draw_errors(rng: np.random.Generator, folder: Path, form: str) -> list[tuple[str, Path]]:
    design = paper_design()
    found = sensitivities(design, ("x", "z", "alpha", "gamma"))
    tornado, machining = plot_sensitivity(design, found, folder, form=form)
    sensor = data_synth.PaperSensor()
    readings_um = sensor.read(np.zeros((_IDLE_SAMPLES, round(sensor.rate_Hz / _IDLE_RATE_Hz))), rng)
    record = Reference(np.arange(_IDLE_SAMPLES) / _IDLE_RATE_Hz, readings_um, source="the bench's sensor at rest")
    (noise,) = plot_idle(record, idle_noise(record), folder, form=form)
    return [
        ("Fig. 7: machining errors", machining),
        ("Fig. 7 in figures: machining errors ranked", tornado),
        ("Fig. 8: measuring errors", noise),
    ]


def _draw_steps(steps: dict[str, PaperRun], path: Path) -> Path:
    shown = {scheme: run.displacement_um[0] for scheme, run in steps.items()}
    run = next(iter(steps.values()))
    time_s = INTERVAL_s * np.arange(len(run.reference_um))
    return plot_steps(time_s, float(run.reference_um[-1]), shown, path)


def _draw_tracks(tracks: dict[str, dict[str, PaperRun]], path: Path) -> Path:
    rows = [
        (title, next(iter(runs.values())).reference_um, {name: run.displacement_um[0] for name, run in runs.items()})
        for title, runs in tracks.items()
    ]
    return plot_tracking(INTERVAL_s, rows, path)


def _assumed() -> list[str]:
    axes = data_synth.PAPER_AXES
    bench = {"sensor": data_synth.PaperSensor(), "axes": axes, "rotation": list(axes.values())[-1]}
    work = {"bias_V": data_synth.PAPER_BIAS_V, "swing_um": data_synth.PAPER_SWING_um, "lead_s": LEAD_s}
    return render("assumed.txt.j2", levels=LEVELS, training_runs=TRAINING_RUNS, **bench, **work).splitlines()
