"""Many variants of one stage under many commands at once.

On a CPU what a hysteresis remembers is found row by row, as a loop of scalars runs fastest there, and all the rest
for all rows together. Elsewhere, and for stages with other parts, the stage itself is mapped over the rows. Both
give the same numbers but for rounding.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from fits.sweeps._devices import by_rows
from fits.sweeps._stages import varied
from microid import (
    AbstractLinear,
    Everett,
    Hold,
    LinearSystem,
    Preisach,
    Stage,
    Staircase,
    Start,
    forest_sum,
    remember,
)

# A quadratic B-spline has three pieces, see `microid.Everett`.
_WINDOW = 3


def respond(
    stage: Stage,
    table: Float[Array, "n k"],
    names: tuple[str, ...],
    relative: tuple[str, ...],
    interval_s: float,
    voltage_V: Float[Array, "n t"],
    memory: Staircase | None,
    on_cpu: bool,
) -> Float[Array, "n t"]:
    """Respond to commands, each row at rest under its first sample.

    Parameters
    ----------
    stage
        What is simulated.
    table, names, relative
        Parameters that vary, one column each, their names, and those that are factors; see `varied`.
    interval_s
        Between samples.
    voltage_V
        Commands, shape `(n, t)`.
    memory
        Of the hysteresis before all rows.
    on_cpu
        Whether this runs on a CPU.

    Returns
    -------
    Array
        Displacement in um, shape `(n, t)`.
    """
    interval = jnp.asarray(interval_s)
    if not on_cpu or not _plain(stage):
        return _mapped(stage, table, names, relative, interval, voltage_V, memory)
    links = _links(stage)
    # A program for each link: compiled as one, XLA computes much of it several times.
    signal, before, hold = voltage_V, voltage_V[:, 0], stage.hold
    for link in _pieces(stage, table, names, relative, links):
        if isinstance(link, LinearSystem):
            signal, before = _linear(link, interval, signal, before, hold)
            if link.rest.shape[1]:
                hold = "first" if hold == "zero" else "smooth"
        else:
            assert memory is not None
            signal, before = _hysteresis(*link, signal, before, memory)
    return signal


@by_rows("table", "voltage")
def _mapped(
    stage: Stage,
    table: Float[Array, "n k"],
    names: tuple[str, ...],
    relative: tuple[str, ...],
    interval: Float[Array, ""],
    voltage: Float[Array, "n t"],
    memory: Staircase | None,
) -> Float[Array, "n t"]:
    start = Start(None, memory)
    vary = partial(_vary, stage, names, relative)
    return jax.vmap(lambda row, signal: vary(row)(interval, signal, start))(table, voltage)


@by_rows("table")
def _pieces(
    stage: Stage,
    table: Float[Array, "n k"],
    names: tuple[str, ...],
    relative: tuple[str, ...],
    links: tuple[tuple[int, int], ...],
) -> list[LinearSystem | tuple[Everett, Float[Array, " n"]]]:
    """What each link is, for all rows."""
    vary = partial(_vary, stage, names, relative)
    found: list[LinearSystem | tuple[Everett, Float[Array, " n"]]] = []
    for first, last in links:
        if isinstance(stage.parts[first], Preisach):
            # One row stands for all where it is the same: its tables then stay in the cache.
            alone = not any(name.startswith(f"{stage.names[first]}.") for name in names)
            found.append(jax.vmap(partial(_surface, vary, first))(table[:1] if alone else table))
        else:
            found.append(jax.vmap(partial(_joined, vary, first, last))(table))
    return found


def _vary(stage: Stage, names: tuple[str, ...], relative: tuple[str, ...], row: Float[Array, " k"]) -> Stage:
    return varied(stage, dict(zip(names, row, strict=True)), relative)


def _plain(stage: Stage) -> bool:
    """Whether all parts are ones that are treated here."""
    return stage.substeps == 1 and all(isinstance(part, AbstractLinear | Preisach) for part in stage.parts)


def _links(stage: Stage) -> tuple[tuple[int, int], ...]:
    """First and last place of neighbouring linear parts, and places of a hysteresis."""
    links: list[tuple[int, int]] = []
    for place, part in enumerate(stage.parts):
        joins = links and isinstance(part, AbstractLinear) and isinstance(stage.parts[place - 1], AbstractLinear)
        if joins:
            links[-1] = (links[-1][0], place)
        else:
            links.append((place, place))
    return tuple(links)


def _joined(vary: Callable[[Array], Stage], first: int, last: int, row: Float[Array, " k"]) -> LinearSystem:
    systems = [part.system() for part in vary(row).parts[first : last + 1] if isinstance(part, AbstractLinear)]
    whole = systems[0]
    for system in systems[1:]:
        whole = whole.then(system)
    return whole


def _surface(vary: Callable[[Array], Stage], place: int, row: Float[Array, " k"]) -> tuple[Everett, Float[Array, ""]]:
    part = vary(row).parts[place]
    assert isinstance(part, Preisach)
    return part.everett, part.offset_um


@by_rows("system", "signal", "before")
def _linear(
    system: LinearSystem, interval_s: Float[Array, ""], signal: Float[Array, "n t"], before: Array, hold: Hold
) -> tuple[Float[Array, "n t"], Float[Array, " n"]]:
    """Outputs of one system per row, and those at rest before."""
    return _driven(system, interval_s, signal, before, hold), system.offset + system.gain * before


def _driven(
    system: LinearSystem, interval_s: Float[Array, ""], signal: Float[Array, "n t"], before: Array, hold: Hold
) -> Float[Array, "n t"]:
    """Outputs of one system per row; see `LinearSystem.respond`."""
    order = system.rest.shape[1]
    level = system.offset[:, None] + system.gain[:, None] * signal
    if order == 0:
        return level
    if hold == "smooth":
        bend = jnp.pad(jnp.diff(signal, 2, axis=1) / 12, ((0, 0), (1, 1)))
        directly = system.gain - jnp.sum(system.read * system.rest, axis=1)
        return _driven(system, interval_s, signal - bend, before, "first") + directly[:, None] * bend
    step, taken = jax.vmap(lambda one: one.advance(interval_s[None], hold))(system)
    step, taken, read = step[..., 0], taken[..., 0], system.read
    start = tuple(system.rest[:, i] * (before - signal[:, 0]) for i in range(order))

    def visit(z: tuple[Array, ...], change: Array) -> tuple[tuple[Array, ...], Array]:
        z = tuple(
            sum((step[:, i, j] * z[j] for j in range(order)), start=-taken[:, i] * change) for i in range(order)
        )
        return z, sum((read[:, i] * z[i] for i in range(order)), start=jnp.zeros_like(change))

    first = sum((read[:, i] * start[i] for i in range(order)), start=level[:, 0])
    _, moved = lax.scan(visit, start, jnp.diff(signal, axis=1).T)
    return jnp.concatenate([first[:, None], level[:, 1:] + moved.T], axis=1)


@by_rows("surface", "offset", "voltage", "before")
def _hysteresis(
    surface: Everett, offset: Float[Array, " n"], voltage: Float[Array, "n t"], before: Array, memory: Staircase
) -> tuple[Float[Array, "n t"], Float[Array, " n"]]:
    """Outputs of one Preisach operator per row, and those at rest before; see `Everett.respond`."""
    whole = jnp.concatenate([before[:, None], voltage], axis=1)
    remembered = lax.map(lambda path: remember(path, memory), whole)
    anchor, rising, path = remembered.anchor, remembered.rising, remembered.path_V
    interval, share = lax.optimization_barrier(_place(surface, path))
    pair = (jnp.take_along_axis(values, anchor, axis=1) for values in (interval, share))
    old, past = lax.optimization_barrier(tuple(pair))
    high = jnp.where(rising, interval, old), jnp.where(rising, share, past)
    low = jnp.where(rising, old, interval), jnp.where(rising, past, share)
    step = jnp.where(rising, -1.0, 1.0) * _window(surface.window_um, surface.branch_um.shape[2] // 2, high, low)
    step = lax.optimization_barrier(step.at[:, 0].set(0))
    total = lax.map(lambda now: forest_sum(*now), (step, anchor))
    branch = jnp.where(rising, interval, interval + surface.branch_um.shape[2] // 2)
    rows = jnp.arange(surface.branch_um.shape[0], dtype=jnp.int32)[:, None] * surface.branch_um.shape[2]
    c0, c1, c2, c3 = (_pick(surface.branch_um[:, k].ravel(), rows + branch) for k in range(4))
    output = offset[:, None] + total + c0 + share * (c1 + share * (c2 + share * c3))
    lead = memory.extremes_V.shape[0]
    return output[:, lead + 1 :], output[:, lead]


def _place(surface: Everett, voltage: Float[Array, "n t"]) -> tuple[Int[Array, "n t"], Float[Array, "n t"]]:
    n = surface.branch_um.shape[2] // 2
    lower, upper = surface.lower_V[:, None], surface.upper_V[:, None]
    x = (jnp.clip(voltage, lower, upper) - lower) * (n / (upper - lower))
    interval = jnp.clip(x.astype(jnp.int32), 0, n - 1)
    return interval, x - interval.astype(x.dtype)


def _window(table: Float[Array, "n q"], intervals: int, high: Any, low: Any) -> Float[Array, "n t"]:
    (i, s), (j, t) = high, low
    width = intervals + 2
    first = jnp.arange(table.shape[0], dtype=jnp.int32)[:, None] * table.shape[1] + i * width + j
    flat = table.ravel()
    left, right = _basis(s), _basis(t)
    total = jnp.zeros_like(s)
    for p in range(_WINDOW):
        row = sum((right[c] * _pick(flat, first + (p * width + c)) for c in range(_WINDOW)), start=jnp.zeros_like(s))
        total = total + left[p] * row
    return total


def _basis(s: Float[Array, "n t"]) -> tuple[Float[Array, "n t"], ...]:
    return (1 - s) ** 2 / 2, 0.5 + s * (1 - s), s**2 / 2


def _pick(table: Float[Array, " q"], index: Int[Array, "n t"]) -> Float[Array, "n t"]:
    return table.at[index].get(mode="promise_in_bounds")
