"""The steps of a diagnosis, as they are announced."""

import enum


class Step(enum.StrEnum):
    """What a diagnosis is doing; in the order in which it is done, and at most once more each."""

    BASELINE = "fitting the plain stage"
    PROBES = "simulating every effect"
    ROUGHNESS = "learning how rough the density is"
    SELECTION = "asking for every effect"
    EXTENSION = "extending the stage"
    WRITING = "writing"
