"""A whole stage in feedforward: what it follows, and what is refused or said, from Python and from the command."""

import ctypes
import json
import shutil
import subprocess

import numpy as np
import pytest
from _command import run, whole_picture
from _models import ends_um, limits_V, play, random_model
from _plant_reference import driver_and_mechanics, mechanics_alone, states
from test_compensate import read

import microid
from fits import DataError, Reference, compensate, save_model
from microid.hysteresis import PrandtlIshlinskii

COMPILER = shutil.which("gcc") or shutil.which("cc")
SAMPLES, HALF = 400, 200


def stage_of(rng, law):
    """A driver with a gain, and mechanics and a sensor that turn the displacement into another."""
    return microid.Stage.of(
        driver=microid.Driver(2e-3, rng.uniform(5, 15)),
        hysteresis=law,
        mechanics=microid.Mechanics(120.0, 0.1, rng.uniform(1, 3)),
        sensor=microid.Sensor(rng.uniform(0.9, 1.1), rng.normal()),
    )


def reading_um(stage, piezo_um):
    """What the sensor reads where the hysteresis gives a displacement, at rest."""
    return float(stage["sensor"].offset_um) + float(stage["sensor"].gain * stage["mechanics"].gain) * piezo_um


def smooth_reference(stage, highest=0.7):
    """A rest, a smooth start and a tone that dies out, between the ends of the range."""
    time_s = np.arange(SAMPLES) * 1e-3
    x = np.clip((time_s - 0.01) / 0.15, 0, 1)
    rise = x**4 * (35 - 84 * x + 70 * x**2 - 20 * x**3)
    low_um, high_um = (reading_um(stage, end) for end in ends_um(stage["hysteresis"]))
    share = rise * (highest - 0.25 * (1 - np.cos(2 * np.pi * 8 * time_s)))
    return Reference(time_s, low_um + share * (high_um - low_um), "wanted.csv"), high_um - low_um


def played(stage, time_s, command_V):
    """The chain, part by part; every part but the hysteresis in NumPy and SciPy."""
    driver, mechanics = stage["driver"], stage["mechanics"]
    a, b = driver_and_mechanics(float(driver.time_constant_s), 1.0, 1.0)
    v = float(driver.gain) * states(a[:1, :1], b[:1], time_s, command_V, "first")[:, 0]
    w = law_um(stage["hysteresis"], v)
    # Behind a driver the displacement has no corners: lines in its place lie a twelfth of its second difference off.
    w[1:-1] -= np.diff(w, 2) / 12
    a, b = mechanics_alone(float(mechanics.natural_frequency_Hz), float(mechanics.damping_ratio))
    return reading_um(stage, states(a, b, time_s, w, "first")[:, 0])


def law_um(law, voltage_V):
    first_um, memory = play(law, voltage_V[:HALF])
    return np.append(first_um, play(law, voltage_V[HALF:], memory)[0])


def test_a_whole_stage_follows_and_without_its_mechanics_it_lags(rng):
    stage = stage_of(rng, random_model(rng))
    wanted, stroke = smooth_reference(stage)
    dynamic, static = compensate(stage, wanted, way="dynamic"), compensate(stage, wanted)
    assert dynamic.remarks == static.remarks == ()
    for found in (dynamic, static):
        expected_um = played(stage, wanted.time_s, found.voltage_V)
        np.testing.assert_allclose(found.displacement_um, expected_um, rtol=0, atol=1e-10 * stroke)
    off, lag = (
        np.sqrt(np.mean((found.displacement_um - wanted.displacement_um) ** 2)) for found in (dynamic, static)
    )
    assert off < 2e-3 * stroke
    assert lag > 10 * off
    # Slowly, a static command is all that is needed: the sensor reads the reference.
    v = static.voltage_V * float(stage["driver"].gain)
    slow_um = law_um(stage["hysteresis"], v)
    np.testing.assert_allclose(reading_um(stage, slow_um), wanted.displacement_um, rtol=0, atol=1e-10 * stroke)


def test_what_a_stage_cannot_follow_is_refused_or_said(rng):
    stage = stage_of(rng, random_model(rng))
    lower_V, upper_V = (end / float(stage["driver"].gain) for end in limits_V(stage["hysteresis"]))
    wanted, stroke = smooth_reference(stage)
    low_um = wanted.displacement_um[0]

    def refusal(displacement_um, **options):
        with pytest.raises(DataError) as error:
            compensate(stage, Reference(wanted.time_s, displacement_um, "wanted.csv"), way="dynamic", **options)
        return str(error.value)

    step_um = low_um + np.where(np.arange(SAMPLES) < 100, 0.3, 0.7) * stroke
    for words in ("wanted.csv", "sample", "turns within a sample", "smooth it", "statically"):
        assert words in refusal(step_um)
    clipped = compensate(stage, Reference(wanted.time_s, step_um), clip=True, way="dynamic")
    assert clipped.clipped.any()
    assert "turns within a sample" in " ".join(clipped.remarks)
    corners_um = low_um + stroke * np.interp(np.arange(SAMPLES), [100, 121, 142], [0.5, 0.7, 0.5])
    remarks = compensate(stage, Reference(wanted.time_s, corners_um), way="dynamic").remarks
    assert any("turns within a sample" in remark for remark in remarks)
    moving_um = low_um + stroke * (0.5 + 0.2 * np.sin(2 * np.pi * 20 * wanted.time_s))
    (remark,) = compensate(stage, Reference(wanted.time_s, moving_um), way="dynamic").remarks
    assert "begins in motion" in remark

    too_far_um = low_um + (wanted.displacement_um - low_um) * 1.6
    for words in ("um of the piezo", "can be reached", f"{lower_V:g} and {upper_V:g} V", "slow it down", "clipped"):
        assert words in refusal(too_far_um)
    # Fast, and near the end of the range of a command: the hysteresis could, the driver cannot.
    limits = (lower_V, float(compensate(stage, wanted, way="dynamic").voltage_V.max()) * 0.7)
    static = compensate(stage, wanted, clip=True, limits_V=limits)
    dynamic = compensate(stage, wanted, clip=True, limits_V=limits, way="dynamic")
    for found in (static, dynamic):
        assert limits[0] <= found.voltage_V.min() <= found.voltage_V.max() <= limits[1]
        assert found.clipped.any()
    assert "limited" in refusal(wanted.displacement_um, limits_V=limits)
    few = Reference(wanted.time_s[:9], wanted.displacement_um[:9], "wanted.csv")
    with pytest.raises(DataError, match="16 samples"):
        compensate(stage, few, way="dynamic")
    with pytest.raises(DataError, match="dynamically"):
        compensate(stage["hysteresis"], wanted, way="dynamic")
    with pytest.raises(DataError, match=r"plays.*hysteresis"):
        compensate(microid.Stage.of(plays=PrandtlIshlinskii(0.2, np.ones(1), np.ones(1), 0.0)), wanted)
    turned = stage.swap("sensor", microid.Sensor(-1.0, 0.0))
    with pytest.raises(DataError, match=r"'sensor'.*positive"):
        compensate(turned, wanted)


def test_the_driver_alone_can_be_what_asks_for_too_much(rng):
    law = random_model(rng)
    lower_V, upper_V = limits_V(law)
    time_s = np.arange(SAMPLES) * 1e-3
    v = lower_V + (upper_V - lower_V) * (0.5 - 0.49 * np.cos(2 * np.pi * 20 * time_s))
    w = law_um(law, v)
    stage = microid.Stage.of(driver=microid.Driver(5e-3, 2.0), hysteresis=law)
    with pytest.raises(DataError, match="driver's lag"):
        compensate(stage, Reference(time_s, w, "wanted.csv"), way="dynamic")
    found = compensate(stage, Reference(time_s, w), way="dynamic", clip=True)
    assert found.clipped.any()
    assert "cut to the limits" in found.remarks[-1]
    assert lower_V / 2 <= found.voltage_V.min() <= found.voltage_V.max() <= upper_V / 2


def test_the_command_takes_stages(rng, tmp_path):
    law = random_model(rng)
    stage, path = stage_of(rng, law), tmp_path / "stage.json"
    save_model(path, stage, None, {})
    wanted, stroke = smooth_reference(stage)
    csv, out = tmp_path / "r.csv", tmp_path / "v.csv"
    rows = zip(wanted.time_s.tolist(), wanted.displacement_um.tolist(), strict=True)
    csv.write_text("time_s,displacement_um\n" + "".join(f"{t!r},{w!r}\n" for t, w in rows))
    done = run("compensate", path, csv, "--out", out, "--dynamic", "--plots", tmp_path / "plots", "--json")
    assert done.exit_code == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["displacement_sd_median_um"] is None
    assert summary["offset_um"] == pytest.approx(reading_um(stage, float(law.offset_um)))
    assert summary["error_max_um"] < 0.02 * stroke
    whole_picture(tmp_path / "plots" / "compensation.png")
    _, (_, voltage_V, displacement_um) = read(out)
    np.testing.assert_allclose(displacement_um, played(stage, wanted.time_s, voltage_V), rtol=0, atol=1e-9 * stroke)
    static = run("compensate", path, csv, "--out", out)
    assert static.exit_code == 0, static.stderr
    _, (_, voltage_V, _) = read(out)

    exported = run("export", path, "--out", tmp_path / "c")
    assert "static gains" in exported.stdout
    if COMPILER is None:
        pytest.skip("there is no C compiler on this machine: what was exported is not tried")
    library = tmp_path / "c.so"
    subprocess.run([COMPILER, "-fPIC", "-shared", tmp_path / "c" / "compensator.c", "-o", library], check=True)
    code, state = ctypes.CDLL(str(library)), ctypes.create_string_buffer(1 << 16)
    code.compensator_init(state, 0)
    inverse = code.compensator_inverse
    inverse.argtypes, inverse.restype = [ctypes.c_void_p, ctypes.c_double], ctypes.c_double
    found_V = [inverse(state, value) for value in wanted.displacement_um.tolist()]
    np.testing.assert_allclose(found_V, voltage_V, rtol=0, atol=1e-8)


def test_what_is_out_of_reach_beside_an_effect_is_not_said_of_the_reference(rng):
    # A creep that goes on: towards the end the plain stage is to be lower than it can be.
    creep = next(one for one in microid.effects.EFFECTS if one.name == "creep")
    law = random_model(rng, 12)
    stage = microid.effects.extend(microid.Stage.of(hysteresis=law), creep(0.1, 0.05))
    low, high = ends_um(law)
    time_s = np.linspace(0, 2, 400)
    there = Reference(time_s, low + (high - low) * 0.8 * np.clip(np.minimum(time_s, 2 - time_s), 0, 0.5), "r.csv")
    with pytest.raises(DataError, match=r"r\.csv, less what the effects of the model add: .* asks for .* clipped"):
        compensate(stage, there)
