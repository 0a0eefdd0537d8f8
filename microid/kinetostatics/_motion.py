"""The six motion functions of the stage (Eq. 2) for small strokes, with the arguments of Eq. 5."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from microid.kinetostatics._compliance import Constants, TwoPort, bridge, guide_stiffness_N_per_um, leaf_compliance
from microid.kinetostatics._geometry import Scalar

_Residual = Float[Array, ""]


def f_x(
    x_out_um: Scalar,
    l1_mm: Scalar,
    t1_mm: Scalar,
    la1_mm: Scalar,
    l2_mm: Scalar,
    t2_mm: Scalar,
    l3_mm: Scalar,
    alpha1_rad: Scalar,
    x_pzt_um: Scalar,
    *,
    constants: Constants,
) -> _Residual:
    """Translation in x, zero where the output belongs to the elongation of the piezo, in um.

    One bridge of the bottom platform drives; the guiding legs are a spring at its output. The opposite, undriven
    bridge is taken as not attached.
    """
    drive = bridge(l1_mm, t1_mm, la1_mm, alpha1_rad, constants)
    load = guide_stiffness_N_per_um(l2_mm, t2_mm, l3_mm, constants)
    return x_out_um - drive.loaded_ratio(load) * x_pzt_um


def f_y(
    y_out_um: Scalar,
    l1_mm: Scalar,
    t1_mm: Scalar,
    la1_mm: Scalar,
    l2_mm: Scalar,
    t2_mm: Scalar,
    l3_mm: Scalar,
    alpha1_rad: Scalar,
    y_pzt_um: Scalar,
    *,
    constants: Constants,
) -> _Residual:
    """Translation in y, in um of the piezo: as `f_x`, by symmetry."""
    return f_x(y_out_um, l1_mm, t1_mm, la1_mm, l2_mm, t2_mm, l3_mm, alpha1_rad, y_pzt_um, constants=constants)


def f_z(
    z_out_um: Scalar, la2_mm: Scalar, alpha2_rad: Scalar, t4_mm: Scalar, z_pzt_um: Scalar, *, constants: Constants
) -> _Residual:
    """Translation in z, in um: the bridges of the middle platform, all driven alike, carry no load.

    The paper's Eq. (2) lists `t4` twice (erratum 1).
    """
    return z_out_um - middle_bridge(la2_mm, alpha2_rad, t4_mm, constants).ratio * z_pzt_um


def f_alpha(
    alpha_out_rad: Scalar,
    l_mm: Scalar,
    l5_mm: Scalar,
    la2_mm: Scalar,
    alpha2_rad: Scalar,
    t4_mm: Scalar,
    alpha_pzt_um: Scalar,
    *,
    constants: Constants,
) -> _Residual:
    """Rotation about x, in rad: one bridge of the middle platform lifts its side.

    The platform tilts as the bending of the two leaves `l5` lets it, whose thickness cancels. The paper's Eq. (2) has
    `l1` in place of `l` (erratum 2), and `alpha_pzt` is a displacement (erratum 12).
    """
    lift_um = middle_bridge(la2_mm, alpha2_rad, t4_mm, constants).ratio * alpha_pzt_um
    return alpha_out_rad - jnp.arctan(1e-3 * lift_um / tilt_arm_mm(l_mm, l5_mm))


def f_beta(
    beta_out_rad: Scalar,
    l_mm: Scalar,
    l5_mm: Scalar,
    la2_mm: Scalar,
    alpha2_rad: Scalar,
    t4_mm: Scalar,
    beta_pzt_um: Scalar,
    *,
    constants: Constants,
) -> _Residual:
    """Rotation about y, in um of the piezo: as `f_alpha`, by symmetry."""
    return f_alpha(beta_out_rad, l_mm, l5_mm, la2_mm, alpha2_rad, t4_mm, beta_pzt_um, constants=constants)


def f_gamma(
    gamma_out_rad: Scalar,
    l6_mm: Scalar,
    t6_mm: Scalar,
    la3_mm: Scalar,
    l7_mm: Scalar,
    t7_mm: Scalar,
    alpha3_rad: Scalar,
    J_mm: Scalar,
    R_mm: Scalar,
    gamma_pzt_um: Scalar,
    *,
    constants: Constants,
) -> _Residual:
    """Rotation about z, in rad: two bridges of the top platform turn the rotor as a couple, each through a leaf.

    Each bridge's output block is taken as guided: it neither turns nor moves sideways. Held by its own legs alone it
    would let the rotor turn further, by 17 % for the paper's dimensions. The paper counts six arguments where Eq. (4)
    sums eight (erratum 5).
    """
    drive = bridge(l6_mm, t6_mm, la3_mm, alpha3_rad, constants)
    load, give = link_leaf(l7_mm, t7_mm, R_mm + J_mm, constants)
    tip_um = drive.loaded_ratio(load) / give * gamma_pzt_um
    return gamma_out_rad - jnp.arcsin(1e-3 * tip_um / (R_mm + J_mm))


def middle_bridge(la2_mm: Scalar, alpha2_rad: Scalar, t4_mm: Scalar, constants: Constants) -> TwoPort:
    """Stiffness of a bridge of the middle platform; the length of its hinges is a constant."""
    return bridge(constants.middle_hinge_mm, t4_mm, la2_mm, alpha2_rad, constants)


def tilt_arm_mm(l_mm: Scalar, l5_mm: Scalar) -> Scalar:
    """Lift of one side per tilt of the platform, small angles, in mm.

    Each leaf is clamped to its bridge and to the platform; the moment that both exert on the platform is zero.
    """
    return 4 * (3 * l_mm**2 + 3 * l_mm * l5_mm + l5_mm**2) / (3 * (2 * l_mm + l5_mm))


def link_leaf(
    l7_mm: Scalar, t7_mm: Scalar, arm_mm: Scalar, constants: Constants
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """What the rotor and its leaf are to a bridge of the top platform.

    Returns
    -------
    tuple
        The spring at the bridge's output in N/um, and the output's displacement per displacement of the lever's tip.

    Notes
    -----
    The tip moves along the leaf to first order, so the leaf is bent by an end rotation without deflection, and
    stretched by its load.
    """
    axial, rotational, lateral = leaf_compliance(l7_mm, t7_mm, constants)
    stiffness = (1 / rotational + l7_mm**2 / (4 * lateral)) / arm_mm**2
    give = 1 + stiffness * axial
    return constants.youngs_modulus_MPa * constants.width_mm / 1000 * stiffness / give, give
