"""What decides in a diagnosis, by itself: on constructed residuals and answers, against closed forms and SciPy."""

from dataclasses import dataclass
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import fits
from fits import Record
from fits.diagnosis import _diagnose, _findings
from fits.diagnosis._effects import Law
from fits.diagnosis._explanation import Cause
from fits.diagnosis._extension import Compared, Extension, gain_of, predicts_worse, shared_effects, without_effects
from fits.diagnosis._misfit import Misfit
from fits.diagnosis._prepare import Prepared, _covered, of_half_a_sample
from fits.diagnosis._result import Gain
from fits.stage._solve_stage import default_stage
from fits.stats._compare import improvement_z
from fits.stats._held import _regressed, _stretches_at_rest
from microid.effects import EFFECTS


def misfit(explained, rest, freedom=40, count=10_000):
    return Misfit(explained, rest, freedom, count)


def test_chance_is_nothing_to_be_explained(rng):
    rests = stats.chi2.rvs(40, size=20_000, random_state=rng)
    found = [misfit(500.0, rest) for rest in rests]
    # Beyond three standard deviations of a chi-square variable, one in some hundreds.
    assert np.mean([one.total > 500.0 for one in found]) < 0.01
    assert not any(one.is_left_over for one in found)
    assert np.median([one.share for one in found]) == 1.0


def test_structure_of_a_size_counts_as_left_over(rng):
    # A signal of half the noise in 10,000 samples, seen along 40 columns.
    energy = 10_000 * 0.5**2
    rests = stats.ncx2.rvs(40, energy, size=500, random_state=rng)
    found = [misfit(0.0, rest) for rest in rests]
    assert np.mean([one.rest_noise for one in found]) == pytest.approx(0.5, rel=0.01)
    assert all(one.is_left_over for one in found)
    small = [misfit(0.0, rest) for rest in stats.ncx2.rvs(40, 10_000 * 0.1**2, size=500, random_state=rng)]
    # It is no chance, but too small to matter.
    assert np.mean([stats.chi2.sf(one.rest, 40) < 1e-6 for one in small]) > 0.9
    assert not any(one.is_left_over for one in small)


def test_causes_share_what_is_beyond_chance():
    half = misfit(1000.0, 1000.0 + 40 + 3 * 80**0.5)
    assert half.share == pytest.approx(0.5)
    rest, counts = misfit(0.0, 40.0 + 2500.0).unnamed(weak=True)
    assert (rest, counts) == (pytest.approx(0.5), True)
    # What a strong suspect explains nearly nothing of is of another kind, and what it explains most of is there.
    assert misfit(9.0, 39.0).unnamed(weak=False) == (pytest.approx(0.03), True)
    assert not misfit(1.0, 300.0).unnamed(weak=False)[1]
    assert not misfit(9.0, 39.0).unnamed(weak=True)[1]


def compared(before, after):
    return [Compared(None, before, after, np.ones(len(before), dtype=bool))]


def test_an_extension_is_worse_only_beyond_chance(rng):
    before = rng.standard_normal(5000)
    assert not predicts_worse(compared(before, 0.9 * before), 2.0, 0.06)
    # A little worse everywhere is no chance.
    assert predicts_worse(compared(before, 1.03 * before), 2.0, 0.06)
    # Of two that are as good, chance calls one worse by two standard deviations in 2.3 of 100.
    pairs = [compared(*rng.standard_normal((2, 5000))) for _ in range(400)]
    assert 0.002 < np.mean([predicts_worse(one, 2.0, 0.06) for one in pairs]) < 0.06
    assert not predicts_worse([Compared(None, before, 2 * before, np.zeros(5000, dtype=bool))], 2.0, 0.06)
    # One slow error is one, and much worse all the same.
    slow = before + np.where(np.arange(5000) < 150, 3.0, 0.0)
    assert improvement_z(before, slow) > -2
    assert predicts_worse(compared(before, slow), 2.0, 0.06)


def test_an_extension_may_be_worse_by_what_is_open_of_its_prediction(rng):
    """The density is less known beside a cause: five runs of it, each off by another draw of that."""
    everywhere = np.ones(5000, dtype=bool)
    for _ in range(5):
        before, open_um = rng.standard_normal(5000), 0.5 * np.repeat(rng.standard_normal(500), 10)
        known, unknown = ([Compared(None, before, before + open_um, everywhere, open_um2)] for open_um2 in (0.0, 0.3))
        assert predicts_worse(known, 2.0, 0.06)
        assert not predicts_worse(unknown, 2.0, 0.06)
        # Where there is doubt what was held out must be predicted better, and far more may be no excuse.
        assert predicts_worse(unknown, -1.0, 0.06)
        assert predicts_worse([Compared(None, before, 2 * before, everywhere, 0.9)], 2.0, 0.06)
        assert predicts_worse([Compared(None, before, before + open_um, everywhere, 4.0)], 2.0, 0.06)


def test_what_the_runs_held_out_do_not_share_is_left_out_of_the_stage(rng):
    before, after = rng.standard_normal((2, 200))
    own, aside = compared(before, after)[0], compared(before, 2 * before)[0]
    stage = default_stage()
    runs = (SimpleNamespace(samples=SimpleNamespace(stride=4)),)
    ready = SimpleNamespace(baseline=SimpleNamespace(runs=runs, fine=runs, stage=stage))
    found = without_effects(ready, Extension(stage, ready.baseline, (own, aside), ("load",)))
    assert found.effects == ()
    assert found.stage.substeps == 4
    assert found.compared[0] is own
    np.testing.assert_array_equal(found.compared[1].after_um, before)


def test_the_gain_and_its_uncertainty_are_those_of_many_records(rng):
    def drawn():
        before, after = 0.2 * rng.standard_normal((2, 4800)) + [[0.1], [0.0]]
        return gain_of(compared(before, after), 0.2, "whole runs")

    found = [drawn() for _ in range(200)]
    differences = [one.heldout_rms_before_um - one.heldout_rms_after_um for one in found]
    assert np.mean(differences) == pytest.approx(np.hypot(0.2, 0.1) - 0.2, abs=0.001)
    # 24 blocks know a standard deviation to 15 %.
    assert np.median([one.sd_of_difference_um for one in found]) == pytest.approx(np.std(differences), rel=0.2)
    nothing = gain_of([Compared(None, np.ones(3), np.ones(3), np.zeros(3, dtype=bool))], 0.2, "")
    assert np.isnan(nothing.heldout_rms_before_um)


def form(name):
    return next(effect for effect in EFFECTS if effect.name == name)


def test_an_extended_stage_has_what_all_runs_share():
    hum = form("mains_hum")
    alike, apart = (
        [hum(np.array([a, 0.1, 0.0]), np.zeros(3), jnp.asarray(50.0)) for a in pair]
        for pair in ((1.0, 1.1), (1.0, -1.0))
    )
    for pair, expected in ((alike, 1.05), (apart, 0.0)):
        law = Law(pair)
        model = SimpleNamespace(laws=(law,), x=(law.start,))
        (shared,) = shared_effects(model, 2)
        np.testing.assert_allclose(shared.cosine_um, [expected, 0.1, 0.0], atol=1e-9)
    # Of one run nobody knows whether the next has a hum of the same phase.
    alone = Law(alike[:1])
    (shared,) = shared_effects(SimpleNamespace(laws=(alone,), x=(alone.start,)), 1)
    assert not np.any(shared.cosine_um)
    # What happened once does not happen again, and what went on before a run is no part of the rig.
    lost, creep = form("dropped_samples"), form("creep")
    once = Law([lost(jnp.asarray(1e-3), jnp.asarray(0.5))])
    slow = Law([creep(jnp.asarray(0.01), jnp.asarray(0.1), jnp.asarray(0.3))], True)
    model = SimpleNamespace(laws=(once, slow), x=(once.start, slow.start))
    dropped, crept = shared_effects(model, 1)
    assert float(dropped.dropped_s) == 0
    assert (float(crept.gain_per_decade), float(crept.recent_um)) == (pytest.approx(0.01), 0.0)


def test_what_is_fitted_must_go_both_ways():
    there = np.linspace(0, 10, 500)
    loop, twice = (
        Record(np.arange(k * 1000.0), np.tile(np.r_[there, there[::-1]], k), np.zeros(k * 1000)) for k in (1, 2)
    )
    assert _covered([twice], 0.2)
    assert _covered([loop, twice], 0.2)
    # Half of the way back says nothing of the other half, which is not known to be as it was on the way there.
    assert not _covered([loop], 0.2)
    assert not _covered([loop], 0.5)
    assert _covered([loop], 0.0)
    assert not _covered([Record(np.arange(500.0), there, np.zeros(500))], 0.0)
    # The other way may be in another run.
    back = Record(np.arange(500.0), there[::-1], np.zeros(500))
    assert _covered([Record(np.arange(500.0), there, np.zeros(500)), back], 0.0)


def test_a_slope_is_that_of_scipy(rng):
    x = np.sort(rng.uniform(0, 3, 24 * 50))
    y = 2.0 - 0.7 * x + 0.05 * rng.standard_normal(len(x))
    slope, sd, straight = _regressed(x, y)
    plain = stats.linregress(x, y)
    assert slope == pytest.approx(plain.slope, abs=3 * plain.stderr)
    # Only every other block is taken to be of its own.
    assert sd == pytest.approx(2**0.5 * plain.stderr, rel=0.6)
    assert straight > 0.99
    assert _regressed(x, rng.standard_normal(len(x)))[2] < 0.6


def test_stretches_at_rest_are_whole():
    place = np.r_[np.linspace(0, 10, 300), np.full(517, 10.0), np.linspace(10, 3, 300), np.full(905, 3.0)]
    (first, stop), (begin, end) = _stretches_at_rest(place, 0.03)
    assert (first, stop) == (pytest.approx(300, abs=2), pytest.approx(817, abs=2))
    assert (begin, end) == (pytest.approx(1117, abs=2), len(place))


@dataclass(frozen=True)
class Answer:
    verdict: str
    causes: list
    gain: Gain
    of: dict
    remarks: tuple
    unexplained_rms_um: float = 0.0


@pytest.fixture
def asked(monkeypatch):
    """How records were read, in order; the answers are made by hand."""
    log = SimpleNamespace(readings=[], answers=[], places=[], onward=[], second=None, better=False)

    def prepare(reading, progress, has_time, onward):
        log.readings.append(reading)
        log.onward.append(onward)
        baseline = fits.diagnosis._baseline.Baseline(*(None,) * 14, True, ("said",))
        parts = {"bench": None, "regression": None, "probes": (), "faults": None, "skipped": ()}
        return Prepared(reading, baseline, projector=None, **parts)

    def select(*_):
        number = len(log.readings) - 1
        left_um = log.answers[number].get("left", 1.0 - 0.1 * number)
        place = {"plain_instead": lambda _: log.places.pop(0) if log.places else None}
        return SimpleNamespace(number=number, left_um=left_um, **place)

    def conclude(ready, found, *_):
        answer = log.answers[found.number]
        # Root mean squares of the errors in what was held out, in um, beside noise of 1 um.
        after_um = answer.get("error", 1.0)
        gain = Gain(answer.get("plain", after_um), after_um, noise_um=1.0)
        causes = [SimpleNamespace(z=z, name="creep", rms_um=0.0) for z in answer.get("z", ())]
        return Answer("effect_found" if causes else "no_effect", causes, gain, answer, ready.baseline.remarks)

    monkeypatch.setattr(_diagnose, "prepare_diagnosis", prepare)
    monkeypatch.setattr(_diagnose, "select", select)
    monkeypatch.setattr(_diagnose, "look_again", lambda *_: log.second)
    monkeypatch.setattr(_diagnose, "is_better", lambda *_: log.better)
    monkeypatch.setattr(_diagnose, "conclude", conclude)
    record = Record(np.arange(5.0), np.arange(5.0), np.zeros(5))

    def ask(*answers, places=(), second=None, better=False, **options):
        log.answers, log.readings, log.places, log.onward = list(answers), [], list(places), []
        log.second, log.better = second, better
        found = fits.diagnose([record], **options)
        assert len(log.readings) == len(answers)
        assert log.onward == [None, *places, *[None] * len(answers)][: len(answers)]
        return found, found.of, log.readings

    return ask


def test_a_plain_answer_is_taken(asked):
    answer = {"z": (9.0,)}
    found, kept, (reading,) = asked(answer)
    assert kept is answer
    assert (reading.fraction, reading.initial) == (0.2, "unknown")
    assert found.remarks == ("said",)


def test_a_plain_stage_that_was_found_beside_an_effect_of_none_is_gone_on_from(asked):
    _, kept, (first, again) = asked({}, {"z": (9.0,)}, places=["there"])
    assert kept == {"z": (9.0,)}
    assert first is again
    # A fit from there that leaves more has not found back.
    _, kept, _ = asked({"z": (5.0,)}, {"z": (9.0,), "left": 10.0}, places=["there"])
    assert kept["z"] == (5.0,)


@pytest.mark.parametrize("better", [True, False])
def test_parts_that_show_beside_a_cause_are_taken_where_those_explain_more(asked, better):
    baseline = fits.diagnosis._baseline.Baseline(*(None,) * 14, True, ("with a resonance",))
    second = Prepared(None, baseline, None, None, None, (), None, ())
    found, *_ = asked({"z": (9.0,)}, second=(second, second), better=better)
    assert found.remarks == (("with a resonance",) if better else ("said",))


@pytest.mark.parametrize("z", [20.0, 5.0])
def test_what_was_held_out_is_used_where_only_it_shows_a_cause(asked, z):
    first, whole = {"error": 3.0}, {"z": (z,)}
    found, kept, (_, reading) = asked(first, whole)
    assert reading.fraction == 0.0
    assert kept is (whole if z > 8 else first)
    assert any("not measured on new data" in words for words in found.remarks) == (z > 8)
    # Also where a cause was found that explains hardly any of it.
    assert asked({"error": 3.0, "plain": 3.5, "z": (9.0,)}, whole)[2][1].fraction == 0.0
    # It is not where noise explains it, a cause does, or whole runs are held out.
    assert asked({"error": 1.2})[1] == {"error": 1.2}
    asked({"error": 3.0, "plain": 6.0, "z": (9.0,)})
    aside = Record(np.arange(6.0), np.arange(6.0), np.zeros(6))
    assert asked({"error": 3.0}, holdout=[aside])[2][0].fraction == 0.12


def test_of_runs_held_out_that_are_off_by_more_than_noise_it_is_said(asked):
    aside = Record(np.arange(6.0), np.arange(6.0), np.zeros(6))

    def said(**answer):
        return [
            words for words in asked(answer, holdout=[aside])[0].remarks if "held out are off by 2 times" in words
        ]

    assert said(error=2.0)
    assert not said(error=1.1)
    # A load that had changed in the run held out alone was not spoken of beside a law that explained the others.
    assert said(error=2.0, z=(9.0,))


def test_of_a_part_held_out_that_is_off_by_more_than_noise_it_is_said(asked):
    """A cause explained all but what a chirp reached at its end, and nothing told of that."""
    for error, plain, expected in ((5.0, 20.0, True), (1.1, 20.0, False)):
        remarks = asked({"error": error, "plain": plain, "z": (9.0,)})[0].remarks
        assert any(f"held out is off by {error:.2g} times" in words for words in remarks) == expected


def test_the_class_of_a_cause_lists_none_that_is_named_beside_it(monkeypatch):
    """A report had said sensor lowpass (or creep), and creep."""
    forms = {form.name: form for form in EFFECTS}
    rivals = {"sensor_lowpass": ("creep", "transport_delay"), "creep": ("sensor_lowpass",)}
    causes = [
        Cause(name, 9.0, 1e-9, tuple(SimpleNamespace(name=other) for other in others), 50.0)
        for name, others in rivals.items()
    ]
    laws = [SimpleNamespace(form=forms[name], size=1, effects=lambda x: x) for name in rivals]
    model = SimpleNamespace(covariance=lambda: np.eye(2), laws=laws, x=[np.ones(1), np.ones(1)])
    run = SimpleNamespace(run=SimpleNamespace(record=SimpleNamespace(time_s=np.arange(3.0))))
    bench = SimpleNamespace(respond=lambda _: [np.ones(3)], plain=[np.zeros(3)], prepared=[run])
    projector = SimpleNamespace(join=np.concatenate, off=lambda x: x, masks=[np.ones(3, bool)], count=3)
    monkeypatch.setattr(_findings, "profile_likelihood", lambda *_: [])
    monkeypatch.setattr(_findings, "_parameters", lambda *_: ())
    monkeypatch.setattr(_findings, "_given", lambda _: {})
    beside = SimpleNamespace(bench=bench, projector=projector)
    found = _findings.causes_of(
        causes, model, beside, (1.0, 1.0), (), SimpleNamespace(noise=[SimpleNamespace(total_um=1.0)])
    )
    assert {one.name: one.also_consistent for one in found} == {"sensor_lowpass": ("transport_delay",), "creep": ()}


@pytest.mark.parametrize(
    ("delay_s", "hold", "is_said"), [(5.1e-4, "first", True), (8e-4, "first", False), (5.1e-4, "zero", False)]
)
def test_a_delay_of_half_a_sample_may_be_a_command_that_is_held(delay_s, hold, is_said):
    late = SimpleNamespace(name="delay_s", value=delay_s, sd=1e-5)
    cause = SimpleNamespace(name="transport_delay", parameters=(late,))
    run = SimpleNamespace(rate_Hz=1000.0, hold=hold)
    assert bool(of_half_a_sample([cause], [run])) == is_said
    # What has no delay has none of half a sample.
    other = SimpleNamespace(name="creep", parameters=(late,))
    assert of_half_a_sample([other], [run]) == []
