"""Physical effects: nothing where they are zero, and otherwise finite, differentiable and in their places."""

import functools
from dataclasses import replace
from typing import get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _models import compiled
from scipy import signal

import microid as m
from fits.diagnosis._effects import without_drifts
from microid import effects as fx
from microid._part import Scene, Signal
from microid.effects._base import host

INTERVAL_S, SAMPLES = 5e-4, 400
BY_NAME = {(effect.name, effect.form): effect for effect in fx.EFFECTS}
IDS = ["-".join(filter(None, key)) for key in BY_NAME]
every = pytest.mark.parametrize("effect", BY_NAME.values(), ids=IDS)
TRACES: list[str] = []


@functools.cache
def scales():
    return fx.Scales(
        0.0,
        100.0,
        4e4,
        20.0,
        10.0,
        INTERVAL_S,
        INTERVAL_S * SAMPLES,
        INTERVAL_S * SAMPLES,
        0.03,
        100.0,
        (("temperature_degC", 21.0, 2.0), ("other_um", 10.0, 20.0), ("path_V", 900.0, 800.0)),
        0.4,
    )


def plain_stage():
    """All kinds of parts; the law's loop is 2 um wide."""
    law = m.hysteresis.Dahl(0.2, 1.0, 8.0, 1.0)
    return m.Stage.of(driver=m.Driver(8e-4), hysteresis=law, mechanics=m.Mechanics(100.0, 0.05), sensor=m.Sensor())


def command_V():
    """Steps of two heights, then a chirp about half of the range."""
    time = INTERVAL_S * np.arange(SAMPLES)
    wave = 50 + 25 * signal.chirp(time, 20, time[-1], 300)
    return np.where(time < 0.01, 0.0, np.where(time < 0.03, 100.0, np.where(time < 0.05, 30.0, wave)))


def columns():
    time = INTERVAL_S * np.arange(SAMPLES)
    path = np.cumsum(np.abs(np.diff(command_V(), prepend=0.0)))
    return {
        "temperature_degC": jnp.asarray(20 + 10 * time),
        "other_um": jnp.asarray(10 * np.sin(30 * time)),
        "path_V": jnp.asarray(500 + path),
    }


def examples(effect):
    """All probes of an effect; noise has none."""
    stage = plain_stage()
    place = host(effect, stage)
    groups = effect.probes(scales(), None if place is None else stage.parts[place])
    found = [probe for group in groups for probe in group]
    if effect.place == "noise":
        assert not found
        names = [
            info.path
            for info in m.parameter_table(
                effect(*[0.5] * (1 + (effect.name == "outliers") + 2 * (effect.name == "floor_vibration")))
            )
        ]
        found = [effect(**dict.fromkeys(names, 0.5))]
    return found


def nothing(probe):
    """The same effect without any."""
    beyond = 1e6 * (1 if probe.form == "" else -1)
    far = {"slew_limit": 1e9, "driver_saturation": beyond, "end_stop": beyond}
    names = probe.strength or tuple(n for n in ("limit_V_per_s", "rail_V", "stop_um") if hasattr(probe, n))
    empty = [jnp.full_like(getattr(probe, name), 0.0 if probe.strength else far[probe.name]) for name in names]
    return eqx.tree_at(lambda e: [getattr(e, name) for name in names], probe, empty)


@compiled
def play(effect, change, given, scene):
    """What an effect gives, and how that changes with its parameters."""
    TRACES.append(type(effect).__name__)

    def response(one):
        return one.run(jnp.asarray(INTERVAL_S), given, scene).values

    return eqx.filter_jvp(response, (effect,), (change,))


@functools.cache
def signals():
    """The signals between the parts of the plain stage, and the scene."""
    command = Signal(jnp.asarray(command_V()), jnp.asarray(0.0), "first")
    scene, found = Scene(command, columns()), [command]
    for part in plain_stage().parts[:3]:
        found.append(passed(part, found[-1], scene))
    return dict(zip(("command", "driver", "hysteresis", "mechanics"), found, strict=True)), scene


@compiled
def passed(part, given, scene):
    return part.run(jnp.asarray(INTERVAL_S), given, scene)


def entrance(effect):
    """Where the signal comes from that an effect takes, and what is there without it."""
    between, scene = signals()
    if not hasattr(effect, "inner"):
        at = {"driver": "command", "hysteresis": "hysteresis", "mechanics": "hysteresis"}.get(
            effect.place, "mechanics"
        )
        return between[at], between[at].values, scene
    at = {"driver": "command", "hysteresis": "driver", "mechanics": "hysteresis"}[effect.place]
    return between[at], between[effect.place].values, scene


def still(effect):
    """A change of no parameter."""
    return jax.tree_util.tree_map(jnp.zeros_like, eqx.filter(effect, eqx.is_inexact_array))


def own_parameters(effect):
    return [info for info in m.parameter_table(effect) if not info.path.startswith("inner")]


@every
def test_nothing_at_zero_strength_something_at_probes_and_derivatives_of_finite_differences(effect, rng):
    probes = examples(effect)
    assert probes
    given, plain, scene = entrance(probes[0])
    before = len(TRACES)

    def played(one):
        return np.asarray(play(one, still(one), given, scene)[0])

    np.testing.assert_allclose(played(nothing(probes[0])), plain, rtol=0, atol=1e-11)
    for probe in probes:
        found = played(probe)
        assert np.all(np.isfinite(found))
        for info in own_parameters(probe):
            value = np.asarray(getattr(probe, info.path))
            assert np.all((value >= info.spec.lower) & (value <= info.spec.upper))
        assert effect.place == "noise" or np.max(np.abs(found - plain)) > 1e-5
    if effect.place == "noise":
        return
    # Away from a whole number of intervals, where cubics meet.
    names = [info.path for info in own_parameters(probes[0])]
    values = [getattr(probes[0], name) for name in names]
    turned = [value * rng.uniform(0.9, 0.95) for value in values]
    ways = [jnp.asarray(rng.uniform(0.5, 1, value.shape)) * jnp.maximum(jnp.abs(value), 1e-4) for value in values]
    if effect.name == "mains_hum":
        turned[-1] = values[-1]

    def moved(share):
        new = [value + share * way for value, way in zip(turned, ways, strict=True)]
        return eqx.tree_at(lambda e: [getattr(e, name) for name in names], probes[0], new)

    change = eqx.tree_at(lambda e: [getattr(e, name) for name in names], still(probes[0]), ways)
    slope = np.asarray(play(moved(0.0), change, given, scene)[1])
    step = 1e-6
    truth = (played(moved(step)) - played(moved(-step))) / (2 * step)
    assert np.max(np.abs(slope)) > 1e-6
    np.testing.assert_allclose(slope, truth, rtol=1e-3, atol=1e-3 * np.max(np.abs(slope)) + 1e-7)
    assert len(TRACES) == before + 1


def test_effects_act_in_a_stage():
    chosen = [("slew_limit", ""), ("cross_coupling", ""), ("transport_delay", "")]
    stage = plain_stage()
    run = compiled(lambda s, v: s(jnp.asarray(INTERVAL_S), v, columns=columns()))
    found = [np.asarray(run(stage, jnp.asarray(command_V())))]
    for key in chosen:
        stage = fx.extend(stage, examples(BY_NAME[key])[0])
    found.append(np.asarray(run(stage, jnp.asarray(command_V()))))
    assert np.all(np.isfinite(found))
    assert np.max(np.abs(found[1] - found[0])) > 1e-3


@every
def test_what_is_known_of_it_is_whole(effect):
    names = {other.name for other in fx.EFFECTS}
    assert effect.place in fx.PLACES
    assert effect.name not in effect.confusions
    assert set(effect.confusions) <= names
    assert all(text and "\n" not in text for text in (effect.fingerprint, effect.experiment, effect.source))
    assert effect.fingerprint.endswith(".")
    fields = {info.path.rpartition(".")[2] for info in m.parameter_table(examples(effect)[0])}
    assert set(effect.strength) <= fields
    assert effect.view in get_args(fx.View)
    assert effect.statistic in get_args(fx.Statistic)
    # What changes the mean is probed, and what does not is measured.
    assert bool(effect.statistic) == (effect.place == "noise")
    assert effect.delay in ("", *effect.strength)
    # Forms of one effect are spoken of alike.
    first = fx.card_of(effect.name)
    for field in ("view", "column", "statistic", "independent", "universal", "held"):
        assert getattr(effect, field) == getattr(first, field), field


def test_a_card_is_found_by_the_name_of_its_effect():
    assert {fx.card_of(name) for name, _ in BY_NAME} <= set(fx.EFFECTS)
    with pytest.raises(LookupError, match="nothing"):
        fx.card_of("nothing")
    # Each statistic of the noise has one effect, and one of all is a pure delay.
    measured = [effect.statistic for effect in fx.EFFECTS if effect.statistic]
    assert sorted(measured) == sorted(set(get_args(fx.Statistic)) - {""})
    assert len([effect for effect in fx.EFFECTS if effect.delay]) == 1


def test_all_effects_together_stand_in_the_order_of_the_signal(rng):
    one_each = list({effect.name: effect for effect in reversed(fx.EFFECTS)}.values())
    stage, wrapped = plain_stage(), 0
    for index in rng.permutation(len(one_each)):
        effect = one_each[index]
        place = host(effect, stage)
        wrapped += place is not None
        chosen = examples(effect)[0]
        if place is not None:
            chosen = eqx.tree_at(lambda e: e.inner, chosen, stage.parts[place])
        stage = fx.extend(stage, chosen)
    assert len(stage.parts) == 4 + len(one_each) - wrapped
    order = list(stage.names)
    alone = [n for n in order if n not in ("driver", "hysteresis", "mechanics", "sensor")]
    ranks = [fx.PLACES.index(next(e.place for e in one_each if e.name == n)) for n in alone]
    assert ranks == sorted(ranks)
    assert order.index("slew_limit") < order.index("driver") < order.index("hysteresis") < order.index("creep")
    assert order.index("creep") < order.index("backlash") < order.index("mechanics") < order.index("sensor_lowpass")


def test_what_may_come_twice_has_names_of_its_own():
    stage = plain_stage()
    given = jnp.asarray(command_V())
    run = compiled(lambda s, v: s(jnp.asarray(INTERVAL_S), v, columns=columns()))
    before = np.asarray(run(stage, given))
    hums = [
        BY_NAME["mains_hum", form](np.full(3, 0.1), np.zeros(3), 1.0 * f)
        for form, f in (("50_Hz", 50), ("60_Hz", 60))
    ]
    changes = []
    for hum in hums:
        changes.append(np.asarray(run(fx.extend(plain_stage(), hum), given)) - before)
        stage = fx.extend(stage, hum)
    assert set(stage.names) - set(plain_stage().names) == {"mains_hum", "mains_hum_2"}
    np.testing.assert_allclose(np.asarray(run(stage, given)) - before, sum(changes), atol=1e-9)
    once = examples(BY_NAME["slew_limit", ""])[0]
    with pytest.raises(ValueError, match="slew_limit"):
        fx.extend(fx.extend(plain_stage(), once), once)


def test_losses_are_sought_within_the_shortest_record():
    """Beside slow loops of a minute, a fast record takes seconds: losses all over it are simulated."""
    short_s, long_s = 2.5, 60.0
    sizes = replace(scales(), shortest_s=short_s, duration_s=long_s)
    probes = BY_NAME["dropped_samples", ""].probes(sizes, None)
    instants = np.sort([float(one.after_s) for (one,) in probes])
    for length in (short_s, long_s):
        inside = np.r_[0, instants[instants < length], length]
        assert np.diff(inside).max() < length / 6


def test_second_modes_are_sought_wherever_samples_show_them():
    sizes = replace(scales(), resonance_Hz=100.0, interval_s=1 / 900)
    inner = plain_stage()["mechanics"]
    for form in ("", "added"):
        at_Hz = np.array(
            [float(one.frequency_Hz) for (one,) in BY_NAME["second_resonance", form].probes(sizes, inner)]
        )
        # Up to six times the first, but for what lies above half the sampling rate.
        for mode_Hz in np.linspace(120, 400, 20):
            assert np.min(np.abs(at_Hz - mode_Hz)) < 0.03 * mode_Hz
        assert at_Hz.max() < 450


@pytest.mark.parametrize("mains_Hz", [50, pytest.param(60, marks=pytest.mark.study)])
def test_lines_that_samples_turn_into_a_drift_are_left_out(mains_Hz, rng):
    """How often each line seems to go round is counted at the samples, for mains as slow and fast as they come."""
    hum = BY_NAME["mains_hum", f"{mains_Hz}_Hz"](jnp.ones(3), jnp.ones(3), jnp.asarray(float(mains_Hz)))
    for rate_Hz in (*rng.uniform(20, 2000, 30), 2 * mains_Hz, mains_Hz, 3 * mains_Hz, 1.5 * mains_Hz):
        time_s = np.arange(int(rate_Hz * rng.choice([0.5, 5.0, 50.0]))) / rate_Hz
        periods = np.empty((3, 41))
        for h in range(3):
            for k, share in enumerate(np.linspace(-0.002, 0.002, 41)):
                line = np.exp(2j * np.pi * (h + 1) * mains_Hz * (1 + share) * time_s)
                periods[h, k] = abs(np.angle(np.vdot(line[:-1], line[1:]))) * (len(line) - 1) / (2 * np.pi)
        left = without_drifts(hum, 1 / rate_Hz, time_s[-1])
        seen = np.asarray(left.cosine_um)
        np.testing.assert_array_equal(seen, np.asarray(left.sine_um))
        for h in range(3):
            least = periods[h].min()
            if abs(least - 3) > 0.5:
                assert seen[h] == (least > 3), (rate_Hz, h, least)
