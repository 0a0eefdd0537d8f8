"""What tolerances make of a gain beyond first order: mean shift and variance from second derivatives."""

from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.io._errors import DataError
from fits.machining._design import Design
from microid import AXES, DIMENSIONS, MOTIONS, Axis, Constants, Geometry, gain, loaded_um

Distribution = Literal["normal", "uniform", "triangular"]
DISTRIBUTIONS: tuple[Distribution, ...] = ("normal", "uniform", "triangular")
# Constants of the motion functions that are dimensions; stiffnesses depend on them.
_OTHERS = ("l4", "h", "d")


@dataclass(frozen=True)
class SecondOrder:
    """Spread of a gain that is a quadratic function of the dimensions' errors.

    Attributes
    ----------
    axis, unit
        Which, and the unit of its gain: `um/um` or `rad/um`; per um of free elongation with `voltage`.
    distribution, voltage
        As asked for.
    names
        Dimensions that the gain depends on, `k` of them.
    gain
        At the nominal dimensions.
    gradient, hessian
        Derivatives per mm or rad, shapes `(k,)` and `(k, k)`.
    first_order_sd
        Standard deviation from the gradient alone.
    mean_shift
        Mean less the gain at the nominal dimensions.
    pairs
        What each pair adds to the variance at second order, shape `(k, k)`; the sum of all counts, and two equal
        halves of a pair stand at either side of the diagonal.
    """

    axis: Axis
    unit: str
    distribution: Distribution
    voltage: bool
    names: tuple[str, ...]
    gain: float
    gradient: np.ndarray
    hessian: np.ndarray
    first_order_sd: float
    mean_shift: float
    pairs: np.ndarray

    @property
    def sd(self) -> float:
        """Standard deviation at second order."""
        return float(np.sqrt(max(0.0, self.first_order_sd**2 + self.pairs.sum())))

    @property
    def second_order_share(self) -> float:
        """Part of the variance that the gradient does not give."""
        return float(self.pairs.sum() / (self.first_order_sd**2 + self.pairs.sum()))


def second_order(
    design: Design, axis: Axis, distribution: Distribution = "normal", *, voltage: bool = False
) -> SecondOrder:
    r"""Expand the gain of an axis to second order in the dimensions' errors.

    With the covariance :math:`\Sigma`, gradient g and Hessian H, the mean shifts by :math:`\tfrac12 \mathrm{tr} H
    \Sigma` and the variance is

    .. math::

        g^T \Sigma g + \tfrac12 \mathrm{tr} H \Sigma H \Sigma + \tfrac14 \sum_i H_{ii}^2 (\mu_{4i} - 3 \sigma_i^4)

    for independent dimensions of any symmetric distribution with fourth moments :math:`\mu_4`, and for correlated
    normal ones. Correlated dimensions that are not normal have joint fourth moments that this leaves out. Third
    derivatives add to the variance at the same power of the tolerances unless the gradient vanishes; they are left
    out, too.

    Parameters
    ----------
    design
        Dimensions and tolerances.
    axis
        One of `AXES`.
    distribution
        `normal` with the tolerance as three standard deviations; `uniform` or `triangular` over the tolerance.
    voltage
        Impose the voltage of the piezo instead of its elongation.

    Raises
    ------
    DataError
        If there is no such axis or distribution, or a tolerance is as large as its dimension.
    """
    check(design, (axis,), distribution)
    names = inputs_of(axis, voltage)
    at = nominal(design, names), twin(axis), names, *setting(design, voltage)
    value, slopes = first_order(*at)
    gradient, hessian = np.asarray(slopes), np.asarray(_hessian(*at))
    sigma = covariance(design, names, distribution)
    bent = hessian @ sigma
    second, fourth = moments(distribution)
    tolerance = tolerances(design, names)
    tails = np.diag(hessian) ** 2 * (fourth - 3 * second**2) * tolerance**4 / 4
    return SecondOrder(
        axis,
        f"{MOTIONS[axis].unit}/um",
        distribution,
        voltage,
        names,
        float(value),
        gradient,
        hessian,
        float(np.sqrt(gradient @ sigma @ gradient)),
        float(np.trace(bent) / 2),
        bent * bent.T / 2 + np.diag(tails),
    )


def check(design: Design, axes: tuple[Axis, ...], distribution: str) -> None:
    """Refuse what cannot be drawn.

    Raises
    ------
    DataError
        If an axis or the distribution is unknown, an axis has no tolerances, or draws reach a dimension of zero.
    RuntimeError
        If float64 is off.
    """
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError('tolerances need float64: jax.config.update("jax_enable_x64", True)')
    if distribution not in DISTRIBUTIONS:
        raise DataError(f"there is no distribution {distribution!r}: choose one of {', '.join(DISTRIBUTIONS)}")
    unknown = [axis for axis in axes if axis not in AXES]
    if unknown or not axes:
        raise DataError(f"there is no axis {unknown[0] if unknown else ''!r}: choose some of {', '.join(AXES)}")
    for axis in axes:
        if not any(design.tolerance[name] > 0 for name in MOTIONS[axis].dimensions):
            raise DataError(f"{axis} does not spread without tolerances: give one of {_list(axis)} a positive one")
    # Six standard deviations of a normal distribution.
    reach = 2 if distribution == "normal" else 1
    for name in DIMENSIONS:
        value, tolerance = float(design.geometry[name]), design.tolerance[name]
        if value - reach * tolerance <= 0:
            unit = DIMENSIONS[name].unit
            raise DataError(
                f"{name} of {value:g} {unit} with a tolerance of {tolerance:g} {unit} may come out as zero "
                f"when drawn from a {distribution} distribution: lower the tolerance below {value / reach:g} {unit}"
            )


def _list(axis: Axis) -> str:
    return ", ".join(MOTIONS[axis].dimensions)


def twin(axis: Axis) -> Axis:
    """The first axis that is the same function of the same dimensions: x for y, alpha for beta, others themselves."""
    return next(other for other in AXES if MOTIONS[other].dimensions == MOTIONS[axis].dimensions)


def inputs_of(axis: Axis, voltage: bool) -> tuple[str, ...]:
    """Names of the dimensions that a gain depends on: those of Eq. 5, and with `voltage` those of the stiffness."""
    names = MOTIONS[axis].dimensions
    return names + _OTHERS if voltage else names


def setting(design: Design, voltage: bool) -> tuple[Geometry, Constants, Float[Array, ""] | None]:
    """What stays as it is: geometry, constants, and the stiffness of the piezo if its voltage is imposed."""
    return design.geometry, design.constants, design.actuation.piezo_N_per_um if voltage else None


def gain_at(
    values: Float[Array, " k"],
    axis: Axis,
    names: tuple[str, ...],
    geometry: Geometry,
    constants: Constants,
    piezo_N_per_um: Float[Array, ""] | None,
) -> Float[Array, ""]:
    """Gain of an axis with some dimensions replaced; per free elongation if the stiffness of the piezo is given."""
    fields = {field: getattr(geometry, field) for field in (d.field for d in DIMENSIONS.values())}
    fields |= {DIMENSIONS[name].field: value for name, value in zip(names, values, strict=True)}
    changed = Geometry(**fields)
    if piezo_N_per_um is None:
        return gain(axis, changed, constants)
    at = constants.at(changed)
    return gain(axis, changed, at) * loaded_um(axis, changed, 1.0, at, piezo_N_per_um)


@eqx.filter_jit
def first_order(
    values: Float[Array, " k"],
    axis: Axis,
    names: tuple[str, ...],
    geometry: Geometry,
    constants: Constants,
    piezo_N_per_um: Float[Array, ""] | None,
) -> tuple[Float[Array, ""], Float[Array, " k"]]:
    """Gain of an axis and its derivatives with respect to the values; see `gain_at`."""
    return jax.value_and_grad(gain_at)(values, axis, names, geometry, constants, piezo_N_per_um)


@eqx.filter_jit
def _hessian(
    values: Float[Array, " k"],
    axis: Axis,
    names: tuple[str, ...],
    geometry: Geometry,
    constants: Constants,
    piezo_N_per_um: Float[Array, ""] | None,
) -> Float[Array, "k k"]:
    # Forward over forward compiles in half the time of forward over reverse.
    return jax.jacfwd(jax.jacfwd(gain_at))(values, axis, names, geometry, constants, piezo_N_per_um)


def nominal(design: Design, names: tuple[str, ...]) -> Float[Array, " k"]:
    """Values of dimensions, shape `(k,)`, in mm and rad."""
    return jnp.stack([design.geometry[name] for name in names])


def tolerances(design: Design, names: tuple[str, ...]) -> np.ndarray:
    """Tolerances of dimensions, shape `(k,)`, in mm and rad."""
    return np.array([design.tolerance[name] for name in names])


def moments(distribution: Distribution) -> tuple[float, float]:
    """Variance and fourth central moment for a tolerance of one."""
    return {"normal": (1 / 9, 1 / 27), "uniform": (1 / 3, 1 / 5), "triangular": (1 / 6, 1 / 15)}[distribution]


def covariance(design: Design, names: tuple[str, ...], distribution: Distribution) -> np.ndarray:
    """Covariance of dimensions, shape `(k, k)`, in their units."""
    sd = np.sqrt(moments(distribution)[0]) * tolerances(design, names)
    return np.asarray(sd[:, None] * design.correlation(names) * sd)
