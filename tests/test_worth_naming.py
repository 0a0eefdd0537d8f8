"""Which of the causes that were found are worth naming beside the others, by what each explains and predicts."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from test_diagnosis_decisions import misfit
from test_diagnosis_residuals import faults

from fits import Record
from fits.diagnosis import _misfit
from fits.diagnosis._comparison import model_error
from fits.diagnosis._explanation import Cause, Selection
from fits.diagnosis._occurrences import has_occurred
from fits.diagnosis._refit import Refit
from fits.diagnosis._thresholds import Thresholds
from microid.effects.dropped_samples import DroppedSamples


def named_beside(monkeypatch, parts, rest, harmful=(), unsure=(), helpful=(), uneven=()):
    """Names that are kept where each cause explains a part of its own, in noise variances, and so much is left.

    With each of those that are harmful, what was held out is predicted worse, and with those that are helpful better;
    the strengths of those that are unsure are nearer to none than their standard deviation, and those that are uneven
    are in some runs and not in others.
    """

    def cost(names):
        return rest + sum(part for name, part in parts.items() if name not in names)

    def model(names):
        errors = np.ones(100) * (1 + sum(name in harmful for name in names)) / (1 + sum(n in helpful for n in names))
        strength_z = [0.5 if name in unsure else 9.0 for name in names]
        even = [name not in uneven for name in names]
        each = {"strength_z": strength_z.__getitem__, "in_each_run": lambda which, *_: all(even[k] for k in which)}
        laws = [SimpleNamespace(size=1) for _ in names]
        return SimpleNamespace(cost=cost(names), change_um=errors, laws=laws, **each)

    def without(found, name):
        return model([cause.name for cause in found.causes if cause.name != name])

    def misfit_of(_, found, __):
        return misfit(cost(()) - found.model.cost, rest), None

    monkeypatch.setattr(_misfit, "_without", without)
    monkeypatch.setattr(_misfit, "_in_noise", lambda found, _: found)
    monkeypatch.setattr(_misfit, "_misfit", misfit_of)
    causes = tuple(Cause(name, 9.0, 0.0, (), part) for name, part in parts.items())
    projector = SimpleNamespace(held_out=lambda errors: errors)
    found = Selection(causes, model([*parts]), *(None,) * 5, projector, None)
    ready = SimpleNamespace(reading=SimpleNamespace(thresholds=Thresholds()))
    kept, _, last, _, said = _misfit.worth_naming(ready, found, (), False)
    names = [cause.name for cause in kept.causes]
    assert last.explained == pytest.approx(sum(parts[name] for name in names))
    left_out = [words.split(" would")[0].split(" is not")[0].replace(" ", "_") for words in said]
    assert sorted(left_out) == sorted({*parts} - {*names})
    # The smallest first.
    assert harmful or unsure or left_out == sorted(left_out, key=parts.__getitem__)
    return names


def test_what_the_rest_may_make_is_not_named(monkeypatch):
    chance = 40 + 3 * 80**0.5
    parts = {"transport_delay": 8000.0, "thermal_gain": 170.0, "creep": 90.0}
    every = {"helpful": [*parts]}
    assert named_beside(monkeypatch, parts, chance + 2500.0, **every) == ["transport_delay"]
    assert named_beside(monkeypatch, parts, chance, **every) == [*parts]
    # A third of what there is beside the others is more than a minor share.
    assert named_beside(monkeypatch, parts, chance + 300.0, **every) == ["transport_delay", "thermal_gain"]
    # One cause alone is decided on by its share of the whole misfit; a hum is no other effect's misfit.
    assert named_beside(monkeypatch, {"creep": 90.0}, chance + 2500.0) == ["creep"]
    hum = {"creep": 8000.0, "mains_hum": 90.0}
    assert named_beside(monkeypatch, hum, chance + 2500.0, helpful=["creep"]) == ["creep", "mains_hum"]


def test_what_is_small_beside_the_noise_is_named_only_where_it_predicts_or_is_beyond_doubt(monkeypatch):
    """A tenth of the noise was named at 4.9 standard deviations: forty plays, that are on no grid."""
    assert named_beside(monkeypatch, {"backlash": 24.0}, 40.0) == []
    assert named_beside(monkeypatch, {"backlash": 24.0}, 40.0, helpful=["backlash"]) == ["backlash"]
    assert named_beside(monkeypatch, {"backlash": 70.0}, 40.0) == ["backlash"]
    # What the others explain as well, but for chance, is none, whatever it predicts.
    parts = {"creep": 8000.0, "backlash": 12.0}
    assert named_beside(monkeypatch, parts, 40.0, helpful=[*parts]) == ["creep"]
    assert named_beside(monkeypatch, {**parts, "backlash": 24.0}, 40.0, helpful=[*parts]) == [*parts]


def test_beside_what_is_left_a_cause_is_named_only_where_it_predicts(monkeypatch):
    """A rail of 0.4 V was, at 44 standard deviations, beside the steps of a converter that are in no library."""
    parts, chance = {"creep": 8000.0, "driver_saturation": 4000.0}, 40 + 3 * 80**0.5
    assert named_beside(monkeypatch, parts, chance) == [*parts]
    assert named_beside(monkeypatch, parts, chance + 2500.0, helpful=["creep"]) == ["creep"]
    assert named_beside(monkeypatch, parts, chance + 2500.0, helpful=[*parts]) == [*parts]
    # What one run had of its own is seen in no other.
    load = {"creep": 8000.0, "load_change": 4000.0}
    assert named_beside(monkeypatch, load, chance + 2500.0, helpful=["creep"]) == [*load]
    # What may come as often as it likes follows a part of anything: it must be most of what the others leave.
    for jumps, named in ((4000.0, ["creep"]), (6000.0, ["creep", "zero_shift"])):
        parts = {"creep": 8000.0, "zero_shift": jumps}
        assert named_beside(monkeypatch, parts, chance + 2500.0, helpful=["creep"]) == named
    assert named_beside(monkeypatch, {"creep": 8000.0, "zero_shift": 4000.0}, chance) == ["creep", "zero_shift"]


def test_what_predicts_worse_is_not_named_beside_others(monkeypatch):
    parts = {"creep": 8000.0, "friction": 4000.0, "mains_hum": 90.0}
    chance = 40 + 3 * 80**0.5
    assert named_beside(monkeypatch, parts, chance, ["friction"]) == ["creep", "mains_hum"]
    assert named_beside(monkeypatch, parts, chance, ["friction", "mains_hum"]) == ["creep"]


def test_what_may_be_none_is_named_only_where_it_predicts(monkeypatch):
    parts = {"creep": 8000.0, "second_resonance": 4000.0}
    chance = 40 + 3 * 80**0.5
    assert named_beside(monkeypatch, parts, chance, unsure=["second_resonance"]) == ["creep"]
    beyond = {"unsure": ["second_resonance"], "helpful": ["second_resonance"]}
    assert named_beside(monkeypatch, parts, chance, **beyond) == [*parts]
    assert named_beside(monkeypatch, {"creep": 8000.0}, chance, unsure=["creep"]) == []
    assert named_beside(monkeypatch, {"creep": 8000.0}, chance, unsure=["creep"], helpful=["creep"]) == ["creep"]


def test_what_is_small_is_named_beside_others_only_where_it_predicts(monkeypatch):
    """A second resonance of a tenth of the noise was, at 21 standard deviations, beside a creep that was there."""
    parts, small = {"creep": 8000.0, "thermal_drift": 440.0}, ["thermal_drift"]
    chance = 40 + 3 * 80**0.5
    assert named_beside(monkeypatch, parts, chance) == ["creep"]
    assert named_beside(monkeypatch, parts, chance, helpful=small) == [*parts]
    # What is as large as a third of the noise need not.
    assert named_beside(monkeypatch, {**parts, "thermal_drift": 1000.0}, chance) == [*parts]
    # Nothing else is like a hum, and its phase in other runs is another.
    assert named_beside(monkeypatch, {"creep": 8000.0, "mains_hum": 440.0}, chance) == ["creep", "mains_hum"]


def test_a_hum_is_in_every_run(monkeypatch):
    """Harmonics of a sine that met a soft rail were called one, thirty times as large as in the other run."""
    parts, chance = {"creep": 8000.0, "mains_hum": 4000.0}, 40 + 3 * 80**0.5
    assert named_beside(monkeypatch, parts, chance, uneven=["mains_hum"]) == ["creep"]
    assert named_beside(monkeypatch, {"mains_hum": 4000.0}, chance, uneven=["mains_hum"]) == []
    # What a load does to one run is that run's.
    assert named_beside(monkeypatch, {"load_change": 4000.0}, chance, uneven=["load_change"]) == ["load_change"]


@pytest.mark.parametrize(
    ("samples", "after_s", "occurred"),
    [(1.0, 5.0, True), (0.3, 5.0, False), (1.0, 0.05, False), (1.4, 0.4, True)],
)
def test_a_loss_is_of_whole_samples_and_lies_inside_its_run(samples, after_s, occurred):
    interval_s, n = 0.01, 1001
    time_s = interval_s * np.arange(n)
    loss = DroppedSamples(jnp.asarray(samples * interval_s), jnp.asarray(after_s))
    record = Record(time_s, np.sin(time_s), np.sin(time_s))
    bench = SimpleNamespace(prepared=[SimpleNamespace(run=SimpleNamespace(record=record))])
    law = SimpleNamespace(form=DroppedSamples, effect=lambda x, run: loss)
    assert has_occurred(bench, SimpleNamespace(laws=[law], x=[None])) == occurred


def test_a_hysteresis_that_bends_to_anything_needs_the_evidence_of_what_it_is_mistaken_for():
    thresholds = Thresholds()
    assert model_error("bouc_wen_hysteresis", ["creep"], thresholds) == thresholds.confused_error
    assert model_error("backlash", ["creep"], thresholds) == thresholds.model_error


def test_hums_that_each_run_has_of_its_own_are_in_every_run():
    """Their frequencies differ, and each is fitted by itself."""
    sd = np.full(2, 0.1)

    def strengths(size, in_both):
        each = [[(np.array([3.0, 1.0]), sd), (np.zeros(2), sd)], [(np.zeros(2), sd), (size * np.ones(2), sd)]]
        return SimpleNamespace(_strengths=(each if in_both else each[:1]).__getitem__)

    assert Refit.in_each_run(strengths(2.0, True), [0, 1], 0.3, 4.0)
    assert not Refit.in_each_run(strengths(0.1, True), [0, 1], 0.3, 4.0)
    assert not Refit.in_each_run(strengths(2.0, False), [0], 0.3, 4.0)
    # What a run does not show may be as large as in the other.
    assert Refit.in_each_run(strengths(2.0, False), [0], 0.3, 8.0)


def test_bad_samples_that_show_beside_the_causes_are_taken_out_of_the_readings(monkeypatch):
    """A large effect hides the smaller ones before it is known."""
    index = np.arange(2000)
    first, later = index % 500 == 7, index % 400 == 11
    known = faults(spikes=(first,), heights_um=(2.0 * first,))
    seen = faults(spikes=(later,), heights_um=(0.3 * later,), quantum_um=0.0)
    monkeypatch.setattr(_misfit, "find_faults", lambda *_: seen)
    monkeypatch.setattr(_misfit, "_anew", lambda _, first, now: SimpleNamespace(first=first, projector=now))
    projector = SimpleNamespace(regression=None, roughness=(), with_readings_less=lambda heights_um: heights_um)
    ready = SimpleNamespace(faults=known, reading=SimpleNamespace(thresholds=Thresholds()))
    model = SimpleNamespace(change_um=())
    found = SimpleNamespace(causes=("creep",), first=projector, projector=projector, model=model)
    after, beside, unnamed = _misfit.faults_beside(ready, found)
    assert beside.count == first.sum() + later.sum()
    np.testing.assert_array_equal(beside.heights_um[0], 2.0 * first + 0.3 * later)
    # Those that were known are not in the readings any more.
    np.testing.assert_array_equal(after.projector[0], 0.3 * later)
    assert unnamed is known
    # Where nothing was found, they are as they were.
    found.causes = ()
    after, beside, unnamed = _misfit.faults_beside(ready, found)
    assert after is found
    assert beside.count == unnamed.count == first.sum()
