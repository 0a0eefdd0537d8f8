"""Gains of the motions with errors of the dimensions, and their derivatives: the one place that evaluates them."""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from fits.io._errors import DataError
from fits.machining._design import Design
from microid import kinetostatics as ks

# Constants of the motion functions that are dimensions; stiffnesses depend on them.
_OF_STIFFNESS = ("l4", "h", "d")
_Result = TypeVar("_Result")


def twin(axis: ks.Axis) -> ks.Axis:
    """The first axis that is the same function of the same dimensions: x for y, alpha for beta, others themselves."""
    return next(other for other in ks.AXES if ks.MOTIONS[other].dimensions == ks.MOTIONS[axis].dimensions)


def once_per_function(axes: Iterable[ks.Axis], compute: Callable[[ks.Axis], Any]) -> dict[ks.Axis, Any]:
    """Compute a dataclass for each axis, but only once for two axes that are one function."""
    found: dict[ks.Axis, Any] = {}
    for axis in axes:
        if twin(axis) not in found:
            found[twin(axis)] = compute(axis)
    return {axis: dataclasses.replace(found[twin(axis)], axis=axis) for axis in axes}


def check_axes(axes: Iterable[str]) -> None:
    """Raise a `DataError` for the first axis that does not exist."""
    for axis in axes:
        if axis not in ks.AXES:
            raise DataError(f"there is no axis {axis!r}: choose some of {', '.join(ks.AXES)}")


def quick_jit(function: Callable[..., _Result]) -> Callable[..., _Result]:
    """Compile fast: a call takes microseconds however it is compiled, and compiling with optimisation seconds."""
    options: dict[str, Any] = {"xla_disable_hlo_passes": "fusion", "xla_backend_optimization_level": 0}
    if jax.__version_info__ < (0, 11):
        # Without its fusion emitters, which a user's flags may switch off, XLA compiles what is not fused wrongly.
        options["xla_cpu_use_fusion_emitters"] = True
    return eqx.filter_jit(function, compiler_options=options)  # type: ignore[call-overload]


class GainModel(eqx.Module):
    """The gains of a design, the elongation of the piezo being imposed, or its voltage if its stiffness is given."""

    geometry: ks.Geometry
    constants: ks.Constants
    piezo_N_per_um: Float[Array, ""] | None

    def __call__(self, errors: Float[Array, " k"], axis: ks.Axis, names: tuple[str, ...]) -> Float[Array, ""]:
        """Gain with errors of some dimensions in mm and rad, in um or rad per um of the (free) elongation."""
        fields = [ks.DIMENSIONS[name].field for name in names]
        sizes = {field: getattr(self.geometry, field) + error for field, error in zip(fields, errors, strict=True)}
        geometry = dataclasses.replace(self.geometry, **sizes)
        if self.piezo_N_per_um is None:
            return ks.gain(axis, geometry, self.constants)
        constants = self.constants.at(geometry)
        return ks.gain(axis, geometry, constants) * ks.loaded_um(axis, geometry, 1.0, constants, self.piezo_N_per_um)


def gain_model(design: Design, voltage: bool = False) -> GainModel:
    """The gains of a design; with `voltage`, per free elongation of the piezo."""
    return GainModel(design.geometry, design.constants, design.actuation.piezo_N_per_um if voltage else None)


def inputs_of(axis: ks.Axis, voltage: bool) -> tuple[str, ...]:
    """Names of the dimensions that a gain depends on: those of Eq. 5, and with `voltage` those of the stiffness."""
    names = ks.MOTIONS[axis].dimensions
    return names + _OF_STIFFNESS if voltage else names


def _gains(
    model: GainModel, errors: Float[Array, "k n"], axes: tuple[ks.Axis, ...], names: tuple[str, ...]
) -> Float[Array, "axes n"]:
    """Gains of some axes for many stages, whose errors of the named dimensions are in mm and rad."""
    of_one = jax.vmap(lambda error: jnp.stack([model(error, axis, names) for axis in axes]), in_axes=1, out_axes=1)
    return of_one(errors)


# For few stages what counts is the time to compile, for millions the time to run.
gains_of_few = quick_jit(_gains)
gains_of_many = eqx.filter_jit(_gains)


@quick_jit
def gradient(model: GainModel, axis: ks.Axis, names: tuple[str, ...]) -> tuple[Float[Array, ""], Float[Array, " k"]]:
    """Gain of an axis without errors, and its derivatives with respect to the named dimensions."""
    return jax.value_and_grad(model)(jnp.zeros(len(names)), axis, names)


@quick_jit
def hessian(model: GainModel, axis: ks.Axis, names: tuple[str, ...]) -> Float[Array, "k k"]:
    """Second derivatives of a gain with respect to the named dimensions."""
    # Forward over forward compiles in half the time of forward over reverse.
    return jax.jacfwd(jax.jacfwd(model))(jnp.zeros(len(names)), axis, names)
