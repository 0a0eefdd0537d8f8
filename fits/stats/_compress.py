"""A long record in few pseudo-samples, without loss for least squares.

Within one interval of the levels and on one branch, the response to every column is a cubic in the voltage. However
many samples fall there, four numbers carry all that they say: a visit of more than four samples is replaced by four
voltages and a 4 x 4 mixing matrix. What a fit costs then depends on the path, not on the sampling rate.
"""

from dataclasses import dataclass

import numpy as np

# A branch that goes less far than this, in steps of the grid, stands still.
_SMALLEST_MOVE = 1e-12
_SLOTS = 4
_NEGLIGIBLE = 1e-14


@dataclass(frozen=True)
class Compressed:
    """Groups of four voltages, in the order of the path.

    Sums of squares and products of `mix @ response(voltage_V) ~ target_um` equal those of the samples; the squares
    that no response could explain are in `residue_um2`. `block` is -1, and `mix` zero, where samples are not used;
    `count` is their number, each as often as it counts.
    """

    voltage_V: np.ndarray
    mix: np.ndarray
    target_um: np.ndarray
    block: np.ndarray
    count: np.ndarray
    residue_um2: np.ndarray


def compress(
    voltage_V: np.ndarray,
    displacement_um: np.ndarray,
    anchor_V: np.ndarray,
    rising: np.ndarray,
    block: np.ndarray,
    levels_V: np.ndarray,
    weight: np.ndarray | None = None,
) -> Compressed:
    """Group the samples of a record by their branches (see `fits.loop._run.Path`) and by evenly spaced levels.

    `block` numbers the part of the record that each sample belongs to, -1 where it is not used.
    """
    share = np.ones(len(voltage_V)) if weight is None else weight
    step = levels_V[1] - levels_V[0]
    cell = np.clip(((voltage_V - levels_V[0]) / step).astype(np.int64), 0, len(levels_V) - 2)
    changed = (np.diff(anchor_V) != 0) | (np.diff(rising) != 0) | (np.diff(cell) != 0) | (np.diff(block) != 0)
    first = _group_starts(np.concatenate([[True], changed]), block)
    last = np.append(first[1:], len(voltage_V)) - 1
    size = last - first + 1
    group = np.repeat(np.arange(len(first)), size)
    dense = size > _SLOTS

    # Samples as they are, the last one repeated to fill its group.
    slot = np.minimum(np.arange(_SLOTS)[None, :], size[:, None] - 1) + first[:, None]
    filled = np.arange(_SLOTS)[None, :] < size[:, None]
    voltage, target = voltage_V[slot], np.where(filled, displacement_um[slot], 0.0)
    root = np.sqrt(share)[slot] * filled
    target *= root
    mix = np.eye(_SLOTS)[None] * root[:, :, None]
    residue = np.zeros(len(first))

    # Visits of many samples: moments of the fraction of the way, then the square root of their Gram matrix.
    start, span = voltage_V[first], voltage_V[last] - voltage_V[first]
    safe = np.where(np.abs(span) <= _SMALLEST_MOVE * step, 1.0, span)
    way = (voltage_V - start[group]) / safe[group]
    powers = np.vander(way, 2 * _SLOTS - 1, increasing=True)
    powers *= share[:, None]
    moments = np.add.reduceat(powers, first)[dense]
    cross = np.add.reduceat(powers[:, :_SLOTS] * displacement_um[:, None], first)[dense]
    energy = np.add.reduceat(share * displacement_um**2, first)[dense]
    hankel = moments[:, np.arange(_SLOTS)[:, None] + np.arange(_SLOTS)[None, :]]
    # Chebyshev-Lobatto nodes, which include the ends, so that every reversal stays in the path; and the coefficients
    # of the polynomials that are 1 at one of them.
    nodes = (1 - np.cos(np.pi * np.arange(_SLOTS) / (_SLOTS - 1))) / 2
    lagrange = np.linalg.inv(np.vander(nodes, increasing=True)).T
    root, right, left = square_root(lagrange @ hankel @ lagrange.T, cross @ lagrange.T, energy)
    voltage[dense] = start[dense, None] + span[dense, None] * nodes
    mix[dense], target[dense], residue[dense] = root, right, left

    used = block[first] >= 0
    return Compressed(
        voltage_V=voltage,
        mix=np.where(used[:, None, None], mix, 0.0),
        target_um=np.where(used[:, None], target, 0.0),
        block=block[first],
        count=np.where(used, np.add.reduceat(share, first), 0.0),
        residue_um2=np.where(used, residue, 0.0),
    )


def _group_starts(visit_starts: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Keep visits of many samples whole; pack the samples of short ones together, four by four."""
    n = len(visit_starts)
    first = np.flatnonzero(visit_starts)
    dense = np.repeat(np.diff(np.append(first, n)) > _SLOTS, np.diff(np.append(first, n)))
    # A stretch of short visits ends at a dense one and at the border of a block.
    border = np.concatenate([[True], (np.diff(dense) != 0) | (np.diff(block) != 0)]) | (visit_starts & dense)
    opening = np.maximum.accumulate(np.where(border, np.arange(n), 0))
    packed = ~dense & ((np.arange(n) - opening) % _SLOTS == 0)
    return np.flatnonzero(border | packed)


def square_root(
    gram: np.ndarray, cross: np.ndarray, energy: np.ndarray, negligible: float = _NEGLIGIBLE
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Factor each `gram = root' root`, solve `root' target = cross`, and what that leaves of the energies.

    Directions that hold less than a part of the largest are dropped.
    """
    value, vector = np.linalg.eigh(gram)
    kept = value > negligible * value[:, -1:]
    scale = np.sqrt(np.where(kept, value, 0.0))
    root = scale[:, :, None] * np.swapaxes(vector, 1, 2)
    seen = np.einsum("gij,gi->gj", vector, cross)
    target = np.where(kept, seen / np.where(kept, scale, 1.0), 0.0)
    return root, target, np.maximum(energy - np.sum(target**2, axis=1), 0.0)
