"""Physical effects that the plain stage lacks, one file each.

Importing the package imports every sibling whose name does not start with an underscore; each registers itself.
"""

from microid._plugins import plugins as _plugins
from microid.effects._base import (
    EFFECTS,
    PLACES,
    AbstractEffect,
    Place,
    Scales,
    Statistic,
    View,
    card_of,
    extend,
    host,
    register,
)

# fmt: off
__all__ = [  # noqa: RUF022
    # Effects, and a stage that has some
    "AbstractEffect", "EFFECTS", "extend", "host",
    # What is known of an effect
    "PLACES", "Place", "Scales", "Statistic", "View", "card_of", "register",
]
# fmt: on

_plugins(__name__, __path__)
