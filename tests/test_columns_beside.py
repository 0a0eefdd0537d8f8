"""Further columns of a record: which are the temperature and the second axis, and what a stage does without them."""

import jax.numpy as jnp
import numpy as np
import pytest

import fits
from fits.diagnosis._experiment import further_column
from fits.io.columns import COLUMNS, columns_beside
from microid import Driver, Mechanics, Sensor, Stage
from microid.effects import EFFECTS, extend
from microid.hysteresis import Dahl


def record(rng, **extra):
    time = np.arange(400) / 100
    voltage = 50 - 50 * np.cos(time)
    return fits.Record(time, voltage, 0.3 * voltage + 0.01 * rng.standard_normal(400), extra, source="run.csv")


def test_columns_are_known_by_their_names_and_other_readings_are_not_taken(rng):
    warm, other = 20 + np.linspace(0, 1, 400) ** 2, np.sin(np.arange(400) / 7)
    own = record(rng)
    taken = columns_beside(record(rng, temperature_C=warm, y_um=other))
    np.testing.assert_array_equal(taken["temperature_degC"][1:], warm[1:])
    assert taken["temperature_degC"][0] == pytest.approx(warm[0], abs=1e-4)
    np.testing.assert_array_equal(taken["other_um"], other)
    others = {
        "raw_nm": 1e3 * own.displacement_um,
        "monitor_V": own.voltage_V + 0.1,
        "attempt": warm,
        "gain_c": other,
        "path_m": 2 * own.time_s,
        "still_um": np.full(400, 3.0),
    }
    assert columns_beside(record(rng, **others)) == {}


def test_columns_come_in_the_units_that_effects_know(rng):
    other = np.sin(np.arange(400) / 7)
    taken = columns_beside(record(rng, y_nm=other, chamber_temperature_K=np.linspace(290.0, 291.0, 400)))
    np.testing.assert_allclose(taken["other_um"], other / 1e3, rtol=1e-15)
    np.testing.assert_allclose(taken["temperature_degC"][1:], np.linspace(16.85, 17.85, 400)[1:], rtol=1e-12)
    travelled = np.full(400, 900.0)
    assert columns_beside(record(rng, path_V=travelled))["path_V"].tolist() == travelled.tolist()


def test_the_columns_that_effects_name_are_known():
    named = {name for effect in EFFECTS for name in (*effect.needs, *effect.unless, effect.column)}
    assert {name for name in named if name and " " not in name} <= set(COLUMNS)


def test_a_column_that_is_there_is_not_asked_for_again(rng):
    asked = further_column(("cross_coupling", "thermal_drift"), [record(rng)])
    assert asked.startswith("other_um: the position of the second axis")
    assert further_column(("cross_coupling",), [record(rng), record(rng, y_um=np.sin(np.arange(400) / 7))]) == ""
    assert further_column(("thermal_drift",), [record(rng, temperature_degC=np.full(400, 20.0))]) == ""
    assert further_column(("clock_mismatch",), [record(rng)]).startswith("raw time stamps of both clocks")


def test_the_noise_of_the_first_temperature_is_no_step(rng):
    # The end of a line through n readings is off by 2 / sqrt(n) of their noise (ordinary least squares).
    time_s = np.arange(100_000) / 100
    off = []
    for _ in range(50):
        warm = 20 + 0.01 * time_s + 0.1 * rng.standard_normal(len(time_s))
        own = fits.Record(time_s, np.sin(time_s), np.sin(time_s), {"temperature_C": warm})
        off.append(columns_beside(own)["temperature_degC"][0] - 20)
    expected = 0.1 * 2 / 2000**0.5
    assert 0.6 * expected < np.sqrt(np.mean(np.square(off))) < 1.5 * expected


def test_a_stage_with_an_effect_of_a_column_asks_for_it(rng):
    coupling = next(one for one in EFFECTS if (one.name, one.form) == ("cross_coupling", ""))
    plain = Stage.of(
        driver=Driver(8e-4), hysteresis=Dahl(0.2, 1.0, 8.0, 1.0), mechanics=Mechanics(100.0, 0.05), sensor=Sensor()
    )
    stage = extend(plain, coupling(jnp.asarray(0.01)))
    given = record(rng, y_um=np.sin(np.arange(400) / 7))
    moved = fits.predict(stage, given).displacement_um - fits.predict(plain, given).displacement_um
    assert np.ptp(moved) > 1e-3
    with pytest.raises(fits.DataError, match="other_um"):
        fits.predict(stage, record(rng))
