"""Motion functions, their derivatives and the constants of the stage, against numbers and methods of other origin."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _models import compiled

import microid as m
from microid import kinetostatics as ks

# The argument lists of Eq. 5, as the paper orders them.
ARGUMENTS = {
    "x": "l1 t1 la1 l2 t2 l3 alpha1",
    "y": "l1 t1 la1 l2 t2 l3 alpha1",
    "z": "la2 alpha2 t4",
    "alpha": "l l5 la2 alpha2 t4",
    "beta": "l l5 la2 alpha2 t4",
    "gamma": "l6 t6 la3 l7 t7 alpha3 J R",
}
# Derived by other means for the paper's geometry: output in um or rad at 1 um of the piezo.
REFERENCE = {
    0: {"x": 7.163123807743204, "z": 9.58228792749674, "alpha": 1.0730040541951e-4, "gamma": 5.26369312718e-4},
    1: {"x": 6.53222375162135, "z": 9.148282226628, "alpha": 1.0244050268267e-4, "gamma": 5.00846830121e-4},
}
TWO_PORTS = {
    ("bottom", 0): (0.04411562568517, 0.00249837137270, 2.672163118748e-4),
    ("bottom", 1): (0.03456524902072, 0.00188475752940, 2.136852836922e-4),
    ("top", 0): (0.16429090017461, 0.03053040948153, 5.897244465194e-3),
    ("top", 1): (0.06487489533711, 0.01192161810697, 2.358364784348e-3),
}
FUNCTIONS = {
    "x": ks.f_x,
    "y": ks.f_y,
    "z": ks.f_z,
    "alpha": ks.f_alpha,
    "beta": ks.f_beta,
    "gamma": ks.f_gamma,
}


@compiled
def moved(axis, geometry, piezo_um, constants, form="linear"):
    return ks.output(axis, geometry, piezo_um, constants, form)


@compiled
def sensitivity(axis, geometry, piezo_um, constants, form="linear"):
    return ks.sensitivity(axis, geometry, piezo_um, constants, form)


def changed(geometry, name, by):
    return eqx.tree_at(lambda g: getattr(g, ks.DIMENSIONS[name].field), geometry, geometry[name] + by)


def randomised(rng):
    """A stage of other dimensions, each within 10 % of the paper's."""
    geometry = ks.Geometry()
    for name in ks.DIMENSIONS:
        geometry = changed(geometry, name, float(geometry[name]) * rng.uniform(-0.1, 0.1))
    return geometry


def slope(function, step):
    """Central differences of sixth order."""
    weights = ((1, 3 / 4), (2, -3 / 20), (3, 1 / 60))
    return sum(w * (function(k * step) - function(-k * step)) for k, w in weights) / step


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("axis", ["x", "z", "alpha", "gamma"])
def test_outputs_are_those_derived_elsewhere(axis, level):
    geometry = ks.Geometry()
    found = moved(axis, geometry, 1.0, ks.constants_of(geometry, level))
    # As many digits as the reference was written down with.
    assert found == pytest.approx(REFERENCE[level][axis], rel=1e-12 if axis == "x" else 2e-12)
    other = {"x": "y", "alpha": "beta"}.get(axis)
    if other:
        assert moved(other, geometry, 1.0, ks.constants_of(geometry, level)) == found


@pytest.mark.parametrize(("platform", "level"), TWO_PORTS)
def test_two_ports_are_those_derived_elsewhere(platform, level):
    g = ks.Geometry()
    constants = ks.constants_of(g, level)
    sizes = (
        (g.l1_mm, g.t1_mm, g.la1_mm, g.alpha1_rad)
        if platform == "bottom"
        else (g.l6_mm, g.t6_mm, g.la3_mm, g.alpha3_rad)
    )
    found = ks.bridge(*sizes, constants)
    scale = float(constants.youngs_modulus_MPa * constants.width_mm) / 1000
    per_modulus = np.array([found.K11_N_per_um, found.K12_N_per_um, found.K22_N_per_um]) / scale
    np.testing.assert_allclose(per_modulus, TWO_PORTS[platform, level], rtol=1e-11)
    stiffness = np.array([[per_modulus[0], -per_modulus[1]], [-per_modulus[1], per_modulus[2]]])
    assert np.all(np.linalg.eigvalsh(stiffness) > 0)


@pytest.mark.parametrize("axis", ks.AXES)
def test_arguments_are_those_of_the_paper(axis):
    names = [name for name in inspect.signature(FUNCTIONS[axis]).parameters if name != "constants"]
    unit = ks.MOTIONS[axis].unit
    assert names[0] == f"{axis}_out_{unit}"
    assert names[-1] == f"{axis}_pzt_um"
    symbols = [name.rpartition("_")[0] for name in names[1:-1]]
    assert symbols == ARGUMENTS[axis].split() == list(ks.MOTIONS[axis].dimensions)
    for name, symbol in zip(names[1:-1], symbols, strict=True):
        assert name == ks.DIMENSIONS[symbol].field
    for function in ks.MOTIONS[axis].functions.values():
        same = list(inspect.signature(function).parameters)
        assert [name.rpartition("_")[0] for name in same[1:-2]] == symbols


@pytest.mark.parametrize("axis", ks.AXES)
def test_output_enters_with_slope_one(axis, rng):
    geometry = randomised(rng)
    constants = ks.constants_of(geometry)
    values = [geometry[name] for name in ks.MOTIONS[axis].dimensions]
    at, piezo_um = rng.uniform(-1, 1), rng.uniform(-20, 20)
    assert jax.grad(FUNCTIONS[axis])(at, *values, piezo_um, constants=constants) == 1.0
    out = moved(axis, geometry, piezo_um, constants)
    assert abs(FUNCTIONS[axis](out, *values, piezo_um, constants=constants)) <= 1e-15 * abs(float(out))


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("axis", ["x", "z", "alpha", "gamma"])
def test_derivatives_are_those_of_finite_differences(axis, level, rng):
    geometry, piezo_um = randomised(rng), rng.uniform(5, 20)
    constants = ks.constants_of(geometry, level)
    found = sensitivity(axis, geometry, piezo_um, constants)
    assert found.output == pytest.approx(float(moved(axis, geometry, piezo_um, constants)), rel=1e-14)
    by_piezo = slope(lambda h: float(moved(axis, geometry, piezo_um + h, constants)), 0.1)
    assert found.piezo == pytest.approx(by_piezo, rel=1e-9)
    assert set(found.dimensions) == set(ARGUMENTS[axis].split())
    for name, value in found.dimensions.items():
        size = float(geometry[name])
        by = slope(
            lambda h, name=name: float(moved(axis, changed(geometry, name, h), piezo_um, constants)), 3e-3 * size
        )
        # Relative to the output, for derivatives that nearly vanish.
        assert value == pytest.approx(by, rel=1e-9, abs=1e-12 * abs(float(found.output)) / size)


# The others are of the same kind.
FIRST = (("z", "pseudo_rigid"),)


@pytest.mark.parametrize(
    ("axis", "form"),
    [
        pytest.param(axis, form, marks=() if (axis, form) in FIRST else pytest.mark.study)
        for axis in ("x", "z", "alpha", "gamma")
        for form in ks.MOTIONS[axis].functions
        if form != "linear"
    ],
)
def test_derivatives_of_implicit_forms_too(axis, form, rng):
    geometry, piezo_um = randomised(rng), rng.uniform(10, 30)
    constants = ks.constants_of(geometry, 0)
    found = sensitivity(axis, geometry, piezo_um, constants, form)
    by_piezo = slope(lambda h: float(moved(axis, geometry, piezo_um + h, constants, form)), 0.1)
    assert found.piezo == pytest.approx(by_piezo, rel=1e-9)
    for name, value in found.dimensions.items():
        size = float(geometry[name])
        by = slope(
            lambda h, name=name: float(moved(axis, changed(geometry, name, h), piezo_um, constants, form)),
            3e-3 * size,
        )
        assert value == pytest.approx(by, rel=1e-9, abs=1e-10 * abs(float(found.output)) / size)


@pytest.mark.parametrize("axis", ["x", "z", "alpha", "gamma"])
def test_fixed_voltage_adds_what_stiffness_does(axis, rng):
    geometry, free_um, piezo_N_per_um = randomised(rng), 40.0, rng.uniform(25, 120)
    found = compiled(ks.voltage_sensitivity)(axis, geometry, free_um, ks.constants_of(geometry), piezo_N_per_um)

    @compiled
    def loaded(geometry):
        constants = ks.constants_of(geometry)
        stiffness = ks.input_stiffness_N_per_um(axis, geometry, constants)
        return ks.output(axis, geometry, free_um * piezo_N_per_um / (piezo_N_per_um + stiffness), constants)

    assert found.output == pytest.approx(float(loaded(geometry)), rel=1e-14)
    for name, value in found.dimensions.items():
        size = float(geometry[name])
        by = slope(lambda h, name=name: float(loaded(changed(geometry, name, h))), 3e-3 * size)
        assert value == pytest.approx(by, rel=1e-9, abs=1e-12 * abs(float(found.output)) / size)


@pytest.mark.parametrize("axis", ["x", "z", "alpha", "gamma"])
def test_modulus_and_width_cancel_from_motion_and_scale_stiffness(axis, rng):
    geometry = randomised(rng)
    constants = ks.constants_of(geometry)
    softer = eqx.tree_at(
        lambda c: (c.youngs_modulus_MPa, c.width_mm), constants, (jnp.asarray(70e3), jnp.asarray(23.0))
    )
    assert moved(axis, geometry, 7.0, softer) == pytest.approx(
        float(moved(axis, geometry, 7.0, constants)), rel=1e-14
    )
    ratio = 70e3 * 23.0 / float(constants.youngs_modulus_MPa * constants.width_mm)
    stiffness = ks.input_stiffness_N_per_um(axis, geometry, constants)
    assert ks.input_stiffness_N_per_um(axis, geometry, softer) == pytest.approx(ratio * float(stiffness), rel=1e-13)


@pytest.mark.parametrize("level", [0, 1])
def test_thin_hinges_turn_freely_and_weak_guides_do_not_load(level, rng):
    geometry = randomised(rng)
    thin = eqx.tree_at(lambda g: (g.t1_mm, g.t4_mm), geometry, (jnp.asarray(1e-6), jnp.asarray(1e-6)))
    cotangent = 1 / np.tan(float(geometry.alpha2_rad))
    assert ks.gain("z", thin, ks.constants_of(thin, level)) == pytest.approx(cotangent, rel=1e-6)
    constants = ks.constants_of(geometry, level)
    drive = ks.bridge(geometry.l1_mm, geometry.t1_mm, geometry.la1_mm, geometry.alpha1_rad, constants)
    unguided = eqx.tree_at(lambda c: c.guides, constants, jnp.asarray(0.0))
    assert ks.gain("x", geometry, unguided) == pytest.approx(float(drive.ratio), rel=1e-14)
    assert ks.gain("x", geometry, constants) < drive.ratio


def test_a_level_or_form_that_does_not_exist_is_refused():
    geometry = ks.Geometry()
    with pytest.raises(ValueError, match="levels 0 and 1, got 2"):
        ks.constants_of(geometry, 2)
    with pytest.raises(ValueError, match="x has no form 'pseudo_rigid': choose one of linear, beam"):
        ks.output("x", geometry, 1.0, ks.constants_of(geometry, 0), "pseudo_rigid")
    with pytest.raises(ValueError, match="form 'beam' is of level 0"):
        ks.output("x", geometry, 1.0, ks.constants_of(geometry, 1), "beam")


def test_constants_of_the_stage_are_those_derived_elsewhere():
    geometry = ks.Geometry()
    constants = ks.constants_of(geometry)
    table = {
        "x": (6.532, 45.8, 20.9, 136, 77, 7018e-3, 579),
        "z": (9.148, 33.8, 23.9, 218, 164, 3700e-3, 143),
        "alpha": (0.10244e-3, 33.8, 23.9, 2.44e-3, 175, 3.304e5, 1.20e4),
        "gamma": (0.50085e-3, 35.0, 23.5, 11.8e-3, 319, 6.980e4, 1390),
    }
    for axis, row in table.items():
        found = compiled(ks.stage_constants)(axis, geometry, constants, ks.Actuation())
        shown = (
            found.gain,
            found.input_stiffness_N_per_um,
            found.loaded_stroke_um,
            found.stroke,
            found.resonance_Hz,
            found.stiffness,
            # The table has N s/m for translations and N s/m times mm for rotations.
            found.damping * (1e6 if axis in ("x", "z") else 1e3),
        )
        np.testing.assert_allclose(shown, row, rtol=5e-3)
        rate = np.sqrt(float(found.stiffness / found.mass))
        assert rate == pytest.approx(2 * np.pi * float(found.resonance_Hz), rel=1e-12)
        # Eq. 17 has the gain of the axis at rest.
        assert found.input_stiffness_N_per_um / found.stiffness == pytest.approx(float(found.gain), rel=1e-12)


def test_driving_error_is_what_a_proportional_piezo_leaves(rng):
    density = m.densities.GridDensity(jnp.asarray(rng.uniform(0.1, 0.3, 36)), jnp.asarray(0.0), jnp.asarray(120.0))
    model = m.Preisach(
        density, m.Reversible(jnp.full(8, 0.2), jnp.asarray(0.0), jnp.asarray(120.0)), jnp.asarray(3.0)
    )
    voltage = jnp.concatenate([jnp.linspace(0, 120, 100), jnp.linspace(119, 0, 100)])
    found = compiled(ks.driving_error)(model, voltage)
    elongation = np.asarray(compiled(model)(voltage))
    elongation = elongation - elongation[0]
    fitted = np.linalg.lstsq(np.asarray(voltage)[:, None], elongation, rcond=None)[0]
    np.testing.assert_allclose(found.slope_um_per_V, fitted[0], rtol=1e-12)
    np.testing.assert_allclose(found.signed_um, elongation - fitted[0] * np.asarray(voltage), atol=1e-12)
    np.testing.assert_allclose(found.absolute_um, np.abs(found.signed_um))
    assert found.signed_um.min() < 0 < found.signed_um.max()
    given = compiled(ks.driving_error)(model, voltage, 0.3)
    np.testing.assert_allclose(given.signed_um, elongation - 0.3 * np.asarray(voltage), atol=1e-12)


def test_parts_of_the_error_add_up():
    found = ks.total_error(3.0, -4.0, 12.0)
    assert (found.signed, found.worst_case, found.root_sum_square) == (11.0, 19.0, 13.0)
