"""Least squares for modes, with or without hysteresis, on spectra: what `fit_response` and `fit_hysteresis` solve."""

import math
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Complex, Float
from numpy.typing import NDArray
from optimistix import RESULTS
from scipy.ndimage import convolve1d
from scipy.signal import find_peaks, peak_widths

from fits.io._errors import DataError
from fits.loop._result import FitError, FitStatus
from fits.stage._distortion import NonlinearResponse
from fits.stage._frequency import Multisine, ResponseData, approximate, smooth
from microid import Coordinates, HystereticModes, Modes, with_plays

_M = TypeVar("_M", Modes, HystereticModes)
_Band = tuple[float, float] | None
_GAINS = ("gain_um_per_V", "quadrature_um_per_V", "residual_um_per_V")
_FEW_LINES = 5


@dataclass(frozen=True, eq=False)
class ModalFit(Generic[_M]):
    """Fitted modes and how far to trust them.

    Standard deviations are in the places of a model, zero for what was not fitted; the `covariance` is that of the
    fitted parameters in the order of `parameter_table(model)`, in their units. The `misfit` is the residual over what
    noise and distortion explain, root mean square: 1 if the model is right. Where it is larger, and where the
    variance is not known, standard deviations were multiplied by it. `band_Hz` has the first and last frequency that
    was fitted.
    """

    model: _M
    sd: _M
    covariance: NDArray[np.float64]
    misfit: float
    band_Hz: tuple[float, float]


def fit_response(data: ResponseData, modes: int = 2, band_Hz: _Band = None, coupled: bool = False) -> ModalFit[Modes]:
    """Fit modes to a measured frequency response by least squares, each line weighted by its variance.

    Starts at the peaks of the singular values (complex mode indicator function); where there are fewer than modes,
    where the least is explained. Gains are eliminated (variable projection, Kaufman's Jacobian).

    Of the number of `modes` one more than the band shows stands for the next one above it; damping may couple them,
    by `quadrature_um_per_V`, if `coupled`. `band_Hz` is the lowest and highest frequency to fit; all by default.

    A `DataError` says that the band is too narrow for so many parameters, or leaves some of them open, and a
    `FitError` that the solver does not arrive at an optimum.
    """
    band = _in_band(data.frequency_Hz, band_Hz, modes)
    frequency, gain = data.frequency_Hz[band], data.response_um_per_V[band]
    known = data.variance_um2_per_V2
    variance = np.full(gain.shape, np.mean(np.abs(gain) ** 2)) if known is None else known[band]
    # Without plays every pair of input and output is a response of its own to the same poles.
    wanted, variance = (values.reshape(len(gain), 1, -1) for values in (gain, variance))
    drive = jnp.ones((len(gain), 1, 1), dtype=complex)
    spectra = _Spectra(jnp.asarray(frequency), drive, jnp.asarray(wanted), jnp.asarray(variance), coupled)
    found = _fit(_start(spectra, gain, modes), spectra, known is not None)
    model, sd = (_reshaped(modes, gain.shape[1:]) for modes in (found.model, found.sd))
    return ModalFit(model, sd, found.covariance, found.misfit, found.band_Hz)


def _reshaped(modes: Modes, shape: tuple[int, ...]) -> Modes:
    return eqx.tree_at(_gains, modes, tuple(gain.reshape(*gain.shape[:-2], *shape) for gain in _gains(modes)))


def _gains(model: Modes | HystereticModes) -> tuple[Array, ...]:
    return tuple(getattr(_modes(model), name) for name in _GAINS)


def fit_hysteresis(
    record: Multisine, start: ModalFit[Modes] | Modes, threshold_V: Any, band_Hz: _Band = None, coupled: bool = False
) -> ModalFit[HystereticModes]:
    """Fit modes and the plays ahead of them to the spectra of a record.

    Under known periodic voltages plays of given thresholds are known too, so they are inputs like the voltages, and
    displacements are linear in all gains; everything is fitted together as in `fit_response`, to each realization.

    The record needs more realizations than inputs: they tell how much of the spectra is distortion, which the weights
    are made of. Modes to start from are usually of `fit_response`; the thresholds of the plays have shape `(K,)` and
    are not zero, where a play is the voltage itself. For the others, and what is raised, see `fit_response`.
    """
    frequency, u, y = record.spectra()
    modes = start if isinstance(start, Modes) else start.model
    threshold = np.atleast_1d(np.asarray(threshold_V, dtype=float))
    band = _in_band(frequency, band_Hz, len(modes.damping_ratio))
    variance = np.repeat(smooth(approximate(record, u, y)[1])[band, None], u.shape[1], axis=1)
    voltage = np.mean(record.voltage_V, axis=1)
    drive = np.stack([with_plays(jnp.asarray(v), jnp.asarray(threshold)) for v in voltage])
    drive = _spectra(drive, frequency[band], record)
    wanted = jnp.asarray(np.mean(y, axis=2)[band])
    spectra = _Spectra(jnp.asarray(frequency[band]), jnp.asarray(drive), wanted, jnp.asarray(variance), coupled)
    # Solved for first of all, so what they start from does not matter.
    zero = jnp.zeros((len(modes.damping_ratio), y.shape[3], drive.shape[2]))
    modes = Modes(modes.natural_frequency_Hz, modes.damping_ratio, zero, zero, zero[0], modes.delay_s)
    return _fit(HystereticModes(modes, jnp.asarray(threshold)), spectra, True)


def relative_error(
    model: Modes | HystereticModes | ResponseData | NonlinearResponse, record: Multisine, band_Hz: _Band = None
) -> float:
    """Norm of what a model leaves of the averaged output spectra in a band, over their own norm.

    A measured response is one, too, alone or with its distortion; a `DataError` if it is not of the lines of the
    record.
    """
    frequency, u, y = record.spectra()
    band = _in_band(frequency, band_Hz, 0)
    wanted = np.mean(y, axis=2)[band]
    if isinstance(model, ResponseData):
        if len(model.frequency_Hz) != len(frequency) or not np.allclose(model.frequency_Hz, frequency):
            raise DataError(f"{record.source}: expected the lines of the measured response; record the same program.")
        found = np.einsum("fpm,frm->frp", model.response_um_per_V[band], np.mean(u, axis=2)[band])
    else:
        voltage = np.mean(record.voltage_V, axis=1)
        moved = np.stack([model.respond_periodically(jnp.asarray(v), record.interval_s) for v in voltage])
        found = _spectra(moved, frequency[band], record)
    return float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))


def _spectra(signals: NDArray[Any], frequency_Hz: NDArray[np.float64], record: Multisine) -> NDArray[Any]:
    """Spectra of a period of signals, shape `(r, n, k)`, at some lines of a record, shape `(f, r, k)`."""
    lines = np.rint(frequency_Hz * signals.shape[1] * record.interval_s).astype(int)
    return np.moveaxis(np.fft.rfft(signals, axis=1)[:, lines] / signals.shape[1], 1, 0)


def _in_band(frequency_Hz: NDArray[np.float64], band_Hz: _Band, modes: int) -> NDArray[np.bool_]:
    low, high = band_Hz or (0.0, math.inf)
    inside = (frequency_Hz >= low) & (frequency_Hz <= high)
    if np.count_nonzero(inside) < 4 * modes + 2:
        raise DataError(
            f"frequency response: expected at least {4 * modes + 2} lines for {modes} modes between {low:g} and "
            f"{high:g} Hz, found {np.count_nonzero(inside)}; widen the band or fit fewer modes."
        )
    return inside


class _Spectra(eqx.Module):
    """Spectra: of voltages and plays, `(f, e, m)`, of displacements and their variance, `(f, e, p)`."""

    frequency_Hz: Float[Array, " f"]
    drive: Complex[Array, "f e m"]
    wanted: Complex[Array, "f e p"]
    variance: Float[Array, "f e p"]
    coupled: bool = eqx.field(static=True)

    def whitened(self, model: Modes | HystereticModes) -> Float[Array, "p n"]:
        """Residuals of unit variance, real and imaginary parts, for each output."""
        response = _modes(model).frequency_response(self.frequency_Hz)
        return self._white(self.wanted - jnp.einsum("fpm,fem->fep", response, self.drive))

    def eliminated(self, model: Modes | HystereticModes) -> tuple[Float[Array, "p n"], Float[Array, "p b m"]]:
        """Residuals under the best gains, and these gains. The Jacobian of the former is that of Kaufman (1975)."""
        basis = _basis(_modes(model), self.coupled, self.frequency_Hz)
        column = basis[:, None, :, None] * self.drive[:, :, None, :]
        column = column.reshape(*column.shape[:2], 1, -1)
        design = jax.vmap(self._white, -1, -1)(jnp.broadcast_to(column, (*self.wanted.shape, column.shape[-1])))
        wanted = self._white(self.wanted)
        q, r = jnp.linalg.qr(jax.lax.stop_gradient(design))
        gains = jax.scipy.linalg.solve_triangular(r, jnp.einsum("pnc,pn->pc", q, wanted)[..., None])
        residual = wanted - (design @ gains)[..., 0]
        # What the gains could still take off is no residual; at this point it is zero, its derivative is not.
        residual -= jnp.einsum("pnc,pc->pn", q, jnp.einsum("pnc,pn->pc", q, residual))
        return residual, gains.reshape(gains.shape[0], basis.shape[1], self.drive.shape[2])

    def _white(self, values: Complex[Array, "f e p"]) -> Float[Array, "p n"]:
        scaled = jnp.moveaxis(jnp.stack([values.real, values.imag]) * (2 / self.variance[None]) ** 0.5, -1, 0)
        return scaled.reshape(scaled.shape[0], -1)


def _modes(model: Modes | HystereticModes) -> Modes:
    return model if isinstance(model, Modes) else model.modes


def _basis(modes: Modes, coupled: bool, frequency_Hz: Float[Array, " f"]) -> Complex[Array, "f b"]:
    """Responses to one gain after the other, shape `(f, b)`: of the modes, in quadrature if coupled, and residual."""
    k = modes.damping_ratio.shape[0]
    one = jnp.eye((2 * k if coupled else k) + 1, dtype=modes.damping_ratio.dtype)[:, :, None]
    quadrature = one[k : 2 * k] if coupled else jnp.zeros_like(one[:k])
    unit = Modes(modes.natural_frequency_Hz, modes.damping_ratio, one[:k], quadrature, one[-1], modes.delay_s)
    return unit.frequency_response(frequency_Hz)[..., 0]


def _with_gains(model: _M, gains: Float[Array, "p b m"], coupled: bool) -> _M:
    k = _modes(model).damping_ratio.shape[0]
    each = jnp.moveaxis(gains, 0, 1)
    new = (each[:k], each[k : 2 * k] if coupled else jnp.zeros_like(each[:k]), each[-1])
    return eqx.tree_at(_gains, model, new)


@eqx.filter_jit
def _solve(model: _M, spectra: _Spectra) -> tuple[_M, Any]:
    coordinates = Coordinates(model, lambda info: info.path.rpartition(".")[2] not in _GAINS)
    start = coordinates.of(model)

    def residual(z: Float[Array, " n"], _: None = None) -> Float[Array, "p n"]:
        return spectra.eliminated(coordinates(z))[0]

    # Steps of one move the residuals by one standard deviation.
    size = jnp.sqrt(jnp.sum(jax.jacfwd(residual)(start) ** 2, axis=(0, 1)))
    solver: Any = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-6)
    solution: Any = optx.least_squares(
        lambda x, _: residual(start + x / size), solver, jnp.zeros_like(start), max_steps=500, throw=False
    )
    found = coordinates(start + solution.value / size)
    return _with_gains(found, spectra.eliminated(found)[1], spectra.coupled), solution.result


@eqx.filter_jit
def _linearise(model: _M, spectra: _Spectra) -> tuple[Array, Array, Array]:
    """Residuals at the optimum, and what the QR decomposition of their Jacobian makes of them."""
    coordinates = _all(model, spectra.coupled)
    z = coordinates.of(model)
    jacobian = jax.jacfwd(lambda z: spectra.whitened(coordinates(z)).ravel())(z)
    residual = spectra.whitened(model).ravel()
    size = jnp.linalg.norm(jacobian, axis=0)
    q, r = jnp.linalg.qr(jacobian / size[None])
    return residual, q.T @ residual, r * size[None]


def _all(model: _M, coupled: bool) -> Coordinates[_M]:
    return Coordinates(model, lambda info: coupled or not info.path.endswith("quadrature_um_per_V"))


def _fit(start: _M, spectra: _Spectra, known: bool) -> ModalFit[_M]:
    model, result = _solve(start, spectra)
    if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree_util.tree_leaves(model)):
        raise FitError(FitStatus.NONFINITE)
    residual, left, root = (np.asarray(part) for part in _linearise(model, spectra))
    if np.linalg.cond(root / np.linalg.norm(root, axis=0)) > 1e10:
        raise DataError(
            "frequency response: expected a band that determines all parameters, found some that nothing depends on; "
            "fit fewer modes or a wider band."
        )
    misfit = float(np.linalg.norm(residual) / math.sqrt(len(residual) - len(left)))
    # The rest of the way to the optimum, in standard deviations.
    if not np.linalg.norm(left) <= 1e-2 * misfit * math.sqrt(len(left)) + 1e-6:
        slow = result == RESULTS.nonlinear_max_steps_reached
        raise FitError(FitStatus.MAX_STEPS if slow else FitStatus.NOT_STATIONARY)
    inverse = np.linalg.inv(root) * (max(1.0, misfit) if known else misfit)
    coordinates = _all(model, spectra.coupled)
    z = coordinates.of(model)
    sd = _moved(coordinates, z, jnp.linalg.norm(inverse, axis=1))
    slope = np.concatenate([np.ravel(leaf) for leaf in jax.tree_util.tree_leaves(_moved(coordinates, z, 1 + 0 * z))])
    factor = slope[slope != 0, None] * inverse
    edges = (float(spectra.frequency_Hz[0]), float(spectra.frequency_Hz[-1]))
    return ModalFit(model, sd, factor @ factor.T, misfit, edges)


def _moved(coordinates: Coordinates[_M], z: Float[Array, " n"], by: Float[Array, " n"]) -> _M:
    """Change of the model per change of the coordinates, zero where nothing moves."""
    model, change = eqx.filter_jvp(coordinates, (z,), (by,))
    return jax.tree.map(lambda value, moved: jnp.zeros_like(value) if moved is None else moved, model, change)


def _start(spectra: _Spectra, response: NDArray[Any], count: int) -> Modes:
    """Modes at the highest peaks of the singular values; those that have none go where the least is explained."""
    frequency = np.asarray(spectra.frequency_Hz)
    found: list[tuple[float, float, float]] = []
    average = np.full(_FEW_LINES, 1 / _FEW_LINES)
    for curve in np.linalg.svd(response, compute_uv=False).T:
        level = convolve1d(np.log(np.maximum(curve, 1e-12 * np.max(np.abs(response)))), average, mode="nearest")
        peaks, about = find_peaks(level, prominence=0.3)  # lower ones may be noise
        width = peak_widths(np.exp(2 * level), peaks)[0] * np.mean(np.diff(frequency))
        found += zip(about["prominences"], frequency[peaks], width / (2 * frequency[peaks]), strict=True)
    at: list[tuple[float, float]] = []
    for _, natural, damping in sorted(found, reverse=True):
        if len(at) < count and all(abs(natural - other) > 0.02 * natural for other, _ in at):
            at.append((natural, float(np.clip(damping, 1e-3, 0.2))))
    while True:
        naturals, dampings = np.array(at).reshape(-1, 2).T
        zero = jnp.zeros((len(at), spectra.wanted.shape[2], 1))
        model = Modes(jnp.asarray(naturals), jnp.asarray(dampings), zero, zero, zero.sum(axis=0))
        if len(at) == count:
            return model
        squares = convolve1d(np.asarray(_squares(model, spectra)), average, mode="nearest")
        near = np.any(np.abs(frequency[:, None] - naturals) < 0.05 * naturals, axis=1)
        at.append((float(frequency[np.argmax(np.where(near, 0, squares))]), 0.01))


@eqx.filter_jit
def _squares(model: Modes, spectra: _Spectra) -> Float[Array, " f"]:
    """What the best gains leave, in squares, at every line."""
    best = _with_gains(model, spectra.eliminated(model)[1], spectra.coupled)
    left = spectra.wanted - jnp.swapaxes(best.frequency_response(spectra.frequency_Hz), 1, 2)
    return jnp.sum(jnp.abs(left) ** 2, axis=(1, 2))
