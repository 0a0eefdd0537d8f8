"""The whole question on fresh rigs: an effect is hidden, the command sees only CSVs, and then the truth is opened."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from _command import files, run
from _seed import seed_of
from test_diagnosis_report import violations

import data_synth
from fits.report._diagnosis_json import diagnosis_schema

# Effects of the library that are found as good as always at five times the noise.
FOUND = ("creep",)
# Without an effect, a rig in a thousand may be accused.
FALSE_ALARM = 0.001
SAMPLES = {"slow_samples": 1500, "fast_samples": 2000}


def diagnosed(folder, effects, *options):
    """Hide effects in a fresh rig, and diagnose its CSVs; the truth stays in a folder of its own."""
    seed = seed_of(f"test_hidden_effect {effects}")
    bench = data_synth.hidden(effects, seed=seed, **SAMPLES)
    runs, truth = folder / "runs", folder / "truth"
    data_synth.write(bench, runs)
    truth.mkdir()
    (runs / "truth.json").rename(truth / "truth.json")
    slow, fast, *aside = (runs / f"{record.name}.csv" for record in bench.records)
    holdout = [word for path in aside for word in ("--holdout", path)]
    # However slow the machine is.
    patient = "--budget", "3600"
    done = run("diagnose", slow, fast, *holdout, *patient, *options, "--out", folder / "diagnosis", "--quiet")
    assert done.exit_code == 0, f"seed {seed}: {done.output}"
    found = json.loads((folder / "diagnosis" / "diagnosis.json").read_text())
    return SimpleNamespace(
        seed=f"replay with MICROID_SEED={seed}",
        folder=folder,
        aside=aside,
        words=done.stdout,
        found=found,
        truth=json.loads((truth / "truth.json").read_text()),
    )


def named(cause):
    return {cause["name"], *cause["also_consistent"]}


@pytest.fixture(scope="module", params=FOUND)
def case(request, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patched:
        # No run is longer: half of what is computed would be padding.
        patched.setattr("fits.loop._run._SHORTEST", 2048)
        return diagnosed(tmp_path_factory.mktemp(request.param), [request.param])


def test_the_hidden_effect_is_named(case):
    [hidden] = case.truth["effects"]
    assert case.found["verdict"] == "effect_found", case.seed
    first = case.found["causes"][0]
    assert hidden["name"] in named(first), case.seed
    assert first["z"] > 5, case.seed
    assert first["p_family"] < 0.01, case.seed
    assert first["name"] in case.words, case.seed


def test_the_noise_is_that_of_the_sensor(case):
    assert case.found["noise_um"] == pytest.approx(case.truth["sensor"]["noise_um"], rel=0.25), case.seed


def test_the_extension_is_worth_something_on_runs_it_has_not_seen(case):
    gain = case.found["gain"]
    assert gain["heldout_rms_after_um"] <= gain["heldout_rms_before_um"], case.seed


def test_all_files_are_there_and_keep_to_their_schema(case):
    written = set(files(case.folder / "diagnosis"))
    assert {"report.html", "diagnosis.json", "baseline.json", "extended.json"} <= written
    assert ("next_experiment.csv" in written) == (case.found["next_experiment"] is not None)
    assert violations(case.found, diagnosis_schema()) == [], case.seed


def test_no_sentence_contradicts_a_number(case):
    found, page = case.found, (case.folder / "diagnosis" / "report.html").read_text(encoding="utf-8").lower()
    named = {name for cause in found["causes"] for name in (cause["name"], *cause["also_consistent"])}
    assert (found["verdict"] == "effect_found") == bool(found["causes"]), case.seed
    # What is named is not among what was not found, and what could not be seen has no evidence.
    for bound in found["upper_bounds"]:
        assert bound["name"] not in named, case.seed
        assert not bound["reason"] or not bound["z"], (case.seed, bound)
    gain = found["gain"]
    worse = gain["heldout_rms_after_um"] - gain["heldout_rms_before_um"]
    assert worse < 2 * gain["sd_of_difference_um"], case.seed
    for words, verdict in (("effect found", "effect_found"), ("no effect found", "no_effect")):
        assert (words in case.words) == (found["verdict"] == verdict), case.seed
    for name in named:
        assert name.replace("_", " ") in page or name in page, (case.seed, name)
    if found["causes"]:
        assert sum(cause["share_of_misfit"] for cause in found["causes"]) >= 0.65, case.seed


def test_the_extended_model_simulates_new_runs_better(case):
    squares = {}
    for which in ("baseline", "extended"):
        model = case.folder / "diagnosis" / f"{which}.json"
        squares[which] = 0.0
        for csv in case.aside:
            out = case.folder / f"{which}_{csv.name}"
            done = run("simulate", model, csv, "--out", out, "--json")
            assert done.exit_code == 0, f"{case.seed}: {done.output}"
            measured, said = (np.genfromtxt(file, delimiter=",", names=True) for file in (csv, out))
            off_um = measured["displacement_um"] - said["displacement_um"]
            squares[which] += np.sum((off_um - off_um.mean()) ** 2)
            sd_um = json.loads(done.stdout)["displacement_sd_median_um"]
            assert sd_um == pytest.approx(float(np.median(said["displacement_sd_um"])), rel=1e-9)
            if which == "extended":
                # Of normal errors as large together as the band and the noise say, three in a million are so large.
                assert np.std(off_um) < np.hypot(1.1 * case.found["noise_um"], 4.5 * sd_um), case.seed
    assert squares["extended"] <= squares["baseline"], case.seed


def test_the_stage_beside_the_cause_is_known_as_well_as_is_said(case):
    found, plant = case.found["extended_parameters"], case.truth["plant"]
    names = ("driver.time_constant_s", "mechanics.natural_frequency_Hz", "mechanics.damping_ratio")
    for name in names:
        one, true = found[name], plant[name.partition(".")[2]]
        # Of a normal error, three in a million are as large.
        assert abs(one["value"] - true) < 4.5 * one["sd"] < 0.1 * true, (case.seed, name)
        assert one["lower"] < one["value"] < one["upper"], (case.seed, name)


@pytest.mark.study
def test_an_answer_in_no_time_says_what_was_not_asked(tmp_path):
    case = diagnosed(tmp_path, ["creep"], "--budget", "1e-3")
    assert case.found["causes"] == [], case.seed
    assert case.found["next_experiment"] is None, case.seed
    assert any("the time was over" in words for words in case.found["remarks"]), case.seed
    assert {"report.html", "extended.json"} <= set(files(case.folder / "diagnosis"))


@pytest.mark.study
def test_a_rig_without_an_effect_is_not_accused(tmp_path):
    case = diagnosed(tmp_path, [], "--false-alarm", FALSE_ALARM)
    assert "effects" not in case.truth
    assert case.found["verdict"] != "effect_found", case.seed
    assert case.found["causes"] == [], case.seed
