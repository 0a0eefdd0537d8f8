"""Controllers for a stage, the closed loop, and its figures of merit (Sections 3.3 and 4.3-4.4).

Importing the package imports every sibling whose name does not start with an underscore: each holds a controller and
registers it under the name of its file.
"""

from microid._plugins import plugins as _plugins
from microid.control._base import (
    CONTROLLERS,
    AbstractController,
    AbstractLinearController,
    ControlledPlant,
    ControlTask,
    Setting,
    register,
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

# fmt: off
__all__ = [  # noqa: RUF022
    # Controllers
    "BPPID", "CMACPID", "CONTROLLERS", "GainNetwork", "PID", "ResonantPID", "Setting", "settings_of",
    # What a controller is made of, and for
    "AbstractController", "AbstractLinearController", "AbstractPlant", "ControlTask", "ControlledPlant",
    "SampledStage", "register",
    # The closed loop
    "ControlledRun", "Learnt", "TwoDegrees", "iterative_learning", "learn_once", "simulate_loop", "two_degrees",
    # Figures of merit
    "Margins", "StepMetrics", "TrackingErrors", "loop_gain", "margins", "require_stable", "step_metrics",
    "tracking_errors",
]
# fmt: on

_plugins(__name__, __path__)
