"""Effects that begin at an instant of a record, against SciPy."""

import numpy as np
from test_effects_reference import BY_NAME, motion, through

import microid as m


def test_a_load_put_on_in_motion_goes_on_from_there(rng):
    time, push = 1e-4 * np.arange(600), 10 + rng.normal(size=600).cumsum() * 0.1
    at = 250

    def under(mass):
        # The same spring and damper, at 120 Hz and 0.03 with a mass of 1.
        rate = 2 * np.pi * 120
        return lambda y, u: [y[1], (rate**2 * (u - y[0]) - 2 * 0.03 * rate * y[1]) / mass]

    before = motion(time[: at + 1], push[: at + 1], under(1.0), np.array([push[0], 0.0]))
    after = motion(time[at:], push[at:], under(1.3), before[-1])
    truth = np.concatenate([before[:, 0], after[1:, 0]])
    mechanics = m.Mechanics(120.0, 0.03)
    found, plain = (
        through(part, 1e-4, push) for part in (BY_NAME["load_change", "within"](mechanics, 0.3, time[at]), mechanics)
    )
    np.testing.assert_array_equal(found[:at], plain[:at])
    np.testing.assert_allclose(found, truth, atol=0.01 * np.max(np.abs(truth - plain)))
