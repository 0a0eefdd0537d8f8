"""Hysteresis that is no Preisach operator: a part of it follows the law of Bouc and Wen."""

from typing import Any, ClassVar, Self, TypeAlias

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import array, param
from microid._part import AbstractPart, Scene, Signal, innermost
from microid._preisach import Preisach
from microid.effects._base import AbstractEffect, Place, Scales, register
from microid.effects._grids import _decades
from microid.effects._legendre import _legendre

# A move of the voltage longer than this part of the length is divided into so many steps of the classical Runge-Kutta
# rule; any other is one.
_LONG, _FINE = 0.1, 16
# A move over the length, gain and loss at its ends and in its middle, and the places of its ends in the range.
_Move: TypeAlias = tuple[Array, Array, Array, Array]
_SMALL = 1e-12
# Each polynomial is at most so much of the logarithm of gain or loss.
_VARIED = 3.0
# So many places in the range at which the farthest limit of the state is looked for.
_PLACES = 129


@register
class BoucWenHysteresis(AbstractEffect):
    r"""A hysteresis beside whose displacement `w` a state of Bouc and Wen stays behind the voltage: `w - a z`.

    .. math::
        l \frac{dz}{du} = g(u) \left(1 - \frac{p(u)}{g(u)} |z|^n \left(1 - \sigma
        + \sigma\, \mathrm{sgn}(z \dot u) + \phi\, (\mathrm{sgn}\, \dot u + \mathrm{sgn}\, z)\right)\right)^i

    It forgets reversals by and by, where a Preisach operator wipes them out or keeps them: its minor loops do not
    close, and those between the same voltages differ. The logarithms of gain and loss, `g` and `p`, are sums of
    Legendre's polynomials over the range of the voltage. With an `i` of one it is Bouc and Wen's law. With `sigma`
    and `n` of one it is Dahl's, whose exponent is `i`, and with a gain that varies that of Coleman and Hodgdon, whose
    curves are not straight; with a `sigma` of a half it is that of Jiles and Atherton without coupling. Before the
    record the voltage went along what the memory of a `Preisach` holds, from where it had come down for long; ahead
    of another law it had just done so.

    Attributes
    ----------
    inner
        The hysteresis `w`.
    amplitude_um
        `a`: `z` goes from about -1 to 1. Where it is negative, the part runs ahead of the voltage.
    length_share
        `l` over the range of the voltage: on twice that way `z` has turned after a reversal. A shorter one than the
        lower bound is a clearance, as of `backlash`.
    sigma
        How much steeper `z` is after a reversal than at zero: a half where it is as steep, one in Dahl's law.
    exponent
        `n`, how sharply `z` bends towards its limits.
    range_V
        The range of the command, given.
    asymmetry
        `phi`, by which rising branches bend more than falling ones.
    before
        What `z` was before the first sample, beyond what the memory tells.
    gain_first, gain_second, gain_third, gain_fourth
        Of the polynomials in the logarithm of the gain: the part is wider where that is larger.
    loss_first, loss_second
        Of those in that of the loss: the part turns sooner where that is larger.
    lower_V
        Where the range begins, given.
    approach
        `i`: above one it comes to its limits ever more slowly, below one it reaches them.
    """

    name: ClassVar[str] = "bouc_wen_hysteresis"
    title: ClassVar[str] = "Bouc-Wen hysteresis"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("amplitude_um",)
    history: ClassVar[tuple[str, ...]] = ("before",)
    flexible: ClassVar[bool] = True
    # There it is a play, which every density has.
    extremes: ClassVar[tuple[str, ...]] = ("exponent",)
    fingerprint: ClassVar[str] = (
        "Minor loops between the same voltages differ in height and do not close, at any rate: a reversal is "
        "forgotten by and by as the voltage goes on, and not at once when it is passed."
    )
    confusions: ClassVar[tuple[str, ...]] = ("accommodation", "curved_hysteresis")
    experiment: ClassVar[str] = "The same small loop at three biases, ten times each, at two rates."
    source: ClassVar[str] = (
        "Bouc 1967; Wen 1976; normalised as by Ikhouane & Rodellar, Systems with Hysteresis (2007); asymmetry of "
        "Wang & Wen, J. Struct. Eng. 126 (2000) 1151; piezos: Low & Guo, J. Microelectromech. Syst. 4 (1995) 230"
    )
    inner: AbstractPart
    amplitude_um: Float[Array, ""] = param(unit="um", scale=0.1)
    length_share: Float[Array, ""] = param(unit="1", lower=0.05, upper=10.0)
    sigma: Float[Array, ""] = param(unit="1", lower=0.5, upper=5.0)
    exponent: Float[Array, ""] = param(unit="1", lower=1.0, upper=10.0)
    range_V: Float[Array, ""] = array()
    asymmetry: Float[Array, ""] = param(unit="1", scale=0.1, lower=-0.45, upper=0.45, default=0.0)
    before: Float[Array, ""] = param(unit="1", lower=-2.0, upper=2.0, default=0.0)
    gain_first: Float[Array, ""] = param(unit="1", scale=0.1, lower=-_VARIED, upper=_VARIED, default=0.0)
    gain_second: Float[Array, ""] = param(unit="1", scale=0.1, lower=-_VARIED, upper=_VARIED, default=0.0)
    gain_third: Float[Array, ""] = param(unit="1", scale=0.1, lower=-_VARIED, upper=_VARIED, default=0.0)
    gain_fourth: Float[Array, ""] = param(unit="1", scale=0.1, lower=-_VARIED, upper=_VARIED, default=0.0)
    loss_first: Float[Array, ""] = param(unit="1", scale=0.1, lower=-_VARIED, upper=_VARIED, default=0.0)
    loss_second: Float[Array, ""] = param(unit="1", scale=0.1, lower=-_VARIED, upper=_VARIED, default=0.0)
    lower_V: Float[Array, ""] = array(default=0.0)
    approach: Float[Array, ""] = param(unit="1", lower=0.5, upper=3.0, default=1.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Lengths in steps of half a decade, from a seventeenth of the range to the whole."""
        if inner is None:
            return ()
        size, sigma, exponent = (jnp.asarray(x) for x in (0.01 * scales.stroke_um, 0.75, 1.4))
        range_V, lower_V = jnp.asarray(scales.upper_V - scales.lower_V), jnp.asarray(scales.lower_V)
        grid = _decades(0.06, 1.0, 2)
        return tuple((cls(inner, size, jnp.asarray(x), sigma, exponent, range_V, lower_V=lower_V),) for x in grid)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Answer as the hysteresis does, less what stays behind."""
        given = self.inner.run(time_s, signal, start)
        law = innermost(self.inner)
        state = self._limit(-1.0)
        if isinstance(law, Preisach):
            memory = start.memory if isinstance(start, Scene) else start
            past = law.density.lower_V[None] if memory is None else memory.extremes_V
            state = self._along(state, jnp.append(past, signal.before))[-1]
        state = jnp.clip(state + self.before, self._limit(-1.0), self._limit(1.0))
        states = self._along(state, jnp.concatenate([signal.before[None], signal.values]))
        return given.with_values(given.values - self.amplitude_um * states, given.before - self.amplitude_um * state)

    def _limit(self, way: float) -> Float[Array, ""]:
        """The farthest that the state approaches as the voltage goes up or down."""
        gain, loss = self._varied(jnp.linspace(-1, 1, _PLACES))
        most = jnp.log(jnp.max(gain / loss))
        return way * jnp.exp((most - jnp.log1p(2 * way * self.asymmetry)) / self.exponent)

    def _varied(self, place: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Gain and loss at places in the range, from -1 to 1."""
        gain = _legendre(place, (self.gain_first, self.gain_second, self.gain_third, self.gain_fourth))
        return jnp.exp(gain), jnp.exp(_legendre(place, (self.loss_first, self.loss_second)))

    def _along(self, state: Float[Array, ""], voltage_V: Float[Array, " t"]) -> Float[Array, " t-1"]:
        """The state at all voltages but the first, at which it is given."""
        lowest, highest = self._limit(-1.0), self._limit(1.0)
        places = jnp.clip(2 * (voltage_V - self.lower_V) / self.range_V - 1, -1, 1)
        # At the ends and in the middle of each step, all at once: in the loop they would take most of the time.
        three = jnp.stack([places[:-1], (places[:-1] + places[1:]) / 2, places[1:]], axis=1)

        def slope(z: Array, way: Array, gain: Array, loss: Array) -> Array:
            # Within the limits it never goes back, however long a step is.
            z = jnp.clip(z, lowest, highest)
            size, side = jnp.abs(z), jnp.sign(z)
            # The logarithm has no derivative at zero, where the power has.
            at_zero = size < _SMALL
            power = jnp.where(at_zero, 0.0, jnp.exp(self.exponent * jnp.log(jnp.where(at_zero, 1.0, size))))
            turn = 1 - self.sigma + self.sigma * side * way + self.asymmetry * (way + side)
            left = 1 - loss / gain * power * turn
            # Where the limit varies with the voltage, it may be passed, and is then approached from beyond.
            size = jnp.maximum(jnp.abs(left), _SMALL)
            return gain * jnp.sign(left) * jnp.exp(self.approach * jnp.log(size))

        def step(z: Array, length: Array, gain: Array, loss: Array) -> Array:
            way = jnp.sign(length)
            k1 = slope(z, way, gain[0], loss[0])
            k2 = slope(z + length * k1 / 2, way, gain[1], loss[1])
            k3 = slope(z + length * k2 / 2, way, gain[1], loss[1])
            k4 = slope(z + length * k3, way, gain[2], loss[2])
            return jnp.clip(z + length * (k1 + 2 * k2 + 2 * k3 + k4) / 6, lowest, highest)

        def in_steps(z: Array, length: Array, gain: Array, loss: Array, ends: Array) -> Array:
            whole = jnp.linspace(ends[0], ends[1], 2 * _FINE + 1)
            each = self._varied(jnp.stack([whole[:-2:2], whole[1::2], whole[2::2]], axis=1))

            def go(z: Array, varied: tuple[Array, Array]) -> tuple[Array, None]:
                return step(z, length / _FINE, *varied), None

            return lax.scan(go, z, each)[0]

        def at_once(z: Array, length: Array, gain: Array, loss: Array, ends: Array) -> Array:
            return step(z, length, gain, loss)

        def visit(z: Array, move: _Move) -> tuple[Array, Array]:
            z = at_once(z, *move)
            return z, z

        def visit_any(z: Array, move: _Move) -> tuple[Array, Array]:
            z = lax.cond(jnp.abs(move[0]) > _LONG, in_steps, at_once, z, *move)
            return z, z

        ends = jnp.stack([places[:-1], places[1:]], axis=1)
        moves = jnp.diff(voltage_V) / (self.length_share * self.range_V), *self._varied(three), ends
        # To ask at each move takes as long as to make it.
        return lax.cond(
            jnp.any(jnp.abs(moves[0]) > _LONG),
            lambda: lax.scan(visit_any, state, moves)[1],
            lambda: lax.scan(visit, state, moves)[1],
        )
