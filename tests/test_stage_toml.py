import dataclasses
import math
import tomllib

import jax.numpy as jnp
import numpy as np
import pytest

import fits
from microid import kinetostatics as ks

# Table 1 of the paper; l is assumed.
TABLE = {
    "l1": 7, "t1": 0.8, "la1": 9, "alpha1": 0.068, "l2": 10, "t2": 1, "l3": 28,
    "l4": 9, "t4": 0.8, "la2": 9, "alpha2": 0.061, "l5": 9, "t5": 0.8, "h": 5, "d": 10, "l": 40,
    "l6": 2, "t6": 0.8, "la3": 14, "alpha3": 0.185, "l7": 2, "t7": 0.8, "R": 4, "J": 4,
}  # fmt: skip
GROUPS = (fits.Together(("t1", "t2", "alpha1"), 0.5), fits.Together(("l6", "l7"), -1.0))


@pytest.fixture
def written(tmp_path):
    """File of the paper's stage with correlated dimensions, and its text."""
    path = tmp_path / "stage.toml"
    fits.write_design(dataclasses.replace(fits.paper_design(), together=GROUPS), path)
    return path, path.read_text()


def sizes(design):
    return {name: float(design.geometry[name]) for name in ks.DIMENSIONS}


def random_design(rng):
    geometry = ks.Geometry(
        **{ks.DIMENSIONS[name].field: jnp.asarray(value * rng.uniform(0.85, 0.99)) for name, value in TABLE.items()},
    )
    # The paper's l4 is as long as its leg.
    geometry = dataclasses.replace(geometry, l4_mm=geometry.la2_mm)
    return fits.Design(
        geometry=geometry,
        tolerance={name: float(rng.uniform(0, 0.05) * geometry[name]) for name in ks.DIMENSIONS},
        level=int(rng.integers(2)),
        guides=rng.uniform(0, 9),
        youngs_modulus_GPa=rng.uniform(50, 400),
        actuation=ks.Actuation(*(jnp.asarray(value) for value in rng.lognormal(1, 3, 8))),
        together=(fits.Together(("t1", "l5", "alpha3"), rng.uniform(-0.4, 1)), fits.Together(("R", "J"), -1.0)),
    )


def test_a_design_comes_back_to_the_last_digit(rng, tmp_path):
    design = random_design(rng)
    fits.write_design(design, tmp_path / "stage.toml")
    again = fits.read_design(tmp_path / "stage.toml")
    assert sizes(again) == sizes(design)
    assert vars(again.actuation) == vars(design.actuation)
    for field in ("tolerance", "level", "guides", "youngs_modulus_GPa", "together"):
        assert getattr(again, field) == getattr(design, field)


def test_the_file_holds_table_1_in_plain_toml(written):
    table = tomllib.loads(written[1])
    assert {name: entry["value"] for name, entry in table["geometry"].items()} == TABLE
    assert table["geometry"]["t2"] == {"value": 1.0, "unit": "mm", "tolerance": 0.02}
    assert table["geometry"]["alpha3"] == {"value": 0.185, "unit": "rad", "tolerance": 0.02 / 14}
    assert table["material"] == {"youngs_modulus": {"value": 206.0, "unit": "GPa"}, "guides": 4.0}
    assert table["together"][1] == {"dimensions": ["l6", "l7"], "correlation": -1.0}
    comments = {line.split(" = ")[0]: line.split("#")[1] for line in written[1].splitlines() if " }  # " in line}
    for name, dimension in ks.DIMENSIONS.items():
        assert dimension.meaning in comments[name]


def edited(path, text, *changes):
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path.write_text(text)
    return path


T2 = 't2 = { value = 1.0, unit = "mm", tolerance = 0.02 }'
ALPHA1 = f'alpha1 = {{ value = 0.068, unit = "rad", tolerance = {0.02 / 9!r} }}'


def test_other_units_are_converted(written):
    path = edited(
        *written,
        (T2, 't2 = { value = 1015.0, unit = "um", tolerance = 20 }'),
        (ALPHA1, 'alpha1 = { value = 3.9, unit = "deg", tolerance = 0.1 }'),
        ('l1 = { value = 7.0, unit = "mm"', 'l1 = { value = 0.007, unit = "m"'),
        ('alpha3 = { value = 0.185, unit = "rad", tolerance = 0.0014285714285714286',
         'alpha3 = { value = 185, unit = "mrad", tolerance = 1.5'),
        ('{ value = 206.0, unit = "GPa" }', '{ value = 206000, unit = "MPa" }'),
        ('{ value = 700.0, unit = "kg mm^2" }', '{ value = 7e-4, unit = "kg m^2" }'),
    )  # fmt: skip
    with pytest.raises(fits.DataError, match=r"line 7: geometry\.l1: .*tolerance.*20 mm"):
        fits.read_design(path)
    design = fits.read_design(
        edited(path, path.read_text(), ('0.007, unit = "m", tolerance = 0.02', '0.007, unit = "m", tolerance = 2e-5'))
    )
    assert sizes(design) == pytest.approx(TABLE | {"t2": 1.015, "alpha1": 3.9 * math.pi / 180}, rel=1e-15)
    found = [design.tolerance[name] for name in ("t2", "alpha1", "l1", "alpha3")]
    assert found == pytest.approx([0.02, 0.1 * math.pi / 180, 0.02, 0.0015], rel=1e-15)
    assert design.youngs_modulus_GPa == 206
    assert float(design.actuation.inertia_tilt_kg_mm2) == pytest.approx(700, rel=1e-15)


def test_what_has_no_tolerance_has_that_of_a_wire_cut(written):
    path, text = written
    lines = [line.split(", tolerance")[0] + " }" if "tolerance" in line else line for line in text.splitlines()]
    path.write_text("\n".join(lines))
    found = fits.read_design(path).tolerance
    legs = {"alpha1": 9, "alpha2": 9, "alpha3": 14}
    assert found == {name: 0.02 / legs.get(name, 1) for name in TABLE}
    wider = fits.read_design(path).with_tolerance(0.05).tolerance
    assert wider == {name: 0.05 / legs.get(name, 1) for name in TABLE}


L1, LA1 = 'l1 = { value = 7.0, unit = "mm"', 'la1 = { value = 9.0, unit = "mm"'
REFUSED = [
    # What stands in the file, what is put in its place, and words of the sentence.
    ("level = 1", "level = 2", ["level", "0 or 1", "found 2"]),
    ("level = 1", "level = true", ["level", "true"]),
    ("level = 1", "level = 1.0", ["level", "1.0"]),
    ('schema = "microid.stage/1"', 'schema = "microid.stage/2"', ["schema", "microid.stage/1", "microid.stage/2"]),
    ('schema = "microid.stage/1"', "schema = ", ["TOML", "line 1"]),
    ("[geometry]", "[geometry", ["TOML", "line 5"]),
    (T2, f"{T2}\n{T2}", ["TOML"]),
    (T2, "", ["geometry.t2", "found none", "add it"]),
    (T2, T2.replace("t2", "t_2"), ["geometry.t_2", "did you mean t2?"]),
    (T2, T2.replace("t2", "thickness"), ["geometry.thickness"]),
    (T2, T2.replace("value", "vlaue"), ["geometry.t2.vlaue", "did you mean value?"]),
    (T2, T2.replace("tolerance", "error"), ["geometry.t2.error", "value, unit, tolerance"]),
    (T2, T2.replace("value = 1.0, ", ""), ["geometry.t2.value", "found none"]),
    (T2, T2.replace('unit = "mm", ', ""), ["geometry.t2.unit", "found none"]),
    (T2, "t2 = 1.0", ["geometry.t2", "unit", "found 1.0"]),
    (T2, T2.replace("mm", "rad"), ["geometry.t2.unit", "mm, um, m", '"rad"']),
    (T2, T2.replace("mm", "inch"), ["geometry.t2.unit", "mm, um, m", '"inch"']),
    (T2, T2.replace('"mm"', "1"), ["geometry.t2.unit", "found 1"]),
    (ALPHA1, ALPHA1.replace("rad", "mm"), ["geometry.alpha1.unit", "rad, mrad, deg", '"mm"']),
    (ALPHA1, ALPHA1.replace("0.068", "1.5"), ["geometry.alpha1", "1.5 rad"]),
    (ALPHA1, ALPHA1.replace("0.068", "0"), ["geometry.alpha1", "found 0"]),
    (ALPHA1, ALPHA1.replace('0.068, unit = "rad"', '90, unit = "deg"'), ["geometry.alpha1", "1.5", "1.5708"]),
    (T2, T2.replace("1.0", "nan"), ["geometry.t2.value", "finite", "nan"]),
    (T2, T2.replace("1.0", "inf"), ["geometry.t2.value", "finite", "inf"]),
    (T2, T2.replace("1.0", "true"), ["geometry.t2.value", "true"]),
    (T2, T2.replace("1.0", '"1.0"'), ["geometry.t2.value", '"1.0"', "quotes"]),
    (T2, T2.replace("1.0", "1" + 400 * "0"), ["geometry.t2.value", "enormous"]),
    (T2, T2.replace("1.0", "1" + 9000 * "0"), ["TOML"]),
    (T2, T2.replace("1.0", "[1.0]"), ["geometry.t2.value", "a list"]),
    (T2, T2.replace("1.0", "0.0"), ["geometry.t2", "found 0", "thickness of the leaf hinges of a guiding leg"]),
    (T2, T2.replace("1.0", "-1.0"), ["geometry.t2", "found -1"]),
    (T2, T2.replace("0.02", "-0.02"), ["geometry.t2", "tolerance", "-0.02"]),
    (T2, T2.replace("0.02", "nan"), ["geometry.t2.tolerance", "nan"]),
    (T2, T2.replace("0.02", "1.0"), ["geometry.t2", "tolerance", "1 mm"]),
    (L1, L1.replace("7.0", "9.5"), ["geometry.l1", "la1 = 9 mm", "9.5 mm"]),
    (LA1, LA1.replace("9.0", "-9.0"), ["geometry.la1", "found -9"]),
    ('l2 = { value = 10.0, unit = "mm"', 'l2 = { value = 0.0291, unit = "m"', ["geometry.l2", "l3 = 28 mm"]),
    ('l4 = { value = 9.0, unit = "mm"', 'l4 = { value = 9.2, unit = "mm"', ["geometry.l4", "la2 = 9 mm"]),
    ('la3 = { value = 14.0, unit = "mm"', 'la3 = { value = 1.9, unit = "mm"', ["l6", "la3 = 1.9 mm"]),
    ("guides = 4.0", "guides = -1", ["material.guides", "found -1"]),
    ("guides = 4.0", "guides = 1e308", ["material.guides", "found 1e+308"]),
    ("alpha1 = { value = 0.068, unit", "alpha1 = { value = 1.2, unit", ["geometry.l1", "runs 3.261 mm"]),
    ("guides = 4.0", "", ["material.guides", "found none"]),
    ("206.0", "0.0", ["material.youngs_modulus", "found 0"]),
    ('"GPa"', '"mm"', ["material.youngs_modulus.unit", "GPa, MPa"]),
    ("[material]", "[materials]", ["materials", "did you mean material?"]),
    ("[material]", "[[material]]", ["material", "a list"]),
    ("value = 40.0, unit = \"um\"", "value = 0, unit = \"um\"", ["actuation.free_stroke", "found 0"]),
    ("value = 120.0, unit = \"V\"", "value = 120.0, unit = \"V\", tolerance = 1", ["actuation.voltage.tolerance"]),
    ("damping_ratio", "damping", ["actuation.damping", "damping_ratio"]),
    ('["l6", "l7"]', '["l6", "l77"]', ["together[1].dimensions", "'l77'", "did you mean l7?"]),
    ('["l6", "l7"]', '["l6"]', ["together[1].dimensions", "two"]),
    ('["l6", "l7"]', '["l6", "l6"]', ["together[1].dimensions", "two different"]),
    ('["l6", "l7"]', '"l6"', ["together[1].dimensions", "list"]),
    ('["l6", "l7"]', '["t1", "t2"]', ["together[1].dimensions", "t1 and t2", "together[0]"]),
    ("correlation = -1.0", "correlation = -1.1", ["together[1].correlation", "-1.1"]),
    ("correlation = -1.0", "correlation = false", ["together[1].correlation", "false"]),
    ("correlation = -1.0", "corelation = -1.0", ["together[1].corelation", "did you mean correlation?"]),
    ("correlation = 0.5", "correlation = -0.51", ["correlation", "semidefinite"]),
    ('["l6", "l7"]', '["t1", "l7"]', ["together[1].correlation", "semidefinite"]),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "words"), REFUSED, ids=[f"{i}-{row[2][0]}" for i, row in enumerate(REFUSED)])
def test_what_is_wrong_is_named_in_one_sentence(written, old, new, words):
    path = edited(*written, (old, new))
    with pytest.raises(fits.DataError) as caught:
        fits.read_design(path)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert sentence.startswith(str(path))
    for word in words:
        assert word in sentence.removeprefix(str(path))


@pytest.mark.parametrize(("old", "new"), [(T2, T2.replace("mm", "rad")), ("correlation = -1.0", "correlation = 2.0")])
def test_the_line_is_that_of_the_mistake(written, rng, old, new):
    """Anywhere in the file, whatever comes before."""
    path, text = written
    lines = text.splitlines()
    for _ in range(5):
        lines.insert(int(rng.integers(len(lines))), "# t2 = { unit = 3 }")
    edited(path, "\n".join(lines), (old, new))
    line = next(k for k, line in enumerate(path.read_text().splitlines(), start=1) if line.startswith(new))
    with pytest.raises(fits.DataError, match=rf"stage\.toml, line {line}: "):
        fits.read_design(path)


def test_without_any_of_its_lines_a_file_is_refused(written):
    path, text = written
    lines = text.splitlines()
    for k, line in enumerate(lines):
        path.write_text("\n".join(lines[:k] + lines[k + 1 :]))
        if line.startswith("#") or not line:
            assert sizes(fits.read_design(path)) == TABLE
        else:
            with pytest.raises(fits.DataError, match=r"stage\.toml"):
                fits.read_design(path)


@pytest.mark.parametrize("kind", ["missing", "folder", "binary", "nested", "empty"])
def test_files_that_are_no_stages_are_refused(tmp_path, kind):
    path = tmp_path / "stage.toml"
    if kind == "folder":
        path.mkdir()
    elif kind != "missing":
        content = {"binary": b"\xff\xfe\x00", "nested": b"a = " + b"[" * 5000, "empty": b""}[kind]
        path.write_bytes(content)
    with pytest.raises(fits.DataError, match=r"stage\.toml"):
        fits.read_design(path)


def test_impossible_designs_are_refused_without_a_file_too():
    design = fits.paper_design()
    with pytest.raises(fits.DataError, match=r"^geometry\.l1: .*la1 = 9 mm"):
        dataclasses.replace(design, geometry=ks.Geometry(l1_mm=jnp.asarray(9.1)))
    with pytest.raises(fits.DataError, match=r"^geometry\.t2: .*none"):
        dataclasses.replace(design, tolerance={name: 0.001 for name in TABLE if name != "t2"})
    with pytest.raises(fits.DataError, match=r"^geometry\.t3: .*unknown"):
        dataclasses.replace(design, tolerance=design.tolerance | {"t3": 0.02})
    with pytest.raises(fits.DataError, match=r"^actuation\.mass_z_kg: "):
        dataclasses.replace(design, actuation=ks.Actuation(mass_z_kg=jnp.asarray(0.0)))


def test_correlations_are_those_of_the_groups():
    design = dataclasses.replace(fits.paper_design(), together=GROUPS)
    found = design.correlation(("t2", "l6", "t1", "l7", "J"))
    half = [[1, 0, 0.5, 0, 0], [0, 1, 0, -1, 0], [0.5, 0, 1, 0, 0], [0, -1, 0, 1, 0], [0, 0, 0, 0, 1]]
    assert np.array_equal(found, half)
    assert design.constants.youngs_modulus_MPa == 206e3
    assert float(design.constants.guides) == 4
