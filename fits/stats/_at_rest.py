"""What a record shows of its sensor alone: stretches at rest, and its least significant bit."""

import numpy as np

# A command that rests for this many samples is idle from a third of the rest on.
_FEWEST_AT_REST = 24


def stretches(flags: np.ndarray) -> list[tuple[int, int]]:
    """First sample, and that after the last, of each stretch of flags that are set."""
    edges = np.flatnonzero(np.diff(flags.astype(int), prepend=0, append=0))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def idle_stretches(voltage_V: np.ndarray, settling: int) -> list[slice]:
    """Stretches in which the command has rested for a while, and for so many samples at least."""
    found = []
    for first, stop in stretches(np.diff(voltage_V) == 0):
        begin = max(first + (stop - first) // 3, first + settling)
        if stop - begin >= 2 * _FEWEST_AT_REST // 3:
            found.append(slice(begin, stop))
    return found


def quantum_um(values_um: np.ndarray) -> float:
    """Last digit of a sensor: the spacing of which all readings are multiples; 0 where there is none."""
    distinct = np.unique(values_um)
    if len(distinct) < 3 or len(distinct) > 0.7 * len(values_um):
        return 0.0
    gaps = np.diff(distinct)
    gaps = gaps[gaps > 1e-9 * float(np.ptp(distinct))]
    smallest = float(np.quantile(gaps, 0.05))
    spacing = float(np.median(gaps[gaps < 1.5 * smallest]))
    turns = (distinct - distinct[0]) / spacing
    # Refined over the whole range, where a small error of the spacing adds up.
    whole = np.round(turns)
    for _ in range(3):
        spacing = float(whole @ (distinct - distinct[0]) / (whole @ whole))
        whole = np.round((distinct - distinct[0]) / spacing)
    off = np.abs((distinct - distinct[0]) / spacing - whole)
    return spacing if float(np.mean(off < 0.1)) > 0.95 else 0.0
