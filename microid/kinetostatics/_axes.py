"""The six axes: outputs, gains, and what an error of any dimension does to them (Eq. 1-5)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._param import static
from microid.kinetostatics import _large_stroke as large
from microid.kinetostatics import _motion as small
from microid.kinetostatics._compliance import Constants
from microid.kinetostatics._geometry import DIMENSIONS, Geometry, Scalar

Axis = Literal["x", "y", "z", "alpha", "beta", "gamma"]
"""A motion of the stage: along x, y or z, in um, or about them, in rad."""
Form = Literal["linear", "pseudo_rigid", "beam"]
"""The form of a motion function: of first order in the stroke, or one of two for large strokes."""
AXES: tuple[Axis, ...] = ("x", "y", "z", "alpha", "beta", "gamma")
"""All motions, in the order of the paper."""
_TRANSLATION = ("l1", "t1", "la1", "l2", "t2", "l3", "alpha1")
_TILT = ("l", "l5", "la2", "alpha2", "t4")


@dataclass(frozen=True)
class Motion:
    """One axis of the stage.

    Attributes
    ----------
    axis
        Its name.
    dimensions
        The arguments of Eq. 5, in the order of Eq. 2.
    unit
        Of the output: `um` or `rad`.
    functions
        The motion function by form: `linear` for small strokes; for large ones `pseudo_rigid` and `beam`, where there
        are such.
    """

    axis: Axis
    dimensions: tuple[str, ...]
    unit: str
    functions: dict[str, Callable[..., Float[Array, ""]]]


MOTIONS: dict[Axis, Motion] = {
    "x": Motion("x", _TRANSLATION, "um", {"linear": small.f_x, "beam": large.beam_x}),
    "y": Motion("y", _TRANSLATION, "um", {"linear": small.f_y, "beam": large.beam_x}),
    "z": Motion(
        "z",
        ("la2", "alpha2", "t4"),
        "um",
        {"linear": small.f_z, "pseudo_rigid": large.pseudo_rigid_z, "beam": large.beam_z},
    ),
    "alpha": Motion(
        "alpha",
        _TILT,
        "rad",
        {"linear": small.f_alpha, "pseudo_rigid": large.pseudo_rigid_alpha, "beam": large.beam_alpha},
    ),
    "beta": Motion(
        "beta",
        _TILT,
        "rad",
        {"linear": small.f_beta, "pseudo_rigid": large.pseudo_rigid_alpha, "beam": large.beam_alpha},
    ),
    "gamma": Motion(
        "gamma",
        ("l6", "t6", "la3", "l7", "t7", "alpha3", "J", "R"),
        "rad",
        {"linear": small.f_gamma, "beam": large.beam_gamma},
    ),
}
"""What each motion takes: its dimensions, its unit, um or rad, and its functions by form."""


class Sensitivity(eqx.Module):
    """How the output of an axis depends on what it is made of, each of shape `()`.

    Attributes
    ----------
    output
        In um or rad.
    piezo
        Derivative of the output with respect to the elongation of the piezo, per um (Eq. 3).
    dimensions
        Derivatives with respect to the dimensions by name, per mm or rad (Eq. 4).
    axis
        Which.
    """

    output: Float[Array, ""]
    piezo: Float[Array, ""]
    dimensions: dict[str, Float[Array, ""]]
    axis: Axis = static()


def output(
    axis: Axis, geometry: Geometry, piezo_um: Scalar, constants: Constants, form: Form = "linear"
) -> Float[Array, ""]:
    """Solve a motion function for its output.

    Parameters
    ----------
    axis
        One of `AXES`.
    geometry
        The dimensions.
    piezo_um
        Elongation of the piezo, shape `()`.
    constants
        See `constants_of`.
    form
        `linear` for small strokes. For large ones, at level 0, `pseudo_rigid` (z, alpha and beta) or `beam`.

    Returns
    -------
    Array
        In um or rad, shape `()`; differentiable in all arguments, through the solution of the implicit function.

    Raises
    ------
    ValueError
        If the axis has no such form, or the form no such level.
    RuntimeError
        If a stroke is larger than the bridge can give.
    """
    function = _function(axis, constants, form)
    values = [geometry[name] for name in MOTIONS[axis].dimensions]
    if form != "pseudo_rigid":
        # The function is the output less what belongs to the piezo.
        return -function(0.0, *values, piezo_um, constants=constants)
    return _solved(function, values, jnp.asarray(piezo_um, dtype=values[0].dtype), constants, axis, geometry)


def gain(axis: Axis, geometry: Geometry, constants: Constants) -> Float[Array, ""]:
    """Output per elongation of the piezo for small strokes, in um/um or rad/um, shape `()`.

    Parameters
    ----------
    axis, geometry, constants
        See `output`.
    """
    return jax.grad(lambda piezo_um: output(axis, geometry, piezo_um, constants))(jnp.zeros_like(geometry.l1_mm))


def sensitivity(
    axis: Axis, geometry: Geometry, piezo_um: Scalar, constants: Constants, form: Form = "linear"
) -> Sensitivity:
    r"""Differentiate the implicit motion function of an axis, the piezo's elongation being imposed (Eq. 3 and 4).

    .. math::

        \delta w_{out} = -\Big(\frac{\partial f_w}{\partial w_{out}}\Big)^{-1}
        \Big[\frac{\partial f_w}{\partial w_{pzt}} \delta w_{pzt}
        + \sum_i \frac{\partial f_w}{\partial d_{wi}} \delta d_{wi}\Big]

    The paper lacks the inverse (erratum 6), and names the wrong function in two places (errata 3 and 4).

    Parameters
    ----------
    axis, geometry, piezo_um, constants, form
        See `output`.

    Raises
    ------
    ValueError, RuntimeError
        See `output`.
    """
    function = _function(axis, constants, form)
    names = MOTIONS[axis].dimensions
    solved = output(axis, geometry, piezo_um, constants, form)
    piezo = jnp.asarray(piezo_um, dtype=solved.dtype)
    values = jnp.stack([geometry[name] for name in names])

    def residual(out: Array, dimensions: Array, piezo: Array) -> Array:
        return function(out, *dimensions, piezo, constants=constants)

    by_output, by_dimensions, by_piezo = jax.grad(residual, (0, 1, 2))(solved, values, piezo)
    slopes = -by_dimensions / by_output
    return Sensitivity(solved, -by_piezo / by_output, dict(zip(names, slopes, strict=True)), axis)


def input_stiffness_N_per_um(axis: Axis, geometry: Geometry, constants: Constants) -> Float[Array, ""]:
    """Force of a piezo per elongation, with the load of its axis, in N/um, shape `()`."""
    drive, load = drive_of(axis, geometry, constants)
    return drive.input_stiffness_N_per_um(load)


def drive_of(axis: Axis, geometry: Geometry, constants: Constants) -> tuple[small.TwoPort, Scalar]:
    """Bridge of an axis, and the spring at its output in N/um."""
    g = geometry
    if axis in ("x", "y"):
        load = small.guide_stiffness_N_per_um(g.l2_mm, g.t2_mm, g.l3_mm, constants)
        return small.bridge(g.l1_mm, g.t1_mm, g.la1_mm, g.alpha1_rad, constants), load
    if axis == "gamma":
        load, _ = small.link_leaf(g.l7_mm, g.t7_mm, g.R_mm + g.J_mm, constants)
        return small.bridge(g.l6_mm, g.t6_mm, g.la3_mm, g.alpha3_rad, constants), load
    return small.middle_bridge(g.la2_mm, g.alpha2_rad, g.t4_mm, constants), 0.0


def loaded_um(
    axis: Axis, geometry: Geometry, free_um: Scalar, constants: Constants, piezo_N_per_um: Scalar
) -> Float[Array, ""]:
    """Elongation of a piezo that pushes a bridge (Eq. 14), in um, shape `()`.

    Parameters
    ----------
    axis, geometry, constants
        See `output`.
    free_um
        What the piezo would elongate without a load: in proportion to the voltage.
    piezo_N_per_um
        Its stiffness.
    """
    return free_um * piezo_N_per_um / (piezo_N_per_um + input_stiffness_N_per_um(axis, geometry, constants))


def voltage_sensitivity(
    axis: Axis, geometry: Geometry, free_um: Scalar, constants: Constants, piezo_N_per_um: Scalar
) -> Sensitivity:
    """Differentiate the output of an axis, the piezo's voltage being imposed.

    A dimension then acts twice: on the motion, as in Eq. 4, and on the input stiffness and so on the elongation of
    the piezo (Eq. 14), which the paper leaves out and which often is the larger part.

    Parameters
    ----------
    axis, geometry, free_um, constants, piezo_N_per_um
        See `loaded_um`.

    Returns
    -------
    Sensitivity
        With the derivatives for all dimensions, those that enter the stiffness alone among them; `piezo` is the
        derivative with respect to the free elongation.
    """

    def moved(geometry: Geometry, free_um: Array) -> Array:
        at = constants.at(geometry)
        return output(axis, geometry, loaded_um(axis, geometry, free_um, at, piezo_N_per_um), at)

    free = jnp.asarray(free_um, dtype=geometry.l1_mm.dtype)
    solved, (by_geometry, by_free) = jax.value_and_grad(moved, (0, 1))(geometry, free)
    return Sensitivity(solved, by_free, {name: by_geometry[name] for name in DIMENSIONS}, axis)


def _function(axis: Axis, constants: Constants, form: Form) -> Callable[..., Float[Array, ""]]:
    forms = MOTIONS[axis].functions
    if form not in forms:
        raise ValueError(f"{axis} has no form {form!r}: choose one of {', '.join(forms)}")
    if form != "linear" and constants.level != 0:
        raise ValueError(f"form {form!r} is of level 0: make the constants with level=0")
    return forms[form]


def _solved(
    function: Callable[..., Float[Array, ""]],
    values: list[Float[Array, ""]],
    piezo_um: Float[Array, ""],
    constants: Constants,
    axis: Axis,
    geometry: Geometry,
) -> Float[Array, ""]:
    """Find the root of a function that is implicit in its output, from that of the linear one."""
    start = output(axis, geometry, piezo_um, constants)
    # In um of the piezo, and about as large in the unknown.
    unit = jax.lax.stop_gradient(gain(axis, geometry, constants))

    def residual(scaled: Array, given: tuple[list[Array], Array, Constants, Array]) -> Array:
        values, piezo_um, constants, unit = given
        return function(scaled * unit, *values, piezo_um, constants=constants)

    import optimistix as optx  # slow to import

    found: optx.Solution = optx.root_find(
        residual,
        optx.Newton(rtol=1e-9, atol=1e-9),
        start / unit,
        args=(values, piezo_um, constants, unit),
        max_steps=64,
    )
    return found.value * unit
