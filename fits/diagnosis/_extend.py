"""The stage with its causes: fitted anew, and what it is worth on data that were not used."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.diagnosis._baseline import Baseline
from fits.diagnosis._candidates import Bench
from fits.diagnosis._evaluate import with_effects
from fits.diagnosis._refit import Refit
from fits.diagnosis._result import Gain
from fits.loop._run import Run
from fits.stage._motion import Prepared, signals
from fits.stage._run import project_out
from microid import AbstractEffect, Stage

_BLOCKS = 24
_ROUNDS = 6
# Relative spread of strengths that are the same in all runs.
_ALIKE = 0.3


def shared_effects(model: Refit, runs: int) -> list[AbstractEffect]:
    """The effects as a model holds them: strengths that every run has by their mean, and others not at all."""
    found = []
    for law, x in zip(model.laws, model.x, strict=True):
        # What went on before one run says nothing of the next.
        nothing = {name: jnp.zeros(()) for name in law.form.history}
        each = [replace(law.effect(x, run), **nothing) for run in range(runs)]
        if hasattr(each[0], "after_s"):
            # What happened at one instant does not happen again.
            found.append(replace(each[0], **{name: 0 * getattr(each[0], name) for name in law.form.strength}))
        elif law.form.per_run and law.each.any():
            found.append(replace(each[0], **{name: _common(each, name) for name in law.form.strength}))
        else:
            found.append(each[0])
    return found


def _common(each: Sequence[AbstractEffect], name: str) -> Float[Array, "..."]:
    values = jnp.stack([getattr(effect, name) for effect in each])
    mean = jnp.mean(values, axis=0)
    # What one run had says nothing of the next.
    return jnp.where(jnp.std(values, axis=0) < _ALIKE * jnp.abs(mean), mean, 0.0)


def extended_stage(baseline: Baseline, effects: Sequence[AbstractEffect], substeps: int) -> Stage:
    """The stage with effects, as a model: with the steps that its fit needed."""
    return with_effects(baseline.stage, effects).with_substeps(substeps)


def left_of(run: Run, own: np.ndarray, response_um: np.ndarray, using: np.ndarray) -> np.ndarray:
    """Measurement less response, the run's nuisance parameters fitted to some of the samples and taken off."""
    off = run.displacement_um - response_um
    weight = jnp.asarray(using.astype(float))
    return np.asarray(_without(jnp.asarray(own), weight, jnp.asarray(off)))


_without = eqx.filter_jit(project_out)


@dataclass(frozen=True)
class Compared:
    """Residuals of the plain and the extended stage in one run, shape `(n,)`, and which samples were held out."""

    run: Run
    before_um: np.ndarray
    after_um: np.ndarray
    held_out: np.ndarray


def gain_of(compared: Sequence[Compared], noise_um: float, source: str) -> Gain:
    """Errors on held-out data before and after, and how sure their difference is."""
    before = [one.before_um[one.held_out] for one in compared if one.held_out.any()]
    after = [one.after_um[one.held_out] for one in compared if one.held_out.any()]
    if not before:
        return Gain(noise_um=noise_um, source="nothing was held out")
    r0, r1 = np.concatenate(before), np.concatenate(after)
    rms0, rms1 = float(np.sqrt(np.mean(r0**2))), float(np.sqrt(np.mean(r1**2)))
    # The difference of the two, linearised, over blocks longer than errors stay alike.
    influence = r0**2 / (2 * max(rms0, 1e-300)) - r1**2 / (2 * max(rms1, 1e-300))
    blocks = np.array([block.mean() for block in np.array_split(influence, _BLOCKS)])
    sd = float(np.std(blocks, ddof=1) / len(blocks) ** 0.5)
    return Gain(rms0, rms1, sd, float(np.max(np.abs(r0))), float(np.max(np.abs(r1))), noise_um, source=source)


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
        moved = replace(one, scene=eqx.tree_at(lambda s: s.command, one.scene, signal))
        off = wanted - _all(stage, moved)
        off = off - np.mean(off)
        errors.append(float(np.sqrt(np.mean(off**2))))
        fine = np.interp(np.arange(len(command)) / stride, np.arange(n), off)
        command = np.clip(command + fine / slope, low, high)
    return errors[0], min(errors)


def _all(stage: Stage, prepared: Prepared) -> np.ndarray:
    values = signals(stage, prepared)[-1].values
    return np.asarray(values)[:: prepared.run.samples.stride][: len(prepared.run.record)]
