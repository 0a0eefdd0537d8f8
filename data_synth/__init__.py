"""An independent virtual test bench for a piezo-driven micro-positioner.

It makes CSV files of voltage and displacement from a truth that shares no numerics with `microid`: NumPy, SciPy and
the standard library only, and neither of the other packages.

A stage with dynamics, the table `[plant]` of a scenario, is driven by the CSV's voltages joined by straight lines, or
held from sample to sample with `hold = "zero"`, and is at rest before the first sample.
"""

from data_synth._bench import Bench as Bench
from data_synth._bench import Record as Record
from data_synth._bench import simulate as simulate
from data_synth._bouc_wen import BOUCWEN_RATE_HZ as BOUCWEN_RATE_HZ
from data_synth._bouc_wen import BoucWenOscillator as BoucWenOscillator
from data_synth._bouc_wen import boucwen_multisine as boucwen_multisine
from data_synth._bouc_wen import boucwen_response as boucwen_response
from data_synth._bouc_wen import boucwen_sweep as boucwen_sweep
from data_synth._bouc_wen_files import BOUCWEN as BOUCWEN
from data_synth._bouc_wen_files import boucwen_files as boucwen_files
from data_synth._environment import OtherAxisSettings as OtherAxisSettings
from data_synth._environment import TemperatureSettings as TemperatureSettings
from data_synth._errors import ScenarioError as ScenarioError
from data_synth._hidden import hidden as hidden
from data_synth._history import initial_history as initial_history
from data_synth._paper_bench import PAPER_AXES as PAPER_AXES
from data_synth._paper_bench import PAPER_BIAS_V as PAPER_BIAS_V
from data_synth._paper_bench import PAPER_PERIOD_s as PAPER_PERIOD_s
from data_synth._paper_bench import PAPER_STEP_um as PAPER_STEP_um
from data_synth._paper_bench import PAPER_SWING_um as PAPER_SWING_um
from data_synth._paper_bench import PaperAxis as PaperAxis
from data_synth._paper_bench import PaperBench as PaperBench
from data_synth._paper_bench import PaperSensor as PaperSensor
from data_synth._paper_bench import paper_reference_um as paper_reference_um
from data_synth._paper_piezo import PaperPiezo as PaperPiezo
from data_synth._paper_records import paper_loops as paper_loops
from data_synth._paper_records import paper_responses as paper_responses
from data_synth._plant import Plant as Plant
from data_synth._plant import random_plant as random_plant
from data_synth._plays import PlayShape as PlayShape
from data_synth._plays import PlaySum as PlaySum
from data_synth._programs import chirp as chirp
from data_synth._programs import forc as forc
from data_synth._programs import hold as hold
from data_synth._programs import multisine as multisine
from data_synth._programs import nested as nested
from data_synth._programs import ramp as ramp
from data_synth._programs import random_reversals as random_reversals
from data_synth._programs import sine as sine
from data_synth._programs import steps as steps
from data_synth._programs import triangle as triangle
from data_synth._relays import RelayGrid as RelayGrid
from data_synth._relays import plain_relays as plain_relays
from data_synth._rig import Rig as Rig
from data_synth._rig import random_rig as random_rig
from data_synth._scenario import PlantSettings as PlantSettings
from data_synth._scenario import RigSettings as RigSettings
from data_synth._scenario import Run as Run
from data_synth._scenario import Scenario as Scenario
from data_synth._scenario import Segment as Segment
from data_synth._scenario import load_scenario as load_scenario
from data_synth._scenario import parse_scenario as parse_scenario
from data_synth._scenario import scenario_names as scenario_names
from data_synth._sensor import Sensor as Sensor
from data_synth._strength import EffectSettings as EffectSettings
from data_synth._strength import HiddenEffect as HiddenEffect
from data_synth._truth_density import Bump as Bump
from data_synth._truth_density import Density as Density
from data_synth._truth_density import Reversible as Reversible
from data_synth._truth_density import Ridge as Ridge
from data_synth._write import files as files
from data_synth._write import write as write
from data_synth.effects import EFFECTS as EFFECTS
from data_synth.effects import OUTSIDE as OUTSIDE

__all__ = [
    "BOUCWEN",
    "BOUCWEN_RATE_HZ",
    "EFFECTS",
    "OUTSIDE",
    "PAPER_AXES",
    "PAPER_BIAS_V",
    "Bench",
    "BoucWenOscillator",
    "Bump",
    "Density",
    "EffectSettings",
    "HiddenEffect",
    "OtherAxisSettings",
    "PAPER_PERIOD_s",
    "PAPER_STEP_um",
    "PAPER_SWING_um",
    "PaperAxis",
    "PaperBench",
    "PaperPiezo",
    "PaperSensor",
    "Plant",
    "PlantSettings",
    "PlayShape",
    "PlaySum",
    "Record",
    "RelayGrid",
    "Reversible",
    "Ridge",
    "Rig",
    "RigSettings",
    "Run",
    "Scenario",
    "ScenarioError",
    "Segment",
    "Sensor",
    "TemperatureSettings",
    "boucwen_files",
    "boucwen_multisine",
    "boucwen_response",
    "boucwen_sweep",
    "chirp",
    "files",
    "forc",
    "hidden",
    "hold",
    "initial_history",
    "load_scenario",
    "multisine",
    "nested",
    "paper_loops",
    "paper_reference_um",
    "paper_responses",
    "parse_scenario",
    "plain_relays",
    "ramp",
    "random_plant",
    "random_reversals",
    "random_rig",
    "scenario_names",
    "simulate",
    "sine",
    "steps",
    "triangle",
    "write",
]
