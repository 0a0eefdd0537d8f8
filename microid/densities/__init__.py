"""Families of Preisach densities, one file each.

Importing the package imports every sibling whose name does not start with an underscore; each registers itself.
"""

from microid._plugins import plugins as _plugins
from microid.densities._base import FAMILIES as FAMILIES
from microid.densities._base import AbstractDensity as AbstractDensity
from microid.densities._base import register as register

_plugins(__name__, __path__)
