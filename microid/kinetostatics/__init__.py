"""Section 2 of the paper: what the dimensions of the stage make of its motion, and their errors of its accuracy."""

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
    # Axes and motions
    "AXES", "Axis", "Form", "MOTIONS", "Motion", "drive_of", "gain", "output",
    # Dimensions, and what errors of theirs do
    "DIMENSIONS", "Dimension", "DrivingError", "Geometry", "Sensitivity", "TotalError", "driving_error",
    "sensitivity", "total_error", "voltage_sensitivity",
    # Stiffness and compliance
    "Actuation", "Constants", "StageConstants", "TwoPort", "bridge", "constants_of", "guide_stiffness_N_per_um",
    "input_stiffness_N_per_um", "leaf_compliance", "link_leaf", "loaded_um", "middle_bridge", "stage_constants",
    "tilt_arm_mm",
    # Motion functions
    "beam_alpha", "beam_gamma", "beam_x", "beam_z", "f_alpha", "f_beta", "f_gamma", "f_x", "f_y", "f_z",
    "pseudo_rigid_alpha", "pseudo_rigid_z",
]
# fmt: on
