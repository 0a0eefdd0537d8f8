"""The job `simulate`: the response of a stage to a program, and figures that sum it up."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from fits.io._errors import DataError, shown
from fits.sweeps._devices import by_rows, place
from fits.sweeps._jobs import Request
from fits.sweeps._programs import Program, number, read_program
from fits.sweeps._stages import memory_before, requested_stage, respond, stage_parameters
from fits.sweeps._types import AbstractJob, Facts, FloatArray, Output, Rows
from microid import Stage, Staircase

# Arrays of one value per sample that a row needs at a time, and how much memory all rows of a block may need.
_ARRAYS, _BLOCK_BYTES, _LARGEST_BLOCK = 30, 128e6, 256


def block_rows(samples: int) -> int:
    """Rows to compute together: a power of two that depends on the number of samples alone."""
    fit = _BLOCK_BYTES / (8 * _ARRAYS * samples)
    return int(min(_LARGEST_BLOCK, 2 ** max(0, int(np.log2(max(fit, 1.0))))))


class SimulateJob(AbstractJob):
    """Simulations of a stage."""

    def __init__(
        self,
        stage: Stage,
        program: Program,
        initial: str,
        names: tuple[str, ...],
        relative: tuple[str, ...],
        from_s: float = 0.0,
        every: int = 0,
    ):
        """Prepare the job.

        Parameters
        ----------
        stage, program
            What is simulated, and the voltage.
        initial
            Memory before each row.
        names, relative
            Parameters that vary, and which of them as factors.
        from_s
            Where the figures begin to count.
        every
            Traces are kept at every so many samples; not at all if 0.
        """
        self._stage, self._program, self._names, self._relative = stage, program, names, relative
        self._memory = memory_before(stage, initial)
        self._given = None if program.given is None else jnp.asarray(program.given)
        self._first, self._every = round(from_s / program.interval_s), every

    @property
    def facts(self) -> Facts:
        """What is known before it runs."""
        samples = self._program.samples
        outputs = list(_OUTPUTS)
        coordinates: dict[str, tuple[str, str, FloatArray]] = {}
        if self._every:
            time_s = np.arange(0, samples, self._every) * self._program.interval_s
            outputs += [
                Output("displacement_um", "um", "displacement at times", (("time", len(time_s)),)),
                Output("voltage_V", "V", "command at times", (("time", len(time_s)),)),
            ]
            coordinates["time_s"] = ("time", "s", np.asarray(time_s, dtype=np.float64))
        parameters = (*stage_parameters(self._stage), *self._program.parameters)
        block = block_rows(samples)
        return Facts(parameters, tuple(outputs), block, coordinates=coordinates)

    def compute(
        self, values: Mapping[str, FloatArray], rows: NDArray[np.int64], sources: NDArray[np.int64], seed: int
    ) -> Rows:
        """Simulate a block on each device; see `AbstractJob.compute`."""
        del sources, seed
        table = table_of(values, self._names, len(rows))
        found = _simulate(
            self._stage,
            place(table),
            self._names,
            self._relative,
            self._program,
            self._given,
            self._memory,
            self._first,
            self._every,
        )
        outputs = {name: np.asarray(value) for name, value in found.items()}
        fine = np.isfinite(outputs["displacement_rms_um"])
        reasons = tuple("" if good else "the displacement is not finite" for good in fine)
        return Rows(outputs, reasons)


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


def make(request: Request) -> SimulateJob:
    """Make the job that a sweep asks for; a `DataError` says what is wrong with it."""
    stage, initial = requested_stage(request)
    program = read_program(request.table.get("program", {"shape": "sine"}), "program", "V", request.load)
    asked = request.table.get("outputs", {})
    for key in asked:
        if key not in ("traces", "every", "from_s"):
            raise DataError(f"outputs.{key}: expected a known key, found {shown(key)}; use traces, every and from_s.")
    traces, every = asked.get("traces", False), asked.get("every", 1)
    if not isinstance(traces, bool):
        raise DataError(f"outputs.traces: expected true or false, found {shown(traces)}; correct it.")
    if isinstance(every, bool) or not isinstance(every, int) or every < 1:
        raise DataError(f"outputs.every: expected a number of samples, 1 or more, found {shown(every)}; correct it.")
    from_s = number(asked.get("from_s", 0.0), "outputs.from_s")
    if not 0 <= from_s < (program.samples - 1) * program.interval_s:
        raise DataError(f"outputs.from_s: expected a time within the program, found {from_s:g}; correct it.")
    return SimulateJob(stage, program, initial, request.names, request.relative, from_s, every if traces else 0)


# In programs of their own: compiled as one, XLA computes much of it several times.
def _simulate(
    stage: Stage,
    table: Float[Array, "n k"],
    names: tuple[str, ...],
    relative: tuple[str, ...],
    program: Program,
    given: Float[Array, " t"] | None,
    memory: Staircase | None,
    first: int,
    every: int,
) -> dict[str, Float[Array, "n ..."]]:
    voltage = drive(table, names, program, given)
    displacement = respond(stage, table, names, relative, jnp.asarray(program.interval_s), voltage, memory)
    found = _sum_up(voltage, displacement, first)
    if every:
        found |= {"displacement_um": displacement[:, ::every], "voltage_V": voltage[:, ::every]}
    return found


def table_of(values: Mapping[str, FloatArray], names: tuple[str, ...], count: int) -> FloatArray:
    """Values as the columns of a table, shape `(count, names)`."""
    return np.stack([values[name] for name in names], axis=1) if names else np.zeros((count, 0))


@by_rows("table")
def drive(
    table: Float[Array, "n k"], names: tuple[str, ...], program: Program, given: Float[Array, " t"] | None
) -> Float[Array, "n t"]:
    """Signals of all rows, whose parameters are the columns of a table."""
    return jax.vmap(lambda row: program.signal(dict(zip(names, row, strict=True)), given))(table)


@by_rows("voltage", "displacement")
def _sum_up(
    voltage: Float[Array, "n t"], displacement: Float[Array, "n t"], first: int
) -> dict[str, Float[Array, " n"]]:
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
