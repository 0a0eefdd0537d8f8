"""What data teach: measured records, estimation, reports and the `microid` command."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fits._allocate import Allocation as Allocation
    from fits._allocate import AllocationError as AllocationError
    from fits._allocate import allocate as allocate
    from fits._budget import AxisBudget as AxisBudget
    from fits._budget import Budget as Budget
    from fits._budget import Driving as Driving
    from fits._budget import budget as budget
    from fits._budget_report import budget_json as budget_json
    from fits._budget_report import describe_budget as describe_budget
    from fits._choose_grid import LADDER as LADDER
    from fits._compensate import Compensation as Compensation
    from fits._compensate import compensate as compensate
    from fits._draw_plants import draw_plants as draw_plants
    from fits._errors import DataError as DataError
    from fits._export_c import export_c as export_c
    from fits._fit import fit as fit
    from fits._fit_stage import default_stage as default_stage
    from fits._fit_stage import fit_stage as fit_stage
    from fits._frequency import Multisine as Multisine
    from fits._frequency import ResponseData as ResponseData
    from fits._frequency import estimate_response as estimate_response
    from fits._frequency import read_multisine as read_multisine
    from fits._idle import IdleNoise as IdleNoise
    from fits._idle import idle_noise as idle_noise
    from fits._idle import read_idle as read_idle
    from fits._metrics import Errors as Errors
    from fits._metrics import errors as errors
    from fits._metrics import loop_width_pct as loop_width_pct
    from fits._modal_fit import ModalFit as ModalFit
    from fits._modal_fit import fit_hysteresis as fit_hysteresis
    from fits._modal_fit import fit_response as fit_response
    from fits._modal_fit import relative_error as relative_error
    from fits._model_file import ModelFile as ModelFile
    from fits._model_file import load_model as load_model
    from fits._model_file import save_model as save_model
    from fits._monte_carlo import AxisSpread as AxisSpread
    from fits._monte_carlo import MonteCarlo as MonteCarlo
    from fits._monte_carlo import monte_carlo as monte_carlo
    from fits._network_inverse import NetworkInverse as NetworkInverse
    from fits._network_inverse import fit_network_inverse as fit_network_inverse
    from fits._noise_spectrum import NoiseBand as NoiseBand
    from fits._noise_spectrum import NoiseLine as NoiseLine
    from fits._paper_claims import Claim as Claim
    from fits._paper_claims import describe_claims as describe_claims
    from fits._paper_claims import paper_claims as paper_claims
    from fits._paper_claims import sign_change_guides as sign_change_guides
    from fits._plot_budget import plot_budget as plot_budget
    from fits._plot_compensation import plot_compensation as plot_compensation
    from fits._plot_control import plot_control as plot_control
    from fits._plot_idle import plot_idle as plot_idle
    from fits._plot_sensitivity import plot_sensitivity as plot_sensitivity
    from fits._plot_stage import plot_stage as plot_stage
    from fits._plots import plot_fit as plot_fit
    from fits._posterior import Draws as Draws
    from fits._posterior import sample_posterior as sample_posterior
    from fits._profile import Profile as Profile
    from fits._profile import profile_stage as profile_stage
    from fits._read_csv import read_csv as read_csv
    from fits._read_csv import read_reference as read_reference
    from fits._read_csv import read_runs as read_runs
    from fits._read_response import read_response as read_response
    from fits._record import Record as Record
    from fits._record import Reference as Reference
    from fits._report import describe as describe
    from fits._report import fit_report as fit_report
    from fits._result import FitError as FitError
    from fits._result import FitResult as FitResult
    from fits._result import FitStatus as FitStatus
    from fits._result import LevelTrial as LevelTrial
    from fits._result import Prediction as Prediction
    from fits._result import RunReport as RunReport
    from fits._result import predict as predict
    from fits._second_order import SecondOrder as SecondOrder
    from fits._second_order import second_order as second_order
    from fits._sensitivity import AxisSensitivity as AxisSensitivity
    from fits._sensitivity import DimensionEffect as DimensionEffect
    from fits._sensitivity import SensitivityReport as SensitivityReport
    from fits._sensitivity import sensitivities as sensitivities
    from fits._sensitivity_report import describe_sensitivity as describe_sensitivity
    from fits._sensitivity_report import sensitivity_json as sensitivity_json
    from fits._sobol import SobolIndices as SobolIndices
    from fits._sobol import sobol as sobol
    from fits._stage_design import Design as Design
    from fits._stage_design import Together as Together
    from fits._stage_design import paper_design as paper_design
    from fits._stage_report import describe_stage as describe_stage
    from fits._stage_report import stage_report as stage_report
    from fits._stage_result import ParameterEstimate as ParameterEstimate
    from fits._stage_result import StageFit as StageFit
    from fits._stage_result import predict_stage as predict_stage
    from fits._stage_toml import read_design as read_design
    from fits._stage_toml import write_design as write_design
    from fits._stage_uncertainty import StageUncertainty as StageUncertainty
    from fits._tune import tune_controller as tune_controller
    from fits._tune_problem import Goal as Goal
    from fits._tune_result import LoopReport as LoopReport
    from fits._tune_result import Tuning as Tuning
    from fits._tune_start import UltimatePoint as UltimatePoint
    from fits._tune_start import relay_start as relay_start
    from fits._tune_start import steepest_slope as steepest_slope
    from fits._tune_start import ultimate_point as ultimate_point
    from fits._uncertainty import Uncertainty as Uncertainty
    from fits.diagnosis._diagnose import diagnose as diagnose
    from fits.diagnosis._json import diagnosis_json as diagnosis_json
    from fits.diagnosis._json import diagnosis_schema as diagnosis_schema
    from fits.diagnosis._report import report_html as report_html
    from fits.diagnosis._result import Bound as Bound
    from fits.diagnosis._result import Diagnosis as Diagnosis
    from fits.diagnosis._result import EffectParameter as EffectParameter
    from fits.diagnosis._result import Experiment as Experiment
    from fits.diagnosis._result import FoundCause as FoundCause
    from fits.diagnosis._result import Gain as Gain
    from fits.sweeps._run import Outcome as Outcome
    from fits.sweeps._run import run_sweep as run_sweep
    from fits.sweeps._show import open_sweep as open_sweep
    from fits.sweeps._show import plot_sweep as plot_sweep
    from fits.sweeps._spec import Sweep as Sweep
    from fits.sweeps._spec import read_sweep as read_sweep

# Names are looked up when first used, so that the command's help does not wait for JAX and pandas.
_HOMES = {
    "Allocation": "_allocate",
    "AllocationError": "_allocate",
    "AxisBudget": "_budget",
    "AxisSensitivity": "_sensitivity",
    "AxisSpread": "_monte_carlo",
    "Bound": "diagnosis._result",
    "Budget": "_budget",
    "Claim": "_paper_claims",
    "Compensation": "_compensate",
    "DataError": "_errors",
    "Design": "_stage_design",
    "Diagnosis": "diagnosis._result",
    "DimensionEffect": "_sensitivity",
    "Draws": "_posterior",
    "Driving": "_budget",
    "EffectParameter": "diagnosis._result",
    "Errors": "_metrics",
    "Experiment": "diagnosis._result",
    "FitError": "_result",
    "FitResult": "_result",
    "FitStatus": "_result",
    "FoundCause": "diagnosis._result",
    "Gain": "diagnosis._result",
    "Goal": "_tune_problem",
    "IdleNoise": "_idle",
    "LADDER": "_choose_grid",
    "LevelTrial": "_result",
    "LoopReport": "_tune_result",
    "ModalFit": "_modal_fit",
    "ModelFile": "_model_file",
    "MonteCarlo": "_monte_carlo",
    "Multisine": "_frequency",
    "NetworkInverse": "_network_inverse",
    "NoiseBand": "_noise_spectrum",
    "NoiseLine": "_noise_spectrum",
    "Outcome": "sweeps._run",
    "ParameterEstimate": "_stage_result",
    "Prediction": "_result",
    "Profile": "_profile",
    "Record": "_record",
    "Reference": "_record",
    "ResponseData": "_frequency",
    "RunReport": "_result",
    "SecondOrder": "_second_order",
    "SensitivityReport": "_sensitivity",
    "SobolIndices": "_sobol",
    "StageFit": "_stage_result",
    "StageUncertainty": "_stage_uncertainty",
    "Sweep": "sweeps._spec",
    "Together": "_stage_design",
    "Tuning": "_tune_result",
    "UltimatePoint": "_tune_start",
    "Uncertainty": "_uncertainty",
    "allocate": "_allocate",
    "budget": "_budget",
    "budget_json": "_budget_report",
    "compensate": "_compensate",
    "default_stage": "_fit_stage",
    "describe": "_report",
    "describe_budget": "_budget_report",
    "describe_claims": "_paper_claims",
    "describe_sensitivity": "_sensitivity_report",
    "describe_stage": "_stage_report",
    "diagnose": "diagnosis._diagnose",
    "diagnosis_json": "diagnosis._json",
    "diagnosis_schema": "diagnosis._json",
    "draw_plants": "_draw_plants",
    "errors": "_metrics",
    "estimate_response": "_frequency",
    "export_c": "_export_c",
    "fit": "_fit",
    "fit_hysteresis": "_modal_fit",
    "fit_network_inverse": "_network_inverse",
    "fit_report": "_report",
    "fit_response": "_modal_fit",
    "fit_stage": "_fit_stage",
    "idle_noise": "_idle",
    "load_model": "_model_file",
    "loop_width_pct": "_metrics",
    "monte_carlo": "_monte_carlo",
    "paper_claims": "_paper_claims",
    "paper_design": "_stage_design",
    "open_sweep": "sweeps._show",
    "plot_budget": "_plot_budget",
    "plot_compensation": "_plot_compensation",
    "plot_control": "_plot_control",
    "plot_fit": "_plots",
    "plot_idle": "_plot_idle",
    "plot_sensitivity": "_plot_sensitivity",
    "plot_stage": "_plot_stage",
    "plot_sweep": "sweeps._show",
    "predict": "_result",
    "predict_stage": "_stage_result",
    "profile_stage": "_profile",
    "read_csv": "_read_csv",
    "read_design": "_stage_toml",
    "read_idle": "_idle",
    "read_multisine": "_frequency",
    "read_reference": "_read_csv",
    "read_response": "_read_response",
    "read_runs": "_read_csv",
    "read_sweep": "sweeps._spec",
    "relative_error": "_modal_fit",
    "relay_start": "_tune_start",
    "report_html": "diagnosis._report",
    "run_sweep": "sweeps._run",
    "sample_posterior": "_posterior",
    "save_model": "_model_file",
    "second_order": "_second_order",
    "sensitivities": "_sensitivity",
    "sensitivity_json": "_sensitivity_report",
    "sign_change_guides": "_paper_claims",
    "sobol": "_sobol",
    "stage_report": "_stage_report",
    "steepest_slope": "_tune_start",
    "tune_controller": "_tune",
    "ultimate_point": "_tune_start",
    "write_design": "_stage_toml",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_HOMES)
