"""Mount relaxation: the sensor's mount settles after it has been touched."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._in_numpy import _instants, _NumpySignal
from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, View, _times_of, register
from microid.effects._grids import _decades


@register
class MountRelaxation(AbstractEffect):
    r"""Settling towards a limit: `y + a (1 - exp(-t / tau))`.

    Attributes
    ----------
    change_um
        `a`, what is still to come at the start of the record.
    time_constant_s
        `tau`.
    """

    name: ClassVar[str] = "mount_relaxation"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "environment"
    strength: ClassVar[tuple[str, ...]] = ("change_um",)
    per_run: ClassVar[bool] = True
    fingerprint: ClassVar[str] = (
        "The residual drifts whatever the command and the temperature do, and more slowly the longer the set-up has "
        "stood."
    )
    confusions: ClassVar[tuple[str, ...]] = ("thermal_drift", "creep", "aging")
    experiment: ClassVar[str] = "A record at rest right after the set-up was touched, with the temperature."
    source: ClassVar[str] = "Applied Optics 63 (2024) 8359, adhesive gaps; 5 to 500 nm, minutes to days (estimate)"
    view: ClassVar[View] = "time"
    column: ClassVar[str] = "temperature_degC"
    change_um: Float[Array, ""] = param(unit="um", scale=0.1)
    time_constant_s: Float[Array, ""] = param(unit="s", scale=100.0, lower=1e-3, upper=1e6)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Time constants in steps of half a decade, from a thirtieth of the record to three of it."""
        grid = _decades(scales.duration_s / 30, 3 * scales.duration_s, 2)
        return tuple((cls(jnp.asarray(3 * scales.noise_um), jnp.asarray(constant)),) for constant in grid)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add what has settled since the first sample."""
        time = _times_of(time_s, signal.values.shape[0])
        moved = -self.change_um * jnp.expm1(-time / self.time_constant_s)
        return signal.with_values(signal.values + moved, signal.before)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Add what has settled since the first sample."""
        time = _instants(interval_s, len(signal.values))[:, None]
        return signal._replace(values=signal.values - self.change_um * np.expm1(-time / self.time_constant_s))


@register
class LogarithmicMountRelaxation(AbstractEffect):
    r"""Settling along the logarithm of time: `y + a log10(1 + t / t_m)`.

    Attributes
    ----------
    change_per_decade_um
        `a`.
    age_s
        `t_m`, for how long the mount had stood when the record started.
    """

    name: ClassVar[str] = "mount_relaxation"
    form: ClassVar[str] = "logarithmic"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "environment"
    strength: ClassVar[tuple[str, ...]] = ("change_per_decade_um",)
    per_run: ClassVar[bool] = True
    fingerprint: ClassVar[str] = MountRelaxation.fingerprint
    confusions: ClassVar[tuple[str, ...]] = MountRelaxation.confusions
    experiment: ClassVar[str] = MountRelaxation.experiment
    source: ClassVar[str] = MountRelaxation.source
    view: ClassVar[View] = "time"
    column: ClassVar[str] = "temperature_degC"
    change_per_decade_um: Float[Array, ""] = param(unit="um", scale=0.1)
    age_s: Float[Array, ""] = param(unit="s", scale=10.0, lower=1e-3, upper=1e7)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Ages in steps of a decade, from a thousandth of the record to its length."""
        grid = _decades(max(scales.duration_s / 1000, 2e-3), scales.duration_s)
        return tuple((cls(jnp.asarray(3 * scales.noise_um), jnp.asarray(age)),) for age in grid)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add what has settled since the first sample."""
        time = _times_of(time_s, signal.values.shape[0])
        moved = self.change_per_decade_um * jnp.log1p(time / self.age_s) / jnp.log(10.0)
        return signal.with_values(signal.values + moved, signal.before)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Add what has settled since the first sample."""
        time = _instants(interval_s, len(signal.values))[:, None]
        moved = self.change_per_decade_um * np.log1p(time / self.age_s) / np.log(10.0)
        return signal._replace(values=signal.values + moved)
