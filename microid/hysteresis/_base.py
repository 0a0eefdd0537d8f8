"""The laws that are known, by the names of their files."""

from typing import TypeVar

from microid._part import AbstractHysteresis

LAWS: dict[str, type[AbstractHysteresis]] = {}
"""Every law of hysteresis beside `Preisach`, by the name of its file."""
_Law = TypeVar("_Law", bound=type[AbstractHysteresis])


def register(law: _Law) -> _Law:
    """Make a law known under the name of its file; used as a decorator there.

    Raises
    ------
    ValueError
        If the file has registered one before.
    """
    name = law.__module__.rpartition(".")[2]
    if name in LAWS:
        raise ValueError(f"the hysteresis law {name!r} is defined twice")
    LAWS[name] = law
    return law
