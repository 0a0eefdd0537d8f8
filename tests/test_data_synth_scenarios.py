"""Scenarios: what is refused, and in which words; what is shipped."""

import dataclasses

import numpy as np
import pytest

import data_synth as ds

GOOD = """
name = "small"
description = "A few samples."
seed = 7

[rig]
relays = 60

[sensor]
noise_um = 0.03

[[runs]]
name = "train"
sample_rate_Hz = 10.0
initial = "demagnetised"

[[runs.program]]
kind = "forc"
reversals_V = [80, 40.5]
rate_V_per_s = 60

[[runs.program]]
kind = "nested"
biases_V = [60.0]
amplitude_V = 20.0
loops = 2
rate_V_per_s = 60.0
"""


def test_a_scenario_is_read_as_it_is_written():
    scenario = ds.parse_scenario(GOOD)
    assert (scenario.name, scenario.seed, scenario.text) == ("small", 7, GOOD)
    assert scenario.rig == ds.RigSettings(relays=60)
    assert scenario.sensor == ds.Sensor(noise_um=0.03)
    (run,) = scenario.runs
    assert (run.name, run.sample_rate_Hz, run.initial) == ("train", 10.0, "demagnetised")
    assert [segment.kind for segment in run.program] == ["forc", "nested"]
    assert run.program[0].settings == {"reversals_V": (80.0, 40.5), "rate_V_per_s": 60.0}
    assert isinstance(run.program[0].settings["rate_V_per_s"], float)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        # Unknown keys, with the nearest known one.
        ('name = "small"', 'nam = "small"', "lab.toml: unknown key 'nam', did you mean 'name'?"),
        ("noise_um", "noise_nm", "lab.toml: sensor: unknown key 'noise_nm', did you mean 'noise_um'?"),
        ("initial =", "inital =", "lab.toml: runs[0]: unknown key 'inital', did you mean 'initial'?"),
        ("loops =", "loop =", "lab.toml: runs[0]: program[1]: unknown key 'loop', did you mean 'loops'?"),
        (
            'kind = "forc"',
            'kind = "fork"',
            "lab.toml: runs[0]: program[0]: unknown kind 'fork', did you mean 'forc'?",
        ),
        ("relays = 60", "start_V = 60", "lab.toml: rig: unknown key 'start_V', "),
        ('kind = "forc"', 'kind = "forc"\nstart_V = 1.0', "lab.toml: runs[0]: program[0]: unknown key 'start_V', "),
        ('kind = "forc"', 'kind = "forc"\nrng = 1', "lab.toml: runs[0]: program[0]: unknown key 'rng', "),
        # Missing keys.
        ('description = "A few samples."', "", "lab.toml: key 'description' is missing"),
        ("sample_rate_Hz = 10.0", "", "lab.toml: runs[0]: key 'sample_rate_Hz' is missing"),
        ("loops = 2", "", "lab.toml: runs[0]: program[1]: key 'loops' is missing"),
        ('kind = "forc"', "", "lab.toml: runs[0]: program[0]: key 'kind' is missing"),
        # Wrong types.
        ("seed = 7", "seed = 7.5", "lab.toml: seed must be a whole number, got 7.5"),
        ("relays = 60", "relays = true", "lab.toml: rig: relays must be a whole number, got True"),
        ("relays = 60", "random = 1", "lab.toml: rig: random must be true or false, got 1"),
        ("noise_um = 0.03", 'noise_um = "30 nm"', "lab.toml: sensor: noise_um must be a number, got '30 nm'"),
        ("noise_um = 0.03", "noise_um = nan", "lab.toml: sensor: noise_um must be finite, got nan"),
        ("[80, 40.5]", "80", "lab.toml: runs[0]: program[0]: reversals_V must be a list, got 80"),
        ("[80, 40.5]", "[80, '4']", "lab.toml: runs[0]: program[0]: reversals_V[1] must be a number, got '4'"),
        ("[rig]\nrelays = 60", "rig = 3", "lab.toml: rig must be a table, got 3"),
        # Bad values.
        ("seed = 7", "seed = -7", "lab.toml: seed must be zero or positive, got -7"),
        ("relays = 60", "relays = 1", "lab.toml: rig: relays must be 2 to 10000, got 1"),
        ("relays = 60", "stroke_um = -40", "lab.toml: rig: stroke_um must be positive, got -40.0"),
        ("relays = 60", "lower_V = 200", "lab.toml: rig: lower_V must be below upper_V, got 200.0 and 120.0"),
        ("relays = 60", "loop_width = 13", "lab.toml: rig: loop_width must be between 0 and 1, got 13.0"),
        ("relays = 60", 'kind = "relay"', "lab.toml: rig: kind must be one of relays, plays, got 'relay'"),
        ("noise_um = 0.03", "noise_um = -1", "lab.toml: sensor: noise_um must be zero or positive, got -1.0"),
        ("demagnetised", "annealed", "lab.toml: runs[0]: initial must be one of negative, positive, demagnetised"),
        ('name = "train"', 'name = "../x"', "lab.toml: runs[0]: name must be made of letters, digits"),
        (
            "sample_rate_Hz = 10.0",
            "sample_rate_Hz = 0",
            "lab.toml: runs[0]: sample_rate_Hz must lie in 0.001 to 1e+08, got 0.0",
        ),
        ("[80, 40.5]", "[130]", "lab.toml: runs[0]: program[0] (forc): reversals_V must lie in 0.0 to 120.0 V, got"),
        ("amplitude_V = 20", "amplitude_V = 80", "lab.toml: runs[0]: program[1] (nested): the program reaches"),
        ("amplitude_V = 20", "amplitude_V = -2", "lab.toml: runs[0]: program[1] (nested): amplitude_V must be"),
        ("rate_V_per_s = 60\n", "rate_V_per_s = 1e-9\n", "lab.toml: runs[0]: program[0] (forc): the program takes"),
        ("seed = 7", "seed = ", "lab.toml: not valid TOML: "),
    ],
)
def test_bad_scenarios_are_refused_in_one_sentence(old, new, sentence):
    assert GOOD.count(old) >= 1
    with pytest.raises(ds.ScenarioError) as refusal:
        ds.parse_scenario(GOOD.replace(old, new, 1), "lab.toml")
    assert str(refusal.value).startswith(sentence)
    assert "\n" not in str(refusal.value)


def test_two_runs_of_one_name_are_refused():
    second = GOOD[GOOD.index("[[runs]]") :].replace('"train"', '"TRAIN"')
    with pytest.raises(ds.ScenarioError, match=r"runs\[0\]: name 'train' is taken by another run"):
        ds.parse_scenario(GOOD + second)


def test_a_loop_the_rig_cannot_have_is_refused_with_the_file():
    text = GOOD.replace("relays = 60", "loop_width = 0.19\nreversible_share = 0.8")
    with pytest.raises(ds.ScenarioError, match=r"^lab\.toml: rig: loop_width must be between"):
        ds.simulate(ds.parse_scenario(text, "lab.toml"))


def test_scenarios_that_are_not_there_are_refused(tmp_path):
    with pytest.raises(ds.ScenarioError, match="no scenario is called 'quickstrt': did you mean 'quickstart'"):
        ds.load_scenario("quickstrt")
    with pytest.raises(ds.ScenarioError, match=r"lab\.toml: cannot be read: No such file"):
        ds.load_scenario(str(tmp_path / "lab.toml"))


def test_a_scenario_is_read_from_a_file(tmp_path):
    (tmp_path / "lab.toml").write_text(GOOD, encoding="utf-8")
    assert ds.load_scenario(str(tmp_path / "lab.toml")).runs == ds.parse_scenario(GOOD).runs


def test_shipped_scenarios_are_the_ones_that_are_promised():
    promised = {"quickstart", "major_loops", "forc", "nested", "random_reversals"}
    promised |= {"holds_and_steps", "chirp", "unknown_history", "plays", "stage"}
    assert promised <= set(ds.scenario_names())
    assert ds.scenario_names() == sorted(ds.scenario_names())


@pytest.mark.parametrize("name", ds.scenario_names())
def test_shipped_scenarios_can_be_measured_and_written(name, tmp_path, seed):
    scenario = ds.load_scenario(name)
    assert scenario.name == name
    assert scenario.description.endswith(".")
    # A coarser truth than the shipped one saves time and goes the same ways.
    coarse = dataclasses.replace(scenario, rig=dataclasses.replace(scenario.rig, relays=150, plays=50))
    bench = ds.simulate(coarse, seed)
    for run, record in zip(scenario.runs, bench.records, strict=True):
        assert record.name == run.name
        assert record.voltage_V[0] == pytest.approx(record.history_V[-1], abs=1e-6)
        assert record.voltage_V.min() >= bench.rig.lower_V
        assert record.voltage_V.max() <= bench.rig.upper_V
        # Whatever the history, the displacement lies between the two saturations; a mass may swing beyond, and
        # effects go farther.
        beyond_um = 0 if bench.plant is None else (0.5 if bench.effects else 0.05) * bench.rig.stroke_um
        assert record.true_displacement_um.min() >= -1e-9 - beyond_um
        assert record.true_displacement_um.max() <= bench.rig.stroke_um * 1.001 + beyond_um
        np.testing.assert_allclose(np.diff(record.time_s), 1 / run.sample_rate_Hz, atol=2e-9)
    files = ds.write(bench, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in files)


def test_the_quickstart_is_the_stage_of_the_paper():
    """One record of about 10,000 samples to learn from, one of about 5,000 to check with, on the paper's stage."""
    scenario = ds.load_scenario("quickstart")
    bench = ds.simulate(dataclasses.replace(scenario, rig=dataclasses.replace(scenario.rig, relays=150)))
    train, heldout = bench.records
    assert 9_000 < len(train.time_s) < 11_000
    assert 4_000 < len(heldout.time_s) < 6_000
    assert (bench.rig.lower_V, bench.rig.upper_V, bench.rig.stroke_um) == (0.0, 120.0, 40.0)
    assert bench.rig.loop_width == 0.13
    assert (scenario.sensor.noise_um, scenario.sensor.quantum_um) == (0.03, 0.001)


def test_what_takes_hours_is_refused():
    """Many samples of many plays; either alone is fine."""
    many, long = GOOD.replace("relays = 60", 'kind = "plays"\nplays = 10_000'), ("10.0", "100_000.0")
    ds.parse_scenario(many)
    ds.parse_scenario(GOOD.replace(*long, 1))
    with pytest.raises(ds.ScenarioError, match=r"runs\[0\]: all runs take more than 400,000 samples"):
        ds.parse_scenario(many.replace(*long, 1))
