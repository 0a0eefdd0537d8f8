"""The other kinds of jobs, each against something that shares no code with it, and workers of a cluster."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from _gain_formulas import gains, sizes
from _sweeps import Relays, parsed, small
from scipy.signal import StateSpace, cont2discrete, lsim

from fits import DataError
from fits.sweeps._run import run_sweep
from fits.sweeps._spec import compute_chunk
from fits.sweeps._stages import nominal_stage

CONTROL = """
schema = "microid.sweep/1"
kind = "control"
[reference]
shape = "step"
samples = 80
interval_s = 1e-3
amplitude_um = 5.0
[controller]
delay_samples = 1
[[axis]]
parameter = "controller.integral_V_per_um_s"
values = {integral}
zip = "gains"
[[axis]]
parameter = "controller.proportional_V_per_um"
values = {proportional}
zip = "gains"
"""

FIT = """
schema = "microid.sweep/1"
kind = "fit"
seed = {seed}
[fit]
method = "{method}"
levels = 8
[records]
noise_um = 0.02
[program]
shape = "decay"
samples = 300
interval_s = 0.02
offset_V = 60.0
amplitude_V = 60.0
frequency_Hz = 0.8
[[axis]]
parameter = "hysteresis.density.packed_um"
relative = true
values = [0.7, 1.0, 1.3]
"""


def closed_loop(stage, integral, proportional, samples, interval_s, wanted_um):
    """A PI controller, late by a sample, around driver, relays and mechanics, step by step with SciPy."""
    keep = np.exp(-interval_s / float(stage["driver"].time_constant_s))
    rate = 2 * np.pi * float(stage["mechanics"].natural_frequency_Hz)
    matrix = [[0.0, 1.0], [-(rate**2), -2 * float(stage["mechanics"].damping_ratio) * rate]]
    plant, relays = StateSpace(matrix, [[0.0], [rate**2]], np.eye(2), np.zeros((2, 1))), Relays(stage)
    voltage, loaded = 0.0, relays(0.0)
    state, late, total, errors = np.array([loaded, 0.0]), loaded, 0.0, []
    for _ in range(samples):
        displacement = state[0]
        errors.append(wanted_um - displacement)
        measured, late = late, displacement
        wanted = total + integral * interval_s * (wanted_um - measured) + proportional * (wanted_um - measured)
        command = np.clip(wanted, 0.0, 120.0)
        total += integral * interval_s * (wanted_um - measured) + command - wanted
        voltage = keep * voltage + (1 - keep) * command
        before, loaded = loaded, relays(voltage)
        state = lsim(plant, [before, loaded], [0.0, interval_s], X0=state)[1][-1]
    return np.array(errors)


@pytest.mark.study
def test_closed_loops_agree_with_a_loop_of_scipy_and_relays(rng):
    chosen = rng.uniform(20, 200, 3), rng.uniform(0, 0.5, 3)
    sweep = parsed(CONTROL.format(integral=chosen[0].tolist(), proportional=chosen[1].tolist()))
    found = compute_chunk(sweep, 0).outputs
    for row, (integral, proportional) in enumerate(zip(*chosen, strict=True)):
        errors = closed_loop(nominal_stage(), integral, proportional, 80, 1e-3, 5.0)
        assert found["error_rms_um"][row] == pytest.approx(np.sqrt(np.mean(errors**2)), rel=5e-3)
        assert found["error_final_um"][row] == pytest.approx(errors[-1], abs=0.03)


def largest_pole(stage, integral, proportional, interval_s, slope_um_per_V):
    """Of the loop of `closed_loop` with a slope in place of the relays, as a matrix from sample to sample."""
    time_constant_s = float(stage["driver"].time_constant_s)
    rate = 2 * np.pi * float(stage["mechanics"].natural_frequency_Hz)
    damping = float(stage["mechanics"].damping_ratio)
    plant = [
        [-1 / time_constant_s, 0, 0],
        [0, 0, 1],
        [rate**2 * slope_um_per_V, -(rate**2), -2 * damping * rate],
    ]
    drive = np.array([[1 / time_constant_s], [0], [0]])
    step, push, *_ = cont2discrete((np.array(plant), drive, np.eye(3), np.zeros((3, 1))), interval_s)
    grow = integral * interval_s
    # Three states of the plant, the late reading, the integral.
    loop = np.zeros((5, 5))
    loop[:3, :3], loop[:3, 3], loop[:3, 4] = step, -(grow + proportional) * push[:, 0], push[:, 0]
    loop[3, 1], loop[4, 3], loop[4, 4] = 1, -grow, 1
    return np.abs(np.linalg.eigvals(loop)).max()


@pytest.mark.study
def test_loops_whose_largest_pole_is_outside_fail_and_others_do_not(rng):
    import fits

    stage = nominal_stage()
    integral, proportional = rng.uniform(20, 4000, 8), rng.uniform(0, 3, 8)
    integral[:2], proportional[:2] = (50, 3000), (0.1, 2.0)
    found = compute_chunk(parsed(CONTROL.format(integral=integral.tolist(), proportional=proportional.tolist())), 0)
    for row, gains_of in enumerate(zip(integral, proportional, strict=True)):
        radius = largest_pole(stage, *gains_of, 1e-3, fits.steepest_slope(stage))
        if radius < 1:
            assert found.reasons[row] == ""
            assert found.outputs["pole_radius"][row] == pytest.approx(radius, rel=1e-4)
        else:
            assert "unstable where the hysteresis is steepest" in found.reasons[row]
            assert float(found.reasons[row].partition(" = ")[2]) == pytest.approx(radius, rel=1e-4)
    assert found.outputs["status"][:2].tolist() == [1, 2]


def test_references_that_stand_still_fail_with_that_reason():
    text = CONTROL.format(integral=[50.0], proportional=[0.1])
    found = compute_chunk(parsed(text.replace("amplitude_um = 5.0", "amplitude_um = 0.0")), 0)
    assert found.reasons == ("the reference does not move",)


def test_dimensions_agree_with_formulas_and_with_the_design_one_by_one(rng):
    import fits

    factors, modulus = rng.uniform(0.9, 1.1, 3), rng.uniform(60, 250, 3)
    text = (
        'schema = "microid.sweep/1"\nkind = "sensitivity"\n[sensitivity]\naxes = ["x"]\n'
        f'[[axis]]\nparameter = "geometry.t1_mm"\nrelative = true\nvalues = {factors.tolist()}\nzip = "a"\n'
        f'[[axis]]\nparameter = "material.youngs_modulus_GPa"\nvalues = {modulus.tolist()}\nzip = "a"\n'
    )
    found = compute_chunk(parsed(text), 0).outputs
    for row in range(3):
        design = fits.paper_design()
        thick = dataclasses.replace(design.geometry, t1_mm=design.geometry.t1_mm * factors[row])
        design = dataclasses.replace(design, geometry=thick, youngs_modulus_GPa=modulus[row])
        report = fits.sensitivities(design, ("x",))["x"]
        expected = gains("x", sizes(t1=0.8 * factors[row]))
        assert found["x_gain_um_per_um"][row] == pytest.approx(expected, rel=1e-10)
        assert found["x_stroke_um"][row] == pytest.approx(report.stroke, rel=1e-10)
        assert found["x_spread_pct"][row] == pytest.approx(report.rss_pct, rel=1e-6)


def test_a_batch_of_fits_finds_the_noise_and_the_loops(seed):
    found = compute_chunk(parsed(FIT.format(seed=seed, method="batch")), 0)
    assert set(found.reasons) == {""}
    # The standard error of a standard deviation from 300 samples is some 4 %.
    np.testing.assert_allclose(found.outputs["noise_um"], 0.02, rtol=0.25)
    # What is left in the small loops that were not fitted is that noise, and little more.
    stroke_um = 0.02 / found.outputs["heldout_e_rms_pct"] * 100
    assert np.all((stroke_um > 6) & (stroke_um < 30))
    # The nominal stage has 5 um of loops; weights on so coarse a grid and a smooth density trade with the slope.
    np.testing.assert_allclose(np.diff(found.outputs["loops_um"]), 0.3 * 5, rtol=0.5)


@pytest.mark.study
def test_a_batch_of_fits_agrees_with_fits_one_by_one(seed):
    batch = compute_chunk(parsed(FIT.format(seed=seed, method="batch")), 0).outputs
    alone = compute_chunk(parsed(FIT.format(seed=seed, method="one_by_one")), 0).outputs
    # One grid and one smoothness for all cost something: half as much again on some rigs.
    assert batch["heldout_e_rms_pct"][0] < 2 * alone["heldout_e_rms_pct"][0]
    assert batch["noise_um"][0] == pytest.approx(alone["noise_um"][0], rel=0.3)
    assert batch["offset_um"][0] == pytest.approx(alone["offset_um"][0], abs=0.1)


def test_files_are_rows_and_a_broken_one_fails_alone(tmp_path, rng):
    time_s = np.arange(200) * 0.01
    for k in range(3):
        voltage = 50 + 50 * np.sin(2 * np.pi * time_s + k)
        frame = pd.DataFrame({"time_s": time_s, "voltage_V": voltage, "displacement_um": np.roll(voltage, 3) / 10})
        frame["displacement_um"] += rng.normal(0, 0.01, 200)
        frame.to_csv(tmp_path / f"day{k}.csv", index=False)
    (tmp_path / "day1.csv").write_text("time_s,voltage_V\n1,2\n")
    file = tmp_path / "sweep.toml"
    file.write_text('schema = "microid.sweep/1"\nkind = "fit"\n[records]\nfiles = "day*.csv"\n[fit]\nsamples = 256\n')
    from fits.sweeps._spec import read_sweep

    outcome = run_sweep(read_sweep(file), str(tmp_path / "out"))
    assert (outcome.rows, outcome.failed) == (3, 1)
    found = pd.read_parquet(tmp_path / "out" / "results.parquet")
    assert found["status"].tolist() == [1, 2, 1]
    assert found["reason"][1].startswith("day1.csv")
    assert found["source"].tolist() == ["day0.csv", "day1.csv", "day2.csv"]


def test_diagnoses_go_one_by_one_and_a_refused_record_fails_alone(monkeypatch, seed):
    text = FIT.replace('method = "{method}"\nlevels = 8\n', "").replace("[fit]", "[diagnose]")
    text = text.replace('kind = "fit"', 'kind = "diagnose"').format(seed=seed)
    asked = []

    def diagnose(records, **options):
        asked.append((records[0], options))
        if len(asked) == 2:
            raise DataError("the voltage stands still")
        gain = SimpleNamespace(heldout_rms_before_um=2.0, heldout_rms_after_um=1.0)
        return SimpleNamespace(
            causes=[SimpleNamespace(name="creep", z=9.0)],
            noise_um=0.1,
            unexplained_rms_um=0.0,
            gain=gain,
            verdict="effect_found",
        )

    monkeypatch.setattr("fits.diagnosis._diagnose.diagnose", diagnose)
    sweep = parsed(text)
    found = [compute_chunk(sweep, chunk) for chunk in range(3)]
    assert [rows.reasons for rows in found] == [("",), ("the voltage stands still",), ("",)]
    assert found[0].outputs["first_cause"] == ["creep"]
    assert found[0].outputs["verdict"] == ["effect_found"]
    strokes = [np.ptp(record.displacement_um) for record, _ in asked]
    assert strokes == sorted(strokes)


@pytest.mark.study
def test_two_workers_give_the_same_bits(tmp_path, seed):
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    sweep = parsed(small(seed, rows=300))
    run_sweep(sweep, str(tmp_path / "here"))
    run_sweep(sweep, str(tmp_path / "there"), cluster="local:2")
    here, there = (pd.read_parquet(tmp_path / name / "results.parquet") for name in ("here", "there"))
    assert here.equals(there)


def test_workers_with_other_versions_or_none_are_refused(tmp_path, monkeypatch, seed):
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    sweep = parsed(small(seed, rows=10))
    with pytest.raises(DataError, match="does not answer"):
        run_sweep(sweep, str(tmp_path / "a"), cluster="nowhere")
    from fits.sweeps import _cluster

    real = _cluster.versions()
    payload = _cluster._Payload("", "", {}, "", "", real | {"numpy": "0.1"})
    monkeypatch.setattr("distributed.get_worker", lambda: SimpleNamespace(name="w", address="tcp://w:1"))
    _, refused = _cluster.work(payload, 0)
    assert f"numpy {real['numpy']}, and 0.1 is needed" in refused
