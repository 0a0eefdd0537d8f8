"""Tables of TOML and JSON as structs: what is read, and the sentence on the first fault."""

from typing import Annotated

import msgspec
import pytest

from fits.io._errors import DataError
from fits.io._typed import typed


class Part(msgspec.Struct):
    size: float
    unit: str = "mm"
    tolerance: float | None = None


class Whole(msgspec.Struct):
    parts: list[Part]
    count: int = 1
    share: Annotated[float, msgspec.Meta(ge=0, le=1, description="a share from 0 to 1")] = 0.5
    words: Annotated[list[str], msgspec.Meta(min_length=1, description="one word or more")] = msgspec.field(
        default_factory=lambda: ["a"]
    )


def test_what_is_left_out_has_its_default():
    found = typed({"parts": [{"size": 2}, {"size": 0.5, "unit": "um", "tolerance": 1}], "words": ["x", "y"]}, Whole)
    assert found == Whole([Part(2.0), Part(0.5, "um", 1.0)], 1, 0.5, ["x", "y"])
    assert isinstance(found.parts[0].size, float)


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ([], "it: expected a table of parts, count, share, words, found a list; write [it] and its keys below."),
        ({}, "it.parts: expected this key, found none; add it."),
        ({"parts": {}}, "it.parts: expected a list, found a table; put what is in it in brackets."),
        ({"parts": [], "shar": 1}, 'it.shar: expected a known key, found "shar"; did you mean share?'),
        ({"parts": [{"size": 1}, {}]}, "it.parts[1].size: expected this key, found none; add it."),
        (
            {"parts": [{"size": "1"}]},
            'it.parts[0].size: expected a finite number, found "1"; give one without quotes.',
        ),
        (
            {"parts": [{"size": float("nan")}]},
            "it.parts[0].size: expected a finite number, found nan; give one without quotes.",
        ),
        (
            {"parts": [{"size": 1, "tolerance": float("inf")}]},
            "it.parts[0].tolerance: expected a finite number, found inf; give one without quotes.",
        ),
        ({"parts": [{"size": 1, "unit": 3}]}, "it.parts[0].unit: expected a text, found 3; put it in quotes."),
        (
            {"parts": [], "count": True},
            "it.count: expected a whole number, found true; give one without quotes or a point.",
        ),
        ({"parts": [], "share": 1.5}, "it.share: expected a share from 0 to 1, found 1.5; correct it."),
        ({"parts": [], "words": []}, "it.words: expected one word or more, found a list; correct it."),
        ({"parts": [], "x - at `$.y`": 1}, "it.x - at `$.y`: expected a known key"),
    ],
)
def test_the_first_fault_is_a_sentence(table, sentence):
    with pytest.raises(DataError) as refused:
        typed(table, Whole, "it")
    assert str(refused.value).startswith(sentence)
