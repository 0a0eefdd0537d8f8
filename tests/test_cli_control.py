"""The command that closes a loop around a model, end to end, and what it refuses."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from _command import columns_of, files, refused, run, whole_picture
from _models import linear_stage_of
from scipy.signal import TransferFunction, cont2discrete, lfilter, step

import fits.plots._style
import microid as m
from fits import save_model
from fits.cli._main import cli
from fits.report._control import describe_control
from microid.effects.slew_limit import SlewLimit

T = 1e-3
SAMPLES = 120
TAU_s, NATURAL_Hz, DAMPING, GAIN, OFFSET = 2e-3, 60.0, 0.3, 0.12, 1.5
GIVEN = ("--gains", "0.5,80,1e-3")
LIVELY = ("--gains", "0.5,1700,1e-3", "--feedforward", "none")


def write(path, time_s, displacement_um):
    rows = [f"{t!r},{x!r}" for t, x in zip(time_s.tolist(), displacement_um.tolist(), strict=True)]
    path.write_text("\n".join(["time_s,displacement_um", *rows]) + "\n")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A linear model, a hysteresis, and references: a step, a sine, and uneven times."""
    place = tmp_path_factory.mktemp("control")
    linear = linear_stage_of((TAU_s, NATURAL_Hz, DAMPING), GAIN, OFFSET)
    save_model(place / "linear.json", linear, None, {})
    density = m.densities.GridDensity(np.linspace(0.2, 0.8, 15), 0.0, 100.0)
    law = m.Preisach(density, m.Reversible(jnp.full(5, 0.05), 0.0, 100.0), jnp.asarray(2.0))
    save_model(place / "loop.json", law, None, {})
    save_model(place / "slew.json", m.Stage.of(slew=SlewLimit(1e4), piezo=m.Piezo(0.1)), None, {})
    at = T * np.arange(SAMPLES)
    write(place / "step.csv", at, 5.0 + 2 * (at > 0.0195))
    write(place / "sine.csv", at, 7.0 - 2 * np.cos(2 * np.pi * 25 * at))
    write(place / "uneven.csv", at + 2e-4 * (np.arange(SAMPLES) == 40), at)
    write(place / "short.csv", at[:9], at[:9])
    return place


def closed_by_scipy(gains, reference, start):
    """Displacement of the loop from rest, by the polynomials of controller and sampled plant."""
    kp, ki, kd = gains
    rate = 2 * np.pi * NATURAL_Hz
    bottom = np.polymul([TAU_s, 1], [1 / rate**2, 2 * DAMPING / rate, 1])
    above, below, _ = cont2discrete(([GAIN], bottom), T, method="zoh")
    pid = np.polyadd([kp, -kp, 0], np.polyadd([ki * T, 0, 0], np.array([1, -2, 1]) * kd / T))
    whole = np.polyadd(np.polymul(np.polymul([1, -1, 0], below), [1]), np.polymul(pid, above[0]))
    top = np.polymul(pid, above[0])
    padded = np.append(np.zeros(len(whole) - len(top)), top)
    return start + lfilter(padded, whole, reference - start)


def test_given_gains_are_run_as_scipy_runs_them(folder, tmp_path, monkeypatch):
    pictures, save = {}, fits.plots._style.save
    monkeypatch.setattr("fits.plots._style.save", lambda *one: pictures.update({one[1].stem: one[0]}) or save(*one))
    gains = (0.5, 80.0, 1e-3)
    given = ",".join(map(str, gains))
    result = run(
        *("control", folder / "linear.json", folder / "step.csv", "--out", tmp_path / "r.csv", "--gains", given),
        *("--feedforward", "none", "--json", "--plots", tmp_path / "plots"),
    )
    assert result.exit_code == 0, result.output
    told, out = json.loads(result.stdout), columns_of(tmp_path / "r.csv")
    assert list(out) == ["time_s", "reference_um", "displacement_um", "measured_um", "command_V", "error_um"]
    reference = 5.0 + 2 * (out["time_s"] > 0.0195)
    expected = closed_by_scipy(gains, reference, 5.0)
    np.testing.assert_allclose(out["reference_um"], reference, atol=1e-12)
    np.testing.assert_allclose(out["displacement_um"], expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(out["error_um"], reference - expected, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(out["measured_um"], out["displacement_um"])
    error = reference - expected
    assert told["tracking"]["e_max_pct"] == pytest.approx(100 * np.abs(error).max() / 2)
    assert told["tracking"]["error_rms_um"] == pytest.approx(np.sqrt(np.mean(error**2)))
    assert told["step"]["overshoot_pct"] >= 0
    assert told["schema"] == "microid.control/1"
    assert told["tuning"] is told["without_feedback"] is None
    assert told["gains"]["integral_V_per_um_s"] == 80.0
    assert told["margins"]["stable"] is True
    assert [path.name for path in sorted((tmp_path / "plots").iterdir())] == ["margins.png", "run.png"]
    for place in told["plots"]:
        whole_picture(place)
    # The limits are drawn, and the peak as high as is told, between the samples of a coarse line.
    size, turn, peak = pictures["margins"].axes
    dashed = [
        line.get_ydata()[0] for axes in (size, turn, peak) for line in axes.lines if line.get_linestyle() == "--"
    ]
    assert dashed == [0.5, -150.0, 2.0]
    highest = max(float(np.max(line.get_ydata())) for line in peak.lines if len(line.get_ydata()) > 2)
    assert highest == pytest.approx(told["margins"]["sensitivity_peak"], rel=1e-3)
    # What --json printed is taken as gains again.
    (tmp_path / "gains.json").write_text(result.stdout)
    again = run(
        *("control", folder / "linear.json", folder / "step.csv", "--out", tmp_path / "again.csv"),
        *("--gains", tmp_path / "gains.json", "--feedforward", "none"),
    )
    assert again.exit_code == 0, again.output
    assert (tmp_path / "again.csv").read_text() == (tmp_path / "r.csv").read_text()
    assert "margins     1 plants" in again.stdout


def test_it_says_what_feedback_is_worth(folder, tmp_path):
    """Against what the feedforward leaves, which the same run with next to no gain shows."""
    words = ("control", folder / "linear.json", folder / "sine.csv", "--out", tmp_path / "r.csv", "--gains")
    weak = json.loads(run(*words, "1e-12,0,0", "--json").stdout)
    told = json.loads(run(*words, "0.5,80,1e-3", "--json").stdout)
    assert told["without_feedback"]["error_rms_um"] == pytest.approx(weak["tracking"]["error_rms_um"], rel=1e-6)
    without, after = weak["tracking"]["error_rms_um"], told["tracking"]["error_rms_um"]
    assert told["worth"]["share"] == pytest.approx(1 - after / without)
    assert describe_control(told).count(f"feedback    takes {100 * (1 - after / without):.3g} % off") == 1
    for share, part in (
        (0.5, "takes 50 % off"),
        (0.04, "takes 4 % off"),
        (-0.5, "nothing off"),
        (-0.005, "nothing off"),
        (None, "nothing off"),
    ):
        said = describe_control(told | {"worth": told["worth"] | {"share": share}})
        assert part in said
        alone = "better" if share == -0.5 else "as well"
        assert (f"'microid compensate' does {alone}" in said) == (share != 0.5)
        led = describe_control(told | {"worth": told["worth"] | {"share": share}, "feedforward": "dynamic"})
        assert ("'microid compensate --dynamic' does" in led) == (share != 0.5)
    # What the inverse of the whole stage leaves is told where another feedforward is used.
    led = json.loads(run(*words, "1e-12,0,0", "--feedforward", "dynamic", "--json").stdout)
    assert told["inverse_alone_um"] == pytest.approx(led["tracking"]["error_rms_um"], rel=1e-4)
    assert (told["over_plants_um"], told["strongest_Hz"]) == (pytest.approx(after), pytest.approx(25, rel=0.01))
    assert "alone leaves" not in describe_control(led)


@pytest.mark.study
def test_a_tuned_loop_follows_better_than_its_start_and_says_what_noise_hides(folder, tmp_path):
    options = ["--noise", "0.5", "--delay", "1", "--resolution", "0.001", "--skip", "0.02", "--starts", "1"]
    result = run(
        *("control", folder / "linear.json", folder / "sine.csv", "--out", tmp_path / "r.csv", "--json"),
        *(*options, "--feedforward", "dynamic", "--effort", "0.01"),
    )
    assert result.exit_code == 0, result.output
    told, out = json.loads(result.stdout), columns_of(tmp_path / "r.csv")
    assert told["tuning"]["cost_after_um"] < told["tuning"]["cost_before_um"]
    assert told["margins_worst"]["gain_margin"] is None or told["margins_worst"]["gain_margin"] > 1.99
    kept = slice(20, None)
    error = out["reference_um"] - out["displacement_um"]
    assert told["tracking"]["error_max_um"] == pytest.approx(np.abs(error[kept]).max())
    # Readings are late by one sample, noisy and rounded.
    noise = out["measured_um"][1:] - out["displacement_um"][:-1]
    assert 0.4 < noise.std() < 0.6
    np.testing.assert_allclose(out["measured_um"][1:], np.round(out["measured_um"][1:], 3), atol=1e-9)
    assert any("below the sensor's noise" in remark for remark in told["remarks"])
    assert told["without_feedback"]["error_rms_um"] < 0.1
    words = [line for line in result.stderr.splitlines() if "cost" in line]
    assert len(words) == 2
    # The tuned controller, its filter included, is what --json printed.
    assert told["gains"]["filter_s"] > 0
    (tmp_path / "gains.json").write_text(result.stdout)
    again = run(
        *("control", folder / "linear.json", folder / "sine.csv", "--out", tmp_path / "again.csv", "--json"),
        *(*options, "--feedforward", "dynamic", "--gains", tmp_path / "gains.json"),
    )
    assert again.exit_code == 0, again.output
    assert (tmp_path / "again.csv").read_text() == (tmp_path / "r.csv").read_text()
    assert json.loads(again.stdout)["gains"] == told["gains"]
    assert json.loads(again.stdout)["margins"] == told["margins"]


@pytest.mark.parametrize(
    "kind", [*(pytest.param(k, marks=pytest.mark.study) for k in ("bp-pid", "cmac-pid")), "resonant"]
)
@pytest.mark.study
def test_the_other_controllers_run_on_a_hysteresis(folder, tmp_path, kind):
    result = run(
        *("control", folder / "loop.json", folder / "sine.csv", "--out", tmp_path / "r.csv", "--json", "--quiet"),
        *("--controller", kind, "--gains", "0.2,300,1e-5"),
    )
    assert result.exit_code == 0, result.output
    told, out = json.loads(result.stdout), columns_of(tmp_path / "r.csv")
    assert told["controller"] == kind
    assert np.all((out["command_V"] >= 0) & (out["command_V"] <= 100))
    assert told["tracking"]["e_rms_pct"] < 60
    if kind == "resonant":
        assert told["gains"]["resonant_V_per_um_s"][0] > 0
        (remark,) = [remark for remark in told["remarks"] if "resonator is at" in remark]
        assert float(remark.split("at ")[1].split(" Hz")[0]) == pytest.approx(25, abs=0.5)
    else:
        assert any("before it learns" in remark for remark in told["remarks"])
    # What is printed, changed here and there, is what runs and is printed again.
    assert told["gains"]["pid.proportional_V_per_um"] == 0.2
    own = {"resonant": "lead_deg", "bp-pid": "network.hidden_weight", "cmac-pid": "learning_rate"}[kind]
    changed = np.asarray(told["gains"][own]) * 0.9
    told["gains"] |= {"pid.filter_s": 2e-3, own: changed.tolist()} | ({"filter_s": 2e-3} if kind == "bp-pid" else {})
    (tmp_path / "gains.json").write_text(json.dumps(told))
    for name in ("second", "third"):
        result = run(
            *("control", folder / "loop.json", folder / "sine.csv", "--out", tmp_path / f"{name}.csv", "--json"),
            *("--controller", kind, "--gains", tmp_path / "gains.json"),
        )
        assert result.exit_code == 0, result.output
        assert json.loads(result.stdout)["gains"] == told["gains"]
        (tmp_path / "gains.json").write_text(result.stdout)
    assert (tmp_path / "second.csv").read_text() == (tmp_path / "third.csv").read_text()
    assert (tmp_path / "second.csv").read_text() != (tmp_path / "r.csv").read_text()


@pytest.mark.parametrize(
    ("model", "reference", "options", "words"),
    [
        ("linear.json", "uneven.csv", [], ["even times"]),
        ("linear.json", "short.csv", [], ["16 samples"]),
        ("linear.json", "none.csv", [], ["no such file"]),
        ("none.json", "step.csv", [], ["none.json"]),
        ("slew.json", "step.csv", [], ["SlewLimit", "no form for single samples"]),
        ("loop.json", "sine.csv", ["--feedforward", "dynamic"], ["dynamic", "hysteresis alone"]),
        ("loop.json", "sine.csv", ["--limits", "0,500"], ["voltage limits: "]),
        ("linear.json", "step.csv", ["--limits", "60,10"], ["--limits: expected", "60,10"]),
        ("linear.json", "step.csv", ["--limits", "nan,60"], ["--limits: expected", "nan,60"]),
        ("linear.json", "step.csv", ["--resolution", "1e-320"], ["--resolution"]),
        ("linear.json", "step.csv", [*GIVEN, "--gain-margin", "90"], ["--gain-margin: expected a gain margin of 90"]),
        ("linear.json", "step.csv", [*GIVEN, "--peak", "1.01"], ["--peak: expected a peak"]),
        ("linear.json", "step.csv", [*GIVEN, "--phase-margin", "170"], ["--phase-margin: expected a phase margin"]),
        ("linear.json", "step.csv", [*LIVELY, "--overshoot", "1"], ["--overshoot: expected an overshoot of 1 %"]),
        ("linear.json", "step.csv", ["--noise", "-1"], ["--noise"]),
        ("linear.json", "step.csv", ["--resolution", "0"], ["--resolution"]),
        ("linear.json", "step.csv", ["--gain-margin", "0.5"], ["--gain-margin"]),
        ("linear.json", "step.csv", ["--frequency", "5"], ["--frequency", "resonant"]),
        ("linear.json", "step.csv", ["--controller", "resonant"], ["frequency: no period stands out", "state it"]),
        ("linear.json", "step.csv", ["--gains", "1,2"], ["gains: ", "three numbers"]),
        ("linear.json", "step.csv", ["--gains", "1,2,-3"], ["gains: ", "0 or more"]),
        ("linear.json", "step.csv", ["--gains", "gone.json"], ["gains: ", "gone.json"]),
        ("linear.json", "step.csv", ["--gains", "50,5000,1"], ["unstable"]),
        ("linear.json", "step.csv", ["--skip", "7"], ["--skip"]),
        ("linear.json", "step.csv", ["--plants", "3"], ["uncertainty"]),
        (
            "linear.json",
            "sine.csv",
            ["--controller", "resonant", "--gains", "1,1,0", "--frequency", "900"],
            ["frequency: ", "500 Hz"],
        ),
        (
            "linear.json",
            "sine.csv",
            ["--controller", "resonant", "--gains", "1,1,0", "--frequency", "25", "--frequency", "25"],
            ["frequency: ", "alike"],
        ),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_sentence(folder, tmp_path, model, reference, options, words):
    places = ["control", folder / model, folder / reference, "--out", tmp_path / "r.csv"]
    refused(run(*places, "--plots", tmp_path / "plots", *options), *words)
    assert files(tmp_path) == []


def test_inputs_are_not_overwritten(folder):
    before = (folder / "step.csv").read_text()
    refused(run("control", folder / "linear.json", folder / "step.csv", "--out", folder / "step.csv"), "overwrite")
    assert (folder / "step.csv").read_text() == before


def test_gains_are_not_overwritten_either(folder, tmp_path):
    (tmp_path / "pid.txt").write_text('{"proportional_V_per_um": 1, "integral_V_per_um_s": 1}')
    places = ["control", folder / "linear.json", folder / "step.csv", "--gains", tmp_path / "pid.txt"]
    refused(run(*places, "--out", tmp_path / "pid.txt"), "overwrite")
    assert "proportional" in (tmp_path / "pid.txt").read_text()


@pytest.mark.parametrize(
    ("more", "word"),
    [
        ({}, "derivative_V_s_per_um"),
        ({"derivative_V_s_per_um": True}, "with numbers"),
        ({"derivative_V_s_per_um": [1, 2]}, "one number"),
        ({"derivative_V_s_per_um": 0, "filter": 1e-3}, "filter is no parameter"),
        ({"derivative_V_s_per_um": 0, "filter_s": -1e-3}, "filter_s of 0 or more"),
        ({"derivative_V_s_per_um": 0, "frequency_Hz": [25]}, "resonant_V_per_um_s"),
    ],
)
def test_files_of_gains_are_read_with_care(folder, tmp_path, more, word):
    gains = {"proportional_V_per_um": 0.5, "integral_V_per_um_s": 1} | more
    (tmp_path / "pid.json").write_text(json.dumps({"gains": gains}))
    places = ["control", folder / "linear.json", folder / "sine.csv", "--gains", tmp_path / "pid.json"]
    refused(run(*places, "--controller", "resonant", "--out", tmp_path / "r.csv"), word)


def test_what_is_to_blame_comes_first(folder, tmp_path):
    for more, first in ((["--limits", "9,1"], "--limits"), ([], "uneven.csv")):
        result = run("control", folder / "linear.json", folder / "uneven.csv", "--out", tmp_path / "r.csv", *more)
        assert result.stderr.startswith(f"{first}:")


@pytest.mark.parametrize("options", [["--delay", "1500"], ["--seed", "9" * 26]])
def test_numbers_that_are_far_too_large_are_refused(folder, tmp_path, options):
    result = run("control", folder / "linear.json", folder / "step.csv", "--out", tmp_path / "r.csv", *options)
    assert result.exit_code == 2
    assert options[0] in result.stderr


def test_a_default_limit_that_given_gains_pass_is_said(folder, tmp_path):
    places = ["control", folder / "linear.json", folder / "step.csv", "--out", tmp_path / "r.csv"]
    result = run(*places, *LIVELY, "--resolution", "1e6")
    assert result.exit_code == 0, result.output
    assert "passed: expected a gain margin of 2 or more" in result.stdout
    assert "not settled within the record" in result.stdout
    assert "unlimited s" not in result.stdout
    assert "below the sensor's resolution" in result.stdout


def test_references_that_stand_still_are_told_of_and_those_that_overflow_refused(folder, tmp_path):
    at = T * np.arange(SAMPLES)
    write(tmp_path / "still.csv", at, np.full(SAMPLES, 5.0))
    write(tmp_path / "huge.csv", at, 1e300 * np.sin(2 * np.pi * 25 * at))
    still = run("control", folder / "linear.json", tmp_path / "still.csv", "--out", tmp_path / "r.csv", *GIVEN)
    assert still.exit_code == 0, still.output
    assert "(unlimited" not in still.stdout
    places = ["control", folder / "linear.json", tmp_path / "huge.csv", "--out", tmp_path / "huge_run.csv"]
    refused(run(*places, *GIVEN), "huge.csv, line 3, column 'displacement_um'", "from -1e+09 to 1e+09 um")
    assert not (tmp_path / "huge_run.csv").exists()


def test_choices_in_the_help_are_those_of_the_library():
    (kinds,) = (option.type.choices for option in cli.commands["control"].params if option.name == "controller")
    assert kinds[0] == "pid"
    assert sorted(kinds) == sorted(m.control.CONTROLLERS)


@pytest.mark.study
def test_a_loop_that_rings_beyond_a_limit_between_its_samples_is_refused(tmp_path):
    # Read every second period, a light resonance seems to stand still.
    natural_Hz, interval_s, step_um = 200.0, 0.01, 5.0
    stage = m.Stage.of(piezo=m.Piezo(0.1), mechanics=m.Mechanics(natural_Hz, 0.02))
    save_model(tmp_path / "light.json", stage, None, {})
    at = interval_s * np.arange(40)
    write(tmp_path / "jump.csv", at, step_um * (at > 0.045))
    rate = 2 * np.pi * natural_Hz
    fine_s = np.linspace(0, interval_s, 400)
    peak_um = step_um * step(TransferFunction([rate**2], [1, 0.04 * rate, rate**2]), T=fine_s)[1].max()
    out = tmp_path / "run.csv"
    play = ("control", tmp_path / "light.json", tmp_path / "jump.csv", "--gains", "0,1e-9,0", "--out", out)
    lowest = -3 * step_um
    refused(run(*play, "--limit", f"displacement={lowest}:{0.95 * peak_um}um"), "--limit allows")
    assert not out.exists()
    done = run(*play, "--limit", f"displacement={lowest}:{1.05 * peak_um}um", "--limit", "velocity=1m/s")
    assert done.exit_code == 0, done.stderr
    assert columns_of(out)["displacement_um"].max() < 0.95 * peak_um
