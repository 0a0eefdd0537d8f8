"""Large strokes: against the beam-column equation integrated numerically, and against SciPy's root finder."""

import numpy as np
import pytest
from _models import compiled
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from microid import kinetostatics as ks


@compiled
def moved(axis, geometry, piezo_um, constants, form):
    return ks.output(axis, geometry, piezo_um, constants, form)


def varied(rng):
    """Other bridges for x and z."""
    scale = {name: rng.uniform(0.9, 1.1) for name in ks.DIMENSIONS}
    geometry = ks.Geometry()
    return ks.Geometry(**{d.field: float(geometry[name]) * scale[name] for name, d in ks.DIMENSIONS.items()})


def integrated_um(length, thickness, leg, inclination, spring, piezo_um):
    """Output of a bridge, its leaves integrated from their clamped ends; forces per modulus and width.

    The leg's centre of symmetry carries no moment. Rotations are small where they lift, exact where they shorten.
    """
    inertia, rise, insert = thickness**3 / 12, leg * np.sin(inclination), leg * np.cos(inclination) - length

    def leaf(pull, drop):
        """Deflection, slope and shortening of a leaf, while the leg's other end comes down by `drop`."""
        centre, lift = (rise - drop) / 2, spring * drop

        def rates(x, state):
            y, turn, _ = state
            moment = pull * (y - centre) + lift * (length + insert / 2 - x)
            return [turn, moment / inertia, turn**2 / 2]

        return solve_ivp(rates, (0, length), [0, 0, 0], method="DOP853", rtol=1e-12, atol=1e-15).y[:, -1]

    def settled(pull):
        """The drop at which leaf and link meet in the centre: the condition is linear in it."""
        gap = []
        for drop in (0.0, rise):
            y, turn, _ = leaf(pull, drop)
            gap.append(y + insert / 2 * turn + drop / 2)
        return rise * gap[0] / (gap[0] - gap[1])

    def elongation(pull):
        drop = settled(pull)
        _, turn, shortening = leaf(pull, drop)
        stretch = 2 * length / thickness * pull
        return 2 * (stretch - 2 * shortening - rise * np.sin(turn) - insert * (1 - np.cos(turn)))

    wanted = piezo_um / 1000
    span = wanted * thickness / length
    ends = sorted((1e-6 * span, 3 * span))
    pull = brentq(lambda p: elongation(p) - wanted, *ends, xtol=1e-18, rtol=1e-13)
    return 2000 * settled(pull)


@pytest.mark.parametrize("piezo_um", [40.0, 11.0, -15.0])
def test_leaves_bend_as_the_integrated_equation_says(piezo_um, rng):
    g = varied(rng)
    constants = ks.constants_of(g, 0)
    load = ks.guide_stiffness_N_per_um(g.l2_mm, g.t2_mm, g.l3_mm, constants)
    spring = float(load * 1000 / (constants.youngs_modulus_MPa * constants.width_mm))
    bottom = [float(x) for x in (g.l1_mm, g.t1_mm, g.la1_mm, g.alpha1_rad)]
    middle = [float(x) for x in (g.l4_mm, g.t4_mm, g.la2_mm, g.alpha2_rad)]
    for axis, bridge in (("x", [*bottom, spring]), ("z", [*middle, 0.0])):
        found = moved(axis, g, piezo_um, constants, "beam")
        assert found == pytest.approx(integrated_um(*bridge, piezo_um), rel=1e-8)


@pytest.mark.parametrize("piezo_um", [40.0, 11.0, -15.0])
def test_links_turn_as_statics_says(piezo_um, rng):
    """The link's tension balances its hinges' moments and stretches them (level 0)."""
    g = varied(rng)
    leg, inclination, thickness = float(g.la2_mm), float(g.alpha2_rad), float(g.t4_mm)
    length = float(g.l4_mm)

    def elongation(turn):
        rise = leg * np.sin(inclination - turn)
        pull = 2 * (thickness**3 / (12 * length)) * turn / rise
        return 2 * (leg * np.cos(inclination - turn) - leg * np.cos(inclination) + 2 * pull * length / thickness)

    turn = brentq(lambda a: elongation(a) - piezo_um / 1000, -inclination, 0.95 * inclination, xtol=1e-16)
    lift_um = 2000 * leg * (np.sin(inclination) - np.sin(inclination - turn))
    constants = ks.constants_of(g, 0)
    assert moved("z", g, piezo_um, constants, "pseudo_rigid") == pytest.approx(lift_um, rel=1e-10)
    tilt = np.arctan(lift_um / 1000 / float(ks.tilt_arm_mm(g.l_mm, g.l5_mm)))
    assert moved("alpha", g, piezo_um, constants, "pseudo_rigid") == pytest.approx(tilt, rel=1e-10)


@pytest.mark.parametrize(
    "axis", ["x", *(pytest.param(axis, marks=pytest.mark.study) for axis in ("z", "alpha", "gamma"))]
)
def test_small_strokes_are_those_of_the_linear_form(axis, rng):
    g = varied(rng)
    constants = ks.constants_of(g, 0)
    for form in ks.MOTIONS[axis].functions:
        assert abs(moved(axis, g, 0.0, constants, form)) < 1e-9
        slope = compiled(ks.sensitivity)(axis, g, 0.0, constants, form).piezo
        assert slope == pytest.approx(float(ks.gain(axis, g, constants)), rel=1e-9)


@pytest.mark.study
def test_what_the_large_stroke_costs_is_what_finite_elements_say():
    """Error of the linear form against co-rotational finite elements, read off a table to two digits."""
    g = ks.Geometry()
    constants = ks.constants_of(g, 0)
    table = {"x": (0.33, 1.7, 3.7, 8.2), "z": (0.44, 2.4, 5.2, 12.3), "gamma": (-0.03, -0.17, -0.35, -0.7)}
    for axis, row in table.items():
        for piezo_um, percent in zip((2.0, 10.0, 20.0, 40.0), row, strict=True):
            large, small = (moved(axis, g, piezo_um, constants, form) for form in ("beam", "linear"))
            assert 100 * (small / large - 1) == pytest.approx(percent, abs=0.06 + 0.02 * abs(percent))


def test_a_stroke_beyond_the_leaves_is_refused():
    g = ks.Geometry()
    with pytest.raises(Exception, match=r"shorten it|maximum number of steps"):
        moved("z", g, 2000.0, ks.constants_of(g, 0), "beam").block_until_ready()
