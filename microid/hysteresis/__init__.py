"""Hysteresis laws beside `Preisach`, one file each, to be put into a stage in its place.

Each gives the displacement in um under a voltage in V, whatever the speed: `law(voltage_V, start)`. In the literature
most of them are friction forces that run ahead of a displacement; a piezo's displacement stays behind its voltage, so
here they are subtracted from a proportional part. Importing the package imports every sibling whose name does not
start with an underscore; each registers itself.
"""

from microid._plugins import plugins as _plugins
from microid.hysteresis._base import LAWS, register
from microid.hysteresis.bouc_wen import BoucWen
from microid.hysteresis.dahl import Dahl
from microid.hysteresis.duhem import Duhem
from microid.hysteresis.maxwell_slip import MaxwellSlip
from microid.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii

# fmt: off
__all__ = [  # noqa: RUF022
    # Laws
    "BoucWen", "Dahl", "Duhem", "LAWS", "MaxwellSlip", "PrandtlIshlinskii",
    # For a new one
    "register",
]
# fmt: on

_plugins(__name__, __path__)
