"""A diagnosis in words and numbers with sensible digits."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from fits.diagnosis._result import SMALLEST_P, Diagnosis, FoundCause, RunView
from fits.io import _length, _percent
from fits.loop._report_words import unseen
from fits.loop._result import ParameterEstimate
from microid.effects import EFFECTS, card_of

# A residual of more times the noise floor is not called noise.
NOISY = 1.2
_UNITS = {"um": "µm", "degC": "°C"}
# What stands for a number that is not known.
NONE = "\N{EN DASH}"
SIGMA = "\N{GREEK SMALL LETTER SIGMA}"
# Digits that are shown at most.
_MOST_DIGITS = 9
_MINUS = "\N{MINUS SIGN}"
_TIMES = "\N{MULTIPLICATION SIGN}"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def plain(name: str) -> str:
    """Write a name in words: the title of an effect that has one."""
    titles = (effect.title for effect in EFFECTS if effect.name == name)
    return next(filter(None, titles), name.replace("_", " "))


def heading(name: str) -> str:
    """The same with a capital at the beginning."""
    words = plain(name)
    return words[:1].upper() + words[1:]


def listed(names: Sequence[str], last: str = "and") -> str:
    words = [plain(name) for name in names]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}" if words else ""


def shown_unit(unit: str) -> str:
    """Write a unit such as `um/V^2` as µm/V²; nothing for none."""
    if unit == "1":
        return ""
    return "/".join(_UNITS.get(part, part) for part in unit.split("/")).replace("^2", "²")


def number(value: float, digits: int = 3) -> str:
    """Write a number with so many significant digits, and an en dash where there is none."""
    if not math.isfinite(value):
        return NONE
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))
    if not -4 <= exponent < 6:
        mantissa = f"{value / 10.0**exponent:.{digits - 1}f}".replace("-", _MINUS)
        return f"{mantissa} {_TIMES} 10{str(exponent).translate(_SUPERSCRIPTS)}"
    return _decimals(value, max(digits - 1 - exponent, 0))


def estimate(parameter: ParameterEstimate) -> tuple[str, str, str]:
    """Write estimate, standard deviation and 95 % interval, rounded to two digits of the standard deviation."""
    if words := unseen(parameter.value, parameter.lower, parameter.upper):
        return words, NONE, NONE
    sd = parameter.sd
    size = abs(parameter.value) if math.isfinite(parameter.value) else 0.0
    if not (math.isfinite(sd) and sd >= 1e-6) or max(size, sd) >= 1e6:
        known = size / sd if 0 < sd < size and math.isfinite(sd) else 1.0
        digits = min(2 + math.ceil(math.log10(known)), _MOST_DIGITS)
        ends = " to ".join(number(end, max(digits, 3)) for end in (parameter.lower, parameter.upper))
        return number(parameter.value, max(digits, 4)), number(sd, 2), ends
    places = max(1 - math.floor(math.log10(sd)), 0)
    lower, upper = (_decimals(end, places) for end in (parameter.lower, parameter.upper))
    return _decimals(parameter.value, places), _decimals(sd, places), f"{lower} to {upper}"


def _decimals(value: float, places: int) -> str:
    if not math.isfinite(value):
        return NONE
    whole, _, rest = f"{value:.{places}f}".partition(".")
    text = whole + (f".{rest}" if rest else "")
    return text.replace("-", _MINUS) if float(text) else text.lstrip("-")


def sigmas(z: float) -> str:
    """Write evidence in standard deviations; a tenth of one says nothing more."""
    return _decimals(z, 1) if abs(z) < 1e3 else number(z)


def parameter_name(parameter: ParameterEstimate) -> str:
    """Name a parameter in words, with its unit if it has one."""
    suffix = "_" + parameter.unit.replace("/", "_per_").replace("^", "")
    unit = shown_unit(parameter.unit)
    return plain(parameter.name.removesuffix(suffix).replace(".", " ")) + (f" ({unit})" if unit else "")


def percent(share: float) -> str:
    """Write a fraction as a percentage that is never rounded to all or nothing."""
    return _percent.percent(share).replace("-", _MINUS) if math.isfinite(share) else NONE


def chance(p: float) -> str:
    if not math.isfinite(p):
        return NONE
    if p < SMALLEST_P:
        return f"below {number(SMALLEST_P, 1).removeprefix(f'1 {_TIMES} ')}"
    return number(p, 2 if p >= 1e-3 else 1)


def length(size_um: float) -> str:
    """Write a length with the unit that it asks for, and an en dash where it is not known."""
    return _length.length(size_um).replace("um", _UNITS["um"]) if math.isfinite(size_um) else NONE


def spread(size_um: float, sd_um: float) -> str:
    """Write a length and its standard deviation, where that is known, in the unit of the larger."""
    if not math.isfinite(sd_um):
        return length(size_um)
    per_um, unit = _length.length_unit(max(abs(size_um), sd_um))
    return f"{number(per_um * size_um)} ± {number(per_um * sd_um, 2)} {shown_unit(unit)}"


def rms_um(runs: Sequence[RunView], name: str) -> float:
    """Root mean square of a residual, `before_um` or `after_um`, over the samples of the fit; NaN for none.

    Others were held out, or come before the stage forgot what it went through earlier: that is no error of a model.
    """
    parts = [getattr(run, name)[run.fitted] for run in runs]
    values = np.concatenate(parts or [np.empty(0)])
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


def whole(name: str) -> str:
    """What the share of a cause is a part of."""
    return "noise" if card_of(name).statistic else "misfit"


def headline(diagnosis: Diagnosis) -> str:
    """Say in a few words what is wrong."""
    classes = [(cause.name, listed(cause.also_consistent, "or")) for cause in diagnosis.causes]
    found = listed([f"{name} (or {others})" if others else name for name, others in classes])
    if len(classes) == 1:
        found = listed([diagnosis.causes[0].name, *diagnosis.causes[0].also_consistent], "or")
    if diagnosis.verdict == "no_effect":
        return "No hidden effect was found."
    if diagnosis.verdict == "unexplained":
        begin = f"The stage shows {found}, and more" if found else "Something is wrong"
        return f"{begin} that no known effect explains."
    return f"The stage shows {found}."


def verdict_sentence(diagnosis: Diagnosis) -> str:
    """Say in plain sentences what is wrong, why, how sure that is, and how much better the extension predicts."""
    apart = [
        f"These records cannot tell {plain(cause.name)} from {listed(cause.also_consistent, 'or')}."
        for cause in diagnosis.causes
        if cause.also_consistent
    ]
    return " ".join([_found(diagnosis), *apart, *_gained(diagnosis)])


def _found(diagnosis: Diagnosis) -> str:
    noise, left = length(diagnosis.noise_um), length(diagnosis.unexplained_rms_um)
    over_um = rms_um(diagnosis.runs, "before_um")
    if not diagnosis.causes and diagnosis.verdict == "unexplained":
        return (
            f"In the fit the plain stage leaves a residual of {length(over_um)}, root mean square, over a noise "
            f"floor of {noise}. Beyond what the stage could still follow, a reproducible error of {left} is left, "
            "and no effect of the library explains it."
        )
    if not diagnosis.causes:
        described = "describes these records down to"
        if over_um > NOISY * diagnosis.noise_um:
            described = f"leaves {length(over_um)}, root mean square, in which no effect shows, over"
        return (
            f"The plain stage {described} a noise floor of {noise}. Of records that hold no effect, "
            f"{percent(diagnosis.false_alarm)} are given a cause by chance."
        )
    shares = "; ".join(_shares(diagnosis.causes))
    sentences = [f"{shares[:1].upper()}{shares[1:]}."]
    if diagnosis.unexplained_rms_um > 0:
        sentences.append(
            f"Beyond the noise, a reproducible error of {left}, root mean square, is left without an explanation."
        )
    return " ".join(sentences)


def _shares(causes: Sequence[FoundCause]) -> Iterator[str]:
    """What is explained by which cause, of the misfit and of the noise."""
    for what in ("misfit", "noise"):
        some = [cause for cause in causes if whole(cause.name) == what]
        parts = [
            # No verb follows a name, as some are plural.
            f"{percent(one.share_of_misfit)} is explained by {plain(one.name)} ({sigmas(one.z)} standard deviations, "
            f"probability by chance {chance(one.p_family)})"
            for one in some
        ]
        # What goes without saying again.
        parts[1:] = [part.replace(" is explained", "").replace(" standard deviations", "") for part in parts[1:]]
        if parts:
            of = "reproducible misfit of the plain stage" if what == "misfit" else "noise"
            yield f"of the {of} {listed(parts)}"


def _gained(diagnosis: Diagnosis) -> list[str]:
    before, after = diagnosis.gain.heldout_rms_before_um, diagnosis.gain.heldout_rms_after_um
    modelled = [cause.name for cause in diagnosis.causes if not card_of(cause.name).statistic]
    if not modelled:
        return []
    if not math.isfinite(before) or not math.isfinite(after):
        return ["Nothing was held out, so what this is worth on new data is not known."]
    if after == before:
        return [f"What {listed(modelled)} did in these runs is not in the model of the next."]
    change = "falls" if after < before else "does not fall: it goes"
    change = f"{change} from {length(before)} to {length(after)}"
    if length(before) == length(after):
        change = f"stays at {length(after)}"
    return [
        f"With {listed(modelled)} in the model, the error on data that were not used {change}, root mean square; the "
        f"noise floor is {length(diagnosis.noise_um)}."
    ]
