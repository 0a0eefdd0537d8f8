"""Which way of a command between samples a diagnosis takes, by what lines and the other leave."""

from types import SimpleNamespace

import numpy as np
import pytest

from fits.diagnosis._prepare import _Fit
from fits.diagnosis._thresholds import THRESHOLDS


def prefers(hold, lines, other, late, late_after=0.0, best=None, best_after=0.0):
    """Of costs under lines and under the other, what a delay takes off either, and what the best effect does."""
    left, after = np.array([lines**0.5]), np.array([other**0.5])
    fit = SimpleNamespace(
        left=left,
        left_under=lambda _: after,
        delay_drop=lambda at=None: late if at is None else late_after,
        largest_z=lambda at=None: (max(best or 0.0, late) if at is None else max(best_after, late_after)) ** 0.5,
    )
    return _Fit.prefers(fit, hold, THRESHOLDS)


def test_steps_are_taken_that_explain_what_a_delay_does():
    assert prefers("zero", lines=9000, other=5010, late=4000)


def test_steps_that_leave_a_delay_are_not():
    assert not prefers("zero", lines=9000, other=8000, late=4000, late_after=150)


@pytest.mark.parametrize("hold", ["zero", "smooth"])
def test_what_another_effect_explains_better_beside_lines_is_no_way_of_the_command(hold):
    # As backlash does, whose readings seem late by a little.
    assert not prefers(hold, lines=39000, other=28700, late=430, best=31800, best_after=16400)
    assert prefers(hold, lines=39000, other=28700, late=430, best=9000, best_after=8900)


def test_without_a_delay_there_are_no_steps():
    assert not prefers("zero", lines=9000, other=5000, late=20)
