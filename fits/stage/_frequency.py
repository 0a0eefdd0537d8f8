"""Measured frequency responses: from periodic multisines, or read as an analyser writes them."""

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from fits.io._errors import AnyPath, DataError
from fits.io._open_table import open_table
from fits.io._plausible import SHORTEST_STEP_s, check_size
from fits.io._record import read_only
from fits.io._table import Table

_REAL, _IMAGINARY, _VARIANCE = "real_um_per_V", "imag_um_per_V", "variance_um2_per_V2"
_MAGNITUDE, _DECIBEL, _DEGREES, _RADIANS = "magnitude_um_per_V", "magnitude_dB", "phase_deg", "phase_rad"
# What a unit is checked by, of each column.
_UNITS = {"frequency_Hz": "Hz"} | dict.fromkeys((_REAL, _IMAGINARY, _MAGNITUDE), "um/V")
_UNITS |= {_VARIANCE: "um^2/V^2", _DECIBEL: "dB", _DEGREES: "deg", _RADIANS: "rad"}
# Degree of a local polynomial, and the neighbours on each side that are tried where the record is to choose.
_DEGREE, _TRIED = 2, (2, 3, 4, 6, 8, 12)


@dataclass(frozen=True, eq=False)
class Multisine:
    """Steady-state response to periodic inputs: `r` realizations of `q` periods, `n` samples each.

    Voltages and displacements have shapes `(r, q, n, m)` and `(r, q, n, p)`.
    """

    interval_s: float
    voltage_V: NDArray[np.float64]
    displacement_um: NDArray[np.float64]
    source: str = "record"

    def __post_init__(self) -> None:
        """Refuse arrays that do not belong together, and what is no finite number."""
        for name in ("voltage_V", "displacement_um"):
            object.__setattr__(self, name, read_only(name, getattr(self, name)))
        u, y = self.voltage_V, self.displacement_um
        if u.ndim != 4 or y.ndim != 4 or u.shape[:3] != y.shape[:3] or not 0 < self.interval_s < np.inf:
            raise DataError(
                f"{self.source}: expected voltages and displacements of shapes (realizations, periods, samples, "
                f"channels) and a positive interval, got {u.shape}, {y.shape} and {self.interval_s:g} s; "
                "arrange them so."
            )
        if min(u.shape + y.shape) == 0 or u.shape[2] < 2:
            raise DataError(f"{self.source}: expected two samples or more in a period, found {u.shape}; record more.")
        for name, array in (("voltage_V", u), ("displacement_um", y)):
            if len(odd := np.argwhere(~np.isfinite(array))):
                raise DataError(
                    f"{self.source}: {name}{odd[0].tolist()}: expected a finite number, found "
                    f"{array[tuple(odd[0])]} ({len(odd)} such in all); leave such realizations out."
                )

    def take(self, realizations: slice) -> "Multisine":
        """Some of the realizations, so that the others can be held out."""
        u, y = self.voltage_V[realizations], self.displacement_um[realizations]
        return Multisine(self.interval_s, u, y, self.source)

    def spectra(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Excited lines in Hz, shape `(f,)`, and spectra of all periods, `(f, r, q, m)` and `(f, r, q, p)`."""
        samples = self.voltage_V.shape[2]
        u, y = (np.moveaxis(np.fft.rfft(x, axis=2), 2, 0) / samples for x in (self.voltage_V, self.displacement_um))
        size = np.sqrt(np.mean(np.abs(u) ** 2, axis=(1, 2, 3)))
        size[0] = 0
        lines = np.flatnonzero(size > 0.01 * np.max(size))
        if not len(lines):
            raise DataError(
                f"{self.source}: expected periodic voltages, found none that change; choose other columns."
            )
        return np.fft.rfftfreq(samples, self.interval_s)[lines], u[lines], y[lines]


@dataclass(frozen=True, eq=False)
class ResponseData:
    """A measured frequency response: increasing frequencies, shape `(f,)`, and complex responses, `(f, p, m)`.

    The variance of the latter, `(f, p, m)`, holds noise and distortion; where it is None, all lines weigh the same.
    The noise variance is the part of it that differs between periods; None for a single period.
    """

    frequency_Hz: NDArray[np.float64]
    response_um_per_V: NDArray[np.complex128]
    variance_um2_per_V2: NDArray[np.float64] | None = None
    noise_variance_um2_per_V2: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        """Refuse what is no frequency response."""
        lines, response = np.asarray(self.frequency_Hz), np.asarray(self.response_um_per_V)
        if lines.ndim != 1 or response.ndim != 3 or len(response) != len(lines) or not np.all(np.isfinite(response)):
            raise DataError(
                "frequency response: expected finite values of shape (f, p, m) at f frequencies, got "
                f"{response.shape} at {lines.shape}; give (f, 1, 1) for one input and one output."
            )
        if len(lines) < 2 or lines[0] < 0 or np.any(np.diff(lines) <= 0):
            raise DataError("frequency response: expected frequencies that increase from 0 Hz on; sort the lines.")
        for variance in (self.variance_um2_per_V2, self.noise_variance_um2_per_V2):
            if variance is not None and (variance.shape != response.shape or not np.all(variance > 0)):
                raise DataError(
                    f"frequency response: expected positive variances of shape {response.shape}; "
                    "leave them out where they are not known."
                )


def read_multisine(path: AnyPath) -> Multisine:
    """Read `time_s, realization, period, u1_V, u2_V, ..., y1_um, y2_um, ...` from a CSV file.

    Rows are ordered by realization, then period, then time, which may start anew with each realization. A `DataError`
    says in one sentence with file and column what was expected and what to do.
    """
    table = open_table(path)
    inputs = [f"u{i}_V" for i in range(1, len(table.names) + 1) if f"u{i}_V" in table.names]
    outputs = [f"y{i}_um" for i in range(1, len(table.names) + 1) if f"y{i}_um" in table.names]
    needed = ("time_s", "realization", "period", *(inputs or ["u1_V"]), *(outputs or ["y1_um"]))
    for name in needed:
        if name not in table.names:
            raise table.error(f"expected a column '{name}', found none; rename or add it")
    values, _ = table.read(needed)
    for name in needed:
        check_size(table, name, values[name], {"V": "V", "um": "um", "s": "s"}.get(name.rpartition("_")[2], "1"))
    group = np.stack([values["realization"], values["period"]])
    starts = np.flatnonzero(np.append(True, np.any(np.diff(group) != 0, axis=0)))
    lengths, periods = np.diff(np.append(starts, group.shape[1])), len(np.unique(group[1]))
    order = np.lexsort(group[::-1, starts])
    whole = len(set(lengths)) == 1 and len(starts) == periods * len(np.unique(group[0]))
    if not whole or np.any(order != np.arange(len(starts))):
        raise table.error(
            "expected every realization with the same periods of the same length, in order; cut or sort the rows",
            column="period",
        )
    if periods * lengths[0] < 2:
        raise table.error("expected two samples or more per realization, found one")
    steps = np.diff(values["time_s"].reshape(-1, periods * lengths[0]), axis=1)
    interval_s = float(np.mean(steps))
    if not interval_s >= SHORTEST_STEP_s or np.max(np.abs(steps - interval_s)) > 0.01 * interval_s:
        raise table.error("expected even time steps of 1e-12 s or more; sample evenly", column="time_s")
    shape = (-1, periods, lengths[0])
    u, y = (np.stack([values[name].reshape(shape) for name in names], axis=-1) for names in (inputs, outputs))
    return Multisine(interval_s, u, y, os.path.basename(table.path))


def estimate_response(record: Multisine, neighbours: int | None = 0) -> ResponseData:
    """Estimate the best linear approximation and its variance, without a model of it.

    Least squares over the realizations of what periods have averaged, line by line, or with so many `neighbours` on
    each side by the local polynomial method: less noise, and a bias where the response bends sharply. None takes the
    number that predicts realizations best that were left out. See Pintelon and Schoukens, *System Identification: A
    Frequency Domain Approach* (2012), chapters 4 and 7. What differs between periods is noise; what differs between
    realizations is noise and nonlinear distortion together. Voltages count as exact.

    A `DataError` if there are no more realizations than inputs, the inputs are not independent, or there are too few
    lines for so many neighbours.
    """
    frequency_Hz, u, y = record.spectra()
    gain, total = approximate(record, u, y)
    drive, moved = np.mean(u, axis=2), np.mean(y, axis=2)
    tried = usable(frequency_Hz) if neighbours is None else [neighbours]
    if not all(0 <= 2 * n < len(frequency_Hz) for n in tried):
        most = (len(frequency_Hz) - 1) // 2
        raise DataError(
            f"{record.source}: expected 0 to {most} neighbours for {len(frequency_Hz)} lines, found {neighbours}; "
            "choose another number."
        )
    if any(tried):
        _, gain, total, spread, _ = together(drive, moved, tried)
    else:
        spread = np.real(np.diagonal(np.linalg.inv(np.swapaxes(drive, 1, 2).conj() @ drive), axis1=1, axis2=2))
        total = smooth(total)
    # Without any noise rounding is left.
    least = (np.finfo(float).eps * np.max(np.abs(moved), axis=(0, 1))) ** 2 + np.finfo(float).tiny
    total, noise = np.maximum(total, least), None
    if y.shape[2] > 1:
        between = np.maximum(np.mean(np.var(y, axis=2, ddof=1), axis=1) / y.shape[2], least)
        noise = smooth(between)[:, :, None] * spread[:, None, :]
    return ResponseData(frequency_Hz, gain, total[:, :, None] * spread[:, None, :], noise)


def usable(frequency_Hz: NDArray[np.float64]) -> list[int]:
    """Numbers of neighbours on each side that are tried where the record is to choose."""
    return [n for n in _TRIED if 2 * n + 1 <= len(frequency_Hz)]


def together(
    drive: NDArray[Any], moved: NDArray[Any], tried: list[int]
) -> tuple[int, NDArray[Any], NDArray[Any], NDArray[np.float64], NDArray[Any]]:
    """The number of neighbours that predicts left-out realizations best, and what `_local_polynomial` finds by it."""
    found = [(n, *_local_polynomial(drive, moved, n)) for n in tried]
    return min(found, key=lambda one: float(np.linalg.norm(one[4])))


def _local_polynomial(
    drive: NDArray[Any], moved: NDArray[Any], neighbours: int
) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.float64], NDArray[Any]]:
    """Fit a response that is a polynomial about each line, by least squares (Pintelon and Schoukens, section 7.2).

    Of spectra of the inputs, `(f, r, m)`, and outputs, `(f, r, p)`, of `r` realizations: the response, `(f, p, m)`,
    the variance of the outputs about it, `(f, p)`, that of the response over the latter, `(f, m)`, and what is left
    of each realization where the fit is to the others, `(f, r, p)`.
    """
    lines, realizations, inputs = drive.shape
    near, powers = _window(lines, neighbours)
    width = near.shape[1]
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


def smooth_response(drive: NDArray[Any], moved: NDArray[Any], neighbours: int) -> NDArray[Any]:
    """The response `(f, p, m)` of `_local_polynomial` alone, in little memory however many outputs there are."""
    near, powers = _window(len(drive), neighbours)
    adjoint = np.swapaxes(drive, 1, 2).conj()
    inner, cross = adjoint @ drive, adjoint @ moved
    inputs, count = drive.shape[2], powers.shape[2]
    gram = np.einsum("fwd,fwe,fwmn->fdmen", powers, powers, inner[near], optimize=True)
    right = np.zeros((len(drive), count, *cross.shape[1:]), dtype=complex)
    for w in range(near.shape[1]):
        right += powers[:, w, :, None, None] * cross[near[:, w], None]
    size = inputs * count
    found = np.linalg.solve(gram.reshape(-1, size, size), right.reshape(len(drive), size, -1))
    return np.swapaxes(found[:, :inputs], 1, 2)


def _window(lines: int, neighbours: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Of each line, the lines about it, shape `(f, w)`, and the powers of how far away they are, `(f, w, d)`."""
    width = 2 * neighbours + 1
    first = np.clip(np.arange(lines) - neighbours, 0, lines - width)
    near = first[:, None] + np.arange(width)
    away = (near - np.arange(lines)[:, None]) / neighbours
    return near, away[..., None] ** np.arange(_DEGREE + 1)


def approximate(record: Multisine, u: NDArray[Any], y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Best linear approximation, shape `(f, p, m)`, and variance of the averaged outputs about it, `(f, p)`."""
    drive, moved = np.mean(u, axis=2), np.mean(y, axis=2)
    realizations, inputs = drive.shape[1:]
    if realizations <= inputs:
        raise DataError(
            f"{record.source}: expected more realizations than its {inputs} inputs, found {realizations}; "
            "record more, or the distortion cannot be told from the response."
        )
    if np.max(np.linalg.cond(drive)) > 1e6:
        raise DataError(
            f"{record.source}: expected inputs that are independent over the realizations, found some that are not; "
            "draw the phases of each input and realization anew."
        )
    gain = np.linalg.pinv(drive) @ moved
    total = np.sum(np.abs(moved - drive @ gain) ** 2, axis=1) / (realizations - inputs)
    return np.swapaxes(gain, 1, 2), total


def smooth(variance: NDArray[Any]) -> NDArray[Any]:
    """Mean over nine neighbouring lines, shape `(f, p)`: few realizations alone make poor weights."""
    width = 2 * (min(9, len(variance) - 1 | 1) // 2) + 1
    return convolve1d(variance, np.full(width, 1 / width), axis=0, mode="mirror")


def read_response(path: AnyPath) -> ResponseData:
    """Read a frequency response as an analyser writes it: a row per line, frequencies increasing.

    The columns are `frequency_Hz`, then `real_um_per_V` and `imag_um_per_V`, or a magnitude (`magnitude_um_per_V`, or
    `magnitude_dB` for 20 log10 of um/V) and a phase (`phase_deg` or `phase_rad`). A column `variance_um2_per_V2`, of
    the complex response, may stand beside them. The data are of shape `(f, 1, 1)`, for `fit_response`. A `DataError`
    says in one sentence with file and column what was expected and what to do.
    """
    table = open_table(path)
    magnitude, phase = _one_of(table, _MAGNITUDE, _DECIBEL), _one_of(table, _DEGREES, _RADIANS)
    cartesian = _REAL in table.names and _IMAGINARY in table.names
    if "frequency_Hz" not in table.names or cartesian == bool(magnitude and phase):
        raise table.error(
            f"expected the columns frequency_Hz and either {_REAL} and {_IMAGINARY} or {_MAGNITUDE} (or {_DECIBEL}) "
            f"and {_DEGREES} (or {_RADIANS}), found {', '.join(table.names)}; rename or drop columns"
        )
    shown = (_REAL, _IMAGINARY) if cartesian else (magnitude, phase)
    known = (_VARIANCE,) if _VARIANCE in table.names else ()
    values, _ = table.read(("frequency_Hz", *shown, *known))
    for name, unit in _UNITS.items():
        if name in ("frequency_Hz", *shown, *known):
            check_size(table, name, values[name], unit)
    first, second = (values[name] for name in shown)
    for name, wrong, expected in (
        ("frequency_Hz", np.diff(values["frequency_Hz"], prepend=-np.inf) <= 0, "frequencies that increase"),
        ("frequency_Hz", values["frequency_Hz"] < 0, "frequencies from 0 Hz on"),
        (_MAGNITUDE, (first < 0) & (shown[0] == _MAGNITUDE), "magnitudes that are not negative"),
        *((name, values[name] <= 0, "positive variances") for name in known),
    ):
        if np.any(wrong):
            row = int(np.argmax(wrong))
            raise table.error(f"expected {expected}; correct or sort the rows", row, name)
    if cartesian:
        response = first + 1j * second
    else:
        size = 10 ** (first / 20) if magnitude == _DECIBEL else first
        response = size * np.exp(1j * (np.deg2rad(second) if phase == _DEGREES else second))
    variance = values[_VARIANCE][:, None, None] if known else None
    return ResponseData(values["frequency_Hz"], response[:, None, None], variance)


def _one_of(table: Table, *names: str) -> str:
    found = [name for name in names if name in table.names]
    if len(found) > 1:
        raise table.error(f"expected one of {' and '.join(names)}, found both; drop one")
    return found[0] if found else ""
