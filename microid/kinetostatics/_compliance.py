"""Stiffness of leaf hinges, guiding legs and bridge amplifiers in closed form."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._param import array, static
from microid.kinetostatics._geometry import Geometry, Scalar

# In units of a hinge's thickness, fitted once to plane-stress finite elements of hinges in their blocks.
_ROOT_ROTATION, _ROOT_AXIAL, _ROOT_LATERAL = 0.80, 2.18, 0.80
# 60Si2Mn spring steel.
_YOUNGS_MODULUS_MPA, _POISSONS_RATIO = 206e3, 0.29
_SHEAR_COEFFICIENT = 5 / 6
_GUIDES = 4


class Constants(eqx.Module):
    """What enters the motion functions without being one of their arguments.

    Attributes
    ----------
    youngs_modulus_MPa, width_mm
        Of all flexures. Both cancel from every motion; stiffnesses scale with them.
    guides
        Guiding legs of a translation in x or y.
    root_rotation, root_axial, root_lateral
        Compliance of a hinge's ends in its blocks, in thicknesses.
    shear
        Young's modulus over the effective shear modulus; zero for Euler-Bernoulli beams.
    link_height_mm
        In-plane height of links and bars; infinite for rigid ones.
    middle_hinge_mm
        Length `l4`, which the paper leaves out of the motion functions. It matters at level 1 only, and little.
    level
        0 for Euler-Bernoulli leaves between rigid blocks, 1 with elastic roots, shear and links.
    """

    youngs_modulus_MPa: Float[Array, ""] = array()
    width_mm: Float[Array, ""] = array()
    guides: Float[Array, ""] = array()
    root_rotation: Float[Array, ""] = array()
    root_axial: Float[Array, ""] = array()
    root_lateral: Float[Array, ""] = array()
    shear: Float[Array, ""] = array()
    link_height_mm: Float[Array, ""] = array()
    middle_hinge_mm: Float[Array, ""] = array()
    level: int = static()

    def at(self, geometry: Geometry) -> "Constants":
        """Take those that are dimensions (`d`, `h` and `l4`) from a geometry."""
        height = geometry.h_mm if self.level else self.link_height_mm
        return eqx.tree_at(
            lambda c: (c.width_mm, c.link_height_mm, c.middle_hinge_mm),
            self,
            (geometry.d_mm, height, geometry.l4_mm),
        )


def constants_of(
    geometry: Geometry, level: int = 1, youngs_modulus_MPa: Scalar = _YOUNGS_MODULUS_MPA, guides: Scalar = _GUIDES
) -> Constants:
    """Constants of a stage of spring steel.

    Parameters
    ----------
    geometry
        Of which `d`, `h` and `l4` are taken.
    level
        0 for Euler-Bernoulli leaves between rigid blocks. 1 adds the elasticity of hinge roots, links and shear; it
        brings the short hinges of the top platform to a few per cent of plane-stress finite elements, where level 0
        is 2.5 times too stiff.
    youngs_modulus_MPa, guides
        See `Constants`.

    Raises
    ------
    ValueError
        If the level is neither 0 nor 1.
    """
    if level not in (0, 1):
        raise ValueError(f"there are levels 0 and 1, got {level}")
    elastic = float(level)
    return Constants(
        youngs_modulus_MPa=jnp.asarray(youngs_modulus_MPa),
        width_mm=geometry.d_mm,
        guides=jnp.asarray(guides),
        root_rotation=jnp.asarray(elastic * _ROOT_ROTATION),
        root_axial=jnp.asarray(elastic * _ROOT_AXIAL),
        root_lateral=jnp.asarray(elastic * _ROOT_LATERAL),
        shear=jnp.asarray(elastic * 2 * (1 + _POISSONS_RATIO) / _SHEAR_COEFFICIENT),
        link_height_mm=geometry.h_mm if level else jnp.asarray(jnp.inf),
        middle_hinge_mm=geometry.l4_mm,
        level=level,
    )


class TwoPort(eqx.Module):
    """Stiffness of a bridge seen from its piezo and from its free output port, in N/um, each of shape `()`.

    With the elongation `p` of the piezo, the displacement `X` of the output towards the bridge's centre and the force
    on the load, `F_p = K11 p - K12 X` and `F_X = K12 p - K22 X`.
    """

    K11_N_per_um: Float[Array, ""] = array()
    K12_N_per_um: Float[Array, ""] = array()
    K22_N_per_um: Float[Array, ""] = array()

    @property
    def ratio(self) -> Float[Array, ""]:
        """Amplification without a load, in um/um."""
        return self.K12_N_per_um / self.K22_N_per_um

    def loaded_ratio(self, load_N_per_um: Scalar) -> Float[Array, ""]:
        """Amplification against a spring at the output, in um/um."""
        return self.K12_N_per_um / (self.K22_N_per_um + load_N_per_um)

    def input_stiffness_N_per_um(self, load_N_per_um: Scalar) -> Float[Array, ""]:
        """Force of the piezo per elongation, with a spring at the output."""
        return self.K11_N_per_um - self.K12_N_per_um**2 / (self.K22_N_per_um + load_N_per_um)


def leaf_compliance(
    length_mm: Scalar, thickness_mm: Scalar, constants: Constants
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Axial, rotational (1/mm^2) and lateral compliance of a leaf about its centre, times modulus and width."""
    axial = (length_mm + constants.root_axial * thickness_mm) / thickness_mm
    rotational = 12 * (length_mm + constants.root_rotation * thickness_mm) / thickness_mm**3
    lateral = ((length_mm + constants.root_lateral * thickness_mm) / thickness_mm) ** 3
    return axial, rotational, lateral + constants.shear * length_mm / thickness_mm


def bridge(
    length_mm: Scalar, thickness_mm: Scalar, leg_mm: Scalar, inclination_rad: Scalar, constants: Constants
) -> TwoPort:
    """Stiffness of a bridge amplifier of four legs, each a leaf, a link and a leaf; one output port is grounded.

    Parameters
    ----------
    length_mm, thickness_mm
        Of the leaves, which are parallel to the piezo.
    leg_mm, inclination_rad
        Distance between the centres of a leg's two leaves, and inclination of the line through them.
    constants
        Material and level.

    Returns
    -------
    TwoPort
        In N/um.

    Notes
    -----
    About the centre of a leg, which is a centre of symmetry, rotation decouples from translation, and the
    translational compliances of the two leaves and the link add up. The unloaded ratio at level 0,
    `3 la^2 sin cos / (3 la^2 sin^2 + t^2)`, is that of Ling et al. (2016), and does not depend on the leaves' length.
    """
    axial, rotational, lateral = leaf_compliance(length_mm, thickness_mm, constants)
    run, rise = leg_mm * jnp.cos(inclination_rad), leg_mm * jnp.sin(inclination_rad)
    link = (run - length_mm) / constants.link_height_mm
    xx = 2 * axial + rotational * rise**2 / 2 + link
    xy = rotational * run * rise / 2
    yy = 2 * lateral + rotational * run**2 / 2 + link**3 + constants.shear * link
    scale = constants.youngs_modulus_MPa * constants.width_mm / 1000 / (xx * yy - xy**2)
    return TwoPort(scale * yy, scale * xy, scale * xx)


def guide_stiffness_N_per_um(
    length_mm: Scalar, thickness_mm: Scalar, distance_mm: Scalar, constants: Constants
) -> Float[Array, ""]:
    """Stiffness of all guiding legs of a translation against it.

    Parameters
    ----------
    length_mm, thickness_mm
        Of the leaves.
    distance_mm
        Between the centres of a leg's two leaves.
    constants
        Material, number of legs and level.
    """
    _, rotational, lateral = leaf_compliance(length_mm, thickness_mm, constants)
    bar = (distance_mm - length_mm) / constants.link_height_mm
    compliance = 2 * lateral + rotational * distance_mm**2 / 2 + bar**3 + constants.shear * bar
    return constants.guides * constants.youngs_modulus_MPa * constants.width_mm / 1000 / compliance
