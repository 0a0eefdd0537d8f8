"""What data teach: measured records, estimation, reports and the `microid` command.

The public names stand below in groups. Type checkers follow the imports; a name is imported when it is first used, so
that the command's help does not wait for JAX and pandas.
"""

from typing import TYPE_CHECKING

from microid._late import late as _late

# fmt: off
__all__ = [  # noqa: RUF022
    # Files and records
    "DataError", "Record", "Reference", "read_csv", "read_reference", "read_runs", "read_table",
    # A loop or a stage, fitted
    "FitError", "FitResult", "FitStatus", "LevelTrial", "ModelFile", "ParameterEstimate", "Prediction", "RunReport",
    "default_stage", "fit", "fit_report", "fit_slow", "fit_stage", "load_model", "predict", "save_model",
    # How sure a fit is
    "AbstractUncertainty", "Draws", "Errors", "Profile", "StageUncertainty", "Uncertainty", "draw_plants", "errors",
    "profile_stage", "sample_posterior",
    # Frequency responses
    "ModalFit", "Multisine", "NonlinearResponse", "ResponseData", "estimate_nonlinear_response", "estimate_response",
    "fit_hysteresis", "fit_response", "read_multisine", "read_response", "relative_error",
    # Diagnosis
    "Bound", "Diagnosis", "Experiment", "FoundCause", "Gain", "Thresholds", "diagnose", "diagnosis_json",
    "diagnosis_schema", "report_html",
    # Compensation and control
    "Compensation", "Goal", "LoopReport", "NetworkInverse", "Tuning", "compensate", "export_c", "export_simulation_c",
    "fit_network_inverse", "relay_start", "steepest_slope", "tune_controller",
    # Dimensions, tolerances and error budgets
    "Allocation", "AllocationError", "AxisBudget", "AxisSensitivity", "AxisSpread", "Budget", "Claim", "Design",
    "DimensionEffect", "Driving", "IdleNoise", "MonteCarlo", "NoiseBand", "NoiseLine", "SecondOrder",
    "SensitivityReport", "SobolIndices", "Together", "allocate", "budget", "idle_noise", "monte_carlo",
    "paper_claims", "paper_design", "read_design", "read_idle", "second_order", "sensitivities",
    "sign_change_guides", "sobol", "write_design",
    # Sweeps
    "Outcome", "Sweep", "open_sweep", "read_sweep", "run_sweep",
    # Pictures
    "plot_budget", "plot_compensation", "plot_control", "plot_fit", "plot_idle", "plot_sensitivity", "plot_stage",
    "plot_sweep",
]
# fmt: on

if TYPE_CHECKING:
    from fits.control._compensate import compensate
    from fits.control._export_c import export_c
    from fits.control._export_simulation import export_simulation_c
    from fits.control._follow import Compensation
    from fits.control._network_inverse import NetworkInverse, fit_network_inverse
    from fits.control._tune import tune_controller
    from fits.control._tune_problem import Goal, LoopReport, Tuning
    from fits.control._tune_start import relay_start, steepest_slope
    from fits.diagnosis._diagnose import diagnose
    from fits.diagnosis._result import Bound, Diagnosis, Experiment, FoundCause, Gain
    from fits.diagnosis._thresholds import Thresholds
    from fits.io._errors import DataError
    from fits.io._in_python import read_csv, read_reference, read_runs, read_table
    from fits.io._record import Record, Reference
    from fits.loop._fit import fit
    from fits.loop._prediction import Prediction
    from fits.loop._report import fit_report
    from fits.loop._result import FitError, FitResult, FitStatus, LevelTrial, ParameterEstimate, RunReport
    from fits.loop._uncertainty import AbstractUncertainty, Uncertainty
    from fits.machining._allocate import Allocation, AllocationError, allocate
    from fits.machining._budget import AxisBudget, Budget, Driving, budget
    from fits.machining._claims import Claim, paper_claims, sign_change_guides
    from fits.machining._design import Design, Together, paper_design
    from fits.machining._design_file import read_design, write_design
    from fits.machining._idle import IdleNoise, idle_noise, read_idle
    from fits.machining._monte_carlo import AxisSpread, MonteCarlo, SecondOrder, monte_carlo, second_order
    from fits.machining._sensitivity import AxisSensitivity, DimensionEffect, SensitivityReport, sensitivities
    from fits.machining._sobol import SobolIndices, sobol
    from fits.plots._control import plot_compensation, plot_control
    from fits.plots._fit import plot_fit, plot_stage
    from fits.plots._machining import plot_budget, plot_idle, plot_sensitivity
    from fits.plots._sweep import plot_sweep
    from fits.report._diagnosis import report_html
    from fits.report._diagnosis_json import diagnosis_json, diagnosis_schema
    from fits.stage._distortion import NonlinearResponse, estimate_nonlinear_response
    from fits.stage._fit import fit_stage
    from fits.stage._fit_slow import fit_slow
    from fits.stage._frequency import Multisine, ResponseData, estimate_response, read_multisine, read_response
    from fits.stage._modal_fit import ModalFit, fit_hysteresis, fit_response, relative_error
    from fits.stage._model_file import ModelFile, load_model, save_model
    from fits.stage._posterior import Draws, Profile, profile_stage, sample_posterior
    from fits.stage._solve_stage import default_stage
    from fits.stage._uncertainty import StageUncertainty, draw_plants, predict
    from fits.stats._metrics import Errors, errors
    from fits.stats._noise_spectrum import NoiseBand, NoiseLine
    from fits.sweeps._run import Outcome, run_sweep
    from fits.sweeps._show import open_sweep
    from fits.sweeps._spec import Sweep, read_sweep
else:
    _HOMES, __getattr__ = _late(__name__, __file__)

    def __dir__():
        return sorted(__all__)
