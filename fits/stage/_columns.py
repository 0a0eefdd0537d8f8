"""Responses of a run to the columns of its hysteresis, passed on through what follows it."""

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.io._kept import kept
from fits.loop._design import Grid, branch_table, design
from fits.loop._path import Path
from fits.loop._run import Run, Samples
from fits.loop._stepped import intervals
from fits.stage._chain import Chain
from fits.stage._plain_linear import Linear
from fits.stage._run import ahead, joined, lines_of
from microid import Coordinates, LinearSystem, Scene, Signal, Stage, Staircase, run_parts

# Samples that are passed on at a time.
PIECE = 2048
# Directions that are passed on at a time.
_AT_ONCE = 64


def passes_linearly(stage: Stage, place: int) -> bool:
    """Whether all that follows a part is linear."""
    after = stage.parts[place + 1 :]
    return not after or joined(after) is not None


def propagated(
    coordinates: Coordinates[Stage],
    place: int | None,
    z: Float[Array, " p"],
    run: Run,
    around_um: np.ndarray,
    moved_um: np.ndarray,
) -> np.ndarray:
    """Pass changes of what comes out of the hysteresis, shape `(n, k)`, on through what follows it, to first order.

    They are `around_um`, shape `(n,)`. Where all that follows is linear, they have been passed on already.
    """
    assert place is not None
    if passes_linearly(coordinates(z), place):
        return moved_um
    n, samples = len(run.record), run.samples
    pad = len(samples.weight) - n
    signal = jnp.asarray(np.pad(around_um, (0, pad), mode="edge"))
    out = np.empty_like(moved_um)
    for first in range(0, moved_um.shape[1], _AT_ONCE):
        part = moved_um[:, first : first + _AT_ONCE].T
        full = np.pad(np.pad(part, ((0, 0), (0, pad)), mode="edge"), ((0, _AT_ONCE - len(part)), (0, 0)))
        answer = _propagated(coordinates, place, z, samples, signal, jnp.asarray(full))
        out[:, first : first + _AT_ONCE] = np.asarray(answer)[: len(part), :n].T
    return out


@kept
def _propagated(
    coordinates: Coordinates[Stage],
    place: int,
    z: Float[Array, " p"],
    samples: Samples,
    around_um: Float[Array, " n"],
    moved_um: Float[Array, "k n"],
) -> Float[Array, "k n"]:
    stage, each = coordinates(z), slice(None, None, samples.stride)
    time_s = samples.time_s * samples.stride if samples.time_s.ndim == 0 else samples.time_s[each]
    command = Signal(samples.voltage_V[each], samples.rest_V, samples.hold)
    beside = {name: values[each] for name, values in samples.beside.items()}
    scene = Scene(command, beside, samples.start.memory)

    between = lines_of(ahead(stage, place, samples))

    def follow(values: Float[Array, " n"]) -> Float[Array, " n"]:
        return run_parts(stage.parts[place + 1 :], time_s, Signal(values, values[0], *between), scene).values

    _, push = jax.linearize(follow, around_um)
    return jax.vmap(push)(moved_um)


@kept
def _before_and_after(
    coordinates: Coordinates[Stage], place: int, z: Float[Array, " p"], samples: Samples, each: int
) -> tuple[Signal, LinearSystem | None]:
    """What the hysteresis sees, at each so many of the refined times, and the linear system that follows it."""
    stage = coordinates(z)
    seen = ahead(stage, place, samples)
    some = seen.with_values(seen.values[::each], seen.before)
    return some, joined(stage.parts[place + 1 :])


@kept
def _design(
    grid: Grid, table: Float[Array, "4 k D"], voltage_V: Float[Array, " k"], memory: Staircase
) -> tuple[Float[Array, "k D"], Staircase]:
    return design(grid, table, voltage_V, memory)


def _passed(
    chain: Chain,
    z: Float[Array, " p"],
    run: Run,
    respond: Callable[[np.ndarray], Iterator[np.ndarray]],
    steps: int = 1,
) -> Iterator[np.ndarray]:
    """What follows the hysteresis makes of responses to the voltage that it sees, piece by piece.

    They are those in so many steps from sample to sample.
    """
    assert chain.place is not None
    seen, system = _before_and_after(chain.coordinates, chain.place, z, run.samples, run.stride // steps)
    responses = respond(np.asarray(seen.values)[: (len(run.record) - 1) * steps + 1])
    if system is None:
        return responses
    rate, rest, read = map(np.asarray, (system.rate_per_s, system.rest, system.read))
    behind = Linear(rate, rest, read, float(system.gain), 0.0)
    hold, settling_s = lines_of(seen)
    settles = None if settling_s is None else float(settling_s)
    each_s = intervals(run.record.time_s) / steps
    return behind.follow(each_s if len(each_s) == 1 else np.repeat(each_s, steps), responses, hold, settles)


def pieces(
    chain: Chain, z: Float[Array, " p"], run: Run, free: bool, refined: bool = False
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the rows of the columns, piece by piece, with the sample that each piece begins at.

    Unless they are `refined`, they are not followed between samples: good enough as directions to move in, while only
    the residual decides where the fit ends.
    """
    grid, n = chain.grid, len(run.record)
    run = run.coarser if refined else run
    steps = run.stride if refined else 1
    if grid is None or chain.place is None or not free:
        yield from ((first, np.zeros((min(PIECE, n - first), 0))) for first in range(0, n, PIECE))
        return
    table = jnp.asarray(branch_table(grid.levels))

    def respond(voltage_V: np.ndarray) -> Iterator[np.ndarray]:
        memory = run.samples.start.memory
        for first in range(0, len(voltage_V), PIECE):
            some = voltage_V[first : first + PIECE]
            padded = jnp.asarray(np.pad(some, (0, PIECE - len(some)), mode="edge"))
            rows, memory = _design(grid, table, padded, memory)
            yield np.asarray(rows)[: len(some)]

    for k, rows in enumerate(_passed(chain, z, run, respond, steps)):
        first = -(-k * PIECE // steps)
        yield first, rows[first * steps - k * PIECE :: steps]


def combined(chain: Chain, z: Float[Array, " p"], run: Run, columns_um: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the responses to combinations of columns, `(D, k)`, in um, piece by piece: `pieces` times these."""
    grid, memory, n = chain.grid, run.samples.start.memory, len(run.record)
    if grid is None or chain.place is None:
        yield from (np.zeros((min(PIECE, n - first), columns_um.shape[1])) for first in range(0, n, PIECE))
        return
    surface = grid.surface(columns_um)
    before_V = np.asarray(memory.extremes_V)[: int(memory.count)]
    yield from _passed(chain, z, run, lambda seen_V: map(surface.respond, Path.pieces(before_V, seen_V, PIECE)))
