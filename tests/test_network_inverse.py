"""The inverse as a network: what it learns, and that it is no match for the exact one."""

import jax.numpy as jnp
import numpy as np
import pytest
from _models import compiled
from _reference import branches

from fits import DataError, Record
from fits.control._network_inverse import fit_network_inverse

SAMPLES = 1200
# One size for all tests: compiling the training takes longer than the training.
SMALL = {"width": 8, "samples": 400, "steps": 25}


def loops_V(rng, samples):
    """Up to the end of the range, and random reversals; from 0 V to 100 V."""
    turning_V = np.concatenate([[0, 100, 0], rng.uniform(0, 100, 30)])
    way = np.concatenate([[0], np.cumsum(np.abs(np.diff(turning_V)))])
    return np.interp(np.linspace(0, way[-1], samples), way, turning_V)


def relays_um(voltage_V):
    """Relays of even density, 40 um in all, by areas under the staircase (Eq. 9-11)."""
    corner, rising = branches(np.append(0.0, voltage_V))
    path, out = np.append(0.0, voltage_V), np.zeros(len(voltage_V) + 1)
    for k in range(1, len(path)):
        area = (path[k] - path[corner[k]]) ** 2 / 2
        out[k] = out[corner[k]] + 0.004 * (area if rising[k] else -area) + 0.2 * (path[k] - path[corner[k]])
    return out[1:]


@compiled
def voltage_of(inverse, displacement_um):
    return inverse(displacement_um)


@compiled
def seen_by(inverse, displacement_um):
    return inverse.features(displacement_um)


def test_it_learns_an_inverse_from_swapped_columns(rng):
    learn_V, test_V = loops_V(rng, SAMPLES), loops_V(rng, SAMPLES)
    record = Record(np.arange(SAMPLES), learn_V, relays_um(learn_V), source="loops.csv")
    inverse = fit_network_inverse(record, seed=3, **SMALL)
    again = fit_network_inverse(record, seed=3, **SMALL)
    test_um = relays_um(test_V)
    found_V = voltage_of(inverse, test_um)
    np.testing.assert_array_equal(voltage_of(again, test_um), found_V)
    rms_V = np.sqrt(np.mean((found_V - test_V) ** 2))
    # A curve through the record, without a memory, is off by the width of its loops.
    order = np.argsort(record.displacement_um)
    level_um, level_V = record.displacement_um[order], learn_V[order]
    bins = np.linspace(0, level_um[-1] + 1e-9, 41)
    place = np.digitize(level_um, bins)
    curve = [level_V[place == k].mean() if (place == k).any() else np.nan for k in range(1, 41)]
    plain_V = np.interp(test_um, (bins[1:] + bins[:-1])[~np.isnan(curve)] / 2, np.array(curve)[~np.isnan(curve)])
    # So small a network, trained so briefly, leaves 0.2 to 0.5 of that.
    assert rms_V < 0.7 * np.sqrt(np.mean((plain_V - test_V) ** 2))


def test_it_sees_the_remembered_extremes_and_no_noise(rng):
    learn_V = loops_V(rng, SAMPLES)
    record = Record(np.arange(SAMPLES), learn_V, relays_um(learn_V))
    inverse = fit_network_inverse(record, **SMALL)
    displacement_um = record.displacement_um[:300]
    seen = np.asarray(seen_by(inverse, displacement_um))
    levels = 2 * np.append(0, displacement_um) / np.ptp(record.displacement_um) - 1
    corner, rising = branches(levels)
    corner_of_corner = corner[corner]
    expected = [levels, levels[corner], levels[corner_of_corner], levels[corner[corner_of_corner]]]
    np.testing.assert_allclose(seen[:, :4], np.stack(expected, axis=1)[1:], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(seen[:, 4] > 0, rising[1:])
    noisy = fit_network_inverse(record, noise_um=0.05, **SMALL)
    rise_um = jnp.linspace(1.0, 30.0, 300) + rng.uniform(-0.1, 0.1, 300)
    assert np.all(seen_by(noisy, rise_um)[:, 4] == 1)
    assert not np.all(seen_by(inverse, rise_um)[:, 4] == 1)


@pytest.mark.parametrize(
    ("voltage_V", "displacement_um", "words"),
    [(np.arange(300.0), None, "displacement column"), (np.arange(50.0), np.arange(50.0), "200 samples"),
     (np.arange(300.0), np.zeros(300), "move")],
)  # fmt: skip
def test_records_that_teach_nothing_are_refused(voltage_V, displacement_um, words):
    record = Record(np.arange(float(len(voltage_V))), voltage_V, displacement_um, source="short.csv")
    with pytest.raises(DataError, match=words):
        fit_network_inverse(record)
