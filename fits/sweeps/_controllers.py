"""The controllers of a sweep: what may be stated and varied of each kind, and the one that a row asks for."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.control._defaults import PERIODS, bp_defaults, cmac_defaults, strongest_Hz
from fits.control._gains import GAINS
from fits.control._setup import setup
from fits.control._tune_start import slope_array
from fits.io._errors import DataError, shown
from fits.io._record import Reference
from fits.machining._design import nearest
from fits.sweeps._choices import check_plain
from fits.sweeps._programs import Program, number
from fits.sweeps._stages import memory_before, range_of
from fits.sweeps._types import FloatArray, Parameter
from microid import BPPID, CMACPID, PID, AbstractController, ResonantPID, SampledStage, Stage, Start, parameter_table

_PID = (*GAINS, "filter_s", "reference_weight", "derivative_weight")
_LIMITS = ("lower_V", "upper_V")
_GAINS_MADE = ("resonant_V_per_um_s", "lead_deg")


@dataclass(frozen=True)
class _Kind:
    """What a kind of controller has beside limits and a delay: what varies, and what is only stated."""

    varied: tuple[str, ...]
    stated: tuple[str, ...] = ()


_KINDS = {
    "pid": _Kind(_PID),
    "bp-pid": _Kind(
        (*GAINS, "filter_s", "learning_rate_per_um2", "momentum", "slope_um_per_V", "scale_um", "seed"), ("span",)
    ),
    "cmac-pid": _Kind((*_PID, "learning_rate", "limit_V"), ("lower_um", "upper_um", "fastest_um_per_s")),
    "resonant": _Kind((*_PID, "frequency_Hz", *_GAINS_MADE)),
}
# The gains of a network are shares of those it begins with, which are above zero.
_LEAST_GAIN, _LEAST = 1e-12, 1e-9
_DEFAULTS = dict(zip(_PID, (0.0, 100.0, 0.0, 0.0, 1.0, 1.0), strict=True))
_BP_DEFAULTS = dict(zip(GAINS, (0.1, 100.0, 1e-4), strict=True)) | {
    "learning_rate_per_um2": 0.1,
    "momentum": 0.05,
    "seed": 0.0,
}
_SPAN = 3.0
# Resonators are below half the sampling rate.
_NYQUIST = 0.5 - 1e-6
# Unit and bounds of what is no parameter of its module.
_MORE: dict[str, tuple[str, float, float]] = {
    "lower_V": ("V", -math.inf, math.inf),
    "upper_V": ("V", -math.inf, math.inf),
    "slope_um_per_V": ("um/V", -math.inf, math.inf),
    "scale_um": ("um", _LEAST, math.inf),
    "seed": ("1", 0.0, 2.0**53),
    "limit_V": ("V", 0.0, math.inf),
    "lower_um": ("um", -math.inf, math.inf),
    "upper_um": ("um", -math.inf, math.inf),
    "fastest_um_per_s": ("um/s", _LEAST, math.inf),
    "lead_deg": ("deg", -math.inf, math.inf),
}


class Controllers(eqx.Module):
    """Controllers of one kind that differ in some numbers.

    What is made by the stage or the reference is made for the nominal ones: they differ from row to row, and the
    controller does not know of it.

    Attributes
    ----------
    kind
        One of `_KINDS`.
    numbers
        Those of a row where they do not vary. Gains and leads of resonators that are not stated are left out: they
        are made around the PID controller of each row.
    interval_s
        Between two samples.
    stage, slope_um_per_V
        The nominal stage, and its steepest slope, for resonators; None for others.
    delay
        Samples by which readings are late.
    span
        Of the gains of a network, see `BPPID.around`.
    """

    kind: str = eqx.field(static=True)
    numbers: dict[str, Float[Array, ""]]
    interval_s: Float[Array, ""]
    stage: Stage | None
    slope_um_per_V: Float[Array, ""] | None
    delay: int = eqx.field(static=True)
    span: float = eqx.field(static=True)

    def at(self, values: Mapping[str, Float[Array, ""]]) -> AbstractController:
        """The controller of a row, whose values come by the names of the sweep."""
        numbers = dict(self.numbers)
        for name in _KINDS[self.kind].varied:
            if f"controller.{name}" in values:
                numbers[name] = values[f"controller.{name}"]
        pid = self._pid(numbers)
        if self.kind == "pid":
            return pid
        if self.kind == "resonant":
            return self._resonant(pid, numbers)
        own: dict[str, Any] = {name: value for name, value in numbers.items() if name not in (*_PID, *_LIMITS)}
        if self.kind == "cmac-pid":
            return CMACPID(pid, **own)
        key = jax.random.key(own.pop("seed").astype(jnp.int64))
        return BPPID.around(pid, key, self.span, **own)

    def _pid(self, numbers: Mapping[str, Float[Array, ""]]) -> PID:
        fields: dict[str, Any] = {name: numbers[name] for name in (*_PID, *_LIMITS) if name in numbers}
        return PID(interval_s=self.interval_s, **fields)

    def _resonant(self, pid: PID, numbers: Mapping[str, Float[Array, ""]]) -> ResonantPID:
        frequency = numbers["frequency_Hz"]
        own = {name: numbers[name][None] for name in _GAINS_MADE if name in numbers}
        if len(own) < len(_GAINS_MADE):
            assert self.stage is not None
            rate, slope = frequency / PERIODS, self.slope_um_per_V
            made = ResonantPID.around(pid, self.stage, frequency[None], rate, delay=self.delay, slope_um_per_V=slope)
            own = {name: getattr(made, name) for name in _GAINS_MADE} | own
        return ResonantPID(pid, frequency[None], **own)

    def parameters(self) -> tuple[Parameter, ...]:
        """What may vary, with its nominal value, shape `()`."""
        found = self.at({})
        nominal = {name: float(value) for name, value in self.numbers.items()}
        if isinstance(found, ResonantPID):
            nominal |= {name: float(getattr(found, name)[0]) for name in _GAINS_MADE}
        # Of its PID controller, too: one that learns is made around it, and does not hold it.
        specs = {info.path: info.spec for info in parameter_table(self._pid(self.numbers))}
        specs |= {info.path: info.spec for info in parameter_table(found)}
        bounds = _MORE | {name: (spec.unit, spec.lower, spec.upper) for name, spec in specs.items()}
        bounds["frequency_Hz"] = "Hz", _LEAST, _NYQUIST / float(self.interval_s)
        if self.kind == "bp-pid":
            bounds |= {name: (bounds[name][0], _LEAST_GAIN, math.inf) for name in GAINS}
        return tuple(
            Parameter(f"controller.{name}", unit, nominal[name], lower, upper, whole=name == "seed")
            for name in _KINDS[self.kind].varied
            for unit, lower, upper in (bounds[name],)
        )


def read_controllers(given: Mapping[str, Any], stage: Stage, initial: str, reference: Program) -> Controllers:
    """Read the table `[controller]` of a sweep.

    Parameters
    ----------
    given
        The table.
    stage, initial, reference
        The nominal loop.

    Raises
    ------
    DataError
        For the first thing that is not as it should be.
    """
    kind = given.get("kind", "pid")
    if not isinstance(kind, str) or kind not in _KINDS:
        raise DataError(
            f"controller.kind: expected one of {', '.join(_KINDS)}, found {shown(kind)}; "
            f"{nearest(str(kind), [*_KINDS])}"
        )
    own = (*_KINDS[kind].varied, *_KINDS[kind].stated, *_LIMITS)
    for key in given:
        if key not in (*own, "kind", "delay_samples"):
            raise DataError(_unknown(key, kind, (*own, "kind", "delay_samples")))
    delay = given.get("delay_samples", 0)
    if isinstance(delay, bool) or not isinstance(delay, int) or not 0 <= delay <= 100:
        raise DataError(f"controller.delay_samples: expected a number from 0 to 100, found {shown(delay)}.")
    stated = {name: number(given[name], f"controller.{name}") for name in own if name in given}
    span = stated.pop("span", _SPAN)
    if not span > 1:
        raise DataError(f"controller.span: expected more than 1, found {span:g}; correct it.")
    numbers = dict(zip(_LIMITS, range_of(stage) or (-1e3, 1e3), strict=True))
    numbers |= _defaults(kind, stated, stage, initial, reference) | stated
    for low, high in (_LIMITS, ("lower_um", "upper_um")):
        if low in numbers and not numbers[low] < numbers[high]:
            raise DataError(
                f"controller.{low}: expected less than {high}, which is {numbers[high]:g} {low[6:]}, found "
                f"{numbers[low]:g}; correct one of them."
            )
    around = kind == "resonant" and not all(name in stated for name in _GAINS_MADE)
    found = Controllers(
        kind,
        {name: jnp.asarray(value) for name, value in numbers.items()},
        jnp.asarray(reference.interval_s),
        stage if around else None,
        slope_array(stage) if around else None,
        delay,
        span,
    )
    try:
        parameters = found.parameters()
    except ValueError as error:
        raise DataError(
            f"controller.kind: resonators cannot be made for this stage ({error}); state {' and '.join(_GAINS_MADE)}."
        ) from error
    _check(parameters, numbers)
    return found


def _unknown(key: str, kind: str, known: tuple[str, ...]) -> str:
    owners = [name for name, each in _KINDS.items() if key in (*each.varied, *each.stated)]
    of = f", which is of {' and '.join(owners)}" if owners else ""
    return f"controller.{key}: expected a known key of {kind}, found {shown(key)}{of}; {nearest(key, known)}"


def _check(parameters: tuple[Parameter, ...], numbers: Mapping[str, float]) -> None:
    """Refuse numbers out of their bounds, varied or not."""
    bounds = {each.name.removeprefix("controller."): each for each in parameters}
    for name, (unit, lower, upper) in _MORE.items():
        bounds.setdefault(name, Parameter(name, unit, 0.0, lower, upper))
    for name, value in numbers.items():
        each = bounds[name]
        if not each.lower <= value <= each.upper:
            raise DataError(f"controller.{name}: expected {each.range_words}, found {value:g}; correct it.")
        check_plain(each, np.array([value]), False, f"controller.{name}")


def _defaults(
    kind: str, stated: Mapping[str, float], stage: Stage, initial: str, reference: Program
) -> dict[str, float]:
    """What is not stated, as `microid control` has it, by the nominal stage and reference."""
    if kind == "pid":
        return _DEFAULTS
    if kind == "resonant":
        own = stated["frequency_Hz"] if "frequency_Hz" in stated else _frequency_Hz(reference)
        return _DEFAULTS | {"frequency_Hz": own}
    way_um = _way_um(stage, initial, reference)
    if kind == "bp-pid":
        return {"filter_s": 0.0} | _BP_DEFAULTS | bp_defaults(stage, way_um)
    static_V = np.zeros(1) if "limit_V" in stated else _static_V(stage, initial, reference.interval_s, way_um)
    return _DEFAULTS | cmac_defaults(way_um, static_V, reference.interval_s)


def _frequency_Hz(reference: Program) -> float:
    """Of what is to be followed: stated, or the strongest there is."""
    nominal = dict(reference.nominal)
    if "frequency_Hz" in nominal and "frequency_end_Hz" not in nominal:
        return nominal["frequency_Hz"]
    found = None if reference.shape == "step" else strongest_Hz(_wanted_um(reference), reference.interval_s)
    if found is None:
        raise DataError("controller.frequency_Hz: expected one for a reference that does not oscillate; state it.")
    return found


def _wanted_um(reference: Program) -> FloatArray:
    given = None if reference.given is None else jnp.asarray(reference.given)
    return np.asarray(reference.signal({}, given), dtype=np.float64)


def _way_um(stage: Stage, initial: str, reference: Program) -> FloatArray:
    """What is followed, from where the stage stands before: a step at the first sample is none by itself."""
    try:
        plant = SampledStage(stage, reference.interval_s)
    except ValueError as error:
        raise DataError(f"model: it cannot be stepped from sample to sample ({error}); give another one.") from error
    rest_um = plant.init(Start(None, memory_before(stage, initial)))[1]
    return np.append(rest_um, _wanted_um(reference))


def _static_V(stage: Stage, initial: str, interval_s: float, way_um: FloatArray) -> FloatArray:
    """Command that would hold the stage there."""
    time_s = np.arange(len(way_um), dtype=np.float64) * interval_s
    asked = Reference(np.asarray(time_s, dtype=np.float64), way_um, "reference")
    try:
        return setup(stage, asked, "none", initial=initial).static_V
    except DataError as error:
        raise DataError(f"controller.limit_V: no default is found ({error}); state it.") from error
