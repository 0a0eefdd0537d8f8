"""Where a lag lies that runs show without a resonance: in the driver, ahead of the hysteresis, or behind it."""

from functools import partial

import numpy as np

from fits.diagnosis._joint_fit import alternate
from fits.diagnosis._plain_fit import PlainFit, is_far_less
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit, nothing, refit_beside
from fits.diagnosis._score import Scored, score
from fits.diagnosis._thresholds import Thresholds
from fits.io._threads import map_in_threads
from fits.stage._run import named_parts
from microid import Driver, Lag, Mechanics

# A resonance that is damped less rings, and is not mistaken for a delay.
_RINGS = 0.2
# Most of what is left beyond noise is late.
_MOSTLY = 0.5
# What is left exceeds noise by no more than this part of it.
_NOISE = 0.05
# So many effects beside a lag are fitted.
_TRIED = 2
# Damping ratios from its frequency within which a mode answers.
_NEAR = 2.0
# So many time constants after the first sample a lag has settled.
_SETTLED = 8


def may_be_of_driver(plain: PlainFit, thresholds: Thresholds) -> bool:
    """Whether a driver alone may explain what a stage does not, or explains by a mode that never rings."""
    late, left = plain.delay_drop(plain.left), float(plain.left @ plain.left)
    if not plain.regression.baseline.dynamic:
        return late > thresholds.other_hold_z**2
    noise = len(plain.left)
    return left > (1 + _NOISE) * noise and (_is_damped(plain) or late > _MOSTLY * (left - noise))


def lag_of(plain: PlainFit) -> float:
    """How late the readings are, in s: as its driver and mechanics have it, or as a delay shows them."""
    parts = [part for _, part in named_parts(plain.regression.baseline.stage, Driver, Lag, Mechanics)]
    if not parts:
        return plain.late()[1]
    return float(sum(np.sum(-1 / part.poles_rad_per_s).real for part in parts))


def is_of_driver(driver: PlainFit, plain: PlainFit, thresholds: Thresholds) -> bool:
    """Whether a stage with a driver and no mechanics is to be taken in place of the plain one.

    Every stage has a driver: one that leaves noise alone needs no other lag. It lags ahead of the hysteresis, and a
    sensor behind it, so that loops turn otherwise: beside a quasi-static stage a lag of the reading must leave less,
    by more than models are off by. A mode that never rings may stand in for a delay: where a driver beside one, and
    beside what else explains most, leaves far less than that mode alone, and no more than the mode beside the same,
    the mode is not needed.
    """
    if not driver.regression.baseline.dynamic:
        return False
    if plain.regression.baseline.dynamic:
        alone, left, noise = driver.left_in(plain.faults), float(plain.left @ plain.left), len(plain.left)
        if is_far_less(float(alone @ alone), left, noise):
            return True
        beside = _left_beside_two(driver.in_noise_of(plain)) if _is_damped(plain) else np.inf
        if not is_far_less(beside, left, noise):
            return False
        other = _left_beside_two(plain)
        return beside < other + max(thresholds.other_hold_z**2, thresholds.model_error * (other - noise))
    left, noise = float(driver.left @ driver.left), len(driver.left)
    if left <= (1 + _NOISE) * noise:
        return True
    there, lag_s = plain.in_noise_of(driver), lag_of(driver)
    ends = [alternate(there.bench, there.projector, lag) for lag in _beside_lags(there)]
    # Either follows what moved before the record in a way of its own.
    left = _left_later(driver.projector, driver.left, lag_s)
    beside = min((_left_later(end[1], end[-1].residual, lag_s) for end in ends), default=left)
    return left < beside + max(thresholds.other_hold_z**2, thresholds.model_error * (beside - noise))


def _left_later(projector: Projector, residual: np.ndarray, lag_s: float) -> float:
    """Sum of squares of what is left once a lag has settled from where it was before each run."""
    found, regression = 0.0, projector.regression
    for part, mask, run in zip(projector.split(residual), projector.masks, regression.baseline.runs, strict=True):
        time_s = run.record.time_s - run.record.time_s[0]
        later = part[time_s[mask] > _SETTLED * lag_s]
        found += float(later @ later)
    return found


def _is_damped(plain: PlainFit) -> bool:
    """Whether a mode of the stage does not ring."""
    return plain.regression.baseline.resonance_Hz is not None and not rings(plain)


def rings(plain: PlainFit) -> bool:
    """Whether the stage has a mode, and that rings."""
    modes = named_parts(plain.regression.baseline.stage, Mechanics)
    return bool(modes) and all(float(mode.damping_ratio) <= _RINGS for _, mode in modes)


def rings_by_command(plain: PlainFit) -> bool:
    """Whether the stage has modes that ring, and that the command itself moves by more than noise.

    Overtones of a slow sine, which only the hysteresis makes, are followed by any mode among them.
    """
    modes = named_parts(plain.regression.baseline.stage, Mechanics)
    return rings(plain) and all(_is_moved(mode, plain) for _, mode in modes)


def _is_moved(mode: Mechanics, plain: PlainFit) -> bool:
    """Whether what a mode makes of a command near its frequency, by the gain at rest, exceeds the noise of a run."""
    baseline, damping = plain.regression.baseline, float(mode.damping_ratio)
    most = baseline.stroke_um / np.ptp(baseline.range_V) / (2 * damping)
    for run, noise in zip(baseline.runs, plain.faults.noise, strict=True):
        voltage_V, window = run.record.voltage_V, np.hanning(len(run.record))
        spectrum = np.fft.rfft((voltage_V - voltage_V.mean()) * window) / np.sqrt(np.mean(window**2))
        off = np.abs(np.fft.rfftfreq(len(voltage_V), 1 / run.rate_Hz) / float(mode.natural_frequency_Hz) - 1)
        near = off < max(_NEAR * damping, 1.001 * off.min())
        rms_V = float(np.sqrt(2 * np.sum(np.abs(spectrum[near]) ** 2))) / len(voltage_V)
        if rms_V * most > noise.total_um:
            return True
    return False


def _beside_lags(plain: PlainFit) -> list[Refit]:
    """Fits of a lag and of a delay of the reading, those that the runs show."""
    model = nothing(plain.bench, plain.projector)
    scores = score(plain.projector, [one for one in plain.probed[0] if one.form.lag or one.form.delay], plain.left)
    best = _best(scores.each)
    return map_in_threads(partial(refit_beside, plain.bench, plain.projector, model), best) if best else []


def _left_beside_two(plain: PlainFit) -> float:
    """Sum of squares beside a lag of the reading, if there is one, and the best other effect."""
    models = [nothing(plain.bench, plain.projector), *_beside_lags(plain)]
    model = min(models, key=lambda one: one.cost)
    others = [one for one in plain.probed[0] if not (one.form.lag or one.form.delay)]
    best = _best(score(plain.projector, others, model.residual, model.basis()).each)[:_TRIED]
    beside = map_in_threads(partial(refit_beside, plain.bench, plain.projector, model), best) if best else []
    found = min((model, *beside), key=lambda one: one.cost)
    return min(found.cost, alternate(plain.bench, plain.projector, found)[-1].cost)


def _best(scores: tuple[Scored, ...]) -> list[Scored]:
    """The best of each form, the first first."""
    found: dict[type, Scored] = {}
    for one in sorted(scores, key=lambda one: -one.z):
        if one.z > 0:
            found.setdefault(one.form, one)
    return [*found.values()]
