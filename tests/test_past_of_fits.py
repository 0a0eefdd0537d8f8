"""The unknown past of runs in fits and predictions, against relays that went through something else before."""

import json
from itertools import pairwise

import numpy as np
import pytest
from _command import refused, run
from scipy.signal import lsim
from test_past import LEVELS, half_plane, relays

import fits
from fits import Record
from fits.loop._known import known_samples

NOISE = 5e-4
RATE_HZ = 2000.0
# Turns before a run, whose state lies between none and all of the relays on.
BEFORE = (0.9, 0.2, 0.75, 0.3)


def grows(rng, n):
    """Loops around the middle that go a little farther each time, and reach the ends of 0 to 1 V at last."""
    size = np.linspace(0.15, 0.5, n)
    return np.clip(0.5 + size * np.sin(np.linspace(rng.uniform(0.1, 0.6), 16 * np.pi, n)), 0.0, 1.0)


def moved(rig, before_V, voltage_V):
    """Displacement of relays that were all off, then went through some voltages, and then through a record."""
    on_V, off_V, weight = rig
    turns = np.concatenate([np.linspace(*two, 60) for two in pairwise(before_V)])
    along = np.concatenate([turns, np.linspace(before_V[-1], voltage_V[0], 20), voltage_V])
    state = np.full(len(weight), -1.0)
    return 10 * (relays(along, state, weight, on_V, off_V)[-len(voltage_V) :] + 0.6 * voltage_V)


def record(rng, rig, before_V, voltage_V, name):
    time_s = np.arange(len(voltage_V)) / RATE_HZ
    noise = NOISE * 10 * rng.standard_normal(len(time_s))
    return Record(time_s, voltage_V, moved(rig, before_V, voltage_V) + noise, source=name)


@pytest.fixture
def fitted(rng):
    """Relays, a run of which most depends on what came before, and its fit."""
    rig = half_plane(rng)
    one = record(rng, rig, (0.0, *BEFORE), grows(rng, 4000), "a.csv")
    return rig, one, fits.fit([one], holdout=0.0)


def test_a_run_that_depends_on_its_past_is_fitted_as_a_whole(fitted):
    _, one, result = fitted
    assert np.mean(~known_samples(one.voltage_V, *(f(one.voltage_V) for f in (np.min, np.max)))) > 0.5
    assert result.in_sample.samples == len(one)
    # Relays switch in steps of a level.
    step_um = np.ptp(one.displacement_um) / LEVELS
    assert result.in_sample.rms_um < 1.2 * step_um / 12**0.5
    assert any("unknown and estimated" in remark for remark in result.remarks)


def test_a_prediction_begins_as_a_run_of_the_fit_did(fitted):
    """The same record again, without its readings; after saturation it would be far off."""
    _, one, result = fitted
    off_um = {}
    for name, initial in {"as then": result.runs[0].start, "unknown": "unknown"}.items():
        found = fits.predict(result, one, initial)
        off_um[name] = np.sqrt(np.mean((found.displacement_um - one.displacement_um) ** 2))
    # Twelve extremes stand for what was before, and the widest relays are met once.
    assert off_um["as then"] < 0.75 * off_um["unknown"]


def test_a_prediction_from_an_unknown_memory_says_how_far_off_it_may_be(fitted, rng):
    rig, one, result = fitted
    step_um = np.ptp(one.displacement_um) / LEVELS
    program = Record(np.arange(1500) / RATE_HZ, 0.5 + 0.2 * np.sin(np.linspace(0, 40, 1500)), None)
    found = fits.predict(result, program, "unknown")
    for _ in range(6):
        turns = np.append(0.0, rng.uniform(0, 1, rng.integers(1, 8)))
        truth = moved(rig, turns, program.voltage_V)
        # The offset of the sensor is that of the fitted run.
        off = np.abs(found.displacement_um - truth)
        assert np.all(off < 3 * found.displacement_sd_um + step_um)
    known = fits.predict(result, program, "negative")
    assert np.max(found.displacement_sd_um) > 3 * np.max(known.displacement_sd_um)
    assert any("unknown" in remark for remark in found.remarks)
    # Once the voltage has been at both ends nothing is left of it.
    low, high = np.min(one.voltage_V), np.max(one.voltage_V)
    swept = np.interp(np.arange(349), [0, 49, 148, 200, 250, 348], [0.5, low, high, 0.4, 0.8, low])
    both = [fits.predict(result, Record(np.arange(349.0), swept, None), state) for state in ("unknown", "negative")]
    np.testing.assert_allclose(*(one.displacement_um[149:] for one in both), atol=1e-12)
    np.testing.assert_allclose(*(one.displacement_sd_um[149:] for one in both), rtol=1e-9)


def test_the_memory_before_a_run_of_a_stage_is_estimated(rng):
    """Behind a mode and a lag, whose memory is that of the hysteresis, not of the command."""
    rig, natural = half_plane(rng), 2 * np.pi * 150.0
    begins = 0.5 + 0.35 * np.sin(np.linspace(0.3, 11 * np.pi, 3000))
    lines = 0.5 + sum(
        0.06 * np.sin(2 * np.pi * f * np.arange(3000) / RATE_HZ + rng.uniform(0, 6)) for f in (7, 31, 90, 170)
    )
    whole = np.concatenate(
        [np.linspace(0.5, 0, 300), np.linspace(0, 1, 600), np.linspace(1, 0, 600), np.linspace(0, 0.5, 300)]
    )
    runs = []
    for name, voltage in (("slow.csv", np.concatenate([whole, begins])), ("fast.csv", lines), ("again.csv", begins)):
        time_s = np.arange(len(voltage)) / RATE_HZ
        still = moved(rig, (0.0, *BEFORE), voltage)
        state = lsim(([natural**2], [1, 2 * 0.05 * natural, natural**2]), still - still[0], time_s)[1]
        noise = NOISE * 10 * rng.standard_normal(len(time_s))
        runs.append(Record(time_s, voltage, state + still[0] + noise, source=name))
    result = fits.fit_stage(runs[:2], levels=16, holdout=runs[2:])
    report = result.runs[2]
    assert report.has_past
    # Later it has been at both of its ends.
    count = 1 + max(
        int(np.argmax(begins >= 0.999 * np.max(begins))), int(np.argmax(begins <= 1.001 * np.min(begins)))
    )
    assert count > 200
    left = {
        name: runs[2].displacement_um - fits.predict(result, runs[2], initial).displacement_um
        for name, initial in {"as then": report.start, "negative": "negative"}.items()
    }
    # Relays switch in steps of a level, which no smooth density follows.
    more = {}
    for name, off in left.items():
        before, after = np.split(off, [count])
        more[name] = np.mean((before - np.mean(after)) ** 2) - np.var(after)
    assert more["as then"] < 0.2 * more["negative"]


def test_simulate_takes_the_memory_of_a_run_by_its_name(rng, tmp_path):
    one = record(rng, half_plane(rng), (0.0, *BEFORE), grows(rng, 4000), "a.csv")
    table = np.stack([one.time_s, one.voltage_V, one.displacement_um], axis=1)
    words = "time_s,voltage_V,displacement_um"
    measured, model, out = (tmp_path / name for name in ("a.csv", "model.json", "p.csv"))
    np.savetxt(measured, table, delimiter=",", header=words, comments="", fmt="%.17g")
    assert run("fit", measured, "--out", model).exit_code == 0
    off_um = {}
    for initial in (str(measured), "unknown"):
        ran = run("simulate", model, measured, "--out", out, "--initial", initial, "--json")
        assert ran.exit_code == 0, ran.output
        there = np.genfromtxt(out, delimiter=",", names=True)["displacement_um"]
        off_um[initial] = np.sqrt(np.mean((there - one.displacement_um) ** 2))
    assert "unknown" in json.loads(ran.stdout)["remarks"][0]
    assert off_um[str(measured)] < 0.75 * off_um["unknown"]
    ran = run("simulate", model, measured, "--out", tmp_path / "no.csv", "--initial", "b.csv")
    refused(ran, "a.csv", "demagnetised", "b.csv")
    assert not (tmp_path / "no.csv").exists()
