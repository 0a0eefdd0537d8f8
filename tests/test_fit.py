"""Fits end to end, on the independent bench."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import data_synth
import fits

LEVELS = 12


def records(bench):
    return [fits.Record(r.time_s, r.voltage_V, r.displacement_um, source=f"{r.name}.csv") for r in bench.records]


@pytest.fixture(scope="module")
def bench():
    return data_synth.simulate(data_synth.load_scenario("plays"), seed=20240)


@pytest.fixture(scope="module")
def result(bench):
    train, heldout = records(bench)
    return fits.fit([train], holdout=[heldout], levels=LEVELS, initial="negative")


def test_held_out_runs_are_predicted_to_the_noise(result):
    assert result.status is fits.FitStatus.CONVERGED
    assert result.held_out.rms_um < 1.1 * 0.03
    assert result.noise_um == pytest.approx(0.03, rel=0.05)
    assert result.correlation_samples < 1.2
    assert len(result.runs) == 2
    assert result.runs[0].held_out is None
    assert result.runs[1].in_sample is None


def test_weights_are_non_negative_and_account_for_the_stroke(result, bench):
    weights = np.asarray(result.weights_um)
    assert weights.shape == (LEVELS, LEVELS)
    assert np.all(weights >= 0)
    assert np.all(weights[np.triu_indices(LEVELS, 1)] == 0)
    record = bench.records[0]
    low, high = (float(v) for v in (result.model.density.lower_V, result.model.density.upper_V))
    stroke = float(result.everett(high, low))
    assert stroke == pytest.approx(np.ptp(record.true_displacement_um), rel=1e-2)


def test_prediction_is_the_model_and_its_band_covers_the_truth(result, bench):
    _, heldout = records(bench)
    prediction = result.predict(heldout, initial="negative")
    plain = result.model(jnp.asarray(heldout.voltage_V))
    np.testing.assert_allclose(prediction.displacement_um, plain, rtol=0, atol=1e-9)
    unsure = fits.predict(result.model, heldout)
    np.testing.assert_allclose(unsure.displacement_um, plain, rtol=0, atol=1e-9)
    assert np.all(np.isnan(unsure.displacement_sd_um))
    truth = bench.records[1].true_displacement_um
    off = prediction.displacement_um - truth
    off -= off.mean()
    assert np.mean(np.abs(off) < 1.96 * prediction.displacement_sd_um) > 0.7


def test_voltages_beyond_the_fitted_range_are_refused(result):
    far = fits.Record(np.arange(60.0), np.linspace(0, 130, 60), None, source="far.csv")
    with pytest.raises(fits.DataError, match=r"far\.csv: sample 56 .* between 0 and 120 V"):
        result.predict(far)


def test_two_runs_are_fitted_at_once_each_with_its_own_offset(bench, rng):
    train, _ = records(bench)
    half = len(train) // 2
    low = train.voltage_V <= 1e-9
    cut = half + int(np.flatnonzero(low[half:])[0])
    first, second = train[:cut], train[cut:]
    shift = rng.uniform(-50, 50)
    second = fits.Record(second.time_s, second.voltage_V, second.displacement_um + shift, source="second.csv")
    found = fits.fit([first, second], holdout=0.2, levels=LEVELS, initial="negative")
    gap = found.runs[1].offset_um - found.runs[0].offset_um
    assert gap == pytest.approx(shift, abs=0.02)
    assert found.held_out.rms_um < 1.15 * 0.03


def test_an_unknown_past_is_estimated(rng):
    """A record that starts half way up after a random history that the fit is not told."""
    lower_V, upper_V, n = 0.0, 120.0, 4000
    history = np.concatenate([[lower_V, upper_V], rng.uniform(20, 100, 4)])
    turns = np.concatenate([[history[-1]], rng.uniform(10, 110, 3), [lower_V, upper_V], rng.uniform(0, 120, 24)])
    voltage = np.interp(np.linspace(0, len(turns) - 1, n), np.arange(len(turns)), turns)
    rig = data_synth.random_rig(rng, kind="relays", stroke_um=40.0, reversible_share=0.6, loop_width=0.13)
    operator = rig.hysteresis()
    operator.play(history)
    truth = rig.reversible(voltage) + operator.play(voltage)
    record = fits.Record(np.arange(n) * 0.01, voltage, truth + rng.normal(0, 0.03, n), source="late.csv")
    found = fits.fit([record], holdout=0.0, levels=LEVELS)
    assert found.runs[0].unknown == 0
    near_V = 1e-3 * np.ptp(voltage)
    unknown = int(np.argmax((voltage <= voltage.min() + near_V) | (voltage >= voltage.max() - near_V)))
    assert 0.05 * n < unknown < n // 2
    again = np.asarray(found.model(jnp.asarray(record.voltage_V), found.runs[0].start))
    past, known = again[:unknown] - truth[:unknown], again[unknown:] - truth[unknown:]
    cold = np.asarray(found.model(jnp.asarray(record.voltage_V)))[:unknown] - truth[:unknown]
    assert np.std(past) < 0.3 * np.std(cold) + 0.1
    assert abs(known.mean()) < 0.1
    assert any("late.csv: what the rig went through before" in remark for remark in found.remarks)


@pytest.mark.parametrize("family", [pytest.param(name, marks=pytest.mark.study) for name in ("mixture", "network")])
def test_other_families_reach_the_noise(bench, family):
    train, heldout = records(bench)
    found = fits.fit([train], holdout=[heldout], family=family, levels=LEVELS, starts=3, initial="negative", seed=1)
    assert found.model.density.family == family
    assert found.held_out.rms_um < 1.25 * 0.03
    assert np.all(np.asarray(found.weights_um) >= 0)


def test_a_second_record_of_the_same_length_compiles_nothing(bench):
    train, heldout = records(bench)
    shift = fits.Record(train.time_s, train.voltage_V, train.displacement_um * 1.01, source="again.csv")
    compiled = []

    def listen(name, duration, **_):
        if "backend_compile" in name:
            compiled.append(name)

    fits.fit([shift], holdout=[heldout], levels=LEVELS, initial="negative").predict(heldout)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        fits.fit([train], holdout=[heldout], levels=LEVELS, initial="negative").predict(heldout)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert compiled == []


def test_records_that_cannot_be_fitted_are_refused(bench):
    train, _ = records(bench)
    turned = fits.Record(train.time_s, train.voltage_V, -train.displacement_um, source="turned.csv")
    exchanged = fits.Record(train.time_s, train.displacement_um, train.voltage_V, source="exchanged.csv")
    noise = fits.Record(
        train.time_s, train.voltage_V, np.random.default_rng(0).normal(size=len(train)), source="noise.csv"
    )
    for bad, options, words in [
        ([noise], {}, "noise.csv: the displacement hardly follows the voltage"),
        ([], {}, "no record"),
        ([train], {"family": "spline"}, "unknown density family 'spline'"),
        ([train], {"levels": 3}, "from 4 to 100"),
        ([train], {"holdout": 0.95}, "between 0 and 0.9"),
        ([train], {"initial": "warm"}, "unknown initial state 'warm'"),
        ([turned], {}, "turned.csv: the displacement falls where the voltage rises.* the other way round"),
        ([exchanged], {}, "exchanged.csv: the displacement runs ahead of the voltage"),
        ([train[:40]], {}, "50 are needed"),
    ]:
        with pytest.raises(fits.DataError, match=words):
            fits.fit(bad, **options)


def test_single_precision_is_refused(bench):
    train, _ = records(bench)
    with jax.enable_x64(False), pytest.raises(RuntimeError, match="float64"):
        fits.fit([train])


def test_a_solver_that_runs_out_of_steps_gives_no_answer(bench, monkeypatch):
    train, _ = records(bench)
    monkeypatch.setattr("fits.loop._shapes._STEPS", 1)
    monkeypatch.setattr("fits.loop._shapes._TIMES", 1)
    with pytest.raises(fits.FitError, match="the cost still falls") as caught:
        # A number of levels of its own: what is compiled here must not be met again.
        fits.fit([train], family="mixture", levels=9, starts=1, initial="negative")
    assert caught.value.status is fits.FitStatus.NOT_STATIONARY


def test_remarks_name_what_the_record_cannot_teach():
    t = np.arange(400) * 0.05
    voltage = 60 - 60 * np.cos(2 * np.pi * t / 5)
    record = fits.Record(t, voltage, 0.3 * voltage - 2 * np.sin(2 * np.pi * t / 5 + 0.1), source="major.csv")
    found = fits.fit([record], levels=LEVELS, holdout=0.0)
    assert any("no loop smaller than the full range" in remark for remark in found.remarks)
