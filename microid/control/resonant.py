"""PID controller beside resonators, for references and disturbances that are sinusoids."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Complex, Float

from microid._param import _as_inexact, array, param
from microid._part import _complex
from microid._stage import Stage
from microid.control._base import AbstractLinearController, ControlledPlant, ControlTask, Setting, register
from microid.control._margins import loop_gain
from microid.control.pid import PID

_Scalar = Float[Array, ""] | float
# Resonators take up an error over so many of their periods, and are below half the sampling rate.
_PERIODS, _NYQUIST = 3.0, 0.5 - 1e-6


class _State(eqx.Module):
    pid: Any
    real_V: Float[Array, " h"]
    imag_V: Float[Array, " h"]


def _frequency_Hz(task: ControlTask) -> float:
    found = task.frequency_Hz()
    if found is None:
        raise ValueError("no period stands out in the reference, such as in a single move")
    return found


@register
class ResonantPID(AbstractLinearController):
    r"""PID controller in parallel with one resonator per frequency.

    .. math:: u = u_{ff} + u_p + \sum_h \mathrm{Re}(e^{i \varphi_h} c_h), \qquad
        c_h \leftarrow e^{i \omega_h T} c_h + K_h T (r - y)

    Its gain is infinite at each frequency, as that of an integral is at zero (the internal model principle, Francis
    and Wonham 1976): whatever is periodic there vanishes from the error, at a rate of `K |P S| / 2` where `P S` is
    what the other loop makes of a voltage. `P` is the stage with its delay and `S` the sensitivity; `φ` should undo
    the phase of `P S`. See `around`. With all harmonics of a period it is a repetitive controller.

    Attributes
    ----------
    pid
        Its limits are those of the whole command. While the command is at one of them, the resonators are not driven.
    frequency_Hz
        Shape `(h,)`, below half the sampling rate.
    resonant_V_per_um_s
        Gains `K`, shape `(h,)`.
    lead_deg
        Phases `φ`, shape `(h,)`.
    """

    settings: ClassVar[tuple[Setting, ...]] = (
        *PID.settings,
        Setting(
            "frequency_Hz",
            "Hz",
            lower=1e-9,
            upper=_NYQUIST,
            default=_frequency_Hz,
            said="the resonator is at {:.6g} Hz, the strongest in the reference",
            several=True,
            of_rate=True,
        ),
        Setting("resonant_V_per_um_s", several=True),
        Setting("lead_deg", "deg", several=True),
    )
    own: ClassVar[tuple[str, ...]] = ("frequency_Hz", "resonant_V_per_um_s", "lead_deg")
    pid: PID
    frequency_Hz: Float[Array, " h"] = array()
    resonant_V_per_um_s: Float[Array, " h"] = param(unit="V/(um s)", scale=100.0, lower=0.0)
    lead_deg: Float[Array, " h"] = array()

    def __check_init__(self) -> None:
        """Refuse resonators of which not all is known."""
        shapes = {x.shape for x in (self.frequency_Hz, self.resonant_V_per_um_s, self.lead_deg)}
        if len(shapes) != 1 or self.frequency_Hz.ndim != 1:
            raise ValueError(f"frequencies, gains and leads need one shape (h,), got {sorted(shapes)}")

    @classmethod
    def of(cls, pid: PID, numbers: Mapping[str, Any], plant: ControlledPlant | None) -> Self:
        """Put resonators beside a PID controller; gains and leads that are not given are found as by `around`."""
        fields = {name: jnp.atleast_1d(_as_inexact(value)) for name, value in numbers.items()}
        if plant is not None and len(fields) < len(cls.own):
            frequency = fields["frequency_Hz"]
            rate, slope = jnp.min(frequency) / _PERIODS, plant.slope_um_per_V
            made = cls.around(pid, plant.stage, frequency, rate, delay=plant.delay, slope_um_per_V=slope)
            fields = {name: getattr(made, name) for name in cls.own} | fields
        return cls(pid, **fields)

    @classmethod
    def around(
        cls,
        pid: PID,
        stage: Stage,
        frequency_Hz: Float[Array, " h"],
        rate_per_s: _Scalar,
        *,
        delay: int = 0,
        slope_um_per_V: _Scalar | None = None,
    ) -> Self:
        """Choose gains and leads by what a loop makes of a voltage at each frequency.

        Parameters
        ----------
        pid
            Of a stable loop.
        stage, delay, slope_um_per_V
            See `margins`.
        frequency_Hz
            Shape `(h,)`.
        rate_per_s
            How fast the error at each frequency is to vanish, to first order: slowly beside the loop itself.

        Raises
        ------
        ValueError
            See `margins`.
        """
        frequency = jnp.atleast_1d(_as_inexact(frequency_Hz))
        unit = PID.from_times(1.0, math.inf, 0.0, pid.interval_s)
        slope = None if slope_um_per_V is None else _as_inexact(slope_um_per_V)
        plant = loop_gain(unit, stage, frequency, delay=delay, slope_um_per_V=slope)
        turn = 2 * jnp.pi * frequency * pid.interval_s
        path = plant / (1 + pid.transfer(lax.complex(jnp.cos(turn), jnp.sin(turn))) * plant)
        return cls(pid, frequency, 2 * rate_per_s / jnp.abs(path), -jnp.rad2deg(jnp.angle(path)))

    @property
    def interval_s(self) -> Float[Array, ""]:
        """Between two samples."""
        return self.pid.interval_s

    def init(self, rest_um: _Scalar = 0.0, feedback_V: _Scalar = 0.0) -> _State:
        """State at rest: that of the PID controller, and resonators without motion."""
        still = jnp.zeros_like(self.resonant_V_per_um_s)
        return _State(self.pid.init(rest_um, feedback_V), still, still)

    def step(
        self,
        state: _State,
        reference_um: Float[Array, ""],
        measured_um: Float[Array, ""],
        feedforward_V: _Scalar = 0.0,
    ) -> tuple[_State, Float[Array, ""]]:
        """Choose the command; see `AbstractController.step`."""
        turn, lead = 2 * jnp.pi * self.frequency_Hz * self.interval_s, jnp.deg2rad(self.lead_deg)
        real = jnp.cos(turn) * state.real_V - jnp.sin(turn) * state.imag_V
        imag = jnp.sin(turn) * state.real_V + jnp.cos(turn) * state.imag_V
        push = self.resonant_V_per_um_s * self.interval_s * (reference_um - measured_um)
        known = feedforward_V + jnp.sum(jnp.cos(lead) * (real + push) - jnp.sin(lead) * imag)
        pid, command = self.pid.step(state.pid, reference_um, measured_um, known)
        free = (command > self.pid.lower_V) & (command < self.pid.upper_V)
        return _State(pid, real + jnp.where(free, push, 0), imag), command

    def transfer(self, z: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Feedback per error, in V/um, at points of the z-plane; without limits."""
        turn, lead = 2 * jnp.pi * self.frequency_Hz * self.interval_s, jnp.deg2rad(self.lead_deg)
        total = self.pid.transfer(z)
        numbers = (self.resonant_V_per_um_s * self.interval_s, jnp.cos(lead), jnp.cos(turn - lead), jnp.cos(turn))
        # One after the other: there are few, and z has any shape.
        for gain, ahead, back, own in zip(*(_complex(x) for x in numbers), strict=True):
            total = total + gain * z * (z * ahead - back) / (z * z - 2 * z * own + 1)
        return total

    def _unlimited(self) -> Self:
        return eqx.tree_at(lambda x: x.pid, self, self.pid._unlimited())

    def _driven(self, state: _State) -> _State:
        live = self.resonant_V_per_um_s != 0
        real, imag = (jnp.where(live, x, 0) for x in (state.real_V, state.imag_V))
        return _State(self.pid._driven(state.pid), real, imag)
