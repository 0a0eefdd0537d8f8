"""Through how many volts the command went before each sample, other records included."""

import numpy as np

from fits.io._quantity import VOLTAGE, FloatArray, Quantity
from fits.io.columns._base import Column, register

PATH = register(Column(Quantity("path", "V", VOLTAGE), shown_if_constant=True, optional=True)).key


def gone_V(voltage_V: FloatArray) -> FloatArray:
    """Through how many volts a command went from its first sample to each."""
    return np.cumsum(np.abs(np.diff(voltage_V, prepend=voltage_V[0])))
