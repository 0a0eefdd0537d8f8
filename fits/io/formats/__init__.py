"""Formats of files, one file each, which registers it when the package is imported."""

from fits.io._late import import_all as _import_all
from fits.io.formats._base import FORMATS as FORMATS
from fits.io.formats._base import Format as Format
from fits.io.formats._base import register as register

_import_all(__name__, __path__)
