"""Rows for the fit of a linear plant, on the shared record: SciPy's least squares with `lsim` beside our own."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _inputs import BENCH
from _timing import Line, Table, side_by_side
from scipy.optimize import least_squares
from scipy.signal import lsim, lti

import fits
from microid import Driver, Mechanics, Piezo, Stage, Start

PLANT = BENCH / "data" / "plant.npz"
# Time constant in s, natural frequency in rad/s, damping ratio, gain in um/V.
ROUGH = np.array([2e-3, 2 * np.pi * 300, 0.1, 0.2])
NAMES = ("tau", "wn", "zeta", "gain")


@dataclass(frozen=True)
class PlantCase:
    """A record of a linear plant at rest under 0 V before its first sample, and a noise-free one to predict."""

    interval_s: float
    voltage_V: np.ndarray
    displacement_um: np.ndarray
    test_voltage_V: np.ndarray
    test_true_um: np.ndarray
    true: np.ndarray

    @property
    def time_s(self) -> np.ndarray:
        """Times of the samples."""
        return np.arange(len(self.voltage_V)) * self.interval_s

    def nrmse_pct(self, predicted_um: np.ndarray) -> float:
        """Root mean square error of the prediction, in percent of the range of the truth."""
        rms_um = np.sqrt(np.mean((predicted_um - self.test_true_um) ** 2))
        return float(100 * rms_um / np.ptp(self.test_true_um))


@dataclass(frozen=True)
class Fitted:
    """Parameters in the order and units of `ROUGH`, and the prediction of the record held out."""

    parameters: np.ndarray
    predicted_um: np.ndarray


Fit = Callable[[PlantCase], Fitted]


def plant_case() -> PlantCase | None:
    """The record shared by all benchmarks; None where it does not lie beside the repository."""
    if not PLANT.is_file():
        return None
    with np.load(PLANT) as d:
        true = np.array([float(d[name]) for name in NAMES])
        return PlantCase(float(d["dt"]), d["u_train"], d["y_train"], d["u_test"], d["y_test"], true)


def simulate_lsim(parameters: np.ndarray, voltage_V: np.ndarray, interval_s: float) -> np.ndarray:
    """Displacement of a driver and mechanics under lines between samples, from zero states."""
    tau_s, rate, damping, gain_um_per_V = parameters
    plant = lti([gain_um_per_V], np.polymul([tau_s, 1], [1 / rate**2, 2 * damping / rate, 1]))
    return lsim(plant, voltage_V, np.arange(len(voltage_V)) * interval_s, interp=True)[1]


def fit_lsim(case: PlantCase) -> Fitted:
    """The peer: logarithms of all parameters, Jacobian by finite differences, one simulation per column."""

    def residual(logarithm: np.ndarray) -> np.ndarray:
        return simulate_lsim(np.exp(logarithm), case.voltage_V, case.interval_s) - case.displacement_um

    found = np.exp(least_squares(residual, np.log(ROUGH)).x)
    return Fitted(found, simulate_lsim(found, case.test_voltage_V, case.interval_s))


def fit_own(case: PlantCase) -> Fitted:
    """Our own: no start, the state before the record unknown, the sensor's offset too."""
    stage = Stage.of(
        driver=Driver(jnp.asarray(1e-3)),
        piezo=Piezo(jnp.asarray(1.0)),
        mechanics=Mechanics(jnp.asarray(100.0), jnp.asarray(0.1)),
    ).freeze("driver.gain", "mechanics.gain")
    record = fits.Record(case.time_s, case.voltage_V, case.displacement_um, source="plant.npz")
    found = fits.fit_stage([record], stage=stage, holdout=0.0)
    names = ("driver.time_constant_s", "mechanics.natural_frequency_Hz", "mechanics.damping_ratio")
    tau_s, natural_Hz, damping = (found[name].value for name in names)
    gain_um_per_V = found["piezo.gain_um_per_V"].value
    # As the peer predicts: from zero states, without an offset.
    known = found.model.swap("piezo", Piezo(jnp.asarray(gain_um_per_V)))
    predicted = _predict(known, jnp.asarray(case.interval_s), jnp.asarray(case.test_voltage_V))
    return Fitted(np.array([tau_s, 2 * np.pi * natural_Hz, damping, gain_um_per_V]), np.asarray(predicted))


@eqx.filter_jit
def _predict(stage: Stage, interval_s: jax.Array, voltage_V: jax.Array) -> jax.Array:
    return stage(interval_s, voltage_V, Start(rest_V=jnp.zeros(())))


def _note(case: PlantCase, fitted: Fitted) -> str:
    off = 100 * np.abs(fitted.parameters / case.true - 1)
    return ", ".join(f"{name} {error:.2g}" for name, error in zip(NAMES, off, strict=True)) + " % off"


def _once(call: Callable[[], Fitted]) -> tuple[Fitted, float]:
    start = time.process_time()
    return call(), time.process_time() - start


def plant_fit(repeats: int, table: Table, fit: Fit | None = None) -> None:
    """Fit the shared record with SciPy, and with `fit` beside it, which is called once before to be compiled.

    Parameters
    ----------
    repeats
        Times both are measured, in turn.
    table
        Takes the rows.
    fit
        Our own fit of a case; it may start from `ROUGH`. Only the peer if None.
    """
    case = plant_case()
    if case is None:
        table.add(Line("plant.npz", "", "", note="skipped: shared/bench does not lie beside the repository"))
        return
    peer, once_s = _once(lambda: fit_lsim(case))
    what, found = "plant.npz, held-out NRMSE", f"{case.nrmse_pct(peer.predicted_um):.2g} %"
    table.add(Line(f"{what}, least_squares and lsim", "", found, "", f"{once_s:.3g}", _note(case, peer)))
    if fit is None:
        return
    own, first_s = _once(lambda: fit(case))
    note = f"{_note(case, own)}; first call {first_s:.3g} CPU s"
    table.add(Line(what, "", f"{case.nrmse_pct(own.predicted_um):.2g} %", note=note))
    # Both give NumPy arrays, so that nothing is left to be waited for when the clock stops.
    calls = {"own": lambda: fit(case).predicted_um, "lsim": lambda: fit_lsim(case).predicted_um}
    taken = side_by_side(calls, repeats)
    table.ratio("plant.npz, fit, over least_squares and lsim", "", taken["lsim"], taken["own"])
