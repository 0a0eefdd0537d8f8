"""Hidden effects: each is as strong as asked for, absent where it must be, and is the physics it is named after."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import detrend

import data_synth as ds
from data_synth._effect import REGISTRY
from data_synth._engine import _drive
from data_synth._mechanics import Mechanics, Mode

ALL = (*ds.EFFECTS, *ds.OUTSIDE)
NOISE_UM = 0.03


def bench(*effects, seed, **settings):
    """A small stage of 40 um."""
    usual = {"slow_samples": 1000, "fast_samples": 1000, "holdout": False, "stroke_um": 40.0, "noise_um": NOISE_UM}
    usual |= {"kind": "plays", "roughness": 0.3, "plays": 60, "temperature": False, "other_axis": False}
    return ds.hidden(effects, seed=seed, **(usual | settings))


def without(hidden, effects=()):
    return ds.simulate(dataclasses.replace(hidden.scenario, effects=effects))


def changes_um(hidden, plain):
    """What differs in the readings of each run; the noise is the same in both."""
    return {r.name: r.displacement_um - plain.record(r.name).displacement_um for r in hidden.records}


def rms(parts):
    return np.sqrt(np.mean(np.concatenate([part - part.mean() for part in parts]) ** 2))


def test_a_command_held_in_steps_comes_half_a_sample_later(seed):
    lines, steps = (bench(seed=seed, hold=hold).record("fast") for hold in ("first", "zero"))
    rate_um_per_s = np.gradient(lines.true_displacement_um, lines.time_s)
    change_um = steps.true_displacement_um - lines.true_displacement_um
    later_s = -(change_um @ rate_um_per_s) / (rate_um_per_s @ rate_um_per_s)
    assert later_s == pytest.approx((lines.time_s[1] - lines.time_s[0]) / 2, rel=0.1)


@pytest.mark.parametrize("name", ALL)
def test_an_effect_is_as_strong_as_asked_and_nothing_at_strength_zero(name, seed):
    hidden = bench(name, seed=seed, rms_per_noise=3.0, temperature=name == "thermal_drift")
    plain = without(hidden)
    (truth,) = hidden.effects
    assert truth.name == name
    changed = changes_um(hidden, plain)
    # The last digit, and what is read again, depend on the noise itself; ties of the sensor's own digit do the rest.
    tolerance = 0.1 if name in ("quantisation", "repeated_readings") else 1e-3
    assert rms(changed.values()) == pytest.approx(truth.rms_um, rel=tolerance)
    for run, change_um in changed.items():
        assert rms([change_um]) == pytest.approx(truth.runs_rms_um[run], rel=tolerance, abs=1e-5)
    if truth.capped:
        entry = REGISTRY[name]
        assert truth.parameters[entry.size] == pytest.approx(entry.limit)
        assert truth.rms_um < 3 * NOISE_UM
    else:
        # Whole samples are lost.
        assert truth.rms_um == pytest.approx(3 * NOISE_UM, rel=0.2 if name == "repeated_readings" else 0.05)
    off = without(hidden, (ds.EffectSettings(name, {}, 0.0),))
    for change_um in changes_um(off, plain).values():
        # The hysteresis is asked at other voltages where the path differs in its last bit.
        assert np.abs(change_um).max() < 2e-4


def test_the_library_and_what_is_outside_of_it():
    assert len(ds.EFFECTS) == 33
    assert not set(ds.EFFECTS) & set(ds.OUTSIDE)
    assert {"wandering_gain", "burst_disturbance", "memory_loss"} == set(ds.OUTSIDE)


@pytest.mark.parametrize("kind", ["plays", "relays"])
def test_fine_steps_agree_with_the_closed_form(kind, seed):
    fine = bench(seed=seed, kind=kind, noise_um=0.0)
    closed = ds.simulate(dataclasses.replace(fine.scenario, fine_steps=False))
    for record in fine.records:
        away_um = record.true_displacement_um - closed.record(record.name).true_displacement_um
        # A turn at the edge of a cell of relays may be remembered on either side of it.
        assert np.sqrt(np.mean(away_um**2)) < 2e-3
        if kind == "plays":
            assert np.abs(away_um).max() < 4e-3


@pytest.mark.parametrize("name", ["creep", "floor_vibration", "dropped_samples", "outliers"])
def test_the_same_seed_gives_the_same_bytes(name, seed, tmp_path):
    for folder, start in (("a", seed), ("b", seed), ("c", seed + 1)):
        ds.write(bench(name, seed=start, temperature=None, other_axis=None), tmp_path / folder)
    files = {f: {p.name: p.read_bytes() for p in (tmp_path / f).iterdir()} for f in "abc"}
    assert files["a"] == files["b"]
    assert all(files["a"][file] != files["c"][file] for file in files["a"])


def test_an_effect_leaves_stage_programs_and_noise_as_they_were(seed):
    hidden, plain = bench("second_resonance", seed=seed), bench(seed=seed)
    assert (hidden.rig, hidden.plant) == (plain.rig, plain.plant)
    for record in hidden.records:
        np.testing.assert_array_equal(record.voltage_V, plain.record(record.name).voltage_V)
    # A second mode does nothing in a slow run, but where it steps.
    changed = changes_um(hidden, plain)
    assert 20 * np.median(np.abs(changed["slow"])) < np.median(np.abs(changed["fast"]))


def test_a_creeping_step_is_straight_in_log_time(rng, seed):
    creeping = ds.EffectSettings("creep", {"share": 0.02, "onset_s": 0.1})
    hidden = bench(creeping, seed=seed, noise_um=0.0)
    time_s = np.arange(6000) / 100
    voltage_V = np.where(time_s > 0, 60.0, 0.0)
    crept = hidden.play(time_s, voltage_V, rng).displacement_um
    settled = without(hidden).play(time_s, voltage_V, rng).displacement_um
    step_um, later = settled[-1] - settled[0], slice(200, None)
    decades = np.log10(1 + (time_s[later] - 0.005) / 0.1)
    slope_um, start_um = np.polyfit(decades, (crept - settled)[later], 1)
    assert slope_um == pytest.approx(0.02 * step_um, rel=1e-3)
    assert abs(start_um) < 1e-3 * step_um
    assert np.abs((crept - settled)[later] - start_um - slope_um * decades).max() < 2e-4 * step_um


def test_a_fast_enough_amplifier_is_not_limited(seed):
    changed = changes_um(bench("slew_limit", seed=seed), bench(seed=seed))
    assert np.abs(changed["slow"]).max() == 0
    assert np.abs(changed["fast"]).max() > 3 * NOISE_UM
    first = np.flatnonzero(changed["fast"])[0]
    assert first > 50  # the loop at the start is too slow for it


def test_lost_samples_show_after_the_first_of_them(seed):
    lost = ds.EffectSettings("dropped_samples", {"lost": 3.0})
    hidden = bench(lost, seed=seed, noise_um=0.0)
    plain = without(hidden)
    fast, whole = hidden.record("fast").displacement_um, plain.record("fast").displacement_um
    first = np.flatnonzero(fast != whole)[0]
    assert first >= 0.05 * len(fast)
    # After the last loss each reading is the one three samples later.
    np.testing.assert_allclose(fast[-40:-3], whole[-37:], atol=2e-5)


@pytest.mark.parametrize("name", ["mains_hum", "floor_vibration", "burst_disturbance", "zero_shift"])
def test_disturbances_do_not_ask_what_is_commanded(name, seed):
    hidden = bench(name, seed=seed, noise_um=NOISE_UM)
    plain = without(hidden)
    time_s = np.arange(400) / 1000
    added = []
    for voltage_V in (np.zeros(400), 60 - 60 * np.cos(20 * time_s)):
        records = [b.play(time_s, voltage_V, np.random.default_rng(seed)) for b in (hidden, plain)]
        added.append(np.subtract(*(record.displacement_um for record in records)))
    np.testing.assert_allclose(added[0], added[1], atol=3e-5)
    assert np.std(added[0]) > NOISE_UM / 3


def test_a_delay_a_clock_and_a_last_digit_are_what_they_say(seed):
    quiet = {"seed": seed, "noise_um": 0.0}
    plain = bench(**quiet)
    for name in ("slow", "fast"):
        reading_um, time_s = plain.record(name).displacement_um, plain.record(name).time_s
        period_s = time_s[1]
        late = bench(ds.EffectSettings("transport_delay", {"delay_s": 2 * period_s}), **quiet)
        np.testing.assert_allclose(late.record(name).displacement_um[2:], reading_um[:-2], atol=1e-4)
        ahead = bench(ds.EffectSettings("clock_mismatch", {"rate_share": 4 / (len(time_s) - 1)}), **quiet)
        assert ahead.record(name).displacement_um[0] == reading_um[0]
        # Half way through the run the clocks are two samples apart, at the end four.
        middle = (len(time_s) - 1) // 2
        span = np.sort(reading_um[middle + 1 : middle + 4])
        assert span[0] - 1e-4 <= ahead.record(name).displacement_um[middle] <= span[-1] + 1e-4
    coarse = bench(ds.EffectSettings("quantisation", {"step_um": 0.1}), **quiet).record("slow").displacement_um
    np.testing.assert_allclose(coarse * 10, np.round(coarse * 10), atol=1e-6)
    assert np.abs(coarse - plain.record("slow").displacement_um).max() <= 0.05 + 1e-5


def test_hardening_is_duffings_equation(rng):
    time_s = np.arange(4001) * 2e-5
    static_um = 20 + 8 * np.sin(2 * np.pi * 90 * time_s)
    rise, centre_um, reach_um, omega, zeta = 0.08, 10.0, 40.0, 2 * np.pi * 110, 0.03
    entry = REGISTRY["stiffness_hardening"]
    hidden = bench(seed=int(rng.integers(2**31)))
    place = type("Run", (), {"rig": dataclasses.replace(hidden.rig, stroke_um=reach_um)})
    stage = entry.function(Mechanics(Mode(110.0, zeta)), place, rise=rise, centre_share=centre_um / reach_um)
    found_um = stage.respond(static_um, time_s)

    def force_um(x):
        return x * (1 + rise * ((x - centre_um) / reach_um) ** 2)

    def change(t, state):
        asked_um = np.interp(t, time_s, static_um)
        return [state[1], omega**2 * (asked_um - force_um(state[0])) - 2 * zeta * omega * state[1]]

    assert force_um(found_um[0]) == pytest.approx(static_um[0], rel=1e-9)
    exact = solve_ivp(change, (0, time_s[-1]), [found_um[0], 0], t_eval=time_s, rtol=1e-9, atol=1e-9, max_step=2e-5)
    np.testing.assert_allclose(found_um, exact.y[0], atol=2e-3)
    assert np.abs(found_um - Mechanics(Mode(110.0, zeta)).respond(static_um, time_s)).max() > 0.1


@pytest.mark.parametrize("hold", ["first", "zero"])
def test_a_lag_that_changes_with_the_voltage_and_its_direction_is_its_differential_equation(hold, rng):
    tau_s, share, slower, rate_Hz, steps = 1e-3, 0.8 * rng.choice([-1, 1]), rng.choice([0, 0.2]), 4000.0, 16
    command_V = 60 + 60 * np.sin(2 * np.pi * rng.uniform(100, 400) * np.arange(60) / rate_Hz + rng.uniform(0, 6))
    time_s = np.arange(59 * steps + 1) / (rate_Hz * steps)
    if hold == "first":
        fine_V = np.interp(time_s, time_s[::steps], command_V)
    else:
        fine_V = np.append(command_V[0], np.repeat(command_V[:-1], steps))
    situation = SimpleNamespace(step_s=time_s[1], plant=SimpleNamespace(hold=hold))

    def of(voltage_V, ahead_V):
        return tau_s * (1 + share * (voltage_V - 60) / 60) * (1 + slower * np.sign(ahead_V))

    def going(ahead_V, voltage_V):
        return ahead_V / of(voltage_V, ahead_V)

    driven_V = _drive(fine_V, of, situation)
    expected_V, now_V = [command_V[0]], command_V[0]
    for k in range(59):
        way_V = command_V[k + 1] - command_V[k] if hold == "first" else 0.0
        solved = solve_ivp(
            lambda t, v, k=k, way_V=way_V: going(command_V[k] + way_V * t * rate_Hz - v, v),
            (0, 1 / rate_Hz),
            [now_V],
            method="LSODA",
            rtol=1e-10,
            atol=1e-10,
        )
        now_V = float(solved.y[0, -1])
        expected_V.append(now_V)
    np.testing.assert_allclose(driven_V[::steps], expected_V, rtol=0, atol=0.02)


def test_a_load_lowers_the_note_of_the_stage(rng, seed):
    loaded = ds.EffectSettings("load_change", {"mass_share": 0.5, "instant_share": 0.5})
    hidden = bench(loaded, seed=seed, noise_um=0.0)
    frequency_Hz = hidden.plant.natural_frequency_Hz
    time_s = np.arange(4000) / (40 * frequency_Hz)
    voltage_V = np.where((np.arange(4000) // 1000) % 2 == 1, 60.0, 50.0)
    ringing_um = hidden.play(time_s, voltage_V, rng).displacement_um
    notes_Hz = []
    for start in (1010, 3010):
        piece = detrend(ringing_um[start : start + 600], type="constant")
        crossings = np.flatnonzero(np.diff(np.signbit(piece)))[:9]
        notes_Hz.append((len(crossings) - 1) / 2 / (time_s[crossings[-1]] - time_s[crossings[0]]))
    assert notes_Hz[1] / notes_Hz[0] == pytest.approx(1 / np.sqrt(1.5), rel=0.06)


def test_a_run_is_played_again_on_the_same_stage(rng, seed):
    hidden = bench("second_resonance", seed=seed, temperature=True, other_axis=True)
    fast = hidden.record("fast")
    again = hidden.play(fast.time_s, fast.voltage_V, rng)
    np.testing.assert_allclose(again.true_displacement_um, fast.true_displacement_um, atol=1e-5)
    noise_um = (again.displacement_um - fast.displacement_um) / np.sqrt(2)
    assert noise_um.std() == pytest.approx(NOISE_UM, rel=0.1)
    assert again.columns().keys() == fast.columns().keys()
    for time_s, voltage_V, word in (
        (fast.time_s**2, fast.voltage_V, "even steps"),
        (fast.time_s, fast.voltage_V + 1, "must lie in 0 to 120 V"),
        (fast.time_s[1:], fast.voltage_V, "same length"),
    ):
        with pytest.raises(ds.ScenarioError, match=word):
            hidden.play(time_s, voltage_V, rng)


def test_two_effects_at_once_and_columns_besides(seed, tmp_path):
    hidden = bench("creep", "cross_coupling", seed=seed, temperature=True, rms_per_noise=4.0)
    assert [effect.name for effect in hidden.effects] == ["creep", "cross_coupling"]
    both = rms(changes_um(hidden, without(hidden)).values())
    first, second = (effect.rms_um for effect in hidden.effects)
    assert abs(first - second) - 1e-4 <= both <= first + second + 1e-4
    ds.write(hidden, tmp_path)
    header, row, *_ = (tmp_path / "slow.csv").read_text().split("\n")
    assert header == "time_s,voltage_V,displacement_um,temperature_C,other_um"
    assert len(row.split(",")) == 5
    truth = json.loads((tmp_path / "truth.json").read_text())["effects"]
    assert [effect["name"] for effect in truth] == ["creep", "cross_coupling"]
    assert truth[0].keys() == {"name", "parameters", "rms_um", "runs_rms_um", "capped"}
    # The reading goes with the column of the other axis.
    fast = hidden.record("fast")
    single = without(hidden, hidden.scenario.effects[:1]).record("fast")
    slope = np.polyfit(fast.other_um, fast.displacement_um - single.displacement_um, 1)[0]
    assert slope == pytest.approx(truth[1]["parameters"]["share"], rel=0.02)


GOOD = ds.load_scenario("hidden_creep").text


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('name = "creep"', 'name = "crep"', r"effects\[0\]: unknown effect 'crep', did you mean 'creep'"),
        ("rms_per_noise", "rms_per_nois", r"effects\[0\]: unknown key 'rms_per_nois'"),
        ("rms_per_noise = 5.0", "rms_per_noise = true", "rms_per_noise must be a number"),
        ("rms_per_noise = 5.0", "rms_per_noise = 5.0\nshare = 0.1", "state share or rms_per_noise and not both"),
        ("rms_per_noise = 5.0", "static_um = 5.0", r"effects\[0\]: unknown key 'static_um'"),
        ("rms_per_noise = 5.0", 'kind = "power"', "kind must be one of log, kelvin_voigt"),
        ("rms_per_noise = 5.0", '[[effects]]\nname = "creep"', r"effects\[0\]: creep stands twice"),
        ('name = "creep"\n', "", r"effects\[0\]: key 'name' is missing"),
        ("wander_K = 0.2", "wander_C = 0.2", "temperature: unknown key 'wander_C', did you mean 'wander_K'"),
        ("wander_K = 0.2", "wander_K = -0.2", "wander_K must be zero or positive"),
        ("[temperature]\nwander_K = 0.2", "[other_axis]\nstroke_mm = 3", "other_axis: unknown key 'stroke_mm'"),
        ('name = "creep"', 'name = "cross_coupling"', "cross_coupling needs a second axis"),
        ("noise_um = 0.03", "noise_um = 0.0", "which must be positive"),
        ("rms_per_noise = 5.0", "rms_per_noise = 5e4\nat_most = false", "creep cannot be 50000 times the noise"),
        ("time_constant_s = 0.0006", "", ""),
    ],
)
def test_effects_that_cannot_be_are_refused_in_one_sentence(old, new, sentence):
    assert old in GOOD
    text = GOOD.replace(old, new, 1).replace("sample_rate_Hz = 4000.0", "sample_rate_Hz = 1000.0")
    if not sentence:
        text, sentence = text.replace('"creep"', '"voltage_dependent_capacitance"'), "needs a driver"
    with pytest.raises(ds.ScenarioError, match=sentence) as refusal:
        ds.simulate(ds.parse_scenario(text, "lab.toml"))
    assert "\n" not in str(refusal.value)


def test_hidden_refuses_what_it_cannot_draw():
    with pytest.raises(ds.ScenarioError, match="unknown effect 'crep', did you mean 'creep'"):
        ds.hidden(["crep"])
    with pytest.raises(ds.ScenarioError, match="must be 1000 or more"):
        ds.hidden(slow_samples=10)
    with pytest.raises(ds.ScenarioError, match="seed must be zero or positive"):
        ds.hidden(seed=-1)
