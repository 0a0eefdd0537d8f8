"""Mains hum: lines at the frequency of the mains and its multiples."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._in_numpy import _instants, _NumpySignal
from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, View, _times_of, register

_HARMONICS, _MOST = 3, 11
# By which the mains may run fast or slow.
_TOLERANCE = 0.002


@register
class MainsHum(AbstractEffect):
    r"""Hum of mains of 50 Hz, with the phases of each record.

    .. math:: y + \sum_{h=1}^{3} A_h \cos 2 \pi h f t + B_h \sin 2 \pi h f t

    Attributes
    ----------
    cosine_um, sine_um
        `A` and `B`, shape `(3,)`, with `t` from the start of the record.
    frequency_Hz
        `f`.
    """

    name: ClassVar[str] = "mains_hum"
    form: ClassVar[str] = "50_Hz"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "sensor"
    strength: ClassVar[tuple[str, ...]] = ("cosine_um", "sine_um")
    per_run: ClassVar[bool] = True
    # Its frequency is another one in the next record.
    repeats: ClassVar[bool] = True
    lines_Hz: ClassVar[tuple[float, ...]] = (50.0, 100.0, 150.0)
    tolerance: ClassVar[float] = _TOLERANCE
    phases: ClassVar[tuple[str, ...]] = ("cosine_um", "sine_um")
    fingerprint: ClassVar[str] = (
        "Lines in the spectrum at multiples of 50 or 60 Hz, also at rest, whatever the command."
    )
    confusions: ClassVar[tuple[str, ...]] = ("floor_vibration",)
    experiment: ClassVar[str] = "A record at rest, as long as can be."
    source: ClassVar[str] = "ripple of piezo amplifiers of 20 to 40 mV, 7 to 13 nm; 1 to 50 nm in sensors (estimate)"
    view: ClassVar[View] = "frequency"
    independent: ClassVar[bool] = True
    cosine_um: Float[Array, " 3"] = param(unit="um", scale=0.01)
    sine_um: Float[Array, " 3"] = param(unit="um", scale=0.01)
    frequency_Hz: Float[Array, ""] = param(unit="Hz", lower=50 * (1 - _TOLERANCE), upper=50 * (1 + _TOLERANCE))

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Cosines and sines of all harmonics, at frequencies that the longest record tells apart."""
        return _lines(cls, scales, 50.0)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add the lines."""
        return _hum(time_s, signal, self.cosine_um, self.sine_um, self.frequency_Hz)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Add the lines."""
        return _hum_in_numpy(interval_s, signal, self.cosine_um, self.sine_um, self.frequency_Hz)


@register
class MainsHum60(AbstractEffect):
    """Hum of mains of 60 Hz; see `MainsHum`.

    Attributes
    ----------
    cosine_um, sine_um
        Amplitudes, shape `(3,)`, with times from the start of the record.
    frequency_Hz
        Frequency of the mains.
    """

    name: ClassVar[str] = "mains_hum"
    form: ClassVar[str] = "60_Hz"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "sensor"
    strength: ClassVar[tuple[str, ...]] = ("cosine_um", "sine_um")
    per_run: ClassVar[bool] = True
    # Its frequency is another one in the next record.
    repeats: ClassVar[bool] = True
    lines_Hz: ClassVar[tuple[float, ...]] = (60.0, 120.0, 180.0)
    tolerance: ClassVar[float] = _TOLERANCE
    phases: ClassVar[tuple[str, ...]] = ("cosine_um", "sine_um")
    fingerprint: ClassVar[str] = MainsHum.fingerprint
    confusions: ClassVar[tuple[str, ...]] = MainsHum.confusions
    experiment: ClassVar[str] = MainsHum.experiment
    source: ClassVar[str] = MainsHum.source
    view: ClassVar[View] = "frequency"
    independent: ClassVar[bool] = True
    cosine_um: Float[Array, " 3"] = param(unit="um", scale=0.01)
    sine_um: Float[Array, " 3"] = param(unit="um", scale=0.01)
    frequency_Hz: Float[Array, ""] = param(unit="Hz", lower=60 * (1 - _TOLERANCE), upper=60 * (1 + _TOLERANCE))

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Cosines and sines of all harmonics, at frequencies that the longest record tells apart."""
        return _lines(cls, scales, 60.0)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add the lines."""
        return _hum(time_s, signal, self.cosine_um, self.sine_um, self.frequency_Hz)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Add the lines."""
        return _hum_in_numpy(interval_s, signal, self.cosine_um, self.sine_um, self.frequency_Hz)


def _lines(cls: Any, scales: Scales, mains_Hz: float) -> tuple[tuple[Any, ...], ...]:
    seen = [h for h in range(1, _HARMONICS + 1) if 2.2 * h * mains_Hz * scales.interval_s < 1]
    span = 1.8 * _TOLERANCE * mains_Hz
    places = min(2 * int(span * scales.duration_s / 2) + 1, _MOST)
    groups = []
    for frequency in mains_Hz + span * (np.arange(places) - (places - 1) / 2) / max(places - 1, 1):
        at, none = jnp.asarray(float(frequency)), jnp.zeros(_HARMONICS)
        lines = [none.at[h - 1].set(0.01) for h in seen]
        groups.append(tuple(effect for line in lines for effect in (cls(line, none, at), cls(none, line, at))))
    return tuple(groups) if seen else ()


def _hum(
    time_s: Times,
    signal: Signal,
    cosine_um: Float[Array, " 3"],
    sine_um: Float[Array, " 3"],
    frequency_Hz: Float[Array, ""],
) -> Signal:
    phase = 2 * jnp.pi * frequency_Hz * _times_of(time_s, signal.values.shape[0])
    total = signal.values
    for h in range(_HARMONICS):
        total = total + cosine_um[h] * jnp.cos((h + 1) * phase) + sine_um[h] * jnp.sin((h + 1) * phase)
    return signal.with_values(total, signal.before)


def _hum_in_numpy(
    interval_s: np.ndarray, signal: _NumpySignal, cosine_um: Any, sine_um: Any, frequency_Hz: Any
) -> _NumpySignal:
    phase, total = 2 * np.pi * frequency_Hz * _instants(interval_s, len(signal.values))[:, None], signal.values
    for h in range(_HARMONICS):
        total = total + cosine_um[h] * np.cos((h + 1) * phase) + sine_um[h] * np.sin((h + 1) * phase)
    return signal._replace(values=total)
