"""Thermal drift: the frame grows and shrinks with its temperature, whatever the command."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._in_numpy import _instants, _NumpySignal
from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, View, _lowpass, _times_of, register
from microid.effects._grids import _decades

# Heat takes about so long through a millimetre of ceramic (d^2 / (pi^2 a), of a thermal diffusivity a of 0.5 mm^2/s):
# no stack follows it sooner.
_SOONEST_s = 0.2


@register
class ThermalDrift(AbstractEffect):
    r"""Drift at a steady rate: `y + r t`, with `t` from the start of the record.

    Attributes
    ----------
    rate_um_per_s
        `r`.
    """

    name: ClassVar[str] = "thermal_drift"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "environment"
    strength: ClassVar[tuple[str, ...]] = ("rate_um_per_s",)
    unless: ClassVar[tuple[str, ...]] = ("temperature_degC",)
    per_run: ClassVar[bool] = True
    fingerprint: ClassVar[str] = (
        "The residual moves slowly in one direction whatever the command does, also while it rests, and follows the "
        "temperature with a lag."
    )
    confusions: ClassVar[tuple[str, ...]] = ("creep", "mount_relaxation", "aging")
    experiment: ClassVar[str] = (
        "The same pattern again after a wait, a record at rest, and a temperature_degC column of the stage's body."
    )
    source: ClassVar[str] = "PI piezo tutorial, thermal expansion: piezo stack -3.5e-6/K, steel 11e-6/K to 12e-6/K"
    view: ClassVar[View] = "time"
    column: ClassVar[str] = "temperature_degC"
    rate_um_per_s: Float[Array, ""] = param(unit="um/s", scale=1e-3)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """A drift by three times the noise over the record."""
        return ((cls(jnp.asarray(3 * scales.noise_um / scales.duration_s)),),)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add the drift since the first sample."""
        time = _times_of(time_s, signal.values.shape[0])
        return signal.with_values(signal.values + self.rate_um_per_s * time, signal.before)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Add the drift since the first sample."""
        time = _instants(interval_s, len(signal.values))[:, None]
        return signal._replace(values=signal.values + self.rate_um_per_s * time)


@register
class ExponentialThermalDrift(AbstractEffect):
    r"""Drift towards a new balance: `y + a (1 - exp(-t / tau))`.

    Attributes
    ----------
    change_um
        `a`.
    time_constant_s
        `tau`.
    """

    name: ClassVar[str] = "thermal_drift"
    form: ClassVar[str] = "exponential"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "environment"
    strength: ClassVar[tuple[str, ...]] = ("change_um",)
    unless: ClassVar[tuple[str, ...]] = ("temperature_degC",)
    per_run: ClassVar[bool] = True
    fingerprint: ClassVar[str] = ThermalDrift.fingerprint
    confusions: ClassVar[tuple[str, ...]] = ThermalDrift.confusions
    experiment: ClassVar[str] = ThermalDrift.experiment
    source: ClassVar[str] = "Newton's law of cooling; time constants of 2 to 60 min are an engineering estimate"
    view: ClassVar[View] = "time"
    column: ClassVar[str] = "temperature_degC"
    change_um: Float[Array, ""] = param(unit="um", scale=0.1)
    time_constant_s: Float[Array, ""] = param(unit="s", scale=100.0, lower=_SOONEST_s, upper=1e6)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Time constants in steps of half a decade, from a thirtieth of the record to three of it."""
        grid = _decades(max(scales.duration_s / 30, 2 * _SOONEST_s), 3 * scales.duration_s, 2)
        return tuple((cls(jnp.asarray(3 * scales.noise_um), jnp.asarray(constant)),) for constant in grid)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add the drift since the first sample."""
        time = _times_of(time_s, signal.values.shape[0])
        moved = -self.change_um * jnp.expm1(-time / self.time_constant_s)
        return signal.with_values(signal.values + moved, signal.before)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Add the drift since the first sample."""
        time = _instants(interval_s, len(signal.values))[:, None]
        return signal._replace(values=signal.values - self.change_um * np.expm1(-time / self.time_constant_s))


@register
class TemperatureDrift(AbstractEffect):
    r"""Expansion with a measured temperature: `y + alpha LP_tau[T - T(0)]`.

    Attributes
    ----------
    expansion_um_per_K
        `alpha`.
    time_constant_s
        `tau`, by which the frame lags behind the sensor of the temperature.
    before_um
        What is still to come, at the start of the record, of changes of the temperature before it.
    """

    name: ClassVar[str] = "thermal_drift"
    form: ClassVar[str] = "temperature"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "environment"
    strength: ClassVar[tuple[str, ...]] = ("expansion_um_per_K",)
    history: ClassVar[tuple[str, ...]] = ("before_um",)
    moved: ClassVar[str] = "K"
    needs: ClassVar[tuple[str, ...]] = ("temperature_degC",)
    fingerprint: ClassVar[str] = ThermalDrift.fingerprint
    confusions: ClassVar[tuple[str, ...]] = ThermalDrift.confusions
    experiment: ClassVar[str] = ThermalDrift.experiment
    source: ClassVar[str] = ThermalDrift.source
    view: ClassVar[View] = "time"
    column: ClassVar[str] = "temperature_degC"
    expansion_um_per_K: Float[Array, ""] = param(unit="um/K", scale=0.1)
    time_constant_s: Float[Array, ""] = param(unit="s", scale=100.0, lower=1e-3, upper=1e6)
    before_um: Float[Array, ""] = param(default=0.0, unit="um")

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Time constants in steps of half a decade, from some samples to the length of the record."""
        spread = {name: spread for name, _, spread in scales.columns}.get("temperature_degC", 0.0)
        if not spread > 0:
            return ()
        grid = _decades(max(3 * scales.interval_s, scales.duration_s / 300, 1e-3), scales.duration_s, 2)
        size = jnp.asarray(3 * scales.noise_um / spread)
        return tuple((cls(size, jnp.asarray(constant)),) for constant in grid)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add the expansion since the first sample."""
        temperature = start.columns["temperature_degC"]
        followed = self.expansion_um_per_K * _lowpass(time_s, temperature - temperature[0], self.time_constant_s)
        late = -self.before_um * jnp.expm1(-_times_of(time_s, followed.shape[0]) / self.time_constant_s)
        return signal.with_values(signal.values + followed + late, signal.before)
