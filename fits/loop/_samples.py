"""The arrays of a run as compiled functions of a stage take them: padded, and refined in time."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.io._errors import DataError
from fits.io._record import Record
from fits.io.columns import columns_beside
from microid import Hold, Staircase, Start, refined

# Records are filled up to a power of two, so that those of like length share what was compiled.
_SHORTEST = 1024
# Intervals that differ by less than this from their mean, as a fraction of it, count as even.
_EVEN = 1e-6
# Extremes that a memory may hold: filtered multisines nest deeply.
_EXTREMES = 512
# A hundred arrays of so many values are 8 GB.
_MOST_STEPS = 10_000_000


class Samples(eqx.Module):
    """A run of `n` samples, padded, with `m = (n - 1) stride + 1` steps.

    `time_s` is the one interval between steps where they are even. `weight` is that of each sample in the sum of
    squares, 0 where it is not fitted. `moving` says whether the stage may have been moving when the record began, and
    `has_past` whether the unknown memory of its hysteresis is estimated.
    `beside` holds further columns under the names of `columns_beside`.
    """

    time_s: Float[Array, " m"] | Float[Array, ""]
    voltage_V: Float[Array, " m"]
    displacement_um: Float[Array, " n"]
    weight: Float[Array, " n"]
    start: Start
    stride: int = eqx.field(static=True)
    moving: bool = eqx.field(static=True)
    beside: dict[str, Float[Array, " m"]] = eqx.field(default_factory=dict)
    has_past: bool = eqx.field(static=True, default=False)


def refine(
    record: Record,
    weight: np.ndarray,
    start: Staircase,
    stride: int,
    moving: bool,
    hold: Hold,
    has_past: bool = False,
) -> Samples:
    """Fill up a record, divide its intervals into steps, and take a displacement that it lacks for zero."""
    refuse_many_steps(record, stride)
    n, time_s = len(record), record.time_s
    pad = (0, max(_SHORTEST, 1 << (n - 1).bit_length()) - n)
    step = (time_s[-1] - time_s[0]) / (n - 1)
    share = np.arange((n + pad[1] - 1) * stride + 1) / stride
    _, voltage_V = refined(jnp.ones(()), jnp.asarray(np.pad(record.voltage_V, pad, mode="edge")), stride, hold)
    if np.max(np.abs(np.diff(time_s) - step)) <= _EVEN * step:
        time: Any = np.asarray(step / stride)
    else:
        longer = np.concatenate([time_s, time_s[-1] + step * np.arange(1, pad[1] + 1)])
        time = np.interp(share, np.arange(n + pad[1]), longer)
    measured = np.zeros(n) if record.displacement_um is None else record.displacement_um
    return Samples(
        time_s=jnp.asarray(time),
        voltage_V=voltage_V,
        displacement_um=jnp.asarray(np.pad(measured, pad, mode="edge")),
        weight=jnp.asarray(np.pad(weight, pad)),
        start=Start(memory=resized(start, _EXTREMES)),
        stride=stride,
        moving=moving,
        beside={name: jnp.asarray(np.interp(share, np.arange(n), v)) for name, v in columns_beside(record).items()},
        has_past=has_past,
    )


def resized(start: Staircase, size: int) -> Staircase:
    """Give a memory room for so many extremes at least."""
    pad = jnp.full(max(0, size - start.extremes_V.shape[0]), start.extremes_V[0])
    return Staircase(jnp.concatenate([start.extremes_V, pad]), start.count)


def refuse_many_steps(record: Record, stride: int) -> None:
    """Refuse, in a `DataError`, what would not fit into the memory."""
    if stride * len(record) > _MOST_STEPS:
        raise DataError(
            f"{record.source}: expected at most {_MOST_STEPS:,} steps, found {len(record):,} samples of {stride} "
            "substeps each; split the record, or use a model of fewer substeps"
        )
