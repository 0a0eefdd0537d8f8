"""How sure a prediction is."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from fits.loop._design import Grid
from fits.loop._run import Run, split
from microid import Staircase, everett, remember

_BATCH = 32


class Uncertainty(eqx.Module):
    """Independent perturbations of a model, each one standard deviation long.

    The variance of a prediction is the sum of the squared responses to all of them: the covariance of the weights,
    carried through the linear operator. To that comes what the model is seen to leave out. It is the uncertainty of
    the noise-free displacement: sensor noise is not in it.

    Attributes
    ----------
    columns_um
        Perturbations of the columns of the grid, shape `(k, D)`.
    offset_um
        And of the sensor offset, shape `(k,)`.
    discrepancy_um
        Standard deviation of the model's own error, as predicting parts of the record from others shows it.
    grid
        The columns.
    """

    columns_um: Float[Array, "k D"]
    offset_um: Float[Array, " k"]
    discrepancy_um: Float[Array, ""]
    grid: Grid

    def sd_um(self, voltage_V: Float[Array, " n"], start: Staircase) -> Float[Array, " n"]:
        """Standard deviation of the predicted displacement, shape `(n,)`."""
        memory = remember(voltage_V, start)
        n = self.grid.weights

        def variance(perturbation: tuple[Float[Array, " D"], Float[Array, ""]]) -> Float[Array, " n"]:
            columns, offset = perturbation
            surface = everett(
                self.grid.nodes(columns[:n]) / self.grid.range_V**2,
                columns[n:] / self.grid.range_V,
                self.grid.lower_V,
                self.grid.upper_V,
            )
            return (surface.respond(memory) + offset) ** 2

        # In batches: all at once would take k times the memory of a simulation.
        each = lax.map(variance, (self.columns_um, self.offset_um), batch_size=_BATCH)
        return jnp.sqrt(jnp.sum(each, axis=0) + self.discrepancy_um**2)


@eqx.filter_jit
def perturbations(
    grid: Grid,
    factor_um: Float[Array, "D k"],
    mean_response: Float[Array, " D"],
    offset_sd_um: Float[Array, ""],
    discrepancy_um: Float[Array, ""],
) -> Uncertainty:
    """Turn a factor of the covariance into perturbations of a model.

    Parameters
    ----------
    grid
        The columns.
    factor_um
        `factor @ factor.T` is the covariance of the columns in um^2.
    mean_response
        Mean response of the run whose mean displacement fixes the offset.
    offset_sd_um
        Standard deviation of that mean.
    discrepancy_um
        See `Uncertainty`.
    """
    # The offset makes up for what a perturbation does to the mean of the record.
    columns = jnp.concatenate([factor_um.T, jnp.zeros((1, grid.columns))])
    offsets = jnp.append(-(mean_response @ factor_um), offset_sd_um)
    return Uncertainty(columns, offsets, discrepancy_um, grid)


@eqx.filter_jit
def _sd(uncertainty: Uncertainty, voltage_V: Float[Array, " n"], start: Staircase) -> Float[Array, " n"]:
    return uncertainty.sd_um(voltage_V, start)


def sd_run(uncertainty: Uncertainty, run: Run) -> np.ndarray:
    """Standard deviation of the predicted displacement of a run, in um, shape `(n,)`."""
    pieces = split(run.record.voltage_V)
    out = [_sd(uncertainty, jnp.asarray(v), start) for v, start in zip(pieces, run.starts, strict=True)]
    return np.concatenate(out)[: len(run.record)]
