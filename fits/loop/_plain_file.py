"""Which model files do without JAX."""

import base64
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from fits.loop._plain import Perturbations, PlainLoop
from fits.loop._surface import Surface, spread

# What is larger in size is refused where JAX reads it.
_LARGEST, _FINEST = 1e30, 1000
# What is raised by anything that is not as `microid fit` writes it.
ODD = (LookupError, TypeError, ValueError, AttributeError)


def plain_loop(content: Mapping[str, Any]) -> PlainLoop | None:
    """The hysteresis of a model file, as `read_model_text` gives it.

    None where JAX is to take it, and to say what is wrong with it: where it is no Preisach operator on a grid with
    its uncertainty, as `microid fit` writes it, and where anything is odd.
    """
    try:
        law = read_law(content["model"])
        known = content["uncertainty"], "Uncertainty", "columns_um", "offset_um", "discrepancy_um", "grid"
        columns, offsets, discrepancy, grid = fields_of(*known)
        columns_um, offsets_um = array_of(columns, 2, packed=True), array_of(offsets, 1)
        moved = read_directions(columns_um, grid)
        if not len(offsets_um) == len(columns_um) > 0:
            return None
        uncertainty = Perturbations(*moved, offsets_um, float(array_of(discrepancy, 0)))
    except ODD:
        return None
    return replace(law, uncertainty=uncertainty, report=content["fit"])


def read_law(item: Mapping[str, Any]) -> PlainLoop:
    """A Preisach operator on a grid, without an uncertainty; one of the exceptions `ODD` where it is another part."""
    density, reversible, offset = fields_of(item, "Preisach", "density", "reversible", "offset_um")
    packed, *ends = fields_of(density, "GridDensity", "packed_um", "lower_V", "upper_V")
    slope, *others = fields_of(reversible, "Reversible", "slope_um_per_V", "lower_V", "upper_V")
    weights_um, slope_um_per_V = array_of(packed, 1, "um", 0.0), array_of(slope, 1, "um/V", 0.0)
    lower_V, upper_V, *_ = (float(array_of(end, 0)) for end in (*ends, *others))
    levels = len(slope_um_per_V)
    if not (levels >= 2 and len(weights_um) == levels * (levels + 1) // 2 and lower_V < upper_V):
        raise ValueError("no grid")
    with np.errstate(all="ignore"):
        weights = (weights_um / _node_areas(levels)[np.tril_indices(levels)])[:, None]
        nodes = spread(weights, levels) / (upper_V - lower_V) ** 2
        surface = Surface.of(nodes, slope_um_per_V[:, None], lower_V, upper_V)
    if not (np.isfinite(surface.window_um).all() and np.isfinite(surface.branch_um).all()):
        raise ValueError("too large")
    return PlainLoop(surface, float(array_of(offset, 0, "um")))


def read_directions(
    columns_um: np.ndarray, grid: Mapping[str, Any]
) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Densities and slopes of perturbations, `(k, D)`, as `Surface.of` takes them, and the range of their grid."""
    *ends, levels = fields_of(grid, "Grid", "lower_V", "upper_V", "levels")
    lower_V, upper_V = (float(array_of(end, 0)) for end in ends)
    size = levels * (levels + 1) // 2
    if not (2 <= levels <= _FINEST and columns_um.shape[1] == size + levels and lower_V < upper_V):
        raise ValueError("another grid")
    range_V = upper_V - lower_V
    with np.errstate(all="ignore"):
        density, slope = spread(columns_um[:, :size].T, levels) / range_V**2, columns_um[:, size:].T / range_V
    if not (np.isfinite(density).all() and np.isfinite(slope).all()):
        raise ValueError("too large")
    return density, slope, (lower_V, upper_V)


def fields_of(item: Mapping[str, Any], kind: str, *names: str) -> list[Any]:
    """Fields of a part of a kind; a `ValueError` where it is another, or has others."""
    if item["type"] != kind or set(item) != {"type", *names}:
        raise ValueError(kind)
    return [item[name] for name in names]


def array_of(
    item: Mapping[str, Any], axes: int, unit: str | None = None, least: float = -_LARGEST, packed: bool = False
) -> np.ndarray:
    """Numbers of a field in float64; a `ValueError` where they are not as `microid fit` writes them.

    Only what may be `packed` may be in base64.
    """
    if packed and set(item) == {"unit", "shape", "float64_base64"}:
        data = base64.b64decode(item["float64_base64"], validate=True)
        array = np.frombuffer(data, "<f8").reshape(item["shape"])
    else:
        array = np.asarray(item["value"])
    plain = packed or set(item) == {"unit", "value"}
    sized = array.dtype.kind in "if" and array.ndim == axes and np.all((array >= least) & (array <= _LARGEST))
    if not (plain and sized and unit in (None, item["unit"])):
        raise ValueError("another form")
    return array.astype(np.float64)


def _node_areas(levels: int) -> np.ndarray:
    """Integrals of the hat functions of the nodes, in the range squared; see `microid.densities.node_areas`."""
    i, edge = np.arange(levels - 1), np.ones(levels)
    edge[[0, -1]] = 1 / 2
    area = np.tril(np.outer(edge, edge), -1)
    # The triangles along the diagonal: a third of each goes to each of its nodes.
    area[i + 1, i] -= 1 / 4 - 1 / 6
    area[i, i] += 1 / 6
    area[i + 1, i + 1] += 1 / 6
    area[np.arange(1, levels - 1), np.arange(1, levels - 1)] += 1 / 4
    return area / (levels - 1) ** 2
