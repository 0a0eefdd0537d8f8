"""Models of a piezo-driven micro-positioner as pure, differentiable JAX functions.

Here are a stage, its parts and the Preisach operator. What there are several kinds of, and what is built on a stage,
is in five modules: `microid.densities` and `microid.hysteresis` hold what may stand in a stage, `microid.effects`
what a stage may hide, `microid.control` the closed loop, and `microid.kinetostatics` the dimensions. A name is
imported when it is first used: what needs no model does without JAX.
"""

from typing import TYPE_CHECKING

from microid._late import late as _late

# fmt: off
__all__ = [  # noqa: RUF022
    # A stage and its parts
    "Driver", "HystereticMechanics", "HystereticModes", "Lag", "Mechanics", "Modes", "Piezo", "Reversible",
    "Sensor", "Stage", "Start", "with_plays",
    # What parts are made of
    "AbstractHysteresis", "AbstractLinear", "AbstractPart", "AbstractStepper", "Hold", "LinearSystem", "Scene",
    "Signal", "innermost", "recur", "refined", "run_parts",
    # The Preisach operator
    "Everett", "Preisach", "everett", "forest_sum", "respond_all",
    # Memory
    "Memory", "Staircase", "demagnetised", "negative_saturation", "positive_saturation", "remember",
    # Parameters
    "Coordinates", "ParameterInfo", "ParameterSpec", "array", "param", "parameter_table", "static",
    # Inverses
    "Inversion", "StageInversion", "driver_command", "invert", "invert_stage", "piezo_demand",
]
# fmt: on

if TYPE_CHECKING:
    from microid import control as control
    from microid import densities as densities
    from microid import effects as effects
    from microid import hysteresis as hysteresis
    from microid import kinetostatics as kinetostatics
    from microid._batch import respond_all
    from microid._everett import Everett, everett
    from microid._forest import forest_sum
    from microid._hysteretic_mechanics import HystereticMechanics
    from microid._inverse import Inversion, invert
    from microid._inverse_stage import StageInversion, driver_command, invert_stage, piezo_demand
    from microid._linear import Hold, LinearSystem, recur
    from microid._memory import Memory, Staircase, demagnetised, negative_saturation, positive_saturation, remember
    from microid._modes import HystereticModes, Modes, with_plays
    from microid._param import Coordinates, ParameterInfo, ParameterSpec, array, param, parameter_table, static
    from microid._part import (
        AbstractHysteresis,
        AbstractLinear,
        AbstractPart,
        AbstractStepper,
        Scene,
        Signal,
        innermost,
        run_parts,
    )
    from microid._plant import Driver, Lag, Mechanics, Piezo, Sensor
    from microid._preisach import Preisach
    from microid._refine import refined
    from microid._reversible import Reversible
    from microid._stage import Stage, Start
else:
    _HOMES, __getattr__ = _late(__name__, __file__)

    def __dir__():
        return sorted({*globals(), *__all__, *(name for name, home in _HOMES.items() if home == __name__)})
