"""Families of Preisach densities, one file each.

Importing the package imports every sibling whose name does not start with an underscore; each registers itself.
"""

import importlib
import pkgutil

from microid.densities._base import FAMILIES as FAMILIES
from microid.densities._base import AbstractDensity as AbstractDensity
from microid.densities._base import register as register

for _module in pkgutil.iter_modules(__path__):
    if not _module.name.startswith("_"):
        importlib.import_module(f"{__name__}.{_module.name}")
