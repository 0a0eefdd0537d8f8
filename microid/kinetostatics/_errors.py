"""The positioning error and its three parts (Eq. 1, 3, 4 and 7)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._preisach import Preisach
from microid.kinetostatics._geometry import Scalar


class DrivingError(eqx.Module):
    """What hysteresis adds to a piezo's proportional elongation, each of shape `(n,)` but for the slope.

    Attributes
    ----------
    slope_um_per_V
        The proportional elongation per voltage.
    signed_um
        Elongation less its proportional part.
    absolute_um
        Its size: Eq. 7, which loses the sign that Eq. 1 and 3 need (erratum 10).
    """

    slope_um_per_V: Float[Array, ""]
    signed_um: Float[Array, " n"]
    absolute_um: Float[Array, " n"]


class TotalError(eqx.Module):
    """Three parts of a positioning error put together, in the unit of the axis.

    Attributes
    ----------
    signed
        Sum with signs (Eq. 1): what a stage with just these errors is off.
    worst_case
        Sum of sizes: no combination of signs is worse.
    root_sum_square
        For parts that are independent and whose signs are not known.
    """

    signed: Float[Array, ""]
    worst_case: Float[Array, ""]
    root_sum_square: Float[Array, ""]


def driving_error(
    model: Preisach, voltage_V: Float[Array, " n"], slope_um_per_V: Scalar | None = None
) -> DrivingError:
    r"""Compare a piezo with a proportional one over a voltage program (Eq. 7).

    .. math:: \delta w_{pzt} = H(u) - \varsigma u

    Parameters
    ----------
    model
        Voltage to elongation; its offset is left out.
    voltage_V
        Program, shape `(n,)`, from negative saturation. The paper's is one loop over the whole range.
    slope_um_per_V
        The proportional elongation per voltage, counted from the first sample. By default the one that leaves the
        smallest squares over the program.

    Returns
    -------
    DrivingError
        In um of elongation. `Sensitivity.piezo` turns it into an error of the output (Eq. 3).
    """
    moved = model(voltage_V)
    moved = moved - moved[0]
    swing = voltage_V - voltage_V[0]
    slope = jnp.vdot(swing, moved) / jnp.vdot(swing, swing) if slope_um_per_V is None else jnp.asarray(slope_um_per_V)
    signed = moved - slope * swing
    return DrivingError(slope, signed, jnp.abs(signed))


def total_error(driving: Scalar, machining: Scalar, measuring: Scalar) -> TotalError:
    """Put driving, machining and measuring error of one axis together (Eq. 1).

    Parameters
    ----------
    driving, machining, measuring
        With their signs, in the unit of the axis, each of shape `()`.
    """
    parts = jnp.stack(jnp.broadcast_arrays(driving, machining, measuring))
    return TotalError(jnp.sum(parts), jnp.sum(jnp.abs(parts)), jnp.sqrt(jnp.sum(parts**2)))
