"""The job `fit`: loop fits of many records, in one batch or one by one."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from fits.io._errors import DataError, shown
from fits.io._record import Record
from fits.loop._design import branch_table
from fits.loop._fit import fit
from fits.loop._prior import roughness
from fits.loop._result import FitError
from fits.loop._run import INITIAL_STATES, initial_state, known_samples
from fits.machining._design import nearest
from fits.stats._metrics import errors
from fits.sweeps._choices import choice, chosen
from fits.sweeps._devices import in_turn, on_cpu, place
from fits.sweeps._fit_batch import BatchFit, fit_batch
from fits.sweeps._jobs import Request
from fits.sweeps._programs import number
from fits.sweeps._records import Files, Simulated, requested_records
from fits.sweeps._types import AbstractJob, Facts, FloatArray, Output, Parameter, Rows
from microid import Staircase, node_areas

_KEYS = ("method", "levels", "holdout", "initial", "samples", "weights", "smoothness")
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


class FitJob(AbstractJob):
    """Fits of a Preisach operator."""

    def __init__(
        self,
        records: Files | Simulated,
        levels: int | None,
        holdout: float,
        initial: str,
        samples: int,
        batch: bool,
        weights: bool,
        smoothness: float,
    ):
        """Prepare the job.

        Parameters
        ----------
        records
            What is fitted.
        levels
            Of the grid where they do not vary; None chooses them, one by one only.
        holdout
            Share at the end of each record that is only predicted.
        initial
            Memory before each record, one of `INITIAL_STATES`.
        samples
            That a record of a batch has at most.
        batch
            Whether all fits of a block are made together.
        weights
            Whether the weights are kept, too.
        smoothness
            Weight of the density's curvature in a batch; one by one it is found from the data.
        """
        self._records, self._levels, self._holdout, self._initial = records, levels, holdout, initial
        self._samples, self._batch, self._weights, self._smoothness = samples, batch, weights, smoothness

    @property
    def facts(self) -> Facts:
        """What is known before it runs."""
        sources = self._records.names if isinstance(self._records, Files) else ()
        outputs = list(_OUTPUTS)
        if self._weights:
            size = len(_packed(self._levels or 0)[0])
            outputs.append(Output("weights_um", "um", "weights of Eq. 9, packed row by row", (("weight", size),)))
        levels = float(self._levels or _DEFAULT_LEVELS)
        parameters = (
            *self._records.parameters,
            Parameter("fit.holdout", "1", self._holdout, 0.0, 0.9),
            Parameter("fit.levels", "1", levels, _FEWEST_LEVELS, _MOST_LEVELS, whole=True),
            choice("fit.initial", INITIAL_STATES, self._initial),
        )
        if self._batch:
            parameters = (*parameters, Parameter("fit.smoothness", "1", self._smoothness, 1e-12, 1e6))
        block = _BLOCK if self._batch else 1
        return Facts(parameters, tuple(outputs), block, sources, alone=not self._batch)

    def compute(
        self, values: Mapping[str, FloatArray], rows: NDArray[np.int64], sources: NDArray[np.int64], seed: int
    ) -> Rows:
        """Fit the records of some blocks; see `AbstractJob.compute`."""
        records, every = self._records.records(values, rows, sources, seed), np.ones(len(rows))
        holdout = values.get("fit.holdout", every * self._holdout)
        initial = chosen(values, "fit.initial", INITIAL_STATES, self._initial, len(rows))
        if self._batch:
            levels = values.get("fit.levels", every * (self._levels or _DEFAULT_LEVELS)).astype(int)
            smoothness = values.get("fit.smoothness", every * self._smoothness)
            return self._together(records, holdout, initial, levels, smoothness)
        swept = values.get("fit.levels")
        numbers = [self._levels] * len(rows) if swept is None else swept.astype(int).tolist()
        found = [self._alone(*options) for options in zip(records, numbers, holdout.tolist(), initial, strict=True)]
        outputs = {
            output.name: np.array([each[0].get(output.name, np.full(output.shape, np.nan)) for each in found])
            for output in self.facts.outputs
        }
        return Rows(outputs, tuple(reason for _, reason in found))

    def _alone(
        self, record: Record | str, levels: int | None, holdout: float, initial: str
    ) -> tuple[dict[str, Any], str]:
        if isinstance(record, str):
            return {}, record
        try:
            result = fit([record], levels=levels, holdout=holdout, initial=initial)
        except (DataError, FitError) as error:
            return {}, " ".join(str(error).split())
        run = result.runs[0]
        weights = np.asarray(result.weights_um)
        found: dict[str, Any] = {
            "offset_um": run.offset_um,
            "noise_um": result.noise_um,
            "loops_um": float(weights.sum()),
            "levels": len(weights),
            "weights_um": weights[_packed(len(weights))],
        }
        for start, figures in (("", run.in_sample), ("heldout_", run.held_out)):
            if figures is not None:
                found |= {f"{start}e_rms_pct": figures.e_rms_pct, f"{start}e_max_pct": figures.e_max_pct}
        return found, ""

    def _together(
        self,
        records: list[Record | str],
        holdout: FloatArray,
        initial: list[str],
        levels: NDArray[np.int64],
        smoothness: FloatArray,
    ) -> Rows:
        count, samples = len(records), self._samples
        voltage, displacement = np.zeros((count, samples)), np.zeros((count, samples))
        fitted, known = np.zeros((count, samples)), np.zeros((count, samples), dtype=bool)
        limits, extremes, used = np.tile([0.0, 1.0], (count, 1)), np.zeros((count, _PLACES)), np.ones(count, "i4")
        reasons = [""] * count
        for k, record in enumerate(records):
            reasons[k] = record if isinstance(record, str) else self._why_not(record)
            if isinstance(record, str) or reasons[k]:
                # Something harmless in its place.
                voltage[k], displacement[k], fitted[k] = np.arange(samples) % 2, np.arange(samples) % 2, 1.0
                continue
            assert record.displacement_um is not None
            n, v = len(record), record.voltage_V
            limits[k] = v.min(), v.max()
            voltage[k], displacement[k, :n] = np.pad(v, (0, samples - n), mode="edge"), record.displacement_um
            known[k, :n] = True if initial[k] != "unknown" else known_samples(v, *limits[k])
            fitted[k] = known[k] & (np.arange(samples) < n - round(holdout[k] * n))
            if fitted[k].sum() < _FEWEST:
                reasons[k] = f"only {int(fitted[k].sum())} samples are left to fit, {_FEWEST} are needed"
            start = initial_state(initial[k], *limits[k])
            extremes[k], used[k] = np.asarray(start.extremes_V), int(start.count)
        rows = voltage, displacement, fitted, limits, smoothness, extremes, used
        # The whole block on each number of levels there is in it, of which every row takes its own: what is found
        # for a row depends on its place in the block, and not on what the rows beside it ask for.
        found = {number: _fitted(number, rows) for number in np.unique(levels).tolist()}
        names = [name for name in found[int(levels[0])] if name != "weights_um" or self._weights]
        outputs = {name: np.array([found[n][name][k] for k, n in enumerate(levels.tolist())]) for name in names}
        predicted, success = outputs.pop("predicted_um"), outputs.pop("success")
        for start_name, samples_of in (("", fitted > 0), ("heldout_", known & (fitted == 0))):
            figures = [_errors(displacement[k], predicted[k], samples_of[k], known[k]) for k in range(count)]
            outputs[f"{start_name}e_rms_pct"] = np.array([each[0] for each in figures])
            outputs[f"{start_name}e_max_pct"] = np.array([each[1] for each in figures])
        for k in range(count):
            if not reasons[k] and not (success[k] and np.isfinite(outputs["e_rms_pct"][k])):
                reasons[k] = "the regression did not converge"
        return Rows(outputs, tuple(reasons))

    def _why_not(self, record: Record) -> str:
        if len(record) > self._samples:
            return f"the record has {len(record)} samples; raise fit.samples, which is {self._samples}"
        if record.displacement_um is None or np.ptp(record.displacement_um) == 0 or np.ptp(record.voltage_V) == 0:
            return "nothing moves in the record"
        return ""


def _fitted(levels: int, rows: tuple[NDArray[Any], ...]) -> dict[str, NDArray[Any]]:
    """Fit whole blocks on one number of levels; figures by output, weights, predictions and success."""
    table, rough = jnp.asarray(branch_table(levels)), roughness(levels)

    def regress(*rows: Array) -> BatchFit:
        fits: BatchFit = fit_batch(levels, table, rough, *rows[:5], Staircase(*rows[5:]))
        return fits

    found = in_turn(regress, *rows) if on_cpu() else regress(*map(place, rows))
    packed = _packed(levels)
    weights = np.asarray(found.columns_um)[:, : len(packed[0])] * node_areas(levels)[packed]
    return {
        "offset_um": np.asarray(found.offset_um),
        "noise_um": np.asarray(found.noise_um),
        "loops_um": weights.sum(axis=1),
        "levels": np.full(len(weights), float(levels)),
        "weights_um": weights,
        "predicted_um": np.asarray(found.predicted_um),
        "success": np.asarray(found.success),
    }


def _packed(levels: int) -> tuple[NDArray[np.int64], ...]:
    """Places of the weights in their square array, row by row."""
    return tuple(np.tril_indices(levels))


def _errors(measured: FloatArray, predicted: FloatArray, samples: Any, known: Any) -> tuple[float, float]:
    if not (samples.any() and known.any()) or np.ptp(measured[known]) == 0:
        return np.nan, np.nan
    figures = errors(measured[samples], predicted[samples], float(np.ptp(measured[known])))
    return figures.e_rms_pct, figures.e_max_pct


def make(request: Request) -> FitJob:
    """Make the job that a sweep asks for; a `DataError` says what is wrong with it."""
    records, table = requested_records(request), request.table.get("fit", {})
    for key in table:
        if key not in _KEYS:
            raise DataError(f"fit.{key}: expected a known key, found {shown(key)}; {nearest(key, _KEYS)}")
    method, initial = table.get("method", "batch"), table.get("initial")
    if method not in ("batch", "one_by_one"):
        raise DataError(f"fit.method: expected batch or one_by_one, found {shown(method)}; choose one.")
    known = request.table.get("initial", "negative") if isinstance(records, Simulated) else "unknown"
    initial = known if initial is None else initial
    if initial not in INITIAL_STATES:
        raise DataError(f"fit.initial: expected one of {', '.join(INITIAL_STATES)}, found {shown(initial)}.")
    levels = table.get("levels", _DEFAULT_LEVELS if method == "batch" else None)
    whole = isinstance(levels, int) and not isinstance(levels, bool)
    if levels is not None and not (whole and _FEWEST_LEVELS <= levels <= _MOST_LEVELS):
        raise DataError(
            f"fit.levels: expected a number from {_FEWEST_LEVELS} to {_MOST_LEVELS}, found {shown(levels)}."
        )
    weights = table.get("weights", False)
    if not isinstance(weights, bool) or (weights and levels is None):
        raise DataError(f"fit.weights: expected true, with fit.levels, or false, found {shown(weights)}; correct it.")
    if weights and "fit.levels" in request.names:
        raise DataError("fit.weights: rows of other fit.levels have other weights; leave out one of the two.")
    if isinstance(records, Simulated) and "samples" in table:
        raise DataError("fit.samples: simulated records have the samples of their program; leave it out.")
    if method == "one_by_one" and "smoothness" in table:
        raise DataError("fit.smoothness: one_by_one finds it from the data; leave it out.")
    samples = records.program.samples if isinstance(records, Simulated) else table.get("samples", 2048)
    if isinstance(samples, bool) or not isinstance(samples, int) or not _FEWEST <= samples <= _MOST:
        raise DataError(f"fit.samples: expected a number from {_FEWEST} to {_MOST:,}, found {shown(samples)}.")
    holdout = number(table.get("holdout", 0.2), "fit.holdout")
    if not 0 <= holdout <= 0.9:
        raise DataError(f"fit.holdout: expected a share between 0 and 0.9, found {holdout:g}; correct it.")
    smoothness = number(table.get("smoothness", 0.01), "fit.smoothness")
    if not 1e-12 <= smoothness <= 1e6:
        raise DataError(f"fit.smoothness: expected a weight from 1e-12 to 1e6, found {smoothness:g}; correct it.")
    return FitJob(records, levels, holdout, initial, samples, method == "batch", weights, smoothness)
