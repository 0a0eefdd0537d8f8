"""What is read off a residual: structure, irregular noise, faults of samples, and how smooth the density is."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter
from test_diagnosis_parts import WHITE, regression
from test_diagnosis_tangent import baseline_of

from fits import Record
from fits.diagnosis import _misfit
from fits.diagnosis._discrepancy import smoothed
from fits.diagnosis._explanation import Selection
from fits.diagnosis._noise import Faults, find_faults, name_faults
from fits.diagnosis._projector import Projector
from fits.diagnosis._regression import Regression
from fits.diagnosis._residual_tests import (
    Regressors,
    _bands,
    explain,
    explain_together,
    irregular,
    period_of,
    repeats_in,
    run_regressors,
)
from fits.diagnosis._thresholds import THRESHOLDS
from fits.stats._band import Band
from fits.stats._cycles import Cycles
from fits.stats._noise import Noise


def run_of(voltage_V, displacement_um, rate_Hz=1000.0):
    time_s = np.arange(len(voltage_V)) / rate_Hz
    record = Record(time_s, voltage_V, displacement_um)
    fitted = np.ones(len(voltage_V), dtype=bool)
    return SimpleNamespace(record=record, displacement_um=displacement_um, fitted=fitted, rate_Hz=rate_Hz)


def plain_projector(lengths=(600, 800)):
    """A projector that takes nothing off, of white noise of one."""
    masks = tuple(np.ones(n, dtype=bool) for n in lengths)
    stops = np.cumsum(lengths)[:-1]
    return SimpleNamespace(
        masks=masks, off=lambda joined: joined, join=np.concatenate, split=lambda joined: np.split(joined, stops)
    )


def test_regressors_explain_what_least_squares_does(rng):
    lengths = (600, 800)
    columns = [[rng.standard_normal(n) for n in lengths] for _ in range(5)]
    # One that the others make up adds nothing.
    columns.append([a + b for a, b in zip(columns[0], columns[1], strict=True)])
    known = np.linalg.qr(rng.standard_normal((sum(lengths), 2)))[0]
    residual = rng.standard_normal(sum(lengths)) + 0.2 * np.concatenate(columns[2])
    residual -= known @ (known.T @ residual)
    view = Regressors("any", tuple(map(tuple, columns)), "")
    (seen,) = explain(plain_projector(lengths), known, residual, [view])
    design = np.column_stack([*(np.concatenate(column) for column in columns), known])
    left = residual - design @ np.linalg.lstsq(design, residual, rcond=None)[0]
    assert seen.drop == pytest.approx(residual @ residual - left @ left, rel=1e-9)
    assert (seen.freedom, seen.p) == (5, pytest.approx(stats.chi2.sf(seen.drop, 5)))
    both = explain_together(
        plain_projector(lengths),
        known,
        residual,
        [Regressors("a", view.columns[:3], ""), Regressors("b", view.columns[3:], "")],
    )
    assert both == (pytest.approx(seen.drop), 5)


def test_probabilities_of_structure_are_uniform_where_there_is_none(rng):
    lengths = (600, 800)
    view = Regressors("any", tuple(tuple(rng.standard_normal(n) for n in lengths) for _ in range(6)), "")
    none = np.zeros((sum(lengths), 0))
    found = [
        explain(plain_projector(lengths), none, rng.standard_normal(sum(lengths)), [view])[0].p for _ in range(300)
    ]
    assert stats.kstest(found, "uniform").pvalue > 1e-4


def played(rng, n=4000):
    """A run between random turning points, so that where it is says little of how long ago it turned."""
    levels_V = np.where(np.arange(40) % 2, rng.uniform(55, 100, 40), rng.uniform(0, 45, 40))
    # Each way has a rate of its own.
    begun_s = np.r_[0, np.cumsum(np.abs(np.diff(levels_V)) * rng.uniform(0.2, 1.0, 39))]
    time_s = np.arange(n) / 100
    voltage_V = np.interp(np.linspace(0, begun_s[-1], n), begun_s, levels_V)
    return SimpleNamespace(record=Record(time_s, voltage_V, voltage_V / 5)), voltage_V / 5


@pytest.mark.parametrize("name", ["time", "position", "velocity", "reversal", "jumps", "gain"])
def test_each_view_sees_its_own_structure(rng, name):
    run, plain_um = played(rng)
    time_s, place = run.record.time_s, plain_um / np.ptp(plain_um)
    turns = np.flatnonzero(np.diff(np.sign(np.diff(run.record.voltage_V)))) + 1
    begun = np.r_[0, turns][np.searchsorted(np.r_[0, turns], np.arange(len(time_s)), side="right") - 1]
    structure = {
        "time": np.cos(np.pi * 3 * time_s / time_s[-1]),
        "position": np.cos(np.pi * 4 * place),
        "velocity": np.gradient(plain_um, time_s) * np.cos(2 * np.pi * place),
        "reversal": np.sign(np.gradient(run.record.voltage_V)) * np.log10(1 + (time_s - time_s[begun]) / 0.1),
        "jumps": (np.arange(len(time_s)) >= len(time_s) * 7 // 24).astype(float),
        "gain": place * np.cos(np.pi * 5 * time_s / time_s[-1]),
    }[name]
    residual = structure / np.std(structure) + 0.5 * rng.standard_normal(len(time_s))
    (way,) = (one for one in run_regressors([run], [plain_um]) if one.name == name)
    nothing = np.zeros((len(time_s), 0))
    (seen,), (other,) = (
        explain(plain_projector((len(time_s),)), nothing, values, [way])
        for values in (residual, rng.standard_normal(len(time_s)))
    )
    assert seen.drop > 0.5 * len(time_s)
    assert other.p > 1e-5


def test_bands_follow_a_filter_of_the_command(rng):
    turn = 2 * np.pi * np.arange(3000) / 3000
    voltage_V = sum(np.cos(k * turn + rng.uniform(0, 6)) for k in (20, 70, 200, 600))
    design = np.stack(_bands(voltage_V), axis=1)
    changed = lfilter([0.3], [1, -0.7], voltage_V)
    left = changed - design @ np.linalg.lstsq(design, changed, rcond=None)[0]
    assert np.linalg.norm(left) < 0.15 * np.linalg.norm(changed)
    # Without the copies a quarter of a period later no change of phase is followed.
    flat = design[:, ::2]
    assert np.linalg.norm(changed - flat @ np.linalg.lstsq(flat, changed, rcond=None)[0]) > 2 * np.linalg.norm(left)


def test_a_period_in_the_position_is_found(rng):
    plain_um = [20 * np.sin(np.arange(n) / 200) ** 2 for n in (600, 800)]
    period_um = rng.uniform(0.2, 1.0)
    noise = rng.standard_normal(1400)
    wave = np.concatenate([np.cos(2 * np.pi * p / period_um + 0.3) for p in plain_um])
    found = repeats_in(plain_projector(), noise + wave, plain_um)
    assert found.period_um == pytest.approx(period_um, rel=0.01)
    assert found.z > 50
    assert found.drop == pytest.approx(1400 / 2, rel=0.25)
    assert repeats_in(plain_projector(), noise, plain_um).z < 15


def irregularities(values):
    found, bursts = irregular(plain_projector((len(values),)), values)
    return {one.name: one for one in found}, bursts


def test_white_noise_is_regular(rng):
    found, bursts = irregularities(rng.standard_normal(6000))
    assert not bursts
    assert all(one.p > 1e-5 for one in found.values())
    assert all(one.sentence.startswith("no sign") == (one.p >= 1e-3) for one in found.values())


def test_sizes_of_stretches_are_compared_as_scipy_does(rng):
    values = rng.standard_normal(6000) * np.repeat(rng.uniform(0.8, 1.2, 24), 250)
    found, _ = irregularities(values)
    # Past values predict nothing, so that what is new in each sample is nearly the sample, but for a factor.
    reference = stats.f_oneway(*np.array_split(np.abs(values[20:] - values.mean()), 24)).pvalue
    assert np.log(found["evenness"].p) == pytest.approx(np.log(reference), rel=0.15)


@pytest.mark.parametrize("kind", ["whiteness", "evenness", "tails", "bursts"])
def test_each_irregularity_is_seen_as_what_it_is(rng, kind):
    values = rng.standard_normal(12_000)
    if kind == "whiteness":
        values = lfilter([1.0], [1.0, -0.3], values)
    elif kind == "evenness":
        values[3000:6000] *= 1.5
    elif kind == "tails":
        values = rng.standard_t(5, 12_000)
    else:
        values[rng.choice(24, 3, replace=False)[:, None] * 500 + np.arange(500)] *= 12
    found, bursts = irregularities(values)
    assert bursts == (kind == "bursts")
    if kind != "bursts":
        assert min(found, key=lambda name: found[name].p) == kind
        assert found[kind].p < 1e-6


@pytest.mark.parametrize(("period_um", "is_one"), [(0.53, False), (1.06, False), (0.8, True), (1.6, True)])
def test_what_rounding_repeats_is_no_period_of_the_sensor(period_um, is_one):
    """Of two waves, one over two digits has a second one over each of them."""
    assert period_of(Cycles(period_um, 1e3, 1e3), 0.53) == (period_um if is_one else None)
    assert period_of(Cycles(period_um, 1e3, 1e3), 0.0) == period_um


def faults(n=5000, noise_um=0.1, **found):
    nothing = {
        "spikes": (np.zeros(n, dtype=bool),),
        "heights_um": (np.zeros(n),),
        "repeats_um": np.zeros(0),
        "quantum_um": 0.0,
    }
    nothing |= {"jitter_s": 0.0, "jitter_um": 0.0, "jitter_z": 0.0, "band": Band(0.0, 0.0, 0.0, 0.0, 0.0)}
    return Faults((Noise(noise_um, WHITE),), "", **(nothing | found))


def test_nothing_is_named_where_nothing_is_wrong():
    assert name_faults(faults(), False) == []
    assert name_faults(faults(quantum_um=0.1), False) == []
    assert not faults().repaired


def test_faults_have_the_variance_that_they_make(rng):
    bad = np.zeros(5000, dtype=bool)
    bad[rng.choice(5000, 12, replace=False)] = True
    heights = np.where(bad, rng.choice([-1, 1], 5000) * rng.uniform(1, 3, 5000), 0.0)
    (spikes,) = name_faults(faults(spikes=(bad,), heights_um=(heights,)), False)
    assert (spikes.statistic, spikes.variance_um2) == ("spikes", pytest.approx(np.mean(heights**2)))
    values = {name: value for name, value, _, _ in spikes.parameters}
    assert values == {"fraction": pytest.approx(12 / 5000), "size_um": pytest.approx(np.std(heights[bad]), rel=0.3)}
    (digit,) = name_faults(faults(quantum_um=0.3), False)
    rounding = np.round(rng.uniform(0, 100, 100_000) / 0.3) * 0.3
    uniform = rng.uniform(-0.15, 0.15, 100_000)
    assert digit.variance_um2 == pytest.approx(np.var(uniform), rel=0.02)
    assert (digit.statistic, digit.parameters[0][1]) == (
        "rounding",
        pytest.approx(np.diff(np.unique(rounding)).min()),
    )
    shaky = faults(jitter_s=1e-4, jitter_um=0.05, jitter_z=10.0)
    assert [one.statistic for one in name_faults(shaky, False)] == ["jitter"]
    # What repeats itself with the position looks like it.
    assert name_faults(shaky, True) == []
    wave = Band(20.0, 0.08, 0.005, 10.0, 30.0, 1000.0, 1)
    assert [one.statistic for one in name_faults(faults(band=wave), False)] == ["band"]
    # At an even speed a period in the position is a line in time.
    assert name_faults(faults(band=wave), True) == []
    # A mode that rings after steps is a line in time, too.
    assert name_faults(faults(band=wave), False, mistaken=True) == []
    # Within four widths, which are of 2 Hz.
    own = [faults(band=wave).rings_itself(at_Hz, THRESHOLDS) for at_Hz in (None, 11.0, 13.0, 27.0, 29.0)]
    assert own == [False, False, True, True, False]
    none = Band(0.0, 0.0, 0.0, 0.0, 0.0)
    assert not faults(band=none).rings_itself(100.0, THRESHOLDS)
    for other in (replace(wave, frequency_Hz=50.0), replace(wave, quality=1.0), replace(wave, z=3.0)):
        assert name_faults(faults(band=other), False) == []


def test_spikes_are_taken_out_and_the_noise_is_what_is_left(rng):
    n = 5000
    reg = regression(rng, lengths=(n,), kinds=0)
    time_s = np.arange(n) / 1000
    noise_um, where = 0.05, 200 + 400 * np.arange(10)
    clean = noise_um * rng.standard_normal(n)
    heights = np.zeros(n)
    heights[where] = rng.choice([-1, 1], 10) * rng.uniform(1, 4, 10)
    reading = 10 * np.sin(time_s) + clean + heights
    run = run_of(np.sin(time_s), reading)
    reg.baseline.runs, reg.baseline.stroke_um, reg.baseline.dynamic = (run,), 20.0, False
    reg.baseline.columns_um = np.zeros(12)
    whole = Regression(
        reg.baseline, (run.fitted,), (0 * reg.rows[0],), reg.nuisance, (), (clean + heights,), reg.root, ((),)
    )
    found = find_faults(whole)
    assert found.repaired
    assert np.flatnonzero(found.spikes[0]).tolist() == where.tolist()
    np.testing.assert_allclose(found.heights_um[0][where], heights[where], atol=5 * noise_um)
    assert found.noise[0].total_um == pytest.approx(noise_um, rel=0.1)
    (repaired,) = found.clean([Record(time_s, np.sin(time_s), reading)])
    np.testing.assert_allclose(repaired.displacement_um, reading - heights, atol=5 * noise_um)
    # What a known effect changes is none of it.
    assert not find_faults(whole, [heights]).repaired


def test_jitter_of_a_motion_of_few_samples_in_a_period_is_measured_by_its_slope(rng):
    """Differences of neighbours are less than it, and made a jitter a fifth too large; of six the sd is 4 % now."""
    n, jitter_s = 4000, 4e-5
    time_s, lines_rad_per_s, phases = 7e-4 * np.arange(n), 2 * np.pi * rng.uniform(8, 340, 40), rng.uniform(0, 6, 40)

    def position_um(at_s):
        return 0.05 * np.sum(np.sin(np.outer(at_s, lines_rad_per_s) + phases), axis=1) * (time_s < 1.2)

    late_s, noise_um = jitter_s * rng.standard_normal(n), 1e-3 * rng.standard_normal(n)
    left = position_um(time_s + late_s) - position_um(time_s) + noise_um
    reg = regression(rng, lengths=(n,), kinds=0)
    reg.baseline.runs = (run_of(np.sin(time_s), position_um(time_s) + left, 1 / 7e-4),)
    reg.baseline.stroke_um, reg.baseline.dynamic, reg.baseline.columns_um = 2.0, False, np.zeros(12)
    mask = np.ones(n, dtype=bool)
    whole = Regression(reg.baseline, (mask,), (0 * reg.rows[0],), reg.nuisance, (), (left,), reg.root, ((),))
    assert find_faults(whole).jitter_s == pytest.approx(jitter_s, rel=0.16)


def test_spikes_of_a_stage_that_would_move_far_are_none_of_the_readings(rng):
    n, where = 3000, 500 + 400 * np.arange(5)
    reg = regression(rng, lengths=(n,), kinds=0)
    time_s = np.arange(n) / 1000
    left = 10 * np.sin(time_s) + 0.05 * rng.standard_normal(n)
    # A column that follows what is left, but for a few samples where it makes spikes.
    rows = np.zeros_like(reg.rows[0])
    rows[:, 0] = np.sin(time_s)
    rows[where, 0] += 0.5
    run = run_of(np.sin(time_s), left)
    reg.baseline.runs, reg.baseline.stroke_um, reg.baseline.dynamic = (run,), 20.0, False
    reg.baseline.columns_um = np.zeros(12)
    whole = Regression(reg.baseline, (run.fitted,), (rows,), reg.nuisance, (), (left,), 1e-6 * reg.root, ((),))
    moved = left - rows[:, 0] * np.linalg.lstsq(rows[:, :1], left, rcond=None)[0]
    assert np.abs(moved[where]).min() > 50 * 0.05
    assert not find_faults(whole).repaired


def test_a_prior_is_as_smooth_as_the_density(rng):
    baseline = baseline_of(rng)
    size, count = len(baseline.columns_um), 900
    i, j = np.tril_indices(baseline.chain.grid.levels)
    smooth = np.r_[0.3 + 0.02 * i + 0.01 * j, np.full(size - len(i), 0.3)]
    rough = smooth * rng.uniform(0.2, 1.8, size)
    design = [rng.standard_normal((count, size)) for _ in range(2)]
    stiffness = []
    for truth in (smooth, rough):
        here = replace(baseline, columns_um=smooth, z=np.zeros(0))
        left = tuple(rows @ (truth - smooth) + 0.3 * rng.standard_normal(count) for rows in design)
        masks, own = (np.ones(count, dtype=bool),) * 2, (np.ones((count, 1)),) * 2
        reg = Regression(here, masks, tuple(design), own, (), left, 1e-3 * np.eye(size), ((), ()))
        found = smoothed(Projector(reg, [Noise(0.3, WHITE)] * 2), [np.zeros(count)] * 2)
        prior = found.regression.baseline.prior
        stiffness.append(np.trace(prior[: len(i), : len(i)]))
        # Ridge regression by that prior is nearer to the truth than least squares.
        rows, target = np.concatenate(design) / 0.3, np.concatenate(left) / 0.3
        flat, held = (
            np.linalg.solve(rows.T @ rows + p, rows.T @ target + p @ (0 - smooth)) for p in (1e-9 * prior, prior)
        )
        off = np.linalg.norm(held + smooth - truth) / np.linalg.norm(flat + smooth - truth)
        assert off < (0.7 if truth is smooth else 1.05)
    assert stiffness[0] > 10 * stiffness[1]


def test_where_all_causes_were_left_out_nothing_is_told_beside_what_they_had_taught(monkeypatch):
    """Beside causes a density may be less rough: it has fewer unknowns then, and rows, than without them."""
    monkeypatch.setattr(_misfit, "nothing", lambda _, projector: SimpleNamespace(cost=9.0, rows=projector.rows))
    smooth, rough = (SimpleNamespace(rows=rows) for rows in (10, 74))
    before = Selection((), *(None,) * 6, *(SimpleNamespace(beside=lambda _, one=one: one) for one in (smooth, rough)))
    told = _misfit._in_noise(before, ())
    assert told.model.rows == told.projector.rows == 74


def test_a_whitened_residual_has_a_size_in_um(rng):
    """Of a narrow band whitening leaves little, which is large before it, and runs have noise of their own."""
    lengths, slow = (3000, 5000), np.array([1.9, -0.95])
    reg = regression(rng, lengths=lengths)
    noise = [Noise(0.01, slow), Noise(2.0, WHITE)]
    projector = Projector(reg, noise)
    shaking = lfilter([0.01], np.r_[1.0, -slow], rng.standard_normal(lengths[0]))
    quiet = 0.5 * rng.standard_normal(lengths[1])
    found = projector.unit_um(projector.join([shaking, quiet]))
    size_um = np.sqrt(np.mean(np.concatenate([shaking, quiet]) ** 2))
    # Of white numbers of variance one in the first run and 1/16 in the second.
    assert found == pytest.approx(size_um / np.sqrt((3000 + 5000 / 16) / 8000), rel=0.15)
