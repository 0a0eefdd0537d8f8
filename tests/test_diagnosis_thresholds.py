"""What decides in a diagnosis stands in one place, and each number is explained there."""

import dataclasses
import re

import pytest

import fits


def test_fewer_than_twenty_numbers_decide_and_each_is_explained():
    fields = [field.name for field in dataclasses.fields(fits.Thresholds)]
    assert len(fields) < 20
    listed = fits.Thresholds.__doc__.split("Attributes")[1]
    explained = {name for line in re.findall(r"^    (\w[\w, ]*)$", listed, re.M) for name in line.split(", ")}
    assert explained == set(fields)


def test_a_budget_is_a_time():
    with pytest.raises(fits.DataError, match=r"budget.*positive"):
        fits.diagnose([fits.Record([0.0, 1.0, 2.0], [0.0, 1.0, 2.0], [0.0, 1.0, 2.0])], budget_s=0.0)
