"""A plain stage that has gone elsewhere beside an effect, which explains little there, is gone on from."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from fits.diagnosis._explanation import Cause, Selection
from fits.diagnosis._thresholds import THRESHOLDS


@dataclass(frozen=True)
class Place:
    z: np.ndarray
    columns_um: np.ndarray


def found(there, with_effect, plain, problem, causes=1):
    """Sums of squares at the place found, without an effect and with it, and at the first plain stage."""
    baseline = SimpleNamespace(problem=problem, z=np.array([1.0, 2.0]), columns_um=np.array([3.0]))
    residual = np.array([float(there) ** 0.5, 0.0])
    at = SimpleNamespace(regression=SimpleNamespace(baseline=baseline), residual=residual, off=lambda joined: joined)
    models = SimpleNamespace(cost=with_effect), SimpleNamespace(cost=plain)
    cause = Cause("friction", 9.0, 0.0, (), 1.0)
    return Selection((cause,) * causes, *models, (), (), None, SimpleNamespace(plain=[np.zeros(2)]), at, at)


def test_the_place_is_that_beside_the_effect():
    better = found(120.0, 110.0, 1000.0, Place(np.zeros(2), np.zeros(1))).plain_instead(THRESHOLDS)
    np.testing.assert_array_equal(better.z, [1.0, 2.0])
    np.testing.assert_array_equal(better.columns_um, [3.0])


@pytest.mark.parametrize(
    ("there", "problem", "causes"),
    [(900.0, Place(np.zeros(2), np.zeros(1)), 1), (120.0, None, 1), (120.0, Place(np.zeros(2), np.zeros(1)), 0)],
    ids=["the effect explains it", "no dynamics", "no effect"],
)
def test_else_the_plain_stage_stays(there, problem, causes):
    assert found(there, 110.0, 1000.0, problem, causes).plain_instead(THRESHOLDS) is None
