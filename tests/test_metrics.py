"""Eq. 34-36 on loops whose figures follow from their construction."""

import numpy as np
import pytest

from fits import errors
from fits.stats._metrics import loop_width_pct


def test_errors_are_percentages_of_the_measured_range():
    found = errors(np.array([0.0, 5.0, 10.0]), np.array([0.0, 5.3, 9.6]))
    assert found.e_max_pct == pytest.approx(4.0)
    assert found.e_rms_pct == pytest.approx(100 * np.sqrt((0.3**2 + 0.4**2) / 3) / 10)
    assert errors(np.array([4.0, 5.0]), np.array([4.0, 5.2]), 20.0).e_max_pct == pytest.approx(1.0)


@pytest.mark.parametrize("measured", [[], [1.0, 1.0]])
def test_nothing_to_compare_is_refused(measured):
    with pytest.raises(ValueError, match="moves"):
        errors(np.array(measured), np.array(measured))


def test_width_of_an_ellipse(rng):
    # displacement = cos(t - lag): the two branches differ by 2 sin(lag) where the voltage is zero.
    lag, height = rng.uniform(0.05, 0.3), rng.uniform(1, 50)
    t = np.linspace(0, 10 * 2 * np.pi, 20_001)
    width = loop_width_pct(60 + 60 * np.cos(t), height * np.cos(t - lag) + 7)
    assert width == pytest.approx(100 * np.sin(lag), rel=1e-3)


def test_one_way_makes_no_loop():
    assert loop_width_pct(np.linspace(0, 1, 100), np.linspace(0, 1, 100)) is None
