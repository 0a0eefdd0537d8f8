"""A curve behind a hysteresis, against relays one by one."""

import numpy as np
import pytest
from _models import densities_of, limits_V, random_model
from _reference import play_relays, relay_weights_um
from test_effects_reference import BY_NAME, through, wander

RELAYS, LEVELS = 400, 6


def relays_of(model):
    weights, thresholds = relay_weights_um(*densities_of(model), *limits_V(model), RELAYS)
    return lambda path: np.asarray(play_relays(weights, thresholds, path)) + float(model.offset_um)


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_it_bends_what_the_past_leaves_and_not_what_follows_the_voltage(rng, share):
    """A run of a smaller range has the same irreversible part: it is off the middle of the largest loop."""
    model = random_model(rng, LEVELS)
    lower, upper = limits_V(model)
    play = relays_of(model)
    # Between their thresholds relays are exact.
    fine = np.linspace(lower, upper, RELAYS + 1)
    loop = play(np.r_[fine, fine[::-1]])
    path = fine[np.round(wander(rng, 200, 0, share * RELAYS)).astype(int)]
    path[0] = lower
    plain, middle = play(path), np.interp(path, fine, (loop[: RELAYS + 1] + loop[:RELAYS:-1]) / 2)
    parts, centre, half = rng.normal(0, 0.05, 4), float(np.mean(loop)), float(np.ptp(loop)) / 2

    def curve(displacement):
        return half * np.polynomial.legendre.legval((displacement - centre) / half, [0, 0, *parts])

    effect = BY_NAME["curved_hysteresis", ""](model, *(float(part) for part in parts), centre, half)
    change = through(effect, 1e-3, path) - through(model, 1e-3, path)
    expected = curve(plain) - curve(middle)
    assert np.ptp(expected) > 1e-3 * half
    np.testing.assert_allclose(change, expected, atol=0.02 * np.max(np.abs(expected)) + 1e-4 * half)
