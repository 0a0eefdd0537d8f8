"""Voltages, densities and records that the benchmark runs on."""

from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import data_synth
from microid import Preisach, Reversible
from microid.densities import GridDensity, node_areas

BENCH = Path(__file__).parents[2] / "shared" / "bench"
RECORD = BENCH / "data" / "fit_preisach.npz"
SLOPE_um_per_V = 0.6


@dataclass(frozen=True)
class Case:
    """A record to fit and one to predict; the prediction is judged by its noise-free truth."""

    voltage_V: np.ndarray
    displacement_um: np.ndarray
    test_voltage_V: np.ndarray
    test_true_um: np.ndarray

    def nrmse_pct(self, predicted_um: np.ndarray) -> float:
        """Root mean square error of the prediction, in percent of the range of the truth."""
        rms_um = np.sqrt(np.mean((predicted_um - self.test_true_um) ** 2))
        return float(100 * rms_um / np.ptp(self.test_true_um))


def along(turning_V: np.ndarray, samples: int) -> np.ndarray:
    """Sample the way through turning points, at a constant rate."""
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(turning_V)))])
    return np.interp(np.linspace(0, way[-1], samples), way, turning_V)


def random_path(rng: np.random.Generator, samples: int, reversals: int, upper_V: float) -> np.ndarray:
    """Random reversals from 0 V on, within 0 to `upper_V`."""
    turning_V = data_synth.random_reversals(
        0.0, lower_V=0.0, upper_V=upper_V, reversals=reversals, rate_V_per_s=np.inf, sample_rate_Hz=1.0, rng=rng
    )
    return along(np.concatenate([[0.0], turning_V]), samples)


def learning_path(samples: int, upper_V: float) -> np.ndarray:
    """A major loop, first-order reversal curves from both sides, and nested loops."""
    middle_V = upper_V / 2
    turning_V = [0.0, upper_V]
    for low_V in np.linspace(0, upper_V, 12)[:-1]:
        turning_V += [low_V, upper_V]
    turning_V.append(0.0)
    for high_V in np.linspace(0, upper_V, 12)[1:]:
        turning_V += [high_V, 0.0]
    for amplitude_V in middle_V * np.arange(14, 0, -1) / 14:
        turning_V += [middle_V + amplitude_V, middle_V - amplitude_V]
    return along(np.array(turning_V), samples)


def smooth_density(seed: int, upper_V: float, stroke_um: float) -> data_synth.Rig:
    """A stage with a smooth density, drawn at random."""
    rng = np.random.default_rng(seed)
    return data_synth.random_rig(rng, kind="relays", lower_V=0.0, upper_V=upper_V, stroke_um=stroke_um)


def model_of(rig: data_synth.Rig, levels: int) -> Preisach:
    """An operator with the rig's density at its nodes, and an even reversible slope."""
    levels_V = np.linspace(rig.lower_V, rig.upper_V, levels)
    rows, columns = np.tril_indices(levels)
    density_um_per_V2 = rig.irreversible(levels_V[rows], levels_V[columns])
    areas_V2 = node_areas(levels)[rows, columns] * (rig.upper_V - rig.lower_V) ** 2
    lower_V, upper_V = jnp.asarray(rig.lower_V), jnp.asarray(rig.upper_V)
    return Preisach(
        GridDensity(jnp.asarray(density_um_per_V2 * areas_V2), lower_V, upper_V),
        Reversible(jnp.full(levels, SLOPE_um_per_V), lower_V, upper_V),
        jnp.asarray(0.0),
    )


def synthetic_case(seed: int, samples: int) -> Case:
    """A 40 um stage measured with noise of 0.1 % of its range."""
    upper_V, stroke_um = 120.0, 40.0
    rig = smooth_density(seed, upper_V, stroke_um)
    noise_rng, path_rng = np.random.default_rng(seed).spawn(2)

    def true_um(voltage_V: np.ndarray) -> np.ndarray:
        return rig.reversible(voltage_V) + rig.hysteresis().play(voltage_V)

    learn_V, test_V = learning_path(samples, upper_V), random_path(path_rng, samples, 80, upper_V)
    noise_um = 1e-3 * stroke_um * noise_rng.standard_normal(samples)
    return Case(learn_V, true_um(learn_V) + noise_um, test_V, true_um(test_V))


def shared_case() -> Case | None:
    """The record that other toolboxes were tried on; None where it is not on this machine."""
    if not RECORD.exists():
        return None
    with np.load(RECORD) as file:
        return Case(file["u_train"], file["y_train"], file["u_test"], file["y_test"])
