"""Identification in the frequency domain, against state matrices and SciPy; and the measured mirror where at hand."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from _frequency_reference import multisine, response, state_space
from _measured import measured
from _models import compiled
from _plant_reference import play_positions
from scipy.optimize import least_squares
from scipy.signal import StateSpace, lsim

import fits
import fits.stage._modal_fit
import microid as m

INTERVAL_s, SAMPLES = 1 / 2048, 1024
LINES = np.arange(10, 200)
FREQUENCY_Hz = LINES / (SAMPLES * INTERVAL_s)
DELAY_s = 3.3e-4


def plant(rng, coupled=True, outputs=2, inputs=2):
    """Two modes: frequencies, damping, gains, quadrature and residual, each drawn at random."""
    gain = rng.uniform(0.3, 1.0, (2, outputs, inputs)) * rng.choice([-1, 1], (2, outputs, inputs))
    quadrature = 0.1 * rng.standard_normal(gain.shape) * coupled
    frequency = np.array([rng.uniform(90, 120), rng.uniform(200, 260)])
    return frequency, rng.uniform(0.01, 0.03, 2), gain, quadrature, 0.2 * rng.standard_normal((outputs, inputs))


def noisy(rng, parts, size):
    """A measured response of known variance."""
    exact = response(FREQUENCY_Hz, *state_space(*parts), DELAY_s)
    variance = size**2 * rng.uniform(0.5, 2.0, exact.shape)
    noise = rng.standard_normal(exact.shape) + 1j * rng.standard_normal(exact.shape)
    return fits.ResponseData(FREQUENCY_Hz, exact + np.sqrt(variance / 2) * noise, variance)


def record(rng, parts, threshold_V=(), weight=(), realizations=5, noise=1e-3):
    """Steady state of the plant, under plays that are walked through sample by sample on a finer grid."""
    voltage = multisine(rng, SAMPLES, LINES, 1.0, realizations, 2)
    gain = response(np.fft.rfftfreq(SAMPLES, INTERVAL_s), *state_space(*parts), DELAY_s)
    drive = voltage.copy()
    fine = 8 * SAMPLES
    for r in range(realizations if len(threshold_V) else 0):
        for i in range(2):
            path = 8 * np.fft.irfft(np.fft.rfft(voltage[r, :, i]), fine)
            plays = play_positions(np.tile(path, 2), threshold_V, np.zeros(len(threshold_V)))[fine:]
            coarse = np.fft.irfft(np.fft.rfft(plays, axis=0)[: SAMPLES // 2 + 1], SAMPLES, axis=0) / 8
            drive[r, :, i] += coarse @ weight[i]
    moved = np.fft.irfft(np.einsum("fpm,rfm->rfp", gain, np.fft.rfft(drive, axis=1)), SAMPLES, axis=1)
    shown = moved[:, None] + noise * rng.standard_normal((realizations, 2, *moved.shape[1:]))
    return fits.Multisine(INTERVAL_s, np.repeat(voltage[:, None], 2, axis=1), shown)


@compiled
def walk(modes, interval_s, voltage_V, before_V):
    return tuple(modes(interval_s, voltage_V, before_V, hold) for hold in ("first", "zero"))


def test_modes_are_their_state_matrices(rng):
    parts = plant(rng, outputs=3)
    modes = m.Modes(*parts, DELAY_s)
    matrices = state_space(*parts)
    np.testing.assert_allclose(
        modes.frequency_response(FREQUENCY_Hz), response(FREQUENCY_Hz, *matrices, DELAY_s), rtol=1e-9
    )
    np.testing.assert_allclose(np.sort_complex(np.ravel(modes.poles_rad_per_s)[:2]).imag.sum(), 0, atol=1e-6)
    rates = np.linalg.eigvals(matrices[0])
    assert np.all(np.min(np.abs(np.ravel(modes.poles_rad_per_s)[:, None] - rates), axis=1) < 1e-6)
    np.testing.assert_allclose(modes.static_gain_um_per_V, response([0.0], *matrices, 0.0)[0].real, rtol=1e-9)


@pytest.mark.parametrize("late", [0.0, 2.0, 0.37, 3.6])
def test_sampled_voltages_give_what_lsim_gives(rng, late):
    parts, parts_of = plant(rng), 100
    modes, system = m.Modes(*parts, late * INTERVAL_s), StateSpace(*state_space(*parts))
    voltage = np.append(np.zeros((1, 2)), rng.standard_normal((60, 2)), axis=0)
    found = walk(modes, jnp.asarray(INTERVAL_s), jnp.asarray(voltage), jnp.zeros(2))
    at = np.arange(61)
    fine = np.arange(60 * parts_of + 1) / parts_of
    read = np.rint((at - late) * parts_of).astype(int)
    lines = np.stack([np.interp(fine, at, u) for u in voltage.T], axis=1)
    expected = lsim(system, lines, fine * INTERVAL_s)[1]
    np.testing.assert_allclose(found[0], np.where(read[:, None] >= 0, expected[np.maximum(read, 0)], 0), atol=1e-9)
    steps = voltage[np.floor(fine + 1e-9).astype(int)]
    inner = lsim(system, steps, fine * INTERVAL_s, interp=False)[1]
    np.testing.assert_allclose(found[1], np.where(read[:, None] >= 0, inner[np.maximum(read, 0)], 0), atol=1e-9)


def test_a_long_run_of_periods_becomes_the_periodic_response(rng):
    parts = plant(rng, coupled=False)
    modes = m.Modes(*parts)
    fine = 16 * 128
    voltage = multisine(rng, 128, np.arange(3, 20), 1.0, 1, 2)[0]
    path = 16 * np.fft.irfft(np.fft.rfft(voltage, axis=0), fine, axis=0)
    time_s = np.arange(60 * fine) * INTERVAL_s / 16
    expected = lsim(StateSpace(*state_space(*parts)), np.tile(path, (60, 1)), time_s)[1][-fine::16]
    np.testing.assert_allclose(
        modes.respond_periodically(jnp.asarray(voltage), INTERVAL_s), expected, atol=2e-3 * np.ptp(expected)
    )


@pytest.mark.parametrize("coupled", [pytest.param(False, marks=pytest.mark.study), True])
def test_modes_are_recovered_from_a_noisy_response(rng, coupled):
    parts = plant(rng, coupled)
    found = fits.fit_response(noisy(rng, parts, 1e-2), 2, coupled=coupled)
    order = np.argsort(found.model.natural_frequency_Hz)
    fitted = (found.model, found.sd)
    names = ("natural_frequency_Hz", "damping_ratio", "gain_um_per_V") + ("quadrature_um_per_V",) * coupled
    scores = [
        (getattr(fitted[0], n) - p[np.argsort(order)]) / getattr(fitted[1], n)
        for n, p in zip(names, parts, strict=False)
    ]
    scores += [(fitted[0].residual_um_per_V - parts[4]) / fitted[1].residual_um_per_V]
    scores += [(fitted[0].delay_s - DELAY_s) / fitted[1].delay_s]
    scores = np.concatenate([np.ravel(score) for score in scores])
    # Normal deviates: their mean square lies near one, and none is far out.
    assert np.max(np.abs(scores)) < 5.5
    assert 0.25 < np.sqrt(np.mean(scores**2)) < 2.2
    assert found.misfit == pytest.approx(1, abs=0.15)
    if not coupled:
        np.testing.assert_array_equal(found.model.quadrature_um_per_V, 0)
        np.testing.assert_array_equal(found.sd.quadrature_um_per_V, 0)


def test_covariance_is_that_of_scipy(rng):
    data = noisy(rng, plant(rng, coupled=False), 1e-2)
    found = fits.fit_response(data, 2)

    def residual(x):
        gain = x[4:12].reshape(2, 2, 2)
        ratio = FREQUENCY_Hz[:, None] / x[:2]
        mode = 1 / (1 - ratio**2 + 2j * x[2:4] * ratio)
        late = np.exp(-2j * np.pi * FREQUENCY_Hz * x[16])[:, None, None]
        response = late * (np.einsum("fk,kpm->fpm", mode, gain) + x[12:16].reshape(2, 2))
        off = (response - data.response_um_per_V) / np.sqrt(data.variance_um2_per_V2 / 2)
        return np.concatenate([off.real.ravel(), off.imag.ravel()])

    fitted = ("natural_frequency_Hz", "damping_ratio", "gain_um_per_V", "residual_um_per_V", "delay_s")
    ours = np.concatenate([np.ravel(getattr(found.model, name)) for name in fitted])
    sd = np.sqrt(np.diag(found.covariance))
    peer = least_squares(lambda x: residual(ours + sd * x), np.zeros(17), jac="3-point", xtol=1e-12, ftol=1e-12)
    np.testing.assert_array_less(np.abs(peer.x), 0.02)
    covariance = np.linalg.inv(peer.jac.T @ peer.jac) * max(1.0, found.misfit) ** 2
    np.testing.assert_allclose(covariance, found.covariance / np.outer(sd, sd), atol=1e-2)


def test_a_record_gives_its_response_and_its_variance(rng):
    parts = plant(rng)
    measured = record(rng, parts, realizations=12, noise=0.05)
    data = fits.estimate_response(measured)
    np.testing.assert_allclose(data.frequency_Hz, FREQUENCY_Hz, rtol=1e-12)
    off = np.abs(data.response_um_per_V - response(FREQUENCY_Hz, *state_space(*parts), DELAY_s)) ** 2
    # Nothing but noise, seen between realizations and between periods alike.
    assert np.mean(off / data.variance_um2_per_V2) == pytest.approx(1, rel=0.3)
    assert np.mean(off / data.noise_variance_um2_per_V2) == pytest.approx(1, rel=0.3)


def test_neighbouring_lines_are_fitted_together(rng):
    parts = plant(rng)
    # More noise than bias, which is left where the modes are sharp.
    measured = record(rng, parts, realizations=8, noise=20.0)
    learnt, tested = measured.take(slice(0, 5)), measured.take(slice(5, 8))
    data = fits.estimate_response(learnt, 3)
    off = np.abs(data.response_um_per_V - response(FREQUENCY_Hz, *state_space(*parts), DELAY_s)) ** 2
    assert np.mean(off / data.variance_um2_per_V2) == pytest.approx(1, rel=0.3)
    # One line by a plain regression on its own and the six around it.
    k = int(rng.integers(3, len(LINES) - 3))
    u, y = (
        np.fft.rfft(x.mean(axis=1), axis=1)[:, LINES[k - 3 : k + 4]]
        for x in (learnt.voltage_V, learnt.displacement_um)
    )
    away = np.tile(np.arange(-3, 4) / 3, 5)[:, None]
    columns = np.concatenate([u.reshape(-1, 2) * away**power for power in range(3)], axis=1)
    expected = np.linalg.lstsq(columns, y.reshape(-1, 2), rcond=None)[0][:2].T
    np.testing.assert_allclose(data.response_um_per_V[k], expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())
    alone, chosen = (fits.relative_error(fits.estimate_response(learnt, n), tested) for n in (0, None))
    assert chosen < alone
    with pytest.raises(fits.DataError, match="expected 0 to 94 neighbours for 190 lines, found 95"):
        fits.estimate_response(learnt, 95)


@pytest.mark.parametrize(("level_mV", "most"), [(100, 0.050), (300, 0.039)])
def test_the_measured_mirror_without_a_model(level_mV, most):
    path = measured(f"fsm_cubespec_{level_mV}mV_train.csv")
    record = fits.read_multisine(path)
    learnt, tested = record.take(slice(0, 4)), record.take(slice(4, 6))
    alone, together = (fits.relative_error(fits.estimate_response(learnt, n), tested) for n in (0, None))
    assert together < min(most, 0.8 * alone)


@pytest.mark.study
def test_plays_are_recovered_and_win_on_held_out_realizations(rng):
    threshold_V = np.array([0.3, 1.0])
    weight = rng.uniform(0.1, 0.4, (2, 2))
    parts = plant(rng, coupled=False)
    measured = record(rng, parts, threshold_V, weight)
    learnt, tested = measured.take(slice(0, 4)), measured.take(slice(4, 5))
    linear = fits.fit_response(fits.estimate_response(learnt), 2)
    found = fits.fit_hysteresis(learnt, linear, threshold_V)
    order = np.argsort(found.model.modes.natural_frequency_Hz)
    gain, sd = (
        np.asarray(modes.gain_um_per_V)[order].reshape(2, 2, 2, 3) for modes in (found.model.modes, found.sd.modes)
    )
    expected = parts[2][..., None] * np.append(np.ones((2, 1)), weight, axis=1)
    np.testing.assert_allclose(gain, expected, atol=0.02)
    assert np.max(np.abs(gain - expected) / sd) < 6
    assert fits.relative_error(found.model, tested) < 0.1 * fits.relative_error(linear.model, tested)


def write(path, change=lambda rows: rows, header="time_s,realization,period,u1_V,y1_um"):
    rows = [[k / 100, r, q, np.sin(k + r), np.cos(k)] for r in range(3) for q in range(2) for k in range(8)]
    for row in rows:
        row[0] += 0.08 * row[2]
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in change(rows))]))
    return path


def test_files_are_read_and_odd_ones_refused(tmp_path):
    read = fits.read_multisine(write(tmp_path / "good.csv"))
    assert read.voltage_V.shape == read.displacement_um.shape == (3, 2, 8, 1)
    assert read.interval_s == pytest.approx(0.01)
    assert read.displacement_um[2, 1, 3, 0] == pytest.approx(np.cos(3))
    for change, sentence in (
        (lambda rows: rows[:-1], "same periods of the same length"),
        (lambda rows: rows[8:] + rows[:8], "in order"),
        (lambda rows: [[row[0] ** 2, *row[1:]] for row in rows], "even time steps"),
    ):
        with pytest.raises(fits.DataError, match=sentence):
            fits.read_multisine(write(tmp_path / "odd.csv", change))
    with pytest.raises(fits.DataError, match="expected a column 'y1_um'"):
        fits.read_multisine(write(tmp_path / "odd.csv", header="time_s,realization,period,u1_V,w1_um"))


def test_data_that_say_too_little_are_refused(rng):
    parts = plant(rng)
    data, measured = noisy(rng, parts, 1e-2), record(rng, parts)
    with pytest.raises(fits.DataError, match="more realizations than its 2 inputs, found 2"):
        fits.estimate_response(measured.take(slice(0, 2)))
    same = np.repeat(measured.voltage_V[..., :1], 2, axis=-1)
    with pytest.raises(fits.DataError, match="independent over the realizations"):
        fits.estimate_response(fits.Multisine(INTERVAL_s, same, measured.displacement_um))
    with pytest.raises(fits.DataError, match="periodic voltages, found none that change"):
        fits.estimate_response(fits.Multisine(INTERVAL_s, 0 * measured.voltage_V, measured.displacement_um))
    with pytest.raises(fits.DataError, match="at least 10 lines for 2 modes between 50 and 52 Hz"):
        fits.fit_response(data, 2, (50, 52))
    with pytest.raises(fits.DataError, match="increase from 0 Hz"):
        fits.ResponseData(FREQUENCY_Hz[::-1], data.response_um_per_V)
    with pytest.raises(fits.DataError, match="finite values of shape"):
        fits.ResponseData(FREQUENCY_Hz, data.response_um_per_V[:, 0, 0])
    with pytest.raises(ValueError, match="expected shapes"):
        m.Modes(*parts[:3], parts[3][:, :1], parts[4])


def test_a_search_that_does_not_arrive_has_no_answer(rng, monkeypatch):
    slow = optx.RESULTS.nonlinear_max_steps_reached
    solve = fits.stage._modal_fit._solve
    data = noisy(rng, plant(rng, coupled=False), 1e-2)

    def stop_short(model, spectra):
        found, _ = solve(model, spectra)
        return eqx.tree_at(lambda modes: modes.damping_ratio, found, 1.1 * found.damping_ratio), slow

    monkeypatch.setattr("fits.stage._modal_fit._solve", stop_short)
    with pytest.raises(fits.FitError) as caught:
        fits.fit_response(data, 2)
    assert caught.value.status is fits.FitStatus.MAX_STEPS


@pytest.mark.study
def test_the_measured_mirror_held_out():
    path = measured("fsm_cubespec_100mV_train.csv")
    band_Hz = (760.0, 860.0)
    record = fits.read_multisine(path)
    learnt, tested = record.take(slice(0, 4)), record.take(slice(4, 6))
    linear = fits.fit_response(fits.estimate_response(learnt), 2, band_Hz, coupled=True)
    assert np.min(np.abs(linear.model.natural_frequency_Hz - 814.2)) < 1.5
    bent = fits.fit_hysteresis(learnt, linear, [0.03], band_Hz, coupled=True)
    errors = [fits.relative_error(model, tested, band_Hz) for model in (linear.model, bent.model)]
    assert errors[1] < 0.97 * errors[0] < 0.06
