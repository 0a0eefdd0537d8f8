"""What data teach: measured records, estimation, reports and the `microid` command."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fits.control._compensate import Compensation as Compensation
    from fits.control._compensate import compensate as compensate
    from fits.control._export_c import export_c as export_c
    from fits.control._network_inverse import NetworkInverse as NetworkInverse
    from fits.control._network_inverse import fit_network_inverse as fit_network_inverse
    from fits.control._tune import tune_controller as tune_controller
    from fits.control._tune_problem import Goal as Goal
    from fits.control._tune_result import LoopReport as LoopReport
    from fits.control._tune_result import Tuning as Tuning
    from fits.control._tune_start import UltimatePoint as UltimatePoint
    from fits.control._tune_start import relay_start as relay_start
    from fits.control._tune_start import steepest_slope as steepest_slope
    from fits.control._tune_start import ultimate_point as ultimate_point
    from fits.diagnosis._diagnose import diagnose as diagnose
    from fits.diagnosis._result import Bound as Bound
    from fits.diagnosis._result import Diagnosis as Diagnosis
    from fits.diagnosis._result import EffectParameter as EffectParameter
    from fits.diagnosis._result import Experiment as Experiment
    from fits.diagnosis._result import FoundCause as FoundCause
    from fits.diagnosis._result import Gain as Gain
    from fits.io._errors import DataError as DataError
    from fits.io._read_csv import read_csv as read_csv
    from fits.io._read_csv import read_reference as read_reference
    from fits.io._read_csv import read_runs as read_runs
    from fits.io._record import Record as Record
    from fits.io._record import Reference as Reference
    from fits.loop._choose_grid import LADDER as LADDER
    from fits.loop._fit import fit as fit
    from fits.loop._result import FitError as FitError
    from fits.loop._result import FitResult as FitResult
    from fits.loop._result import FitStatus as FitStatus
    from fits.loop._result import LevelTrial as LevelTrial
    from fits.loop._result import ParameterEstimate as ParameterEstimate
    from fits.loop._result import RunReport as RunReport
    from fits.loop._uncertainty import AbstractUncertainty as AbstractUncertainty
    from fits.loop._uncertainty import Prediction as Prediction
    from fits.loop._uncertainty import Uncertainty as Uncertainty
    from fits.machining._allocate import Allocation as Allocation
    from fits.machining._allocate import AllocationError as AllocationError
    from fits.machining._allocate import allocate as allocate
    from fits.machining._budget import AxisBudget as AxisBudget
    from fits.machining._budget import Budget as Budget
    from fits.machining._budget import Driving as Driving
    from fits.machining._budget import budget as budget
    from fits.machining._claims import Claim as Claim
    from fits.machining._claims import describe_claims as describe_claims
    from fits.machining._claims import paper_claims as paper_claims
    from fits.machining._claims import sign_change_guides as sign_change_guides
    from fits.machining._design import Design as Design
    from fits.machining._design import Together as Together
    from fits.machining._design import paper_design as paper_design
    from fits.machining._design_file import read_design as read_design
    from fits.machining._design_file import write_design as write_design
    from fits.machining._idle import IdleNoise as IdleNoise
    from fits.machining._idle import idle_noise as idle_noise
    from fits.machining._idle import read_idle as read_idle
    from fits.machining._monte_carlo import AxisSpread as AxisSpread
    from fits.machining._monte_carlo import MonteCarlo as MonteCarlo
    from fits.machining._monte_carlo import SecondOrder as SecondOrder
    from fits.machining._monte_carlo import monte_carlo as monte_carlo
    from fits.machining._monte_carlo import second_order as second_order
    from fits.machining._sensitivity import AxisSensitivity as AxisSensitivity
    from fits.machining._sensitivity import DimensionEffect as DimensionEffect
    from fits.machining._sensitivity import SensitivityReport as SensitivityReport
    from fits.machining._sensitivity import sensitivities as sensitivities
    from fits.machining._sobol import SobolIndices as SobolIndices
    from fits.machining._sobol import sobol as sobol
    from fits.plots._control import plot_compensation as plot_compensation
    from fits.plots._control import plot_control as plot_control
    from fits.plots._loop import plot_fit as plot_fit
    from fits.plots._machining import plot_budget as plot_budget
    from fits.plots._machining import plot_idle as plot_idle
    from fits.plots._machining import plot_sensitivity as plot_sensitivity
    from fits.plots._stage import plot_stage as plot_stage
    from fits.plots._sweep import plot_sweep as plot_sweep
    from fits.report._diagnosis import report_html as report_html
    from fits.report._diagnosis_json import diagnosis_json as diagnosis_json
    from fits.report._diagnosis_json import diagnosis_schema as diagnosis_schema
    from fits.report._fit import describe as describe
    from fits.report._fit import fit_report as fit_report
    from fits.report._machining import budget_json as budget_json
    from fits.report._machining import describe_budget as describe_budget
    from fits.report._machining import describe_sensitivity as describe_sensitivity
    from fits.report._machining import sensitivity_json as sensitivity_json
    from fits.stage._draw_plants import draw_plants as draw_plants
    from fits.stage._fit import default_stage as default_stage
    from fits.stage._fit import fit_stage as fit_stage
    from fits.stage._frequency import Multisine as Multisine
    from fits.stage._frequency import ResponseData as ResponseData
    from fits.stage._frequency import estimate_response as estimate_response
    from fits.stage._frequency import read_multisine as read_multisine
    from fits.stage._modal_fit import ModalFit as ModalFit
    from fits.stage._modal_fit import fit_hysteresis as fit_hysteresis
    from fits.stage._modal_fit import fit_response as fit_response
    from fits.stage._modal_fit import relative_error as relative_error
    from fits.stage._model_file import ModelFile as ModelFile
    from fits.stage._model_file import load_model as load_model
    from fits.stage._model_file import save_model as save_model
    from fits.stage._posterior import Draws as Draws
    from fits.stage._posterior import sample_posterior as sample_posterior
    from fits.stage._predict import predict as predict
    from fits.stage._profile import Profile as Profile
    from fits.stage._profile import profile_stage as profile_stage
    from fits.stage._read_response import read_response as read_response
    from fits.stage._uncertainty import StageUncertainty as StageUncertainty
    from fits.stats._metrics import Errors as Errors
    from fits.stats._metrics import errors as errors
    from fits.stats._metrics import loop_width_pct as loop_width_pct
    from fits.stats._noise_spectrum import NoiseBand as NoiseBand
    from fits.stats._noise_spectrum import NoiseLine as NoiseLine
    from fits.sweeps._run import Outcome as Outcome
    from fits.sweeps._run import run_sweep as run_sweep
    from fits.sweeps._show import open_sweep as open_sweep
    from fits.sweeps._spec import Sweep as Sweep
    from fits.sweeps._spec import read_sweep as read_sweep

# Names are looked up when first used, so that the command's help does not wait for JAX and pandas.
_HOMES = {
    "AbstractUncertainty": "loop._uncertainty",
    "Allocation": "machining._allocate",
    "AllocationError": "machining._allocate",
    "AxisBudget": "machining._budget",
    "AxisSensitivity": "machining._sensitivity",
    "AxisSpread": "machining._monte_carlo",
    "Bound": "diagnosis._result",
    "Budget": "machining._budget",
    "Claim": "machining._claims",
    "Compensation": "control._compensate",
    "DataError": "io._errors",
    "Design": "machining._design",
    "Diagnosis": "diagnosis._result",
    "DimensionEffect": "machining._sensitivity",
    "Draws": "stage._posterior",
    "Driving": "machining._budget",
    "EffectParameter": "diagnosis._result",
    "Errors": "stats._metrics",
    "Experiment": "diagnosis._result",
    "FitError": "loop._result",
    "FitResult": "loop._result",
    "FitStatus": "loop._result",
    "FoundCause": "diagnosis._result",
    "Gain": "diagnosis._result",
    "Goal": "control._tune_problem",
    "IdleNoise": "machining._idle",
    "LADDER": "loop._choose_grid",
    "LevelTrial": "loop._result",
    "LoopReport": "control._tune_result",
    "ModalFit": "stage._modal_fit",
    "ModelFile": "stage._model_file",
    "MonteCarlo": "machining._monte_carlo",
    "Multisine": "stage._frequency",
    "NetworkInverse": "control._network_inverse",
    "NoiseBand": "stats._noise_spectrum",
    "NoiseLine": "stats._noise_spectrum",
    "Outcome": "sweeps._run",
    "ParameterEstimate": "loop._result",
    "Prediction": "loop._uncertainty",
    "Profile": "stage._profile",
    "Record": "io._record",
    "Reference": "io._record",
    "ResponseData": "stage._frequency",
    "RunReport": "loop._result",
    "SecondOrder": "machining._monte_carlo",
    "SensitivityReport": "machining._sensitivity",
    "SobolIndices": "machining._sobol",
    "StageUncertainty": "stage._uncertainty",
    "Sweep": "sweeps._spec",
    "Together": "machining._design",
    "Tuning": "control._tune_result",
    "UltimatePoint": "control._tune_start",
    "Uncertainty": "loop._uncertainty",
    "allocate": "machining._allocate",
    "budget": "machining._budget",
    "budget_json": "report._machining",
    "compensate": "control._compensate",
    "default_stage": "stage._fit",
    "describe": "report._fit",
    "describe_budget": "report._machining",
    "describe_claims": "machining._claims",
    "describe_sensitivity": "report._machining",
    "diagnose": "diagnosis._diagnose",
    "diagnosis_json": "report._diagnosis_json",
    "diagnosis_schema": "report._diagnosis_json",
    "draw_plants": "stage._draw_plants",
    "errors": "stats._metrics",
    "estimate_response": "stage._frequency",
    "export_c": "control._export_c",
    "fit": "loop._fit",
    "fit_hysteresis": "stage._modal_fit",
    "fit_network_inverse": "control._network_inverse",
    "fit_report": "report._fit",
    "fit_response": "stage._modal_fit",
    "fit_stage": "stage._fit",
    "idle_noise": "machining._idle",
    "load_model": "stage._model_file",
    "loop_width_pct": "stats._metrics",
    "monte_carlo": "machining._monte_carlo",
    "paper_claims": "machining._claims",
    "paper_design": "machining._design",
    "open_sweep": "sweeps._show",
    "plot_budget": "plots._machining",
    "plot_compensation": "plots._control",
    "plot_control": "plots._control",
    "plot_fit": "plots._loop",
    "plot_idle": "plots._machining",
    "plot_sensitivity": "plots._machining",
    "plot_stage": "plots._stage",
    "plot_sweep": "plots._sweep",
    "predict": "stage._predict",
    "profile_stage": "stage._profile",
    "read_csv": "io._read_csv",
    "read_design": "machining._design_file",
    "read_idle": "machining._idle",
    "read_multisine": "stage._frequency",
    "read_reference": "io._read_csv",
    "read_response": "stage._read_response",
    "read_runs": "io._read_csv",
    "read_sweep": "sweeps._spec",
    "relative_error": "stage._modal_fit",
    "relay_start": "control._tune_start",
    "report_html": "report._diagnosis",
    "run_sweep": "sweeps._run",
    "sample_posterior": "stage._posterior",
    "save_model": "stage._model_file",
    "second_order": "machining._monte_carlo",
    "sensitivities": "machining._sensitivity",
    "sensitivity_json": "report._machining",
    "sign_change_guides": "machining._claims",
    "sobol": "machining._sobol",
    "steepest_slope": "control._tune_start",
    "tune_controller": "control._tune",
    "ultimate_point": "control._tune_start",
    "write_design": "machining._design_file",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_HOMES)
