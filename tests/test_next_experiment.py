"""Programs within the limits of a rig, what they are predicted to show, and what they do show on the bench."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import data_synth
from fits import Record
from fits.diagnosis import _baseline
from fits.diagnosis._comparison import Rival
from fits.diagnosis._effects import Bench, Law
from fits.diagnosis._experiment import Request, open_question, refine, suggest
from fits.diagnosis._explanation import Cause
from fits.diagnosis._predict import Hypothesis, Predictor
from fits.diagnosis._programs import Limits, Program, limits_of, menu, paces
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import refit
from fits.diagnosis._regression import regress
from fits.diagnosis._result import FoundCause
from fits.diagnosis._score import law_of, probes_of, scales_of, score
from fits.diagnosis._select import select
from fits.loop._run import prepare_run
from fits.stats._noise import Noise
from microid.effects import EFFECTS

MOST = 3000


def limits(rng):
    lower_V = rng.uniform(-20, 20)
    return Limits(
        lower_V,
        lower_V + 10 ** rng.uniform(0.5, 2.5),
        10 ** rng.uniform(0.5, 6),
        10 ** rng.uniform(-5, -1),
        10 ** rng.uniform(-1, 3),
        None if rng.random() < 0.3 else 10 ** rng.uniform(0.5, 3.5),
    )


def test_programs_stay_within_range_rate_and_duration(rng):
    played = set()
    for _ in range(40):
        rig = limits(rng)
        for program in menu(rig, MOST):
            for at in (program.start, rng.uniform(program.lower, program.upper)):
                time_s, voltage_V = program.samples(at)
                played.add(program.words)
                assert time_s.shape == voltage_V.shape
                assert len(time_s) <= MOST
                assert time_s[-1] <= rig.duration_s * (1 + 1e-9)
                steps_s = np.diff(time_s)
                assert np.ptp(steps_s) < 1e-9 * time_s[-1]
                assert steps_s[0] > 0.999 * rig.interval_s
                assert voltage_V.min() >= rig.lower_V
                assert voltage_V.max() <= rig.upper_V
                assert np.abs(np.diff(voltage_V)).max() <= rig.fastest_V_per_s * steps_s[0] * (1 + 1e-6)
                # A full loop comes first: up to the upper voltage, and back.
                assert voltage_V[0] == rig.lower_V
                early = voltage_V[: int(0.6 * len(voltage_V))]
                top = np.flatnonzero(early > rig.upper_V - 0.01 * (rig.upper_V - rig.lower_V))[0]
                assert early[top:].min() < rig.lower_V + 0.01 * (rig.upper_V - rig.lower_V)
    assert len(played) == 9


def test_no_program_fits_into_too_short_a_time(rng):
    rig = limits(rng)
    assert menu(replace(rig, duration_s=rig.span_V / rig.fastest_V_per_s), MOST) == ()
    assert menu(replace(rig, duration_s=5 * rig.interval_s), MOST) == ()


def test_limits_are_those_seen_in_the_records(rng):
    slow = Record(np.arange(50.0), np.linspace(0, 98, 50), np.zeros(50))
    fast = Record(0.1 * np.arange(21), 3 * np.arange(21), np.zeros(21))
    found = limits_of([slow, fast], (-1, 99), 70.0, None)
    assert found == Limits(-1, 99, pytest.approx(30), pytest.approx(0.1), 49.0, 70.0)
    assert limits_of([slow], (0, 98), None, 7.0).duration_s == 7.0
    whole, brisk = paces(found, 101)
    assert (whole.duration_s, whole.interval_s) == (49.0, pytest.approx(0.49))
    assert (brisk.duration_s, brisk.interval_s) == (pytest.approx(10), pytest.approx(0.1))


def test_refinement_climbs_and_stays_inside(rng):
    lower, upper = np.array([0.0, -3.0]), np.array([10.0, 3.0])
    peak, start = rng.uniform(lower, upper), rng.uniform(lower, upper)
    program = Program("", lambda *_: None, limits(rng), lower, upper, start)
    asked = []

    def gain(at):
        asked.append(at)
        return float(np.exp(-np.sum(((at - peak) / (upper - lower)) ** 2)))

    best, top = refine(program, gain, gain(start))
    assert top == gain(best) >= gain(start)
    assert np.all((np.array(asked) >= lower) & (np.array(asked) <= upper))
    far = np.abs(start - peak) > 0.5 * (upper - lower)
    assert top > gain(start) or not far.any()


SCENARIO = """
name = "one loop, then a long hold"
description = "Creep and drift look alike in it."
[rig]
random = true
kind = "plays"
[sensor]
noise_um = 0.02
quantum_um = 0.00001
[[runs]]
name = "first"
sample_rate_Hz = 25.0
[[runs.program]]
kind = "triangle"
cycles = 1
rate_V_per_s = 60.0
[[runs.program]]
kind = "random_reversals"
reversals = 6
rate_V_per_s = 60.0
[[runs.program]]
kind = "steps"
levels_V = [80.0]
dwell_s = 12.0
rate_V_per_s = 60.0
[[effects]]
name = "creep"
rms_per_noise = 2.0
"""


def measured(run):
    return Record(run.time_s, run.voltage_V, run.displacement_um, source=run.name)


def ready(records, noise_um):
    """What a diagnosis prepares, with three forms of effects only and a noise that is known."""
    range_V = min(r.voltage_V.min() for r in records), max(r.voltage_V.max() for r in records)
    baseline = _baseline._static(records, (), range_V, 0.0, "unknown", (True,) * len(records), (), lambda _: None)
    bench = Bench(baseline)
    scales = scales_of(bench, noise_um)
    forms = [form for form in EFFECTS if (form.name, form.form) in {("creep", ""), ("thermal_drift", "exponential")}]
    probes = [probe for form in forms for probe in probes_of(bench, form, scales)]
    projector = Projector(regress(baseline), [Noise(noise_um, np.zeros(0))] * len(records), (0.02, 0.05))
    return SimpleNamespace(baseline=baseline, bench=bench, projector=projector, probes=probes)


def fitted(made, name):
    target = made.projector.off(made.projector.residual)
    asked = score(made.projector, [probe for probe in made.probes if probe.name == name], target).each
    best = max(asked, key=lambda one: one.z)
    law = law_of(best, len(made.bench.prepared))
    return refit(made.bench, made.projector, [law], [law.start])


def found_cause(name, rival):
    return FoundCause(name, "", (rival,), 9.0, 1e-9, (), 1.0, 0.1, "", "", "")


def by_least_squares(made, true, other, time_s, voltage_V):
    """The difference of two changes off all that can follow, of both runs as one dense regression."""
    again = Record(time_s, voltage_V, np.zeros(len(time_s)))
    both = [made.bench.prepared[0].run.record, again]
    # The new one begins at an end of the range.
    settings = made.baseline.range_V, "unknown", 0.0, 1
    runs = tuple(prepare_run(one, *settings, estimated=k == 0) for k, one in enumerate(both))
    baseline = replace(made.baseline, runs=runs, coarse=runs, fine=runs)
    bench, regression = Bench(baseline), regress(baseline)
    noise = made.projector.noise[0].innovation_um
    laws = [Law([one.laws[0].effect(one.x[0], 0)] * 2) for one in (true, other)]
    # As it was in the old run, so it will be in the new one.
    changes = [bench.change([law.effect(law.start, 0)]) for law in laws]
    law, tangent = laws[1], []
    for i in range(law.size):
        ahead = law.start.copy()
        ahead[i] += 1e-4
        out = bench.respond([[law.effect(ahead, run)] for run in range(2)])
        tangent.append([(a - p - c) / 1e-4 for a, p, c in zip(out, bench.plain, changes[1], strict=True)])
    # What has no size of roughness is not among what follows.
    kinds = list(zip(regression.finer, made.projector.roughness, strict=False))
    rows = []
    for k, run in enumerate(runs):
        own = [
            regression.nuisance[i] if i == k else np.zeros((len(run.record), o.shape[1]))
            for i, o in enumerate(regression.nuisance)
        ]
        block = np.concatenate(
            [regression.rows[k], *(kind[k] for kind, _ in kinds), *own, np.stack([t[k] for t in tangent], 1)],
            axis=1,
        )
        rows.append(np.c_[block, changes[0][k] - changes[1][k]][run.fitted] / noise)
    wide = rows[0].shape[1]
    priors = np.zeros((len(regression.root) + sum(kind[0].shape[1] for kind, _ in kinds), wide))
    priors[: len(regression.root), : len(regression.root)] = regression.root
    at = len(regression.root)
    for kind, size in kinds:
        width = kind[0].shape[1]
        priors[at : at + width, regression.size + at - len(regression.root) :][:, :width] = np.eye(width) / size
        at += width
    matrix = np.concatenate([*rows, priors])
    block, target = matrix[:, :-1], matrix[:, -1]
    scale = np.linalg.norm(block, axis=0) + 1e-300
    answer = np.linalg.lstsq(block / scale, target, rcond=1e-9)[0]
    return float(np.linalg.norm(target - block / scale @ answer))


@pytest.mark.study
def test_the_suggested_run_tells_what_the_first_does_not(seed, monkeypatch):
    monkeypatch.setattr(_baseline, "_FINEST", 16)
    bench = data_synth.simulate(data_synth.parse_scenario(SCENARIO), seed)
    noise_um = bench.scenario.sensor.noise_um
    first = measured(bench.records[0])
    made = ready([first], noise_um)
    creep, drift = fitted(made, "creep"), fitted(made, "thermal_drift")
    plain = select(made.bench, made.projector, made.probes, 0.01, np.random.default_rng(seed), lambda _: None)
    count = made.projector.count
    rival = Rival("thermal_drift", drift, drift.criterion(count), drift.cost, np.zeros(0))
    ambiguous = replace(plain, causes=(Cause("creep", 9.0, 1e-9, (rival,), 81.0),), model=creep)
    told = []
    experiment = suggest(made, ambiguous, (found_cause("creep", "thermal_drift"),), Request(), told.append)
    assert experiment is not None
    assert experiment.separates == ("creep", "thermal_drift")
    assert "temperature" in experiment.extra_column
    assert told
    assert experiment.time_s[-1] <= first.duration_s + 1e-9
    assert experiment.predicted_z > max(1.2 * experiment.present_z, 4)
    # The prediction, by a dense regression of both runs.
    hypotheses = [Hypothesis(one.laws, one.x) for one in (creep, drift)]
    program = experiment.time_s, experiment.voltage_V
    predictor = Predictor(made.bench, made.projector, hypotheses, [(0, 1)])
    expected = by_least_squares(made, *hypotheses, *program)
    assert predictor.predicted_z(*program) == pytest.approx(expected, rel=0.01)
    # Of a rival only the last effect may have been fitted, the one before following along its tangent.
    followed = replace(drift, laws=(*creep.laws, *drift.laws), x=(*creep.x, *drift.x))
    two = replace(creep, laws=followed.laws, x=followed.x, tangent=np.hstack([creep.tangent, drift.tangent]))
    other = replace(rival, refit=replace(followed, tangent=drift.tangent))
    causes = (Cause("creep", 9.0, 1e-9, (), 81.0), Cause("aging", 9.0, 1e-9, (other,), 81.0))
    asked = open_question(made, replace(plain, causes=causes, model=two), (found_cause("aging", "thermal_drift"),))
    for hypothesis in asked[1]:
        sizes = [law.size for law in hypothesis.laws]
        assert [one.shape for one in hypothesis.covariances] == [(size, size) for size in sizes]
        assert len(hypothesis.drawn(np.random.default_rng(0)).x) == len(sizes)
    # Without a cause, what has the largest score is suspected, unless chance explains it.
    alone = replace(plain, causes=(), model=plain.plain, left=plain.scores)
    names, (suspect, nothing), pairs = open_question(made, alone, ())
    assert names == suspect.names == (max(plain.scores, key=lambda one: one.z).name,)
    assert nothing.laws == ()
    assert pairs == ((0, 1),)
    quiet = tuple(replace(one, z=0.5) for one in plain.left)
    assert open_question(made, replace(alone, left=quiet), ()) is None
    # What it says on the bench.
    again = measured(bench.play(*program, np.random.default_rng(seed)))
    both = ready([first, again], noise_um)
    after = select(both.bench, both.projector, both.probes, 0.01, np.random.default_rng(seed), lambda _: None)
    assert after.causes[0].name == "creep"
    assert not after.causes[0].rivals
    # Nothing is open any more.
    assert suggest(both, after, (found_cause("creep", ""),), Request(), told.append) is None


@pytest.mark.parametrize("over_after", [1, 3])
def test_once_the_time_is_over_the_best_program_so_far_is_taken(over_after, monkeypatch):
    played = []

    class Counting:
        present_z = 0.0

        def __init__(self, *given):
            pass

        def predicted_z(self, time_s, voltage_V):
            played.append(float(voltage_V[0]))
            return 10 + float(voltage_V[0])

    def program(number):
        samples, bounds = (np.arange(2.0), np.full(2, float(number))), (np.zeros(1), np.ones(1), np.full(1, 0.5))
        return SimpleNamespace(
            words=f"program {number}",
            limits=SimpleNamespace(duration_s=1.0),
            samples=lambda _: samples,
            **dict(zip(("lower", "upper", "start"), bounds, strict=True)),
        )

    programs = tuple(map(program, (0, 0.1, 0.2, 0.3)))
    guard = SimpleNamespace(
        narrowed=lambda limits: SimpleNamespace(duration_s=1.0),
        menu=lambda *_: programs,
        allows=lambda _: True,
        extremes=lambda _: (),
    )
    question = ("one", "other"), (None, None), ((0, 1),)
    replacements = {
        "open_question": lambda *_: question,
        "guard_of": lambda *_: guard,
        "limits_of": lambda *_: None,
        "Predictor": Counting,
        "further_column": lambda *_: "",
        "repeated": lambda *_: None,
    }
    for name, replacement in replacements.items():
        monkeypatch.setattr(f"fits.diagnosis._experiment.{name}", replacement)
    ready = SimpleNamespace(baseline=SimpleNamespace(runs=(), range_V=(0.0, 1.0), resonance_Hz=None))
    request = Request(has_time=lambda: len(played) < over_after)
    found = suggest(ready, SimpleNamespace(bench=None, projector=None), (), request, lambda _: None)
    assert played == [0, 0.1, 0.2][:over_after]
    assert found.kind == f"program {played[-1]:g}"
