"""Steps of the unknowns that a regression eliminates."""

import numpy as np
import pytest

from fits.stage._moments import Moments, split_moments


@pytest.mark.parametrize("columns", [0, 2])
def test_what_nothing_depends_on_stays_where_it_is(rng, columns):
    """The lag of a driver at its bound has no derivative: that ended a fit with an error."""
    responses = rng.normal(size=(50, columns + 1))
    responses[:, columns] = 0.0
    measured_um = rng.normal(size=50)
    gram, cross_um = responses.T @ responses, responses.T @ measured_um
    total = Moments(gram, cross_um, measured_um @ measured_um, 50.0)
    rest, step, follow = split_moments(total, columns, 1e-4)
    assert step == pytest.approx(0.0)
    assert follow == pytest.approx(np.zeros((1, columns)))
    assert np.asarray(rest.gram) == pytest.approx(gram[:columns, :columns])
