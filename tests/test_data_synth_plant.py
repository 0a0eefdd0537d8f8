"""Dynamics of the virtual bench, against scipy's integrators, closed forms and quasi-static truths."""

import dataclasses
import itertools
import json

import numpy as np
import pytest
import scipy.integrate
import scipy.signal

import data_synth as ds

KINDS = ["relays", "plays"]

GOOD = """
name = "small"
description = "A few samples of a moving stage."

[rig]
random = true
relays = 120
plays = 60

[plant]
random = true

[sensor]
noise_um = 0.03

[[runs]]
name = "train"
sample_rate_Hz = 2000.0
initial = "random"

[[runs.program]]
kind = "random_reversals"
reversals = 8
rate_V_per_s = 3000.0
"""


def curve_um(voltage_V):
    return 0.2 * voltage_V + 1e-3 * voltage_V**2


def integrated_um(plant, command_V, sample_rate_Hz):
    """Driver and mechanics by scipy's integrator, from sample to sample, for the hysteresis-free `curve_um`."""
    tau_s, zeta = plant.time_constant_s, plant.damping_ratio
    omega = 2 * np.pi * plant.natural_frequency_Hz
    period_s = 1 / sample_rate_Hz
    state = np.array([command_V[0], curve_um(command_V[0]), 0.0])
    displacement_um = [state[1]]
    for now_V, next_V in itertools.pairwise(command_V):
        slope = (next_V - now_V) / period_s if plant.hold == "first" else 0.0

        def rhs(t, y, now_V=now_V, slope=slope):
            v, x, speed = y
            return [
                (now_V + slope * t - v) / tau_s,
                speed,
                omega**2 * (curve_um(v) - x) - 2 * zeta * omega * speed,
            ]

        done = scipy.integrate.solve_ivp(rhs, (0, period_s), state, method="DOP853", rtol=1e-10, atol=1e-10)
        state = done.y[:, -1]
        displacement_um.append(state[1])
    return np.array(displacement_um)


@pytest.mark.parametrize("hold", ["first", "zero"])
def test_driver_and_mechanics_are_the_ode(hold, rng):
    plant = ds.random_plant(rng, hold=hold)
    for sample_rate_Hz in (200.0, 3000.0):
        command_V = rng.uniform(0, 120, 10)
        expected_um = integrated_um(plant, command_V, sample_rate_Hz)
        displacement_um = plant.respond(command_V, sample_rate_Hz, curve_um)
        np.testing.assert_allclose(displacement_um, expected_um, rtol=0, atol=1e-6)


def fine_um(plant, rig, history_V, command_V, sample_rate_Hz, n):
    """Driver, hysteresis and mechanics on a grid of n steps a sample, by scipy's linear simulation and `play`."""
    time_s = np.arange((len(command_V) - 1) * n + 1) / (n * sample_rate_Hz)
    drive_V = np.interp(time_s, np.arange(len(command_V)) / sample_rate_Hz, command_V)
    driver = scipy.signal.lti([1.0], [plant.time_constant_s, 1.0])
    _, moved_V, _ = scipy.signal.lsim(driver, drive_V - command_V[0], time_s)
    hysteresis = rig.hysteresis()
    hysteresis.play(history_V)
    voltage_V = command_V[0] + moved_V
    static_um = rig.reversible(voltage_V) + hysteresis.play(voltage_V)
    omega = 2 * np.pi * plant.natural_frequency_Hz
    stage = scipy.signal.lti([omega**2], [1, 2 * plant.damping_ratio * omega, omega**2])
    _, moved_um, _ = scipy.signal.lsim(stage, static_um - static_um[0], time_s)
    return (static_um[0] + moved_um)[::n]


def responded_um(plant, rig, history_V, command_V, sample_rate_Hz, **options):
    hysteresis = rig.hysteresis()
    hysteresis.play(history_V)
    return plant.respond(command_V, sample_rate_Hz, lambda v: rig.reversible(v) + hysteresis.glide(v), **options)


@pytest.mark.parametrize(("kind", "tolerance"), [("plays", 1e-5), ("relays", 6e-3)])
def test_hysteresis_stands_between_driver_and_mechanics(kind, tolerance, rng):
    """The treads of the relays' staircase are in the reference and not in the plant: hence two tolerances."""
    rig = ds.random_rig(rng, kind=kind, relays=800, plays=60)
    plant = ds.random_plant(rng)
    history_V = ds.initial_history("random", 0.0, 120.0, rng)
    command_V = np.concatenate([history_V[-1:], np.repeat(rng.uniform(0, 120, 8), rng.integers(1, 6, 8))])
    sample_rate_Hz = float(rng.uniform(1000, 3000))
    expected_um = fine_um(plant, rig, history_V, command_V, sample_rate_Hz, 500)
    displacement_um = responded_um(plant, rig, history_V, command_V, sample_rate_Hz)
    assert np.ptp(expected_um) > 0.1 * rig.stroke_um
    np.testing.assert_allclose(displacement_um, expected_um, rtol=0, atol=tolerance * rig.stroke_um)


@pytest.mark.parametrize("kind", KINDS)
def test_finer_panels_change_nothing(kind, rng):
    for sample_rate_Hz in (200.0, 10_000.0):
        rig = ds.random_rig(rng, kind=kind, relays=500, plays=100)
        plant = ds.random_plant(rng)
        history_V = ds.initial_history("random", 0.0, 120.0, rng)
        way_V = {"rate_V_per_s": 50_000.0 if sample_rate_Hz > 5000 else 2000.0, "sample_rate_Hz": sample_rate_Hz}
        command_V = ds.random_reversals(
            float(history_V[-1]), lower_V=0.0, upper_V=120.0, reversals=6, rng=rng, **way_V
        )
        command_V = np.concatenate([history_V[-1:], command_V])
        coarse_um, fine_um = (
            responded_um(plant, rig, history_V, command_V, sample_rate_Hz, refinement=n) for n in (1, 2)
        )
        np.testing.assert_allclose(coarse_um, fine_um, rtol=0, atol=1e-6 * rig.stroke_um)


@pytest.mark.parametrize("damping_ratio", [0.02, 0.9, 4.0])
def test_a_step_response_is_the_closed_form(damping_ratio, rng):
    frequency_Hz, sample_rate_Hz = float(rng.uniform(80, 600)), float(rng.uniform(300, 9000))
    plant = ds.Plant(natural_frequency_Hz=frequency_Hz, damping_ratio=damping_ratio, hold="zero")
    # One sample at rest, then a jump: it is seen from the sample after it on.
    command_V = np.concatenate([[0.0], np.ones(60)])
    time_s = np.concatenate([[0.0], np.arange(60) / sample_rate_Hz])
    omega = 2 * np.pi * frequency_Hz
    poles = omega * (-damping_ratio + np.array([1, -1]) * np.sqrt(damping_ratio**2 - 1 + 0j))
    decays = np.exp(poles[:, None] * time_s)
    expected = 1 - ((poles[1] * decays[0] - poles[0] * decays[1]) / (poles[1] - poles[0])).real
    np.testing.assert_allclose(plant.respond(command_V, sample_rate_Hz, lambda v: 1 * v), expected, atol=1e-9)


def test_a_driver_alone_lags_a_ramp_by_its_time_constant(rng):
    tau_s, sample_rate_Hz = float(rng.uniform(1e-4, 2e-3)), float(rng.uniform(100, 9000))
    time_s = np.arange(200) / sample_rate_Hz
    voltage_V = ds.Plant(time_constant_s=tau_s).respond(50 * time_s, sample_rate_Hz, lambda v: 1 * v)
    np.testing.assert_allclose(voltage_V, 50 * (time_s - tau_s * -np.expm1(-time_s / tau_s)), atol=1e-12)


def test_the_driver_turns_between_samples_too():
    """A fall right after a rise: the driver turns where it meets the falling command, and a play remembers that."""
    seen = []

    def static(voltage_V):
        seen.extend(voltage_V.tolist())
        return voltage_V

    # v(s) in the fall is 10 - 10 s + 10 - (20 - v0) exp(-s), with v0 = 10 exp(-1) at the peak of the command.
    command_V = np.array([0.0, 10.0, 0.0])
    ds.Plant(time_constant_s=1.0).respond(command_V, 1.0, static)
    v0 = 10 * np.exp(-1)
    turn_s = np.log((20 - v0) / 10)
    assert max(seen) == pytest.approx(10 - 10 * turn_s, abs=1e-12)
    assert len(seen) == 4


def test_without_driver_and_mass_it_is_quasi_static(rng):
    rig = ds.random_rig(rng, kind="plays", plays=50)
    history_V = ds.initial_history("random", 0.0, 120.0, rng)
    command_V = np.concatenate([history_V[-1:], np.repeat(rng.uniform(0, 120, 5000), 2)])
    hysteresis = rig.hysteresis()
    hysteresis.play(history_V)
    expected_um = rig.reversible(command_V) + hysteresis.play(command_V)
    displacement_um = responded_um(ds.Plant(), rig, history_V, command_V, 1e3)
    np.testing.assert_allclose(displacement_um, expected_um, rtol=0, atol=1e-10)


@pytest.mark.parametrize("kind", KINDS)
def test_after_a_rest_the_dynamics_are_forgotten_but_not_the_way(kind, rng):
    """An RC driver never overshoots, so after long rests the stage is where the quasi-static one is."""
    rig = ds.random_rig(rng, kind=kind, relays=120, plays=60)
    plant = ds.random_plant(rng, damping_ratio=0.2)
    # On whole volts, the edges of the relays' cells, glide and play are the same.
    history_V = np.array([0.0, 120.0, *rng.integers(0, 121, 9)], dtype=float)
    levels_V = rng.integers(0, 121, 6).astype(float)
    command_V = np.concatenate([history_V[-1:], np.repeat(levels_V, 250)])
    displacement_um = responded_um(plant, rig, history_V, command_V, 1000.0)[250::250]
    hysteresis = rig.hysteresis()
    hysteresis.play(history_V)
    expected_um = rig.reversible(levels_V) + hysteresis.play(levels_V)
    # A relay on whose edge the voltage comes to rest has switched or has not, by rounding: a row of them may differ.
    share = 1e-9 if kind == "plays" else 1e-2
    np.testing.assert_allclose(displacement_um, expected_um, rtol=0, atol=share * rig.stroke_um)


def test_relays_glide_through_what_they_play(rng):
    """The same at the edges of the cells, straight lines between, and never far from the plain relays."""
    rig = ds.random_rig(rng, kind="relays", relays=60)
    turns_V = np.array([0.0, *2.0 * rng.integers(0, 61, 40)])
    gliding, playing = rig.hysteresis(), rig.hysteresis()
    for before_V, after_V in itertools.pairwise(turns_V):
        edges_V = np.linspace(before_V, after_V, int(abs(after_V - before_V) / 2) + 1)
        path_V = np.linspace(before_V, after_V, 8 * (len(edges_V) - 1) + 1)
        expected_um = np.interp(
            np.linspace(0, 1, len(path_V)), np.linspace(0, 1, len(edges_V)), playing.play(edges_V)
        )
        np.testing.assert_allclose(gliding.glide(path_V), expected_um, rtol=0, atol=1e-10)


@pytest.mark.parametrize("kind", KINDS)
def test_gliding_does_not_jump(kind, rng):
    """However small the runs are: cut anywhere, the answer is the same, within a cell up to a line across it."""
    rig = ds.random_rig(rng, kind=kind, relays=50, plays=50)
    steepest = 4 * rig.stroke_um / 120
    cell_V = 120 / 50 if kind == "relays" else 0.0
    path_V = np.concatenate([[0.0], np.clip(60 + rng.normal(0, 3, 300).cumsum(), 0, 120)])
    whole, cut = rig.hysteresis(), rig.hysteresis()
    for before_V, after_V in itertools.pairwise(path_V):
        run_V = np.linspace(before_V, after_V, 50)
        whole_um = whole.glide(run_V)
        cut_um = np.concatenate([cut.glide(part_V) for part_V in np.array_split(run_V, 7)])
        np.testing.assert_allclose(whole_um[-1], cut_um[-1], rtol=0, atol=1e-10)
        np.testing.assert_allclose(whole_um, cut_um, rtol=0, atol=steepest * cell_V + 1e-10)
        assert np.abs(np.diff(whole_um)).max() <= steepest * abs(after_V - before_V) / 49 + 1e-10


def test_a_record_starts_at_rest_in_its_history(seed):
    scenario = ds.parse_scenario(GOOD)
    held = dataclasses.replace(scenario.runs[0], program=(ds.Segment("hold", {"duration_s": 0.05}),))
    runs = tuple(dataclasses.replace(held, name=name) for name in "ab")
    bench = ds.simulate(dataclasses.replace(scenario, runs=runs), seed)
    for record in bench.records:
        hysteresis = bench.rig.hysteresis()
        # With a plant the voltage has no jumps, and a reversal within a cell of the relays is remembered there.
        for turn_V in record.history_V:
            hysteresis.glide(np.array([turn_V]))
        (rest_um,) = bench.rig.reversible(record.voltage_V[:1]) + hysteresis.glide(record.voltage_V[:1])
        np.testing.assert_allclose(record.true_displacement_um, rest_um, rtol=0, atol=1e-9)


def test_a_plant_changes_the_displacement_and_nothing_else(seed):
    moving = ds.simulate(ds.parse_scenario(GOOD), seed)
    still = ds.simulate(ds.parse_scenario(GOOD.replace("[plant]\nrandom = true", "")), seed)
    assert still.plant is None
    assert still.rig == moving.rig
    (a,), (b,) = moving.records, still.records
    np.testing.assert_array_equal(a.voltage_V, b.voltage_V)
    np.testing.assert_array_equal(a.history_V, b.history_V)
    np.testing.assert_allclose(
        a.displacement_um - a.true_displacement_um, b.displacement_um - b.true_displacement_um, atol=1e-11
    )
    assert np.std(a.true_displacement_um - b.true_displacement_um) > 1e-3 * moving.rig.stroke_um
    hysteresis = still.rig.hysteresis()
    hysteresis.play(b.history_V)
    np.testing.assert_array_equal(
        b.true_displacement_um, still.rig.reversible(b.voltage_V) + hysteresis.play(b.voltage_V)
    )


def test_more_runs_leave_the_plant_as_it_is(seed):
    scenario = ds.parse_scenario(GOOD)
    more = dataclasses.replace(scenario, runs=(*scenario.runs, dataclasses.replace(scenario.runs[0], name="more")))
    assert ds.simulate(scenario, seed).plant == ds.simulate(more, seed).plant
    assert ds.simulate(scenario, seed).plant != ds.simulate(scenario, seed + 1).plant


def test_the_truth_is_not_in_the_csv(seed, tmp_path):
    bench = ds.simulate(ds.parse_scenario(GOOD), seed)
    ds.write(bench, tmp_path / "moving")
    assert sorted(path.name for path in (tmp_path / "moving").iterdir()) == ["train.csv", "truth.json"]
    lines = (tmp_path / "moving" / "train.csv").read_text().splitlines()
    assert lines[0] == "time_s,voltage_V,displacement_um"
    assert {line.count(",") for line in lines} == {2}
    truth = json.loads((tmp_path / "moving" / "truth.json").read_text())
    assert truth["plant"] == dataclasses.asdict(bench.plant)
    np.testing.assert_array_equal(truth["runs"]["train"]["displacement_um"], bench.records[0].true_displacement_um)
    ds.write(ds.simulate(ds.parse_scenario(GOOD.replace("[plant]\nrandom = true", "")), seed), tmp_path / "still")
    assert "plant" not in json.loads((tmp_path / "still" / "truth.json").read_text())


def test_random_plants_keep_to_their_limits_and_to_what_is_stated(seed):
    drawn = [ds.random_plant(np.random.default_rng([seed, k])) for k in range(200)]
    limits = {"time_constant_s": (1e-4, 2e-3), "natural_frequency_Hz": (80, 600), "damping_ratio": (0.01, 0.2)}
    for name, (low, high) in limits.items():
        values = np.array([getattr(plant, name) for plant in drawn])
        assert low <= values.min() < values.max() <= high
        # Evenly on a logarithmic scale: the mean of 200 lies within five standard errors of the middle.
        places = np.log(values / low) / np.log(high / low)
        assert abs(places.mean() - 0.5) < 5 / np.sqrt(12 * 200)
    stated = ds.random_plant(np.random.default_rng([seed, 0]), natural_frequency_Hz=50.0)
    assert stated == dataclasses.replace(drawn[0], natural_frequency_Hz=50.0)
    settings = ds.PlantSettings(random=True, damping_ratio=0.5)
    assert settings.draw(np.random.default_rng([seed, 1])) == dataclasses.replace(drawn[1], damping_ratio=0.5)


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        (
            "time_constant_s = -1e-3",
            "lab.toml: plant: time_constant_s must be positive and at most 1e+06, got -0.001",
        ),
        (
            "natural_frequency_Hz = 0",
            "lab.toml: plant: natural_frequency_Hz must be positive and at most 1e+09, got 0.0",
        ),
        (
            "random = true\ndamping_ratio = 0.0",
            "lab.toml: plant: damping_ratio must be positive and at most 1000, got 0.0",
        ),
        ("natural_frequency_Hz = 180", "lab.toml: plant: natural_frequency_Hz and damping_ratio must be stated"),
        ("damping_ratio = 0.04", "lab.toml: plant: natural_frequency_Hz and damping_ratio must be stated together"),
        ("", "lab.toml: plant: time_constant_s, or natural_frequency_Hz and damping_ratio, or random = true must"),
        ("tau_s = 1e-3", "lab.toml: plant: unknown key 'tau_s', "),
        ("time_constant_s = '1 ms'", "lab.toml: plant: time_constant_s must be a number, got '1 ms'"),
        ("time_constant_s = inf", "lab.toml: plant: time_constant_s must be finite, got inf"),
        ("random = true\nhold = 'second'", "lab.toml: plant: hold must be one of first, zero, got 'second'"),
    ],
)
def test_plants_that_cannot_be_are_refused_by_key(table, sentence):
    with pytest.raises(ds.ScenarioError) as refusal:
        ds.parse_scenario(GOOD.replace("[plant]\nrandom = true", f"[plant]\n{table}"), "lab.toml")
    assert str(refusal.value).startswith(sentence)
    assert "\n" not in str(refusal.value)


def test_the_stage_is_what_it_says():
    scenario = ds.load_scenario("stage")
    coarse = dataclasses.replace(scenario, rig=dataclasses.replace(scenario.rig, relays=20))
    bench = ds.simulate(coarse)
    assert bench.plant == ds.Plant(0.8e-3, 180.0, 0.04)
    slow, fast, heldout = bench.records
    assert len(slow.time_s) <= 20_000
    assert 10_000 <= len(fast.time_s) <= 15_000
    assert 5_000 <= len(heldout.time_s) <= 8_000
    assert (bench.rig.stroke_um, scenario.sensor.noise_um) == (40.0, 0.03)
    # The multisine reaches up to 15 V around the middle, after both saturations were visited.
    np.testing.assert_allclose(np.abs(fast.voltage_V[-10_000:] - 60).max(), 15.0, atol=1e-5)
    assert (fast.voltage_V.min(), fast.voltage_V.max()) == (0.0, 120.0)
