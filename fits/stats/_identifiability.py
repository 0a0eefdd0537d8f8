"""What data do not tell, by name."""

from collections.abc import Sequence

import numpy as np

# A coordinate, which is scaled to be of the order of 1, that is known no better than this is not known.
_UNKNOWN = 1.0
# Entries of a direction below this share of its largest are left out of its name.
_FAINT = 0.15
# Exponents this close to 1 or -1 are taken for them.
_WHOLE = 0.1


def unseen_directions(information: np.ndarray, names: Sequence[str], relative: np.ndarray) -> tuple[str, ...]:
    """Name the combinations of parameters that the data leave open, one sentence each, in the order of ignorance.

    `information` is the precision of the coordinates, whatever else is unknown, shape `(p, p)`; `relative` the change
    of each parameter's logarithm per coordinate, shape `(p,)`.
    """
    values, vectors = np.linalg.eigh(information)
    sentences = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value * _UNKNOWN**2 > 1:
            break
        sentences.append(_sentence(vector * relative, names))
    return tuple(sentences)


def _sentence(direction: np.ndarray, names: Sequence[str]) -> str:
    # A parameter at its bound does not move with its coordinate.
    direction = np.where(np.isfinite(direction), direction, 0.0)
    size = np.abs(direction)
    moved = [k for k in np.argsort(-size, kind="stable") if size[k] > _FAINT * size.max()]
    if not moved:
        return f"some combination of {', '.join(names)} is not seen in these runs"
    if len(moved) == 1:
        return f"{names[moved[0]]} is not seen in these runs"
    exponents = direction[moved] / direction[moved[0]]
    if len(moved) == 2 and abs(abs(exponents[1]) - 1) < _WHOLE:
        one, other = names[moved[0]], names[moved[1]]
        # Along the direction one rises as the other falls, or with it: their product, or ratio, stays.
        joint = f"{one} * {other}" if exponents[1] < 0 else f"{one} / {other}"
        return f"only {joint} is seen, not each"
    listed = f"{', '.join(names[k] for k in moved[:-1])} and {names[moved[-1]]}"
    return f"of {listed} only {len(moved) - 1} combinations are seen, not each"
