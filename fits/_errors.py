"""The one exception for bad input."""


class DataError(ValueError):
    """Bad input, in one sentence: the file, the place in it, what was expected and what to do.

    The `microid` command prints the sentence on stderr and exits with status 2.

    Attributes
    ----------
    of_model
        Whether it is the model that cannot do what is asked; the command then names its file before the sentence.
    """

    of_model = False


def model_error(sentence: str) -> DataError:
    """Make the error of a model that cannot do what is asked."""
    error = DataError(sentence)
    error.of_model = True
    return error
