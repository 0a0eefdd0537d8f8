"""How far a linearised loop is from instability, and what it makes of the sensor's noise."""

from collections.abc import Callable
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Complex, Float

from microid._part import AbstractHysteresis, AbstractLinear, _complex
from microid._plant import Piezo
from microid._stage import Stage, Start
from microid.control._base import AbstractLinearController
from microid.control._loop import _Channel, _once, _rest
from microid.control._sampled import SampledStage, _LinearStep

_Scalar = Float[Array, ""] | float
_GRID = 1500
_DECADES = 5
_MOST = 16
_HALVINGS = 50
_DOUBLINGS = 50


class Margins(eqx.Module):
    """Of a linearised loop of which only the feedback is looked at.

    Attributes
    ----------
    stable
        Whether all poles of the closed loop are inside the unit circle. If not, the rest means nothing.
    radius
        Largest modulus of a pole.
    gain_margin
        Least factor above one by which the loop gain comes to -1; `inf` if there is none.
    phase_margin_deg
        Least turn of the loop gain, either way, by which it comes to -1; `inf` if its modulus is never one.
    gain_margin_Hz, phase_margin_Hz
        Where these are; 0 if there is none.
    crossover_Hz
        Highest frequency at which the loop gain has modulus one; 0 if there is none.
    sensitivity_peak, sensitivity_peak_Hz
        Largest modulus of `1 / (1 + L)`, and where: the inverse of the distance between `L` and -1.
    noise_to_displacement
        RMS of the displacement per RMS of white noise of the sensor.
    noise_to_command_V_per_um
        RMS of the command per RMS of white noise of the sensor.
    """

    stable: Bool[Array, ""]
    radius: Float[Array, ""]
    gain_margin: Float[Array, ""]
    phase_margin_deg: Float[Array, ""]
    gain_margin_Hz: Float[Array, ""]
    phase_margin_Hz: Float[Array, ""]
    crossover_Hz: Float[Array, ""]
    sensitivity_peak: Float[Array, ""]
    sensitivity_peak_Hz: Float[Array, ""]
    noise_to_displacement: Float[Array, ""]
    noise_to_command_V_per_um: Float[Array, ""]


class _LoopGain(eqx.Module):
    pid: AbstractLinearController
    plant: SampledStage
    delay: int = eqx.field(static=True)

    @classmethod
    def of(cls, pid: AbstractLinearController, stage: Stage, delay: int, slope_um_per_V: _Scalar | None) -> Self:
        for name, part in zip(stage.names, stage.parts, strict=True):
            if isinstance(part, AbstractHysteresis) and slope_um_per_V is not None:
                stage = stage.swap(name, Piezo(jnp.asarray(slope_um_per_V)))
            elif not isinstance(part, AbstractLinear):
                raise ValueError(f"{name!r} is not linear: give the slope_um_per_V that stands for a hysteresis")
        if delay < 0:
            raise ValueError(f"delay must be a number of samples, 0 or more, got {delay}")
        return cls(pid._unlimited(), SampledStage(stage.with_substeps(1), pid.interval_s), delay)

    def __call__(self, frequency_Hz: Float[Array, " f"]) -> Complex[Array, " f"]:
        turn = 2 * jnp.pi * frequency_Hz * self.pid.interval_s
        z = lax.complex(jnp.cos(turn), jnp.sin(turn))
        # z - 1 without cancellation, and the plant as a fraction in it: its poles may be close to z = 1.
        w = lax.complex(jnp.zeros_like(turn), 2 * jnp.sin(turn / 2)) * lax.complex(
            jnp.cos(turn / 2), jnp.sin(turn / 2)
        )
        link: _LinearStep = self.plant._links[0]
        over, under = _fraction(link)
        top, bottom = jnp.zeros_like(z), jnp.ones_like(z)
        for upper, lower in zip(over, under, strict=True):
            top, bottom = top * w + _complex(upper), bottom * w + _complex(lower)
        plant = _complex(link.gain) - w * top / bottom
        return self.pid.transfer(z) * plant * z ** (-1 - self.delay)


def _fraction(link: _LinearStep) -> tuple[list[Array], list[Array]]:
    """`read (w - A)^-1 push`, `A` being the step less one: coefficients of both polynomials, but the leading one.

    By the recursion of Faddeev and Le Verrier, which suits a handful of states; a library's solver would be called
    for every frequency.
    """
    n = link.read.shape[0]
    one = jnp.eye(n, dtype=link.read.dtype)
    matrix, power = link.step_matrix - one, one
    over, under = [], []
    for k in range(1, n + 1):
        over.append(jnp.sum(link.read[:, None] * power * link.push[None]))
        moved = matrix @ power
        under.append(-jnp.trace(moved) / k)
        power = moved + under[-1] * one
    return over, under


@eqx.filter_jit
def loop_gain(
    pid: AbstractLinearController,
    stage: Stage,
    frequency_Hz: Float[Array, " f"],
    *,
    delay: int = 0,
    slope_um_per_V: _Scalar | None = None,
) -> Complex[Array, " f"]:
    """Gain once around the loop: controller, delay, and stage under a held command.

    Parameters
    ----------
    pid
        Linear: its limits are not looked at.
    stage
        See `margins`.
    frequency_Hz
        Below half the sampling rate, shape `(f,)`.
    delay, slope_um_per_V
        See `margins`.

    Returns
    -------
    Array
        `L(exp(2 pi i f T))`, shape `(f,)`; the loop is `1 / (1 + L)`.

    Raises
    ------
    ValueError
        See `margins`.
    """
    return _LoopGain.of(pid, stage, delay, slope_um_per_V)(jnp.asarray(frequency_Hz))


@eqx.filter_jit
def margins(
    pid: AbstractLinearController, stage: Stage, *, delay: int = 0, slope_um_per_V: _Scalar | None = None
) -> Margins:
    """Find the margins of a loop, differentiable in the controller and the stage.

    Parameters
    ----------
    pid
        A `PID` or a `ResonantPID`: its limits are not looked at. For `BPPID` see its `pid`, for `CMACPID` that within
        it.
    stage
        Of linear parts, and of at most one hysteresis.
    delay
        How many samples old the reading is that the controller is given.
    slope_um_per_V
        What stands for a hysteresis: the slope of its output. The steepest is the least stable.

    Returns
    -------
    Margins
        Crossings are searched for on a grid that is denser at the poles of stage and loop, and then refined.

    Raises
    ------
    ValueError
        If a part is not linear, or the delay is negative.
    """
    loop = _LoopGain.of(pid, stage, delay, slope_um_per_V)
    still = jax.tree.map(lambda x: lax.stop_gradient(x) if eqx.is_array(x) else x, loop)
    closed, driven, reads, direct = _closed(loop)
    poles, radius = _poles(closed)
    stable = radius < 1
    # Of an unstable loop a stable one is made, so that derivatives stay finite.
    spread = _variance(closed * jnp.where(stable, 1, 0.5 / radius), driven)
    noise = jnp.sqrt(jnp.sum((reads @ spread) * reads, axis=1) + direct * direct)
    noise = jnp.where(stable, noise, jnp.inf)
    nyquist = 0.5 / pid.interval_s
    own = [jnp.linalg.eigvals(still.plant._links[0].step_matrix)] if still.plant._links[0].read.shape[0] else []
    grid = lax.stop_gradient(_grid(jnp.concatenate([poles, *own]), nyquist))
    turned, sides = _crossings(lambda loop, f: jnp.imag(loop(f)), loop, still, grid)
    sides &= jnp.real(still(turned)) < 0
    # At half the sampling rate the loop gain is real.
    depth = jnp.append(-jnp.real(loop(turned)), -jnp.real(loop(nyquist[None])))
    counted = jnp.append(sides, True) & (depth > 0) & (depth < 1)
    factors = jnp.where(counted, 1 / jnp.where(counted, depth, 1), jnp.inf)
    gain, at_gain = jnp.min(factors), _where_least(factors, jnp.append(turned, nyquist))
    unity, crossed = _crossings(lambda loop, f: jnp.log(jnp.abs(loop(f))), loop, still, grid)
    reached = loop(jnp.where(crossed, unity, nyquist / 3))
    angle = jnp.abs(jnp.arctan2(-jnp.imag(reached), -jnp.real(reached))) * (180 / jnp.pi)
    turns = jnp.where(crossed, angle, jnp.inf)
    phase, at_phase = jnp.min(turns), _where_least(turns, unity)
    crossover = jnp.max(jnp.where(crossed, unity, 0))
    peak_Hz = _peak(lambda f: 1 / jnp.abs(1 + still(f)), grid)
    peak = 1 / jnp.abs(1 + loop(peak_Hz[None])[0])
    return Margins(stable, radius, gain, phase, at_gain, at_phase, crossover, peak, peak_Hz, noise[0], noise[1])


def _where_least(values: Float[Array, " k"], frequency_Hz: Float[Array, " k"]) -> Float[Array, ""]:
    """Frequency of the least of some values; 0 if none is finite."""
    place = jnp.argmin(values)
    return jnp.where(jnp.isfinite(values[place]), lax.stop_gradient(frequency_Hz[place]), 0)


def require_stable(found: Margins) -> Margins:
    """Pass margins on if their loop is stable.

    Raises
    ------
    ValueError
        If it is not: such a loop is not tuned, whatever its error on some record.
    """
    if not bool(found.stable):
        raise ValueError(
            f"the closed loop is unstable: its largest pole has modulus {float(found.radius):.6g}, not "
            "below 1; lower the gains or the delay"
        )
    return found


def _closed(loop: _LoopGain) -> tuple[Array, Array, Array, Array]:
    """The closed loop as matrices, from its own step: states to states, noise to states, states and noise to outputs.

    Outputs are displacement and command.
    """
    start = _rest(loop.pid, loop.plant, loop.delay, Start(), jnp.zeros_like(loop.pid.interval_s))
    flat, restore = ravel_pytree(start)
    zero, channel = jnp.zeros_like(loop.pid.interval_s), _Channel(None, None, None, None)

    def once(state: Float[Array, " n"], noise: Float[Array, ""]) -> tuple[Array, Array]:
        after, (displacement, _, command) = _once(loop.pid, loop.plant, channel, restore(state), zero, zero, noise)
        after = (loop.pid._driven(after[0]), *after[1:])
        return ravel_pytree(after)[0], jnp.stack([displacement, command])

    (closed, driven), (reads, direct) = jax.jacfwd(once, argnums=(0, 1))(flat, zero)
    return closed, driven, reads, direct


def _poles(matrix: Float[Array, "n n"]) -> tuple[Complex[Array, " n"], Float[Array, ""]]:
    """Eigenvalues, and their largest modulus.

    This has a derivative if that one is simple, from its vectors on both sides. The general rule needs all of them
    to be simple, which those of a delay are not.
    """
    still = lax.stop_gradient(matrix)
    (values, right), (others, left) = jnp.linalg.eig(still), jnp.linalg.eig(still.T)
    place = jnp.argmax(jnp.abs(values))
    value, v = values[place], right[:, place]
    w = left[:, jnp.argmin(jnp.abs(others - value))]
    moved = jnp.sum(w[:, None] * _complex(matrix - still) * v[None]) / jnp.sum(w * v)
    return values, jnp.abs(value + moved)


def _variance(matrix: Float[Array, "n n"], driven: Float[Array, " n"]) -> Float[Array, "n n"]:
    """Solve `P = A P A' + b b'` by doubling."""

    def double(_: Any, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        total, power = carry
        return total + power @ total @ power.T, power @ power

    return lax.fori_loop(0, _DOUBLINGS, double, (jnp.outer(driven, driven), matrix))[0]


def _grid(poles: Complex[Array, " p"], nyquist_Hz: Float[Array, ""]) -> Float[Array, " f"]:
    """Frequencies in order: evenly spaced, evenly in their logarithm, and ever closer to the poles' own."""
    even = jnp.linspace(0, 1, _GRID + 1, dtype=nyquist_Hz.dtype)[1:]
    natural = jnp.abs(jnp.angle(poles)) / jnp.pi
    width = jnp.abs(jnp.log(jnp.maximum(jnp.abs(poles), 1e-3))) / jnp.pi + 1e-9
    near = natural[:, None] + width[:, None] * jnp.sinh(jnp.linspace(-6, 6, 61, dtype=width.dtype))[None]
    # Just below 1, where the loop gain is real by definition and rounding decides on which side.
    every = jnp.concatenate([even, 10 ** (_DECADES * (even - 1)), near.ravel()])
    return nyquist_Hz * jnp.sort(jnp.clip(every, 10.0**-_DECADES, 1 - 1e-9))


def _crossings(
    function: Callable[[_LoopGain, Float[Array, " f"]], Float[Array, " f"]],
    loop: _LoopGain,
    still: _LoopGain,
    grid: Float[Array, " f"],
) -> tuple[Float[Array, " k"], Bool[Array, " k"]]:
    """Frequencies at which a function of the loop changes its sign, and which of them count."""
    positive = function(still, grid) > 0
    index = jnp.nonzero(positive[1:] != positive[:-1], size=_MOST, fill_value=-1)[0]
    found = index >= 0
    sign = positive[index]

    def halve(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = (ends[0] + ends[1]) / 2
        same = (function(still, middle) > 0) == sign
        return jnp.where(same, middle, ends[0]), jnp.where(same, ends[1], middle)

    low, _ = lax.fori_loop(0, _HALVINGS, halve, (grid[index], grid[jnp.where(found, index + 1, -1)]))
    root = lax.stop_gradient(jnp.where(found, low, grid[0]))
    slope = jax.jvp(lambda f: function(still, f), (root,), (jnp.ones_like(root),))[1]
    # One step of Newton's method, for the derivative.
    value = function(loop, root)
    moved = root - (value - lax.stop_gradient(value)) / jnp.where(found & (slope != 0), slope, 1)
    return moved, found


def _peak(function: Callable[[Float[Array, " f"]], Float[Array, " f"]], grid: Float[Array, " f"]) -> Float[Array, ""]:
    """Where a function is largest, by thirds from the grid on."""
    best = grid[jnp.argmax(function(grid))]

    def third(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        inner = jnp.stack([low + (high - low) / 3, high - (high - low) / 3])
        left, right = function(inner)
        return jnp.where(left < right, inner[0], low), jnp.where(left < right, high, inner[1])

    # Neighbours that stand apart: conjugate poles put the same frequencies into the grid.
    below = jnp.max(jnp.where(grid < best * (1 - 1e-6), grid, grid[0]))
    above = jnp.min(jnp.where(grid > best * (1 + 1e-6), grid, grid[-1]))
    low, high = lax.fori_loop(0, _HALVINGS, third, (below, above))
    return lax.stop_gradient((low + high) / 2)
