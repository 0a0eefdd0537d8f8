"""What a diagnosis gives back."""

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Self

import numpy as np

from fits.io._limits import Extreme
from microid import Stage

Verdict = Literal["no_effect", "effect_found", "unexplained"]
SCHEMA = "microid.diagnosis/1"
# The residual depends on something below this probability by chance.
_SIGNIFICANT = 1e-3


class Step(enum.StrEnum):
    """What a diagnosis is doing; in the order in which it is done, and at most once more each."""

    BASELINE = "fitting the plain stage"
    PROBES = "simulating every effect"
    ROUGHNESS = "learning how rough the density is"
    SELECTION = "asking for every effect"
    EXTENSION = "extending the stage"
    WRITING = "writing"


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect that was found: estimate, standard deviation and 95 % interval, in its unit."""

    name: str
    value: float
    sd: float
    unit: str
    lower: float
    upper: float


@dataclass(frozen=True)
class FoundCause:
    """One effect that the records need.

    Attributes
    ----------
    name, form
        Of the effect, and of its model if there are several.
    also_consistent
        Names of effects that this record cannot tell from it.
    z
        Evidence for it, in standard deviations.
    p_family
        Probability that chance gives any effect as much evidence where there is none.
    parameters
        Its strength and shape.
    share_of_misfit
        Part of the reproducible variance, of what the plain stage leaves, that it explains.
    rms_um
        Size of what it changes in the displacement, after the plain stage followed as far as it can.
    fingerprint, experiment, source
        Sentences about the effect.
    """

    name: str
    form: str
    also_consistent: tuple[str, ...]
    z: float
    p_family: float
    parameters: tuple[EffectParameter, ...]
    share_of_misfit: float
    rms_um: float
    fingerprint: str
    experiment: str
    source: str


@dataclass(frozen=True)
class Bound:
    """An effect that was not found, and how large it may still be; numbers are NaN where it was not asked about.

    Attributes
    ----------
    name, z
        Of the effect, and evidence for it beside the causes, in standard deviations.
    absorbed_fraction
        Part of its size that the plain stage follows, so that the records cannot show it.
    bound_um
        Size in the displacement, root mean square before anything follows, that it does not exceed at 95 %.
    reason
        Why it was not asked about; empty where it was.
    """

    name: str
    z: float
    absorbed_fraction: float
    bound_um: float
    reason: str = ""


@dataclass(frozen=True)
class Test:
    """One test of the residual of the plain stage, against something such as `time`, `velocity` or `whiteness`.

    `statistic` is the evidence in standard deviations, `p` the probability of as much by chance, and `share` the part
    of the residual's variance that it explains.
    """

    name: str
    statistic: float
    p: float
    share: float
    sentence: str

    @classmethod
    def of(cls, name: str, z: float, p: float, share: float, sentence: str) -> Self:
        """A test with the sentence that says what its significance means."""
        return cls(name, z, p, share, sentence if p < _SIGNIFICANT else f"no sign of this: {sentence}")


@dataclass(frozen=True)
class Gain:
    """What the extension is worth on data that were not used; NaN where nothing was held out.

    Attributes
    ----------
    heldout_rms_before_um, heldout_rms_after_um, sd_of_difference_um
        Root mean square errors of plain and extended stage, and the standard deviation of their difference.
    heldout_max_before_um, heldout_max_after_um
        Largest errors.
    noise_um
        Noise floor.
    feedforward_before_um, feedforward_after_um
        Root mean square errors of the displacement of the extended stage under voltages from the inverse of the plain
        one and from its own.
    source
        What was held out, in words.
    """

    heldout_rms_before_um: float = np.nan
    heldout_rms_after_um: float = np.nan
    sd_of_difference_um: float = np.nan
    heldout_max_before_um: float = np.nan
    heldout_max_after_um: float = np.nan
    noise_um: float = np.nan
    feedforward_before_um: float = np.nan
    feedforward_after_um: float = np.nan
    source: str = ""


@dataclass(frozen=True)
class RunView:
    """One run, for pictures: shape `(n,)` each.

    `before_um` and `after_um` are measurement less the plain and the extended stage, offset and start taken off;
    `fitted` are the samples that were used.
    """

    source: str
    time_s: np.ndarray
    voltage_V: np.ndarray
    measured_um: np.ndarray
    before_um: np.ndarray
    after_um: np.ndarray
    fitted: np.ndarray


@dataclass(frozen=True)
class Experiment:
    """The next experiment: a voltage program of shape `(n,)`, and what it would tell apart.

    Attributes
    ----------
    kind, purpose
        What it is made of, in words, and what it decides, one sentence.
    separates
        Names of the effects.
    predicted_z, present_z
        Standard deviations by which they would differ, at the smallest, and by which they do in the records at hand.
    extra_column
        Which further column would help, and why; empty if none would.
    extremes
        What the program is predicted to reach at most, whichever of the stages that the records allow is the true
        one, beside the limits.
    """

    time_s: np.ndarray
    voltage_V: np.ndarray
    kind: str
    purpose: str
    separates: tuple[str, ...]
    predicted_z: float
    present_z: float
    extra_column: str = ""
    extremes: tuple[Extreme, ...] = ()


@dataclass(frozen=True)
class Diagnosis:
    """What a fitted stage gets wrong, why, and what is gained by extending it.

    Attributes
    ----------
    verdict
        `no_effect`, `effect_found`, or `unexplained`: something is left that no effect of the library explains.
    noise_um, noise_source
        Noise floor, and what it was learnt from, in words.
    noise_samples
        Samples that are worth one independent one.
    causes
        In order of importance.
    unexplained_rms_um
        Reproducible error that is left.
    upper_bounds
        Of all other effects.
    tests
        Of the plain stage's residual.
    gain
        On held-out data.
    next_experiment
        What to measure next; None where nothing would help.
    remarks
        What the user should know, one sentence each.
    baseline, extended
        The plain stage and the one with the causes; the same where there are none.
    runs
        For pictures; those that were held out come last.
    false_alarm
        Probability of naming a cause where there is none.
    """

    verdict: Verdict
    noise_um: float
    noise_source: str
    noise_samples: float
    causes: tuple[FoundCause, ...]
    unexplained_rms_um: float
    upper_bounds: tuple[Bound, ...]
    tests: tuple[Test, ...]
    gain: Gain
    next_experiment: Experiment | None
    remarks: tuple[str, ...]
    baseline: Stage
    extended: Stage
    runs: tuple[RunView, ...]
    false_alarm: float
    details: Mapping[str, Any] = field(default_factory=dict)
