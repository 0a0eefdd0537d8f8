"""The dimensions of the stage (Table 1), each with its unit, bounds and meaning."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from microid._param import param

Scalar = float | Float[Array, ""]


def _length(default: float) -> Any:
    return param(unit="mm", scale=1.0, lower=0.0, default=default)


def _angle(default: float) -> Any:
    return param(unit="rad", scale=0.1, lower=0.0, upper=1.5, default=default)


class Geometry(eqx.Module):
    """Dimensions of the three platforms; by default the paper's (Table 1).

    The bottom platform moves x and y, the middle one z and the rotations about x and y, the top one the rotation
    about z. `DIMENSIONS` says what each is. The paper gives no value for `l_mm`; 40 mm is assumed (erratum 7).
    """

    l1_mm: Float[Array, ""] = _length(7.0)
    t1_mm: Float[Array, ""] = _length(0.8)
    la1_mm: Float[Array, ""] = _length(9.0)
    alpha1_rad: Float[Array, ""] = _angle(0.068)
    l2_mm: Float[Array, ""] = _length(10.0)
    t2_mm: Float[Array, ""] = _length(1.0)
    l3_mm: Float[Array, ""] = _length(28.0)
    l4_mm: Float[Array, ""] = _length(9.0)
    t4_mm: Float[Array, ""] = _length(0.8)
    la2_mm: Float[Array, ""] = _length(9.0)
    alpha2_rad: Float[Array, ""] = _angle(0.061)
    l5_mm: Float[Array, ""] = _length(9.0)
    t5_mm: Float[Array, ""] = _length(0.8)
    h_mm: Float[Array, ""] = _length(5.0)
    d_mm: Float[Array, ""] = _length(10.0)
    l_mm: Float[Array, ""] = _length(40.0)
    l6_mm: Float[Array, ""] = _length(2.0)
    t6_mm: Float[Array, ""] = _length(0.8)
    la3_mm: Float[Array, ""] = _length(14.0)
    alpha3_rad: Float[Array, ""] = _angle(0.185)
    l7_mm: Float[Array, ""] = _length(2.0)
    t7_mm: Float[Array, ""] = _length(0.8)
    R_mm: Float[Array, ""] = _length(4.0)
    J_mm: Float[Array, ""] = _length(4.0)

    def __getitem__(self, name: str) -> Float[Array, ""]:
        """Value of a dimension by the paper's symbol, such as `t2`, in its unit."""
        value: Float[Array, ""] = getattr(self, DIMENSIONS[name].field)
        return value


@dataclass(frozen=True)
class Dimension:
    """What is known of a dimension beside its value.

    Attributes
    ----------
    name
        The paper's symbol, such as `t2`.
    unit
        `mm` or `rad`.
    platform
        `bottom`, `middle` or `top`.
    meaning
        What it measures.
    leg
        For an angle, the length that turns an error of a position into one of the angle.
    """

    name: str
    unit: str
    platform: str
    meaning: str
    leg: str | None = None

    @property
    def field(self) -> str:
        """Name of the field of `Geometry`."""
        return f"{self.name}_{self.unit}"


def _dimensions() -> dict[str, Dimension]:
    rows = [
        ("l1", "mm", "bottom", "length of the bridge's leaf hinges"),
        ("t1", "mm", "bottom", "thickness of the bridge's leaf hinges"),
        ("la1", "mm", "bottom", "distance between the centres of the two hinges of one leg of the bridge"),
        ("alpha1", "rad", "bottom", "inclination of the line through these centres", "la1"),
        ("l2", "mm", "bottom", "length of the leaf hinges of a guiding leg"),
        ("t2", "mm", "bottom", "thickness of the leaf hinges of a guiding leg"),
        ("l3", "mm", "bottom", "distance between the centres of the two hinges of a guiding leg"),
        ("l4", "mm", "middle", "length of the bridge's leaf hinges"),
        ("t4", "mm", "middle", "thickness of the bridge's leaf hinges"),
        ("la2", "mm", "middle", "distance between the centres of the two hinges of one leg of the bridge"),
        ("alpha2", "rad", "middle", "inclination of the line through these centres", "la2"),
        ("l5", "mm", "middle", "length of the leaf between a bridge and the lifted platform"),
        ("t5", "mm", "middle", "thickness of the leaf between a bridge and the lifted platform"),
        ("h", "mm", "middle", "in-plane height of links and bars"),
        ("d", "mm", "middle", "out-of-plane width of all flexures"),
        ("l", "mm", "middle", "distance from the tilt axis to the inner end of the leaf l5"),
        ("l6", "mm", "top", "length of the bridge's leaf hinges"),
        ("t6", "mm", "top", "thickness of the bridge's leaf hinges"),
        ("la3", "mm", "top", "distance between the centres of the two hinges of one leg of the bridge"),
        ("alpha3", "rad", "top", "inclination of the line through these centres", "la3"),
        ("l7", "mm", "top", "length of the leaf between a bridge and the rotor's lever"),
        ("t7", "mm", "top", "thickness of the leaf between a bridge and the rotor's lever"),
        ("R", "mm", "top", "radius of the rotor's hub"),
        ("J", "mm", "top", "length of the rotor's lever"),
    ]
    return {row[0]: Dimension(*row) for row in rows}


DIMENSIONS = _dimensions()
"""Every dimension of the stage, by the paper's name of it, with its unit, mm or rad, and its field in `Geometry`."""
