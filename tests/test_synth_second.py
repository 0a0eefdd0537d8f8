"""The second truth: its parts are the physics that they say, small, repeatable, and not those of the first."""

import dataclasses
import itertools
import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lsim

import data_synth as ds
from data_synth._effect import REGISTRY
from data_synth.effects._own import spectrum_of, swing_of

OWN = ("relaxation_spectrum", "amplitude_dependent_gain")
SMALL = {"slow_samples": 1000, "fast_samples": 1500}


def test_the_relaxation_is_eight_exponentials_of_a_linear_system(rng):
    spectrum, shortest_s, longest_s, share, step_s = int(rng.integers(1000)), 4e-3, 60.0, 0.3, 2e-3
    times_s, weights = spectrum_of(spectrum, shortest_s, longest_s)
    assert weights.sum() == pytest.approx(1)
    assert (weights > 0).all()
    # One in each eighth of the decades.
    np.testing.assert_array_equal(
        np.floor(8 * np.log(times_s / shortest_s) / np.log(longest_s / shortest_s)), range(8)
    )
    static_um = 20 + np.cumsum(rng.standard_normal(3000))
    found_um = REGISTRY["relaxation_spectrum"].function(
        static_um,
        SimpleNamespace(step_s=step_s),
        share=share,
        spectrum=spectrum,
        shortest_s=shortest_s,
        longest_s=longest_s,
    )
    system = (np.diag(-1 / times_s), 1 / times_s[:, None], share * weights[None, :], np.array([[1.0]]))
    _, expected_um, _ = lsim(system, static_um - static_um[0], step_s * np.arange(3000))
    np.testing.assert_allclose(found_um, static_um[0] + expected_um, rtol=0, atol=1e-8)


def marks_apart_V(path_V, reach_V):
    """Two marks that the voltage pushes, in steps of a hundredth of the reach or less, by their differential law."""
    last_V = high_V = low_V = path_V[0]
    apart_V = []
    for voltage_V in path_V[1:]:
        steps = np.linspace(last_V, voltage_V, 2 + int(abs(voltage_V - last_V) / reach_V * 2000))
        for now_V in steps[1:]:
            way = abs(now_V - last_V) / reach_V
            high_V = max(now_V, high_V - (high_V - now_V) * way)
            low_V = min(now_V, low_V + (now_V - low_V) * way)
            last_V = now_V
        apart_V.append(high_V - low_V)
    return np.array(apart_V)


def test_the_swing_is_that_of_two_marks_and_knows_no_rate(rng):
    reach_V = 30.0
    voltage_V = np.concatenate([[0.0], rng.uniform(0, 120, 25), 60 + rng.uniform(-3, 3, 25)])
    swing = swing_of(voltage_V, reach_V, 0.0, 120.0)
    expected = marks_apart_V(np.concatenate([[120.0, 0.0], voltage_V]), reach_V)[1:] / reach_V
    np.testing.assert_allclose(swing, expected, atol=2e-3)
    assert swing[:25].min() > 0
    # On a finer path, and with rests, the same.
    fine_V = np.concatenate([np.linspace(a, b, 7)[:-1] for a, b in itertools.pairwise(voltage_V)] + [voltage_V[-1:]])
    slower = swing_of(np.repeat(fine_V, 3), reach_V, 0.0, 120.0)
    np.testing.assert_allclose(slower[::18], swing, atol=1e-12)


def test_large_moves_have_more_gain_than_small_ones():
    run = SimpleNamespace(rig=SimpleNamespace(lower_V=0.0, upper_V=120.0))
    gained = {}
    for amplitude_V in (0.6, 3.0, 60.0):
        run.voltage_V = 60 + amplitude_V * np.sin(np.linspace(0, 200 * np.pi, 40001))
        gain = REGISTRY["amplitude_dependent_gain"].function(np.ones(40001), run, gain=0.2, reach_share=0.25)
        gained[amplitude_V] = gain[20000:].max() - 1
    # Small: twice the amplitude over the reach, half of a way back taken off; large: all of it.
    assert gained[0.6] == pytest.approx(0.2 * 1.2 / 30, rel=0.03)
    assert gained[3.0] == pytest.approx(0.2 * 6 / 30, rel=0.12)
    assert gained[60.0] == pytest.approx(0.2 * (1 - np.exp(-4)), rel=1e-4)


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_coloured_noise_has_its_autocorrelation(correlation, rng):
    count = 200_000
    noise_um = ds.Sensor(noise_um=0.03, correlation=correlation).read(np.zeros(count), rng)
    # Five standard deviations of what neighbours that agree leave of so many samples.
    far = 5 * np.sqrt((1 + correlation**2) / (1 - correlation**2) / count)
    assert noise_um.std() == pytest.approx(0.03, rel=far)
    for lag in (1, 2, 5):
        found = np.mean(noise_um[lag:] * noise_um[:-lag]) / np.mean(noise_um**2)
        assert found == pytest.approx(correlation**lag, abs=far)


def test_coloured_noise_has_no_beginning(rng):
    sensor = ds.Sensor(noise_um=1.0, correlation=0.9)
    starts = np.array([sensor.read(np.zeros(2), rng) for _ in range(4000)])
    np.testing.assert_allclose(starts.std(axis=0), 1, atol=5 / np.sqrt(2 * 4000))
    with pytest.raises(ValueError, match="correlation must be zero or positive, and below 1, got 1"):
        ds.Sensor(correlation=1.0)


def test_the_second_truth_is_repeatable_and_nothing_like_the_first(seed):
    first, usual = (ds.hidden(["creep"], seed=seed, **SMALL, **truth) for truth in ({"truth": "first"}, {}))
    second, again = (ds.hidden(["creep"], seed=seed, truth="second", **SMALL) for _ in range(2))
    assert ds.files(second) == ds.files(again)
    assert ds.files(first) == ds.files(usual)
    told = [json.loads(ds.files(bench)["truth.json"])["sensor"] for bench in (first, second)]
    assert "correlation" not in told[0]
    assert told[1]["correlation"] == second.scenario.sensor.correlation
    noise_um = second.scenario.sensor.noise_um
    assert noise_um == first.scenario.sensor.noise_um
    assert second.plant == first.plant
    for record in second.records:
        other = first.record(record.name)
        np.testing.assert_array_equal(record.voltage_V, other.voltage_V)
        assert np.std(record.displacement_um - other.displacement_um) > noise_um / 2
    assert [effect.name for effect in first.effects] == ["creep"]
    assert [effect.name for effect in second.effects] == ["creep", *OWN]
    assert second.effects[0].rms_um == pytest.approx(5 * noise_um, rel=0.05)


def test_the_second_truth_is_small_irregular_and_coloured(seed):
    for k in range(3):
        bench = ds.hidden(seed=seed + k, truth="second", noise_um=0.03, stroke_um=40.0, **SMALL)
        assert isinstance(bench.rig.irreversible, ds.PlayShape)
        assert 24 <= len(bench.rig.irreversible.radii_V) <= 60
        assert np.std(np.diff(bench.rig.irreversible.radii_V)) > 0.1
        assert [effect.name for effect in bench.effects] == list(OWN)
        for effect in bench.effects:
            assert 0.48 * 0.03 < effect.rms_um < 1.02 * 0.03
            assert not effect.capped
        correlation = bench.scenario.sensor.correlation
        assert 0.5 <= correlation <= 0.9
        noise_um = np.concatenate([r.displacement_um - r.true_displacement_um for r in bench.records])
        near = np.mean(noise_um[1:] * noise_um[:-1]) / np.mean(noise_um**2)
        assert near == pytest.approx(correlation, abs=5 * np.sqrt((1 - correlation**2) / len(noise_um)))
        # Without its own ways it is another stage, by what is said of them.
        plain = ds.simulate(dataclasses.replace(bench.scenario, effects=()))
        changed = [r.displacement_um - plain.record(r.name).displacement_um for r in bench.records[:2]]
        change_um = np.concatenate([part - part.mean() for part in changed])
        both_um = [effect.rms_um for effect in bench.effects]
        assert abs(both_um[0] - both_um[1]) - 1e-4 < np.sqrt(np.mean(change_um**2)) < sum(both_um) + 1e-4


def test_a_run_of_the_second_truth_is_played_again(rng, seed):
    bench = ds.hidden(seed=seed, truth="second", **SMALL)
    fast = bench.record("fast")
    again = bench.play(fast.time_s, fast.voltage_V, rng)
    np.testing.assert_allclose(again.true_displacement_um, fast.true_displacement_um, atol=1e-5)


def test_what_is_stated_of_the_second_truth_is_kept(seed):
    bench = ds.hidden(seed=seed, truth="second", plays=100, roughness=0.0, **SMALL)
    assert np.ptp(np.diff(bench.rig.irreversible.radii_V)) == pytest.approx(0, abs=1e-9)
    assert len(bench.rig.irreversible.radii_V) == 100
    assert not {*OWN} & {*ds.EFFECTS, *ds.OUTSIDE}
    with pytest.raises(ds.ScenarioError, match="truth must be first or second, got 'third'"):
        ds.hidden(truth="third")
