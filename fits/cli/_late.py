"""What the commands use of other rooms, imported when it is first used, so that help does not wait for JAX."""
# ruff: noqa: F401

from typing import TYPE_CHECKING

from microid._late import late

if TYPE_CHECKING:
    from fits.control._alone import inverse_alone
    from fits.control._compensate import compensate, static_equivalent
    from fits.control._export_c import export_c
    from fits.control._export_simulation import export_simulation_c
    from fits.control._follow import compensate_plain
    from fits.control._gains import read_gains
    from fits.control._make import Loop, Maker, setup
    from fits.control._tune_problem import Goal, passed_limits
    from fits.diagnosis._diagnose import diagnose
    from fits.diagnosis._result import Diagnosis, Step
    from fits.io._atomic import check_table_name, finite_json, refuse_nonfinite, write_csv, write_table
    from fits.io._inspect import inspect_table
    from fits.io._jax_setup import start_jax
    from fits.io._json import strict
    from fits.io._limits import allowed, check_command, joined, parse_limits, ranges_json, reached_in
    from fits.io._model_text import read_model_text
    from fits.io._quantity import Quantity
    from fits.io._read_csv import read_reference, read_runs, read_table
    from fits.io._read_file import numbered
    from fits.io._record import Record
    from fits.io._units import parse_columns
    from fits.loop._fit import fit
    from fits.loop._plain import PlainModel, memory_named
    from fits.loop._prediction import Initial, Prediction
    from fits.loop._report import fit_report
    from fits.loop._report_words import describe
    from fits.loop._result import FitError
    from fits.machining._budget import budget
    from fits.machining._claims import describe_claims, paper_claims
    from fits.machining._design import Design, paper_design
    from fits.machining._design_file import design_text, read_design
    from fits.machining._idle import idle_noise, read_idle
    from fits.machining._sensitivity import sensitivities
    from fits.paper._regenerate import paper_result
    from fits.plots._channels import plot_channels
    from fits.plots._control import plot_compensation, plot_control
    from fits.plots._fit import plot_fit, plot_stage
    from fits.plots._machining import plot_budget, plot_sensitivity
    from fits.plots._sweep import plot_sweep
    from fits.report._control import control_json, describe_control
    from fits.report._diagnosis import report_html
    from fits.report._diagnosis_json import diagnosis_json
    from fits.report._gallery import gallery_html, result_html
    from fits.report._machining import budget_json, sensitivity_json
    from fits.report._model_words import model_kind, model_numbers, model_words
    from fits.report._page import write_page
    from fits.stage._fit import fit_stage
    from fits.stage._fit_slow import fit_slow
    from fits.stage._model_file import ModelFile, load_model, model_text
    from fits.stage._motion import predicted_ranges
    from fits.stage._plain_stage import plain_model
    from fits.stage._run import yields_inside
    from fits.stage._solve_stage import default_stage
    from fits.stage._uncertainty import draw_plants, predict
    from fits.sweeps._run import run_sweep
    from fits.sweeps._show import describe_sweep, summarise
    from fits.sweeps._spec import read_sweep
    from fits.sweeps._store import RESULTS, TABLE
    from microid import Hold, Preisach, Stage
    from microid.control import CONTROLLERS
    from microid.kinetostatics import AXES, MOTIONS
else:
    __getattr__ = late(__name__, __file__)[1]
