"""How the controllers of `microid paper` are set, from what was identified: the one place to change it.

Gains are closed formulas of the identified mode; only the places of the poles, the filters and what the networks
learn by were chosen, for each scheme and each kind of run once and for all axes: on the bench that also judges them.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import lfilter

from microid.control import BPPID, CMACPID, PID, AbstractController

INTERVAL_s = 1e-3
UPPER_V = 120.0
# Pair of poles and single pole of the loop in rad/s, and the filter of the derivative in s.
_STEP = (86.0, 27.0, 1e-3)
_TRACK = {"HC+PID": (30.0, 30.0, 8e-3), "HC+BP-PID": (30.0, 30.0, 8e-3), "HC+CMAC-PID": (25.0, 25.0, 1e-2)}
# The network starts at the gains of the PID controller, and may take them this factor up and down.
_SPAN, _NETWORK_RATE_per_um2, _NETWORK_um = 1.5, 1e-3, 20.0
_LEVELS, _GENERALISATION, _TABLE_V = (64, 64), 32, 2.0
_TRACK_RATE, _STEP_RATE = 0.005, 3e-4


@dataclass(frozen=True)
class PaperMode:
    """What the feedback is designed on: the slow mode about where the axis works, as its response was fitted."""

    natural_rad_per_s: float
    damping_ratio: float
    gain_um_per_V: float


def placed_pid(mode: PaperMode, pair_rad_per_s: float, single_rad_per_s: float, filter_s: float, step: bool) -> PID:
    """A PID controller that puts the poles of the loop on the real axis.

    The loop's polynomial `s³ + (2 zeta w + g w² Kd) s² + w² (1 + g Kp) s + g w² Ki` becomes `(s + p)² (s + q)`, with
    p and q the places of the pair and of the single pole, but for the driver, the sampling and the filter of the
    derivative. For a step, of which the feedforward already makes one, the weights of the reference are such that the
    answer is that of `p² / (s + p)²`, which does not overshoot; otherwise they are 1, for tracking without lag.
    """
    w, zeta, g = mode.natural_rad_per_s, mode.damping_ratio, mode.gain_um_per_V
    p, q = pair_rad_per_s, single_rad_per_s
    proportional = ((p**2 + 2 * p * q) / w**2 - 1) / g
    return PID(
        proportional_V_per_um=jnp.asarray(proportional),
        integral_V_per_um_s=jnp.asarray(p**2 * q / (g * w**2)),
        derivative_V_s_per_um=jnp.asarray((2 * p + q - 2 * zeta * w) / (g * w**2)),
        interval_s=jnp.asarray(INTERVAL_s),
        filter_s=jnp.asarray(filter_s),
        reference_weight=jnp.asarray(((p / w) ** 2 - 1) / (g * proportional) if step else 1.0),
        derivative_weight=jnp.asarray(0.0 if step else 1.0),
        tracking_s=jnp.asarray(0.05),
        lower_V=jnp.asarray(0.0),
        upper_V=jnp.asarray(UPPER_V),
    )


def paper_controller(scheme: str, mode: PaperMode, seed: int, largest_um: float, step: bool) -> AbstractController:
    """The controller of a scheme, for references from 0 to `largest_um` or a step; the seed is that of weights."""
    pid = placed_pid(mode, *(_STEP if step else _TRACK[scheme]), step)
    if scheme == "HC+PID":
        return pid
    if scheme == "HC+BP-PID":
        return BPPID.around(
            pid,
            jax.random.key(seed),
            _SPAN,
            slope_um_per_V=jnp.asarray(mode.gain_um_per_V),
            learning_rate_per_um2=jnp.asarray(_NETWORK_RATE_per_um2),
            scale_um=jnp.asarray(_NETWORK_um),
        )
    return CMACPID(
        pid,
        jnp.asarray(0.0),
        jnp.asarray(1.2 * largest_um if step else largest_um),
        jnp.asarray(0.6 * np.pi * largest_um),
        jnp.asarray(_STEP_RATE if step else _TRACK_RATE),
        jnp.asarray(_TABLE_V),
        levels=_LEVELS,
        generalisation=_GENERALISATION,
    )


def shown_reference(scheme: str, mode: PaperMode, reference_um: np.ndarray) -> np.ndarray:
    """A step as the controller of a scheme is shown it, shape `(n,)`.

    The velocity form of BP-PID has no weights of the reference; a filter of it does the same.
    """
    if scheme != "HC+BP-PID":
        return reference_um
    pid = placed_pid(mode, *_STEP, True)
    late = np.array([_STEP[2] + INTERVAL_s, -_STEP[2]])

    def polynomial(proportional_weight: float, derivative_weight: float) -> np.ndarray:
        proportional = proportional_weight * float(pid.proportional_V_per_um) * np.polymul([1.0, -1.0], late)
        integral = float(pid.integral_V_per_um_s) * INTERVAL_s * np.polymul([1.0, 0.0], late)
        derivative = derivative_weight * float(pid.derivative_V_s_per_um) * np.array([1.0, -2.0, 1.0])
        return proportional + integral + derivative

    weights = float(pid.reference_weight), float(pid.derivative_weight)
    return np.asarray(lfilter(polynomial(*weights), polynomial(1.0, 1.0), reference_um))
