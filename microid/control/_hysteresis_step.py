"""Hysteresis laws sample by sample, with a state of fixed size, as a closed loop needs them."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from microid._everett import Everett, _window
from microid._memory import Staircase, _filled, negative_saturation
from microid._part import AbstractHysteresis, AbstractStepper
from microid._preisach import Preisach


class _Branch(eqx.Module):
    """The extremes remembered, each with the output's part that hangs from it, and the branch that is run now."""

    extremes_V: Float[Array, " size"]
    totals_um: Float[Array, " size"]
    top: Int[Array, ""]
    rising: Bool[Array, ""]
    voltage_V: Float[Array, ""]
    total_um: Float[Array, ""]


class _PreisachStep(AbstractStepper):
    """The Preisach operator one sample at a time, as exact as the operator along a whole record.

    Minima stand at even places and maxima at odd ones, each kind in order. So how many are left once a new voltage
    has wiped out its share is a count over all places, with no loop. When the places are used up, the innermost loop
    is forgotten, which is the smallest.
    """

    everett: Everett
    offset_um: Float[Array, ""]

    def init(self, before_V: Float[Array, ""], start: Staircase | None = None) -> tuple[_Branch, Float[Array, ""]]:
        """State and output after the voltage has come from a memory to where it rested."""
        start = negative_saturation(self.everett.lower_V) if start is None else start
        path = _filled(start)
        zeros = jnp.zeros_like(path)
        root = _Branch(
            zeros.at[0].set(path[0]), zeros, jnp.zeros((), jnp.int32), jnp.asarray(True), path[0], zeros[0]
        )
        state, _ = lax.scan(lambda state, x: self.step(state, x), root, path)
        return self.step(state, before_V)

    def step(self, state: _Branch, voltage_V: Float[Array, ""]) -> tuple[_Branch, Float[Array, ""]]:
        """Follow the voltage to its next sample."""
        size = state.extremes_V.shape[0]
        place = jnp.arange(size, dtype=jnp.int32)
        x, before = voltage_V, state.voltage_V
        up = jnp.where(x == before, state.rising, x > before)
        turned = up != state.rising
        # Two places back keeps minima at even and maxima at odd places.
        next_ = jnp.where(state.top + 1 < size, state.top + 1, state.top - 1)
        top = jnp.where(turned, next_, state.top)
        pushed = turned & (place == top)
        extremes = jnp.where(pushed, before, state.extremes_V)
        totals = jnp.where(pushed, state.total_um, state.totals_um)
        odd, used = place % 2 == 1, place <= top
        higher = jnp.sum(used & odd & (extremes > x), dtype=jnp.int32)
        lower = jnp.sum(used & ~odd & ((extremes < x) | (place == 0)), dtype=jnp.int32)
        top = jnp.where(up, 2 * higher, 2 * lower - 1)
        here = place == top
        anchor, total = (jnp.sum(jnp.where(here, values, 0)) for values in (extremes, totals))
        (i, s), (j, t) = (self.everett._place(voltage[None]) for voltage in (x, anchor))
        high, low = (jnp.where(up, i, j), jnp.where(up, s, t)), (jnp.where(up, j, i), jnp.where(up, t, s))
        total += jnp.where(up, -1, 1) * _window(self.everett.window_um, *high, *low)[0]
        displacement = self.offset_um + total + self.everett._branch((i, s), up[None])[0]
        return _Branch(extremes, totals, top, up, x, total), displacement


def _step_form(name: str, law: AbstractHysteresis) -> AbstractStepper:
    """The law one sample at a time.

    Raises
    ------
    ValueError
        If it has no such form.
    """
    if isinstance(law, Preisach):
        return _PreisachStep(law.everett, law.offset_um)
    if isinstance(law, AbstractStepper):
        return law
    raise ValueError(
        f"{name!r} is a {type(law).__name__}, which has no form for single samples: "
        "give it `init` and `step`, or put a Preisach in its place"
    )
