"""The job `fit`: loop fits of many records, in one batch or one by one."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from msgspec import Meta
from numpy.typing import NDArray

from fits.io._errors import DataError
from fits.io._record import Record
from fits.io._typed import typed
from fits.loop._design import Grid, branch_table, design
from fits.loop._fit import fit
from fits.loop._known import known_samples
from fits.loop._moments import Moments
from fits.loop._plain import INITIAL_STATES
from fits.loop._prior import Hyper, Posterior, Roughness, effective, renew_noise, roughness
from fits.loop._run import initial_state
from fits.stats._metrics import errors
from fits.stats._nonnegative import minimise_nonnegative
from fits.sweeps._devices import by_rows, in_turn, place
from fits.sweeps._records import Files, Holdout, Initial, Simulated, assumed_initial, each_alone, requested_records
from fits.sweeps._types import AbstractJob, Block, Facts, FloatArray, Output, Parameter, Request, Rows, choice
from microid import Staircase
from microid.densities import node_areas

KEYS = ("model", "initial", "program", "records", "fit")
_BLOCK, _PLACES, _FEWEST, _MOST = 32, 64, 50, 100_000
_FEWEST_LEVELS, _MOST_LEVELS, _DEFAULT_LEVELS = 4, 32, 8
_OUTPUTS = (
    Output("offset_um", "um", "reading at negative saturation"),
    Output("noise_um", "um", "standard deviation of the noise"),
    Output("loops_um", "um", "sum of the weights: the stroke that has a loop"),
    Output("e_rms_pct", "%", "root mean square of what is left where it was fitted, of the range"),
    Output("e_max_pct", "%", "largest of what is left where it was fitted, of the range"),
    Output("heldout_e_rms_pct", "%", "root mean square of what is left where it was predicted, of the range"),
    Output("heldout_e_max_pct", "%", "largest of what is left where it was predicted, of the range"),
    Output("levels", "1", "switching voltages"),
)


class _Options(msgspec.Struct):
    """The table `[fit]`. Without levels one by one chooses them; a batch has a stated smoothness."""

    method: Annotated[Literal["batch", "one_by_one"], Meta(description="batch or one_by_one")] = "batch"
    levels: Annotated[
        Annotated[int, Meta(ge=_FEWEST_LEVELS, le=_MOST_LEVELS)] | None,
        Meta(description=f"a number from {_FEWEST_LEVELS} to {_MOST_LEVELS}"),
    ] = None
    holdout: Holdout = 0.2
    initial: Initial = None
    samples: Annotated[int, Meta(ge=_FEWEST, le=_MOST, description=f"a number from {_FEWEST} to {_MOST:,}")] = 2048
    weights: Annotated[bool, Meta(description="true, with fit.levels, or false")] = False
    smoothness: Annotated[float, Meta(ge=1e-12, le=1e6, description="a weight from 1e-12 to 1e6")] = 0.01


@dataclass(frozen=True, eq=False)
class FitJob(AbstractJob):
    """Fits of a Preisach operator: records, options of all rows, and the memory before each, of `INITIAL_STATES`."""

    records: Files | Simulated
    options: _Options
    initial: str

    @property
    def _batch(self) -> bool:
        return self.options.method == "batch"

    @property
    def facts(self) -> Facts:
        """What is known before it runs."""
        outputs = list(_OUTPUTS)
        if self.options.weights:
            size = len(np.tril_indices(self.options.levels or 0)[0])
            outputs.append(Output("weights_um", "um", "weights of Eq. 9, packed row by row", (("weight", size),)))
        parameters = [*self.records.parameters, Parameter("fit.holdout", "1", self.options.holdout, 0.0, 0.9)]
        parameters.append(choice("fit.initial", INITIAL_STATES, self.initial))
        if not self.options.weights:
            # Rows of other levels have other weights.
            levels = float(self.options.levels or _DEFAULT_LEVELS)
            parameters.append(Parameter("fit.levels", "1", levels, _FEWEST_LEVELS, _MOST_LEVELS, whole=True))
        if self._batch:
            parameters.append(Parameter("fit.smoothness", "1", self.options.smoothness, 1e-12, 1e6))
        block = _BLOCK if self._batch else 1
        return Facts(tuple(parameters), tuple(outputs), block, self.records.sources, alone=not self._batch)

    def compute(self, block: Block) -> Rows:
        """Fit the records of some blocks; see `AbstractJob.compute`."""
        records, holdout = self.records.records(block), block.numbers("fit.holdout", self.options.holdout)
        initial = block.words("fit.initial", INITIAL_STATES, self.initial)
        if self._batch:
            return self._together(block, records, holdout, initial)
        swept = block.values.get("fit.levels")
        numbers = [self.options.levels] * len(records) if swept is None else swept.astype(int).tolist()
        return each_alone(self.facts.outputs, records, _alone, numbers, holdout.tolist(), initial)

    def _together(self, block: Block, records: list[Record | str], holdout: FloatArray, initial: list[str]) -> Rows:
        levels = block.numbers("fit.levels", self.options.levels or _DEFAULT_LEVELS).astype(int)
        smoothness = block.numbers("fit.smoothness", self.options.smoothness)
        count, samples = len(records), self.options.samples
        voltage, displacement, fitted = np.zeros((3, count, samples))
        known, limits = np.zeros((count, samples), dtype=bool), np.tile([0.0, 1.0], (count, 1))
        extremes, used = np.zeros((count, _PLACES)), np.ones(count, "i4")
        reasons = [""] * count
        for k, record in enumerate(records):
            reasons[k] = record if isinstance(record, str) else self._why_not(record)
            if isinstance(record, str) or reasons[k]:
                # Something harmless in its place.
                voltage[k], displacement[k], fitted[k] = np.arange(samples) % 2, np.arange(samples) % 2, 1.0
                continue
            assert record.displacement_um is not None
            n, v = len(record), record.voltage_V
            lower, upper = limits[k] = v.min(), v.max()
            voltage[k], displacement[k, :n] = np.pad(v, (0, samples - n), mode="edge"), record.displacement_um
            known[k, :n] = known_samples(v, lower, upper, initial[k])
            fitted[k] = known[k] & (np.arange(samples) < n - round(holdout[k] * n))
            if fitted[k].sum() < _FEWEST:
                reasons[k] = f"only {int(fitted[k].sum())} samples are left to fit, {_FEWEST} are needed"
            start = initial_state(initial[k], lower, upper)
            extremes[k], used[k] = np.asarray(start.extremes_V), int(start.count)
        rows = voltage, displacement, fitted, limits, smoothness, extremes, used
        # The whole block on each number of levels there is in it, of which every row takes its own: what is found
        # for a row depends on its place in the block, and not on what the rows beside it ask for.
        found = {number: _fitted(number, rows) for number in np.unique(levels).tolist()}
        each: list[dict[str, Any] | str] = []
        for k, number in enumerate(levels.tolist()):
            row = {name: value[k] for name, value in found[number].items()}
            for start_name, chosen in (("", fitted[k] > 0), ("heldout_", known[k] & (fitted[k] == 0))):
                figures = _errors(displacement[k], row["predicted_um"], chosen, known[k])
                row |= {f"{start_name}e_rms_pct": figures[0], f"{start_name}e_max_pct": figures[1]}
            converged = row["success"] and np.isfinite(row["e_rms_pct"])
            each.append(reasons[k] or (row if converged else "the regression did not converge"))
        return Rows.one_by_one(self.facts.outputs, each)

    def _why_not(self, record: Record) -> str:
        if len(record) > self.options.samples:
            return f"the record has {len(record)} samples; raise fit.samples, which is {self.options.samples}"
        if record.displacement_um is None or np.ptp(record.displacement_um) == 0 or np.ptp(record.voltage_V) == 0:
            return "nothing moves in the record"
        return ""


def _alone(record: Record, levels: int | None, holdout: float, initial: str) -> dict[str, Any]:
    result = fit([record], levels=levels, holdout=holdout, initial=initial)
    run, weights = result.runs[0], np.asarray(result.weights_um)
    found: dict[str, Any] = {
        "offset_um": run.offset_um,
        "noise_um": result.noise_um,
        "loops_um": float(weights.sum()),
        "levels": len(weights),
        "weights_um": weights[np.tril_indices(len(weights))],
    }
    for start, figures in (("", run.in_sample), ("heldout_", run.held_out)):
        if figures is not None:
            found |= {f"{start}e_rms_pct": figures.e_rms_pct, f"{start}e_max_pct": figures.e_max_pct}
    return found


def _fitted(levels: int, rows: tuple[NDArray[Any], ...]) -> dict[str, NDArray[Any]]:
    """Fit whole blocks on one number of levels; figures by output, weights, predictions and success."""
    table, rough = jnp.asarray(branch_table(levels)), roughness(levels)

    def regress(*rows: Array) -> dict[str, Array]:
        return fit_batch(levels, table, rough, *rows[:5], Staircase(*rows[5:]))

    batch = in_turn(regress, *rows) if jax.default_backend() == "cpu" else regress(*map(place, rows))
    found, packed = {name: np.asarray(values) for name, values in batch.items()}, np.tril_indices(levels)
    weights = found["columns_um"][:, : len(packed[0])] * node_areas(levels)[packed]
    numbers = np.full(len(weights), float(levels))
    return found | {"loops_um": weights.sum(axis=1), "levels": numbers, "weights_um": weights}


def _errors(measured: FloatArray, predicted: FloatArray, samples: Any, known: Any) -> tuple[float, float]:
    if not (samples.any() and known.any()) or np.ptp(measured[known]) == 0:
        return np.nan, np.nan
    figures = errors(measured[samples], predicted[samples], float(np.ptp(measured[known])))
    return figures.e_rms_pct, figures.e_max_pct


def make(request: Request) -> FitJob:
    """Make the job that a sweep asks for; a `DataError` says what is wrong with it."""
    records, table = requested_records(request), request.table.get("fit", {})
    options = typed(table, _Options, "fit")
    if options.method == "batch" and options.levels is None:
        options.levels = _DEFAULT_LEVELS
    if options.weights and options.levels is None:
        raise DataError("fit.weights: expected true, with fit.levels, or false, found true; correct it.")
    axes = request.table.get("axis")
    if options.weights and isinstance(axes, list) and {"fit.levels"} & {str(each.get("parameter")) for each in axes}:
        raise DataError("fit.weights: rows of other fit.levels have other weights; leave out one of the two.")
    if options.method == "one_by_one" and "smoothness" in table:
        raise DataError("fit.smoothness: one_by_one finds it from the data; leave it out.")
    if isinstance(records, Simulated):
        if "samples" in table:
            raise DataError("fit.samples: simulated records have the samples of their program; leave it out.")
        options.samples = typed({"samples": records.program.samples}, _Options, "fit").samples
    return FitJob(records, options, options.initial or assumed_initial(request, records))


@by_rows("voltage_V", "displacement_um", "weight", "limits_V", "smoothness", "starts")
def fit_batch(
    levels: int,
    table: Float[Array, "4 k D"],
    rough: Roughness,
    voltage_V: Float[Array, "n t"],
    displacement_um: Float[Array, "n t"],
    weight: Float[Array, "n t"],
    limits_V: Float[Array, "n 2"],
    smoothness: Float[Array, " n"],
    starts: Staircase,
) -> dict[str, Array]:
    """Fit all rows on a grid, of which `table` is the `branch_table` and `rough` the `roughness`.

    The weight is 1 for samples that are fitted and 0 for others; the smoothness that of the curvature, see `Hyper`;
    the range of the levels and the memory before it belong to each row. What comes back has a row each: `columns_um`
    as in `Grid`, `offset_um`, `noise_um`, a standard deviation, `predicted_um`, shape `(n, t)`, and `success`.
    """

    def responses(row: tuple[Array, Array, Staircase]) -> Float[Array, "t D"]:
        voltage, limits, start = row
        return design(Grid(limits[0], limits[1], levels), table, voltage, start)[0]

    def one(columns: Array, displacement: Array, weight: Array, smoothness: Array) -> dict[str, Array]:
        count, used = jnp.maximum(jnp.sum(weight), 1.0), weight > 0
        highest = jnp.max(displacement, where=used, initial=-jnp.inf)
        stroke = highest - jnp.min(displacement, where=used, initial=jnp.inf)
        mean_column, mean = weight @ columns / count, weight @ displacement / count
        left, right = (columns - mean_column[None, :]) * weight[:, None], (displacement - mean) * weight / stroke
        moments = Moments(left.T @ left, left.T @ right, right @ right, count)
        weight_of = jnp.log(smoothness)
        # The noise is found from this start, in squared strokes, in a few rounds of a fixed point.
        hyper = Hyper(weight_of, jnp.asarray(-30.0), weight_of, weight_of, jnp.log(jnp.asarray(1e-6)))

        def renew(_: int, hyper: Hyper) -> Hyper:
            posterior = Posterior.of(moments, rough, hyper)
            return renew_noise(moments, hyper, posterior, effective(rough, hyper, posterior))

        hyper = lax.fori_loop(0, 4, renew, hyper)
        posterior = Posterior.of(moments, rough, hyper)
        scale = jnp.sqrt(jnp.diagonal(posterior.precision))
        precision, mode = jnp.asarray(posterior.precision) / (scale[:, None] * scale[None, :]), posterior.mean * scale
        solution, success = minimise_nonnegative(precision, -(precision @ mode), jnp.maximum(mode, 0), 1e-6, 500)
        found = solution / scale * stroke
        offset = mean - mean_column @ found
        noise = jnp.exp(hyper.log_variance / 2) * stroke
        fitted = {"columns_um": found, "offset_um": offset, "noise_um": noise}
        return fitted | {"predicted_um": columns @ found + offset, "success": success}

    # Row by row: what a hysteresis remembers is found fastest by a loop of scalars.
    columns = lax.map(responses, (voltage_V, limits_V, starts))
    return jax.vmap(one)(columns, displacement_um, weight, smoothness)
