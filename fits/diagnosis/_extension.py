"""The stage with its causes: fitted anew, and what it is worth on data that were not used."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import least_squares

from fits.diagnosis._baseline import Baseline, simulate, with_effects
from fits.diagnosis._effects import Bench
from fits.diagnosis._explanation import Selection
from fits.diagnosis._prepare import Prepared
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import Refit
from fits.diagnosis._regression import Regression, regress
from fits.diagnosis._result import Gain
from fits.diagnosis._thresholds import THRESHOLDS
from fits.loop._run import Run
from fits.stage._motion import at_samples, signals
from fits.stage._run import nuisance_columns, project_out
from fits.stats._compare import is_worse, sd_of_difference
from microid import Stage
from microid.effects import AbstractEffect

_ROUNDS = 6
# Of the fit of what a run held out whole had gone through before, at most.
_TRIED = 20
# Parts of a period from which its beginning in such a run is fitted.
_PARTS = 12


@dataclass(frozen=True)
class Compared:
    """Residuals of the plain and the extended stage in one run, shape `(n,)`, and which samples were held out.

    The extended stage is known there to a variance of `open_um2`, shape `(n,)`.
    """

    run: Run
    before_um: np.ndarray
    after_um: np.ndarray
    held_out: np.ndarray
    open_um2: np.ndarray | float = 0.0


@dataclass(frozen=True)
class Extension:
    """A stage with effects, a baseline with them, and residuals in all runs, those held out whole last.

    Effects that each run has of its `own` may be left out.
    """

    stage: Stage
    baseline: Baseline
    compared: tuple[Compared, ...]
    effects: tuple[AbstractEffect, ...]
    own: bool = True


def plain_stage(ready: Prepared) -> Stage:
    """The plain stage, with as many steps between samples as it needs."""
    return ready.baseline.stage.with_substeps(max(run.samples.stride for run in ready.baseline.fine))


def extend_stage(ready: Prepared, found: Selection, model: Refit | None, own: bool = True) -> Extension:
    """Let the plain stage follow what the effects of a model leave, and compare the two; none for the plain stage.

    Those that each run has of its `own` may be left out of the stage.
    """
    baseline = ready.baseline
    if model is None or not model.laws:
        compared = _compare(ready, ready.bench, None, ready.regression, (), False)
        return Extension(plain_stage(ready), baseline, compared, ())
    # What followed along the tangent is put into the stage itself.
    beside = found.projector
    regression = regress(beside.move(beside.residual - beside.join(model.change_um)), ())
    effects = shared_effects(model, len(baseline.runs), ready.reading.thresholds.minor_share, own)
    steps = max(run.samples.stride for run in (baseline.finest if found.finest else baseline.fine))
    stage = with_effects(regression.baseline.stage, effects).with_substeps(steps)
    compared = _compare(ready, Bench(regression.baseline, model.change_um), model, regression, effects, found.finest)
    compared = tuple(_as_open(one, k, beside, effects) for k, one in enumerate(compared))
    return Extension(stage, regression.baseline, compared, tuple(effects), own)


def _as_open(one: Compared, k: int, projector: Projector, effects: Sequence[AbstractEffect]) -> Compared:
    """The same with what the fitted runs leave open of the prediction of what was held out, if anything was."""
    regression = projector.regression
    if not one.held_out.any():
        return one
    if k < len(regression.rows):
        rows, nuisance, using = regression.rows[k], regression.nuisance[k], one.run.fitted
    else:
        alone = regress(regression.baseline.alone(one.run), ((),), (tuple(effects),))
        rows, nuisance, using = alone.rows[0], alone.nuisance[0], one.held_out
    rows = rows - nuisance @ np.linalg.lstsq(nuisance[using], rows[using], rcond=None)[0]
    return replace(one, open_um2=projector.variance_um2(rows))


def is_own(effect: AbstractEffect) -> bool:
    """Whether other runs may have none of an effect, or another, as a hum or what happened at one instant."""
    return effect.per_run or hasattr(effect, "after_s")


def without_effects(ready: Prepared, extension: Extension) -> Extension:
    """The plain stage, which runs held out whole follow; the others stay compared with effects of their own."""
    runs = len(ready.baseline.runs)
    behind = (replace(one, after_um=one.before_um) for one in extension.compared[runs:])
    return Extension(plain_stage(ready), ready.baseline, (*extension.compared[:runs], *behind), ())


def shared_effects(
    model: Refit, runs: int, spread: float = THRESHOLDS.minor_share, own: bool = True
) -> list[AbstractEffect]:
    """The effects as a model holds them: strengths that every run has by their mean, and others not at all.

    Every run has one whose relative `spread` is no larger. Effects that each has of its `own` may be left out.
    """
    found = []
    for law, x in zip(model.laws, model.x, strict=True):
        # What went on before one run says nothing of the next.
        nothing = {name: jnp.zeros(()) for name in law.form.history}
        each = [replace(law.effect(x, run), **nothing) for run in range(runs)]
        if hasattr(each[0], "after_s") or (law.form.independent and runs == 1):
            # What happened at one instant does not happen again, and a hum has another phase in the next run.
            found.append(replace(each[0], **{name: 0 * getattr(each[0], name) for name in law.form.strength}))
        elif law.form.per_run and law.each.any():
            found.append(replace(each[0], **{name: _common(each, name, spread) for name in law.form.strength}))
        else:
            found.append(each[0])
    return [one for one in found if own or not is_own(one)]


def _common(each: Sequence[AbstractEffect], name: str, spread: float) -> Float[Array, "..."]:
    values = jnp.stack([getattr(effect, name) for effect in each])
    mean = jnp.mean(values, axis=0)
    # What one run had says nothing of the next.
    return jnp.where(jnp.std(values, axis=0) < spread * jnp.abs(mean), mean, 0.0)


def _compare(
    ready: Prepared,
    bench: Bench,
    model: Refit | None,
    regression: Regression,
    effects: Sequence[AbstractEffect],
    finest: bool,
) -> tuple[Compared, ...]:
    """Residuals of the plain stage and of the extended one in all runs, those held out whole last."""
    change = [np.zeros_like(plain) for plain in bench.plain] if model is None else model.change_um
    found = []
    for k, run in enumerate(ready.baseline.runs):
        plain = run.displacement_um - ready.regression.residuals[k]
        better = run.displacement_um - regression.residuals[k] + change[k]
        nuisance, using = ready.regression.nuisance[k], run.fitted
        found.append(
            Compared(run, left_of(run, nuisance, plain, using), left_of(run, nuisance, better, using), run.held_out)
        )
    if ready.baseline.aside:
        asides = _aside(ready.baseline, bench.baseline, effects, finest)
        usual = bench.baseline.stage.hold
        if effects and any(run.hold != usual for run in ready.baseline.aside):
            # What the plain stage lacks may have looked like a command that goes otherwise between samples.
            others = _aside(ready.baseline.held_aside(usual), bench.baseline.held_aside(usual), effects, finest)
            asides = [
                min(pair, key=lambda one: _square(one.after_um[one.held_out]))
                for pair in zip(asides, others, strict=True)
            ]
        found += asides
    return tuple(found)


def _aside(plain: Baseline, baseline: Baseline, effects: Sequence[AbstractEffect], finest: bool) -> list[Compared]:
    """Residuals of the plain stage, and of another baseline with effects, in the runs held out whole."""
    behind, found = Bench(baseline, aside=True, finest=finest), []
    for k, run in enumerate(plain.fine_aside):
        nuisance, using = np.asarray(nuisance_columns(plain.stage, run.samples))[: len(run.record)], run.known
        before_um = left_of(run, nuisance, simulate(plain.stage, run), using)
        after_um = _with_past(behind, k, effects, run, simulate(baseline.stage, run), nuisance)
        found.append(Compared(run, before_um, after_um, using))
    return found


def _square(values: np.ndarray) -> float:
    return float(values @ values)


def _with_past(
    behind: Bench,
    k: int,
    effects: Sequence[AbstractEffect],
    run: Run,
    plain_um: np.ndarray,
    nuisance: np.ndarray,
) -> np.ndarray:
    """What the extended stage leaves of a run held out whole, shape `(n,)`, what effects remember fitted to it.

    What a rig went through before a run is no more known of this than of those that were fitted, nor how far from
    where a period of the position began: a sensor has an offset in each run, and so has an unknown past.
    """
    # As of the fitted runs, where the past is stated nothing of it is fitted.
    own = [(at, name) for at, effect in enumerate(effects) for name in effect.history if run.moving]
    begins = [(at, effect.origin[0]) for at, effect in enumerate(effects) if effect.origin]

    def left(values: np.ndarray) -> np.ndarray:
        acting = list(effects)
        for (at, name), value in zip([*own, *begins], values, strict=True):
            acting[at] = replace(acting[at], **{name: jnp.asarray(value)})
        change_um = behind.respond_in(k, acting) - behind.plain[k]
        return left_of(run, nuisance, plain_um + change_um, run.known)

    def missed(values: np.ndarray) -> float:
        return _square(left(values)[run.known])

    best = np.array([0.0] * len(own) + [float(getattr(effects[at], name)) for at, name in begins])
    for place, (at, _) in enumerate(begins, len(own)):
        turn = np.zeros(len(best))
        turn[place] = float(getattr(effects[at], effects[at].origin[1]))
        best = min((best + part * turn for part in np.arange(_PARTS) / _PARTS), key=missed)
    if not len(best):
        return left(best)
    scale_um = float(np.std(run.displacement_um))
    return left(least_squares(lambda values: left(values)[run.known] / scale_um, best, max_nfev=_TRIED).x)


def left_of(run: Run, nuisance: np.ndarray, response_um: np.ndarray, using: np.ndarray) -> np.ndarray:
    """Measurement less response, less the run's nuisance parameters fitted to the samples in use, shape `(n,)`."""
    off = run.displacement_um - response_um
    weight = jnp.asarray(using.astype(float))
    return np.asarray(_without(jnp.asarray(nuisance), weight, jnp.asarray(off)))


_without = eqx.filter_jit(project_out)


def predicts_worse(compared: Sequence[Compared], worse_z: float, most: float) -> bool:
    """Whether the extended stage predicts worse what was held out, if any; see `fits.stats._compare.is_worse`.

    By as much as is open of it, it may, unless there is doubt.
    """
    before, after = _held_out(compared)
    open_um2 = sum(float(np.sum(np.where(one.held_out, one.open_um2, 0.0))) for one in compared)
    # What is open of more than it was off by before tells nothing.
    allowed = open_um2 if worse_z > 0 and open_um2 < float(np.sum(before**2)) else 0.0
    return len(before) > 0 and is_worse(before, after, worse_z, most, allowed)


def _held_out(compared: Sequence[Compared]) -> tuple[np.ndarray, np.ndarray]:
    """Errors before and after in what was held out of all runs, shape `(n,)` each."""
    held = [(one.before_um[one.held_out], one.after_um[one.held_out]) for one in compared]
    before, after = zip((np.zeros(0), np.zeros(0)), *held, strict=True)
    return np.concatenate(before), np.concatenate(after)


def gain_of(compared: Sequence[Compared], noise_um: float, source: str) -> Gain:
    """Errors on held-out data before and after, and how sure their difference is."""
    before, after = errors = _held_out(compared)
    if not len(before):
        return Gain(noise_um=noise_um, source="nothing was held out")
    rms = [float(np.sqrt(np.mean(one**2))) for one in errors]
    most = [float(np.max(np.abs(one))) for one in errors]
    return Gain(rms[0], rms[1], sd_of_difference(before, after), most[0], most[1], noise_um, source=source)


def feedforward(bench: Bench, effects: Sequence[AbstractEffect]) -> tuple[float, float]:
    """Errors that the voltage of the plain stage's inverse leaves on the extended one, and its own inverse's.

    The reference is what the plain stage does under the slowest run's command, whose inverse is that command.
    """
    slowest = int(np.argmax([one.run.record.duration_s for one in bench.prepared]))
    one = bench.prepared[slowest]
    stage = with_effects(bench.stage, effects)
    wanted = bench.plain[slowest]
    samples = one.run.samples
    n, stride = len(one.run.record), samples.stride
    command = np.asarray(samples.voltage_V)
    slope = float(np.ptp(wanted) / max(np.ptp(command), 1e-300))
    low, high = bench.baseline.range_V
    errors = []
    for _ in range(_ROUNDS):
        signal = eqx.tree_at(lambda s: s.values, one.scene.command, jnp.asarray(command))
        moved = replace(one, scene=replace(one.scene, command=signal, past_um=None))
        off = wanted - at_samples(signals(stage, moved)[-1], moved)
        off = off - np.mean(off)
        errors.append(float(np.sqrt(np.mean(off**2))))
        fine = np.interp(np.arange(len(command)) / stride, np.arange(n), off)
        command = np.clip(command + fine / slope, low, high)
    return errors[0], min(errors)
