"""A positioner with several piezos and several axes as a sum of vibration modes, with or without hysteresis."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Complex, Float

from microid._linear import Hold, LinearSystem
from microid._param import array, param
from microid._part import _complex
from microid.hysteresis._play import _plays


class Modes(eqx.Module):
    r"""Vibration modes that `m` voltages excite and `p` displacements show.

    .. math::
        G(s) = e^{-s \tau} \left( R + \sum_k
        \frac{G_k + Q_k s / \omega_k}{s^2 / \omega_k^2 + 2 \zeta_k s / \omega_k + 1} \right)

    The modal model of experimental modal analysis, see Ewins, *Modal Testing* (2000), chapter 2, with residues in the
    units of a static gain. Real modes have no `Q_k`.

    Attributes
    ----------
    natural_frequency_Hz
        Undamped natural frequencies, shape `(k,)`.
    damping_ratio
        Shape `(k,)`.
    gain_um_per_V
        Static gain of each mode, `G_k`, shape `(k, p, m)`. Where damping does not couple the modes, each is of rank
        one: the mode's shape times how much each piezo takes part.
    quadrature_um_per_V
        Gain by the rate, `Q_k`, of modes whose damping is not in proportion; shape `(k, p, m)`.
    residual_um_per_V
        What all modes above the band add, `R`, shape `(p, m)`.
    delay_s
        Delay of amplifier, sensor and converters together; without a bound, so that estimates scatter about zero.
    """

    natural_frequency_Hz: Float[Array, " k"] = param(unit="Hz", scale=100.0, lower=1e-6)
    damping_ratio: Float[Array, " k"] = param(unit="1", scale=0.01, lower=0.0)
    gain_um_per_V: Float[Array, "k p m"] = param(unit="um/V", scale=0.1)
    quadrature_um_per_V: Float[Array, "k p m"] = param(unit="um/V", scale=0.1)
    residual_um_per_V: Float[Array, "p m"] = param(unit="um/V", scale=0.1)
    delay_s: Float[Array, ""] = param(unit="s", scale=1e-4, default=0.0)

    def __check_init__(self) -> None:
        """Refuse shapes that do not belong together."""
        count, gain = self.natural_frequency_Hz.shape, self.gain_um_per_V.shape
        others = (self.damping_ratio.shape, self.quadrature_um_per_V.shape, self.residual_um_per_V.shape)
        if len(count) != 1 or len(gain) != 3 or gain[:1] != count or others != (count, gain, gain[1:]):
            raise ValueError(
                "expected shapes (k,), (k,), (k, p, m), (k, p, m) and (p, m), got "
                f"{count}, {others[0]}, {gain}, {others[1]} and {others[2]}"
            )

    @property
    def static_gain_um_per_V(self) -> Float[Array, "p m"]:
        """Displacements per voltages at rest, shape `(p, m)`."""
        return self.residual_um_per_V + jnp.sum(self.gain_um_per_V, axis=0)

    @property
    def poles_rad_per_s(self) -> Complex[Array, "k 2"]:
        """Pairs of poles, shape `(k, 2)`; critical damping, where they meet, has no derivative."""
        damping = _complex(self.damping_ratio)
        root = jnp.sqrt(damping * damping - 1)
        rate = _complex(2 * jnp.pi * self.natural_frequency_Hz)
        return rate[:, None] * jnp.stack([root - damping, -root - damping], axis=1)

    def frequency_response(self, frequency_Hz: Float[Array, "*f"]) -> Complex[Array, "*f p m"]:
        """Displacements per voltages, in um/V, shape `(..., p, m)`, at frequencies of shape `(...)`."""
        frequency = jnp.asarray(frequency_Hz)
        ratio = jnp.tensordot(frequency, 1 / self.natural_frequency_Hz, 0)
        lost = jnp.tensordot(frequency, 2 * self.damping_ratio / self.natural_frequency_Hz, 0)
        mode = 1 / lax.complex(1 - ratio * ratio, lost)
        moving = lax.complex(jnp.zeros_like(ratio), ratio) * mode
        turned = -2 * jnp.pi * frequency * self.delay_s
        late = lax.complex(jnp.cos(turned), jnp.sin(turned))
        prompt = jnp.tensordot(mode, _complex(self.gain_um_per_V), 1)
        prompt += jnp.tensordot(moving, _complex(self.quadrature_um_per_V), 1)
        prompt += jnp.broadcast_to(_complex(self.residual_um_per_V), prompt.shape)
        return late[..., None, None] * prompt

    def respond_periodically(self, voltage_V: Float[Array, "t m"], interval_s: float) -> Float[Array, "t p"]:
        """Steady state under one period of voltages without content from half the sampling rate on.

        Parameters
        ----------
        voltage_V
            One period at even times, shape `(t, m)`.
        interval_s
            Between samples.

        Returns
        -------
        Array
            Displacements in um, shape `(t, p)`: exact for a multisine.
        """
        lines_Hz = jnp.fft.rfftfreq(voltage_V.shape[0], jnp.asarray(interval_s, dtype=voltage_V.dtype))
        moved = jnp.einsum("fpm,fm->fp", self.frequency_response(lines_Hz), jnp.fft.rfft(voltage_V, axis=0))
        return jnp.fft.irfft(moved, voltage_V.shape[0], axis=0)

    def __call__(
        self, interval_s: float, voltage_V: Float[Array, "t m"], before_V: Float[Array, " m"], hold: Hold = "first"
    ) -> Float[Array, "t p"]:
        """Respond to sampled voltages from rest, exactly for the given hold and any delay.

        Parameters
        ----------
        interval_s
            Between samples. No derivative flows into it, nor into the delay.
        voltage_V
            Shape `(t, m)`.
        before_V
            The constant voltages under which the modes came to rest before the first sample, shape `(m,)`.
        hold
            `"first"`: voltages run in lines from sample to sample; `"zero"`: they keep each sample until the next.

        Returns
        -------
        Array
            Displacements in um, shape `(t, p)`.
        """
        late = lax.stop_gradient(self.delay_s / interval_s)
        whole = jnp.ceil(late)
        rest = whole - late
        # Every interval is cut where the delayed output is read.
        samples = voltage_V.shape[0]
        at = jnp.arange(samples, dtype=voltage_V.dtype)
        time_s = interval_s * jnp.stack([at, at + rest], axis=1).ravel()
        following = voltage_V if hold == "zero" else jnp.concatenate([voltage_V[1:], voltage_V[-1:]])
        between = voltage_V + rest * (following - voltage_V)
        cut = jnp.stack([voltage_V, between], axis=1).reshape(2 * samples, -1)

        def one(frequency: Array, damping: Array, read: Array, signal: Array, before: Array) -> Array:
            # States are displacement, and velocity over the natural rate; only the first has a static gain.
            rate, zero = 2 * jnp.pi * frequency, jnp.zeros_like(frequency)
            matrix = jnp.stack([jnp.stack([zero, rate]), jnp.stack([-rate, -2 * damping * rate])])
            system = LinearSystem(matrix, jnp.eye(2, dtype=read.dtype)[0], read, read[0], zero)
            return system.respond(time_s, signal, before, hold)

        each = jax.vmap(one, (None, None, None, 1, 0))
        each = jax.vmap(jax.vmap(each, (None, None, 0, None, None)), (0, 0, None, None, None))
        reads = jnp.eye(2, dtype=voltage_V.dtype)
        modal = each(self.natural_frequency_Hz, self.damping_ratio, reads, cut, before_V)
        gains = jnp.stack([self.gain_um_per_V, self.quadrature_um_per_V], axis=1)
        moved = jnp.einsum("kqmt,kqpm->tp", modal, gains) + cut @ self.residual_um_per_V.T
        first = self.static_gain_um_per_V @ before_V
        taken = at.astype(jnp.int32) - whole.astype(jnp.int32)
        return jnp.where((taken >= 0)[:, None], moved[1::2][jnp.maximum(taken, 0)], first[None])


class HystereticModes(eqx.Module):
    r"""Modes that voltages drive with hysteresis: plays of each, after Prandtl and Ishlinskii, excite them too.

    .. math:: Y = \sum_i G_{i0} U_i + \sum_i \sum_k G_{ik}\, P_{r_k}[u_i]

    All `G` share their poles. A law of Prandtl and Ishlinskii ahead of each input is the special case in which
    `G_{ik}` is a multiple of `G_{i0}`; here a play may excite one mode more than another.

    Attributes
    ----------
    modes
        Of `m (1 + K)` inputs: each voltage is followed by its plays.
    threshold_V
        Thresholds of the plays, the same for all inputs, shape `(K,)`; not fitted.
    """

    modes: Modes
    threshold_V: Float[Array, " K"] = array()

    def respond_periodically(
        self, voltage_V: Float[Array, "t m"], interval_s: float, oversampling: int = 8
    ) -> Float[Array, "t p"]:
        """Steady state in um under one period of voltages; see `Modes.respond_periodically` and `with_plays`."""
        return self.modes.respond_periodically(with_plays(voltage_V, self.threshold_V, oversampling), interval_s)


def with_plays(
    voltage_V: Float[Array, "t m"], threshold_V: Float[Array, " K"], oversampling: int = 8
) -> Float[Array, "t m_K"]:
    """Voltages and their plays in steady state over one period, without what lies beyond half the sampling rate.

    Parameters
    ----------
    voltage_V
        One period at even times, band-limited, shape `(t, m)`.
    threshold_V
        Shape `(K,)`, in V, not negative.
    oversampling
        How much finer the grid is on which the plays move, since they turn between the samples.

    Returns
    -------
    Array
        Each voltage followed by its plays, in V, shape `(t, m (1 + K))`.
    """
    samples = voltage_V.shape[0]
    fine = samples * oversampling
    path = jnp.fft.irfft(jnp.fft.rfft(voltage_V, axis=0), fine, axis=0) * oversampling
    # One period wipes out whatever came before it, but for plays that the voltage never moves twice.
    twice = jnp.concatenate([path, path])
    plays = jax.vmap(lambda signal: _plays(signal, threshold_V), 1, 1)(twice)[fine:]
    lines = jnp.fft.rfft(plays, axis=0)[: samples // 2 + 1]
    moved = jnp.fft.irfft(lines, samples, axis=0) / oversampling
    return jnp.concatenate([voltage_V[:, :, None], moved], axis=2).reshape(samples, -1)
