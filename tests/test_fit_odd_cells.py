"""Records with cells that no converter writes: fitted without a warning, or refused."""

import numpy as np
import pytest
from _fuzz_files import LEVELS, loops

import fits


@pytest.mark.study
def test_a_voltage_beside_zero_is_zero():
    """Between 0 and 1e-300 V the operator goes nowhere, and no power of that is infinite."""
    run = loops()
    run["voltage_V"][[65, 116]] = 0.0, 1e-300
    result = fits.fit([fits.Record(**run)], levels=LEVELS)
    assert np.isfinite(result.weights_um).all()
