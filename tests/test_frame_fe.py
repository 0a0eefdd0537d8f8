"""Level 0 of the stage's motion against frames of beam elements, which are first checked against the textbook."""

import _frame_fe as fe
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from _models import compiled

from microid import kinetostatics as ks

GEOMETRIES = 100
SHEAR = 3.1


def close(found, wanted, rtol=1e-8):
    np.testing.assert_allclose(found, wanted, rtol=rtol)


def section(rng):
    """Modulus, width, thickness and length of a leaf, in MPa and mm, and its bending stiffness."""
    modulus, width, thickness, length = rng.uniform([1e5, 5, 0.4, 2], [2.5e5, 15, 1.2, 9])
    return modulus, width, thickness, length, modulus * width * thickness**3 / 12


def cantilever(modulus, width, thickness, length, angle, shear=0.0, pieces=1, arm=0.0):
    """Flexibility at the end of a leaf, or of a rigid arm beyond: along it, across it, and its rotation."""
    f = fe.Frame(modulus, width, shear, pieces)
    along, across = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    tip = f.body((length + arm) * along)
    f.leaf(f.ground, [0.0, 0.0], tip, length * along, thickness)
    rows = [f.motion(tip, np.append(along, 0)), f.motion(tip, np.append(across, 0)), f.motion(tip, fe.TURN)]
    return np.linalg.inv(f.ports(f.held(f.ground), rows))


@pytest.mark.parametrize("pieces", [1, 4])
@pytest.mark.parametrize("shear", [0.0, SHEAR])
def test_a_cantilever_bends_as_in_the_textbook(rng, shear, pieces):
    modulus, width, thickness, length, bending = section(rng)
    found = cantilever(modulus, width, thickness, length, rng.uniform(-np.pi, np.pi), shear, pieces)
    area = modulus * width * thickness
    deflection = length**3 / (3 * bending) + shear * length / area
    slope = length**2 / (2 * bending)
    wanted = [[length / area, 0, 0], [0, deflection, slope], [0, slope, length / bending]]
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9 * length / area)


def test_a_rigid_arm_carries_the_load_without_bending(rng):
    """The moment grows linearly from the load, and bends the leaf alone."""
    modulus, width, thickness, length, bending = section(rng)
    arm = rng.uniform(1, 10)
    found = cantilever(modulus, width, thickness, length, rng.uniform(-np.pi, np.pi), arm=arm)
    close(found[1, 1], ((length + arm) ** 3 - arm**3) / (3 * bending))


def test_a_corner_adds_bending_and_stretching(rng):
    """A column with a beam at its top: the load at the beam's end turns, and shortens, the column."""
    modulus, width, thickness, length, bending = section(rng)
    reach = rng.uniform(2, 9)
    f = fe.Frame(modulus, width)
    corner, tip = f.body([0.0, length]), f.body([reach, length])
    f.leaf(f.ground, [0.0, 0.0], corner, [0.0, length], thickness)
    f.leaf(corner, [0.0, length], tip, [reach, length], thickness)
    compliance = np.linalg.inv(f.ports(f.held(f.ground), [f.motion(tip, d) for d in (fe.X, fe.Y, fe.TURN)]))
    sunk = reach**3 / (3 * bending) + reach**2 * length / bending + length / (modulus * width * thickness)
    close(compliance[1, 1], sunk)
    # The end goes sideways as much as the column's top, under its moment.
    close(compliance[0, 1], -reach * length**2 / (2 * bending))


def test_a_guided_leaf_has_twelve_EI_over_l_cubed(rng):
    modulus, width, thickness, length, bending = section(rng)
    f = fe.Frame(modulus, width)
    block = f.body([length, 0.0])
    f.leaf(f.ground, [0.0, 0.0], block, [length, 0.0], thickness)
    still = [*f.held(f.ground), *f.held(block, (fe.X, fe.TURN))]
    close(f.ports(still, [f.motion(block, fe.Y)]), 12 * bending / length**3)


def frames(dimensions, **options):
    """The three frames that hold bridges, with the elongations of their piezos and what is held."""
    for axis in ("x", "z"):
        f, bridge, still = fe.amplifier(axis, dimensions, **options)
        yield f, [bridge.elongation(), bridge.displacement()], still
    f, centre, bridges, still = fe.rotor(dimensions, **options)
    yield f, [*(b.elongation() for b in bridges), f.motion(centre, fe.TURN)], still


@pytest.mark.parametrize("pieces", [1, 3])
def test_only_rigid_motions_are_free_of_force(rng, pieces):
    """Unheld, each frame has three motions without energy: two translations and a rotation of the whole."""
    for f, _, _ in frames(fe.random_dimensions(rng), pieces=pieces):
        stiffness = f.stiffness()
        rigid = np.vstack([np.column_stack([[1, 0, -y], [0, 1, x], [0, 0, 1]]).T for x, y in f.places])
        force = np.abs(stiffness) @ np.abs(rigid)
        assert np.all(np.abs(stiffness @ rigid) <= 1e-12 * force)
        # A scale for each coordinate, as translations and rotations have different units.
        scale = np.sqrt(np.diag(stiffness))
        energies = np.linalg.eigvalsh(stiffness / np.outer(scale, scale))
        assert np.all(np.abs(energies[:3]) < 1e-12)
        assert energies[3] > 1e-9


def test_a_force_here_moves_there_as_one_there_moves_here(rng):
    """Maxwell, with forces at points and moments on any bodies, each solved for on its own."""
    for f, _, _ in frames(fe.random_dimensions(rng), shear=SHEAR):
        free = np.eye(3 * len(f.places))[3:]
        here, there = (free @ f.point(b, rng.uniform(-20, 20, 2)).T @ rng.standard_normal(3) for b in (1, 3))
        stiffness = free @ f.stiffness() @ free.T
        close(there @ np.linalg.solve(stiffness, here), here @ np.linalg.solve(stiffness, there))


@pytest.mark.parametrize("shear", [0.0, SHEAR])
def test_more_elements_change_nothing(rng, shear):
    dimensions = fe.random_dimensions(rng)
    for axis in ("x", "z", "alpha", "gamma"):
        coarse, fine = (fe.gain(axis, dimensions, shear=shear, pieces=n) for n in (1, 4))
        close(fine, coarse)
    for axis in ("x", "z", "gamma"):
        close(*(fe.input_stiffness_N_per_um(axis, dimensions, shear=shear, pieces=n) for n in (1, 4)))


def test_outputs_move_straight_where_symmetry_says_so(rng):
    """The stage and the rotor are held by nothing but their leaves."""
    dimensions = fe.random_dimensions(rng)
    f, bridge, still = fe.amplifier("x", dimensions)
    moved = f.point(bridge.output, f.places[bridge.output]) @ f.imposed(still, [bridge.elongation()])
    assert np.all(np.abs(moved[[0, 2]]) < 1e-9 * np.abs(moved[1]))
    f, centre, bridges, still = fe.rotor(dimensions)
    moved = f.point(centre, [0.0, 0.0]) @ f.imposed(still, [b.elongation() for b in bridges]).sum(1)
    assert np.all(np.abs(moved[:2]) < 1e-9 * np.abs(moved[2]))


def test_ports_are_those_of_forces_and_displacements(rng):
    """What a port needs when displaced is what a load there must be to displace it."""
    for f, rows, still in frames(fe.random_dimensions(rng)):
        free = np.linalg.svd(still)[2][len(still) :]
        loads = free @ np.transpose(rows)
        close(np.linalg.inv(f.ports(still, rows)), loads.T @ np.linalg.solve(free @ f.stiffness() @ free.T, loads))


def drawn(rng, count=GEOMETRIES):
    """Dimensions, widths in mm, moduli in MPa and numbers of guiding legs."""
    return (
        [fe.random_dimensions(rng) for _ in range(count)],
        rng.uniform(5, 20, count),
        rng.uniform(1e5, 2.5e5, count),
        rng.choice([2, 4, 6, 8], count),
    )


def stage(drawn):
    """The same as arguments of `compared`, with all sizes along one axis."""
    dimensions, width, modulus, guides = drawn
    sizes = {ks.DIMENSIONS[name].field: jnp.asarray([d[name] for d in dimensions]) for name in dimensions[0]}
    geometry = ks.Geometry(**sizes, d_mm=jnp.asarray(width), h_mm=jnp.asarray(width))
    return geometry, jnp.asarray(modulus), jnp.asarray(guides, dtype=float)


@compiled
def compared(geometry, modulus_MPa, guides, shear):
    """Gains and input stiffnesses of all axes, for each of many geometries."""

    def one(g, modulus, guides):
        constants = ks.constants_of(g, level=0, youngs_modulus_MPa=modulus, guides=guides)
        constants = eqx.tree_at(lambda c: c.shear, constants, shear)
        return {
            axis: (ks.gain(axis, g, constants), ks.input_stiffness_N_per_um(axis, g, constants)) for axis in ks.AXES
        }

    return eqx.filter_vmap(one)(geometry, modulus_MPa, guides)


def both(rng, shear):
    """Frames' gains and input stiffnesses, and those of `microid`, by axis."""
    draw = drawn(rng)
    options = [
        {"guides": int(n), "width_mm": b, "modulus_MPa": modulus, "shear": shear}
        for b, modulus, n in zip(*draw[1:], strict=True)
    ]
    ours = compared(*stage(draw), jnp.asarray(shear))
    for alike in (("x", "y"), ("z",), ("alpha", "beta"), ("gamma",)):
        pairs = zip(draw[0], options, strict=True)
        wanted = np.array([fe.gain_and_input_stiffness(alike[0], d, **o) for d, o in pairs]).T
        for axis in alike:
            yield axis, wanted, np.array(ours[axis])


def test_six_axes_at_level_0_are_those_of_the_frames(rng):
    for axis, wanted, found in both(rng, 0.0):
        np.testing.assert_allclose(found, wanted, rtol=1e-8, err_msg=axis)


def test_shear_is_that_of_timoshenkos_beams(rng):
    """Not for the tilt: its lever is that of slender leaves at either level."""
    for axis, wanted, found in both(rng, SHEAR):
        rows = slice(1, 2) if axis in ("alpha", "beta") else slice(0, 2)
        np.testing.assert_allclose(found[rows], wanted[rows], rtol=1e-8, err_msg=axis)


def test_a_bridge_is_the_frames_two_port(rng):
    names = ("l1", "t1", "la1", "alpha1")
    for d in drawn(rng, 10)[0]:
        constants = ks.constants_of(ks.Geometry(), level=0)
        port = ks.bridge(*(jnp.asarray(d[name]) for name in names), constants)
        off = -port.K12_N_per_um
        found = np.array([[port.K11_N_per_um, off], [off, port.K22_N_per_um]])
        close(found, fe.two_port_N_per_um(*(d[name] for name in names)))


@pytest.mark.parametrize(
    ("axis", "recorded"),
    # From the derivation of the closed forms, which came before either code: 1 um of the piezo, in um or urad.
    [("x", 7.163123807743204), ("z", 9.58228792749674), ("alpha", 107.30040541951), ("gamma", 526.369312718)],
)
def test_the_papers_stage_has_the_gains_on_record(axis, recorded):
    geometry = ks.Geometry()
    dimensions = {name: float(geometry[name]) for name in ks.DIMENSIONS}
    linear = fe.gain(axis, dimensions)
    close(ks.gain(axis, geometry, ks.constants_of(geometry, level=0)), linear)
    # On record are angles; small strokes give the tangent of the tilt and the sine of the rotation.
    turned = {"alpha": np.tan, "gamma": np.sin}
    close(linear, turned[axis](1e-6 * recorded) if axis in turned else recorded, rtol=1e-11)
