"""Effects answer to the samples of a record, whatever is put behind its end to fill it up."""

from dataclasses import fields, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from _models import compiled
from test_diagnosis_tangent import baseline_of
from test_effects import INTERVAL_S, SAMPLES, columns, entrance, every, examples

import microid as m
from fits.diagnosis._effects import Bench, Law, remembering
from microid._part import Scene, Signal
from microid.effects.creep import Creep

# Samples behind the end, and those before it in which all is at rest, as some effects look ahead.
MORE, REST = 624, 12


def with_all_in_it(probe, rng):
    """The probe of an effect, whose fields that are zero, such as its history, are a part of their scale."""
    scale = {info.path: info.spec.scale for info in m.parameter_table(probe)}
    for name in (field.name for field in fields(probe) if field.name != "inner"):
        if not np.any(np.asarray(getattr(probe, name))):
            value = jnp.full_like(getattr(probe, name), rng.uniform(0.3, 0.9) * scale.get(name, 1.0))
            probe = eqx.tree_at(lambda one, name=name: getattr(one, name), probe, value)
    return probe


def at_rest(values):
    """A signal that stays where it is over its last samples."""
    values = np.array(values)
    values[-REST:] = values[-REST]
    return values


@compiled
def answer(effect, time_s, given, scene):
    return effect.run(time_s, given, scene).values


@pytest.mark.parametrize("even", [True, False], ids=["even", "uneven"])
@every
def test_what_is_behind_the_end_of_a_record_changes_nothing_in_it(effect, even, rng):
    probe = with_all_in_it(examples(effect)[0], rng)
    given, _, scene = entrance(probe)
    time_s = INTERVAL_S * np.arange(SAMPLES + MORE)
    if not even:
        time_s[1:SAMPLES] += rng.uniform(-0.2, 0.2, SAMPLES - 1) * INTERVAL_S

    def response(more):
        def filled(values):
            return jnp.asarray(np.pad(at_rest(values), (0, more), mode="edge"))

        command = Signal(filled(scene.command.values), scene.command.before, "first")
        beside = Scene(command, {name: filled(values) for name, values in columns().items()})
        time = jnp.asarray(INTERVAL_S if even else time_s[: SAMPLES + more])
        found = answer(probe, time, Signal(filled(given.values), given.before, given.hold), beside)
        return np.asarray(found)[:SAMPLES]

    alone, padded = response(0), response(MORE)
    np.testing.assert_allclose(padded[:-1], alone[:-1], rtol=0, atol=1e-9)
    # A mass that still rings is bent at the last sample by what comes next.
    np.testing.assert_allclose(padded[-1], alone[-1], rtol=0, atol=1e-5)
    if effect.place != "noise":
        assert np.max(np.abs(alone - given.values)) > 1e-5


def test_creep_from_before_the_runs_of_a_diagnosis_is_as_old_as_suits_each(rng):
    """Runs of 900 samples, which are filled up to 4,096, against the logarithms that are promised."""
    bench = Bench(baseline_of(rng, 3))
    law = Law([Creep(jnp.asarray(0.01), jnp.asarray(0.1))] * 2)
    recalled = remembering(bench, law, law.start)
    recent_um, older_um = rng.uniform(0.1, 1, 2)
    for run, effect in enumerate(recalled.effects(recalled.start)):
        time_s = bench.prepared[run].run.record.time_s
        share = (time_s - time_s[0]) / (time_s[-1] - time_s[0])
        before = replace(effect, recent_um=jnp.asarray(recent_um), older_um=jnp.asarray(older_um))
        found_um = bench.respond_in(run, [before]) - bench.respond_in(run, [effect])
        at_um = recent_um * np.log10(1 + share / 0.03) + older_um * np.log10(1 + share / 0.5)
        # The mechanics behind it is at rest but for the first milliseconds of a run.
        np.testing.assert_allclose(found_um[20:], at_um[20:], atol=0.02 * at_um[-1])
