"""The linear parts of a stage: driver, lag, unloaded and loaded piezo, mechanics and sensor (Eq. 12-18)."""

from typing import ClassVar, Self

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from microid._linear import LinearSystem
from microid._param import param
from microid._part import AbstractLinear, _complex

_Scalar = Float[Array, ""] | float


class Driver(AbstractLinear):
    r"""Amplifier with an output resistance that charges the piezo's capacitance (Eq. 12).

    .. math:: \tau \dot u_{pzt} + u_{pzt} = k u_{in}

    The paper's Eq. (12) lacks the amplifier's gain `k`, so that its (15) times (17) is not its (18); here it stands
    in (12) (errata 19-21).

    Attributes
    ----------
    time_constant_s
        `R_c C_c`; the two are never seen apart.
    gain
        Amplification. Without a voltage monitor only its product with the gains behind it is seen.
    """

    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "V"
    time_constant_s: Float[Array, ""] = param(unit="s", scale=1e-3, lower=1e-9)
    gain: Float[Array, ""] = param(unit="1", default=1.0)

    @classmethod
    def from_circuit(cls, resistance_Ohm: _Scalar, capacitance_F: _Scalar, gain: _Scalar = 1.0) -> Self:
        """Make a driver from its resistance and the piezo's capacitance."""
        return cls(jnp.asarray(resistance_Ohm * capacitance_F), jnp.asarray(gain))

    def system(self) -> LinearSystem:
        """The driver as a differential equation; its state is its output before amplification."""
        one = jnp.ones_like(self.time_constant_s)[None]
        return LinearSystem(-1 / self.time_constant_s[None, None], one, self.gain * one, self.gain, 0 * self.gain)

    def transfer(self, s_rad_per_s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """`k / (tau s + 1)`, in V/V."""
        s = jnp.asarray(s_rad_per_s)
        return self.gain.astype(s.dtype) / (1 + self.time_constant_s.astype(s.dtype) * s)

    @property
    def poles_rad_per_s(self) -> Complex[Array, " 1"]:
        """The one pole, `-1 / tau`."""
        return _complex(-1 / self.time_constant_s[None])


class Lag(AbstractLinear):
    r"""A lag of the first order behind the hysteresis: of the charge, where the driver follows its command at once.

    .. math:: \tau \dot y + y = x

    The paper has the lag ahead of the hysteresis (`Driver`); a stage of a hysteresis and a linear plant behind it
    (Hammerstein) has this.

    Attributes
    ----------
    time_constant_s
        `tau`.
    """

    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    time_constant_s: Float[Array, ""] = param(unit="s", scale=1e-3, lower=1e-9)

    def system(self) -> LinearSystem:
        """The lag as a differential equation; its state is what it gives."""
        one = jnp.ones_like(self.time_constant_s)
        return LinearSystem(-1 / self.time_constant_s[None, None], one[None], one[None], one, 0 * one)

    def transfer(self, s_rad_per_s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """`1 / (tau s + 1)`, in um/um."""
        s = jnp.asarray(s_rad_per_s)
        return 1 / (1 + self.time_constant_s.astype(s.dtype) * s)

    @property
    def poles_rad_per_s(self) -> Complex[Array, " 1"]:
        """The one pole, `-1 / tau`."""
        return _complex(-1 / self.time_constant_s[None])


class Piezo(AbstractLinear):
    """A loaded piezo without hysteresis (Eq. 13 and 14): displacement in proportion to voltage.

    The paper maps the voltage to `w_pzt` twice, by `H(u)` in Eq. (8) and by (13)-(14) in (15), and never reconciles
    the two (erratum 18). Here a stage has one or the other: a `Preisach` or another law gives the loaded
    displacement, or this part does, and then the stage is the linear one of Eq. (18).

    Attributes
    ----------
    gain_um_per_V
        Loaded displacement per voltage.
    offset_um
        Displacement at no voltage.
    """

    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "um"
    gain_um_per_V: Float[Array, ""] = param(unit="um/V", scale=0.1)
    offset_um: Float[Array, ""] = param(unit="um", scale=10.0, default=0.0)

    @classmethod
    def from_stack(
        cls,
        layers: int,
        charge_constant_um_per_V: _Scalar,
        stack_stiffness_N_per_um: _Scalar,
        load_stiffness_N_per_um: _Scalar,
    ) -> Self:
        """Make a piezo from its layers and the stiffness it pushes against.

        Parameters
        ----------
        layers
            Number `n` of ceramic sheets.
        charge_constant_um_per_V
            Expansion `d` of one sheet.
        stack_stiffness_N_per_um, load_stiffness_N_per_um
            Stiffness of the stack, `k_pzt`, and of the mechanism at its input, `k_in`.
        """
        share = stack_stiffness_N_per_um / (stack_stiffness_N_per_um + load_stiffness_N_per_um)
        return cls(jnp.asarray(layers * charge_constant_um_per_V * share))

    def system(self) -> LinearSystem:
        """The piezo as a system without states."""
        return _memoryless(self.gain_um_per_V, self.offset_um)

    def transfer(self, s_rad_per_s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """The same gain, in um/V, at all frequencies."""
        return _constant(self.gain_um_per_V, s_rad_per_s)

    @property
    def poles_rad_per_s(self) -> Complex[Array, " 0"]:
        """None."""
        return _complex(jnp.zeros(0, dtype=self.gain_um_per_V.dtype))


class Mechanics(AbstractLinear):
    r"""Mass, spring and damper between the piezo's displacement and the stage's (Eq. 16 and 17).

    .. math:: \ddot w_{out} + 2 \zeta \omega \dot w_{out} + \omega^2 w_{out} = \omega^2 \lambda w_{pzt}

    The paper's `k_in` is a driving-point stiffness in (14) and a transfer stiffness in (16)-(17), whose static gain
    `k_in / k_w` must equal the amplification ratio lambda, which an amplifier's output stiffness does not give
    (erratum 24). Here the static gain is a parameter of its own.

    Attributes
    ----------
    natural_frequency_Hz
        Undamped natural frequency `omega / 2 pi`.
    damping_ratio
        `zeta`: 1 is critical, above it the two poles are real.
    gain
        Static gain `lambda` from the piezo's displacement to the stage's.
    """

    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    natural_frequency_Hz: Float[Array, ""] = param(unit="Hz", scale=100.0, lower=1e-6)
    damping_ratio: Float[Array, ""] = param(unit="1", scale=0.1, lower=0.0)
    gain: Float[Array, ""] = param(unit="1", default=1.0)

    @classmethod
    def from_mass(
        cls, mass_kg: _Scalar, stiffness_N_per_m: _Scalar, damping_N_s_per_m: _Scalar, gain: _Scalar = 1.0
    ) -> Self:
        """Make it from `m_w` in kg, `k_w` in N/m, `c_w` in N s/m and the static gain in um/um."""
        critical = 2 * (jnp.asarray(stiffness_N_per_m) * mass_kg) ** 0.5
        frequency = (jnp.asarray(stiffness_N_per_m) / mass_kg) ** 0.5 / (2 * jnp.pi)
        return cls(frequency, damping_N_s_per_m / critical, jnp.asarray(gain))

    def system(self) -> LinearSystem:
        """The equation of motion; its states are the displacement over the gain, and velocity over `omega`."""
        rate = 2 * jnp.pi * self.natural_frequency_Hz
        zero, one = jnp.zeros_like(rate), jnp.ones_like(rate)
        matrix = jnp.stack([jnp.stack([zero, rate]), jnp.stack([-rate, -2 * self.damping_ratio * rate])])
        read = jnp.stack([self.gain, jnp.zeros_like(self.gain)])
        return LinearSystem(matrix, jnp.stack([one, zero]), read, self.gain, 0 * self.gain)

    def transfer(self, s_rad_per_s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """`lambda / (s^2 / omega^2 + 2 zeta s / omega + 1)`, in um/um."""
        s = jnp.asarray(s_rad_per_s)
        turns = s / (2 * jnp.pi * self.natural_frequency_Hz).astype(s.dtype)
        return self.gain.astype(s.dtype) / (1 + turns * (turns + 2 * self.damping_ratio.astype(s.dtype)))

    @property
    def poles_rad_per_s(self) -> Complex[Array, " 2"]:
        """Two poles, conjugate below critical damping. At it they meet, and have no derivative."""
        damping = _complex(self.damping_ratio)
        fast = -damping - jnp.sqrt(damping * damping - 1)
        # Their product is one. The difference of damping and root would lose the digits of a slow pole.
        return _complex(2 * jnp.pi * self.natural_frequency_Hz) * jnp.stack([1 / fast, fast])


class Sensor(AbstractLinear):
    """Position sensor: reading in proportion to the displacement.

    Attributes
    ----------
    gain
        Reading per displacement, in um/um.
    offset_um
        Reading at no displacement.
    """

    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    gain: Float[Array, ""] = param(unit="1", default=1.0)
    offset_um: Float[Array, ""] = param(unit="um", scale=10.0, default=0.0)

    def system(self) -> LinearSystem:
        """The sensor as a system without states."""
        return _memoryless(self.gain, self.offset_um)

    def transfer(self, s_rad_per_s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """The same gain, in um/um, at all frequencies."""
        return _constant(self.gain, s_rad_per_s)

    @property
    def poles_rad_per_s(self) -> Complex[Array, " 0"]:
        """None."""
        return _complex(jnp.zeros(0, dtype=self.gain.dtype))


def _memoryless(gain: Float[Array, ""], offset: Float[Array, ""]) -> LinearSystem:
    none = jnp.zeros(0, dtype=gain.dtype)
    return LinearSystem(none.reshape(0, 0), none, none, gain, offset)


def _constant(gain: Float[Array, ""], s_rad_per_s: Complex[Array, "..."]) -> Complex[Array, "..."]:
    s = jnp.asarray(s_rad_per_s)
    return jnp.broadcast_to(gain.astype(s.dtype), s.shape)
