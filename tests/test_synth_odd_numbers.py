"""Numbers of a scenario that no stage has: refused in one sentence before anything is simulated, or simulated."""

import inspect
import warnings

import numpy as np
import pytest

import data_synth as ds
from data_synth._effect import REGISTRY

SCENARIO = """
name = "odd"
description = "A small one with odd numbers."
seed = 5
[rig]
kind = "plays"
plays = 20
[plant]
time_constant_s = 0.0008
natural_frequency_Hz = {frequency}
damping_ratio = {damping}
[temperature]
[other_axis]
{effect}
[[runs]]
name = "only"
sample_rate_Hz = {rate}
[[runs.program]]
kind = "triangle"
cycles = 1
rate_V_per_s = 2400.0
"""
CREEP = '[[effects]]\nname = "creep"\nshare = 0.1\n'


def scenario(effect="", frequency=180.0, damping=0.04, rate=1000.0):
    text = SCENARIO.format(effect=effect, frequency=frequency, damping=damping, rate=rate)
    return ds.parse_scenario(text, "odd.toml")


def finite_or_refused(*arguments):
    """Say whether a scenario is refused; what it measures is finite."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            (record,) = ds.simulate(scenario(*arguments)).records
        except ds.ScenarioError as refusal:
            return str(refusal)
    assert np.isfinite(record.displacement_um).all()
    return ""


@pytest.mark.parametrize("name", sorted(REGISTRY))
def test_any_number_of_an_effect_is_refused_in_one_sentence_or_taken(name):
    found = [
        one for one in inspect.signature(REGISTRY[name].function).parameters.values() if one.kind is one.KEYWORD_ONLY
    ]
    settings = {one.name: 0.1 for one in found if one.default is one.empty}
    for target in [one.name for one in found]:
        for value in ("0", "-1", "0.0", "-1.0", "1e12", "1e-9", "1000000000000000000"):
            lines = "\n".join(f"{key} = {number}" for key, number in (settings | {target: value}).items())
            refusal = finite_or_refused(f'[[effects]]\nname = "{name}"\n{lines}\n')
            assert refusal == "" or (refusal.startswith("odd.toml: ") and "\n" not in refusal)


@pytest.mark.parametrize("effect", ["", CREEP])
@pytest.mark.parametrize(
    ("frequency", "damping", "times"), [("1e9", "0.04", "1e+06"), ("5e5", "1.1", "550"), ("1e9", "1e3", "1e+09")]
)
def test_a_mass_far_too_fast_for_the_samples_is_refused_before_it_is_simulated(effect, frequency, damping, times):
    refusal = finite_or_refused(effect, frequency, damping)
    assert refusal.startswith("odd.toml: run only: sampled at 1000 Hz, a mass of")
    assert f"moves {times} times between two samples, and at most 500" in refusal


def test_a_run_played_later_is_refused_as_well():
    bench = ds.simulate(scenario())
    with pytest.raises(ds.ScenarioError, match=r"odd\.toml: run again: sampled at 0\.1 Hz, a mass of 180 Hz"):
        bench.play(np.arange(4) * 10.0, np.zeros(4), np.random.default_rng(0))
