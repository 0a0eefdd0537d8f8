"""All of the paper's compensation again, on the virtual bench: figures, pictures and a page."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import data_synth
from fits.io._atomic import finite_json
from fits.io._record import Reference
from fits.machining._design import paper_design
from fits.machining._idle import idle_noise
from fits.machining._sensitivity import sensitivities
from fits.paper._gains import INTERVAL_s
from fits.paper._loop import PaperRun
from fits.paper._runs import (
    LEVELS,
    TRAINING_RUNS,
    Identified,
    LEAD_s,
    PaperStand,
    compensated,
    identify,
    identify_modes,
)
from fits.paper._tables import AXIS_TITLES, PAPER, Measured, PaperResult, paper_json, paper_page
from fits.plots._idle import plot_idle
from fits.plots._paper import plot_inverse, plot_loop, plot_steps, plot_tracking
from fits.plots._sensitivity import plot_sensitivity
from fits.stats._metrics import errors, loop_width_pct
from microid.control import step_metrics, tracking_errors

Tell = Callable[[str], None]
_IDLE_SAMPLES, _IDLE_RATE_Hz = 20_000, 1000.0


def paper_result(seeds: int, seed: int, folder: Path, tell: Tell) -> PaperResult:
    """Run everything, and write the page, the JSON file and the pictures into an existing folder."""
    result = PaperResult(seed, seeds, assumed=_assumed())
    piezo = data_synth.PaperPiezo()
    # A generator each, so that one more run changes nothing elsewhere.
    loops, *others = np.random.default_rng(seed).spawn(2 + 2 * len(data_synth.PAPER_AXES))
    idle = others.pop()
    with tempfile.TemporaryDirectory() as records:
        tell(f"identifying the hysteresis from {seeds} noisy CSVs")
        identified = identify(piezo, loops.spawn(seeds), Path(records))
        stands, noises = {}, {}
        for (name, axis), modes_rng, runs_rng in zip(
            data_synth.PAPER_AXES.items(), others[::2], others[1::2], strict=True
        ):
            tell(f"identifying the response of axis {name}")
            modes = identify_modes(axis, piezo, seeds, modes_rng, Path(records))
            stands[name], noises[name] = PaperStand(axis, piezo, identified, modes), runs_rng
    steps: dict[str, PaperRun] = {}
    for scheme in PAPER["table2"]:
        tell(f"step, {scheme}")
        steps[scheme] = stands["x"].step(scheme, None)
        noisy = stands["x"].step(scheme, noises["x"].spawn(1)[0])
        result.table2[scheme] = _steps(steps[scheme], noisy, PAPER["table2"][scheme])
    tracks: dict[str, dict[str, PaperRun]] = {}
    for name, stand in stands.items():
        said = PAPER["table3"] if name == "x" else PAPER["table4"][name]
        tracks[name] = {}
        for scheme in said:
            tell(f"tracking along {name}, {scheme}")
            tracks[name][scheme] = stand.track(scheme, noises[name].spawn(1)[0])
        found = {scheme: _tracking(run, said[scheme]) for scheme, run in tracks[name].items()}
        if name == "x":
            result.table3 = found
        else:
            result.table4[name] = found
    tell("drawing")
    result.figures = {"fig6": _loop_figures(identified), "fig9": _inverse_figures(identified, piezo)}
    pictures = [
        ("Fig. 6: the hysteresis and its model", _draw_loop(identified[0], folder)),
        *_draw_errors(idle, folder),
        ("Fig. 9: the inverse model", _draw_inverse(identified[0], piezo, folder)),
        ("Fig. 10: a step by scheme", _draw_steps(steps, folder)),
        ("Fig. 11: tracking along X, Y", _draw_tracks({"X, Y": tracks["x"]}, folder / "fig11.png")),
        (
            "Fig. 12: tracking along and about the other axes",
            _draw_tracks({AXIS_TITLES[name]: tracks[name] for name in AXIS_TITLES}, folder / "fig12.png"),
        ),
    ]
    text = finite_json(paper_json(result))
    (folder / "paper.json").write_text(f"{text}\n", encoding="utf-8")
    page = paper_page(result, [(caption, path.name) for caption, path in pictures])
    (folder / "paper.md").write_text(page, encoding="utf-8")
    return result


_step_metrics = eqx.filter_jit(step_metrics)
_tracking_errors = eqx.filter_jit(tracking_errors)


def _steps(run: PaperRun, noisy: PaperRun, said: dict[str, float]) -> dict[str, Measured]:
    time_s = jnp.asarray(np.arange(len(run.reference_um)) * INTERVAL_s)
    target_um = jnp.asarray(run.reference_um[-1])
    found = [
        [_step_metrics(time_s, jnp.asarray(one), target_um) for one in each.displacement_um] for each in (run, noisy)
    ]
    ours, beside = ({name: np.array([float(getattr(m, name)) for m in each]) for name in said} for each in found)
    way_um = float(target_um)
    distances_um = {
        "overshoot_pct": way_um / 100 * ours["overshoot_pct"],
        "settling_value_um": np.abs(way_um - ours["settling_value_um"]),
        "positioning_error_pct": way_um / 100 * ours["positioning_error_pct"],
    }
    return {
        name: Measured(paper, ours[name], beside[name], _hidden(distances_um.get(name)))
        for name, paper in said.items()
    }


def _hidden(distances_um: np.ndarray | None) -> bool:
    """Whether a distance is less than what the paper's sensor shows in single readings; of a time, it is none."""
    sensor = data_synth.PaperSensor()
    return distances_um is not None and bool(np.median(distances_um) < max(sensor.noise_um, sensor.resolution_um))


def _tracking(run: PaperRun, said: dict[str, float]) -> dict[str, Measured]:
    reference_um = jnp.asarray(run.reference_um)
    found = [
        [_tracking_errors(reference_um, jnp.asarray(one)) for one in each]
        for each in (run.displacement_um, run.reading_um)
    ]
    ours, beside = ({name: np.array([float(getattr(m, name)) for m in each]) for name in said} for each in found)
    share_um = np.ptp(run.reference_um) / 100
    return {
        name: Measured(paper, ours[name], beside[name], _hidden(share_um * ours[name]))
        for name, paper in said.items()
    }


def _loop_figures(identified: list[Identified]) -> dict[str, Measured]:
    said, found = PAPER["figures"]["fig6"], [one.fit.runs[0] for one in identified]
    inside = [run.in_sample for run in found if run.in_sample is not None]
    widths = np.array([run.loop_measured_pct or np.nan for run in found])
    ours = widths, np.array([e.e_max_pct for e in inside]), np.array([e.e_rms_pct for e in inside])
    return {name: Measured(paper, values) for (name, paper), values in zip(said.items(), ours, strict=True)}


def _inverse_figures(identified: list[Identified], piezo: data_synth.PaperPiezo) -> dict[str, Measured]:
    said, rows = PAPER["figures"]["fig9"], []
    for one in identified:
        wanted_um, _, reached_um = compensated(one, piezo)
        off = errors(wanted_um, reached_um)
        rows.append((loop_width_pct(wanted_um, reached_um) or np.nan, off.e_max_pct, off.e_rms_pct))
    return {
        name: Measured(paper, values) for (name, paper), values in zip(said.items(), np.array(rows).T, strict=True)
    }


def _draw_loop(one: Identified, folder: Path) -> Path:
    record, model_um = one.record, one.model_um()
    assert record.displacement_um is not None
    return plot_loop(record.voltage_V, record.displacement_um, model_um, folder / "fig6.png")


def _draw_inverse(one: Identified, piezo: data_synth.PaperPiezo, folder: Path) -> Path:
    record = one.record
    assert record.displacement_um is not None
    # Up to the end of the second full loop.
    end = 1 + int(np.flatnonzero(record.voltage_V == record.voltage_V.min())[2])
    loop = record.voltage_V[:end], record.displacement_um[:end]
    return plot_inverse(*loop, *compensated(one, piezo), folder / "fig9.png")


def _draw_errors(rng: np.random.Generator, folder: Path) -> list[tuple[str, Path]]:
    design = paper_design()
    tornado, machining = plot_sensitivity(design, sensitivities(design, ("x", "z", "alpha", "gamma")), folder)
    sensor = data_synth.PaperSensor()
    readings_um = sensor.read(np.zeros((_IDLE_SAMPLES, round(sensor.rate_Hz / _IDLE_RATE_Hz))), rng)
    record = Reference(np.arange(_IDLE_SAMPLES) / _IDLE_RATE_Hz, readings_um, source="the bench's sensor at rest")
    (noise,) = plot_idle(record, idle_noise(record), folder)
    return [
        ("Fig. 7: machining errors", machining),
        ("Fig. 7 in figures: machining errors ranked", tornado),
        ("Fig. 8: measuring errors", noise),
    ]


def _draw_steps(steps: dict[str, PaperRun], folder: Path) -> Path:
    shown = {scheme: run.displacement_um[0] for scheme, run in steps.items()}
    run = next(iter(steps.values()))
    time_s = INTERVAL_s * np.arange(len(run.reference_um))
    return plot_steps(time_s, float(run.reference_um[-1]), shown, folder / "fig10.png")


def _draw_tracks(tracks: dict[str, dict[str, PaperRun]], path: Path) -> Path:
    rows = []
    for title, runs in tracks.items():
        reference_um = next(iter(runs.values())).reference_um
        rows.append((title, reference_um, {scheme: run.displacement_um[0] for scheme, run in runs.items()}))
    return plot_tracking(INTERVAL_s, rows, path)


def _assumed() -> list[str]:
    sensor, axes = data_synth.PaperSensor(), data_synth.PAPER_AXES
    rotation = list(axes.values())[-1]
    gains = ", ".join(f"{name} {100 * axis.gain_error:+.2f} %" for name, axis in axes.items())
    rests = ", ".join(f"{name} {axis.rest_s:g} s" for name, axis in axes.items())
    return [
        "The stage is the virtual bench of `data_synth`: a driver of 1 ms, a piezo of 40.7 um with a loop of 12.83 % "
        "of it as a sum of plays, an amplifier whose gain is off, and a slow mode of 34.7 rad/s with a damping ratio "
        "of 0.1305 (erratum 46), the same for all axes. It shares no code with the models that are fitted to it.",
        f"Calibrated are the damping ratio, the frequency and the gain of x to Table 2's HC, the piezo's curve to "
        f"Table 3's OPEN, and the other gains ({gains}) to Table 4's OPEN: whatever one piezo's hysteresis does not "
        "explain of an open loop is an error of the gain. For the rotations that is far beyond what tolerances of "
        "0.02 mm do (3 %), and HC, which knows nothing of it, is left with it.",
        f"Tracking runs hold rests before and after two periods ({rests}): the paper's e_max of the open loops is "
        "1.9 to 2.7 times its e_rms, which no steady tracking of a sine gives. Errors are counted over the whole "
        "record.",
        f"A reading of the sensor has a white noise of {1e3 * sensor.noise_um:g} nm rms and a last digit of "
        f"{1e3 * sensor.resolution_um:g} nm; there are {sensor.rate_Hz:g} readings in a second, and a controller at "
        "1 kHz is given the mean of those since its last sample. The paper gives no rate: averaging is why true "
        "errors can be smaller than a reading's.",
        "The piezo's sensor is the same; each of the 100 samples a second of its CSV is the mean of the readings "
        "while the voltage is held.",
        f"The hysteresis is `fits.fit` with {LEVELS} levels, the mode `fits.fit_response`; both from CSVs alone. HC "
        "is the static inverse of the hysteresis with the nominal amplification: the piezo is measured, not the "
        "stage.",
        f"Axes rest and work at {data_synth.PAPER_BIAS_V:g} V, reached from above. Rotations are read as the "
        "displacement of a point 40 mm from the axis; the swing of 2 um is the paper's for X, Y and assumed for the "
        f"others: {data_synth.PAPER_SWING_um * rotation.per_um:g} {rotation.unit} of a rotation.",
        "Gains follow from the identified mode by placing the loop's poles, for all axes alike: for tracking at "
        "30 rad/s (25 rad/s beside the CMAC), for steps at 86, 86 and 27 rad/s. BP-PID starts from the gains of PID, "
        "and its network keeps them within a factor of 1.5. For steps the reference has weights in the controller. "
        "These poles, the filters and the learning rates were chosen on the bench that judges them.",
        f"Loops are closed {LEAD_s:g} s before a run. For tracking, the CMAC's table has learnt from {TRAINING_RUNS} "
        "shorter runs of the same kind right before, which do not count; for steps it begins empty.",
    ]
