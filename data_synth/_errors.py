"""The one exception for bad input."""


class ScenarioError(ValueError):
    """Bad input, in one sentence: the file, the key in it, what was expected and what to do.

    The command `python -m data_synth` prints the sentence on stderr and exits with status 2.
    """
