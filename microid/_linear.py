"""Linear time-invariant systems, solved exactly between samples for inputs held constant or joined by lines."""

from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from microid._param import _as_inexact
from microid._platform import _by_platform
from microid._precision import _full_precision

Hold = Literal["first", "zero", "smooth"]
"""How an input goes between samples: in a line, in a step that holds the last one, or in a smooth curve."""
Times = Float[Array, " t"] | Float[Array, ""]
_Between = tuple[Hold, Float[Array, ""] | None]
# With a norm of at most a half, sixteen terms of the exponential series leave less than rounding.
_TERMS = 16
# Each doubles the interval: enough for rates of 1e19 per sample.
_DOUBLINGS = 64
_SQUARINGS = 6
_BLOCK = 2**_SQUARINGS
_PIECE = 256


class LinearSystem(eqx.Module):
    r"""A stable linear system, written in its deviation from rest.

    With the input `w`, the states are `x = rest w + z`, and

    .. math:: \dot z = A z - r \dot w, \qquad y = y_0 + g w + c^T z

    so that `z = 0` is rest, and the static gain stands by itself. Choose states of like magnitude.

    Attributes
    ----------
    rate_per_s
        The matrix `A`, shape `(n, n)`; without states, `n = 0`.
    rest
        States at rest under an input of one, `r`, shape `(n,)`.
    read
        What the states add to the output, `c`, shape `(n,)`.
    gain
        Static gain `g`, output per input.
    offset
        Output at rest under no input, `y_0`, in the unit of the output.
    """

    rate_per_s: Float[Array, "n n"] = eqx.field(converter=_as_inexact)
    rest: Float[Array, " n"] = eqx.field(converter=_as_inexact)
    read: Float[Array, " n"] = eqx.field(converter=_as_inexact)
    gain: Float[Array, ""] = eqx.field(converter=_as_inexact)
    offset: Float[Array, ""] = eqx.field(converter=_as_inexact)

    @property
    def order(self) -> int:
        """Number of states."""
        return self.rest.shape[0]

    def then(self, other: "LinearSystem") -> "LinearSystem":
        """Put another system behind this one; nothing is approximated between the two."""
        inward = other.rate_per_s @ other.rest
        zero = jnp.zeros((self.order, other.order), dtype=self.rest.dtype)
        through = other.gain - other.read @ other.rest
        return LinearSystem(
            jnp.block([[self.rate_per_s, zero], [-jnp.outer(inward, self.read), other.rate_per_s]]),
            jnp.concatenate([self.rest, self.gain * other.rest]),
            jnp.concatenate([through * self.read, other.read]),
            other.gain * self.gain,
            other.gain * self.offset + other.offset,
        )

    # Compiled by itself, so that it is traced once for all programs that it is part of.
    @eqx.filter_jit
    @_full_precision
    def respond(
        self,
        time_s: Times,
        signal: Float[Array, " t"],
        before: Float[Array, ""],
        hold: Hold = "first",
        by_samples: bool = False,
        settling_s: Float[Array, ""] | None = None,
    ) -> Float[Array, " t"]:
        """Respond to a sampled input, exactly for the given hold.

        Parameters
        ----------
        time_s
            Increasing times, shape `(t,)`, evenly spaced or not; or the one interval between all samples, shape `()`,
            which spares looking. No derivative flows into them.
        signal
            The input at these times, shape `(t,)`.
        before
            The constant input under which the system came to rest before the first sample.
        hold
            `"first"`: the input runs in a line from sample to sample; `"zero"`: it keeps each sample until the next;
            `"smooth"`: it runs through the samples without corners, and the response is exact to the fourth order
            of the interval.
        by_samples
            Go from sample to sample, with one interval between all: on a CPU the fastest way for many systems that
            are mapped over together (`jax.vmap`).
        settling_s
            Under the hold `"first"`, a time constant with which the input settles from each sample to the next, in
            place of a line, shape `()`.

        Returns
        -------
        Array
            The output at the same times, shape `(t,)`.

        Raises
        ------
        ValueError
            If there is no such hold.

        Notes
        -----
        Times count as even if rounding of their largest explains what they differ by. Then all intervals share one
        matrix, and blocks of samples are one matrix product; otherwise every interval has its own.
        """
        if hold not in ("first", "zero", "smooth"):
            raise ValueError(f"hold must be 'first', 'zero' or 'smooth', got {hold!r}")
        signal = _as_inexact(signal)
        level = self.offset + self.gain * signal
        if self.order == 0:
            return level
        if hold == "smooth":
            bent = signal - _bend(jnp.asarray(time_s), signal)
            directly = self.gain - self.read @ self.rest
            return self.respond(time_s, bent, before, "first", by_samples) + directly * (signal - bent)
        start = self.rest * (before - signal[0])
        first = level[0] + self.read @ start
        if signal.shape[0] == 1:
            return first[None]
        change = jnp.diff(signal)
        time = lax.stop_gradient(jnp.asarray(time_s))
        if time.ndim == 0:
            even = self._by_samples if by_samples else self._on_even_times
            moved = even(time.astype(signal.dtype), start, change, (hold, settling_s))
        else:
            interval = jnp.diff(time)
            mean = (time[-1] - time[0]) / interval.shape[0]
            rounding = 4 * jnp.finfo(time.dtype).eps * jnp.maximum(jnp.abs(time[0]), jnp.abs(time[-1]))
            moved = lax.cond(
                jnp.max(jnp.abs(interval - mean)) <= rounding,
                lambda self, *rest: self._on_even_times(mean.astype(signal.dtype), *rest, (hold, settling_s)),
                lambda self, *rest: self._on_any_times(interval.astype(signal.dtype), *rest, (hold, settling_s)),
                self,
                start,
                change,
            )
        return jnp.concatenate([first[None], level[1:] + moved])

    def advance(
        self, interval_s: Float[Array, " k"], hold: Hold, settling_s: Float[Array, ""] | None = None
    ) -> tuple[Float[Array, "n n k"], Float[Array, "n k"]]:
        """Matrices `exp(A h)`, and what the states lose by an input that rises by one."""
        if settling_s is not None:
            return self._advance_settling(interval_s, settling_s)
        n, longest = self.order, jnp.max(interval_s)
        whole = self.rate_per_s * longest
        norm = lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(whole), axis=1)))
        doublings = jnp.clip(jnp.ceil(jnp.log2(norm)) + 1, 0, _DOUBLINGS)
        share = (whole * jnp.exp2(-doublings))[:, :, None] * (interval_s / longest)[None, None, :]
        one = jnp.broadcast_to(jnp.eye(n, dtype=share.dtype)[:, :, None], share.shape)

        # Horner's scheme for (exp(X) - 1) / X.
        def nest(mean: Array, j: Array) -> tuple[Array, None]:
            return (one + _times(share, mean)) / j, None

        mean, _ = lax.scan(nest, one, jnp.arange(_TERMS, 0, -1, dtype=share.dtype))
        less, mean = _times(share, mean), jnp.einsum("abk,b->ak", mean, self.rest)

        # Doubling exp(X) - 1 rather than exp(X) keeps the digits of slow states beside fast ones.
        def double(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            less, mean = carry
            return 2 * less + _times(less, less), mean + _times(less, mean[:, None])[:, 0] / 2

        def some(
            first: Array, count: int, stride: int, inner: Any, carry: tuple[Array, Array]
        ) -> tuple[Array, Array]:
            def visit(carry: tuple[Array, Array], i: Array) -> tuple[tuple[Array, Array], None]:
                return lax.cond(i < doublings, partial(inner, i), lambda carry: carry, carry), None

            return lax.scan(visit, carry, first + stride * jnp.arange(count, dtype=first.dtype))[0]

        # As many as the norm needs, in two levels, since asking takes longer than doubling.
        eight = partial(some, count=8, stride=1, inner=lambda _, carry: double(carry))
        less, mean = some(
            jnp.zeros_like(doublings), _DOUBLINGS // 8, 8, lambda i, carry: eight(i, carry=carry), (less, mean)
        )
        return one + less, mean if hold == "first" else jnp.broadcast_to(self.rest[:, None], mean.shape)

    def _advance_settling(
        self, interval_s: Float[Array, " k"], settling_s: Float[Array, ""]
    ) -> tuple[Float[Array, "n n k"], Float[Array, "n k"]]:
        """As `advance`, of an input whose rate decays as `exp(-t / settling_s)` within each interval.

        That rate is one more state, which drives the others: exact even where it decays as they do.
        """
        n, rate = self.order, 1 / settling_s
        driven = jnp.concatenate([self.rate_per_s, -rate * self.rest[:, None]], axis=1)
        decays = jnp.concatenate([jnp.zeros_like(self.rest), -rate[None]])
        nothing = jnp.zeros(n + 1, dtype=self.rest.dtype)
        larger = LinearSystem(jnp.concatenate([driven, decays[None]]), nothing, nothing, self.gain, self.offset)
        step, _ = larger.advance(interval_s, "zero")
        return step[:n, :n], step[:n, n] / jnp.expm1(-rate * interval_s)[None]

    def _on_any_times(
        self, interval_s: Float[Array, " k"], start: Float[Array, " n"], change: Float[Array, " k"], between: _Between
    ) -> Float[Array, " k"]:
        # In pieces, each made again when it is differentiated: all doublings of all samples would not fit.
        pieces = -(-interval_s.shape[0] // _PIECE)
        filled = jnp.pad(interval_s, (0, pieces * _PIECE - interval_s.shape[0]), mode="edge").reshape(pieces, _PIECE)
        advance = jax.checkpoint(lambda system, piece: system.advance(piece, *between))
        every = lax.map(lambda piece: advance(self, piece), filled)
        step, taken = (jnp.moveaxis(x, -1, 1).reshape(-1, *x.shape[1:-1])[: interval_s.shape[0]] for x in every)
        push = -taken * change[:, None]
        return recur(step, push.at[0].add(step[0] @ start)) @ self.read

    def _on_even_times(
        self, interval_s: Float[Array, ""], start: Float[Array, " n"], change: Float[Array, " k"], between: _Between
    ) -> Float[Array, " k"]:
        """Answer of each block of samples to itself as one product, then of the blocks to those before them."""
        step, taken = (x[..., 0] for x in self.advance(interval_s[None], *between))
        blocks = -(-change.shape[0] // _BLOCK)
        inside = jnp.pad(change, (0, blocks * _BLOCK - change.shape[0])).reshape(blocks, _BLOCK)
        # Column j: the states j samples after a change of one, and what states add to the output j + 1 samples on.
        after, over = _orbit(step, -taken)
        later, _ = _orbit(step.T, step.T @ self.read)
        lag = np.arange(_BLOCK) - np.arange(_BLOCK)[:, None]
        answer = jnp.where(lag >= 0, (self.read @ after)[np.abs(lag)], 0)
        left = jnp.einsum("bj,nj->bn", inside, after[:, ::-1])
        across = jnp.broadcast_to(over, (blocks, *over.shape))
        state = recur(across, jnp.concatenate([start[None], left[:-1]]))
        return (inside @ answer + state @ later).ravel()[: change.shape[0]]

    def _by_samples(
        self, interval_s: Float[Array, ""], start: Float[Array, " n"], change: Float[Array, " k"], between: _Between
    ) -> Float[Array, " k"]:
        """The same in one pass, whose states are scalars: mapped over many systems they are vectors."""
        step, taken = (x[..., 0] for x in self.advance(interval_s[None], *between))

        def visit(z: tuple[Array, ...], change: Array) -> tuple[tuple[Array, ...], Array]:
            z = tuple(
                sum((row[j] * z[j] for j in range(self.order)), start=-t * change)
                for row, t in zip(step, taken, strict=True)
            )
            return z, sum((c * state for c, state in zip(self.read, z, strict=True)), start=jnp.zeros_like(change))

        return lax.scan(visit, tuple(start), change)[1]


def _bend(time_s: Times, signal: Float[Array, " t"]) -> Float[Array, " t"]:
    """How far lines through the samples of a smooth signal lie beside it on average.

    That is a twelfth of the second difference. Taken off the samples, lines through them pass on the same spectrum
    to the fourth order.
    """
    if signal.shape[0] < 3:
        return jnp.zeros_like(signal)
    change, time = jnp.diff(signal), lax.stop_gradient(time_s)
    if time.ndim == 0:
        inner = jnp.diff(change) / 12
    else:
        interval = jnp.diff(time).astype(signal.dtype)
        early, late = interval[:-1], interval[1:]
        inner = jnp.diff(change / interval) * early * late / (6 * (early + late))
    return jnp.pad(inner, 1)


def _times(left: Float[Array, "n n k"], right: Float[Array, "n m k"]) -> Float[Array, "n m k"]:
    """Multiply many small matrices; libraries take longer to be called than to do it."""
    return jnp.sum(left[:, :, None, :] * right[None], axis=1)


def _orbit(
    step: Float[Array, "n n"], first: Float[Array, " n"]
) -> tuple[Float[Array, "n block"], Float[Array, "n n"]]:
    """Columns `step**j first` for a block of `j`, and the power that leads to the next block."""
    # Loops rather than products of growing size: they compile in a fraction of the time.
    _, columns = lax.scan(lambda z, _: (jnp.sum(step * z[None], axis=1), z), first, None, length=_BLOCK)
    over, _ = lax.scan(lambda power, _: (_times(power, power), None), step[:, :, None], None, length=_SQUARINGS)
    return columns.T, over[..., 0]


@_full_precision
def recur(step: Float[Array, "t n n"], push: Float[Array, "t n"]) -> Float[Array, "t n"]:
    """Solve `z[t] = step[t] @ z[t - 1] + push[t]` from zero on.

    Parameters
    ----------
    step
        Matrices, shape `(t, n, n)`; the first is not used.
    push
        What comes in, shape `(t, n)`.

    Returns
    -------
    Array
        Shape `(t, n)`. Differentiable in both arguments, in forward and reverse mode.

    Notes
    -----
    One pass on a CPU; elsewhere parallel in time, by an associative scan.
    """

    def residual(z: Array) -> Array:
        return z.at[1:].add(-jnp.einsum("tij,tj->ti", step[1:], z[:-1]))

    def solve(_: object, rhs: Array) -> Array:
        return _by_platform(step, rhs, cpu=_one_by_one, default=_all_at_once)

    def transpose_solve(_: object, rhs: Array) -> Array:
        # Backwards in time, by the transposed matrix of the following sample.
        back = jnp.swapaxes(jnp.roll(step, -1, axis=0), 1, 2)[::-1]
        return _by_platform(back, rhs[::-1], cpu=_one_by_one, default=_all_at_once)[::-1]

    # The implicit form needs one more pass per derivative; differentiating the scan itself is several times slower.
    return lax.custom_linear_solve(residual, push, solve, transpose_solve)


def _one_by_one(step: Float[Array, "t n n"], push: Float[Array, "t n"]) -> Float[Array, "t n"]:
    n = push.shape[1]

    def visit(z: tuple[Array, ...], now: tuple[Array, Array]) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        matrix, more = now
        # Scalars: matrices of this size cost more to call than to multiply.
        z = tuple(sum((matrix[i, j] * z[j] for j in range(n)), start=more[i]) for i in range(n))
        return z, z

    return jnp.stack(lax.scan(visit, tuple(jnp.zeros_like(push[0])), (step, push))[1], axis=1)


def _all_at_once(step: Float[Array, "t n n"], push: Float[Array, "t n"]) -> Float[Array, "t n"]:
    def join(early: tuple[Array, Array], late: tuple[Array, Array]) -> tuple[Array, Array]:
        return late[0] @ early[0], jnp.einsum("tij,tj->ti", late[0], early[1]) + late[1]

    return lax.associative_scan(join, (step, push))[1]
