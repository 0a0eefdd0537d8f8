"""What a diagnosis gives back."""

import enum
import inspect
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Self

import numpy as np

from fits.io._length import length
from fits.io._limits import Extreme
from fits.io._percent import percent
from fits.io._summary import AbstractSummary
from fits.loop._line_words import amplitude
from fits.loop._report_words import unseen
from fits.loop._result import ParameterEstimate
from fits.stage._uncertainty import StageUncertainty
from fits.stats._metrics import TWO_SIDED_95
from microid import Stage
from microid.effects import EFFECTS, AbstractEffect, card_of

Verdict = Literal["no_effect", "effect_found", "unexplained"]
SCHEMA = "microid.diagnosis/1"
# Verdicts in words.
KINDS = {"no_effect": "no effect found", "effect_found": "effect found", "unexplained": "unexplained error"}
# Below this, probabilities are those of tails that nobody has checked.
SMALLEST_P = 1e-9
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
class FoundCause:
    """One effect that the records need.

    `form` names its model if there are several, and `also_consistent` the effects that these records cannot tell from
    it. `z` is the evidence in standard deviations, and `p_family` the probability that chance gives any effect as
    much where there is none. `share_of_misfit` is the part that it explains of the reproducible variance that the
    plain stage leaves, and `rms_um` the size of what it changes after the plain stage followed as far as it can.
    `fingerprint`, `experiment` and `source` are sentences about the effect; `given` are constants of its law that
    were not fitted, by their names, which carry the unit.
    """

    name: str
    form: str
    also_consistent: tuple[str, ...]
    z: float
    p_family: float
    parameters: tuple[ParameterEstimate, ...]
    share_of_misfit: float
    rms_um: float
    fingerprint: str
    experiment: str
    source: str
    given: Mapping[str, float] = field(default_factory=dict)

    @property
    def law(self) -> str:
        """The equation of its model and what each parameter is, in the notation of LaTeX."""
        return law_in_words(self._form)

    @property
    def _form(self) -> type[AbstractEffect]:
        return next((one for one in EFFECTS if (one.name, one.form) == (self.name, self.form)), card_of(self.name))

    @property
    def shown(self) -> tuple[ParameterEstimate, ...]:
        """The parameters as people read them: of lines and waves the amplitudes, for their cosines and sines."""
        card = self._form
        if not card.phases:
            return self.parameters
        cosine, sine = card.phases
        known, out = {one.name: one for one in self.parameters}, list[ParameterEstimate]()
        for one in self.parameters:
            field, index, where = _ENTRY.fullmatch(one.name).groups()  # type: ignore[union-attr]
            if field == cosine:
                number = int(index or 0)
                at = f"at {card.lines_Hz[number]:g} Hz" if card.lines_Hz else f"of harmonic {number + 1}"
                line = f"amplitude {at}{where}"
                out.append(_amplitude(line, one, known[one.name.replace(cosine, sine, 1)]))
            elif field != sine:
                out.append(one)
        return tuple(out)


def law_in_words(form: type[AbstractEffect]) -> str:
    """What the docstring of an effect says of its model, but for the part that it is around."""
    words = re.sub(r"Attributes\n-+\n|\.\. math::[ \n]|`", "", inspect.getdoc(form) or "")
    return re.sub(r"^inner\n(?: .*\n)+", "", words, flags=re.MULTILINE).strip()


# A field, the place of an entry in it, and of which run it is.
_ENTRY = re.compile(r"(\w+)(?:\[(\d+)\])?(.*)")


def _amplitude(name: str, cosine: ParameterEstimate, sine: ParameterEstimate) -> ParameterEstimate:
    size, sd = amplitude((cosine.value, cosine.sd), (sine.value, sine.sd))
    return ParameterEstimate(
        name, cosine.unit, size, sd, max(size - TWO_SIDED_95 * sd, 0.0), size + TWO_SIDED_95 * sd
    )


@dataclass(frozen=True)
class Bound:
    """An effect that was not found, and how large it may still be.

    `z` is the evidence for it beside the causes, in standard deviations; `absorbed_fraction` the part of its size
    that the plain stage follows, so that the records cannot show it; and `bound_um` the root mean square in the
    displacement, before anything follows, that it does not exceed at 95 %. They are NaN where it was not asked about,
    for a `reason`, which is empty otherwise.
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

    Errors on the held-out data, which `source` describes, are those of the plain stage before, and of the extended
    one after: root mean squares, the standard deviation of their difference, and the largest. Those of the
    feedforward are root mean squares in the displacement of the extended stage, under voltages from the inverse of
    the plain one and from its own. `noise_um` is the noise floor.
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
    `fitted` are the samples that were used, and `extra` the names of the further columns.
    """

    source: str
    time_s: np.ndarray
    voltage_V: np.ndarray
    measured_um: np.ndarray
    before_um: np.ndarray
    after_um: np.ndarray
    fitted: np.ndarray
    extra: tuple[str, ...] = ()


@dataclass(frozen=True)
class Experiment:
    """The next experiment: a voltage program of shape `(n,)`, and what it would tell apart.

    `kind` says what it is made of, and `purpose` what it decides. The effects that it `separates` would differ by
    `predicted_z` standard deviations, at the smallest, and do by `present_z` in the records at hand. `extra_column`
    says which further column would help, and why; it is empty if none would. `extremes` are what the program is
    predicted to reach at most, whichever of the stages that the records allow is the true one, beside the limits.
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


@dataclass(frozen=True, repr=False)
class Diagnosis(AbstractSummary):
    """What a fitted stage gets wrong, why, and what is gained by extending it.

    The verdict is `unexplained` where something is left that no effect of the library explains, of the size
    `unexplained_rms_um` as far as it is reproducible. `noise_um` is the noise floor, learnt from `noise_source`, and
    `noise_samples` the samples that are worth one independent one. The `causes` are in order of importance, and
    `upper_bounds` are those of all other effects; `tests` are of the plain stage's residual, and `gain` is on
    held-out data. `next_experiment` is None where nothing would help. `baseline` is the plain stage and `extended`
    the one with the causes, the same where there are none; of the `runs` those that were held out come last.
    `false_alarm` is the probability of naming a cause where there is none. The parameters that were fitted of the
    plain and of the extended stage, which has those of its causes, too, are beside what the other may do. For the
    bands of their predictions there are uncertainties, as `predict` takes them, None where they cannot be told.
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
    baseline_parameters: tuple[ParameterEstimate, ...] = ()
    extended_parameters: tuple[ParameterEstimate, ...] = ()
    baseline_uncertainty: StageUncertainty | None = None
    extended_uncertainty: StageUncertainty | None = None
    details: Mapping[str, Any] = field(default_factory=dict)

    def summary(self) -> str:
        """Say the verdict, the causes with their parameters in units, and the gain, in a few lines."""
        lines = [f"{KINDS[self.verdict]}; noise {length(self.noise_um)}, from {self.noise_source}"]
        for cause in self.causes:
            also = f", or {', '.join(cause.also_consistent)}" if cause.also_consistent else ""
            chance = f"{cause.p_family:.1g}" if cause.p_family >= SMALLEST_P else f"below {SMALLEST_P:.0e}"
            lines.append(f"  {cause.name}{also}: {cause.z:.3g} standard deviations, by chance {chance}")
            whole = "noise" if card_of(cause.name).statistic else "misfit"
            if math.isfinite(cause.rms_um) and math.isfinite(cause.share_of_misfit):
                lines.append(f"    {length(cause.rms_um)}, {percent(cause.share_of_misfit)} of the {whole}")
            for each in cause.shown:
                if words := unseen(each.value, each.lower, each.upper):
                    lines.append(f"    {each.name:24} {words}")
                    continue
                unit = "" if each.unit == "1" else f" {each.unit}"
                below, above = each.value - each.lower, each.upper - each.value
                # An interval that ends at a bound, or reaches farther to one side, is no standard deviation.
                spread = f"+- {each.sd:.2g}{unit}"
                if not min(below, above) > 0.8 * max(below, above):
                    spread = f"(95 %: {each.lower:.3g} to {each.upper:.3g}){unit}"
                lines.append(f"    {each.name:24} {each.value:.4g} {spread}")
            lines += [f"    {name:24} {value:.4g}, given" for name, value in cause.given.items()]
        if self.unexplained_rms_um > 0:
            lines.append(f"  unexplained: {length(self.unexplained_rms_um)} beyond the noise")
        gain = self.gain
        if math.isfinite(gain.heldout_rms_before_um):
            line = f"error on held-out data: {length(gain.heldout_rms_before_um)}"
            if self.causes and math.isfinite(gain.heldout_rms_after_um):
                line += f" without, {length(gain.heldout_rms_after_um)} with what was found"
            lines.append(line)
        if self.next_experiment is not None:
            lines.append(f"next experiment: {self.next_experiment.purpose}")
        return "\n".join([*lines, *(f"Note: {remark}" for remark in self.remarks)])
