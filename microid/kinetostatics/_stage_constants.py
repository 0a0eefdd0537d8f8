"""What an axis is to its controller: strokes, stiffness, resonance, and the mass, spring and damper of Eq. 16."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._param import param, static
from microid.kinetostatics._axes import Axis, drive_of, gain, loaded_um, output
from microid.kinetostatics._compliance import Constants, TwoPort
from microid.kinetostatics._geometry import Geometry
from microid.kinetostatics._motion import tilt_arm_mm

# Bridges that lift the platform together.
_LIFTERS = 4


class Actuation(eqx.Module):
    """Piezos and moving masses; but for stroke and voltage (Section 4.1) typical values that the paper does not give.

    Attributes
    ----------
    piezo_N_per_um
        Stiffness of a piezo, small signal: 25 to 120 N/um for stacks of this stroke.
    free_stroke_um
        Elongation of a piezo without a load at the highest voltage.
    voltage_V
        The highest voltage.
    mass_xy_kg, mass_z_kg
        Moved along x or y, and along z.
    inertia_tilt_kg_mm2, inertia_rotor_kg_mm2
        Turned about x or y, and about z.
    damping_ratio
        Of all axes.
    """

    piezo_N_per_um: Float[Array, ""] = param(unit="N/um", scale=50.0, lower=0.0, default=50.0)
    free_stroke_um: Float[Array, ""] = param(unit="um", scale=10.0, lower=0.0, default=40.0)
    voltage_V: Float[Array, ""] = param(unit="V", scale=100.0, lower=0.0, default=120.0)
    mass_xy_kg: Float[Array, ""] = param(unit="kg", lower=0.0, default=2.0)
    mass_z_kg: Float[Array, ""] = param(unit="kg", lower=0.0, default=0.8)
    inertia_tilt_kg_mm2: Float[Array, ""] = param(unit="kg mm^2", scale=100.0, lower=0.0, default=700.0)
    inertia_rotor_kg_mm2: Float[Array, ""] = param(unit="kg mm^2", scale=100.0, lower=0.0, default=90.0)
    damping_ratio: Float[Array, ""] = param(unit="1", scale=0.01, lower=0.0, default=0.02)


class StageConstants(eqx.Module):
    """An axis in numbers, each of shape `()`; `out` is um or rad.

    Attributes
    ----------
    drive, load_N_per_um
        The bridge, and the spring at its output.
    gain
        Output per elongation of the piezo, in out/um.
    input_stiffness_N_per_um
        Of the loaded bridge, which the piezo pushes.
    loaded_stroke_um
        Elongation of the piezo at the highest voltage (Eq. 14).
    stroke
        Output there, in out.
    resonance_Hz
        First resonance, the voltage being imposed.
    stiffness, mass, damping
        `k_w`, `m_w` and `c_w` of Eq. 16, in N/out, N s^2/out and N s/out. The paper lets a stiffness on the input's
        side act on a mass on the output's (erratum 24); these are chosen so that Eq. 17 has the gain, the resonance
        and the damping of the axis, and are no physical stiffness and mass.
    axis
        Which.
    """

    drive: TwoPort
    load_N_per_um: Float[Array, ""]
    gain: Float[Array, ""]
    input_stiffness_N_per_um: Float[Array, ""]
    loaded_stroke_um: Float[Array, ""]
    stroke: Float[Array, ""]
    resonance_Hz: Float[Array, ""]
    stiffness: Float[Array, ""]
    mass: Float[Array, ""]
    damping: Float[Array, ""]
    axis: Axis = static()


def stage_constants(axis: Axis, geometry: Geometry, constants: Constants, actuation: Actuation) -> StageConstants:
    """Derive what a controller needs to know of an axis.

    Parameters
    ----------
    axis, geometry, constants
        See `output`.
    actuation
        Piezos and masses.
    """
    drive, load = drive_of(axis, geometry, constants)
    stiffness_in = drive.input_stiffness_N_per_um(load)
    stroke_um = loaded_um(axis, geometry, actuation.free_stroke_um, constants, actuation.piezo_N_per_um)
    ratio = gain(axis, geometry, constants)
    held = drive.K22_N_per_um + load - drive.K12_N_per_um**2 / (drive.K11_N_per_um + actuation.piezo_N_per_um)
    # N/um over kg is 1e6 / s^2.
    rate = 1e3 * jnp.sqrt(held / _moved_kg(axis, geometry, actuation))
    stiffness = stiffness_in / ratio
    return StageConstants(
        drive,
        jnp.asarray(load, dtype=ratio.dtype),
        ratio,
        stiffness_in,
        stroke_um,
        output(axis, geometry, stroke_um, constants),
        rate / (2 * jnp.pi),
        stiffness,
        stiffness / rate**2,
        2 * actuation.damping_ratio * stiffness / rate,
        axis,
    )


def _moved_kg(axis: Axis, geometry: Geometry, actuation: Actuation) -> Float[Array, ""]:
    """Mass that each driven bridge sees at its output."""
    if axis in ("x", "y"):
        return actuation.mass_xy_kg
    if axis == "z":
        return actuation.mass_z_kg / _LIFTERS
    if axis == "gamma":
        return actuation.inertia_rotor_kg_mm2 / (2 * (geometry.R_mm + geometry.J_mm) ** 2)
    return actuation.inertia_tilt_kg_mm2 / (2 * (tilt_arm_mm(geometry.l_mm, geometry.l5_mm) / 2) ** 2)
