"""What `control` advises is no worse than what it advises against."""

import pytest

from fits.report._control import describe_control

RUN = {"error_rms_um": 0.04, "error_max_um": 0.1, "e_rms_pct": 0.2, "e_max_pct": 0.5}
TOLD = {
    "controller": "pid",
    "feedforward": "static",
    "samples": 1000,
    "interval_s": 1e-3,
    "gains": {"proportional_V_per_um": 0.1},
    "tuning": None,
    "margins_worst": {"plants": 1, "gain_margin": 3.0, "phase_margin_deg": 60.0, "sensitivity_peak": 1.2},
    "tracking": RUN,
    "over_plants_um": 0.04,
    "without_feedback": RUN,
    "worth": {"error_rms_um": 0.04, "without_um": 0.0404, "share": 0.01},
    "inverse_alone_um": None,
    "strongest_Hz": None,
    "step": None,
    "command_min_V": 0.0,
    "command_max_V": 100.0,
    "remarks": [],
    "out": "run.csv",
    "plots": [],
}


@pytest.mark.parametrize(("alone_um", "advised"), [(0.02, True), (0.0399, False), (0.04, False), (0.08, False)])
def test_the_inverse_is_advised_where_it_alone_leaves_less(alone_um, advised):
    said = describe_control(TOLD | {"inverse_alone_um": alone_um})
    assert ("--feedforward dynamic" in said) == advised
    assert ("over all plants, no less than this loop" in said) != advised
    assert "--feedforward" not in describe_control(TOLD)


def test_resonators_are_named_where_a_period_stands_out_and_feedback_does_little():
    periodic = TOLD | {"strongest_Hz": 12.5}
    assert "for what repeats at 12.5 Hz there is --controller resonant" in describe_control(periodic)
    worth = periodic["worth"] | {"share": 0.5}
    for other in (TOLD, periodic | {"controller": "resonant"}, periodic | {"worth": worth}):
        assert "--controller" not in describe_control(other)
