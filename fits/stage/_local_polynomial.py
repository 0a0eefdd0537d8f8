"""A frequency response from neighbouring lines together, without a model of it: the local polynomial method."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

_DEGREE = 2
# Neighbours on each side that are tried where the record is to choose.
TRIED = (2, 3, 4, 6, 8, 12)


def local_polynomial(
    drive: NDArray[Any], moved: NDArray[Any], neighbours: int
) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.float64], NDArray[Any]]:
    """Fit a response that is a polynomial of second degree about each line, by least squares.

    `drive` are spectra of the inputs, shape `(f, r, m)`, and `moved` of the outputs, `(f, r, p)`, in V and um, of `r`
    realizations. The bias is that of the third derivative, within so many `neighbours` on each side. See Pintelon and
    Schoukens, *System Identification: A Frequency Domain Approach* (2012), section 7.2.

    Returns the response, `(f, p, m)`, the variance of the outputs about it, `(f, p)`, the variance of the response
    over the latter, `(f, m)`, and what is left of each realization where the fit is to the others, `(f, r, p)`.
    """
    lines, realizations, inputs = drive.shape
    width = 2 * neighbours + 1
    first = np.clip(np.arange(lines) - neighbours, 0, lines - width)
    near = first[:, None] + np.arange(width)
    away = (near - np.arange(lines)[:, None]) / neighbours
    powers = away[..., None] ** np.arange(_DEGREE + 1)
    # Of each line: neighbours, realizations, and the columns of all inputs to each power.
    columns = np.einsum("fwd,fwrm->frwdm", powers, drive[near]).reshape(lines, realizations, width, -1)
    target = np.moveaxis(moved[near], 2, 1)
    gram = np.swapaxes(columns, 2, 3).conj() @ columns
    cross = np.swapaxes(columns, 2, 3).conj() @ target
    whole = np.linalg.inv(gram.sum(axis=1))
    found = whole @ cross.sum(axis=1)
    left = target - columns @ found[:, None]
    freedom = realizations * width - columns.shape[3]
    total = np.sum(np.abs(left) ** 2, axis=(1, 2)) / freedom
    others = np.linalg.solve(gram.sum(axis=1)[:, None] - gram, cross.sum(axis=1)[:, None] - cross)
    predicted = np.einsum("frm,frmp->frp", drive, others[:, :, :inputs])
    spread = np.real(np.diagonal(whole, axis1=1, axis2=2))[:, :inputs]
    return np.swapaxes(found[:, :inputs], 1, 2), total, spread, moved - predicted
