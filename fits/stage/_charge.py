"""What the driver of a stage was still charged with when a run began."""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from scipy.linalg import qr
from scipy.optimize import minimize_scalar

import microid as m
from fits.io._record import Record
from fits.loop._run import Run
from fits.stage._run import nuisance_columns, place_of_hysteresis, respond, settled_columns

# Voltages that are tried over the range, the part of their distance to which the best is found, and how much larger
# the Bayesian information criterion must be without.
_TRIED, _FINE, _LEAST = 25, 1e-3, 10.0
# Part of a column beside the others below which it is rounding.
_DEPENDENT = 1e-10


def with_charges(stage: m.Stage, runs: Sequence[Run]) -> list[Record]:
    """The records of runs, with what the driver was charged with before each, where that explains more of it.

    A hysteresis keeps what the voltage behind the driver went through, and not what the command did.
    """
    place = place_of_hysteresis(stage)
    driven = any(isinstance(m.innermost(part), m.Driver) for part in stage.parts[:place])
    if place is None or not driven:
        return [run.record for run in runs]
    return [replace(run.record, charged_V=_charge_V(stage, run)) if run.moving else run.record for run in runs]


def _charge_V(stage: m.Stage, run: Run) -> float:
    """By how much the voltage behind the driver was ahead of the first command; as the record has it by default."""
    samples, record = run.coarser.samples, run.record
    root = np.sqrt(np.asarray(samples.weight))
    columns = settled_columns(stage, samples), nuisance_columns(stage, samples)
    plain, powers = (_spanned(root[:, None] * np.asarray(each)) for each in columns)

    def left(rest_V: float, beside: np.ndarray = plain) -> float:
        """Sum of squares that the stage leaves after a rest, in um^2."""
        rest = jnp.asarray(rest_V)
        begun = replace(samples, rest_V=rest, start=replace(samples.start, rest_V=rest))
        off = root * np.asarray(samples.displacement_um - respond(stage, begun))
        off -= beside @ (beside.T @ off)
        return float(off @ off)

    grid_V = np.linspace(run.lower_V, run.upper_V, _TRIED) / run.gain
    best_V, step_V = min(grid_V, key=left), grid_V[1] - grid_V[0]
    around_V = max(best_V - step_V, grid_V[0]), min(best_V + step_V, grid_V[-1])
    found = minimize_scalar(left, bounds=around_V, method="bounded", options={"xatol": _FINE * step_V})
    # What it was charged with may hardly bend its way, and then its powers do as well.
    now = left(record.voltage_V[0] + record.charged_V, powers)
    if run.fitted.sum() * np.log(now / float(found.fun)) < _LEAST:
        return record.charged_V
    return float(found.x) - float(record.voltage_V[0])


def _spanned(columns: np.ndarray) -> np.ndarray:
    """Orthonormal columns that span the same, shape `(n, r)`."""
    size = np.linalg.norm(columns, axis=0)
    basis, upper, _ = qr(columns[:, size > 0] / size[size > 0], mode="economic", pivoting=True)
    return basis[:, np.abs(np.diagonal(upper)) > _DEPENDENT]
