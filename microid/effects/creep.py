"""Creep: displacement that goes on after the voltage has come to rest, along the logarithm of time."""

from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, lowpass, register

# Relaxations per decade, and the decades that they cover.
_PER_DECADE, _DECADES = 2, 6
# Relaxations whose time constants begin at t0 run ahead of log10(1 + t / t0) by Euler's constant.
_AHEAD = float(np.exp(np.euler_gamma))


@register
class Creep(AbstractEffect):
    r"""Relaxations with time constants evenly spaced on a logarithmic scale, which together creep along its line.

    .. math:: w \leftarrow w + \gamma \sum_j \frac{1}{m} \, \mathrm{LP}_{\tau_j}[w - w(0)]

    With `m` of them per decade a step of one answers with nearly `gamma log10(1 + t / t0)`.

    Attributes
    ----------
    gain_per_decade
        `gamma`: creep per decade of time over the step before.
    onset_s
        `t0`, where creep begins. What lags by less than its bound is a matter of driver, sensor or mechanics.
    """

    name: ClassVar[str] = "creep"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("gain_per_decade",)
    fingerprint: ClassVar[str] = (
        "After each step the residual goes on in the direction of the step, in proportion to it, along the logarithm "
        "of time or towards a limit."
    )
    confusions: ClassVar[tuple[str, ...]] = ("thermal_drift", "mount_relaxation", "rate_dependence")
    experiment: ClassVar[str] = "Steps up and down, each held for three decades of time."
    source: ClassVar[str] = "PI piezo tutorial: dL (1 + gamma lg(t / 0.1 s)), gamma of 0.01 to 0.02"
    gain_per_decade: Float[Array, ""] = param(unit="1", scale=0.01, lower=0.0)
    onset_s: Float[Array, ""] = param(unit="s", scale=0.1, lower=0.01, upper=1e3)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Onsets in steps of a decade, from some samples to a tenth of the record."""
        first = max(10 * scales.interval_s, 0.03)
        return tuple(
            (cls(jnp.asarray(0.01), jnp.asarray(float(onset))),)
            for onset in 10 ** np.arange(np.log10(first), np.log10(scales.duration_s / 10) + 1e-9)
        )

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add creep to a displacement that was at rest."""
        moved = signal.values - signal.before
        steps = (np.arange(_DECADES * _PER_DECADE) + 0.5) / _PER_DECADE
        constants = _AHEAD * self.onset_s * jnp.asarray(10**steps, dtype=moved.dtype)
        total = jnp.sum(jax.vmap(lambda constant: lowpass(time_s, moved, constant))(constants), axis=0)
        return Signal(signal.values + self.gain_per_decade / _PER_DECADE * total, signal.before, signal.hold)


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
    """

    name: ClassVar[str] = "creep"
    form: ClassVar[str] = "kelvin_voigt"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("gain",)
    fingerprint: ClassVar[str] = Creep.fingerprint
    confusions: ClassVar[tuple[str, ...]] = Creep.confusions
    experiment: ClassVar[str] = Creep.experiment
    source: ClassVar[str] = "Kelvin-Voigt element; see Jung & Gweon, Rev. Sci. Instrum. 71 (2000) 1896"
    gain: Float[Array, ""] = param(unit="1", scale=0.01, lower=0.0)
    time_constant_s: Float[Array, ""] = param(unit="s", lower=0.02, upper=1e5)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Time constants in steps of half a decade, from some samples to the length of the record."""
        first = max(10 * scales.interval_s, 0.03)
        return tuple(
            (cls(jnp.asarray(0.01), jnp.asarray(float(constant))),)
            for constant in 10 ** np.arange(np.log10(first), np.log10(scales.duration_s) + 1e-9, 0.5)
        )

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add creep to a displacement that was at rest."""
        moved = lowpass(time_s, signal.values - signal.before, self.time_constant_s)
        return Signal(signal.values + self.gain * moved, signal.before, signal.hold)
