"""The job `control`: a stage in closed loop with a controller, and its figures of merit."""

import math
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import microid as m
from fits.control._gains import GAINS, PID_SETTINGS
from fits.control._make import setup, with_defaults
from fits.control._period import strongest_Hz
from fits.control._tune_start import major_loop_slope, slope_array, steepest_slope
from fits.io._errors import DataError, shown
from fits.io._record import Reference
from fits.io._typed import nearest
from fits.sweeps._devices import block_rows, by_rows, in_turn, place
from fits.sweeps._stages import (
    Program,
    drive,
    memory_before,
    range_of,
    read_program,
    requested_stage,
    stage_parameters,
    varied,
)
from fits.sweeps._types import (
    AbstractJob,
    Block,
    Facts,
    FloatArray,
    Output,
    Parameter,
    Request,
    Rows,
    check_plain,
    number,
    one_of,
)
from microid import control as ctl

KEYS = ("model", "initial", "reference", "controller")
_OUTPUTS = (
    Output("e_rms_pct", "%", "root mean square of the tracking error, of the reference's range"),
    Output("e_max_pct", "%", "largest tracking error, of the reference's range"),
    Output("error_rms_um", "um", "root mean square of the tracking error"),
    Output("error_final_um", "um", "error at the last sample"),
    Output("command_min_V", "V", "smallest command"),
    Output("command_max_V", "V", "largest command"),
    Output(
        "pole_radius",
        "1",
        "largest modulus of the loop's poles where the hysteresis is steepest, before a controller learns; NaN of a "
        "nonlinear part",
    ),
)
_STEP = (
    Output("settling_time_s", "s", "from the step until the displacement stays within 2 %; inf if it does not"),
    Output("overshoot_pct", "%", "beyond the final value, of the way; of the target where it has not settled"),
)
_LIMITS = (ctl.Setting("lower_V", "V", varies=False), ctl.Setting("upper_V", "V", varies=False))


class Controllers(eqx.Module):
    """Controllers of one kind that differ in some numbers, whose names in the sweep begin with `controller.`.

    What is found by the stage or the reference is found for the nominal ones: those differ from row to row, and the
    controller does not know of it. `numbers` are those that do not vary; the plant is None where nothing is to be
    found by it. Readings are late by `delay` samples.
    """

    kind: type[ctl.AbstractController] = eqx.field(static=True)
    numbers: dict[str, Float[Array, ""]]
    interval_s: Float[Array, ""]
    plant: ctl.ControlledPlant | None
    delay: int = eqx.field(static=True)

    def at(self, values: Mapping[str, Float[Array, ""]]) -> ctl.AbstractController:
        """The controller of a row, whose values come by the names of the sweep."""
        names = [setting.name for setting in self.kind.settings if setting.varies]
        varied = {name: values[f"controller.{name}"] for name in names if f"controller.{name}" in values}
        numbers: dict[str, Any] = dict.fromkeys(GAINS, 0.0) | self.numbers | varied
        fields = {name: numbers.pop(name) for name in (*PID_SETTINGS, "lower_V", "upper_V") if name in numbers}
        return self.kind.of(ctl.PID(interval_s=self.interval_s, **fields), numbers, self.plant)

    def parameters(self) -> tuple[Parameter, ...]:
        """What may vary, with its nominal value."""
        nominal, found = self.at({}), []
        for setting in ctl.settings_of(self.kind):
            if setting.varies:
                name = setting.name
                value = float(np.ravel(self.numbers[name] if name in self.numbers else getattr(nominal, name))[0])
                found.append(_parameter(setting, value, float(self.interval_s)))
        return tuple(found)


def _parameter(setting: ctl.Setting, nominal: float, interval_s: float) -> Parameter:
    name, upper = f"controller.{setting.name}", setting.upper / interval_s if setting.of_rate else setting.upper
    return Parameter(name, setting.unit, nominal, setting.lower, upper, whole=setting.whole)


def read_controllers(given: Mapping[str, Any], stage: m.Stage, initial: str, reference: Program) -> Controllers:
    """Read the table `[controller]` of a sweep, for the nominal stage, its memory, and what it is to follow."""
    name = one_of(ctl.CONTROLLERS, given.get("kind", "pid"), "controller.kind")
    kind = ctl.CONTROLLERS[name]
    settings = {setting.name: setting for setting in (*ctl.settings_of(kind), *_LIMITS)}
    known = (*settings, "kind", "delay_samples")
    for key in given:
        if key not in known:
            owners = [other for other, each in ctl.CONTROLLERS.items() if key in [one.name for one in each.settings]]
            of = f", which is of {' and '.join(owners)}" if owners else ""
            raise DataError(
                f"controller.{key}: expected a known key of {name}, found {shown(key)}{of}; {nearest(key, known)}"
            )
    delay = given.get("delay_samples", 0)
    if isinstance(delay, bool) or not isinstance(delay, int) or not 0 <= delay <= 100:
        raise DataError(f"controller.delay_samples: expected a number from 0 to 100, found {shown(delay)}.")
    stated = {each: number(given[each], f"controller.{each}") for each in settings if each in given}
    limits = dict(zip(("lower_V", "upper_V"), range_of(stage) or (-1e3, 1e3), strict=True))
    task = _task(stage, initial, reference)
    # Before the defaults, some of which take seconds to find.
    _check(limits | stated, settings, reference.interval_s)
    numbers, _ = with_defaults(settings.values(), limits | stated, task, lambda each: f"controller.{each}")
    _check(numbers, settings, reference.interval_s)
    left = [each for each in settings if each not in numbers]
    found = Controllers(
        kind,
        {each: jnp.asarray(value) for each, value in numbers.items()},
        jnp.asarray(reference.interval_s),
        ctl.ControlledPlant(stage, slope_array(stage), delay) if left else None,
        delay,
    )
    try:
        found.at({})
    except ValueError as error:
        raise DataError(
            f"controller.kind: a {name} controller cannot be made for this stage ({error}); state "
            f"{' and '.join(left) or 'another kind'}."
        ) from error
    return found


def _check(numbers: Mapping[str, float], settings: Mapping[str, ctl.Setting], interval_s: float) -> None:
    """Refuse what is out of its bounds, whether it varies or not."""
    for each, value in numbers.items():
        place, setting = f"controller.{each}", settings[each]
        parameter = _parameter(setting, value, interval_s)
        if setting.above and not value > setting.lower:
            raise DataError(f"{place}: expected more than {setting.lower:g}, found {value:g}; correct it.")
        if not parameter.lower <= value <= parameter.upper:
            raise DataError(f"{place}: expected {parameter.range_words}, found {value:g}; correct it.")
        check_plain(parameter, np.array([value]), False, place)
        partner = each.replace("lower_", "upper_", 1)
        if partner != each and not value < numbers.get(partner, math.inf):
            raise DataError(
                f"{place}: expected less than {partner}, which is {numbers[partner]:g} {each[6:]}, found {value:g}; "
                "correct one of them."
            )


def _task(stage: m.Stage, initial: str, reference: Program) -> ctl.ControlTask:
    """What the controllers are made for, as `microid control` has it, with the nominal stage and reference."""

    def from_rest_um() -> FloatArray:
        # A step at the first sample is none by itself, but from where the stage stands before.
        plant = ctl.SampledStage(stage, reference.interval_s)
        return np.append(plant.init(m.Start(None, memory_before(stage, initial)))[1], reference.wanted())

    def static_V() -> FloatArray:
        way_um = from_rest_um()
        time_s = np.arange(len(way_um), dtype=np.float64) * reference.interval_s
        return setup(stage, Reference(time_s, way_um, "reference"), "none", initial=initial).static_V

    def frequency_Hz() -> float | None:
        nominal = dict(reference.nominal)
        if "frequency_Hz" in nominal and "frequency_end_Hz" not in nominal:
            return nominal["frequency_Hz"]
        return None if reference.shape == "step" else strongest_Hz(reference.wanted(), reference.interval_s)

    found = from_rest_um, static_V, lambda: steepest_slope(stage), frequency_Hz
    return ctl.ControlTask(stage, reference.interval_s, *found)


class ControlJob(eqx.Module, AbstractJob):
    """Closed loops of a stage, with what they follow and how the stage stands before each row."""

    stage: m.Stage
    controllers: Controllers
    reference: Program = eqx.field(static=True)
    start: m.Start

    @property
    def facts(self) -> Facts:
        """What is known before it runs."""
        parameters = (*self.controllers.parameters(), *stage_parameters(self.stage), *self.reference.parameters)
        outputs = (*_OUTPUTS, *_STEP) if self.reference.shape == "step" else _OUTPUTS
        return Facts(parameters, outputs, block_rows(self.reference.samples))

    def compute(self, block: Block) -> Rows:
        """Run a block of loops on each device; see `AbstractJob.compute`."""
        values = place(block.values)
        wanted = drive(self.reference, block, values)
        outputs = {name: np.asarray(x) for name, x in _control(self, values, block.relative, wanted).items()}

        def radius(rows: Array, values: Mapping[str, Array]) -> Array:
            return _radius(self, rows, values, block.relative)

        outputs["pole_radius"] = in_turn(radius, block.rows, block.values)
        way = np.maximum(np.ptp(np.asarray(wanted), axis=1), np.abs(outputs.pop("from_um")))
        return Rows(outputs, tuple(map(_why_not, way, outputs["pole_radius"], outputs["e_max_pct"])))


def _why_not(way_um: float, radius: float, error_pct: float) -> str:
    if not way_um > 1e-9:
        return "the reference does not move"
    if radius >= 1:
        return f"the loop is unstable where the hysteresis is steepest: modulus of its largest pole = {radius:.6g}"
    # An error of a hundred times the reference's range is not of a loop that anybody wants.
    if not error_pct < 1e4:
        return "the loop is unstable: its error grows without end"
    return ""


def make(request: Request) -> ControlJob:
    """Make the job that a sweep asks for; a `DataError` says what is wrong with it."""
    stage, initial = requested_stage(request)
    reference = read_program(request.table.get("reference", {"shape": "step"}), "reference", "um", request.load)
    controllers = read_controllers(request.table.get("controller", {}), stage, initial, reference)
    return ControlJob(stage, controllers, reference, m.Start(None, memory_before(stage, initial)))


@by_rows("wanted", "values")
def _control(
    job: ControlJob, values: Mapping[str, Array], relative: tuple[str, ...], wanted: Float[Array, "n t"]
) -> dict[str, Float[Array, " n"]]:
    def one(values: Mapping[str, Float[Array, ""]], reference: Float[Array, " t"]) -> dict[str, Float[Array, ""]]:
        controller, changed = job.controllers.at(values), varied(job.stage, values, relative)
        run = ctl.simulate_loop(controller, changed, reference, delay=job.controllers.delay, start=job.start)
        # A step at the first sample is none within the record, but from where the stage stood.
        way = jnp.append(reference, run.displacement_um[0])
        share = 100 / jnp.ptp(way)
        found = {
            "e_rms_pct": share * jnp.sqrt(jnp.mean(run.error_um**2)),
            "e_max_pct": share * jnp.max(jnp.abs(run.error_um)),
            "error_rms_um": jnp.sqrt(jnp.mean(run.error_um**2)),
            "error_final_um": run.error_um[-1],
            "command_min_V": jnp.min(run.command_V),
            "command_max_V": jnp.max(run.command_V),
            "from_um": reference[0] - run.displacement_um[0],
        }
        if job.reference.shape == "step":
            answer = ctl.step_metrics(run.time_s, run.displacement_um, reference[-1], run.displacement_um[0])
            waited = run.time_s[jnp.argmax(reference == reference[-1])]
            found |= {"settling_time_s": answer.settling_time_s - waited, "overshoot_pct": answer.overshoot_pct}
        return found

    return jax.vmap(one)(values, wanted)


@eqx.filter_jit
def _radius(
    job: ControlJob, rows: Array, values: Mapping[str, Array], relative: tuple[str, ...]
) -> Float[Array, " n"]:
    """Largest modulus of the poles of each loop, NaN where a part of the stage has no linear form."""
    if not all(isinstance(part, m.AbstractLinear | m.Preisach) for part in job.stage.parts):
        return jnp.full(rows.shape, jnp.nan)

    def one(values: Mapping[str, Float[Array, ""]]) -> Float[Array, ""]:
        changed = varied(job.stage, values, relative)
        slopes = [major_loop_slope(part, fine=8) for part in changed.parts if isinstance(part, m.Preisach)]
        linear, slope = job.controllers.at(values).linear(), slopes[0] if slopes else None
        return ctl.margins(linear, changed, delay=job.controllers.delay, slope_um_per_V=slope).radius

    return jax.vmap(one)(values)
