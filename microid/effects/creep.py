"""Creep: displacement that goes on after the voltage has come to rest, along the logarithm of time."""

from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._in_numpy import _lags, _NumpySignal
from microid._linear import Times
from microid._param import array, param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, View, _lowpass, _times_of, register
from microid.effects._grids import _decades

# Relaxations per decade of time constants, and the decades ahead of the onset and behind it that they cover.
_PER_DECADE, _AHEAD, _BEHIND = 3, 1, 5
# What creeps more than this per decade, or than that in all, is no piezo's creep but some other lag.
_MOST, _MOST_IN_ALL = 0.1, 0.5
# Moves before a record that stand for all of them took place so many s ago, and where records are at hand so many of
# their durations.
_RECENT_s, _OLDER_s = 1.0, 100.0
_AGES = ("recent_s", 0.03), ("older_s", 0.5)


@register
class Creep(AbstractEffect):
    r"""Relaxations of all time constants, which together creep along the logarithm of time.

    .. math:: w \leftarrow w + \gamma \sum_j \frac{e^{-t_0 / \tau_j}}{m} \, \mathrm{LP}_{\tau_j}[w - w(0)]

    With `m` time constants per decade this is the trapezoidal rule for the integral over the logarithm of `tau` that
    `log10(1 + t / t0)` is (Laplace's of `1 / (t + t0)`): a step of one answers with `gamma log10(1 + t / t0)`, up to
    five decades behind `t0`.

    Attributes
    ----------
    gain_per_decade
        `gamma`: creep per decade of time over the step before.
    onset_s
        `t0`, where creep begins. What lags by less than its bound is a matter of driver, sensor or mechanics.
    recent_um, older_um
        What goes on of moves before the record, per decade: of some right before it, and of some long before.
    recent_s, older_s
        How long before the first sample those took place, given.
    """

    name: ClassVar[str] = "creep"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("gain_per_decade",)
    history: ClassVar[tuple[str, ...]] = ("recent_um", "older_um")
    ages: ClassVar[tuple[tuple[str, float], ...]] = _AGES
    moved: ClassVar[str] = "um"
    fingerprint: ClassVar[str] = (
        "After each step the residual goes on in the direction of the step, in proportion to it, along the logarithm "
        "of time or towards a limit."
    )
    confusions: ClassVar[tuple[str, ...]] = ("thermal_drift", "mount_relaxation", "rate_dependence")
    experiment: ClassVar[str] = "Steps up and down, each held for three decades of time."
    source: ClassVar[str] = "PI piezo tutorial: dL (1 + gamma lg(t / 0.1 s)), gamma of 0.01 to 0.02"
    view: ClassVar[View] = "since_move"
    column: ClassVar[str] = "temperature_degC"
    universal: ClassVar[bool] = True
    held: ClassVar[str] = "gain_per_decade"
    gain_per_decade: Float[Array, ""] = param(unit="1", lower=0.0, upper=_MOST)
    onset_s: Float[Array, ""] = param(unit="s", scale=0.1, lower=0.01, upper=1e3)
    recent_um: Float[Array, ""] = param(default=0.0, unit="um")
    older_um: Float[Array, ""] = param(default=0.0, unit="um")
    recent_s: Float[Array, ""] = array(default=_RECENT_s)
    older_s: Float[Array, ""] = array(default=_OLDER_s)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Onsets in steps of a decade, from some samples to a tenth of the record."""
        return _onsets(cls, scales)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add creep to a displacement that was at rest."""
        crept = self.gain_per_decade * _crept(time_s, signal.values - signal.before, self.onset_s)
        time = _times_of(time_s, crept.shape[0])
        gone_on = _gone_on(time, self.recent_um, self.recent_s) + _gone_on(time, self.older_um, self.older_s)
        return signal.with_values(signal.values + crept + gone_on, signal.before)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Add creep to a displacement that was at rest."""
        crept = self.gain_per_decade * _crept_in_numpy(interval_s, signal.values - signal.before, self.onset_s)
        return signal._replace(values=signal.values + crept)


@register
class VoltageCreep(AbstractEffect):
    r"""Creep ahead of the hysteresis: the domains see a voltage that goes on along the logarithm of time.

    .. math:: u \leftarrow u + \gamma \sum_j \frac{e^{-t_0 / \tau_j}}{m} \, \mathrm{LP}_{\tau_j}[u - u(0)]

    Thermal activation switches domains later that would have switched at a larger field, as if the field had grown
    (Neel's fluctuation field). Unlike `Creep` it knows the branch: what goes on after a move up does so along the
    branch up, and a controller that holds the position lowers the voltage by `gamma` of the step each decade.

    Attributes
    ----------
    gain_per_decade
        `gamma`: change of the voltage seen, per decade of time, over the step of the voltage before.
    onset_s
        `t0`, where creep begins. What lags by less than its bound is a matter of driver, sensor or mechanics.
    recent_V, older_V
        What goes on of moves before the record, per decade: of some right before it, and of some long before.
    recent_s, older_s
        How long before the first sample those took place, given.
    """

    name: ClassVar[str] = "creep"
    form: ClassVar[str] = "voltage"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "V"
    place: ClassVar[Place] = "driver"
    strength: ClassVar[tuple[str, ...]] = ("gain_per_decade",)
    history: ClassVar[tuple[str, ...]] = ("recent_V", "older_V")
    ages: ClassVar[tuple[tuple[str, float], ...]] = _AGES
    moved: ClassVar[str] = "V"
    fingerprint: ClassVar[str] = Creep.fingerprint
    confusions: ClassVar[tuple[str, ...]] = Creep.confusions
    experiment: ClassVar[str] = Creep.experiment
    source: ClassVar[str] = "Neel's fluctuation field; see Bertotti, Hysteresis in Magnetism (1998), ch. 14"
    view: ClassVar[View] = "since_move"
    column: ClassVar[str] = "temperature_degC"
    universal: ClassVar[bool] = True
    held: ClassVar[str] = "gain_per_decade"
    gain_per_decade: Float[Array, ""] = param(unit="1", lower=0.0, upper=_MOST)
    onset_s: Float[Array, ""] = param(unit="s", scale=0.1, lower=0.01, upper=1e3)
    recent_V: Float[Array, ""] = param(default=0.0, unit="V")
    older_V: Float[Array, ""] = param(default=0.0, unit="V")
    recent_s: Float[Array, ""] = array(default=_RECENT_s)
    older_s: Float[Array, ""] = array(default=_OLDER_s)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Onsets as those of `Creep`."""
        return _onsets(cls, scales)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add creep to a voltage that was constant."""
        crept = self.gain_per_decade * _crept(time_s, signal.values - signal.before, self.onset_s)
        time = _times_of(time_s, crept.shape[0])
        gone_on = _gone_on(time, self.recent_V, self.recent_s) + _gone_on(time, self.older_V, self.older_s)
        return signal.with_values(signal.values + crept + gone_on, signal.before)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Add creep to a voltage that was constant."""
        crept = self.gain_per_decade * _crept_in_numpy(interval_s, signal.values - signal.before, self.onset_s)
        return signal._replace(values=signal.values + crept)


@register
class KelvinVoigtCreep(AbstractEffect):
    r"""One relaxation, of a Kelvin-Voigt element in series with the piezo.

    .. math:: w \leftarrow w + a \, \mathrm{LP}_{\tau}[w - w(0)]

    Attributes
    ----------
    gain
        `a`: creep in the end over the step before.
    time_constant_s
        `tau`.
    before_um
        What is still to come, at the start of the record, of moves before it.
    """

    name: ClassVar[str] = "creep"
    form: ClassVar[str] = "kelvin_voigt"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("gain",)
    history: ClassVar[tuple[str, ...]] = ("before_um",)
    moved: ClassVar[str] = "um"
    fingerprint: ClassVar[str] = Creep.fingerprint
    confusions: ClassVar[tuple[str, ...]] = Creep.confusions
    experiment: ClassVar[str] = Creep.experiment
    source: ClassVar[str] = "Kelvin-Voigt element; see Jung & Gweon, Rev. Sci. Instrum. 71 (2000) 1896"
    view: ClassVar[View] = "since_move"
    column: ClassVar[str] = "temperature_degC"
    universal: ClassVar[bool] = True
    relaxation: ClassVar[str] = "time_constant_s"
    held: ClassVar[str] = "gain_per_decade"
    gain: Float[Array, ""] = param(unit="1", lower=0.0, upper=_MOST_IN_ALL)
    time_constant_s: Float[Array, ""] = param(unit="s", lower=0.02, upper=1e5)
    before_um: Float[Array, ""] = param(default=0.0, unit="um")

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Time constants in steps of half a decade, from some samples to the length of the record."""
        first = max(10 * scales.interval_s, 0.03)
        return tuple(
            (cls(jnp.asarray(0.01), jnp.asarray(constant)),) for constant in _decades(first, scales.duration_s, 2)
        )

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add creep to a displacement that was at rest."""
        moved = self.gain * _lowpass(time_s, signal.values - signal.before, self.time_constant_s)
        late = -self.before_um * jnp.expm1(-_times_of(time_s, moved.shape[0]) / self.time_constant_s)
        return signal.with_values(signal.values + moved + late, signal.before)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Add creep to a displacement that was at rest."""
        moved = _lags(interval_s, signal.values - signal.before, [self.time_constant_s], [self.gain])
        return signal._replace(values=signal.values + moved)


def _crept(time_s: Times, moved: Float[Array, " t"], onset_s: Float[Array, ""]) -> Float[Array, " t"]:
    """Answer of all relaxations to a signal from rest, of one per decade to a step of one, shape `(t,)`."""
    ratio, weight = _relaxations()
    weights = jnp.asarray(weight, dtype=moved.dtype)
    constants = onset_s * jnp.asarray(ratio, dtype=moved.dtype)
    each = jax.vmap(lambda constant: _lowpass(time_s, moved, constant))(constants)
    return jnp.sum(weights[:, None] * each, axis=0)


def _crept_in_numpy(interval_s: np.ndarray, moved: np.ndarray, onset_s: Any) -> np.ndarray:
    ratio, weight = _relaxations()
    return _lags(interval_s, moved, onset_s * ratio, weight)


def _relaxations() -> tuple[np.ndarray, np.ndarray]:
    """Time constants over the onset, and what each relaxation answers a step of one with, shape `(m,)` each."""
    ratio = 10 ** (np.arange(-_AHEAD * _PER_DECADE, _BEHIND * _PER_DECADE + 1) / _PER_DECADE)
    return ratio, np.exp(-1 / ratio) / _PER_DECADE


def _gone_on(time_s: Float[Array, " t"], moved: Float[Array, ""], ago_s: Float[Array, ""]) -> Float[Array, " t"]:
    """What goes on, from the first sample on, of moves so long before it, shape `(t,)`."""
    return moved * jnp.log1p(time_s / ago_s) / jnp.log(10.0)


def _onsets(form: type[Any], scales: Scales) -> tuple[tuple[Any, ...], ...]:
    """Creep of a percent per decade with several onsets."""
    first = max(10 * scales.interval_s, 0.03)
    return tuple((form(jnp.asarray(0.01), jnp.asarray(onset)),) for onset in _decades(first, scales.duration_s / 10))
