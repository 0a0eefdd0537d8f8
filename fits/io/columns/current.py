"""The current into the piezo."""

from fits.io._quantity import Quantity
from fits.io.columns._base import Column, register

register(Column(Quantity("current", "A", {"A": 0, "mA": -3, "uA": -6, "nA": -9})))
