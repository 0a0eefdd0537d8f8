"""Sizes of errors in words, in the unit that they ask for."""

# How many of each unit are in 1 um, the largest unit first.
_PER_um = {"um": 1.0, "nm": 1e3, "pm": 1e6}
# Less than this is nothing but rounding.
_LEAST_um = 1e-9


def length_unit(size_um: float, digits: int = 3) -> tuple[float, str]:
    """How many of a unit are in 1 um, and the unit: the largest of um, nm and pm of which it is one at least."""
    rounded = float(f"{abs(size_um):.{digits - 1}e}")
    fitting = (unit for unit, per_um in _PER_um.items() if rounded * per_um >= 1 or rounded == 0)
    unit = next(fitting, "pm")
    return _PER_um[unit], unit


def length(size_um: float, digits: int = 3) -> str:
    """Write a length with so many significant digits and its unit, such as `1.67 nm`; what is rounding as no more."""
    if 0 < abs(size_um) < _LEAST_um:
        return f"< {length(_LEAST_um, 1)}"
    per_um, unit = length_unit(size_um, digits)
    size = float(f"{size_um * per_um:.{digits - 1}e}")
    shown = f"{size:#.{digits}g}".rstrip(".") if 1 <= abs(size) < 10**digits else f"{size:g}"
    return f"{shown} {unit}"
