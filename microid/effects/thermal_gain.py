"""Thermal gain: the piezo's gain changes with its temperature, measured or from its own losses."""

from abc import abstractmethod
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import _as_inexact, array, param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, View, _lowpass, _rate_of, _times_of, register
from microid.effects._grids import _decades

# Heat takes about so long through a millimetre of ceramic (d^2 / (pi^2 a), of a thermal diffusivity a of 0.5 mm^2/s):
# no stack follows it sooner.
_SOONEST_s = 0.2


@register
class ThermalGain(AbstractEffect):
    r"""A gain in proportion to a measured temperature.

    .. math:: w_0 + (w - w_0) (1 + \beta \, \mathrm{LP}_\tau[T - T_0])

    Attributes
    ----------
    gain_per_K
        `beta`.
    time_constant_s
        `tau`, by which the piezo lags behind the sensor of the temperature.
    before_K
        By how much the piezo was warmer than that sensor at the start of the record.
    reference_degC
        `T0`, given.
    zero_um
        `w0`, the displacement that stays, given.
    """

    name: ClassVar[str] = "thermal_gain"
    form: ClassVar[str] = "temperature"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("gain_per_K",)
    history: ClassVar[tuple[str, ...]] = ("before_K",)
    needs: ClassVar[tuple[str, ...]] = ("temperature_degC",)
    fingerprint: ClassVar[str] = (
        "The residual is in proportion to the position, by a factor that grows with heavy driving or with the "
        "temperature and decays in pauses."
    )
    confusions: ClassVar[tuple[str, ...]] = ("aging", "accommodation", "creep", "thermal_drift", "curved_hysteresis")
    experiment: ClassVar[str] = "A slow loop, a burst of heavy driving, the same loop, a pause, and the same loop."
    source: ClassVar[str] = "PI piezo tutorial, temperature effects; 0.1 to 0.5 % per K (estimate)"
    view: ClassVar[View] = "time"
    column: ClassVar[str] = "temperature_degC"
    gain_per_K: Float[Array, ""] = param(unit="1/K", scale=1e-3)
    time_constant_s: Float[Array, ""] = param(unit="s", scale=100.0, lower=1e-3, upper=1e6)
    reference_degC: Float[Array, ""] = array()
    zero_um: Float[Array, ""] = eqx.field(converter=_as_inexact, default=0.0)
    before_K: Float[Array, ""] = param(default=0.0, unit="K")

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Time constants in steps of half a decade, from some samples to the length of the record."""
        found = {name: (mean, spread) for name, mean, spread in scales.columns}
        mean, spread = found.get("temperature_degC", (0.0, 0.0))
        if not spread > 0:
            return ()
        grid = _decades(max(3 * scales.interval_s, scales.duration_s / 300, 1e-3), scales.duration_s, 2)
        return tuple((cls(jnp.asarray(1e-3), jnp.asarray(constant), jnp.asarray(mean)),) for constant in grid)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Scale the displacement."""
        above = _lowpass(time_s, start.columns["temperature_degC"] - self.reference_degC, self.time_constant_s)
        late = self.before_K * jnp.exp(-_times_of(time_s, above.shape[0]) / self.time_constant_s)
        more = self.gain_per_K * (above + late)
        before = signal.before + more[0] * (signal.before - self.zero_um)
        return signal.with_values(signal.values + more * (signal.values - self.zero_um), before)


class _AbstractSelfHeating(AbstractEffect):
    """A gain in proportion to the temperature that the piezo's own losses bring about; see its two forms."""

    name: ClassVar[str] = "thermal_gain"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("gain",)
    history: ClassVar[tuple[str, ...]] = ("before",)
    fingerprint: ClassVar[str] = ThermalGain.fingerprint
    confusions: ClassVar[tuple[str, ...]] = ThermalGain.confusions
    experiment: ClassVar[str] = ThermalGain.experiment
    view: ClassVar[View] = "time"
    column: ClassVar[str] = "temperature_degC"
    gain: AbstractVar[Float[Array, ""]]
    time_constant_s: AbstractVar[Float[Array, ""]]
    zero_um: AbstractVar[Float[Array, ""]]
    before: AbstractVar[Float[Array, ""]]

    @abstractmethod
    def losses(
        self, time_s: Times, moved_um: Float[Array, " t"], command_V: Float[Array, " t"]
    ) -> Float[Array, " t"]:
        """Losses over the reference, of a displacement under a command, shape `(t,)`."""

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Scale the displacement."""
        command = start.command.values
        if command.shape[0] == 1:
            return signal
        losses = self.losses(time_s, signal.values, command)
        # At rest there are none.
        heat = _lowpass(time_s, losses.at[0].set(0), self.time_constant_s)
        heat = heat + self.before * jnp.exp(-_times_of(time_s, heat.shape[0]) / self.time_constant_s)
        before = signal.before + self.gain * heat[0] * (signal.before - self.zero_um)
        return signal.with_values(signal.values + self.gain * heat * (signal.values - self.zero_um), before)


def _heating_constants(scales: Scales) -> list[float]:
    """Time constants in steps of half a decade, from a thirtieth of the record, or what heat takes, to ten."""
    return list(_decades(max(scales.duration_s / 30, 2 * _SOONEST_s), 10 * scales.duration_s, 2))


@register
class SelfHeating(_AbstractSelfHeating):
    r"""A gain in proportion to the temperature that the piezo's hysteresis brings about.

    .. math:: w_0 + (w - w_0) (1 + b (\mathrm{LP}_\tau[|u \dot u|] / p_0 + h e^{-t / \tau}))

    Attributes
    ----------
    gain
        `b`: relative change of the gain in the end under losses of `p0`.
    time_constant_s
        `tau`.
    reference_V2_per_s
        `p0`, given.
    zero_um
        `w0`, the displacement that stays, given.
    before
        `h`: how warm it was when the record began, as losses of so many times `p0` make it in the end.
    """

    form: ClassVar[str] = "self_heating"
    source: ClassVar[str] = (
        "Noliac tutorial on heat dissipation: 30 to 70 K; Actuators 10 (2021) 297: amplitude 15 % more at 10 kHz"
    )
    gain: Float[Array, ""] = param(unit="1", scale=0.01)
    time_constant_s: Float[Array, ""] = param(unit="s", scale=100.0, lower=_SOONEST_s, upper=1e6)
    reference_V2_per_s: Float[Array, ""] = array()
    zero_um: Float[Array, ""] = eqx.field(converter=_as_inexact, default=0.0)
    before: Float[Array, ""] = param(default=0.0, unit="1")

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Time constants in steps of half a decade, from a thirtieth of the record, or what heat takes, to ten."""
        losses = max(abs(scales.lower_V), abs(scales.upper_V)) * scales.fastest_V_per_s / 2
        each = _heating_constants(scales) if losses > 0 else []
        return tuple((cls(jnp.asarray(0.01), jnp.asarray(constant), jnp.asarray(losses)),) for constant in each)

    def losses(
        self, time_s: Times, moved_um: Float[Array, " t"], command_V: Float[Array, " t"]
    ) -> Float[Array, " t"]:
        """Losses of a hysteresis: so much for every way that the command goes."""
        return jnp.abs(command_V * _rate_of(time_s, command_V)) / self.reference_V2_per_s


@register
class ResistiveHeating(_AbstractSelfHeating):
    r"""A gain in proportion to the temperature that currents bring about in the piezo's electrodes and leads.

    .. math:: w_0 + (w - w_0) (1 + b (\mathrm{LP}_\tau[\dot w^2] / v_0^2 + h e^{-t / \tau}))

    Attributes
    ----------
    gain, time_constant_s, zero_um, before
        As of `SelfHeating`.
    reference_um_per_s
        `v0`, given.
    """

    form: ClassVar[str] = "resistive_heating"
    source: ClassVar[str] = "Joule's law, the current of a capacitance being in proportion to the rate of its voltage"
    gain: Float[Array, ""] = param(unit="1", scale=0.01)
    time_constant_s: Float[Array, ""] = param(unit="s", scale=100.0, lower=_SOONEST_s, upper=1e6)
    reference_um_per_s: Float[Array, ""] = array()
    zero_um: Float[Array, ""] = eqx.field(converter=_as_inexact, default=0.0)
    before: Float[Array, ""] = param(default=0.0, unit="1")

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Time constants in steps of half a decade, from a thirtieth of the record, or what heat takes, to ten."""
        range_V = max(scales.upper_V - scales.lower_V, 1e-300)
        fast = scales.fastest_V_per_s / range_V * scales.stroke_um / 2
        each = _heating_constants(scales) if fast > 0 else []
        return tuple((cls(jnp.asarray(0.01), jnp.asarray(constant), jnp.asarray(fast)),) for constant in each)

    def losses(
        self, time_s: Times, moved_um: Float[Array, " t"], command_V: Float[Array, " t"]
    ) -> Float[Array, " t"]:
        """Losses of a current: charge goes with the displacement, and follows the command behind the driver alone."""
        return (_rate_of(time_s, moved_um) / self.reference_um_per_s) ** 2


@register
class ApproachingGain(AbstractEffect):
    r"""A gain that approaches its balance while the stage does, where no temperature was measured.

    .. math:: w_0 + (w - w_0) (1 + g e^{-t / \tau})

    Attributes
    ----------
    gain
        `g`: by which part the gain is larger at the first sample than in balance.
    time_constant_s
        `tau`.
    zero_um
        `w0`, the displacement that stays, given.
    """

    name: ClassVar[str] = "thermal_gain"
    form: ClassVar[str] = "exponential"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("gain",)
    unless: ClassVar[tuple[str, ...]] = ("temperature_degC",)
    per_run: ClassVar[bool] = True
    fingerprint: ClassVar[str] = ThermalGain.fingerprint
    confusions: ClassVar[tuple[str, ...]] = ThermalGain.confusions
    experiment: ClassVar[str] = ThermalGain.experiment
    source: ClassVar[str] = "Newton's law of cooling; 0.1 to 0.5 % per K and time constants of minutes are estimates"
    view: ClassVar[View] = "time"
    column: ClassVar[str] = "temperature_degC"
    gain: Float[Array, ""] = param(unit="1", scale=0.01)
    time_constant_s: Float[Array, ""] = param(unit="s", scale=100.0, lower=_SOONEST_s, upper=1e6)
    zero_um: Float[Array, ""] = eqx.field(converter=_as_inexact, default=0.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Time constants in steps of half a decade, from a thirtieth of the record to three of it."""
        grid = _decades(max(scales.duration_s / 30, 2 * _SOONEST_s), 3 * scales.duration_s, 2)
        return tuple((cls(jnp.asarray(0.01), jnp.asarray(constant)),) for constant in grid)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Scale the displacement."""
        time = _times_of(time_s, signal.values.shape[0])
        more = self.gain * jnp.exp(-time / self.time_constant_s)
        before = signal.before + self.gain * (signal.before - self.zero_um)
        return signal.with_values(signal.values + more * (signal.values - self.zero_um), before)
