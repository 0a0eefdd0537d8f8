"""Controllers for a stage, the closed loop, and its figures of merit (Sections 3.3 and 4.3-4.4).

Importing the package imports every sibling whose name does not start with an underscore: each holds a controller and
registers it under the name of its file.
"""

from microid._plugins import plugins as _plugins
from microid.control._base import CONTROLLERS as CONTROLLERS
from microid.control._base import AbstractController as AbstractController
from microid.control._base import AbstractLinearController as AbstractLinearController
from microid.control._base import ControlledPlant as ControlledPlant
from microid.control._base import ControlTask as ControlTask
from microid.control._base import Setting as Setting
from microid.control._base import register as register
from microid.control._base import settings_of as settings_of
from microid.control._errors import StepMetrics as StepMetrics
from microid.control._errors import TrackingErrors as TrackingErrors
from microid.control._errors import step_metrics as step_metrics
from microid.control._errors import tracking_errors as tracking_errors
from microid.control._learning import Learnt as Learnt
from microid.control._learning import iterative_learning as iterative_learning
from microid.control._learning import learn_once as learn_once
from microid.control._loop import ControlledRun as ControlledRun
from microid.control._loop import simulate_loop as simulate_loop
from microid.control._margins import Margins as Margins
from microid.control._margins import loop_gain as loop_gain
from microid.control._margins import margins as margins
from microid.control._margins import require_stable as require_stable
from microid.control._sampled import AbstractPlant as AbstractPlant
from microid.control._sampled import SampledStage as SampledStage
from microid.control._two_degrees import TwoDegrees as TwoDegrees
from microid.control._two_degrees import two_degrees as two_degrees
from microid.control.bp_pid import BPPID as BPPID
from microid.control.bp_pid import GainNetwork as GainNetwork
from microid.control.cmac_pid import CMACPID as CMACPID
from microid.control.pid import PID as PID
from microid.control.resonant import ResonantPID as ResonantPID

_plugins(__name__, __path__)
