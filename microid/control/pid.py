"""Discrete PID controller (Eq. 24)."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from microid._param import _as_inexact, array, param
from microid._part import _complex
from microid.control._base import AbstractLinearController, ControlledPlant, Setting, register

_Scalar = Float[Array, ""] | float


class _State(eqx.Module):
    integral_V: Float[Array, ""]
    derivative_V: Float[Array, ""]
    before_um: Float[Array, ""]


@register
class PID(AbstractLinearController):
    r"""PID controller with a filtered derivative, limits and anti-windup by back-calculation.

    .. math:: u = u_{ff} + K_p (b r - y) + K_i \int (r - y)\, dt + \frac{K_d s}{T_f s + 1} (c r - y)

    With `b = c = 1` and `T_f = 0` this is Eq. (24) with the `d` that its derivative lacks and the feedforward that
    the total control lacks (errata 27 and 28). Integral, derivative and filter are backward differences. What the
    limits cut off is fed back to the integral (Åström and Hägglund, *Advanced PID Control*, 2006, section 3.5).

    Attributes
    ----------
    proportional_V_per_um, integral_V_per_um_s, derivative_V_s_per_um
        Gains `K_p`, `K_i` and `K_d`; see `from_times` for `K_p`, `T_i` and `T_d`.
    interval_s
        Between two samples.
    filter_s
        Time constant `T_f` of the derivative's filter.
    reference_weight, derivative_weight
        Shares `b` and `c` of the reference in the proportional and the derivative part. Less than one: a step of the
        reference kicks less, and what answers to disturbances stays the same.
    tracking_s
        Time constant of the anti-windup; at most one interval empties the integral at once, `inf` switches it off.
    lower_V, upper_V
        Limits of the whole command.
    """

    settings: ClassVar[tuple[Setting, ...]] = (
        Setting("proportional_V_per_um", default=0.0),
        Setting("integral_V_per_um_s", default=100.0),
        Setting("derivative_V_s_per_um", default=0.0),
        Setting("filter_s", default=0.0),
        Setting("reference_weight", default=1.0),
        Setting("derivative_weight", default=1.0),
    )
    proportional_V_per_um: Float[Array, ""] = param(unit="V/um", lower=0.0)
    integral_V_per_um_s: Float[Array, ""] = param(unit="V/(um s)", scale=100.0, lower=0.0)
    derivative_V_s_per_um: Float[Array, ""] = param(unit="V s/um", scale=1e-2, lower=0.0)
    interval_s: Float[Array, ""] = array()
    filter_s: Float[Array, ""] = param(unit="s", scale=1e-3, lower=0.0, default=0.0)
    reference_weight: Float[Array, ""] = param(unit="1", default=1.0)
    derivative_weight: Float[Array, ""] = param(unit="1", default=1.0)
    tracking_s: Float[Array, ""] = eqx.field(converter=_as_inexact, default=0.0)
    lower_V: Float[Array, ""] = eqx.field(converter=_as_inexact, default=-math.inf)
    upper_V: Float[Array, ""] = eqx.field(converter=_as_inexact, default=math.inf)

    @classmethod
    def of(cls, pid: Self, numbers: Mapping[str, Any], plant: ControlledPlant | None) -> Self:
        """The PID controller itself."""
        return pid

    @classmethod
    def from_times(
        cls,
        gain_V_per_um: _Scalar,
        integral_time_s: _Scalar,
        derivative_time_s: _Scalar,
        interval_s: _Scalar,
        **others: Any,
    ) -> Self:
        """Make it from `K_p`, `T_i` and `T_d` of Eq. (24), and further fields by name."""
        gain = _as_inexact(gain_V_per_um)
        return cls(gain, gain / integral_time_s, gain * derivative_time_s, _as_inexact(interval_s), **others)

    def init(self, rest_um: _Scalar = 0.0, feedback_V: _Scalar = 0.0) -> _State:
        """State at rest: voltages of the integral and the derivative, and what the derivative saw last."""
        rest, zero = _as_inexact(rest_um), jnp.zeros_like(self.proportional_V_per_um)
        held = feedback_V + self.proportional_V_per_um * (1 - self.reference_weight) * rest
        return _State(held, zero, (self.derivative_weight - 1) * rest)

    def step(
        self,
        state: _State,
        reference_um: Float[Array, ""],
        measured_um: Float[Array, ""],
        feedforward_V: _Scalar = 0.0,
    ) -> tuple[_State, Float[Array, ""]]:
        """Choose the command; see `AbstractController.step`."""
        seen = self.derivative_weight * reference_um - measured_um
        late = self.filter_s + self.interval_s
        derivative = (
            self.filter_s * state.derivative_V + self.derivative_V_s_per_um * (seen - state.before_um)
        ) / late
        integral = state.integral_V + self.integral_V_per_um_s * self.interval_s * (reference_um - measured_um)
        proportional = self.proportional_V_per_um * (self.reference_weight * reference_um - measured_um)
        wanted = feedforward_V + proportional + integral + derivative
        command = jnp.clip(wanted, self.lower_V, self.upper_V)
        back = self.interval_s / jnp.maximum(self.tracking_s, self.interval_s)
        return _State(integral + back * (command - wanted), derivative, seen), command

    def transfer(self, z: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Feedback per error, in V/um, at points of the z-plane; without limits."""
        p, i, d, t, f = (
            _complex(x)
            for x in (
                self.proportional_V_per_um,
                self.integral_V_per_um_s,
                self.derivative_V_s_per_um,
                self.interval_s,
                self.filter_s,
            )
        )
        return p + i * t * z / (z - 1) + d * (z - 1) / ((f + t) * z - f)

    def _unlimited(self) -> Self:
        return eqx.tree_at(lambda pid: (pid.lower_V, pid.upper_V), self, (-jnp.inf, jnp.inf))

    def _driven(self, state: _State) -> _State:
        integral = jnp.where(self.integral_V_per_um_s == 0, 0, state.integral_V)
        return _State(integral, state.derivative_V, state.before_um)
