"""The job `control`: a stage in closed loop with a controller, and its figures of merit."""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.control._tune_start import major_loop_slope
from fits.sweeps._controllers import Controllers, read_controllers
from fits.sweeps._devices import block_rows, by_rows, in_turn, place
from fits.sweeps._programs import Program, drive, read_program
from fits.sweeps._stages import memory_before, requested_stage, stage_parameters, varied
from fits.sweeps._types import AbstractJob, Block, Facts, Output, Request, Rows
from microid import AbstractLinear, Preisach, Stage, Start, margins, simulate_loop, step_metrics

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


class ControlJob(eqx.Module, AbstractJob):
    """Closed loops of a stage, with what they follow and how the stage stands before each row."""

    stage: Stage
    controllers: Controllers
    reference: Program = eqx.field(static=True)
    start: Start

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
    return ControlJob(stage, controllers, reference, Start(None, memory_before(stage, initial)))


@by_rows("wanted", "values")
def _control(
    job: ControlJob, values: Mapping[str, Array], relative: tuple[str, ...], wanted: Float[Array, "n t"]
) -> dict[str, Float[Array, " n"]]:
    def one(values: Mapping[str, Float[Array, ""]], reference: Float[Array, " t"]) -> dict[str, Float[Array, ""]]:
        controller, changed = job.controllers.at(values), varied(job.stage, values, relative)
        run = simulate_loop(controller, changed, reference, delay=job.controllers.delay, start=job.start)
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
            answer = step_metrics(run.time_s, run.displacement_um, reference[-1], run.displacement_um[0])
            waited = run.time_s[jnp.argmax(reference == reference[-1])]
            found |= {"settling_time_s": answer.settling_time_s - waited, "overshoot_pct": answer.overshoot_pct}
        return found

    return jax.vmap(one)(values, wanted)


@eqx.filter_jit
def _radius(
    job: ControlJob, rows: Array, values: Mapping[str, Array], relative: tuple[str, ...]
) -> Float[Array, " n"]:
    """Largest modulus of the poles of each loop, NaN where a part of the stage has no linear form."""
    if not all(isinstance(part, AbstractLinear | Preisach) for part in job.stage.parts):
        return jnp.full(rows.shape, jnp.nan)

    def one(values: Mapping[str, Float[Array, ""]]) -> Float[Array, ""]:
        changed = varied(job.stage, values, relative)
        slopes = [major_loop_slope(part, fine=8) for part in changed.parts if isinstance(part, Preisach)]
        linear, slope = job.controllers.at(values).linear(), slopes[0] if slopes else None
        return margins(linear, changed, delay=job.controllers.delay, slope_um_per_V=slope).radius

    return jax.vmap(one)(values)
