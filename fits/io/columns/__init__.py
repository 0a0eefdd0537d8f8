"""Further columns of a record, one file each, which registers it when the package is imported."""

from fits.io.columns._base import COLUMNS as COLUMNS
from fits.io.columns._base import Column as Column
from fits.io.columns._base import columns_beside as columns_beside
from fits.io.columns._base import register as register
from microid._plugins import plugins as _plugins

_plugins(__name__, __path__)
