"""The parts of a diagnosis, each against something plainer: dense least squares, known noise, planted faults."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from fits import Record
from fits.diagnosis._discrepancy import learn_roughness, with_discrepancy
from fits.diagnosis._effects import drop_programs
from fits.diagnosis._projector import Projector
from fits.diagnosis._score import Family, Probe, score
from fits.io._kept import kept
from fits.stats._band import band_of
from fits.stats._compare import surprise
from fits.stats._noise import Noise, learn_noise
from microid.effects import EFFECTS

WHITE = np.zeros(0)


def regression(rng, lengths=(300, 400), columns=12, coordinates=3, kinds=2):
    """Random derivatives of two runs, as a linearised stage would have them."""
    prior = np.eye(columns) * 0.3
    baseline = SimpleNamespace(
        chain=SimpleNamespace(size=columns), columns_um=rng.standard_normal(columns), prior=prior
    )
    return SimpleNamespace(
        baseline=baseline,
        masks=tuple(np.arange(n) >= 20 for n in lengths),
        rows=tuple(rng.standard_normal((n, columns + coordinates)) for n in lengths),
        nuisance=tuple(np.ones((n, 1)) for n in lengths),
        finer=tuple(tuple(rng.standard_normal((n, 5)) for n in lengths) for _ in range(kinds)),
        residuals=tuple(rng.standard_normal(n) for n in lengths),
        root=np.linalg.cholesky(prior).T,
        size=columns + coordinates,
    )


def test_the_projection_is_generalised_least_squares(rng):
    # The same as conditioning on all unknowns with their priors, the noise coloured: by dense covariances.
    reg = regression(rng)
    noise = [Noise(0.5, np.array([0.6])), Noise(2.0, WHITE)]
    sizes = (0.7, 0.2)
    projector = Projector(reg, noise, sizes)
    signal = [rng.standard_normal(len(r)) for r in reg.residuals]
    found = projector.off(projector.join(signal))
    other = projector.off(projector.join([rng.standard_normal(len(r)) for r in reg.residuals]))
    # Dense: whitening matrices, a flat prior on coordinates and offsets, Gaussian ones on the others.
    white = []
    for one, n, mask in zip(noise, (300, 400), reg.masks, strict=True):
        matrix = np.eye(n)
        for k, past in enumerate(one.past, 1):
            matrix -= past * np.eye(n, k=-k)
        white.append((matrix / one.innovation_um)[mask])
    total = sum(len(w) for w in white)
    design, prior = [], []
    for c in range(15):
        design.append(np.concatenate([w @ rows[:, c] for w, rows in zip(white, reg.rows, strict=True)]))
        prior.append(0.3 if c < 12 else 0.0)
    for kind, size in zip(reg.finer, sizes, strict=True):
        for c in range(5):
            design.append(np.concatenate([w @ rows[:, c] for w, rows in zip(white, kind, strict=True)]))
            prior.append(1 / size**2)
    for k in range(2):
        design.append(
            np.concatenate([w @ o[:, 0] * (i == k) for i, (w, o) in enumerate(zip(white, reg.nuisance, strict=True))])
        )
        prior.append(0.0)
    design = np.stack(design, axis=1)
    precision = np.eye(total) - design @ np.linalg.solve(design.T @ design + np.diag(prior), design.T)
    target = np.concatenate([w @ s for w, s in zip(white, signal, strict=True)])
    np.testing.assert_allclose(found @ found, target @ precision @ target, rtol=1e-9)
    np.testing.assert_allclose(projector.off(found), found, atol=1e-10)
    assert abs(found @ other) <= np.linalg.norm(found) * np.linalg.norm(other)
    # What is open of other samples is by the covariance of all unknowns.
    rows, covariance = rng.standard_normal((7, 15)), np.linalg.inv(design.T @ design + np.diag(prior))[:15, :15]
    open_um2 = np.einsum("ij,jk,ik->i", rows, covariance, rows)
    np.testing.assert_allclose(projector.variance_um2(rows), open_um2, rtol=1e-7)
    # What follows a signal, but for the runs' own parameters, are the unknowns at their best.
    best, kinds = np.linalg.solve(design.T @ design + np.diag(prior), design.T @ target), (reg.rows, *reg.finer)
    expected = [np.concatenate([kind[k] for kind in kinds], axis=1) @ best[:-2] for k in range(2)]
    np.testing.assert_allclose(
        np.concatenate(projector.follow(projector.join(signal))), np.concatenate(expected), rtol=1e-7
    )


def test_columns_that_are_pressed_below_zero_stay_there(rng):
    # Against least squares with one zero column at a time beside those that are above zero.
    reg = regression(rng, kinds=0)
    reg.baseline.columns_um = np.where(np.arange(12) < 6, 0.0, 1.0)
    reg.root = 1e-6 * np.eye(12)
    noise = [Noise(1.0, WHITE), Noise(1.0, WHITE)]
    push = np.array([-0.6, 0.6, -0.3, -0.03, 0.0, 0.0])
    reg.residuals = tuple(one + rows[:, :6] @ push for one, rows in zip(reg.residuals, reg.rows, strict=True))
    found = Projector(reg, noise).bounded()
    run = np.repeat([0, 1], [280, 380])
    rows = np.concatenate([r[20:] for r in reg.rows])
    others = np.concatenate([rows[:, 6:], run[:, None] == [0, 1]], axis=1)
    target = np.concatenate([r[20:] for r in reg.residuals])
    pressed = []
    for k in range(6):
        design = np.concatenate([rows[:, k : k + 1], others], axis=1)
        best = np.linalg.lstsq(design, target, rcond=None)[0][0]
        pressed.append(best / np.sqrt(np.linalg.inv(design.T @ design)[0, 0]) < -3)
    assert pressed[0]
    assert not pressed[1]
    assert found.held.tolist() == [*pressed, *[False] * 6]
    # What they alone make is followed no more, but for what the others have in common with it by chance.
    signal = [r[:, 0] for r in reg.rows]
    off = found.off(found.join(signal))
    assert np.linalg.norm(off) > 0.9 * np.linalg.norm(found.join(signal))
    assert Projector(reg, noise).off(found.join(signal)) == pytest.approx(0, abs=1e-4)
    # Effects that make all of it leave nothing that presses.
    change = [rows[:, :6] @ push for rows in reg.rows]
    assert found.bounded(change).held.sum() <= 1


def probe(signatures, positive=False):
    effect = next(form for form in EFFECTS if form.name == "thermal_drift")
    return Probe((SimpleNamespace(name=effect.name, finite=False),), tuple(signatures), positive)


def test_scores_are_standard_normal_where_there_is_nothing(rng):
    reg = regression(rng)
    noise = [Noise(1.0, WHITE), Noise(1.0, WHITE)]
    reg.baseline.columns_um = np.zeros(12)
    one = probe([[rng.standard_normal(n) for n in (300, 400)]])
    draws = []
    for _ in range(200):
        reg.residuals = tuple(rng.standard_normal(n) for n in (300, 400))
        projector = Projector(reg, noise)
        (found,) = score(projector, [one], projector.off(projector.residual)).each
        draws.append(found.z * np.sign(found.coefficients[0]))
    assert stats.kstest(draws, "norm").pvalue > 1e-4


def test_family_wise_probabilities_are_uniform_where_there_is_nothing(rng):
    reg = regression(rng)
    reg.baseline.columns_um = np.zeros(12)
    noise = [Noise(1.0, WHITE), Noise(1.0, WHITE)]
    probes = [probe([[rng.standard_normal(n) for n in (300, 400)]], positive=k % 2 == 0) for k in range(8)]
    # One that has died away, as where a run begins long after what it comes from: its square is nothing.
    sizes = (1.0, 1.0, 1.0, 1e-200)
    probes.append(probe([[size * rng.standard_normal(n) for n in (300, 400)] for size in sizes]))
    found = []
    for _ in range(150):
        reg.residuals = tuple(rng.standard_normal(n) for n in (300, 400))
        projector = Projector(reg, noise)
        residual = projector.off(projector.residual)
        scored = score(projector, probes, residual)
        found.append(Family(scored, rng).p(max(one.z for one in scored.each)))
    # One-sided tests that are all below zero give a probability of one.
    assert stats.binomtest(int(np.sum(np.array(found) < 0.05)), len(found), 0.05).pvalue > 1e-4
    assert stats.binomtest(int(np.sum(np.array(found) < 0.3)), len(found), 0.3).pvalue > 1e-4


@pytest.mark.parametrize("past", [(), (0.7,), (1.2, -0.5)])
def test_noise_is_learnt(rng, past):
    n = 20_000
    noise = lfilter([1.0], np.r_[1.0, -np.array(past)], 0.03 * rng.standard_normal(n))
    found = learn_noise(noise, 10.0)
    assert found.innovation_um == pytest.approx(0.03, rel=0.03)
    assert found.total_um == pytest.approx(float(np.std(noise)), rel=0.08)
    white = found.whiten(noise)[20:]
    assert abs(np.mean(white[1:] * white[:-1])) < 5 / n**0.5


def test_roughness_is_learnt_only_where_it_is(rng):
    reg = regression(rng)
    noise = [Noise(1.0, WHITE), Noise(1.0, WHITE)]
    assert max(learn_roughness(Projector(reg, noise), [])) < 0.15
    bend = rng.standard_normal(5)
    bend *= 0.4 / np.sqrt(np.mean(bend**2))
    reg.residuals = tuple(r + kind @ bend for r, kind in zip(reg.residuals, reg.finer[0], strict=True))
    first, _ = learn_roughness(Projector(reg, noise), [])
    assert 0.15 < first <= 0.5


def test_discrepancy_is_what_no_candidate_explains(rng):
    reg = regression(rng)
    noise = [Noise(1.0, WHITE), Noise(1.0, WHITE)]
    candidate = [5 * np.sin(np.arange(len(r)) / 7) for r in reg.residuals]
    reg.residuals = tuple(r + 3 * own for r, own in zip(reg.residuals, candidate, strict=True))
    # Alone it is unexplained; as a candidate it is an effect, and what is left is the sensor's noise.
    alone, explained = (with_discrepancy(Projector(reg, noise), some) for some in ([], [candidate]))
    assert min(one.total_um for one in alone) > 5
    assert max(one.total_um for one in explained) < 1.2
    # What changes it is taken off before.
    change = [3 * own for own in candidate]
    assert max(one.total_um for one in with_discrepancy(Projector(reg, noise), [], change)) < 1.2
    # It is never less than the noise, and as coloured as it is.
    more = [lfilter([1.0], [1.0, -0.9], 2 * rng.standard_normal(len(r))) for r in reg.residuals]
    reg.residuals = tuple(rng.standard_normal(len(one)) + one for one in more)
    coloured = with_discrepancy(Projector(reg, noise), [])
    for found, one in zip(coloured, more, strict=True):
        assert found.total_um == pytest.approx(np.hypot(np.std(one), 1.0), rel=0.3)
        assert found.correlation_samples > 3


def test_noise_behind_noise_is_whitened_by_both(rng):
    first, second = Noise(0.5, np.array([0.6])), Noise(3.0, np.array([-0.3, 0.2]))
    values = rng.standard_normal(500)
    np.testing.assert_allclose(first.followed_by(second).whiten(values), second.whiten(first.whiten(values)))


def narrow(rng, frequency_Hz, quality, rate_Hz, n):
    """Noise through a resonance, of standard deviation one."""
    radius = np.exp(-np.pi * frequency_Hz / quality / rate_Hz)
    past = [2 * radius * np.cos(2 * np.pi * frequency_Hz / rate_Hz), -(radius**2)]
    wave = lfilter([1.0], [1.0, -past[0], -past[1]], rng.standard_normal(n + 5000))[5000:]
    return wave / np.std(wave)


def test_a_narrow_band_is_found(rng):
    n, rate = 20_000, 500.0
    voltage = 50 + 50 * np.sin(2 * np.pi * 0.05 * np.arange(n) / rate)
    white = 0.05 * rng.standard_normal(n)
    frequency = rng.uniform(8, 45)
    found = band_of(white + 0.1 * narrow(rng, frequency, 20, rate, n), 1 / rate, voltage)
    assert found.z > 8
    assert found.frequency_Hz == pytest.approx(frequency, rel=0.1)
    assert found.size_um == pytest.approx(0.1, rel=0.35)


@pytest.mark.parametrize("past", [[], [0.5], [0.9], [0.97], [0.8, 0.1]])
def test_the_colour_of_a_sensor_is_no_narrow_band_and_hides_none(rng, past):
    n, rate = 20_000, 1000.0
    voltage = 50 + 50 * np.sin(2 * np.pi * 0.3 * np.arange(n) / rate)
    noise = lfilter([1.0], [1.0, *(-one for one in past)], rng.standard_normal(n + 500))[500:]
    quiet = band_of(noise, 1 / rate, voltage)
    assert quiet.z < 8 or not quiet.narrow
    frequency = rng.uniform(8, 45)
    found = band_of(noise + 3 * noise.std() * narrow(rng, frequency, 10, rate, n), 1 / rate, voltage)
    assert found.z > 8
    assert found.frequency_Hz == pytest.approx(frequency, rel=0.1)
    assert 3 < found.quality < 50


@pytest.mark.parametrize(
    ("samples", "interval_s"), [(3000, 1.0), (3000, 0.2), (10, 1e-3), (40, 1e-3), (300, 1e-5), (3, 0.1)]
)
def test_records_too_slow_or_too_short_show_no_band(rng, samples, interval_s):
    assert band_of(rng.standard_normal(samples), interval_s, np.arange(1.0 * samples)).z == 0
    assert band_of(np.zeros(samples), interval_s, np.arange(1.0 * samples)).z == 0


def test_a_band_of_many_weak_bins_is_found_and_is_no_hum(rng):
    n, rate = 3600, 64.0
    voltage = 50 + 50 * np.sin(2 * np.pi * 0.05 * np.arange(n) / rate)
    # Sampling makes 8 Hz of the second harmonic of 60 Hz.
    found = band_of(
        0.05 * rng.standard_normal(n) + 0.1 * narrow(rng, 8 + rng.uniform(-1, 1), 10, rate, n), 1 / rate, voltage
    )
    assert found.z > 8
    assert not found.mains
    assert found.frequency_Hz == pytest.approx(8, rel=0.25)
    assert found.size_um == pytest.approx(0.1, rel=0.35)
    hum = np.cos(2 * np.pi * 120 * np.arange(n) / rate + rng.uniform(0, 6))
    assert band_of(0.05 * rng.standard_normal(n) + 0.1 * hum, 1 / rate, voltage).mains


def test_what_is_no_vibration_is_no_narrow_band(rng):
    n, rate = 20_000, 500.0
    time = np.arange(n) / rate
    voltage = 50 + 50 * np.sin(2 * np.pi * 0.05 * time)
    white = 0.05 * rng.standard_normal(n)
    assert band_of(white, 1 / rate, voltage).z < 8
    # Part of a chirp, and a multiple of what the command plays.
    passing = 0.5 * np.sin(2 * np.pi * 20 * time) * np.exp(-np.minimum(((time - 20) / 1.5) ** 2, 50))
    assert band_of(white + passing, 1 / rate, voltage).z < 8
    # A band of noise that fades, as what the model misses of a loop that does.
    fading = narrow(rng, 20, 10, rate, n) * np.exp(-time / 3)
    assert band_of(white + 0.5 * fading, 1 / rate, voltage).z < 8
    loops = 50 + 50 * np.sin(2 * np.pi * 5 * time)
    found = band_of(white + 0.3 * np.sin(2 * np.pi * 15 * time), 1 / rate, loops)
    assert found.z < 8 or found.played


def test_evidence_beside_a_misfit_is_worth_less(rng):
    # The same signal in white noise, and in steps that have nothing to do with it.
    n = 4000
    reg = regression(rng, lengths=(n,), kinds=1)
    shape = np.cumsum(rng.standard_normal(n))
    shape = (shape - shape.mean()) / shape.std()
    steps = np.repeat(rng.normal(0, 5, n // 200), 200)
    steps -= shape * (shape @ steps) / (shape @ shape)
    for left, trusted in ((rng.standard_normal(n), True), (rng.standard_normal(n) + steps, False)):
        reg.residuals = (left + 0.5 * shape,)
        projector = Projector(reg, [Noise(1.0, WHITE)])
        (found,) = score(projector, [probe([(shape,)])], projector.off(projector.residual)).each
        assert found.z > 4
        assert (found.robust_z > 0.6 * found.z) == trusted


def test_programs_make_room_where_records_are_long():
    hosts = []

    @jax.jit
    def host(x):
        hosts.append(1)
        return x + 1

    @kept
    def part(x):
        traced.append(1)
        return x

    traced: list[int] = []

    def traces_after(n):
        drop_programs([Record(np.arange(float(n)), np.zeros(n), np.zeros(n), source="run")] * 2)
        part(jnp.ones(7))
        host(jnp.ones(3))
        return len(traced), len(hosts)

    assert traces_after(1000) == (1, 1)
    assert traces_after(1000) == (1, 1)
    assert traces_after(10_000) == (2, 2)


def test_a_signal_without_columns_is_whitened(rng):
    noise = Noise(0.1, np.array([0.5]))
    assert noise.whiten(np.zeros((20, 0))).shape == (20, 0)


def test_errors_are_as_improbable_as_their_noise_says(rng):
    # An AR(1), whose inverse covariance comes from its autocovariances.
    held = [SimpleNamespace(held_out=np.arange(5000) >= at) for at in (1000, 3000)]
    noise = Noise(0.3, WHITE), Noise(0.3, np.array([0.7]))
    white = rng.standard_normal(4000)
    coloured = lfilter([(1 - 0.7**2) ** 0.5], [1.0, -0.7], rng.standard_normal(2500))[500:]
    case = SimpleNamespace(regression=SimpleNamespace(baseline=SimpleNamespace(runs=held)), noise=noise)
    expected = white @ white + coloured @ solve_toeplitz(0.7 ** np.arange(2000), coloured)
    assert Projector.surprise(case, np.r_[white, coloured]) == pytest.approx(expected, rel=0.03)


def test_a_slow_error_counts_by_its_waves_and_not_by_its_samples(rng):
    noise, errors = Noise(1.0, WHITE), rng.standard_normal(2000)
    wave = 10 * np.sin(np.linspace(0, 9, 2000))
    assert 5 < surprise(errors + wave, noise) - surprise(errors, noise) < 0.005 * (wave @ wave)
    # One that is as large at all frequencies counts with all of them.
    louder = 2000 * np.log(4)
    assert surprise(2 * errors, noise) - surprise(errors, noise) == pytest.approx(louder, rel=0.1)
