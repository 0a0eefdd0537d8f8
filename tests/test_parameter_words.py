"""Parameters that runs do not show are told in words wherever parameters are printed."""

import re
from dataclasses import replace

import numpy as np
from _diagnosis import diagnosis

from fits import ParameterEstimate
from fits.io._json import strict
from fits.loop._report_words import UNDETERMINED, UNSEEN, parameter_lines, unseen
from fits.report._next_steps import stage_parameters
from fits.report._words import estimate


def test_a_parameter_at_its_bound_that_nothing_shows_gets_no_numbers(rng):
    """A time constant of nothing is seen where the interval is short, and not where it may be anything."""
    open_end = ParameterEstimate("driver.time_constant_s", "s", 2e-9, 5.7, 1e-9, 22.4)
    short = replace(open_end, sd=1e-6, upper=2e-6)
    at_zero, onset = (
        replace(open_end, value=0.0, lower=0.0),
        replace(open_end, value=0.01 + 1e-12, lower=0.01, upper=0.015),
    )
    free = replace(open_end, value=1.0)
    for one, seen in ((open_end, False), (short, True), (at_zero, True), (onset, True), (free, True)):
        (line,) = parameter_lines([strict(vars(one))])
        assert (UNSEEN in line) != seen
        assert (UNSEEN in estimate(one)) != seen
        found = diagnosis(rng)
        found = replace(found, causes=(replace(found.causes[0], parameters=(one,)),), baseline_parameters=(one,))
        assert (UNSEEN in found.summary()) != seen
        assert (UNSEEN in stage_parameters(found)[1]) != seen
        if not seen:
            assert "22.4" not in line + found.summary() + " ".join(stage_parameters(found)[1])


def test_an_interval_that_says_nothing_is_told_in_words_wherever_parameters_are(rng):
    """A time constant of 1e-9 s that may be anything was told as 1e-9 ± 1.5e13 s."""
    given = ParameterEstimate("driver.time_constant_s", "s", 1e-9, 1.5e13, 1e-9, 3e13)
    for one, words in (
        (given, UNSEEN),
        (replace(given, upper=np.inf), UNSEEN),
        (replace(given, value=0.001, lower=1e-9, upper=1e3, sd=250.0), UNDETERMINED),
        (replace(given, value=3.0, lower=-3e13, upper=3e13), UNDETERMINED),
        # An offset near zero, a bound of one side, a gain that may be zero, and one that is known exactly.
        (replace(given, value=1e-6, lower=-0.2, upper=0.2, sd=0.1), ""),
        (replace(given, value=12.0, lower=10.0, upper=np.inf, sd=np.inf), ""),
        (replace(given, value=0.0, lower=0.0, upper=0.4, sd=0.2), ""),
        (replace(given, value=-2.0, lower=-2.0, upper=-2.0, sd=0.0), ""),
        (replace(given, value=-2.0, lower=-2.0, upper=np.nextafter(-2.0, 0), sd=1e-17), ""),
    ):
        assert unseen(one.value, one.lower, one.upper) == words
        found = diagnosis(rng)
        found = replace(found, causes=(replace(found.causes[0], parameters=(one,)),), baseline_parameters=(one,))
        (line,) = parameter_lines([strict(vars(one))])
        for told in (line, found.summary(), " ".join(estimate(one)), " ".join(stage_parameters(found)[1])):
            assert (words in told) if words else ("these runs" not in told)
            assert not words or not re.search(r"e\+?1\d|10¹|inf", told)
    assert unseen(3.0, -np.inf, np.inf) == UNDETERMINED
    # As JSON has what is not known.
    assert unseen(3.0, None, None) == unseen(None, None, 1.0) == ""
