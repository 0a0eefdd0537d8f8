"""Models of a piezo-driven micro-positioner as pure, differentiable JAX functions."""

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
from microid._part import AbstractHysteresis, AbstractLinear, AbstractPart, AbstractStepper, Scene, Signal, innermost
from microid._plant import Driver, Mechanics, Piezo, Sensor
from microid._preisach import Preisach
from microid._refine import refined
from microid._reversible import Reversible
from microid._stage import Stage, Start
from microid.control import CONTROLLERS
from microid.control._base import (
    AbstractController,
    AbstractLinearController,
    ControlledPlant,
    ControlTask,
    Setting,
    settings_of,
)
from microid.control._errors import StepMetrics, TrackingErrors, step_metrics, tracking_errors
from microid.control._learning import Learnt, iterative_learning, learn_once
from microid.control._loop import ControlledRun, simulate_loop
from microid.control._margins import Margins, loop_gain, margins, require_stable
from microid.control._sampled import AbstractPlant, SampledStage
from microid.control._two_degrees import TwoDegrees, two_degrees
from microid.control.bp_pid import BPPID, GainNetwork
from microid.control.cmac_pid import CMACPID
from microid.control.pid import PID
from microid.control.resonant import ResonantPID
from microid.densities import FAMILIES, AbstractDensity
from microid.densities._base import node_areas
from microid.densities.grid import GridDensity
from microid.densities.mixture import MixtureDensity
from microid.densities.network import NetworkDensity
from microid.effects import EFFECTS, PLACES, AbstractEffect, Scales, extend, host
from microid.hysteresis import BoucWen, Dahl, Duhem, MaxwellSlip, PrandtlIshlinskii
from microid.kinetostatics._axes import (
    AXES,
    MOTIONS,
    Axis,
    Form,
    Motion,
    Sensitivity,
    drive_of,
    gain,
    input_stiffness_N_per_um,
    loaded_um,
    output,
    sensitivity,
    voltage_sensitivity,
)
from microid.kinetostatics._compliance import (
    Constants,
    TwoPort,
    bridge,
    constants_of,
    guide_stiffness_N_per_um,
    leaf_compliance,
)
from microid.kinetostatics._errors import DrivingError, TotalError, driving_error, total_error
from microid.kinetostatics._geometry import DIMENSIONS, Dimension, Geometry
from microid.kinetostatics._large_stroke import (
    beam_alpha,
    beam_gamma,
    beam_x,
    beam_z,
    pseudo_rigid_alpha,
    pseudo_rigid_z,
)
from microid.kinetostatics._motion import (
    f_alpha,
    f_beta,
    f_gamma,
    f_x,
    f_y,
    f_z,
    link_leaf,
    middle_bridge,
    tilt_arm_mm,
)
from microid.kinetostatics._stage_constants import Actuation, StageConstants, stage_constants

# fmt: off
__all__ = [  # noqa: RUF022
    # A stage and its parts
    "Driver", "HystereticMechanics", "HystereticModes", "Mechanics", "Modes", "Piezo", "Reversible", "Sensor",
    "Stage", "Start", "with_plays",
    # What parts are made of
    "AbstractHysteresis", "AbstractLinear", "AbstractPart", "AbstractStepper", "Hold", "LinearSystem", "Scene",
    "Signal", "innermost", "recur", "refined",
    # Hysteresis
    "BoucWen", "Dahl", "Duhem", "Everett", "MaxwellSlip", "PrandtlIshlinskii", "Preisach", "everett", "forest_sum",
    "respond_all",
    # Densities
    "AbstractDensity", "FAMILIES", "GridDensity", "MixtureDensity", "NetworkDensity", "node_areas",
    # Memory
    "Memory", "Staircase", "demagnetised", "negative_saturation", "positive_saturation", "remember",
    # Parameters
    "Coordinates", "ParameterInfo", "ParameterSpec", "array", "param", "parameter_table", "static",
    # Inverses
    "Inversion", "StageInversion", "driver_command", "invert", "invert_stage", "piezo_demand",
    # Effects
    "AbstractEffect", "EFFECTS", "PLACES", "Scales", "extend", "host",
    # Control
    "AbstractController", "AbstractLinearController", "AbstractPlant", "BPPID", "CMACPID", "CONTROLLERS",
    "ControlTask", "ControlledPlant", "ControlledRun", "GainNetwork", "Learnt", "Margins", "PID", "ResonantPID",
    "SampledStage", "Setting", "StepMetrics", "TrackingErrors", "TwoDegrees", "iterative_learning", "learn_once",
    "loop_gain", "margins", "require_stable", "settings_of", "simulate_loop", "step_metrics", "tracking_errors",
    "two_degrees",
    # Kinetostatics of the stage
    "AXES", "Actuation", "Axis", "Constants", "DIMENSIONS", "Dimension", "DrivingError", "Form", "Geometry",
    "MOTIONS", "Motion", "Sensitivity", "StageConstants", "TotalError", "TwoPort", "bridge", "constants_of",
    "drive_of", "driving_error", "gain", "guide_stiffness_N_per_um", "input_stiffness_N_per_um", "leaf_compliance",
    "link_leaf", "loaded_um", "middle_bridge", "output", "sensitivity", "stage_constants", "tilt_arm_mm",
    "total_error", "voltage_sensitivity",
    # Motion functions
    "beam_alpha", "beam_gamma", "beam_x", "beam_z", "f_alpha", "f_beta", "f_gamma", "f_x", "f_y", "f_z",
    "pseudo_rigid_alpha", "pseudo_rigid_z",
]
# fmt: on


def __getattr__(name: str) -> str:
    # The version is looked up among what is installed, and only where it is asked for.
    if name == "__version__":
        from importlib.metadata import version

        return version("microid")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
