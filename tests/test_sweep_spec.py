"""What a sweep's text may say, the rows it makes, and what is refused before anything runs."""

import numpy as np
import pytest
from _sweeps import parsed, small
from scipy.stats import qmc

from fits import DataError
from fits.sweeps.kinds import examples

EXAMPLES = {kind: file.read_text() for kind, file in examples().items()}
HEAD = 'schema = "microid.sweep/1"\nkind = "simulate"\n'


def axis(text):
    return f"{HEAD}[[axis]]\n{text}\n"


def rows_of(sweep):
    return sweep.plan.values(np.arange(len(sweep.plan)))


@pytest.mark.parametrize("kind", sorted(EXAMPLES))
def test_examples_are_valid_and_of_a_thousand_rows(kind):
    sweep = parsed(EXAMPLES[kind])
    assert sweep.kind == kind
    assert 900 <= len(sweep.plan) <= 1100
    assert "#" in EXAMPLES[kind]


def test_grids_are_crossed_and_zipped_axes_run_together():
    text = HEAD + "".join(
        f'[[axis]]\nparameter = "{name}"\nvalues = {values}\n{extra}\n'
        for name, values, extra in (
            ("program.amplitude_V", [1.0, 2.0], ""),
            ("program.frequency_Hz", [5.0, 6.0, 7.0], 'zip = "a"'),
            ("program.offset_V", [50.0, 60.0, 70.0], 'zip = "a"'),
        )
    )
    values = rows_of(parsed(text))
    expected = [(a, f, o) for a in (1, 2) for f, o in ((5, 50), (6, 60), (7, 70))]
    names = ("program.amplitude_V", "program.frequency_Hz", "program.offset_V")
    assert list(zip(*(values[name] for name in names), strict=True)) == expected


def test_linear_and_logarithmic_grids_and_other_units():
    grid = rows_of(parsed(axis('parameter="mechanics.natural_frequency_Hz"\nunit="kHz"\nlow=0.1\nhigh=0.3\ncount=3')))
    np.testing.assert_allclose(grid["mechanics.natural_frequency_Hz"], [100, 200, 300], rtol=1e-14)
    log = axis('parameter="driver.time_constant_s"\nunit="ms"\nlow=0.1\nhigh=10\ncount=3\nspacing="log"')
    np.testing.assert_allclose(rows_of(parsed(log))["driver.time_constant_s"], [1e-4, 1e-3, 1e-2], rtol=1e-12)


def test_factors_of_numbers_become_values_and_those_of_arrays_stay_factors():
    values = rows_of(parsed(axis('parameter="mechanics.natural_frequency_Hz"\nrelative=true\nvalues=[0.5, 2.0]')))
    np.testing.assert_allclose(values["mechanics.natural_frequency_Hz"], [100.0, 400.0])
    values = rows_of(parsed(axis('parameter="hysteresis.density.packed_um"\nrelative=true\nvalues=[0.5, 2.0]')))
    np.testing.assert_allclose(values["hysteresis.density.packed_um"], [0.5, 2.0])


@pytest.mark.parametrize("method", ["random", "latin_hypercube", "sobol"])
def test_designs_fill_their_ranges_and_do_not_depend_on_how_they_are_read(method, seed):
    text = (
        small(seed, rows=8192).replace('"random"', f'"{method}"').replace("mean = 0.05\nsd = 0.04", "low=0\nhigh=1")
    )
    plan = parsed(text).plan
    every = plan.values(np.arange(8192))
    unit = np.stack([(every["mechanics.natural_frequency_Hz"] - 80) / 80, every["mechanics.damping_ratio"]], axis=1)
    assert unit.min() >= 0
    assert unit.max() <= 1
    # Of 8192 rows, random ones leave some 1e-2 and quasi-random ones less.
    assert np.abs(unit.mean(axis=0) - 0.5).max() < (0.02 if method == "random" else 1e-3)
    if method == "sobol":
        assert qmc.discrepancy(unit[:1024]) < 1e-4
    if method == "latin_hypercube":
        assert np.all(np.sort((unit * 8192).astype(int), axis=0) == np.arange(8192)[:, None])
    some = np.random.default_rng(seed).choice(8192, 300, replace=False)
    for name, values in plan.values(some).items():
        assert np.array_equal(values, every[name][some])


def test_normal_axes_have_their_mean_and_spread(seed):
    values = rows_of(parsed(small(seed, rows=20000)))["mechanics.damping_ratio"]
    assert abs(values.mean() - 0.05) < 6 * 0.04 / 20000**0.5
    assert abs(values.std() / 0.04 - 1) < 6 / (2 * 20000) ** 0.5


def test_rows_come_from_a_csv():
    text = HEAD + '[list]\nfile = "rows.csv"\n'
    sweep = parsed(text, rows=b"program.amplitude_V,mechanics.damping_ratio\n1.5,0.1\n2.5,0.2\n")
    assert {name: list(values) for name, values in rows_of(sweep).items()} == {
        "program.amplitude_V": [1.5, 2.5],
        "mechanics.damping_ratio": [0.1, 0.2],
    }
    with pytest.raises(DataError, match=r"rows.csv, line 3: expected 2 numbers"):
        parsed(text, rows=b"program.amplitude_V,mechanics.damping_ratio\n1.5,0.1\n2.5,x\n")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            axis('parameter = "mechanics.natural_frequncy_Hz"\nvalues=[1.0]'),
            "did you mean mechanics.natural_frequency_Hz",
        ),
        (axis('parameter = "program.amplitude_V"\nvalues=[]'), "the axis is empty"),
        (axis('parameter = "program.amplitude_V"\nlow=1\nhigh=2\ncount=0'), "the axis is empty"),
        (axis('parameter = "program.amplitude_V"\nunit="um"\nvalues=[1.0]'), 'is in V, found "um"'),
        (axis('parameter = "program.amplitude_V"\nvalue=[1.0]'), "did you mean values"),
        (axis('parameter = "program.amplitude_V"\nlow=2\nhigh=1\ncount=3'), "no higher than high"),
        (axis('parameter = "program.amplitude_V"\nlow=1\nhigh=2'), "add [design]"),
        (axis('parameter = "hysteresis.density.packed_um"\nvalues=[1.0]'), "add relative = true"),
        (axis('parameter = "mechanics.damping_ratio"\nlow=-3\nhigh=-1\n[design]\nmethod="sobol"\nrows=4'), "bounds"),
        (HEAD, "expected at least one axis"),
        (HEAD + "[progam]\n", "did you mean program"),
        (HEAD.replace("simulate", "stimulate"), "kind: expected one of"),
        ('schema = "other"\n', "schema: expected"),
        ("kind = ", "expected TOML"),
        (axis('parameter = "program.amplitude_V"\nvalues=[1.0]\n[run]\nmemory_MB=0'), "run.memory_MB"),
        (axis('parameter = "program.amplitude_V"\nvalues=[1.0]\n[program]\nshape="squre"'), "program.shape"),
    ],
)
def test_mistakes_are_refused_in_one_sentence(text, words):
    with pytest.raises(DataError) as refused:
        parsed(text)
    assert words in str(refused.value)
    assert str(refused.value).startswith("sweep.toml: ")
    assert "\n" not in str(refused.value)
