"""Another instant of an event is looked for, and not for ever."""

from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest

from fits.diagnosis import _relocate


@pytest.mark.parametrize("gain", [0.001, 0.05])
def test_what_goes_on_to_fall_a_little_is_given_up(monkeypatch, gain):
    """Beside a large rest each fit gained something at any instant, and a diagnosis went on past its budget."""
    calls = count()

    def model(cost):
        law = SimpleNamespace(effect=lambda x, run: SimpleNamespace(after_s=1.0), form=SimpleNamespace(rise=""))
        return SimpleNamespace(cost=cost, laws=(law,), x=(np.zeros(1),))

    def moved(bench, projector, one, k, way_s, least_s):
        assert next(calls) < 1000
        return model(one.cost * (1 - gain))

    monkeypatch.setattr(_relocate, "_moved", moved)
    now = [model(1e6)]

    def refit(bench, projector, laws, x, rounds):
        now[0] = model(now[0].cost * (1 - gain))
        return now[0]

    monkeypatch.setattr(_relocate, "refit", refit)
    record = SimpleNamespace(duration_s=10.0, time_s=np.arange(0, 10, 1e-3))
    bench = SimpleNamespace(prepared=[SimpleNamespace(run=SimpleNamespace(record=record))])
    found = _relocate.relocate(bench, SimpleNamespace(count=1000), now[0])
    assert found.cost < 1e6
    # Half as far each time from a twentieth of the record to an interval, or so often at most.
    assert next(calls) <= 2 * 24
