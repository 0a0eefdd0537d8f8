"""Zero shift: at an instant the reading jumps, and stays there."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._in_numpy import _instants, _NumpySignal
from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, View, _times_of, register

_INSTANTS = 24


@register
class ZeroShift(AbstractEffect):
    r"""One jump, along a line between two readings or for longer: `y + a min(max((t - b) / sqrt(r^2 + h^2), 0), 1)`.

    `h` is the sampling interval.

    Attributes
    ----------
    shift_um
        `a`, by how much the reading is off from then on.
    after_s
        `b`, when it began.
    rise_s
        `r`, how long it took.
    """

    name: ClassVar[str] = "zero_shift"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "environment"
    strength: ClassVar[tuple[str, ...]] = ("shift_um",)
    per_run: ClassVar[bool] = True
    repeats: ClassVar[bool] = True
    rise: ClassVar[str] = "rise_s"
    fingerprint: ClassVar[str] = "The residual jumps at one instant and stays there, whatever the command does."
    confusions: ClassVar[tuple[str, ...]] = ("mount_relaxation", "thermal_drift")
    experiment: ClassVar[str] = "The same record again with nothing touched: a jump comes elsewhere, or not at all."
    source: ClassVar[str] = (
        "zero shift of a transducer, a mount that slips, a static load, or fringes that an interferometer lost, of a "
        "half or a quarter of its wavelength each (estimate)"
    )
    view: ClassVar[View] = "time"
    column: ClassVar[str] = "the state of the interferometer's counter, or a second sensor"
    shift_um: Float[Array, ""] = param(unit="um", scale=0.1)
    after_s: Float[Array, ""] = param(unit="s", scale=1.0, lower=0.0)
    rise_s: Float[Array, ""] = param(unit="s", scale=1e-2, lower=0.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """A jump at one of many instants of the longest record, and of the shortest."""
        size, rise = jnp.asarray(3 * scales.noise_um), jnp.asarray(scales.interval_s)
        each = np.arange(1, _INSTANTS) / _INSTANTS
        instants = np.unique(np.outer([scales.shortest_s, scales.duration_s], each))
        return tuple((cls(size, jnp.asarray(float(instant)), rise),) for instant in instants)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add the jump from its instant on."""
        time = _times_of(time_s, signal.values.shape[0])
        width = time[1] - time[0] if time.shape[0] > 1 else jnp.ones_like(self.after_s)
        share = jnp.clip((time - self.after_s) / jnp.hypot(width, self.rise_s), 0.0, 1.0)
        return signal.with_values(signal.values + self.shift_um * share, signal.before)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Add the jump from its instant on."""
        time = _instants(interval_s, len(signal.values))[:, None]
        share = np.clip((time - self.after_s) / np.sqrt(interval_s[0] ** 2 + self.rise_s**2), 0.0, 1.0)
        return signal._replace(values=signal.values + self.shift_um * share)
