"""Measured quantities: the name of each, and the units it may come in."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LENGTH = {"um": 0, "nm": -3, "mm": 3, "m": 6, "pm": -6}
VOLTAGE = {"V": 0, "mV": -3, "uV": -6, "kV": 3}
TIME = {"s": 0, "ms": -3, "us": -6, "ns": -9}
# Words for units, as programs of measurement have them.
_WORDS = {"second": "s", "sec": "s", "millisecond": "ms", "msec": "ms", "microsecond": "us"}
_WORDS |= {"minute": "min", "hour": "h"}
_WORDS |= {"volt": "V", "millivolt": "mV", "kilovolt": "kV", "kelvin": "K", "celsius": "degC"}
_WORDS |= {"meter": "m", "millimeter": "mm", "micrometer": "um", "micron": "um", "nanometer": "nm"}
_WORDS |= {"metre": "m", "millimetre": "mm", "micrometre": "um", "nanometre": "nm"}
_PLAIN_SIGNS = {"µ": "u", "μ": "u", "°C": "degC"}  # both Unicode micro signs, and the degree sign
# What is a unit behind a blank or a slash, too, where much else may stand.
_PLAIN = {*LENGTH, *VOLTAGE, *TIME, "min", "h", "%"}
_LAST = re.compile(r"(?P<stem>.*\S)(?:\s+|\s*/\s*)(?P<unit>[^\s/]+)")
# A number in round brackets counts channels.
BRACKETS = re.compile(r"(?P<stem>.*?)\s*[\[(]\s*(?!\d+\s*\))(?P<unit>[^\[\]()]*?)\s*[\])]")


@dataclass(frozen=True)
class Quantity:
    """A measured quantity: name, such as ``voltage``, canonical unit, and power of ten of each known unit."""

    stem: str
    unit: str
    powers: Mapping[str, int]

    @property
    def column(self) -> str:
        """Canonical column name: stem and unit."""
        return f"{self.stem}_{self.unit}"

    def convert(self, values: Any, unit: str) -> Any:
        """Values, or one, of a known unit in the canonical unit."""
        if unit == "K":
            return values - 273.15
        # Dividing by an exact power is rounded once; multiplying by 1e-3 would be rounded twice.
        power = self.powers[unit]
        return values * 10.0**power if power >= 0 else values / 10.0**-power

    def shifted(self, unit: str, power: int) -> str | None:
        """Name the unit 10**power times as large as `unit`, if there is one."""
        wanted = self.powers[unit] + power
        return next((name for name, value in self.powers.items() if value == wanted), None)


def split_unit(name: str) -> tuple[str, str | None]:
    """Split ``height_nm``, ``height[nm]``, ``height (nm)``, ``height/nm`` or ``height nm`` into stem and unit.

    The unit is None where there is none; behind a slash or a blank it is one of those known for the three quantities.
    """
    if match := BRACKETS.fullmatch(name):
        return match["stem"], _plain(match["unit"]) or None
    if (match := _LAST.fullmatch(name)) and (unit := _plain(match["unit"])) in _PLAIN:
        return match["stem"], unit
    stem, _, unit = name.rpartition("_")
    return (stem, _plain(unit) or None) if stem else (name, None)


def _plain(unit: str) -> str:
    """A unit in the letters that it has here."""
    for sign, plain in _PLAIN_SIGNS.items():
        unit = unit.replace(sign, plain)
    return _WORDS.get(unit.lower().removesuffix("s"), unit)
