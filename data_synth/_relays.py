"""Hysteresis as an explicit sum of hard relays on a grid of switching values."""

import math

import numpy as np

from data_synth._truth_density import Density
from data_synth._types import FloatArray


class RelayGrid:
    """The sum of N (N + 1) / 2 relays, each either off (0) or on (1).

    The voltage range is cut into N cells, and the thresholds are the cells' centres. The relay (i, j), with
    `alpha = thresholds_V[i] >= beta = thresholds_V[j]`, goes on when the voltage reaches alpha and off when it falls
    below beta. Its weight (um) is the density at the cell's centre times the cell's area; only half of a cell on the
    diagonal lies in `alpha >= beta`.

    A sample can only switch relays whose thresholds lie between it and the sample before: whole rows of the state
    when the voltage rises, whole columns when it falls. Only those are touched.

    As `play` has it, the sum is a staircase in voltage with N treads: it is exact (to second order in the cell's
    size) where the voltage is at the edge of a cell, and up to half a cell's row or column off within: for a stroke
    of 40 um and N = 2000 by about 2 nm rms. `glide` takes a relay for all those of its cell, of which a part may be
    on: it has no treads, and remembers a reversal where it was.

    Source: M. Krasnosel'skii and A. Pokrovskii, Systems with Hysteresis (1989); the paper's Eq. 8-9 with relays of
    0 and 1 in the place of -1 and +1.

    Parameters
    ----------
    density
        Displacement per area of the plane of switching values, in um / V^2.
    relays
        N, the number of cells along one side.
    """

    def __init__(self, density: Density, relays: int) -> None:
        cell_V = (density.upper_V - density.lower_V) / relays
        self.thresholds_V = density.lower_V + (np.arange(relays) + 0.5) * cell_V
        weights_um = np.zeros((relays, relays))
        for i, alpha_V in enumerate(self.thresholds_V):
            weights_um[i, : i + 1] = density(alpha_V, self.thresholds_V[: i + 1]) * cell_V**2
        np.fill_diagonal(weights_um, weights_um.diagonal() / 2)
        self._rows_um = weights_um
        # Columns are read as often as rows; a second copy, transposed, makes them contiguous in memory too.
        self._columns_um = np.ascontiguousarray(weights_um.T)
        # The part of each cell that is on. Above the diagonal there are no relays: what stands there has weight zero
        # and means nothing.
        self._on = np.zeros((relays, relays))
        self._at = 0.0
        self._sum_um = 0.0

    def play(self, voltage_V: FloatArray) -> FloatArray:
        """Play voltages, shape (n,), in V; the relays keep their states for the next call.

        Returns the sum of the weights of the relays that are on, shape (n,), in um.
        """
        # The level of a sample is the number of thresholds at or below it.
        levels = np.searchsorted(self.thresholds_V, voltage_V, side="right").astype(float)
        return np.array([self._go(level)[1][-1] for level in levels])

    def glide(self, voltage_V: FloatArray) -> FloatArray:
        """Play voltages, shape (n,), in V, that only rise or only fall, also from the ones before.

        Returns the sum at the edges of the cells and at the last voltage, and straight lines between these: without
        treads, which would shake a stage that has mass.
        """
        cell_V = self.thresholds_V[1] - self.thresholds_V[0]
        cells = np.clip((voltage_V - self.thresholds_V[0]) / cell_V + 0.5, 0, len(self.thresholds_V))
        places, sums_um = self._go(float(cells[-1]))
        return np.interp(cells, *((places, sums_um) if places[-1] >= places[0] else (places[::-1], sums_um[::-1])))

    def _go(self, to: float) -> tuple[FloatArray, FloatArray]:
        """Go up or down to a place, counted in cells from the lowest voltage.

        Returns places on the way, from where it begins to where it ends, and the sums (um) there. A cell that a rise
        and a fall both cut is not quite what it should be: one of many.
        """
        if to > self._at:
            first, last = int(self._at), math.ceil(to)
            on, weights_um, sign = self._on[first:last, :last], self._rows_um[first:last, :last], 1.0
            ends = np.minimum(np.arange(first + 1, last + 1), to)
            switched = np.maximum((ends - np.arange(first, last))[:, None] - on, 0.0)
        else:
            first, last = int(to), math.ceil(self._at)
            on, weights_um, sign = self._on[first:, first:last].T, self._columns_um[first:last, first:], -1.0
            ends = np.maximum(np.arange(first, last), to)
            switched = np.maximum(on - (ends - np.arange(first, last))[:, None], 0.0)
        on += sign * switched
        change_um = sign * np.einsum("ij,ij->i", weights_um, switched)
        order = slice(None) if sign > 0 else slice(None, None, -1)
        places = np.concatenate([[self._at], ends[order]])
        sums_um = self._sum_um + np.concatenate([[0.0], np.cumsum(change_um[order])])
        # Where every relay is off, forget the rounding so far.
        self._at, self._sum_um = to, float(sums_um[-1]) if to > 0 else 0.0
        sums_um[-1] = self._sum_um
        return places, sums_um


def plain_relays(density: Density, relays: int, voltage_V: FloatArray) -> FloatArray:
    """Play voltages to relays that are all off: the definition of `RelayGrid`, word by word and slow.

    Every relay is looked at for every sample. It is here to be compared with, at small N.

    Parameters
    ----------
    density
        Displacement per area of the plane of switching values, in um / V^2.
    relays
        N, the number of cells along one side.
    voltage_V
        The voltages, shape (n,), in V.

    Returns
    -------
    FloatArray
        The sum of the weights of the relays that are on, shape (n,), in um.
    """
    cell_V = (density.upper_V - density.lower_V) / relays
    thresholds_V = [density.lower_V + (k + 0.5) * cell_V for k in range(relays)]
    pairs = [(alpha, beta) for alpha in thresholds_V for beta in thresholds_V if alpha >= beta]
    weights_um = [float(density(a, b)) * cell_V**2 * (0.5 if a == b else 1.0) for a, b in pairs]
    on = [False] * len(pairs)
    displacement_um = []
    for voltage in voltage_V.tolist():
        for k, (alpha_V, beta_V) in enumerate(pairs):
            if voltage >= alpha_V:
                on[k] = True
            elif voltage < beta_V:
                on[k] = False
        displacement_um.append(sum(w for w, is_on in zip(weights_um, on, strict=True) if is_on))
    return np.array(displacement_um)
