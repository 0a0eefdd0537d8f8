"""What errors of the dimensions do to each axis, against recorded figures, finite differences and sums by hand."""

import dataclasses
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _models import compiled

import fits
from fits.machining._claims import describe_claims
from fits.report._machining import sensitivity_json
from microid import kinetostatics as ks

# Section 8.1 of the project's derivation of the closed forms, which came before the code: % of output at plus one
# tolerance, ranked, then root sum of squares and worst case; and to how many digits.
RANKED = {
    "x": ({"t2": -1.51, "t1": -0.80, "la1": 0.14, "l1": -0.09, "l2": 0.05, "alpha1": -0.04, "l3": 0.04}, 1.7, 2.7, 2),
    "z": ({"t4": -2.31, "alpha2": -0.44, "la2": 0.19}, 2.4, 2.9, 2),
    "alpha": ({"t4": -2.312, "alpha2": -0.441, "la2": 0.190, "l": -0.045, "l5": -0.024}, 2.4, 3.0, 3),
    "gamma": (
        {"t7": -1.211, "alpha3": -0.477, "J": -0.146, "R": -0.146, "l6": -0.126, "t6": 0.113, "l7": 0.070,
         "la3": 0.003},
        1.3, 2.3, 3,
    ),
}  # fmt: skip
# The same at the full stroke of the loaded piezo, in um or urad per 20 um.
AT_FULL_STROKE = {
    "x": {"t2": -2.06, "t1": -1.09, "la1": 0.19, "l1": -0.12},
    "z": {"t4": -5.05, "alpha2": -0.96, "la2": 0.41},
    "alpha": {"t4": -56, "alpha2": -11, "la2": 4.6, "l": -1.1, "l5": -0.6},
    "gamma": {"t7": -143, "alpha3": -56, "J": -17, "R": -17, "l6": -15, "t6": 13, "l7": 8},
}
AT_FIXED_VOLTAGE = {
    "x": {"t1": -2.5, "t2": -1.9, "alpha1": 1.5},
    "z": {"t4": -4.3, "alpha2": 1.2},
    "gamma": {"t7": -2.6, "t6": -0.6},
}
# Sections 6 and 7.6: outputs in um or rad at 1 um of the piezo, loaded stroke in um, and stroke in um or urad.
OUTPUTS = {"x": 6.53222375162135, "z": 9.148282226628, "alpha": 1.0244050268267e-4, "gamma": 5.00846830121e-4}
STROKES = {"x": (20.9, 136), "z": (23.9, 218), "alpha": (23.9, 2440), "gamma": (23.5, 11800)}
AXES = tuple(RANKED)


@pytest.fixture(scope="module")
def paper():
    return fits.sensitivities(fits.paper_design())


@compiled
def output(axis, geometry, piezo_um, constants):
    return ks.output(axis, geometry, piezo_um, constants)


@compiled
def held_output(axis, geometry, constants, actuation):
    """Output at full voltage, the piezo being compressed by the stage it pushes."""
    at = constants.at(geometry)
    piezo_um = ks.loaded_um(axis, geometry, actuation.free_stroke_um, at, actuation.piezo_N_per_um)
    return ks.output(axis, geometry, piezo_um, at)


def changed(geometry, name, error):
    field = ks.DIMENSIONS[name].field
    return dataclasses.replace(geometry, **{field: getattr(geometry, field) + error})


def slope(function, step):
    """Derivative at zero, exact for polynomials of the fourth degree."""
    steps = (step, -step, 2 * step, -2 * step)
    one, other, two, back = (float(function(each)) for each in steps)
    return (8 * (one - other) - (two - back)) / (12 * step)


def near(design, rng):
    """A design with other sizes, none off by more than a tenth."""
    geometry = ks.Geometry(
        **{
            d.field: design.geometry[name] * rng.uniform(0.9, 1.0)
            for name, d in ks.DIMENSIONS.items()
            if name != "l4"
        }
    )
    tolerance = {name: rng.uniform(0.001, 0.02) * float(geometry[name]) for name in ks.DIMENSIONS}
    return dataclasses.replace(
        design, geometry=dataclasses.replace(geometry, l4_mm=0.9 * geometry.la2_mm), tolerance=tolerance
    )


def test_gains_are_those_on_record(paper):
    # Small strokes give the tangent of the tilt and the sine of the rotation.
    wanted = OUTPUTS | {"alpha": 1e6 * math.tan(OUTPUTS["alpha"]), "gamma": 1e6 * math.sin(OUTPUTS["gamma"])}
    for axis, gain in wanted.items():
        assert paper[axis].gain == pytest.approx(gain, rel=1e-11)
        loaded_um, stroke = STROKES[axis]
        assert paper[axis].loaded_stroke_um == pytest.approx(loaded_um, abs=0.051)
        assert paper[axis].stroke == pytest.approx(stroke, rel=3e-3)
    assert [paper[axis].gain_unit for axis in ks.AXES] == ["um/um"] * 3 + ["urad/um"] * 3


@pytest.mark.parametrize("axis", AXES)
def test_the_ranking_is_that_on_record(paper, axis):
    changes, rss, worst, digits = RANKED[axis]
    found = {effect.name: effect.relative_change_pct for effect in paper[axis].dimensions}
    assert found == pytest.approx(changes, abs=0.51 * 10**-digits)
    sizes = [abs(change) for change in found.values()]
    assert sizes == sorted(sizes, reverse=True)
    assert paper[axis].rss_pct == pytest.approx(rss, abs=0.05)
    assert paper[axis].worst_case_pct == pytest.approx(worst, abs=0.05)
    for name, change in AT_FULL_STROKE[axis].items():
        digit = 0.01 if axis in ("x", "z") else 0.1 if abs(change) < 5 else 1
        assert 2 * paper[axis][name].output_change_per_10um == pytest.approx(change, abs=0.51 * digit)
    for name, change in AT_FIXED_VOLTAGE.get(axis, {}).items():
        assert paper[axis].voltage_change_pct[name] == pytest.approx(change, abs=0.05)


@pytest.mark.parametrize("axis", AXES)
def test_derivatives_are_those_of_finite_differences(rng, axis):
    design = near(fits.paper_design(), rng)
    geometry, constants, actuation = design.geometry, design.constants, design.actuation
    found = fits.sensitivities(design, [axis])[axis]
    scale = 1e6 if found.output_unit == "urad" else 1.0
    assert [effect.name for effect in found.dimensions] != []
    assert {effect.name for effect in found.dimensions} == set(ks.MOTIONS[axis].dimensions)
    for effect in found.dimensions:
        step = 2e-4 * effect.value
        # So short a stroke that the rotations are linear to 1e-12.
        short_um = 1e-3

        def moved(error, name=effect.name, stroke_um=short_um):
            return scale * output(axis, changed(geometry, name, error), stroke_um, constants)

        gain = float(moved(0.0)) / short_um
        assert found.gain == pytest.approx(gain, rel=1e-9)
        wanted = slope(moved, step) / short_um
        assert effect.derivative == pytest.approx(wanted, rel=1e-8, abs=1e-8 * gain / effect.value)
        assert effect.relative_change_pct == pytest.approx(100 * wanted * effect.tolerance / gain, rel=1e-7)
        exact = float(moved(effect.tolerance)) / float(moved(0.0)) - 1
        assert effect.relative_change_exact_pct == pytest.approx(100 * exact, rel=1e-6)
        leg = ks.DIMENSIONS[effect.name].leg
        ten_um = 0.01 if leg is None else 0.01 / float(geometry[leg])
        full = slope(lambda error, name=effect.name: moved(error, name, found.loaded_stroke_um), step)
        assert effect.output_change_per_10um == pytest.approx(ten_um * full, rel=1e-6)
    at_rest = float(held_output(axis, geometry, constants, actuation))
    for name, change in found.voltage_change_pct.items():
        size = float(geometry[name])
        by = slope(
            lambda e, name=name: held_output(axis, changed(geometry, name, e), constants, actuation), 2e-4 * size
        )
        wanted = 100 * by * design.tolerance[name] / at_rest
        assert change == pytest.approx(wanted, rel=1e-6, abs=1e-9)
    without = set(ks.DIMENSIONS) - set(found.voltage_change_pct)
    for name in without:
        assert float(held_output(axis, changed(geometry, name, 0.1), constants, actuation)) == at_rest


def test_axes_that_are_alike_have_their_own_function(paper):
    """y and beta are computed as x and alpha; their own functions say the same."""
    geometry, constants = ks.Geometry(), fits.paper_design().constants
    for axis, alike, scale in (("y", "x", 1), ("beta", "alpha", 1e6)):
        assert dataclasses.replace(paper[axis], axis=alike) == paper[alike]
        for effect in paper[axis].dimensions:

            def moved(error, name=effect.name, axis=axis, scale=scale):
                return scale * output(axis, changed(geometry, name, error), 1e-3, constants)

            wanted = slope(moved, 2e-4 * effect.value) / 1e-3
            assert effect.derivative == pytest.approx(wanted, rel=1e-7, abs=1e-8 * paper[axis].gain / effect.value)


def test_z_at_level_0_is_the_closed_form_by_hand():
    """R0 = 3 la^2 s c / (3 la^2 s^2 + t^2), s and c of the inclination."""
    la, angle, t, error = 9.0, 0.061, 0.8, 0.02
    s, c = math.sin(angle), math.cos(angle)
    below = 3 * la**2 * s**2 + t**2
    ratio = 3 * la**2 * s * c / below
    logs = {
        "t4": -2 * t / below,
        "la2": 2 / la - 6 * la * s**2 / below,
        "alpha2": c / s - s / c - 6 * la**2 * s * c / below,
    }
    report = fits.sensitivities(dataclasses.replace(fits.paper_design(), level=0), ["z"])
    assert report.level == 0
    assert report["z"].gain == pytest.approx(ratio, rel=1e-13)
    for name, log in logs.items():
        assert report["z"][name].derivative == pytest.approx(ratio * log, rel=1e-11)
    thick = 3 * la**2 * s * c / (3 * la**2 * s**2 + (t + error) ** 2)
    assert report["z"]["t4"].relative_change_exact_pct == pytest.approx(100 * (thick / ratio - 1), rel=1e-10)


@pytest.mark.parametrize("correlation", [1.0, 0.3, -0.5])
def test_shares_with_correlated_thicknesses_add_up_by_hand(paper, correlation):
    together = (fits.Together(("t1", "t2"), correlation),)
    found = fits.sensitivities(dataclasses.replace(fits.paper_design(), together=together), ["x"])["x"]
    alone = {effect.name: effect for effect in paper["x"].dimensions}
    part = {name: effect.relative_change_pct**2 for name, effect in alone.items()}
    both = correlation * alone["t1"].relative_change_pct * alone["t2"].relative_change_pct
    variance = sum(part.values()) + 2 * both
    for effect in found.dimensions:
        extra = both if effect.name in ("t1", "t2") else 0.0
        assert effect.share_of_variance == pytest.approx((part[effect.name] + extra) / variance, rel=1e-12)
        assert alone[effect.name].share_of_variance == pytest.approx(
            part[effect.name] / sum(part.values()), rel=1e-12
        )
    assert found.rss_pct == pytest.approx(math.sqrt(variance), rel=1e-12)
    assert found.worst_case_pct == pytest.approx(sum(map(math.sqrt, part.values())), rel=1e-12)
    assert sum(effect.share_of_variance for effect in found.dimensions) == pytest.approx(1, rel=1e-12)


def test_without_tolerances_nothing_changes():
    design = fits.paper_design()
    still = dataclasses.replace(design, tolerance=dict.fromkeys(ks.DIMENSIONS, 0.0))
    found = fits.sensitivities(still, ["z"])["z"]
    assert (found.rss_pct, found.worst_case_pct) == (0, 0)
    for effect in found.dimensions:
        assert effect.derivative != 0
        assert (effect.share_of_variance, effect.relative_change_pct, effect.relative_change_exact_pct) == (0, 0, 0)
    assert "z: 9.14828 um/um" in fits.SensitivityReport(1, {"z": found}).summary()


def test_modulus_and_width_change_no_motion(paper):
    """They cancel at a fixed elongation; at a fixed voltage a stiffer stage moves less."""
    soft = dataclasses.replace(fits.paper_design(), youngs_modulus_GPa=70.0)
    found = fits.sensitivities(soft, ["x"])["x"]
    assert found.gain == pytest.approx(paper["x"].gain, rel=1e-12)
    assert found["t2"].derivative == pytest.approx(paper["x"]["t2"].derivative, rel=1e-12)
    assert found.stroke > 1.3 * paper["x"].stroke


def test_no_finite_number_is_refused():
    thin = ks.Geometry(t4_mm=jnp.asarray(1e-160))
    with pytest.raises(fits.DataError, match=r"^z: .*finite"):
        fits.sensitivities(fits.Design(thin, dict.fromkeys(ks.DIMENSIONS, 0.0)), ["z"])


def test_the_json_is_that_of_the_schema(paper):
    content = json.loads(json.dumps(sensitivity_json(paper), allow_nan=False))
    assert (content["schema"], content["level"]) == ("microid.sensitivity/1", 1)
    assert list(content["axes"]) == ["x", "y", "z", "alpha", "beta", "gamma"]
    x = content["axes"]["x"]
    assert x["gain"] == paper["x"].gain
    assert x["gain_unit"] == "um/um"
    assert list(x["parameters"]) == list(RANKED["x"][0])
    t2 = x["parameters"]["t2"]
    assert (t2["value"], t2["unit"], t2["tolerance"]) == (1.0, "mm", 0.02)
    assert t2["relative_change_pct"] == pytest.approx(2 * t2["derivative"] / x["gain"], rel=1e-12)
    assert t2["output_change_um_per_10um"] == pytest.approx(-1.03, abs=0.01)
    assert sum(each["share_of_variance"] for each in x["parameters"].values()) == pytest.approx(1)
    gamma = content["axes"]["gamma"]
    assert gamma["gain_unit"] == "urad/um"
    assert gamma["parameters"]["alpha3"]["unit"] == "rad"
    assert "output_change_urad_per_10um" in gamma["parameters"]["alpha3"]
    assert gamma["fixed_voltage"]["t7"]["relative_change_pct"] == pytest.approx(-2.6, abs=0.05)


def test_the_table_names_axes_and_ranks(paper):
    text = paper.summary()
    for words in (
        "x and y: 6.53222 um/um",
        "z: 9.14828",
        "alpha and beta: 102.441 urad/um",
        "gamma: 500.847 urad/um",
    ):
        assert words in text
    places = [text.index(f"\n  {name} ") for name in RANKED["x"][0]]
    assert places == sorted(places)
    assert "voltage" not in text
    assert "t1 -2.52" in paper.summary(voltage=True)


def verdicts(design):
    return {claim.statement: claim for claim in fits.paper_claims(design)}


def test_the_papers_reading_of_its_figure_7():
    """Section 8.2 of the derivation."""
    found = verdicts(fits.paper_design())
    assert {statement: claim.verdict for statement, claim in found.items()} == {
        "t1, t2, l1 and la1 have a great influence": "agree",
        "t1 has a great influence": "agree",
        "t4 affects the error most": "agree",
        "the effect of t4 grows gradually with the machining error": "agree",
        "the effect of la2 rises sharply, then falls and flattens": "disagree",
        "l is among the most severe": "disagree",
        "l5 can be neglected": "agree",
        "t4 can be neglected": "disagree",
        "t4 affects z most, and can be neglected in the rotations about x and y": "disagree",
        "t6, t7 and l6 are the most severe": "partly",
    }
    assert found["t4 affects the error most"].number == pytest.approx(2.31 / 0.44, abs=0.07)
    assert found["l is among the most severe"].number == pytest.approx(50, abs=3)
    assert found["t4 can be neglected"].number == 100
    same = found["t4 affects z most, and can be neglected in the rotations about x and y"]
    assert same.number == pytest.approx(1, rel=1e-12)
    for claim in found.values():
        assert claim.reason.endswith(".")
        assert claim.reason in " ".join(describe_claims([claim]).split())


def test_verdicts_follow_the_numbers():
    """With a middle bridge cut exactly and the rest coarsely, the paper's reading of t4 turns round."""
    design = fits.paper_design()
    sharp = {"t4": 1e-6, "alpha2": 1e-7, "la2": 1e-4, "l": 0.5, "t2": 1e-6, "t1": 1e-6, "t7": 1e-6}
    found = verdicts(dataclasses.replace(design, tolerance=design.tolerance | sharp))
    assert found["t4 affects the error most"].verdict == "disagree"
    assert found["t4 can be neglected"].verdict == "agree"
    assert found["l is among the most severe"].verdict == "agree"
    assert found["t1, t2, l1 and la1 have a great influence"].verdict == "partly"
    assert found["t1 has a great influence"].verdict == "partly"
    assert found["t6, t7 and l6 are the most severe"].verdict == "disagree"


@pytest.mark.parametrize(("level", "recorded"), [(1, 8.0), (0, 6.5)])
def test_t1_has_no_first_order_effect_at_the_number_of_guides_found(level, recorded):
    design = dataclasses.replace(fits.paper_design(), level=level)
    guides = fits.sign_change_guides(design)
    assert guides == pytest.approx(recorded, abs=0.2)

    def by_t1(count):
        constants = dataclasses.replace(design, guides=count).constants
        return slope(lambda e: output("x", changed(design.geometry, "t1", e), 1.0, constants), 1e-3)

    assert by_t1(guides - 0.1) < -1e-3
    assert by_t1(guides + 0.1) > 1e-3
    assert abs(by_t1(guides)) < 1e-7


def test_single_precision_is_refused():
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(RuntimeError, match="float64"):
            fits.sensitivities(fits.paper_design(), ["z"])
    finally:
        jax.config.update("jax_enable_x64", True)
    assert np.asarray(fits.paper_design().geometry.t4_mm).dtype == np.float64
