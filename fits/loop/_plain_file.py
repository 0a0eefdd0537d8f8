"""Which model files do without JAX."""

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np

from fits.loop._plain import Perturbations, PlainLoop
from fits.loop._surface import Surface, spread

# What is larger in size is refused where JAX reads it.
_LARGEST, _FINEST = 1e30, 1000


def plain_loop(content: Mapping[str, Any]) -> PlainLoop | None:
    """The hysteresis of a model file, as `read_model_text` gives it.

    None where JAX is to take it, and to say what is wrong with it: where it is no Preisach operator on a grid with
    its uncertainty, as `microid fit` writes it, and where anything is odd.
    """
    try:
        density, reversible, offset = _fields(content["model"], "Preisach", "density", "reversible", "offset_um")
        packed, *ends = _fields(density, "GridDensity", "packed_um", "lower_V", "upper_V")
        slope, *others = _fields(reversible, "Reversible", "slope_um_per_V", "lower_V", "upper_V")
        known = content["uncertainty"], "Uncertainty", "columns_um", "offset_um", "discrepancy_um", "grid"
        columns, offsets, discrepancy, grid = _fields(*known)
        *grid_ends, levels = _fields(grid, "Grid", "lower_V", "upper_V", "levels")
        weights_um, slope_um_per_V = _array(packed, 1, "um", 0.0), _array(slope, 1, "um/V", 0.0)
        lower_V, upper_V, *_ = (float(_array(end, 0)) for end in (*ends, *others))
        grid_V = float(_array(grid_ends[0], 0)), float(_array(grid_ends[1], 0))
        offset_um, columns_um, offsets_um = float(_array(offset, 0, "um")), _array(columns, 2), _array(offsets, 1)
        discrepancy_um, count = float(_array(discrepancy, 0)), len(columns_um)
        own, size = np.tril_indices(len(slope_um_per_V)), levels * (levels + 1) // 2
        if not (
            len(slope_um_per_V) == 1 + own[0][-1]
            and len(weights_um) == len(own[0])
            and len(offsets_um) == count > 0
            and 2 <= levels <= _FINEST
            and columns_um.shape[1] == size + levels
        ):
            return None
    except (LookupError, TypeError, ValueError, AttributeError):
        return None
    with np.errstate(all="ignore"):
        weights = (weights_um / _node_areas(len(slope_um_per_V))[own])[:, None]
        nodes = spread(weights, len(slope_um_per_V)) / (upper_V - lower_V) ** 2
        surface = Surface.of(nodes, slope_um_per_V[:, None], lower_V, upper_V)
        range_V = grid_V[1] - grid_V[0]
        moved = spread(columns_um[:, :size].T, levels) / range_V**2, columns_um[:, size:].T / range_V
    sound = all(np.isfinite(one).all() for one in (surface.window_um, surface.branch_um, *moved))
    if not (lower_V < upper_V and range_V > 0 and sound):
        return None
    uncertainty = Perturbations(*moved, grid_V, offsets_um, discrepancy_um)
    return PlainLoop(surface, offset_um, uncertainty, content["fit"])


def _fields(item: Mapping[str, Any], kind: str, *names: str) -> list[Any]:
    """Fields of a part of a kind; a `ValueError` where it is another, or has others."""
    if item["type"] != kind or set(item) != {"type", *names}:
        raise ValueError(kind)
    return [item[name] for name in names]


def _array(item: Mapping[str, Any], axes: int, unit: str | None = None, least: float = -_LARGEST) -> np.ndarray:
    """Numbers of a field in float64; a `ValueError` where they are not as `microid fit` writes them."""
    if set(item) == {"unit", "shape", "float64_base64"}:
        data = base64.b64decode(item["float64_base64"], validate=True)
        array = np.frombuffer(data, "<f8").reshape(item["shape"])
    else:
        array = np.asarray(item["value"])
    plain = set(item) == {"unit", "value"} or axes == 2
    sized = array.dtype.kind in "if" and array.ndim == axes and np.all((array >= least) & (array <= _LARGEST))
    if not (plain and sized and unit in (None, item["unit"])):
        raise ValueError("another form")
    return array.astype(np.float64)


def _node_areas(levels: int) -> np.ndarray:
    """Integrals of the hat functions of the nodes, in units of the range squared; see `microid.node_areas`."""
    i, edge = np.arange(levels - 1), np.ones(levels)
    edge[[0, -1]] = 1 / 2
    area = np.tril(np.outer(edge, edge), -1)
    # The triangles along the diagonal: a third of each goes to each of its nodes.
    area[i + 1, i] -= 1 / 4 - 1 / 6
    area[i, i] += 1 / 6
    area[i + 1, i + 1] += 1 / 6
    area[np.arange(1, levels - 1), np.arange(1, levels - 1)] += 1 / 4
    return area / (levels - 1) ** 2
