"""A whole stage identified from slow and fast runs of an independent bench, and runs that cannot be."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _seed import seed_of

import data_synth
import fits
import microid as m
from fits import Record
from fits.loop._misfit import Misfit
from fits.loop._run import prepare_run
from fits.stage._checks import refuse_slopes, refuse_undersampled

SCENARIO = """
name = "small"
description = "slow loops, a fast multisine, and motion to check with"

[rig]
kind = "plays"
plays = {plays}

[plant]
time_constant_s = {tau}
natural_frequency_Hz = {frequency}
damping_ratio = {damping}

[sensor]
noise_um = 0.03

[[runs]]
name = "slow"
sample_rate_Hz = 100.0

[[runs.program]]
kind = "triangle"
cycles = 1
rate_V_per_s = 100.0

[[runs.program]]
kind = "nested"
biases_V = [60.0]
amplitude_V = 60.0
loops = 10
rate_V_per_s = 100.0

[[runs]]
name = "fast"
sample_rate_Hz = 2500.0

[[runs.program]]
kind = "triangle"
cycles = 1
rate_V_per_s = 800.0

[[runs.program]]
kind = "ramp"
to_V = 60.0
rate_V_per_s = 800.0

[[runs.program]]
kind = "multisine"
amplitude_V = 20.0
low_Hz = 2.0
high_Hz = 300.0
period_s = 0.5
periods = 2

[[runs]]
name = "check"
sample_rate_Hz = 2500.0

[[runs.program]]
kind = "random_reversals"
reversals = 20
rate_V_per_s = 2000.0
"""


@dataclasses.dataclass(frozen=True)
class Rig:
    truth: dict[str, float]
    records: dict[str, Record]
    true_um: dict[str, np.ndarray]


def rig_of(plays):
    seed = seed_of("test_fit_stage")
    rng = np.random.default_rng(seed)
    tau, frequency, damping = 10 ** rng.uniform(-3.7, -2.8), rng.uniform(80, 150), rng.uniform(0.02, 0.1)
    bench = data_synth.simulate(
        data_synth.parse_scenario(SCENARIO.format(plays=plays, tau=tau, frequency=frequency, damping=damping)), seed
    )
    truth = {
        "driver.time_constant_s": tau,
        "mechanics.natural_frequency_Hz": frequency,
        "mechanics.damping_ratio": damping,
    }
    records = {
        r.name: Record(r.time_s, r.voltage_V, r.displacement_um, source=f"{r.name}.csv") for r in bench.records
    }
    return Rig(truth, records, {r.name: r.true_displacement_um for r in bench.records})


@pytest.fixture(scope="module")
def rig():
    return rig_of(2000)


@pytest.fixture(scope="module")
def rough_rig():
    """Records that are refused need no smooth hysteresis."""
    return rig_of(60)


@pytest.fixture(scope="module")
def fitted(rig):
    told: list[str] = []
    result = fits.fit_stage(
        [rig.records["slow"], rig.records["fast"]],
        holdout=[rig.records["check"]],
        initial="negative",
        levels=16,
        progress=told.append,
    )
    assert any("round" in sentence for sentence in told)
    return result


@pytest.mark.study
def test_poles_are_found_without_a_guess(rig, fitted):
    for name, value in rig.truth.items():
        print(name, fitted[name], "truth", value)
        # A fifth of a per cent is what the grid's own error may be worth beside the noise.
        assert abs(fitted[name].value - value) < 4 * fitted[name].sd + 2e-3 * value
        assert fitted[name].sd < 0.01 * value
        assert fitted[name].lower < fitted[name].value < fitted[name].upper


@pytest.mark.study
def test_motion_that_was_not_fitted_is_predicted(rig, fitted):
    assert fitted.held_out is not None
    assert fitted.held_out.rms_um < 1.25 * 0.03
    assert fitted.in_sample.rms_um < 1.1 * 0.03
    prediction = fitted.predict(rig.records["check"])
    off = prediction.displacement_um - rig.true_um["check"]
    assert np.std(off) < 0.02
    inside = np.mean(np.abs(off - np.mean(off)) < 1.96 * prediction.displacement_sd_um)
    print("inside the 95 % band", inside)
    assert inside > 0.7


@pytest.mark.study
def test_the_joint_fit_beats_the_hysteresis_alone(rig, fitted):
    alone = fits.fit([rig.records["slow"]], levels=16, holdout=0.0, initial="negative")
    assert type(alone) is type(fitted) is fits.FitResult
    assert alone.weights_um.shape == fitted.weights_um.shape == (16, 16)
    assert [run.source for run in fitted.fitted_runs] == ["slow.csv", "fast.csv"]
    off = alone.predict(rig.records["check"]).displacement_um - rig.true_um["check"]
    assert np.std(off) > 5 * np.std(fitted.predict(rig.records["check"]).displacement_um - rig.true_um["check"])


@pytest.mark.study
def test_gains_stay_in_the_operator(fitted):
    assert {"driver.gain", "mechanics.gain"} <= set(fitted.model.frozen)
    assert float(fitted.model["driver"].gain) == 1.0
    assert [parameter.name for parameter in fitted.parameters] == list(
        ("driver.time_constant_s", "mechanics.natural_frequency_Hz", "mechanics.damping_ratio")
    )
    with pytest.raises(KeyError, match="choose one of driver"):
        fitted["driver.gain"]


@pytest.mark.study
def test_an_amplifier_of_known_gain_scales_the_command_and_nothing_else(rig, fitted):
    commands = {name: dataclasses.replace(r, voltage_V=r.voltage_V / 10) for name, r in rig.records.items()}
    amplified = fits.default_stage().swap("driver", m.Driver(jnp.asarray(1e-3), jnp.asarray(10.0)))
    result = fits.fit_stage(
        [commands["slow"], commands["fast"]],
        stage=amplified,
        holdout=[commands["check"]],
        initial="negative",
        levels=16,
    )
    for name in rig.truth:
        assert result[name].value == pytest.approx(fitted[name].value, abs=0.1 * fitted[name].sd)
    np.testing.assert_allclose(
        result.predict(commands["check"]).displacement_um,
        fitted.predict(rig.records["check"]).displacement_um,
        atol=1e-3,
    )
    with pytest.raises(fits.DataError, match="fitted between 0 and 12 V"):
        result.predict(rig.records["check"])


def test_a_gain_beside_the_operator_is_refused(rough_rig):
    runs = [rough_rig.records["slow"], rough_rig.records["fast"]]
    stage = fits.default_stage().thaw("mechanics.gain")
    with pytest.raises(fits.DataError, match=r"mechanics.gain and the weights of hysteresis .* not each: freeze"):
        fits.fit_stage(runs, stage=stage, initial="negative", levels=8)


@pytest.mark.study
def test_a_voltage_beyond_the_fitted_range_is_refused(fitted):
    time = np.arange(100) / 1000
    with pytest.raises(fits.DataError, match=r"prog.csv: sample 51 .* fitted between 0 and 120 V"):
        fitted.predict(Record(time, np.where(time < 0.05, 0.0, 130.0), None, source="prog.csv"))


@pytest.mark.study
def test_slow_runs_alone_do_not_show_the_dynamics(rng):
    time = np.arange(2400) / 100.0
    voltage = 60 - 60 * np.cos(2 * np.pi * 0.25 * time)
    displacement = 0.3 * voltage + 0.03 * rng.standard_normal(len(time))
    record = Record(time, voltage, displacement, source="slow.csv")
    with pytest.raises(fits.DataError, match=r"slow.csv: .*no(thing|t).*") as refusal:
        fits.fit_stage([record], levels=8, initial="negative")
    assert "chirp" in str(refusal.value) or "sample" in str(refusal.value)


def test_a_resonance_that_samples_cannot_show_is_refused(rng):
    stage = m.Stage.of(piezo=m.Piezo(0.2), mechanics=m.Mechanics(100.0, 0.05, 1.0))

    def refused(rate_Hz, residual_um):
        # Steps at random have as much in the upper half of the band as in the lower.
        record = Record(
            np.arange(300) / rate_Hz, rng.uniform(0, 100, 300), rng.uniform(0, 20, 300), source="thinned.csv"
        )
        left = Misfit("thinned.csv", residual_um, 100 * residual_um / 20, 0.1, "its idle stretches")
        refuse_undersampled(stage, [prepare_run(record, (0.0, 100.0), "negative", 0.0)], [left])

    with pytest.raises(fits.DataError, match=r"thinned.csv: sampled at 300 Hz, .* would lie near 100 Hz"):
        refused(300.0, 1.0)
    with pytest.raises(fits.DataError, match=r"thinned.csv: sampled at 40 Hz, .* would lie far beyond"):
        refused(40.0, 1.0)
    # No more than noise is left, or the samples are many.
    refused(300.0, 0.1)
    refused(600.0, 1.0)


@pytest.mark.study
def test_a_run_sampled_too_slowly_for_its_mode_is_refused(rig, rng):
    fast = rig.records["fast"]
    # Its rate falls to 1.5 times the resonance.
    keep = max(1, round(2500 / (1.5 * rig.truth["mechanics.natural_frequency_Hz"])))
    thinned = Record(fast.time_s[::keep], fast.voltage_V[::keep], fast.displacement_um[::keep], source="thinned.csv")
    # What so few samples make of the ringing may look like another rig.
    with pytest.raises(fits.DataError, match=r"thinned.csv: sampled at .* Hz|thinned.csv: .* not of one rig"):
        fits.fit_stage([rig.records["slow"], thinned], levels=8, initial="negative", holdout=0.0)


def test_a_first_way_from_elsewhere_is_no_other_rig():
    # The same loops, once after a start from far below: only what follows the first full swing is compared.
    time_s = np.arange(600) / 100.0
    voltage_V = 50 - 50 * np.cos(2 * np.pi * time_s)
    settled_um = 0.2 * voltage_V
    first_um = np.where(time_s < 0.45, settled_um - 5 * (1 - time_s / 0.45), settled_um)
    runs = [Record(time_s, voltage_V, um, source=f"{k}.csv") for k, um in enumerate((first_um, settled_um))]
    refuse_slopes(runs)
    larger = Record(time_s, voltage_V, 1.6 * settled_um, source="larger.csv")
    inverted = [Record(r.time_s, voltage_V, -r.displacement_um, source=r.source) for r in (runs[0], larger)]
    for pair in ([runs[0], larger], inverted):
        with pytest.raises(fits.DataError, match=r"larger.csv and 0.csv: .* times as far"):
            refuse_slopes(pair)


@pytest.mark.study
def test_runs_of_different_rigs_are_refused(rig):
    fast = rig.records["fast"]
    other = Record(fast.time_s, fast.voltage_V, 1.4 * fast.displacement_um, source="other.csv")
    with pytest.raises(fits.DataError, match=r"other.csv and slow.csv: .* times as far .* not of one rig"):
        fits.fit_stage([rig.records["slow"], other], levels=8, initial="negative", holdout=0.0)


@pytest.mark.parametrize(
    "tau",
    [
        pytest.param(4e-3, id="slow driver", marks=pytest.mark.study),
        pytest.param(1e-4, id="driver faster than a sample"),
    ],
)
@pytest.mark.study
def test_a_command_held_in_steps_is_fitted(tau, seed):
    """Slow loops lag by what a slow driver takes, and whole samples see nothing of a quick one."""
    text = SCENARIO.format(plays=2000, tau=tau, frequency=120.0, damping=0.05).replace(
        "[plant]", '[plant]\nhold = "zero"'
    )
    bench = data_synth.simulate(data_synth.parse_scenario(text), seed)
    runs = [Record(r.time_s, r.voltage_V, r.displacement_um, source=f"{r.name}.csv") for r in bench.records[:2]]
    result = fits.fit_stage(runs, stage=fits.default_stage("zero"), initial="negative", levels=16, holdout=0.0)
    truth = {"driver.time_constant_s": tau, "mechanics.natural_frequency_Hz": 120.0, "mechanics.damping_ratio": 0.05}
    for name, value in truth.items():
        print(result[name])
        assert abs(result[name].value - value) < 5 * result[name].sd + 2e-3 * value
    assert result.in_sample.rms_um < 1.2 * 0.03
    linear = fits.default_stage("zero").without("driver")
    with pytest.raises(fits.DataError, match="only with a driver ahead of the hysteresis"):
        fits.fit_stage(runs, stage=linear)


def test_a_run_given_twice_is_refused(rough_rig):
    slow = rough_rig.records["slow"]
    again = dataclasses.replace(slow, source="again.csv")
    with pytest.raises(fits.DataError, match=r"slow.csv and again.csv hold the same samples"):
        fits.fit_stage([slow, again])
    with pytest.raises(fits.DataError, match=r"slow.csv and again.csv hold the same samples"):
        fits.fit([slow], holdout=[again])


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"loss": "absolute"}, "unknown loss 'absolute': choose one of squares, huber"),
        ({"initial": ["negative"]}, "1 initial states were given for 2 runs"),
        ({"initial": "positve"}, "unknown initial state 'positve'"),
        ({"holdout": 0.95}, "fraction held out is 0.95"),
    ],
)
def test_settings_that_cannot_be_honoured_are_refused(rough_rig, settings, sentence):
    with pytest.raises(fits.DataError, match=sentence):
        fits.fit_stage([rough_rig.records["slow"], rough_rig.records["fast"]], **settings)
    with pytest.raises(fits.DataError, match="no record"):
        fits.fit_stage([])


@pytest.mark.study
def test_new_data_of_the_same_shape_compile_nothing(rig):
    # Here, as what was compiled may be forgotten between tests.
    slow, fast, check = (rig.records[name] for name in ("slow", "fast", "check"))
    fitted = fits.fit_stage([slow, fast], holdout=[check], initial="negative", levels=16)
    again = [Record(r.time_s, r.voltage_V, r.displacement_um + 1.0, source=r.source) for r in (slow, fast, check)]
    compiled: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, duration, **_: compiled.append(event) if "backend_compile" in event else None
    )
    result = fits.fit_stage(again[:2], holdout=again[2:], initial="negative", levels=16)
    assert compiled == []
    assert result["driver.time_constant_s"].value == pytest.approx(fitted["driver.time_constant_s"].value, rel=1e-3)
    assert jnp.isfinite(result.uncertainty.coordinates).all()
