"""What a fit says of its own uncertainty, against SciPy and against fresh noise."""

import jax.numpy as jnp
import numpy as np
import pytest
from _stage_records import linear_displacement, linear_record
from scipy import stats
from scipy.optimize import curve_fit, least_squares

import fits
from microid import Driver, Mechanics, Piezo, Stage

TRUTH = {
    "time_constant_s": 6e-4,
    "natural_frequency_Hz": 210.0,
    "damping_ratio": 0.03,
    "gain_um_per_V": 0.31,
}
NAMES = ("driver.time_constant_s", "mechanics.natural_frequency_Hz", "mechanics.damping_ratio", "piezo.gain_um_per_V")


def linear_stage():
    stage = Stage.of(
        driver=Driver(jnp.asarray(1e-2)),
        piezo=Piezo(jnp.asarray(1.0)),
        mechanics=Mechanics(jnp.asarray(10.0), jnp.asarray(0.5)),
    )
    return stage.freeze("driver.gain", "mechanics.gain")


def fit_linear(record, **settings):
    return fits.fit_stage([record], stage=linear_stage(), holdout=0.0, **settings)


def test_estimates_and_standard_deviations_are_those_of_curve_fit(rng):
    record = linear_record(rng, TRUTH)

    def model(time, *values):
        return linear_displacement(time, record.voltage_V, *values[:4]) + values[4]

    start = [value * 1.02 for value in TRUTH.values()] + [2.9]
    scale = np.array([1e-4, 1.0, 1e-2, 0.1, 1.0])
    best, covariance = curve_fit(
        lambda t, *x: model(t, *(np.array(x) * scale)), record.time_s, record.displacement_um, np.array(start) / scale
    )
    result = fit_linear(record, initial="negative")
    for name, value, sd in zip(NAMES, best * scale, np.sqrt(np.diag(covariance)) * scale, strict=False):
        assert result[name].value == pytest.approx(value, abs=0.02 * sd)
        assert result[name].sd == pytest.approx(sd, rel=0.1)
        assert result[name].lower == pytest.approx(value - 1.96 * sd, abs=0.25 * sd)
        assert result[name].upper == pytest.approx(value + 1.96 * sd, abs=0.25 * sd)
    correlation = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    order = [NAMES.index(parameter.name) for parameter in result.parameters]
    np.testing.assert_allclose(result.correlation, correlation[np.ix_(order, order)], atol=0.1)


@pytest.mark.study
@pytest.mark.parametrize("pole", [0.0, 0.8], ids=["white", "coloured"])
def test_intervals_hold_the_truth_as_often_as_they_say(rng, pole):
    fits_made, z = 40, []
    for _ in range(fits_made):
        result = fit_linear(linear_record(rng, TRUTH, pole=pole), initial="unknown")
        z.append([(result[n].value - v) / result[n].sd for n, v in zip(NAMES, TRUTH.values(), strict=True)])
    z = np.array(z)
    print("rms of (estimate - truth) / sd", np.sqrt(np.mean(z**2, axis=0)), "inside 95 %", np.mean(np.abs(z) < 1.96))
    # Each parameter's mean square is a chi-square, wrong by chance once in ten thousand studies.
    low, high = stats.chi2.ppf([5e-5, 1 - 5e-5], fits_made) / fits_made
    assert np.all(np.mean(z**2, axis=0) < high * 1.25)
    assert np.all(np.mean(z**2, axis=0) > low / 1.25)


def test_the_state_before_a_run_is_not_assumed(rng):
    record = linear_record(rng, TRUTH)
    # Cut in the middle of its motion.
    later = record[777:]
    result = fit_linear(later, initial="unknown")
    for name, value in zip(NAMES, TRUTH.values(), strict=True):
        assert abs(result[name].value - value) < 5 * result[name].sd
    assert result.runs[0].noise_um == pytest.approx(0.02, rel=0.1)


def test_outliers_count_less_under_the_huber_loss(rng):
    record = linear_record(rng, TRUTH)
    spikes = np.where(rng.random(len(record)) < 0.03, rng.choice([-1.0, 1.0], len(record)) * 2.0, 0.0)
    spoiled = fits.Record(record.time_s, record.voltage_V, record.displacement_um + spikes, source="spikes.csv")
    plain, robust = fit_linear(spoiled), fit_linear(spoiled, loss="huber")
    for name, value in zip(NAMES, TRUTH.values(), strict=True):
        assert abs(robust[name].value - value) < 5 * robust[name].sd
        assert robust[name].sd < 0.5 * plain[name].sd


def test_combinations_that_are_not_seen_are_named(rng):
    record = linear_record(rng, TRUTH)
    result = fits.fit_stage([record], stage=linear_stage().thaw("mechanics.gain"), holdout=0.0)
    pairs = ("mechanics.gain * piezo.gain_um_per_V", "piezo.gain_um_per_V * mechanics.gain")
    assert len(result.unseen) == 1
    assert result.unseen[0] in [f"only {pair} is seen, not each" for pair in pairs]
    assert set(result.unseen) <= set(result.remarks)
    # Each by itself is unknown, and says so.
    assert all(result[name].sd > result[name].value for name in ("mechanics.gain", "piezo.gain_um_per_V"))
    # What is seen is not spoiled by what is not.
    frequency = result["mechanics.natural_frequency_Hz"]
    assert abs(frequency.value - TRUTH["natural_frequency_Hz"]) < 5 * frequency.sd < 1.0
    # The product is as certain as if there were one gain.
    product = result["mechanics.gain"].value * result["piezo.gain_um_per_V"].value
    assert product == pytest.approx(TRUTH["gain_um_per_V"], rel=1e-2)
    assert fit_linear(record).unseen == ()


@pytest.mark.parametrize("damping_ratio", [0.01, 0.2, 1.4])
def test_no_guess_is_needed(rng, damping_ratio):
    truth = TRUTH | {
        "natural_frequency_Hz": float(rng.uniform(60, 600)),
        "damping_ratio": damping_ratio,
        "time_constant_s": float(10 ** rng.uniform(-4, -2.7)),
    }
    record = linear_record(rng, truth, rate_Hz=12 * truth["natural_frequency_Hz"], noise_um=0.005)
    result = fit_linear(record)
    clean = linear_displacement(record.time_s, record.voltage_V, **truth)
    predicted = np.asarray(result.model(jnp.asarray(record.time_s), jnp.asarray(record.voltage_V)))
    assert np.std(predicted - clean) < 0.005
    if damping_ratio < 1:
        # Beyond it three real poles can change places.
        assert abs(result[NAMES[1]].value - truth["natural_frequency_Hz"]) < 6 * result[NAMES[1]].sd


@pytest.mark.study
def test_a_profile_is_that_of_scipy_with_one_parameter_held(rng):
    # Hardly seen beside the delay of the mechanics, so that its profile is no parabola.
    truth = TRUTH | {"time_constant_s": 2e-5}
    record = linear_record(rng, truth, n=1500, noise_um=0.3)
    result = fit_linear(record, initial="negative")
    profile = fits.profile_stage(result, [record], NAMES[0], points=5, holdout=0.0, initial="negative")
    scale = np.array([1.0, 1e-2, 0.1, 1.0])

    def least(tau):
        def residual(x):
            frequency, damping, gain, offset = x * scale
            model = linear_displacement(record.time_s, record.voltage_V, tau, frequency, damping, gain) + offset
            return model - record.displacement_um

        start = np.array([truth["natural_frequency_Hz"], truth["damping_ratio"], truth["gain_um_per_V"], 3.0])
        return 2 * least_squares(residual, start / scale, xtol=1e-12, ftol=1e-12).cost

    costs = np.array([least(tau) for tau in profile.values])
    best = least(result[NAMES[0]].value)
    expected = (costs - best) / result.runs[0].noise_um ** 2 / result.runs[0].correlation_samples
    np.testing.assert_allclose(profile.deviance, expected, rtol=0.02, atol=0.02)
    assert profile.values[0] > 0
    assert profile.lower <= result[NAMES[0]].value <= profile.upper
    with pytest.raises(fits.DataError, match=r"no single parameter 'driver.gain' .* choose one of driver"):
        fits.profile_stage(result, [record], "driver.gain")


def test_the_posterior_is_as_wide_as_the_standard_deviations_say(rng, seed):
    pytest.importorskip("numpyro", reason="numpyro is not installed: pip install '.[posterior]'")
    record = linear_record(rng, TRUTH, n=800)
    result = fit_linear(record, initial="negative")
    drawn = fits.sample_posterior(result, [record], draws=600, seed=seed, holdout=0.0, initial="negative")
    assert drawn.divergences < 15
    for name, values in zip(drawn.names, drawn.values.T, strict=True):
        # Hundreds of draws that hardly depend on each other: 3 % of the deviation, five times over.
        assert np.std(values) == pytest.approx(result[name].sd, rel=0.25)
        assert np.mean(values) == pytest.approx(result[name].value, abs=0.2 * result[name].sd)
