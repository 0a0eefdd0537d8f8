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

    The sum is a staircase in voltage with N treads: it is exact (to second order in the cell's size) where the
    voltage is at the edge of a cell, and up to half a cell's row or column off within: for a stroke of 40 um and
    N = 2000 by about 2 nm rms.

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
        # Above the diagonal there are no relays: what stands there has weight zero and means nothing.
        self._on = np.zeros((relays, relays), dtype=bool)
        self._level = 0
        self._sum_um = 0.0

    def play(self, voltage_V: FloatArray) -> FloatArray:
        """Play voltages, shape (n,), in V; the relays keep their states for the next call.

        Returns the sum of the weights of the relays that are on, shape (n,), in um.
        """
        # The level of a sample is the number of thresholds at or below it.
        levels = np.searchsorted(self.thresholds_V, voltage_V, side="right").tolist()
        displacement_um = np.empty(len(levels))
        for sample, level in enumerate(levels):
            if level > self._level:
                self._rise(level)
            elif level < self._level:
                self._fall(level)
            displacement_um[sample] = self._sum_um
        return displacement_um

    def glide(self, voltage_V: FloatArray) -> FloatArray:
        """Play voltages, shape (n,), in V, that only rise or only fall, also from the ones before.

        Returns what `play` does at the edges of the cells, and straight lines between these: without treads, which
        would shake a stage that has mass. So a reversal is remembered at the last edge that was reached before it.
        """
        relays, level = len(self.thresholds_V), self._level
        cell_V = self.thresholds_V[1] - self.thresholds_V[0]
        cells = np.clip((voltage_V - self.thresholds_V[0]) / cell_V + 0.5, 0, relays)
        lowest, highest = min(int(cells.min()), level), max(math.ceil(cells.max()), level)
        # Before the voltage turns, a row or column switches once: what it was before is all that counts.
        rows, columns = slice(level, highest), slice(lowest, level)
        gains_um = np.sum(self._rows_um[rows, :highest], axis=1, where=~self._on[rows, :highest])
        losses_um = np.sum(self._columns_um[columns, lowest:], axis=1, where=self._on[lowest:, columns].T)
        below_um = self._sum_um - np.cumsum(losses_um[::-1])[::-1]
        edges_um = np.concatenate([below_um, [self._sum_um], self._sum_um + np.cumsum(gains_um)])
        displacement_um = np.interp(cells, np.arange(lowest, highest + 1), edges_um)
        if cells[-1] >= level + 1:
            self._rise(int(cells[-1]))
        elif cells[-1] <= level - 1:
            self._fall(math.ceil(cells[-1]))
        return displacement_um

    def _rise(self, level: int) -> None:
        rows, columns = slice(self._level, level), slice(level)
        on = self._on[rows, columns]
        self._sum_um += float(np.sum(self._rows_um[rows, columns], where=~on))
        on[:] = True
        self._level = level

    def _fall(self, level: int) -> None:
        rows, columns = slice(level, None), slice(level, self._level)
        on = self._on[rows, columns].T
        self._sum_um -= float(np.sum(self._columns_um[columns, rows], where=on))
        on[:] = False
        self._level = level
        if level == 0:
            self._sum_um = 0.0  # every relay is off: forget the rounding so far


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
