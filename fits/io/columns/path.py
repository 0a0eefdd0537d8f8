"""Through how many volts the command went before each sample, other records included."""

from fits.io._quantity import VOLTAGE, Quantity
from fits.io.columns._base import Column, register

PATH = register(Column(Quantity("path", "V", VOLTAGE), shown_if_constant=True, optional=True)).key
