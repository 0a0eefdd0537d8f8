"""A whole stage as a regression: linear in the columns of its hysteresis, linearised in its other parameters."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from fits.io._kept import kept
from fits.loop._design import Grid, branch_table, design
from fits.loop._moments import Moments
from fits.loop._run import Run, Samples
from fits.stage._run import ahead, joined, nuisance_columns, place_of_hysteresis, project_out, respond
from microid import Coordinates, LinearSystem, ParameterInfo, Scene, Signal, Stage, Staircase

# Samples that go through the compiled regression at a time.
_PIECE = 2048
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
    command = Signal(samples.voltage_V[each], samples.voltage_V[0], samples.hold)
    beside = {name: values[each] for name, values in samples.beside.items()}
    scene = Scene(command, beside, samples.start.memory)

    def follow(values: Float[Array, " n"]) -> Float[Array, " n"]:
        signal = Signal(values, values[0], "first")
        for part in stage.parts[place + 1 :]:
            signal = part.run(time_s, signal, scene)
        return signal.values

    _, push = jax.linearize(follow, around_um)
    return jax.vmap(push)(moved_um)


def offsets_out(stage: Stage, grid: bool) -> Coordinates[Stage]:
    """Coordinates of what is free but for offsets and the `grid`'s own; a `ValueError` where nothing is left."""
    place = place_of_hysteresis(stage)
    name = None if place is None or not grid else stage.names[place]

    def moves(info: ParameterInfo) -> bool:
        path = stage.named(info.path)
        return stage.free(info) and not path.endswith("offset_um") and path.partition(".")[0] != name

    return Coordinates(stage, moves)


class Chain(eqx.Module):
    """A stage in the coordinates of its fit; the grid and its place are None where no grid is fitted."""

    coordinates: Coordinates[Stage]
    place: int | None = eqx.field(static=True)
    grid: Grid | None

    @classmethod
    def of(cls, stage: Stage, grid: Grid | None) -> "Chain":
        """Coordinates of a stage whose hysteresis is fitted on a grid, if there is one."""
        place = None if grid is None else place_of_hysteresis(stage)
        return cls(offsets_out(stage, grid is not None), place, grid)

    @property
    def size(self) -> int:
        """Number of columns, `D`."""
        return 0 if self.grid is None else self.grid.columns

    @property
    def levels(self) -> int:
        return 0 if self.grid is None else self.grid.levels

    def stage(self, z: Float[Array, " p"], columns_um: Float[Array, " D"] | None) -> Stage:
        """The stage with these coordinates and columns, and no offset; without columns, with those that it has."""
        stage = self.coordinates(z)
        if self.grid is None or self.place is None or columns_um is None:
            return stage
        return stage.swap(stage.names[self.place], self.grid.model(columns_um, jnp.zeros(())))

    def parameters(self, z: np.ndarray) -> tuple[list[tuple[str, str]], np.ndarray, np.ndarray]:
        """Names and units of the parameters outside the grid, values, and derivatives by their own coordinates."""
        point = jnp.asarray(z)
        stage = self.coordinates(point)
        named = [
            (stage.named(info.path) + ("" if info.shape == () else str(list(place))), info.spec.unit)
            for info in self.coordinates.table
            for place in np.ndindex(info.shape)
        ]
        value, slope = jax.jvp(self.coordinates.values, (point,), (jnp.ones_like(point),))
        return named, np.asarray(value), np.asarray(slope)


@kept
def _linearised(
    chain: Chain, z: Float[Array, " p"], columns_um: Float[Array, " D"] | None, samples: Samples
) -> tuple[Float[Array, " n"], Float[Array, "n p"], Float[Array, "n k"]]:
    def response(z: Float[Array, " p"]) -> tuple[Array, Array]:
        out = respond(chain.stage(z, columns_um), samples)
        return out, out

    slope, out = jax.jacfwd(response, has_aux=True)(z)
    return out, slope, nuisance_columns(chain.stage(z, columns_um), samples)


@kept
def _before_and_after(
    coordinates: Coordinates[Stage], place: int, z: Float[Array, " p"], samples: Samples
) -> tuple[Float[Array, " n"], LinearSystem | None]:
    """Voltage that the hysteresis sees, at the samples, and the linear system that follows it."""
    stage = coordinates(z)
    return ahead(stage, place, samples)[:: samples.stride], joined(stage.parts[place + 1 :])


@kept
def _rows(
    grid: Grid,
    table: Float[Array, "4 k D"],
    system: LinearSystem | None,
    interval_s: Float[Array, " k"],
    voltage_V: Float[Array, " k"],
    memory: Staircase,
    begins: Bool[Array, ""],
    carried: tuple[Float[Array, "s D"], Float[Array, " D"]],
) -> tuple[Float[Array, "k D"], Staircase, tuple[Float[Array, "s D"], Float[Array, " D"]]]:
    """Response to every column alone, passed on through what follows the hysteresis.

    Where a run `begins` it is at rest before the first sample.
    """
    response, memory = design(grid, table, voltage_V, memory)
    state, last = carried
    if system is None:
        return response, memory, (state, response[-1])
    last = jnp.where(begins, response[0], last)
    step, taken = system.advance(interval_s, "first")
    change = jnp.diff(response, axis=0, prepend=last[None])

    def visit(state: Array, now: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        matrix, loss, rise = now
        state = matrix @ state - loss[:, None] * rise[None, :]
        return state, system.read @ state

    state, more = lax.scan(visit, state, (jnp.moveaxis(step, 2, 0), taken.T, change))
    return system.gain * response + more, memory, (state, response[-1])


@dataclass(frozen=True)
class RunSums:
    """What one run adds to the regression on columns and coordinates, its nuisance parameters eliminated.

    `mean` is that of the rows over the fitted samples, shape `(D + p,)`; the residual at all samples is `(n,)`.
    """

    moments: Moments
    mean: np.ndarray
    residual_um: np.ndarray


def run_sums(
    chain: Chain, z: Float[Array, " p"], columns_um: Float[Array, " D"], run: Run, free: bool = True
) -> RunSums:
    """Pass one run through the regression on coordinates and, if they are `free`, columns, linearised there."""
    samples, size = run.samples, chain.size if free else 0
    out, slope, nuisance = linearise(chain, z, columns_um, run)
    weight = np.asarray(samples.weight)
    residual = np.asarray(samples.displacement_um) - out
    root = np.sqrt(weight)
    known = size + slope.shape[1]
    rows = np.empty((min(len(weight), _PIECE), known + nuisance.shape[1]))
    sums = Moments.empty(rows.shape[1])
    for first, columns in pieces(chain, z, run, free):
        piece = slice(first, first + columns.shape[0])
        used = rows[: columns.shape[0]]
        used[:, :size], used[:, size:known], used[:, known:] = columns, slope[piece], nuisance[piece]
        target = root[piece] * (residual[piece] + columns @ np.asarray(columns_um)[:size])
        used *= root[piece, None]
        energy, count = np.asarray(target @ target), np.asarray(weight[piece].sum())
        sums = sums + Moments(used.T @ used, used.T @ target, energy, count)
    reduced, _, _ = split_moments(sums, known, 0.0)
    off = np.asarray(project_out(jnp.asarray(nuisance), samples.weight, jnp.asarray(residual)))
    return RunSums(reduced, np.asarray(sums.gram)[:known, known] / weight.sum(), off[: len(run.record)])


def linearise(
    chain: Chain, z: Float[Array, " p"], columns_um: Float[Array, " D"] | None, run: Run
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Response of a padded run, its slopes along the coordinates, and its nuisance columns."""
    out, slope, nuisance = _linearised(chain, z, columns_um, run.samples)
    return np.asarray(out), np.asarray(slope), np.asarray(nuisance)


def along(
    chain: Chain,
    z: Float[Array, " p"],
    columns_um: Float[Array, " D"] | None,
    run: Run,
    directions: Sequence[np.ndarray],
    slope: np.ndarray | None = None,
    reduce: Callable[[np.ndarray], np.ndarray] = lambda moved: moved,
) -> np.ndarray:
    """Move columns, `(D, k)`, and coordinates, `(p, k)`, to first order: changes of the displacement, shape `(n, k)`.

    Without columns the run is linearised at those that the stage has, whose grid may then differ from the chain's.
    The `slope` along the coordinates, shape `(n, p)`, may be known. Of the changes of each piece, `(samples, k)`,
    only what `reduce` makes of them is kept.
    """
    slope = linearise(chain, z, columns_um, run)[1] if slope is None else slope
    moved_um: Iterable[np.ndarray] = (columns @ directions[0] for _, columns in pieces(chain, z, run, True))
    if chain.place is not None and not passes_linearly(stage := chain.stage(z, columns_um), chain.place):
        # What is not linear needs all of a record at a time.
        around_um = np.asarray(ahead(stage, chain.place + 1, run.samples))[:: run.samples.stride][: len(run.record)]
        whole_um = np.concatenate([*moved_um])
        whole_um = propagated(chain.coordinates, chain.place, z, run, around_um, whole_um)
        moved_um = (whole_um[first : first + _PIECE] for first in range(0, len(whole_um), _PIECE))
    found, first = [], 0
    for each in moved_um:
        found.append(reduce(each + slope[first : first + len(each)] @ directions[1]))
        first += len(each)
    return np.concatenate(found)


def pieces(chain: Chain, z: Float[Array, " p"], run: Run, free: bool) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the rows of the columns, piece by piece, with the sample that each piece begins at.

    They are not refined: good enough as directions to move in, while only the residual decides where the fit ends.
    """
    samples, grid, n = run.samples, chain.grid, len(run.record)
    if grid is None or chain.place is None or not free:
        yield from ((first, np.zeros((min(_PIECE, n - first), 0))) for first in range(0, n, _PIECE))
        return
    voltage, system = _before_and_after(chain.coordinates, chain.place, z, samples)
    table = jnp.asarray(branch_table(grid.levels))
    memory = samples.start.memory
    carried: tuple[Any, Any] = np.zeros((0 if system is None else system.order, grid.columns)), np.zeros(grid.columns)
    between_s = np.diff(run.record.time_s)
    # The state before the first sample is one of rest, which no interval changes.
    interval = np.append(between_s[:1] if n > 1 else 1.0, between_s)
    path = np.asarray(voltage)[:n]
    for first in range(0, n, _PIECE):
        pad = (0, max(0, first + _PIECE - n))
        piece = slice(first, first + _PIECE)
        rows, memory, carried = _rows(
            grid,
            table,
            system,
            jnp.asarray(np.pad(interval[piece], pad, mode="edge")),
            jnp.asarray(np.pad(path[piece], pad, mode="edge")),
            memory,
            jnp.asarray(first == 0),
            carried,
        )
        yield first, np.asarray(rows)[: _PIECE - pad[1]]


def split_moments(total: Moments, size: int, damping: float) -> tuple[Moments, np.ndarray, np.ndarray]:
    """Eliminate the last unknowns of a regression, all but the first `size`, with Marquardt's damping.

    Returns the moments of those that stay, the others at their best for each; the best of the others without them,
    shape `(p,)`; and what that loses for each of them, shape `(p, D)`.
    """
    gram, cross = np.asarray(total.gram), np.asarray(total.cross_um)
    block = gram[size:, size:]
    block = block + damping * np.diag(np.diagonal(block)) + 1e-14 * np.trace(block) * np.eye(len(block))
    answer, follow = np.linalg.solve(block, cross[size:]), np.linalg.solve(block, gram[size:, :size])
    return total.reduced(size, answer, follow), answer, follow
