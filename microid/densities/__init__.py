"""Families of Preisach densities, one file each.

Importing the package imports every sibling whose name does not start with an underscore; each registers itself.
"""

from microid._plugins import plugins as _plugins
from microid.densities._base import FAMILIES, AbstractDensity, node_areas, register
from microid.densities.grid import GridDensity
from microid.densities.mixture import MixtureDensity
from microid.densities.network import NetworkDensity

# fmt: off
__all__ = [  # noqa: RUF022
    # Families
    "FAMILIES", "GridDensity", "MixtureDensity", "NetworkDensity",
    # What a family is made of
    "AbstractDensity", "node_areas", "register",
]
# fmt: on

_plugins(__name__, __path__)
