"""What a report says in sentences is what its numbers say, whatever they are."""

import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from _diagnosis import KINDS, diagnosis

from fits.diagnosis._result import Gain
from fits.report._diagnosis import _gained
from fits.report._next_steps import next_steps, runs_read, stage_parameters
from fits.report._words import Lengths, number, verdict_sentence

SIZES_um = (0.0471, 0.0123, 0.04709, 0.0470999, 0.9, np.nan)


def compared(text):
    """How sentences say that an error changes: the words, and both of its sizes as they are printed."""
    found = re.findall(r"(falls|goes) from ([\d.]+) (\S+) to ([\d.]+) (\S+?),", text)
    return [(word, float(before), float(after), unit == other) for word, before, unit, after, other in found]


@pytest.mark.parametrize("kind", KINDS)
def test_no_sentence_contradicts_a_number(rng, kind):
    made = diagnosis(rng, kind, n=100)
    for before, after, sd in product(SIZES_um, SIZES_um, (0.0, 0.0008, 0.1)):
        if np.isnan(before) != np.isnan(after):
            continue
        found = replace(made, gain=Gain(before, after, sd, noise_um=made.noise_um))
        length, words = Lengths(found), verdict_sentence(found)
        for word, first, second, same_unit in compared(words):
            assert same_unit
            assert (word == "falls") == (second < first)
            assert first != second
        if kind == "effect_found" and np.isfinite(after):
            assert ("falls" in words) == (float(length.bare(after)) < float(length.bare(before)))
            said = _gained(found, length)
            assert ("may be chance" in said) == (after != before and abs(before - after) < 2 * sd)
            assert "rises" not in said or after > before
            assert "falls" not in said or after < before
        (step, command), *_ = next_steps(found)
        better = bool(found.causes) and not after >= before
        assert ("extended.json" in command) == better
        assert ("extended" in step) == better
        assert ("Hold a run out" in step) == (better and bool(np.isnan(after)))


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
    assert runs_read(runs)[0][1:4] == ("3000", number(np.ptp(first.time_s)), number(np.ptp(first.voltage_V)))
    silent = replace(found, verdict="unexplained", next_experiment=None)
    assert next_steps(silent)[-1][0].startswith("Record a run at another speed")


def test_parameters_stand_beside_each_other(rng):
    made = diagnosis(rng)
    heads, row = stage_parameters(made)
    assert heads == ("Parameter", "Plain", "95 % interval", "Extended", "95 % interval", "Unit")
    frequency = ("mechanics natural frequency", "149.80", "149.39 to 150.21", "150.020", "149.950 to 150.090", "Hz")
    assert row == frequency
    # Without a cause both are the same.
    assert stage_parameters(diagnosis(rng, "no_effect"))[1] == (*frequency[:3], "Hz")
