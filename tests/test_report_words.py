"""What a report says in sentences is what its numbers say, whatever they are."""

import re
from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from _diagnosis import KINDS, cause, diagnosis

from fits.diagnosis._conclude import not_named
from fits.diagnosis._experiment import _purpose
from fits.diagnosis._result import Gain
from fits.loop._report_words import _row
from fits.report._diagnosis import _gained, report_html
from fits.report._diagnosis_json import diagnosis_json
from fits.report._next_steps import next_steps, partly_fitted, runs_read, stage_parameters
from fits.report._page import unbroken
from fits.report._words import NONE, headline, length, number, plain, spread, verdict_sentence
from microid.effects import EFFECTS, Scales, extend

SIZES_um = (0.0471, 0.0123, 0.04709, 0.0470999, 0.9, np.nan)


def compared(text):
    """How sentences say that an error changes: the words, and both of its sizes in um."""
    found = re.findall(r"(falls|goes) from (\S+ \S+) to (\S+ \S+?),", text)
    return [(word, size_um(before), size_um(after)) for word, before, after in found]


def size_um(text):
    """A length as it is printed."""
    number, unit = text.split()
    return float(number) * {"pm": 1e-6, "nm": 1e-3, "µm": 1.0}[unit]


@pytest.mark.parametrize("kind", KINDS)
def test_no_sentence_contradicts_a_number(rng, kind):
    made = diagnosis(rng, kind, n=100)
    for before, after, sd in product(SIZES_um, SIZES_um, (0.0, 0.0008, 0.1)):
        if np.isnan(before) != np.isnan(after):
            continue
        found = replace(made, gain=Gain(before, after, sd, noise_um=made.noise_um))
        words = verdict_sentence(found)
        for word, first, second in compared(words):
            assert (word == "falls") == (second < first)
            assert first != second
        if kind == "effect_found" and np.isfinite(after):
            assert ("falls" in words) == (size_um(length(after)) < size_um(length(before)))
            said = _gained(found)
            assert ("may be chance" in said) == (after != before and abs(before - after) < 2 * sd)
            assert "rises" not in said or after > before
            assert "falls" not in said or after < before
        (step, command), *_ = next_steps(found)
        better = bool(found.causes) and not after >= before
        assert ("extended.json" in command) == better
        assert ("extended" in step) == better
        assert ("Hold a run out" in step) == (better and bool(np.isnan(after)))


SIZE = r"([\d.]+ [pnµ]m)"
TILES = ("Residual of the plain stage in the fit", "Noise floor", "Unexplained, beyond the noise")


def test_sentence_tile_step_and_json_give_one_residual_by_one_name(rng):
    made = diagnosis(rng, "unexplained")
    # What comes before a run has forgotten its past is off by far more than all that counts.
    runs = tuple(replace(run, before_um=run.before_um + np.where(run.fitted, 0.0, 50.0)) for run in made.runs)
    left_um = np.concatenate([run.before_um[run.fitted] for run in runs])
    residual_um = np.sqrt(np.mean(left_um**2))
    for gain in (Gain(noise_um=made.noise_um), made.gain):
        found = replace(made, causes=(), runs=runs, gain=gain, unexplained_rms_um=0.00167)
        page = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", report_html(found)))
        tiles = [size_um(re.search(rf"{name}, rms {SIZE}", page)[1]) for name in TILES]
        words = rf"leaves a residual of {SIZE}.* noise floor of {SIZE}. .* reproducible error of {SIZE}"
        said = [size_um(one) for one in re.search(words, verdict_sentence(found)).groups()]
        content = diagnosis_json(found)
        listed = [content[name] for name in ("residual_rms_before_um", "noise_um", "unexplained_rms_um")]
        for one in (tiles, said, listed):
            np.testing.assert_allclose(one, [residual_um, made.noise_um, 0.00167], rtol=0.006)
        expected = size_um(re.search(rf"Expect errors of {SIZE}", next_steps(found)[0][0])[1])
        known = np.isfinite(gain.heldout_rms_before_um)
        assert expected == pytest.approx(gain.heldout_rms_before_um if known else 0.00167, rel=0.006)
        assert ("not used" in next_steps(found)[0][0]) == known


def test_no_verb_follows_a_name_as_some_are_plural(rng):
    made = diagnosis(rng)
    verbs = "is|are|was|were|has|have|explains?|shows?|does|do"
    for name in {effect.name for effect in EFFECTS}:
        found = replace(made, causes=(replace(cause(name), fingerprint=""),), runs=(), next_experiment=None)
        page = re.sub(r"<[^>]+>", " ", report_html(found))
        text = " ".join([verdict_sentence(found), next_steps(found)[0][0], found.summary(), page])
        assert plain(name) in text
        assert not re.search(rf"{plain(name)} ({verbs})\b", text, re.IGNORECASE)


def text_of(found):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", report_html(found)))


def test_a_share_says_what_it_is_a_part_of(rng):
    made = diagnosis(rng)
    for name, part, other in (("floor_vibration", "noise", "misfit"), ("creep", "misfit", "noise")):
        found = replace(made, causes=(cause(name),))
        assert f"93 % of the {part}" in found.summary()
        page = text_of(found)
        assert f"Share of the {part} 93 %" in page
        assert f"Share of the {part} it explains 93 %" in page
        assert f"Share of the {other}" not in page


def test_columns_are_asked_for_that_the_stage_reads(rng):
    """An effect may have a form that reads a temperature and one that does without."""
    made = replace(diagnosis(rng), causes=(cause("thermal_gain"),))
    for form in (form for form in EFFECTS if form.name in ("thermal_gain", "thermal_drift")):
        steps = " ".join(words for words, _ in next_steps(replace(made, extended=SimpleNamespace(parts=(form,)))))
        asked = "more columns in reference.csv: temperature_degC."
        assert (asked in steps) == (form.form == "temperature")


def test_what_a_run_has_of_its_own_is_not_compensated(rng):
    """A hum begins at any phase, so that its compensation may double it."""
    made = diagnosis(rng)
    forms = {form.name: form for form in reversed(EFFECTS)}
    scene = Scales(0.0, 100.0, 1e3, 20.0, 10.0, 1e-3, 20.0, 2.0, 0.01)
    drift, hum = (forms[name].probes(scene, None)[0][0] for name in ("thermal_drift", "mains_hum"))
    none = replace(drift, rate_um_per_s=0 * drift.rate_um_per_s)
    # A rail has no strength that could be none.
    rail = forms["driver_saturation"].probes(scene, None)[0][0]
    rest = made.runs[0], replace(made.runs[1], fitted=np.zeros_like(made.runs[1].fitted))
    for part, runs, kept in (
        (drift, made.runs, True),
        (rail, made.runs, True),
        (none, made.runs, False),
        (drift, rest, False),
        (hum, made.runs, False),
    ):
        found = replace(made, causes=(cause(part.name),), extended=extend(made.baseline, part), runs=runs)
        (step, command), *_ = next_steps(found)
        assert ("extended.json" in command) == kept
        assert ("says nothing of the next" in step) != kept
        both = replace(found, causes=(cause("creep"), *found.causes))
        (step, command), *_ = next_steps(both)
        assert "extended.json" in command
        assert f"which has creep{f' and {plain(part.name)}' if kept else ';'}" in step
        assert (f"what a run has of {plain(part.name)} says nothing" in step) != kept


def test_the_temperature_is_spoken_of_where_there_was_one(rng):
    made = diagnosis(rng)
    warm = replace(made.tests[0], name="temperature")
    for tests, spoken in ((made.tests, False), ((*made.tests, warm), True)):
        assert ("goes with the temperature, too" in text_of(replace(made, tests=tests))) == spoken


def test_evidence_that_names_no_cause_is_explained(rng):
    made = diagnosis(rng)
    loud = replace(made.upper_bounds[0], z=15.1)
    assert "names no cause here" not in text_of(made)
    assert "Evidence above 8 \N{GREEK SMALL LETTER SIGMA} names no cause here" in text_of(
        replace(made, upper_bounds=(loud,))
    )


def test_what_is_to_be_recorded_does_not_contradict_itself(rng):
    for kind in KINDS:
        found = replace(diagnosis(rng, kind), next_experiment=None)
        page, steps = text_of(found), " ".join(words for words, _ in next_steps(found))
        assert ("Record a run" in steps) == (kind == "unexplained")
        assert "What to measure next" not in page
        # Why not, a remark says where there is a reason: the page has none of its own beside it.
        assert "would not tell which known effect" not in page
        assert ("that beside what was found" in page) == bool(found.causes)


def test_a_headline_has_every_effect_that_a_cause_may_be(rng):
    made = replace(diagnosis(rng), causes=(cause("creep", ("aging",)), cause("friction")))
    assert headline(made) == "The stage shows creep (or aging) and friction."
    assert headline(replace(made, causes=made.causes[:1])) == "The stage shows creep or aging."


def test_several_causes_have_one_sentence_with_the_whole_that_each_is_a_part_of(rng):
    made = replace(diagnosis(rng), causes=(cause("floor_vibration"), cause("creep"), cause("friction")))
    first, *_ = verdict_sentence(made).split(". Beyond")
    assert re.match(
        r"Of the reproducible misfit .*93 % is explained by creep .* and 93 % by friction .*; of the", first
    )
    assert re.search(r"; of the noise 93 % is explained by floor vibration \([^()]*\)$", first)
    assert first.count("standard deviations") == 2


def test_no_line_ends_between_a_number_and_its_unit(rng):
    page = report_html(diagnosis(rng, "unexplained"))
    text = re.sub(r"<pre.*?</pre>|<svg.*?</svg>|<style.*?</style>|<[^>]+>", " ", page, flags=re.DOTALL)
    quantity = r"\d(\s)(?:%|[pnµ]m|s|Hz|V|\N{GREEK SMALL LETTER SIGMA})(?![\w/])"
    breaks = re.findall(quantity, text)
    assert len(breaks) > 20
    assert set(breaks) == {"\N{NO-BREAK SPACE}"}
    times, space = "\N{MULTIPLICATION SIGN}", "\N{NO-BREAK SPACE}"
    told = unbroken(f"1.2 {times} 10⁻⁵ or below 10⁻⁹, 3 {times} 4")
    assert told == f"1.2{space}{times}{space}10⁻⁵ or below{space}10⁻⁹, 3 {times} 4"


def test_numbers_of_an_experiment_stand_once_and_of_one_suspect_not_beside_its_evidence(rng):
    made = diagnosis(rng, "unexplained")
    page = text_of(made)
    assert page.count(made.next_experiment.purpose) == 1
    assert "Tells apart creep and aging" in page
    one = replace(made, next_experiment=replace(made.next_experiment, separates=("creep",)))
    assert "Would show creep" in text_of(one)
    assert "Predicted separation" not in text_of(one)


def test_what_is_found_in_the_noise_is_said_to_stay(rng):
    for name in ("floor_vibration", "creep"):
        assert ("no model takes it away" in text_of(replace(diagnosis(rng), causes=(cause(name),)))) == (
            name != "creep"
        )


def test_lengths_are_in_the_unit_that_they_ask_for():
    sizes_um = (123.4, 1.0, 0.9996, 0.99949, 0.00115, 0.001, 0.0009994, 1.15e-9, 2e-14, 0.0, -0.0471, np.nan)
    shown = "123 µm, 1.00 µm, 1.00 µm, 999 nm, 1.15 nm, 1.00 nm, 999 pm, 0.00115 pm, < 0.001 pm, 0 µm, -47.1 nm, "
    assert ", ".join(map(length, sizes_um)) == shown + NONE
    assert spread(0.0348, 0.0008) == "34.8 ± 0.80 nm"
    assert spread(0.0002, 0.0013) == "0.200 ± 1.3 nm"
    assert spread(0.0348, np.nan) == "34.8 nm"


def test_what_is_left_is_called_noise_only_where_it_is(rng):
    quiet = diagnosis(rng, "no_effect")
    still = replace(quiet, runs=tuple(replace(run, before_um=run.after_um) for run in quiet.runs))
    assert "down to a noise floor" in verdict_sentence(still)
    assert re.search(r"leaves 3\d\.\d nm, .* over a noise floor of 10\.1 nm", verdict_sentence(quiet))


def test_commands_name_the_runs_and_those_held_out(rng):
    made = diagnosis(rng)
    first, second = made.runs
    runs = replace(first, source="slow.csv"), replace(second, source="a b.csv", fitted=np.zeros_like(second.fitted))
    found = replace(made, runs=runs)
    again = next_steps(found)[1][1]
    assert again == "microid diagnose slow.csv answer.csv --holdout 'a b.csv' --out again"
    assert [row[-1] for row in runs_read(runs)] == ["80 % fitted", "held out"]
    assert "was looked at to choose" in partly_fitted(runs, True)
    assert "the end was held out" in partly_fitted(runs[:1], True)
    assert "nothing was held out" in partly_fitted(runs[:1], False)
    assert partly_fitted(runs[1:], True) == ""
    row = "3000", "100", number(np.ptp(first.time_s)), number(np.ptp(first.voltage_V)), "voltage, displacement"
    assert runs_read(runs)[0][1:6] == row
    warm = replace(runs[1], extra=("temperature_degC", "pump_on", "path_V"), time_s=runs[1].time_s ** 1.1)
    rows = runs_read((runs[0], warm), ("data/slow.csv", "more/a b.csv"))
    assert [one[0] for one in rows] == ["data/slow.csv", "more/a b.csv"]
    assert rows[1][2].startswith("uneven")
    assert rows[1][5] == "voltage, displacement, temperature, pump on"
    assert "data/slow.csv" in report_html(found, "", ("data/slow.csv", "more/a b.csv"))
    assert [one[0] for one in runs_read(runs, ("elsewhere.csv",))] == ["slow.csv", "a b.csv"]
    silent = replace(found, verdict="unexplained", next_experiment=None)
    assert next_steps(silent)[-1][0].startswith("Record a run at another speed")


def test_parameters_stand_beside_each_other(rng):
    made = diagnosis(rng)
    heads, row = stage_parameters(made)
    assert heads == ("Parameter", "Plain", "95 % interval", "Extended", "95 % interval")
    name = "mechanics natural frequency (Hz)"
    frequency = (name, "149.80", "149.39 to 150.21", "150.020", "149.950 to 150.090")
    assert row == frequency
    # Without a cause both are the same.
    assert stage_parameters(diagnosis(rng, "no_effect"))[1] == frequency[:3]


def test_errors_of_a_fit_are_in_the_unit_that_they_ask_for():
    errors = {"samples": 100, "e_rms_pct": 0.07, "rms_um": 0.01217, "e_max_pct": 9.0, "max_um": 1.5}
    row = _row("in-sample", errors)
    assert "12.17 nm" in row
    assert "1.5" in row.split("9 %")[1]
    assert row.endswith(" um")


def test_what_explains_no_part_has_no_share_and_what_is_computed_is_not_measured(rng):
    """Neighbours that agree by 37 standard deviations stood beside a share of 0 %."""
    made = diagnosis(rng)
    some = replace(made.tests[0], statistic=30.0, share=0.42, sentence="It depends.")
    tests = some, replace(some, name="whiteness", share=0.0, sentence="Neighbours agree.")
    driven = replace(made.gain, feedforward_before_um=0.2, feedforward_after_um=0.01)
    page = text_of(replace(made, tests=tests, gain=driven)).replace("\N{NO-BREAK SPACE}", " ")
    assert "42 % It depends" in page
    assert f"{NONE} Neighbours agree" in page
    assert "Predicted error under feedforward, rms, before → after 200 nm → 10.0 nm" in page
    assert "computed, not measured" in page


def test_what_only_the_readings_have_is_told_from_what_the_stage_has(rng):
    """The voltage that makes a lagging reading follow makes the stage lead."""
    made = diagnosis(rng)
    for names, said in (
        (("creep",), ""),
        (("creep", "sensor_lowpass"), "Only the readings have sensor lowpass: they"),
    ):
        found = replace(made, causes=tuple(map(cause, names)))
        (step, command), *_ = next_steps(found)
        assert "extended.json" in command
        assert (said in step) if said else ("readings" not in step)


def test_one_suspect_is_not_spoken_of_as_several():
    assert not_named(["creep"], "w").endswith("creep came nearest to what is left, but w: it is not named")
    assert not_named(["creep", "load_change"], "w").startswith("creep, load change came nearest")
    assert not_named(["creep", "load_change"], "w").endswith("none of them is named")


@pytest.mark.parametrize("present_z", [0.0, 2.0])
def test_what_to_play_where_no_effect_was_found_does_not_suppose_one(rng, present_z):
    """The report said that no effect was found, and asked for an experiment on the one that was suspected."""
    purpose = _purpose(("load_change",), 6.0, present_z, "")
    assert re.search("by 6.0 standard deviations" if present_z == 0 else "3.0 times as clearly", purpose)
    ahead = replace(diagnosis(rng).next_experiment, purpose=purpose, separates=("load_change",))
    none, open_ = (replace(diagnosis(rng, kind), next_experiment=ahead) for kind in ("no_effect", "unexplained"))
    step = next_steps(none)[1][0]
    assert step.startswith("To be surer that there is no effect, play next_experiment.csv")
    assert "If the rig has load change after all" in step
    assert next_steps(open_)[1][0].startswith("Play next_experiment.csv")
    for told in (none.summary(), text_of(none)):
        assert purpose in told
        assert "suspect" not in told
