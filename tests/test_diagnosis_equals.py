"""Which sets of causes are followed, and what explains as much as a cause in the end: by made-up explanations."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_diagnosis_comparison import asked, made

from fits.diagnosis import _explanation, _select
from fits.diagnosis._conclude import verdict_of
from fits.diagnosis._explanation import Cause, Explanation, best_of_ends, with_equals
from fits.diagnosis._refit import nothing, refit_beside
from fits.diagnosis._score import score
from fits.diagnosis._thresholds import THRESHOLDS
from microid.effects import EFFECTS

FORMS = {form.name: form for form in EFFECTS}


class Fitted:
    """A fit of some effects that leaves a sum of squares."""

    def __init__(self, names, cost):
        self.laws = tuple(SimpleNamespace(size=1, form=FORMS[name]) for name in names)
        self.cost, self.change_um = cost, ()

    def is_noise(self, projector, z):
        return False

    def determined(self, *_):
        return True

    def with_last(self, k):
        return self.laws[k].form.name


def explanation(names, criterion, cost=1000.0, left=(), held=None, rivals=()):
    causes = tuple(Cause(name, 50.0, 0.0, tuple(SimpleNamespace(name=one) for one in rivals), 1e4) for name in names)
    projector = SimpleNamespace(held_out=lambda _: held, count=1000, freedom=10.0)
    bench = SimpleNamespace(baseline=SimpleNamespace(dynamic=False, runs=[SimpleNamespace(held_out=np.ones(1))]))
    family = SimpleNamespace(p=lambda z: 0.0)
    return Explanation(causes, bench, projector, Fitted(names, cost), tuple(left), family, criterion, criterion, held)


@pytest.mark.parametrize(("behind", "named"), [(20.0, {"sensor_lowpass"}), (1e4, set())])
def test_what_explains_as_much_in_the_end_is_an_alternative(monkeypatch, behind, named):
    # A low-pass had been ahead of a delay only until what happened before the run was fitted beside both.
    monkeypatch.setattr(_explanation.Rival, "of", lambda projector, found: SimpleNamespace(name=found))
    best = explanation(("transport_delay", "initial_state"), 2000.0)
    other = explanation(("sensor_lowpass", "initial_state"), 2000.0 + behind)
    plain = SimpleNamespace(cost=20_000.0)
    found = with_equals(best, [best, other], THRESHOLDS, plain)
    assert [{rival.name for rival in cause.rivals} for cause in found.causes] == [named, set()]


def test_what_explains_less_in_the_end_is_none(monkeypatch):
    best = explanation(("transport_delay", "creep"), 2000.0, rivals=("sensor_lowpass",))
    other = explanation(("sensor_lowpass", "backlash"), 9000.0)
    found = with_equals(best, [best, other], THRESHOLDS, SimpleNamespace(cost=20_000.0))
    assert found.causes[0].rivals == ()


def test_a_fit_that_cannot_come_near_enough_is_left(rng, monkeypatch):
    case = made(rng, lambda bench, _: [um + 0.02 * np.tanh(3 * (um - um.mean()) / np.ptp(um)) for um in bench.plain])
    plain = nothing(case.bench, case.projector)
    best = max(score(case.projector, asked(case, "creep"), plain.residual).each, key=lambda one: one.z)
    costs, calls, respond = [], [], case.bench.simulate_in
    monkeypatch.setattr(case.bench, "simulate_in", lambda *each: calls.append(each) or respond(*each))
    for enough in (np.inf, plain.cost, 0.0):
        calls.append(None)
        costs.append((refit_beside(case.bench, case.projector, plain, best, enough).cost, len(calls)))
        calls.clear()
    (whole, many), (same, as_many), (_, few) = costs
    assert (same, as_many) == (whole, many)
    assert few < many


@pytest.mark.parametrize(("grown", "followed"), [(1.3, []), (0.9, ["creep", "backlash"])])
def test_a_further_cause_that_predicts_worse_is_not_followed(monkeypatch, grown, followed):
    # Nor is what explains less than that in its place.
    held = np.random.default_rng(0).standard_normal(2400)
    scored = [
        SimpleNamespace(name=name, form=FORMS[name], z=z, drop=z**2, probe=None)
        for name, z in (("backlash", 40.0), ("aging", 30.0))
    ]
    one = explanation(("creep",), 5000.0, cost=4000.0, left=scored, held=held)
    asked = []

    def compared(bench, projector, model, open_, *_):
        name = max(open_, key=lambda s: s.z).name
        asked.append(name)
        end = (bench, projector, Fitted(("creep", name), 2000.0))
        errors = held * (grown if name == "backlash" else 0.9)
        fits = {"refit": Fitted(("creep", name), 2000.0), "criterion": 3000.0, "cost": 2000.0}
        return [SimpleNamespace(name=name, form=FORMS[name], end=end, held_out=errors, **fits)]

    monkeypatch.setattr(_select, "compare_rivals", compared)
    monkeypatch.setattr(_select, "leaders", lambda open_, _: open_[:1])
    # In no other form of its effect does a cause explain more.
    monkeypatch.setattr(_select, "in_best_forms", lambda *state: state[:3])
    monkeypatch.setattr(_select, "indistinguishable", lambda *_: ())
    monkeypatch.setattr(Explanation, "of", classmethod(lambda cls, causes, state, search: [c.name for c in causes]))
    monkeypatch.setattr(_select, "_that_every_rig_has", lambda found, _: found)
    search = SimpleNamespace(
        plain=SimpleNamespace(cost=20_000.0),
        thresholds=THRESHOLDS,
        false_alarm=0.01,
        has_time=lambda: True,
        progress=print,
        probes=(),
    )
    found = _select._grown(one, search, ())
    assert (found[0] if found else []) == followed
    assert asked == ["backlash"]
    # The same two were reached in the other order.
    assert _select._grown(one, search, {frozenset(("backlash", "creep"))}) == []
    assert asked == ["backlash"]


@pytest.mark.parametrize(("cost", "goes_on"), [(19_500.0, False), (10_000.0, True)])
def test_no_more_is_asked_where_most_would_be_unexplained_with_as_many_more_causes(monkeypatch, cost, goes_on):
    scored = [SimpleNamespace(name="backlash", form=FORMS["backlash"], z=40.0, drop=1600.0, probe=None)]
    one, asked = explanation(("creep",), 5000.0, cost=cost, left=scored, held=np.zeros(3)), []
    monkeypatch.setattr(_select, "compare_rivals", lambda *_: asked.append(True) or [])
    monkeypatch.setattr(_select, "leaders", lambda open_, _: open_[:1])
    settings = {"thresholds": THRESHOLDS, "false_alarm": 0.01, "has_time": lambda: True, "progress": print}
    search = SimpleNamespace(plain=SimpleNamespace(cost=20_000.0), probes=(), **settings)
    assert _select._grown(one, search, ()) == []
    assert bool(asked) == goes_on


@pytest.mark.parametrize(
    ("cause", "left", "asked_for"),
    [
        ("bouc_wen_hysteresis", 1650.0, True),
        ("bouc_wen_hysteresis", 4000.0, False),  # more is left than that explains
        ("bouc_wen_hysteresis", 100.0, False),  # chance leaves as much
        ("creep", 1650.0, False),  # a drift is what an error of creep looks like
    ],
)
def test_what_leaves_nothing_but_noise_is_asked_for_below_the_errors_of_models(monkeypatch, cause, left, asked_for):
    scored = [SimpleNamespace(name="thermal_drift", form=FORMS["thermal_drift"], z=40.0, drop=1600.0, probe=None)]
    one, asked = explanation((cause,), 5000.0, cost=990.0 + left, left=scored, held=np.zeros(3)), []
    monkeypatch.setattr(_select, "compare_rivals", lambda *_: asked.append(True) or [])
    monkeypatch.setattr(_select, "leaders", lambda open_, _: open_[:1])
    monkeypatch.setattr(Explanation, "modelled", lambda *_: 1e6)
    settings = {"thresholds": THRESHOLDS, "false_alarm": 0.01, "has_time": lambda: True, "progress": print}
    assert _select._grown(one, SimpleNamespace(plain=SimpleNamespace(cost=1e6), probes=(), **settings), ()) == []
    assert bool(asked) == asked_for


@pytest.mark.parametrize(
    ("made_um", "left_um", "explained", "verdict"),
    [
        ((0.007,), 0.04, False, "unexplained"),
        ((0.05,), 0.04, False, "effect_found"),
        ((0.007,), 0.04, True, "effect_found"),
        ((), 0.04, False, "unexplained"),
        ((), 0.0, False, "no_effect"),
    ],
)
def test_bad_samples_are_no_answer_to_more_than_they_make(made_um, left_um, explained, verdict):
    # Five peaks of bursts that nobody recorded had passed for what was wrong.
    assert verdict_of([SimpleNamespace(rms_um=um) for um in made_um], left_um, explained) == verdict


@pytest.mark.parametrize(
    ("ahead", "grown", "best"), [(300.0, 1.6, "creep"), (300.0, 1.0, "rate"), (5e3, 1.6, "rate")]
)
def test_of_what_is_not_told_apart_the_one_that_predicts_better_is_taken(monkeypatch, ahead, grown, best):
    # A rate dependence and a hysteresis of its own had won over the creep that predicted the rest of the run.
    monkeypatch.setattr(Explanation, "near_bound", False)
    held = np.random.default_rng(1).standard_normal(2400)
    creep = explanation(("mains_hum", "creep"), 20_000.0, held=held)
    other = explanation(("mains_hum", "rate_dependence"), 20_000.0 - ahead, held=grown * held)
    found = best_of_ends([creep, other], SimpleNamespace(cost=50_000.0), THRESHOLDS)
    assert found is {"creep": creep, "rate": other}[best]


@pytest.mark.parametrize(("first", "best"), [("mains_hum", "creep"), ("backlash", "drift")])
def test_what_hum_explains_makes_no_others_equal(monkeypatch, first, best):
    # Beside a hum of 800 standard deviations a drift that predicts better had counted as equal to the creep.
    monkeypatch.setattr(Explanation, "near_bound", False)
    held = np.random.default_rng(1).standard_normal(2400)
    creep = explanation((first, "creep"), 20_000.0, 18_000.0, held=1.6 * held)
    drift = explanation((first, "thermal_drift"), 22_500.0, 20_500.0, held=held)
    creep, drift = (
        replace(one, causes=(replace(one.causes[0], drop=6.7e5), one.causes[1])) for one in (creep, drift)
    )
    found = best_of_ends([creep, drift], SimpleNamespace(cost=692_000.0), THRESHOLDS)
    assert found is {"creep": creep, "drift": drift}[best]
