"""What is told of a closed loop: figures of a run, of its tuning and of its margins."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from fits.control._alone import played_alone
from fits.control._gains import printed_gains
from fits.control._make import Loop, Made
from fits.control._period import strongest_Hz
from fits.control._tune_problem import Tuning
from fits.io._json import strict
from fits.io._length import length
from microid.control import ControlledRun, StepMetrics, step_metrics, tracking_errors

# Feedback that takes off less than this share is hardly worth its trouble.
_PAYS = 0.1
# Errors that differ by less than this share are the same.
_SAME = 0.01
_ALONE = "'{}' does {}, as long as the stage stays as its model is"


def control_json(
    loop: Loop,
    made: Made,
    played: Sequence[ControlledRun],
    about: Mapping[str, Any],
    remarks: Sequence[str],
    inverse_um: Sequence[np.ndarray] | None = None,
) -> dict[str, Any]:
    """Put runs of a loop with a controller, one for each plant, into JSON values, `microid.control/1`.

    What is not finite is None. What it is `about`, with the feedforward, comes first, and more remarks may follow
    those that are known. What the inverse of the whole stage reaches alone, by plant, is from `inverse_alone`.
    """
    run, kept = played[0], slice(loop.skip, None)
    wanted, moved, command = (np.asarray(x) for x in (run.reference_um, run.displacement_um, run.command_V))
    rms = _rms(np.asarray(run.error_um)[kept])
    sensor = {"noise": loop.noise_um, "resolution": loop.resolution_um or 0.0}
    said = list(remarks)
    below = [f"{name}, {length(size)}" for name, size in sensor.items() if 0 < rms < size]
    if below:
        said.append(
            f"the error, {length(rms)} rms, is that of the model's own displacement and below the sensor's "
            f"{' and its '.join(below)}: a bench cannot show it in single readings"
        )
    every, alone = loop.margins(made.controller), played_alone(loop, loop.ready)
    without = alone and [one[kept] for one in alone]
    inverse = inverse_um and _over_all(wanted[kept], [one[kept] for one in inverse_um])
    every_um = [np.asarray(one.displacement_um)[kept] for one in played]
    found = {
        "schema": "microid.control/1",
        **about,
        "samples": len(wanted),
        "interval_s": loop.ready.interval_s,
        "gains": {path: x.astype(float) for path, x in printed_gains(made.controller, made.pid).items()},
        "tuning": None if made.tuning is None else _tuning(made.tuning),
        "margins": every[0],
        "margins_worst": {
            "plants": len(every),
            "stable": all(bool(one.stable) for one in every),
            "gain_margin": min(float(one.gain_margin) for one in every),
            "phase_margin_deg": min(float(one.phase_margin_deg) for one in every),
            "sensitivity_peak": max(float(one.sensitivity_peak) for one in every),
        },
        "tracking": _tracking(wanted[kept], moved[kept]),
        "over_plants_um": _over_all(wanted[kept], every_um),
        "without_feedback": without and _tracking(wanted[kept], without[0]),
        "worth": without and _worth(wanted[kept], every_um, without),
        "inverse_alone_um": inverse,
        "strongest_Hz": strongest_Hz(wanted, loop.ready.interval_s),
        "step": _step(np.asarray(run.time_s), wanted, moved),
        "command_min_V": command.min(),
        "command_max_V": command.max(),
        "noise_um": loop.noise_um,
        "resolution_um": loop.resolution_um,
        "remarks": said,
    }
    return strict(found)


def _rms(values: np.ndarray) -> float:
    """Root mean square, of numbers whose squares overflow, too."""
    largest = float(np.abs(values).max())
    return largest * float(np.sqrt(np.mean((values / largest) ** 2))) if 0 < largest < math.inf else largest


def _tuning(found: Tuning[Any]) -> dict[str, Any]:
    figures = {name: getattr(found, name) for name in ("converged", "cost_before_um", "cost_after_um")}
    by_plant = {name: [getattr(one, name) for one in found.plants] for name in ("error_rms_um", "overshoot_pct")}
    return {**figures, "plants": len(found.plants), **by_plant}


def _tracking(wanted_um: np.ndarray, moved_um: np.ndarray) -> dict[str, Any]:
    error = wanted_um - moved_um
    shares = tracking_errors(jnp.asarray(wanted_um), jnp.asarray(moved_um))
    sizes = {"error_rms_um": _rms(error), "error_max_um": np.abs(error).max()}
    return {**sizes, "e_rms_pct": shares.e_rms_pct, "e_max_pct": shares.e_max_pct}


def _over_all(wanted_um: np.ndarray, moved_um: Sequence[np.ndarray]) -> float:
    """Error (rms) over all plants."""
    return _rms(np.concatenate([wanted_um - one for one in moved_um]))


def _worth(wanted_um: np.ndarray, with_um: list[np.ndarray], without_um: list[np.ndarray]) -> dict[str, Any]:
    """What feedback takes off the error of the feedforward alone, over all plants."""
    after, before = _over_all(wanted_um, with_um), _over_all(wanted_um, without_um)
    return {"error_rms_um": after, "without_um": before, "share": 1 - after / before if before > 0 else None}


def _step(time_s: np.ndarray, wanted_um: np.ndarray, moved_um: np.ndarray) -> StepMetrics | None:
    """Figures of Table 2, where the reference is one step."""
    turns = np.flatnonzero(np.diff(wanted_um))
    if len(turns) != 1:
        return None
    first = int(turns[0]) + 1
    after = jnp.asarray(time_s[first:]), jnp.asarray(moved_um[first:])
    return step_metrics(*after, float(wanted_um[-1]), float(moved_um[first]))


def describe_control(summary: Mapping[str, Any]) -> str:
    """Put what `control_json` gives into lines of text."""
    worst, without = summary["margins_worst"], summary["without_feedback"]
    lines = [f"{summary['controller']}, {summary['samples']} samples of {summary['interval_s']:.6g} s"]
    for path, value in summary["gains"].items():
        if "network" not in path:
            lines.append(f"{path.removeprefix('pid.'):24} {' '.join(f'{x:.5g}' for x in np.ravel(value))}")
    if (tuning := summary["tuning"]) is not None:
        how = "converged" if tuning["converged"] else "not converged"
        lines.append(
            f"tuning      cost {_long(tuning['cost_before_um'])} to {_long(tuning['cost_after_um'])} over "
            f"{tuning['plants']} plants, {how}"
        )
    lines.append(
        f"margins     {worst['plants']} plants, at worst: gain {_said(worst['gain_margin'])}, phase "
        f"{_said(worst['phase_margin_deg'])} degrees, peak of the sensitivity {_said(worst['sensitivity_peak'])}"
    )
    lines.append(f"tracking    {_tracked(summary['tracking'])}")
    if without is not None:
        lines += [f"  without   {_tracked(without)}", f"feedback    {_said_of_worth(summary)}"]
    if (left := summary["inverse_alone_um"]) is not None:
        less = left < (1 - _SAME) * summary["over_plants_um"]
        how = "less than this loop: --feedforward dynamic" if less else "no less than this loop"
        lines.append(f"inverse     that of the whole stage alone leaves {_long(left)} over all plants, {how}")
    if (step := summary["step"]) is not None:
        time_s = step["settling_time_s"]
        settled = "not settled within the record" if time_s is None else f"settled in {time_s:.4g} s"
        lines.append(
            f"step        {settled}, overshoot {_said(step['overshoot_pct'])} %, "
            f"positioning error {_said(step['positioning_error_pct'])} %"
        )
    lines.append(f"command     {_said(summary['command_min_V'])} to {_said(summary['command_max_V'])} V")
    lines += [f"Note: {remark}" for remark in summary["remarks"]]
    lines += [f"run         {summary['out']}", *(f"plot        {place}" for place in summary["plots"])]
    return "\n".join(lines)


def _tracked(found: Mapping[str, Any]) -> str:
    # A reference that stands still has no range to count in.
    shares = ["" if found[name] is None else f" ({found[name]:.4g} %)" for name in ("e_rms_pct", "e_max_pct")]
    return f"rms {_long(found['error_rms_um'])}{shares[0]}, at most {_long(found['error_max_um'])}{shares[1]}"


def _said_of_worth(summary: Mapping[str, Any]) -> str:
    """Say whether the feedback pays."""
    worth = summary["worth"]
    share, after, before = worth["share"] or 0.0, _long(worth["error_rms_um"]), _long(worth["without_um"])
    part = f"{100 * share:.3g} %" if share > 0 else "nothing"
    does = f"takes {part} off the error of the feedforward alone, {before} to {after} over all plants"
    if share >= _PAYS:
        return does
    command = f"microid compensate{' --dynamic' if summary['feedforward'] == 'dynamic' else ''}"
    said = f"{does}; {_ALONE.format(command, 'as well' if share >= -_SAME else 'better')}"
    period_Hz = summary["strongest_Hz"]
    if summary["controller"] == "resonant" or period_Hz is None:
        return said
    return f"{said}; for what repeats at {period_Hz:.4g} Hz there is --controller resonant"


def _long(size_um: float | None) -> str:
    return "unlimited" if size_um is None else length(size_um, 5)


def _said(value: float | None) -> str:
    return "unlimited" if value is None else f"{value:.5g}"
