"""The one exception for bad input."""


class DataError(ValueError):
    """Bad input, in one sentence: the file, the place in it, what was expected and what to do.

    The `microid` command prints the sentence on stderr and exits with status 2.
    """


class ModelError(DataError):
    """A model that cannot do what is asked; the command names its file before the sentence."""
