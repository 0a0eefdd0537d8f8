"""The one exception for bad input."""

# Of a longer sentence the middle is left out: what is wrong stands at the beginning, and what to do at the end.
_SENTENCE, _END = 1000, 400


class ScenarioError(ValueError):
    """Bad input, in one sentence: the file, the key in it, what was expected and what to do.

    The command `python -m data_synth` prints the sentence on stderr and exits with status 2. Of more than 1,000
    characters the middle is left out.
    """

    def __init__(self, sentence: object = "") -> None:
        text = str(sentence)
        if len(text) > _SENTENCE:
            text = f"{text[: _SENTENCE - _END - 5]} ... {text[-_END:]}"
        super().__init__(text)
