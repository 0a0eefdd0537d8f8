"""PID controller whose gains a small network chooses and learns while it runs (Eq. 25-30)."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from microid._param import _as_inexact, array, param
from microid.control._base import AbstractController, ControlledPlant, ControlTask, Setting, register
from microid.control.pid import PID

_Scalar = Float[Array, ""] | float
_LEAST_GAIN = 1e-12


class GainNetwork(eqx.Module):
    r"""Three inputs, three hidden units and three outputs between 0 and 1.

    .. math:: f = g(W_2\, \phi(W_1 \theta - \rho_1) - \rho_2), \qquad \phi = \tanh, \quad g(w) = 1 / (1 + e^{-2 w})

    Eq. (25) has its thresholds outside the activations, where those of the output would shift the gains and never be
    learnt from (erratum 29); here they are inside.

    Attributes
    ----------
    hidden_weight, hidden_threshold
        Shapes `(3, 3)` and `(3,)`.
    output_weight, output_threshold
        Shapes `(3, 3)` and `(3,)`.
    """

    hidden_weight: Float[Array, "3 3"] = param(unit="1")
    hidden_threshold: Float[Array, " 3"] = param(unit="1")
    output_weight: Float[Array, "3 3"] = param(unit="1")
    output_threshold: Float[Array, " 3"] = param(unit="1")

    def __call__(self, theta: Float[Array, " 3"]) -> Float[Array, " 3"]:
        """Shares of the ranges of the three gains (Eq. 25, 28 and 29)."""
        # Sums rather than products of matrices, which cost more to call than to multiply.
        hidden = jnp.tanh(jnp.sum(self.hidden_weight * theta[None], axis=1) - self.hidden_threshold)
        return jax.nn.sigmoid(2 * (jnp.sum(self.output_weight * hidden[None], axis=1) - self.output_threshold))


class _State(eqx.Module):
    network: GainNetwork
    change: GainNetwork
    signals_um: Float[Array, " 3"]
    earlier_um: Float[Array, ""]
    feedback_V: Float[Array, ""]
    free: Float[Array, ""]


def _slope_um_per_V(task: ControlTask) -> float:
    return float(task.stage.static_gain) * (task.slope_um_per_V() or 1.0)


def _scale_um(task: ControlTask) -> float:
    return max(float(np.ptp(task.reference_um())), 1e-9) / 10


@register
class BPPID(AbstractController):
    r"""PID controller in velocity form, of which a network trained by gradient descent chooses the gains.

    .. math:: \Delta u_k = K_p \left(\Delta e_k + \frac{T}{T_i} e_k + \frac{T_d}{T} \Delta^2 e_k\right), \qquad
        (K_p, T_i, T_d) = f_{lower} + (f_{upper} - f_{lower})\, f(\theta_k)

    The inputs `(Δe, e, Δ²e) / scale`, in this order, are what multiplies the three gains in that form: this is how
    the order of Eq. (26) reads here (erratum 33). The outputs of Eq. (29) lie between 0 and 1; here they are shares
    of stated ranges (erratum 30), and the feedforward is part of the command (erratum 28).

    Weights and thresholds descend along the gradient of Eq. (30), `e² / 2`, by the chain rule through the last
    command, which led to this error: `-e dy/du du/df df/dW`. The paper does not say what `dy/du` is; here it is a
    constant, of which only the sign matters beside the learning rate. A command that was cut off teaches nothing.

    Attributes
    ----------
    network
        Before the first sample.
    gain_V_per_um, integral_time_s, derivative_time_s
        Lower and upper end of the ranges of `K_p`, `T_i` and `T_d`, shape `(2,)` each.
    interval_s
        Between two samples.
    learning_rate_per_um2
        Change of weights per gradient of Eq. (30).
    momentum
        Share of the last change that is made again.
    slope_um_per_V
        What stands for `dy/du`: the static gain of the stage, with its sign.
    scale_um
        Error that is 1 to the network.
    filter_s
        Time constant of the filter of the second difference.
    lower_V, upper_V
        Limits of the whole command. The velocity form starts from what was applied, so nothing winds up.
    """

    # The gains of the network are shares of those that it begins with, which are above zero.
    settings: ClassVar[tuple[Setting, ...]] = (
        Setting("proportional_V_per_um", lower=_LEAST_GAIN, default=0.1),
        Setting("integral_V_per_um_s", lower=_LEAST_GAIN, default=100.0),
        Setting("derivative_V_s_per_um", lower=_LEAST_GAIN, default=1e-4),
        Setting("filter_s", default=0.0),
        Setting("learning_rate_per_um2", default=0.1),
        Setting("momentum", default=0.05),
        Setting("slope_um_per_V", "um/V", default=_slope_um_per_V),
        Setting("scale_um", "um", lower=1e-9, default=_scale_um),
        Setting("seed", "1", lower=0.0, upper=2.0**53, default=0.0, whole=True),
        Setting("span", "1", lower=1.0, above=True, default=3.0, varies=False),
    )
    own: ClassVar[tuple[str, ...]] = (
        "network.hidden_weight",
        "network.hidden_threshold",
        "network.output_weight",
        "network.output_threshold",
        "learning_rate_per_um2",
        "momentum",
        "filter_s",
    )
    learns: ClassVar[bool] = True
    network: GainNetwork
    gain_V_per_um: Float[Array, " 2"] = array()
    integral_time_s: Float[Array, " 2"] = array()
    derivative_time_s: Float[Array, " 2"] = array()
    interval_s: Float[Array, ""] = array()
    learning_rate_per_um2: Float[Array, ""] = param(unit="1/um^2", scale=0.1, lower=0.0, default=0.1)
    momentum: Float[Array, ""] = param(unit="1", scale=0.1, lower=0.0, upper=1.0, default=0.05)
    slope_um_per_V: Float[Array, ""] = eqx.field(converter=_as_inexact, default=1.0)
    scale_um: Float[Array, ""] = eqx.field(converter=_as_inexact, default=1.0)
    filter_s: Float[Array, ""] = param(unit="s", scale=1e-3, lower=0.0, default=0.0)
    lower_V: Float[Array, ""] = eqx.field(converter=_as_inexact, default=-math.inf)
    upper_V: Float[Array, ""] = eqx.field(converter=_as_inexact, default=math.inf)

    @classmethod
    def of(cls, pid: PID, numbers: Mapping[str, Any], plant: ControlledPlant | None) -> Self:
        """Make it around a PID controller, with random weights; see `around`."""
        gains = (pid.proportional_V_per_um, pid.integral_V_per_um_s, pid.derivative_V_s_per_um)
        if not any(isinstance(gain, jax.core.Tracer) for gain in gains) and min(map(float, gains)) <= 0:
            raise ValueError("expected three gains above 0 to learn around, found one of 0")
        others = dict(numbers)
        key = jax.random.key(jnp.asarray(others.pop("seed"), dtype=int))
        return cls.around(pid, key, others.pop("span"), **others)

    @classmethod
    def around(cls, pid: PID, key: PRNGKeyArray, span: _Scalar = 3.0, **others: Any) -> Self:
        """Start from the gains of a PID controller, at no error, with random weights.

        Parameters
        ----------
        pid
            Its gains must be positive; its interval, limits and filter are kept.
        key
            For weights between -1/2 and 1/2.
        span
            Ranges run from the gains divided by it to the gains times it.
        others
            Further fields by name, such as `slope_um_per_V`.

        Raises
        ------
        ValueError
            If the span is not above one.
        """
        if not isinstance(span, jax.core.Tracer) and not span > 1:
            raise ValueError(f"span must be above 1, got {span}")
        kind = pid.proportional_V_per_um.dtype
        hidden, output = jax.random.uniform(key, (2, 3, 3), kind, -0.5, 0.5)
        share = (1 - 1 / span) / (span - 1 / span)
        threshold = jnp.full(3, -jnp.log(share / (1 - share)) / 2, kind)
        ends = jnp.asarray([1 / span, span], kind)
        gain = pid.proportional_V_per_um
        return cls(
            GainNetwork(hidden, jnp.zeros(3, kind), output, threshold),
            gain * ends,
            gain / pid.integral_V_per_um_s * ends,
            pid.derivative_V_s_per_um / gain * ends,
            pid.interval_s,
            **{"filter_s": pid.filter_s, "lower_V": pid.lower_V, "upper_V": pid.upper_V, **others},
        )

    def linear(self) -> PID:
        """The PID controller that the network chooses at first."""
        return self.pid(self.init())

    def init(self, rest_um: _Scalar = 0.0, feedback_V: _Scalar = 0.0) -> _State:
        """State at rest: the network and its last change, what it saw last, and the feedback."""
        zero = jnp.zeros_like(self.scale_um)
        still = jax.tree.map(jnp.zeros_like, self.network)
        return _State(self.network, still, jnp.zeros(3, zero.dtype), zero, zero + feedback_V, zero)

    def step(
        self,
        state: _State,
        reference_um: Float[Array, ""],
        measured_um: Float[Array, ""],
        feedforward_V: _Scalar = 0.0,
    ) -> tuple[_State, Float[Array, ""]]:
        """Learn from the last command, then choose the next; see `AbstractController.step`."""
        error, last = reference_um - measured_um, state.signals_um[1]
        teach = self.learning_rate_per_um2 * error * self.slope_um_per_V * state.free
        slopes = jax.grad(self._increment_V)(state.network, state.signals_um)
        change = jax.tree.map(lambda slope, old: teach * slope + self.momentum * old, slopes, state.change)
        network = jax.tree.map(jnp.add, state.network, change)
        keep = self.filter_s / (self.filter_s + self.interval_s)
        bend = keep * state.signals_um[2] + (1 - keep) * (error - 2 * last + state.earlier_um)
        signals = jnp.stack([error - last, error, bend])
        wanted = feedforward_V + state.feedback_V + self._increment_V(network, signals)
        command = jnp.clip(wanted, self.lower_V, self.upper_V)
        free = (command == wanted).astype(command.dtype)
        return _State(network, change, signals, last, command - feedforward_V, free), command

    def gains(self, state: _State) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """`K_p` in V/um, `T_i` in s and `T_d` in s that the network last chose."""
        kp, ti, td = self._gains(state.network, state.signals_um)
        return kp, ti, td

    def pid(self, state: _State) -> PID:
        """The PID controller it would be if its gains stayed as they are, for `margins`."""
        kept = {"filter_s": self.filter_s, "lower_V": self.lower_V, "upper_V": self.upper_V}
        return PID.from_times(*self.gains(state), self.interval_s, **kept)

    def _gains(self, network: GainNetwork, signals_um: Float[Array, " 3"]) -> Float[Array, " 3"]:
        ranges = jnp.stack([self.gain_V_per_um, self.integral_time_s, self.derivative_time_s])
        return ranges[:, 0] + (ranges[:, 1] - ranges[:, 0]) * network(signals_um / self.scale_um)

    def _increment_V(self, network: GainNetwork, signals_um: Float[Array, " 3"]) -> Float[Array, ""]:
        kp, ti, td = self._gains(network, signals_um)
        slope, error, bend = signals_um
        return kp * (slope + self.interval_s / ti * error + td / self.interval_s * bend)
