"""Results that say in plain text what they hold."""

import abc
import html
import importlib
from typing import Any


class AbstractSummary(abc.ABC):
    """A result with a summary, which an interpreter and a notebook show in place of its fields."""

    @abc.abstractmethod
    def summary(self) -> str:
        """Say what was found, values with units, in lines of text without a newline at the end."""

    def __repr__(self) -> str:
        return self.summary()

    def plot(self) -> Any:
        """Draw the result as one `matplotlib.figure.Figure`, which is written nowhere."""
        # By name: the room of pictures knows results, and not the other way round.
        return importlib.import_module("fits.plots._results").drawn(self)

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(self.summary())}</pre>"
