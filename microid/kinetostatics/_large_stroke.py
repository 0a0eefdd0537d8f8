"""Motion functions for large strokes, where the bridge flattens and amplifies less.

Two forms, both for Euler-Bernoulli leaves between rigid blocks (level 0): links that turn about hinges, which keeps
the arguments of Eq. 2 and makes `f_z` truly implicit, and leaves as beam-columns, which is within 0.13 % of
co-rotational finite elements at 40 um.
"""

import math

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid.kinetostatics._compliance import Constants, guide_stiffness_N_per_um
from microid.kinetostatics._geometry import Scalar
from microid.kinetostatics._motion import link_leaf, tilt_arm_mm

_Residual = Float[Array, ""]
_Shape = Float[Array, "5"]
# Terms of a series in `p`; those left out are below rounding for arguments up to 16.
_TERMS = 18
_LARGEST = 4.0


def pseudo_rigid_z(
    z_out_um: Scalar, la2_mm: Scalar, alpha2_rad: Scalar, t4_mm: Scalar, z_pzt_um: Scalar, *, constants: Constants
) -> _Residual:
    """Translation in z, in um of the piezo: links turn about the centres of their hinges and stretch them.

    The derivative with respect to the output is not one: Eq. 3 and 4 need the inverse that they lack (erratum 6).
    """
    rise = la2_mm * jnp.sin(alpha2_rad) - z_out_um / 2000
    turn = alpha2_rad - jnp.arcsin(rise / la2_mm)
    run = jnp.sqrt(la2_mm**2 - rise**2) - la2_mm * jnp.cos(alpha2_rad)
    return 2000 * (run + t4_mm**2 / 3 * turn / rise) - z_pzt_um


def pseudo_rigid_alpha(
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
    """Rotation about x or y, in um of the piezo: the lift as in `pseudo_rigid_z`."""
    lift_um = 1000 * tilt_arm_mm(l_mm, l5_mm) * jnp.tan(alpha_out_rad)
    return pseudo_rigid_z(lift_um, la2_mm, alpha2_rad, t4_mm, alpha_pzt_um, constants=constants)


def beam_x(
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
    """Translation in x or y, in um, with leaves as beam-columns."""
    load = guide_stiffness_N_per_um(l2_mm, t2_mm, l3_mm, constants)
    return x_out_um - _flattened_um(l1_mm, t1_mm, la1_mm, alpha1_rad, load, x_pzt_um, constants)


def beam_z(
    z_out_um: Scalar, la2_mm: Scalar, alpha2_rad: Scalar, t4_mm: Scalar, z_pzt_um: Scalar, *, constants: Constants
) -> _Residual:
    """Translation in z, in um, with leaves as beam-columns."""
    return z_out_um - _flattened_um(constants.middle_hinge_mm, t4_mm, la2_mm, alpha2_rad, 0.0, z_pzt_um, constants)


def beam_alpha(
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
    """Rotation about x or y, in rad, with the bridge's leaves as beam-columns."""
    lift_um = -beam_z(0.0, la2_mm, alpha2_rad, t4_mm, alpha_pzt_um, constants=constants)
    return alpha_out_rad - jnp.arctan(1e-3 * lift_um / tilt_arm_mm(l_mm, l5_mm))


def beam_gamma(
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
    """Rotation about z, in rad, with the bridge's leaves as beam-columns."""
    load, give = link_leaf(l7_mm, t7_mm, R_mm + J_mm, constants)
    tip_um = _flattened_um(l6_mm, t6_mm, la3_mm, alpha3_rad, load, gamma_pzt_um, constants) / give
    return gamma_out_rad - jnp.arcsin(1e-3 * tip_um / (R_mm + J_mm))


def _flattened_um(
    length_mm: Scalar,
    thickness_mm: Scalar,
    leg_mm: Scalar,
    inclination_rad: Scalar,
    load_N_per_um: Scalar,
    piezo_um: Scalar,
    constants: Constants,
) -> Float[Array, ""]:
    r"""Output of a bridge whose leaves bend as beam-columns, `EI \eta'' = P \eta - V (L_c - x)`, in um.

    Parameters
    ----------
    length_mm, thickness_mm, leg_mm, inclination_rad
        See `bridge`.
    load_N_per_um
        Spring at the output.
    piezo_um
        Elongation of the piezo; negative ones push the leaves instead of pulling them.
    constants
        Of level 0.

    Notes
    -----
    The unknown is `p = P l^2 / EI`, found by Newton's method from its value for small strokes, and differentiated
    implicitly. Every term is a series in `p` without a singularity at rest, so that all derivatives exist there.
    """
    spring = load_N_per_um * 1000 / (constants.youngs_modulus_MPa * constants.width_mm)
    shape = jnp.stack(jnp.broadcast_arrays(length_mm, thickness_mm, leg_mm, inclination_rad, spring))
    wanted = jnp.asarray(piezo_um / 1000, dtype=shape.dtype)
    start = wanted * _load_per_elongation(shape)
    import optimistix as optx  # slow to import

    found: optx.Solution = optx.root_find(
        _excess, optx.Newton(rtol=1e-9, atol=1e-12), start, args=(shape, wanted), max_steps=64
    )
    p = eqx.error_if(
        found.value,
        jnp.abs(found.value) > _LARGEST,
        "the stroke asks more of the bridge's leaves than they can bear: shorten it",
    )
    return 1000 * _beam_column(p, shape)[1]


def _excess(p: _Residual, given: tuple[_Shape, _Residual]) -> _Residual:
    """Elongation beyond the one that is wanted, in thicknesses of the leaves."""
    shape, wanted = given
    return (_beam_column(p, shape)[0] - wanted) / shape[1]


def _load_per_elongation(shape: _Shape) -> _Residual:
    """Return `p` per elongation in mm for small strokes."""
    length, thickness, leg, inclination, spring = shape
    run, rise = leg * jnp.cos(inclination), leg * jnp.sin(inclination)
    xx = 2 * length / thickness + 6 * length * rise**2 / thickness**3
    xy = 6 * length * run * rise / thickness**3
    yy = 2 * (length / thickness) ** 3 + 6 * length * run**2 / thickness**3
    loose = xx * yy - xy**2
    # Each leg carries half of the piezo's force.
    force = (yy - xy**2 / (xx + spring * loose)) / loose / 2
    return 12 * force * length**2 / thickness**3


def _beam_column(p: _Residual, shape: _Shape) -> tuple[_Residual, _Residual]:
    """Elongation of the piezo and output of the bridge, in mm, at `p`."""
    length, thickness, leg, inclination, spring = shape
    rise = leg * jnp.sin(inclination)
    insert = leg * jnp.cos(inclination) - length
    half = insert / 2
    inertia = thickness**3 / 12
    cosh, sinhc, cosh_rest, difference, sinhc_rest, rest_difference = _entire(p)
    bend = cosh + half * p * sinhc / length
    give = length**2 / inertia * (length * difference + half * (length + half) * sinhc / length) / bend
    # Output of a half, over p.
    lift = rise * (cosh_rest + half * sinhc / length) / bend / (1 + 2 * spring * give)
    shear = spring * lift * length**2 / inertia
    slope = (rise / 2 - shear * (length * sinhc + half * cosh)) / bend
    turn = p * (slope * sinhc / length + shear * cosh_rest)
    shortening = p**2 * (
        2 * slope**2 * sinhc_rest / length + 2 * shear**2 * length * rest_difference + slope * shear * cosh_rest**2
    )
    stretch = 2 * p * inertia / (length * thickness)
    return 2 * (stretch - shortening + rise * jnp.sin(turn) - insert * (1 - jnp.cos(turn))), 2 * p * lift


def _entire(p: _Residual) -> Float[Array, "6"]:
    """Entire functions of `p = x^2`: cosh x, sinh x / x, and what is left of them beyond the first terms.

    These are, over `p`: cosh x less 1, cosh x less sinh x / x, sinh x / x less 1 at 4 p, and the last less the same
    at p, over `p` again.
    """
    rows = [
        (
            1 / math.factorial(2 * n),
            1 / math.factorial(2 * n + 1),
            1 / math.factorial(2 * n + 2),
            (2 * n + 2) / math.factorial(2 * n + 3),
            4**n / math.factorial(2 * n + 3),
            (4 ** (n + 1) - 1) / math.factorial(2 * n + 5),
        )
        for n in reversed(range(_TERMS))
    ]
    return lax.scan(lambda total, row: (total * p + row, None), jnp.zeros(6, p.dtype), jnp.asarray(rows, p.dtype))[0]
