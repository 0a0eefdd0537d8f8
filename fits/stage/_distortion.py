"""A measured frequency response and its nonlinear distortion: what hysteresis and products of signals add to it."""

from dataclasses import dataclass
from itertools import combinations, combinations_with_replacement
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from fits.io._errors import DataError
from fits.io._jax_setup import require_float64
from fits.stage._frequency import (
    Multisine,
    ResponseData,
    approximate,
    estimate_response,
    smooth,
    smooth_response,
    together,
    usable,
)
from microid import with_plays

# Thresholds of plays over the root mean square of what moves them.
_THRESHOLDS = (0.05, 0.15, 0.4, 1.0, 2.0)
# Products of three band-limited signals fold back to beyond the band on a grid of twice the density.
_FINER = 2
# Pieces of the band in which weights are linear in frequency, and the ridge over the diagonal: left-out realizations
# choose.
_PIECES, _RIDGES = (4, 8, 16), (1e-3, 1e-2, 1e-1, 1.0)
# Share of the lines, the lowest ones, that tell what voltages do at rest.
_AT_REST = 0.02
# Share by which voltages may be larger or smaller than those of the record.
_OTHER = 0.1
# A voltage beside the lines of the record, over the largest at them, of which nothing is known.
_BESIDE = 0.01


@dataclass(frozen=True, eq=False)
class NonlinearResponse:
    r"""A best linear approximation and terms of nonlinear distortion, which act where the voltages do.

    .. math:: Y = G \left(U + \sum_k A_k \left(N_k - B_k U\right)\right)

    The terms `N` are made of the voltages and of the *apparent* voltages, which would hold the displacements of the
    linear response at rest: in a positioner with resonances, about the strains of its actuators. Both have plays
    (Prandtl and Ishlinskii) of five thresholds; there are all products of two among them and the second derivative
    of the apparent ones, and of three apparent ones. Each term is taken less its own best linear approximation `B`,
    so that `G` remains that of the record, at the amplitude of the record.

    Attributes
    ----------
    linear
        `G` and its variance, at `f` lines.
    samples, interval_s
        Of a period.
    apparent_V_per_um
        Apparent voltages per displacement, shape `(m, p)`.
    scale
        Root mean square of voltages, apparent voltages (V) and their second derivatives (V/s^2), shape `(3, m)`.
    term_response_per_V
        `B`, shape `(f, n, m)`, of `n` terms.
    knots_Hz
        Where the weights have corners, shape `(s,)`.
    weight_V
        `A` at these, shape `(s, m, n)`.
    explained
        Share that the terms take off what the linear part leaves of realizations that were left out, be it
        distortion, noise or bias: in squares, weighted by its variance. Zero, and so are all weights, where they take
        off nothing.
    """

    linear: ResponseData
    samples: int
    interval_s: float
    apparent_V_per_um: NDArray[np.float64]
    scale: NDArray[np.float64]
    term_response_per_V: NDArray[np.complex128]
    knots_Hz: NDArray[np.float64]
    weight_V: NDArray[np.complex128]
    explained: float

    def respond_periodically(self, voltage_V: Any, interval_s: float) -> NDArray[np.float64]:
        """Steady state under one period of voltages, of shape `(t, m)`: displacements in um, `(t, p)`.

        Only what lies at the lines of the record is known, so nothing else is in the answer: no mean either. A
        `DataError` if the period, the lines or the amplitude are not those of the record.
        """
        voltage = np.asarray(voltage_V, dtype=float)
        inputs = self.scale.shape[1]
        if voltage.shape != (self.samples, inputs) or not np.isclose(interval_s, self.interval_s, rtol=1e-6):
            raise DataError(
                f"expected one period of {self.samples} samples of {inputs} voltages at {self.interval_s:g} s, got "
                f"shape {voltage.shape} at {interval_s:g} s; record the same program."
            )
        lines = _lines(self.linear.frequency_Hz, self.samples, self.interval_s)
        every = np.abs(np.fft.rfft(voltage, axis=0)).max(axis=1)
        # What is constant moves nothing that is in the answer.
        beside = np.delete(every, np.r_[0, lines])
        if not np.all(np.isfinite(every)) or np.max(beside, initial=0.0) > _BESIDE * np.max(every[lines]):
            raise DataError(
                "expected finite voltages at the lines of the record alone, found others; record the same program."
            )
        drive = (np.fft.rfft(voltage, axis=0)[lines] / self.samples)[:, None]
        size, recorded = _rms(drive), self.scale[0]
        if np.any(np.abs(size - recorded) > _OTHER * recorded):
            raise DataError(
                f"expected voltages as large as those of the record, {recorded.round(4).tolist()} V, root mean "
                f"square, found {size.round(4).tolist()} V; record that amplitude, as distortion depends on it."
            )
        terms = self._terms(drive) - _apply(self.term_response_per_V, drive)
        weight = _interpolated(self.linear.frequency_Hz, self.knots_Hz, self.weight_V)
        moved = _apply(self.linear.response_um_per_V, drive + _apply(weight, terms))
        return _periods(moved, lines, self.samples)[0]

    def _terms(self, drive: NDArray[Any]) -> NDArray[Any]:
        apparent = _apply(self.apparent_V_per_um @ self.linear.response_um_per_V, drive)
        return _terms(drive, apparent, self.linear.frequency_Hz, self.samples, self.interval_s, self.scale)


def estimate_nonlinear_response(record: Multisine) -> NonlinearResponse:
    """Estimate the best linear approximation and what hysteresis and products of signals add to it.

    The linear part is that of `estimate_response` with as many neighbouring lines as predict best. What it leaves is
    regressed on the terms of `NonlinearResponse`, whose weights are linear in frequency between knots: they act ahead
    of the resonances, so that they need not follow them. Ridge regression, weighted by the variance of what the
    linear part leaves; the number of knots and the ridge are those that predict realizations best that were left out.

    Distortion about a best linear approximation is that of Pintelon and Schoukens, *System Identification: A
    Frequency Domain Approach* (2012), chapter 3. Outputs that act back as inputs are after Adams and Allemang, *A
    frequency domain method for estimating the parameters of a non-linear structural dynamic model through feedback*
    (2000); here they are those of the linear response, which further voltages give, too.

    A `DataError` as of `estimate_response`, and if there are fewer than three realizations, or two are alike. The
    result is compared by `relative_error`.
    """
    require_float64("estimation needs")
    frequency, u, y = record.spectra()
    approximate(record, u, y)
    drive, moved = np.mean(u, axis=2), np.mean(y, axis=2)
    tried = usable(frequency)
    if drive.shape[1] < 3 or not tried:
        raise DataError(
            f"{record.source}: expected three realizations and five lines or more, found {drive.shape[1]} and "
            f"{len(frequency)}; record more."
        )
    alike = [(j, k) for j, k in combinations(range(drive.shape[1]), 2) if np.allclose(drive[:, j], drive[:, k], 1e-6)]
    if alike:
        raise DataError(
            f"{record.source}: expected other phases in each realization, found the same voltages in realizations "
            f"{alike[0][0] + 1} and {alike[0][1] + 1}, whose distortion is the same, too; draw the phases anew."
        )
    neighbours, gain, _, _, left_out = together(drive, moved, tried)
    linear = estimate_response(record, neighbours)
    samples = record.voltage_V.shape[2]
    rest = np.real(gain[: max(1, round(_AT_REST * len(gain)))]).mean(axis=0)
    apparent_V_per_um = np.linalg.pinv(rest)
    apparent = _apply(apparent_V_per_um @ gain, drive)
    scale = np.stack([_rms(x) for x in (drive, apparent, _twice_derived(apparent, frequency))])
    terms = _terms(drive, apparent, frequency, samples, record.interval_s, scale)
    response = smooth_response(drive, terms, neighbours)
    terms -= _apply(response, drive)
    left = moved - _apply(gain, drive)
    weight = 1 / (smooth(np.mean(np.abs(left) ** 2, axis=(1, 2))[:, None])[:, 0] + np.finfo(float).tiny)
    knots, found, explained = _chosen(frequency, gain, terms, left, left_out, weight)
    return NonlinearResponse(
        linear, samples, record.interval_s, apparent_V_per_um, scale, response, knots, found, explained
    )


def _lines(frequency_Hz: NDArray[np.float64], samples: int, interval_s: float) -> NDArray[np.intp]:
    return np.rint(frequency_Hz * samples * interval_s).astype(int)


def _apply(response: NDArray[Any], spectra: NDArray[Any]) -> NDArray[Any]:
    """Responses `(f, p, m)` to the spectra `(f, r, m)` of realizations, shape `(f, r, p)`."""
    return spectra @ np.swapaxes(response, 1, 2)


def _rms(spectra: NDArray[Any]) -> NDArray[np.float64]:
    size = np.sqrt(2 * np.sum(np.mean(np.abs(spectra) ** 2, axis=1), axis=0))
    return np.where(size > 0, size, 1.0)


def _twice_derived(spectra: NDArray[Any], frequency_Hz: NDArray[np.float64]) -> NDArray[Any]:
    return -((2 * np.pi * frequency_Hz[:, None, None]) ** 2) * spectra


def _periods(spectra: NDArray[Any], lines: NDArray[np.intp], samples: int, finer: int = 1) -> NDArray[np.float64]:
    """One period of signals of spectra `(f, r, k)`, shape `(r, n, k)`."""
    all_lines = np.zeros((spectra.shape[1], finer * samples // 2 + 1, spectra.shape[2]), dtype=complex)
    all_lines[:, lines] = np.moveaxis(spectra, 0, 1)
    return np.fft.irfft(all_lines, finer * samples, axis=1) * finer * samples


def _spectra(signals: NDArray[np.float64], lines: NDArray[np.intp]) -> NDArray[Any]:
    return np.moveaxis(np.fft.rfft(signals, axis=1)[:, lines] / signals.shape[1], 1, 0)


def _terms(
    drive: NDArray[Any],
    apparent: NDArray[Any],
    frequency_Hz: NDArray[np.float64],
    samples: int,
    interval_s: float,
    scale: NDArray[np.float64],
) -> NDArray[Any]:
    """Spectra of all terms, `(f, r, n)`: plays, products of two, products of three."""
    lines = _lines(frequency_Hz, samples, interval_s)
    inputs = drive.shape[2]
    signals = np.concatenate([drive, apparent, _twice_derived(apparent, frequency_Hz)], axis=2) / scale.ravel()
    coarse = _periods(signals[:, :, : 2 * inputs], lines, samples)
    threshold = jnp.asarray(_THRESHOLDS)
    played = np.stack([np.asarray(with_plays(jnp.asarray(one), threshold)) for one in coarse])
    # Each signal stands ahead of its plays.
    played = np.delete(played, np.s_[:: len(_THRESHOLDS) + 1], axis=2)
    fine = np.moveaxis(_periods(signals, lines, samples, _FINER), 2, 0)
    pairs = combinations_with_replacement(fine, 2)
    triples = combinations_with_replacement(fine[inputs : 2 * inputs], 3)
    products = [_spectra(np.prod(one, axis=0)[..., None], lines) for few in (pairs, triples) for one in few]
    return np.concatenate([_spectra(played, lines), *products], axis=2)


def _chosen(
    frequency_Hz: NDArray[np.float64],
    gain: NDArray[Any],
    terms: NDArray[Any],
    left: NDArray[Any],
    left_out: NDArray[Any],
    weight: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[Any], float]:
    """Knots, weights at them, and the share that they explain of what was left out."""
    before = float(np.sum(weight[:, None, None] * np.abs(left_out) ** 2))
    best, least = None, before
    for pieces in (n for n in _PIECES if n == _PIECES[0] or len(frequency_Hz) > 20 * n):
        each = _Normal.each(frequency_Hz, pieces, gain, terms, left, left_out, weight)
        whole = _Normal.total(each)
        for ridge in _RIDGES:
            after = before
            for one in each:
                x = (whole - one).solve(ridge)
                after += one.moved(x) - 2 * float(np.real(np.vdot(x, one.held)))
            if after < least:
                best, least = (whole, ridge), after
    if best is None:
        knots = frequency_Hz[[0, -1]]
        return knots, np.zeros((2, gain.shape[2], terms.shape[2]), dtype=complex), 0.0
    whole, ridge = best
    found = whole.solve(ridge).reshape(-1, gain.shape[2], terms.shape[2])
    return np.linspace(frequency_Hz[0], frequency_Hz[-1], len(found)), found, 1 - least / before


def _interpolated(
    frequency_Hz: NDArray[np.float64], knots_Hz: NDArray[np.float64], values: NDArray[Any]
) -> NDArray[Any]:
    at, share = _places(frequency_Hz, knots_Hz)
    return (1 - share)[:, None, None] * values[at] + share[:, None, None] * values[at + 1]


def _places(
    frequency_Hz: NDArray[np.float64], knots_Hz: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Of each line the knot below it, and how far it is on the way to the next one."""
    at = np.clip(np.searchsorted(knots_Hz, frequency_Hz, "right") - 1, 0, len(knots_Hz) - 2)
    return at, (frequency_Hz - knots_Hz[at]) / (knots_Hz[at + 1] - knots_Hz[at])


@dataclass(frozen=True)
class _Normal:
    """Normal equations of weights that are linear between knots: blocks on the diagonal, above it, right-hand sides.

    Shapes `(s, n, n)`, `(s - 1, n, n)`, `(s, n)`; `held` is the right-hand side for what the others predict.
    """

    diagonal: NDArray[Any]
    above: NDArray[Any]
    right: NDArray[Any]
    held: NDArray[Any]

    @staticmethod
    def each(
        frequency_Hz: NDArray[np.float64],
        pieces: int,
        gain: NDArray[Any],
        terms: NDArray[Any],
        left: NDArray[Any],
        left_out: NDArray[Any],
        weight: NDArray[np.float64],
    ) -> "list[_Normal]":
        """Of each realization."""
        inputs, count = gain.shape[2], terms.shape[2]
        size = inputs * count
        at, share = _places(frequency_Hz, np.linspace(frequency_Hz[0], frequency_Hz[-1], pieces + 1))
        adjoint = np.swapaxes(gain, 1, 2).conj() * weight[:, None, None]
        inner = adjoint @ gain
        wanted = [np.einsum("fmp,frp->frm", adjoint, one) for one in (left, left_out)]
        found = []
        for r in range(terms.shape[1]):
            diagonal = np.zeros((pieces + 1, size, size), dtype=complex)
            above = np.zeros((pieces, size, size), dtype=complex)
            right = np.zeros((2, pieces + 1, size), dtype=complex)
            for k in range(pieces):
                of = at == k
                term, upper = terms[of, r], share[of]
                both = term.conj()[:, None, None] * inner[of][..., None]
                products = [
                    (both.reshape(len(term), -1).T @ (h[:, None] * term))
                    .reshape(inputs, inputs, count, count)
                    .swapaxes(1, 2)
                    .reshape(size, size)
                    for h in ((1 - upper) ** 2, upper * (1 - upper), upper**2)
                ]
                diagonal[k] += products[0]
                above[k] = products[1]
                diagonal[k + 1] += products[2]
                for q, one in enumerate(wanted):
                    for j, h in enumerate((1 - upper, upper)):
                        right[q, k + j] += np.einsum("fm,fk,f->mk", one[of, r], term.conj(), h).ravel()
            found.append(_Normal(diagonal, above, *right))
        return found

    @staticmethod
    def total(each: "list[_Normal]") -> "_Normal":
        return _Normal(*(sum(getattr(one, name) for one in each) for name in _Normal.__dataclass_fields__))

    def __sub__(self, other: "_Normal") -> "_Normal":
        return _Normal(*(getattr(self, name) - getattr(other, name) for name in _Normal.__dataclass_fields__))

    def moved(self, x: NDArray[Any]) -> float:
        """Squares of what weights of shape `(s, n)` move."""
        own = np.einsum("sn,snm,sm->", x.conj(), self.diagonal, x, optimize=True)
        return float(np.real(own + 2 * np.einsum("sn,snm,sm->", x[:-1].conj(), self.above, x[1:], optimize=True)))

    def solve(self, ridge: float) -> NDArray[Any]:
        """Weights, shape `(s, n)`, by elimination from block to block."""
        size = np.real(np.diagonal(self.diagonal, axis1=1, axis2=2))
        added = ridge * size + 1e-12 * np.max(size)
        eye = np.eye(size.shape[1])
        pivots, rights = [self.diagonal[0] + added[0] * eye], [self.right[0]]
        for k, above in enumerate(self.above):
            through = np.linalg.solve(pivots[k], np.column_stack([above, rights[k]]))
            below = above.conj().T
            pivots.append(self.diagonal[k + 1] + added[k + 1] * eye - below @ through[:, :-1])
            rights.append(self.right[k + 1] - below @ through[:, -1])
        found = [np.linalg.solve(pivots[-1], rights[-1])]
        for k in reversed(range(len(self.above))):
            found.append(np.linalg.solve(pivots[k], rights[k] - self.above[k] @ found[-1]))
        return np.stack(found[::-1])
