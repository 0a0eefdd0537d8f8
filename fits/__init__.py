"""What data teach: measured records, estimation, reports and the `microid` command."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fits._compensate import Compensation as Compensation
    from fits._compensate import compensate as compensate
    from fits._errors import DataError as DataError
    from fits._export_c import export_c as export_c
    from fits._fit import LADDER as LADDER
    from fits._fit import fit as fit
    from fits._metrics import Errors as Errors
    from fits._metrics import errors as errors
    from fits._metrics import loop_width_pct as loop_width_pct
    from fits._model_file import ModelFile as ModelFile
    from fits._model_file import load_model as load_model
    from fits._model_file import save_model as save_model
    from fits._plot_compensation import plot_compensation as plot_compensation
    from fits._plots import plot_fit as plot_fit
    from fits._read_csv import read_csv as read_csv
    from fits._read_csv import read_reference as read_reference
    from fits._read_csv import read_runs as read_runs
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
    from fits._uncertainty import Uncertainty as Uncertainty

# Names are looked up when first used, so that the command's help does not wait for JAX and pandas.
_HOMES = {
    "Compensation": "_compensate",
    "DataError": "_errors",
    "Errors": "_metrics",
    "FitError": "_result",
    "FitResult": "_result",
    "FitStatus": "_result",
    "LADDER": "_fit",
    "LevelTrial": "_result",
    "ModelFile": "_model_file",
    "Prediction": "_result",
    "Record": "_record",
    "Reference": "_record",
    "RunReport": "_result",
    "Uncertainty": "_uncertainty",
    "compensate": "_compensate",
    "describe": "_report",
    "errors": "_metrics",
    "export_c": "_export_c",
    "fit": "_fit",
    "fit_report": "_report",
    "load_model": "_model_file",
    "loop_width_pct": "_metrics",
    "plot_compensation": "_plot_compensation",
    "plot_fit": "_plots",
    "predict": "_result",
    "read_csv": "_read_csv",
    "read_reference": "_read_csv",
    "read_runs": "_read_csv",
    "save_model": "_model_file",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_HOMES)
