"""The one exception for bad input, how its sentences quote what was found, and what names a file."""

import json
import os
from typing import Any

AnyPath = str | os.PathLike[str]

# What is quoted, and a whole sentence, are cut to so many characters; so many are kept at its end.
_SHOWN, _SENTENCE, _END = 60, 1000, 400


class DataError(ValueError):
    """Bad input, in one sentence: the file, the place in it, what was expected and what to do.

    The `microid` command prints the sentence on stderr and exits with status 2. Of more than 1,000 characters the
    middle is left out: what was expected stands at the beginning, and what to do at the end. `of_model` says whether
    a model cannot do what is asked; the command names its file before the sentence.
    """

    def __init__(self, sentence: object = "", *, of_model: bool = False) -> None:
        self.of_model = of_model
        super().__init__(without_middle(str(sentence)))


def reason_of(error: Exception) -> str:
    """Say why, as the system does."""
    return str(getattr(error, "strerror", None) or error)


def without_middle(sentence: str) -> str:
    """Leave out what a sentence has beyond 1,000 characters, in its middle."""
    return sentence if len(sentence) <= _SENTENCE else f"{sentence[: _SENTENCE - _END - 5]} ... {sentence[-_END:]}"


def shown(found: Any) -> str:
    """Write what was found in a file as TOML and JSON have it, short enough for a sentence."""
    if found is None:
        return "nothing"
    if isinstance(found, dict | list):
        return "a table" if isinstance(found, dict) else "a list"
    if isinstance(found, int) and abs(found) >= 10**_SHOWN:  # more digits take long to write
        return "an enormous number"
    if isinstance(found, str):
        found = " ".join(found[: 2 * _SHOWN].split())
    text = json.dumps(found, ensure_ascii=False) if isinstance(found, str | bool) else str(found)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."
