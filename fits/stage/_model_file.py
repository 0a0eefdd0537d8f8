"""Fitted models as files: JSON that explains itself; `docs/files.md` has the format."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import numpy as np

from fits.io._atomic import atomic_write_text
from fits.io._errors import AnyPath, DataError
from fits.io._jax_setup import require_float64
from fits.io._model_text import SCHEMA, hash_of, pretty, read_model_text
from fits.io._version import written_by
from fits.loop._design import Grid
from fits.loop._uncertainty import AbstractUncertainty, Uncertainty
from fits.stage._chain import offsets_out
from fits.stage._encode import decode, encode
from fits.stage._uncertainty import StageUncertainty
from microid import Preisach, Stage

Model = Preisach | Stage
# A hysteresis or a stage; or a fit of one, what `load_model` made of its file, or the name of that.
AnyModel = Any


@dataclass(frozen=True)
class ModelFile:
    """What a model file holds: a module of `microid`, usually a `Preisach` or a `Stage`, and its uncertainty.

    `report` is what is known of the fit, as `fit_report` makes it, and `written_by` the program and its version.
    """

    model: eqx.Module
    uncertainty: Uncertainty | StageUncertainty | None
    report: dict[str, Any]
    written_by: str


def save_model(
    path: AnyPath, model: eqx.Module, uncertainty: Uncertainty | StageUncertainty | None, report: Mapping[str, Any]
) -> None:
    """Write a model file, whole or not at all; the same model gives the same bytes.

    The model is any module made of public classes of `microid`, the report JSON values under string keys, such as
    `fit_report` makes. A `DataError` if one of them cannot be written, or the file cannot be.
    """
    try:
        text = model_text(model, uncertainty, report)
    except DataError as error:
        raise DataError(f"{os.fspath(path)}: the model cannot be written: {error}.") from error
    atomic_write_text(path, text)


def model_text(
    model: eqx.Module, uncertainty: Uncertainty | StageUncertainty | None, report: Mapping[str, Any]
) -> str:
    """Compose the text of a model file; a `DataError` says why it cannot be."""
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "sha256": "",
        "written_by": written_by(),
        "model": encode(model),
        "uncertainty": encode(uncertainty),
        "fit": dict(report),
    }
    try:
        content["sha256"] = hash_of(content)
        same_report = json.loads(json.dumps(content["fit"])) == content["fit"]
    except (TypeError, ValueError) as error:
        raise DataError(f"its report is not made of finite JSON values ({error})") from error
    if not same_report:
        raise DataError("its report holds something that JSON gives back differently, such as a tuple")
    for value, part in ((model, "model"), (uncertainty, "uncertainty")):
        # What a file would not give back must not be lost silently.
        if not eqx.tree_equal(_in_numpy(value), _in_numpy(decode(content[part], part))):
            raise DataError(f"the {part} holds something that the file would not give back")
    return pretty(content) + "\n"


def _in_numpy(tree: eqx.Module | None) -> eqx.Module | None:
    # JAX would compile a comparison for each shape.
    return jax.tree.map(lambda leaf: np.asarray(leaf) if eqx.is_array(leaf) else leaf, tree)


def load_model(path: AnyPath) -> ModelFile:
    """Read a model file that `save_model` wrote: every number is bit by bit what was written.

    A `DataError` says that the file cannot be read, is of another version, was changed after it was written, or makes
    no sense, and a `RuntimeError` that JAX computes in single precision.
    """
    require_float64("model files hold")
    name = os.fspath(path)
    content = read_model_text(name)
    again = "write the file again with 'microid fit'"
    try:
        model, uncertainty = (decode(content[part], part) for part in ("model", "uncertainty"))
    except DataError as error:
        raise DataError(f"{name}: {error}; {again}.") from error
    if not isinstance(model, eqx.Module) or not isinstance(uncertainty, Uncertainty | StageUncertainty | None):
        raise DataError(f"{name}: expected a model and its uncertainty; {again}.")
    if isinstance(uncertainty, StageUncertainty) and not _moves(model, uncertainty):
        raise DataError(f"{name}: the uncertainty does not fit the stage; {again}.")
    if uncertainty and uncertainty.columns_um.shape[1] != (uncertainty.grid.columns if uncertainty.grid else 0):
        raise DataError(f"{name}: the uncertainty does not fit its grid; {again}.")
    return ModelFile(model, uncertainty, content["fit"], content["written_by"])


def model_given(given: AnyModel, uncertainty: AbstractUncertainty | None = None) -> tuple[Model, Any]:
    """A hysteresis or a stage and its uncertainty, from a fit, a model file that was loaded or is named, or as it is.

    An uncertainty that is given counts instead of theirs. A `DataError` says that there is no such model.
    """
    held = load_model(given) if isinstance(given, str | os.PathLike) else given
    model = getattr(held, "model", held)
    if not isinstance(model, Preisach | Stage):
        raise DataError(
            f"expected a Preisach model or a stage, a fit of one, or the name of its file, found a "
            f"{type(model).__name__}; give one of these"
        )
    return model, getattr(held, "uncertainty", None) if uncertainty is None else uncertainty


def _moves(model: eqx.Module, uncertainty: StageUncertainty) -> bool:
    """Whether perturbations are those of the parameters of a stage, and of its grid if they have one."""
    if not isinstance(model, Stage) or not isinstance(uncertainty.grid, Grid | None):
        return False
    on_grid = uncertainty.grid is not None
    if on_grid and not any(isinstance(part, Preisach) for part in model.parts):
        return False
    try:
        return uncertainty.coordinates.shape[1] == offsets_out(model, on_grid).size
    except ValueError:
        return False
