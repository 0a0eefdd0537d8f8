"""Formats of files, one file each, which registers it when the package is imported."""

from fits.io.formats._base import FORMATS as FORMATS
from fits.io.formats._base import Format as Format
from fits.io.formats._base import register as register
from microid._plugins import plugins as _plugins

_plugins(__name__, __path__)
