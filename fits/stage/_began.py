"""What went on before a run: what the driver was charged with when it began, and what the hysteresis remembered."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize_scalar

import microid as m
from fits.io._record import Record
from fits.loop._misfit import misfits
from fits.loop._prediction import Initial
from fits.loop._run import Run, prepare_aside, prepare_run
from fits.stage._before import memory_before
from fits.stage._run import (
    gain_ahead,
    nuisance_columns,
    place_of_hysteresis,
    residual_of,
    respond,
    settled_columns,
    simulate_stage,
    spanned,
)
from fits.stats._noise import rough_noise_um

# Voltages that are tried over the range, the part of their distance to which the best is found, and how much larger
# the Bayesian information criterion must be without.
_TRIED, _FINE, _LEAST = 25, 1e-3, 10.0
# Noise of a sensor, as a part of its range, of which there is hardly any less.
_NOISELESS = 1e-6
# Mean square that is left where the past counts, over that later, from which on it is looked into, and the part of a
# run that is later at least.
_MORE, _LATER = 1.1, 0.1
# Times that what was before is looked for: beside it a stage is fitted again, and shows more of it.
TURNS = 2
# The logarithm of how few first samples are asked for by themselves, and standard deviations beyond chance.
_FEW, _CHANCE_Z = 3, 6.0


def as_begun(stage: m.Stage, runs: Sequence[Run]) -> list[Record]:
    """The records of runs with what went on before them, where that explains more of them.

    A hysteresis keeps what the voltage behind the driver went through, and not what the command did. What is unknown
    of that is estimated beside the rest, but as smooth, which it is not where it turned.
    """
    place = place_of_hysteresis(stage)
    driven = any(isinstance(m.innermost(part), m.Driver) for part in stage.parts[:place])
    if place is None or not driven:
        return [run.record for run in runs]
    return [_begun(stage, run) if run.moving and run.has_past else run.record for run in runs]


def differ(records: Sequence[Record], begun: Sequence[Record]) -> bool:
    """Whether something else is known to have been before records now."""
    each = zip(records, begun, strict=True)
    return any((one.charged_V, one.before_V) != (other.charged_V, other.before_V) for one, other in each)


def _begun(stage: m.Stage, run: Run) -> Record:
    if not _leaves_more(residual_of(stage, run), run):
        return run.record
    charged = _anew(run, charged_V=_charge_V(stage, run))
    others = [run, charged, *(_anew(one, before_V=_before_V(stage, one)) for one in (run, charged))]
    best = min(others, key=lambda one: _criterion(stage, one))
    return best.record if _criterion(stage, best) < _criterion(stage, run) - _LEAST else run.record


def prepare_asides(
    stage: m.Stage, records: Sequence[Record], range_V: tuple[float, float], initial: Initial, stride: int
) -> list[Run]:
    """Make records ready that a stage predicts as a whole, with what went on before them."""
    if not records:
        return []
    settings: dict[str, Any] = {"stride": stride, "gain": gain_ahead(stage), "hold": stage.hold}

    def ready(record: Record, least: float | None = 0.0) -> Run:
        return prepare_aside(record, range_V, initial, least, **settings)

    runs = [replace(run, fitted=run.known) for run in map(ready, records)]
    least = [None if doubt else 0.0 for doubt in doubted(runs, [residual_of(stage, run) for run in runs])]
    runs = [ready(record, least=each) for record, each in zip(records, least, strict=True)]
    begun = as_begun(stage, [replace(run, fitted=run.known) for run in runs])
    return [ready(record, least=each) for record, each in zip(begun, least, strict=True)]


def doubted(runs: Sequence[Run], left_um: Sequence[np.ndarray]) -> list[bool]:
    """Of which runs that begin at an end of the range more is left than noise, or more until they were at both ends.

    Relays beyond the range, which have never switched or never switch back, are in any state there.
    """
    found = []
    for run, left, misfit in zip(runs, left_um, misfits(runs, left_um), strict=True):
        square, fitted = left**2, np.arange(len(left)) <= np.flatnonzero(run.fitted)[-1]
        early, later = fitted & ~run.been_at_both, fitted & run.been_at_both
        seen = not run.has_past and early.any() and later.any()
        found.append(bool(seen and (misfit.far or np.mean(square[early]) > _MORE * np.mean(square[later]))))
    return found


def weights_beside_pasts(runs: Sequence[Run], left_um: Sequence[np.ndarray]) -> list[np.ndarray]:
    """How much samples count where a past is estimated: less where it leaves more than the rest, `(n,)` each.

    Twice as many at a time: what a rig turned at last lies ever closer around where a run begins.
    """
    weights = []
    for run, left in zip(runs, left_um, strict=True):
        later, weight = _later(run), np.ones(len(left))
        early = np.flatnonzero(run.fitted & ~later)
        for some in np.split(early, 2 ** np.arange(_FEW, len(early).bit_length())):
            if run.has_past and len(some):
                times = _times_usual(left, some, later)
                weight[some] = 1 / times if _exceeds(times, len(some)) else 1.0
        weights.append(weight)
    return weights


def _times_usual(left_um: np.ndarray, some: np.ndarray, later: np.ndarray) -> float:
    """Mean square of what is left of some samples over that of later ones."""
    return float(np.mean(left_um[some] ** 2) / max(np.mean(left_um[later] ** 2), 1e-300))


def _exceeds(times: float, count: int) -> bool:
    """Whether so many samples have so many times the usual mean square, beyond chance."""
    return times > max(_MORE, 1 + _CHANCE_Z * (2 / count) ** 0.5)


def _leaves_more(left_um: np.ndarray, run: Run) -> bool:
    """Whether more is left where the past counts than later, or of the first few samples, beyond chance.

    Where the past counts to the end, more is left than noise.
    """
    later = _later(run)
    if later[: run.of_past].any():
        fitted_um = left_um[run.fitted]
        return _exceeds(float(np.mean(fitted_um**2)) / max(rough_noise_um(fitted_um) ** 2, 1e-300), len(fitted_um))
    early = np.flatnonzero(run.fitted & ~later)
    firsts = (early[:count] for count in (*2 ** np.arange(_FEW, len(early).bit_length()), len(early)))
    return any(len(some) and _exceeds(_times_usual(left_um, some, later), len(some)) for some in firsts)


def _later(run: Run) -> np.ndarray:
    """Samples that are fitted and depend on no unknown past, shape `(n,)`; the last ones where all do."""
    index = np.arange(len(run.record))
    later = run.fitted & (index >= run.of_past)
    last = np.flatnonzero(run.fitted)[-max(int(_LATER * run.fitted.sum()), 1) :]
    return later if later.sum() > len(last) else run.fitted & (index >= last[0])


def _anew(run: Run, **before: float | tuple[float, ...]) -> Run:
    """The same run after something else."""
    record = replace(run.record, **before)  # type: ignore[arg-type]
    ends_V = run.lower_V / run.gain, run.upper_V / run.gain
    begun = prepare_run(record, ends_V, "unknown", 0.0, run.stride, run.gain, run.hold, None, True)
    return replace(run, record=record, start=begun.start)


def _criterion(stage: m.Stage, run: Run) -> float:
    """Bayesian information criterion of what is known to have been before a run, its noise unknown."""
    left_um = residual_of(stage, run)[run.fitted]
    known = len(run.record.before_V) + (run.record.charged_V != 0)
    return float(len(left_um) * np.log(np.sum(left_um**2) + 1e-300) + known * np.log(len(left_um)))


def _before_V(stage: m.Stage, run: Run) -> tuple[float, ...]:
    """Extremes that the hysteresis remembered, at it, by what is left where the past counts."""
    later, left_um, alone_um = _later(run), residual_of(stage, run), simulate_stage(stage, run)
    offset_um = float(np.mean((run.displacement_um - left_um - alone_um)[later]))
    noise_um = float(np.std(left_um[later]))
    guess = run.start if run.record.before_V else memory_before(stage, run, alone_um + offset_um, noise_um)
    from fits.stage._turned import memory_behind  # its solver takes long to import

    # Simulated readings may have none.
    sensor_um = max(rough_noise_um(left_um[run.fitted]), _NOISELESS * float(np.ptp(run.displacement_um)))
    found = memory_behind(stage, run, guess, sensor_um)
    return tuple(np.asarray(found.extremes_V)[: int(found.count)].tolist())


def _charge_V(stage: m.Stage, run: Run) -> float:
    """By how much the voltage behind the driver was ahead of the first command; as the record has it by default."""
    samples, record = run.coarser.samples, run.record
    root = np.sqrt(np.asarray(samples.weight))
    columns = settled_columns(stage, samples), nuisance_columns(stage, samples)
    plain, powers = (spanned(root[:, None] * np.asarray(each)) for each in columns)

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
