"""The job `simulate`: the response of a stage to a program, and figures that sum it up."""

from dataclasses import dataclass
from typing import Annotated

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import Array, Float
from msgspec import Meta

from fits.io._errors import DataError
from fits.io._typed import typed
from fits.sweeps._devices import block_rows, by_rows
from fits.sweeps._stages import Program, read_program, requested_stage, simulated, stage_parameters
from fits.sweeps._types import AbstractJob, Block, Facts, FloatArray, Output, Request, Rows
from microid import Stage

KEYS = ("model", "initial", "program", "outputs")
_OUTPUTS = (
    Output("displacement_min_um", "um", "smallest displacement"),
    Output("displacement_max_um", "um", "largest displacement"),
    Output("displacement_mean_um", "um", "mean displacement"),
    Output("displacement_rms_um", "um", "root mean square of the displacement"),
    Output("displacement_final_um", "um", "displacement at the last sample"),
    Output("stroke_um", "um", "largest less smallest displacement"),
    Output("hysteresis_width_um", "um", "width of the loop at the middle of the voltage's range; 0 without a loop"),
    Output("hysteresis_width_pct", "%", "the same in percent of the stroke"),
)


class _Options(msgspec.Struct):
    """The table `[outputs]`: where figures begin to count, and whether traces are kept, at every so many samples."""

    traces: Annotated[bool, Meta(description="true or false")] = False
    every: Annotated[int, Meta(ge=1, description="a number of samples, 1 or more")] = 1
    from_s: Annotated[float, Meta(ge=0, description="a time within the program")] = 0.0


@dataclass(frozen=True, eq=False)
class SimulateJob(AbstractJob):
    """Simulations of a stage under a voltage; traces are kept at every so many samples, not at all if that is 0."""

    stage: Stage
    program: Program
    initial: str
    from_s: float = 0.0
    every: int = 0

    @property
    def facts(self) -> Facts:
        """What is known before it runs."""
        outputs: tuple[Output, ...] = _OUTPUTS
        coordinates: dict[str, tuple[str, str, FloatArray]] = {}
        if self.every:
            time_s = np.arange(0, self.program.samples, self.every, dtype=np.float64) * self.program.interval_s
            times = (("time", len(time_s)),)
            outputs += (
                Output("displacement_um", "um", "displacement at times", times),
                Output("voltage_V", "V", "command at times", times),
            )
            coordinates["time_s"] = "time", "s", time_s
        parameters = (*stage_parameters(self.stage), *self.program.parameters)
        return Facts(parameters, outputs, block_rows(self.program.samples), coordinates=coordinates)

    def compute(self, block: Block) -> Rows:
        """Simulate a block on each device; see `AbstractJob.compute`."""
        voltage, displacement = simulated(self.stage, self.program, self.initial, block)
        found = _sum_up(voltage, displacement, round(self.from_s / self.program.interval_s))
        if self.every:
            found |= {"displacement_um": displacement[:, :: self.every], "voltage_V": voltage[:, :: self.every]}
        outputs = {name: np.asarray(value) for name, value in found.items()}
        fine = np.isfinite(outputs["displacement_rms_um"])
        reasons = tuple("" if good else "the displacement is not finite" for good in fine)
        return Rows(outputs, reasons)


def make(request: Request) -> SimulateJob:
    """Make the job that a sweep asks for; a `DataError` says what is wrong with it."""
    stage, initial = requested_stage(request)
    program = read_program(request.table.get("program", {"shape": "sine"}), "program", "V", request.load)
    asked = typed(request.table.get("outputs", {}), _Options, "outputs")
    if not asked.from_s < program.last_s:
        raise DataError(f"outputs.from_s: expected a time within the program, found {asked.from_s:g}; correct it.")
    return SimulateJob(stage, program, initial, asked.from_s, asked.every if asked.traces else 0)


@by_rows("voltage", "displacement")
def _sum_up(voltage: Float[Array, "n t"], displacement: Float[Array, "n t"], first: int) -> dict[str, Array]:
    return jax.vmap(summary)(voltage[:, first:], displacement[:, first:])


def summary(voltage: Float[Array, " t"], displacement: Float[Array, " t"]) -> dict[str, Float[Array, ""]]:
    """Figures of one response, by output."""
    low, high = jnp.min(displacement), jnp.max(displacement)
    middle = (jnp.min(voltage) + jnp.max(voltage)) / 2
    before, after = voltage[:-1] - middle, voltage[1:] - middle
    crosses = (before < 0) != (after < 0)
    share = before / jnp.where(crosses, before - after, 1)
    there = displacement[:-1] + share * jnp.diff(displacement)
    width = jnp.max(jnp.where(crosses, there, -jnp.inf)) - jnp.min(jnp.where(crosses, there, jnp.inf))
    width = jnp.where(jnp.sum(crosses) >= 2, width, 0.0)
    return {
        "displacement_min_um": low,
        "displacement_max_um": high,
        "displacement_mean_um": jnp.mean(displacement),
        "displacement_rms_um": jnp.sqrt(jnp.mean(displacement**2)),
        "displacement_final_um": displacement[-1],
        "stroke_um": high - low,
        "hysteresis_width_um": width,
        "hysteresis_width_pct": 100 * width / jnp.where(high > low, high - low, 1),
    }
