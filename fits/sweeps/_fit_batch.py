"""Many small loop fits at once, as `fits.fit` does them on one grid: the smoothness is stated, the noise is found."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from fits.loop._design import Grid, design
from fits.loop._moments import Moments
from fits.loop._prior import Hyper, Posterior, Roughness, effective, renew_noise
from fits.stats._nonnegative import minimise_nonnegative
from fits.sweeps._devices import by_rows
from microid import Staircase


@by_rows("voltage_V", "displacement_um", "weight", "limits_V", "smoothness", "starts")
def fit_batch(
    levels: int,
    table: Float[Array, "4 k D"],
    rough: Roughness,
    voltage_V: Float[Array, "n t"],
    displacement_um: Float[Array, "n t"],
    weight: Float[Array, "n t"],
    limits_V: Float[Array, "n 2"],
    smoothness: Float[Array, " n"],
    starts: Staircase,
) -> dict[str, Array]:
    """Fit all rows on a grid, of which `table` is the `branch_table` and `rough` the `roughness`.

    The weight is 1 for samples that are fitted and 0 for others; the smoothness that of the curvature, see `Hyper`;
    the range of the levels and the memory before it belong to each row. What comes back has a row each: `columns_um`
    as in `Grid`, `offset_um`, `noise_um`, a standard deviation, `predicted_um`, shape `(n, t)`, and `success`.
    """

    def responses(row: tuple[Array, Array, Staircase]) -> Float[Array, "t D"]:
        voltage, limits, start = row
        return design(Grid(limits[0], limits[1], levels), table, voltage, start)[0]

    def one(columns: Array, displacement: Array, weight: Array, smoothness: Array) -> dict[str, Array]:
        count, used = jnp.maximum(jnp.sum(weight), 1.0), weight > 0
        highest = jnp.max(displacement, where=used, initial=-jnp.inf)
        stroke = highest - jnp.min(displacement, where=used, initial=jnp.inf)
        mean_column, mean = weight @ columns / count, weight @ displacement / count
        left, right = (columns - mean_column[None, :]) * weight[:, None], (displacement - mean) * weight / stroke
        moments = Moments(left.T @ left, left.T @ right, right @ right, count)
        weight_of = jnp.log(smoothness)
        # The noise is found from this start, in squared strokes, in a few rounds of a fixed point.
        hyper = Hyper(weight_of, jnp.asarray(-30.0), weight_of, weight_of, jnp.log(jnp.asarray(1e-6)))

        def renew(_: int, hyper: Hyper) -> Hyper:
            posterior = Posterior.of(moments, rough, hyper)
            return renew_noise(moments, hyper, posterior, effective(rough, hyper, posterior))

        hyper = lax.fori_loop(0, 4, renew, hyper)
        posterior = Posterior.of(moments, rough, hyper)
        scale = jnp.sqrt(jnp.diagonal(posterior.precision))
        precision, mode = jnp.asarray(posterior.precision) / (scale[:, None] * scale[None, :]), posterior.mean * scale
        solution, success = minimise_nonnegative(precision, -(precision @ mode), jnp.maximum(mode, 0), 1e-6, 500)
        found = solution / scale * stroke
        offset = mean - mean_column @ found
        noise = jnp.exp(hyper.log_variance / 2) * stroke
        fitted = {"columns_um": found, "offset_um": offset, "noise_um": noise}
        return fitted | {"predicted_um": columns @ found + offset, "success": success}

    # Row by row: what a hysteresis remembers is found fastest by a loop of scalars.
    columns = lax.map(responses, (voltage_V, limits_V, starts))
    return jax.vmap(one)(columns, displacement_um, weight, smoothness)
