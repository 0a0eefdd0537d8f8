"""What a newcomer would write instead: plain relays, and non-negative least squares on them."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.optimize import lsq_linear, nnls


def thresholds(levels: int, lower_V: float, upper_V: float) -> tuple[np.ndarray, np.ndarray]:
    """Switching voltages of the N (N + 1) / 2 relays at the centres of N x N cells: alpha and beta <= alpha."""
    centre_V = lower_V + (np.arange(levels) + 0.5) * (upper_V - lower_V) / levels
    rows, columns = np.tril_indices(levels)
    return centre_V[rows], centre_V[columns]


def numpy_relays(weight_um: np.ndarray, centre_V: np.ndarray, voltage_V: np.ndarray) -> np.ndarray:
    """Loop over samples in Python, over relays in NumPy; all relays off at the start.

    `weight_um` has shape `(N, N)`, alpha along the rows, and is zero where no relay stands. A rise switches whole
    rows on and a fall whole columns off, which is the fastest way NumPy offers.
    """
    on = np.zeros(weight_um.shape)
    flat_on, flat_weight = on.reshape(-1), weight_um.reshape(-1)
    level = np.searchsorted(centre_V, voltage_V, side="right")
    out_um = np.empty(len(voltage_V))
    before = 0
    for t, now in enumerate(level):
        if now > before:
            on[before:now] = 1
        elif now < before:
            on[:, now:before] = 0
        before = now
        out_um[t] = flat_weight @ flat_on
    return out_um


def scan_relays(weight_um: np.ndarray, alpha_V: np.ndarray, beta_V: np.ndarray) -> Callable[[jax.Array], jax.Array]:
    """Compile `lax.scan` over samples, vectorised over the packed relays."""
    weight, alpha, beta = jnp.asarray(weight_um), jnp.asarray(alpha_V), jnp.asarray(beta_V)

    def step(on: jax.Array, voltage: jax.Array) -> tuple[jax.Array, jax.Array]:
        on = (voltage >= alpha) | (on & (voltage >= beta))
        return on, jnp.sum(jnp.where(on, weight, 0))

    return jax.jit(lambda voltage: lax.scan(step, jnp.zeros(alpha.shape, dtype=bool), voltage)[1])


def relay_design(levels: int, lower_V: float, upper_V: float, voltage_V: np.ndarray) -> np.ndarray:
    """Columns of a relay model: N (N + 1) / 2 relays, N - 1 memoryless ramps and a constant of either sign.

    The ramps are what the fit under test has too. Without them the relays would have to fake the reversible part.
    """
    alpha_V, beta_V = thresholds(levels, lower_V, upper_V)
    on = np.zeros(len(alpha_V), dtype=bool)
    relays = np.empty((len(voltage_V), len(alpha_V)))
    for t, voltage in enumerate(voltage_V):
        on = (voltage >= alpha_V) | (on & (voltage >= beta_V))
        relays[t] = on
    knots = np.linspace(lower_V, upper_V, levels)
    ramps = np.clip((voltage_V[:, None] - knots[:-1]) / (knots[1] - knots[0]), 0, 1)
    one = np.ones((len(voltage_V), 1))
    return np.concatenate([relays, ramps, one, -one], axis=1)


def fit_nnls(design: np.ndarray, displacement_um: np.ndarray) -> tuple[np.ndarray, str]:
    """Lawson and Hanson's active set: weights, and what went wrong."""
    return nnls(design, displacement_um, maxiter=20 * design.shape[1])[0], ""


def fit_lsq_linear(design: np.ndarray, displacement_um: np.ndarray) -> tuple[np.ndarray, str]:
    """SciPy's bounded least squares with its default method: weights, and what went wrong."""
    # One free constant in the place of two of either sign, which would stop its interior steps from converging.
    lower = np.zeros(design.shape[1] - 1)
    lower[-1] = -np.inf
    found = lsq_linear(design[:, :-1], displacement_um, bounds=(lower, np.inf))
    return np.append(found.x, 0.0), "" if found.success else f", stopped after {found.nit} iterations"
