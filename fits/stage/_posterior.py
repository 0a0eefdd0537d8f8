"""The whole posterior of a stage's parameters, by NUTS: for those who do not trust a standard deviation."""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.io._errors import DataError
from fits.io._record import Record
from fits.loop._result import FitResult
from fits.loop._samples import Samples
from fits.stage._moments import offsets_out
from fits.stage._run import nuisance_columns, prepare_again, project_out, residual_of, respond
from fits.stage._solve import Weighing
from microid import Coordinates, Stage


@dataclass(frozen=True)
class Draws:
    """Draws from a posterior.

    Attributes
    ----------
    names
        Of the parameters.
    values
        In their units, shape `(draws, p)`.
    divergences
        Number of trajectories that went astray; more than a few mean that the draws are not to be trusted.
    """

    names: tuple[str, ...]
    values: np.ndarray
    divergences: int


def _potential(
    data: tuple[Coordinates[Stage], list[Samples], list[Float[Array, ""]]], z: Float[Array, " p"]
) -> Float[Array, ""]:
    """Minus the logarithm of the likelihood."""
    coordinates, runs, precision = data
    stage, total = coordinates(z), jnp.zeros(())
    for samples, share in zip(runs, precision, strict=True):
        off = project_out(
            nuisance_columns(stage, samples), samples.weight, samples.displacement_um - respond(stage, samples)
        )
        total = total + share * jnp.sum(samples.weight * off**2) / 2
    return total


def sample_posterior(
    result: FitResult[Stage],
    records: Sequence[Record],
    *,
    draws: int = 1000,
    warmup: int = 500,
    seed: int = 0,
    holdout: float = 0.2,
    initial: str = "unknown",
) -> Draws:
    """Draw from the posterior of the parameters, flat in the solver's coordinates, the hysteresis as it was fitted.

    Needs numpyro: `pip install -c constraints.txt ".[posterior]"`.

    Parameters
    ----------
    result
        From `fit_stage` of the same records; where the sampler starts.
    records, holdout, initial
        As they were given there.
    draws, warmup
        Number of draws, and of steps to adapt before.
    seed
        Of the sampler.

    Raises
    ------
    DataError
        If numpyro is not installed.
    """
    try:
        from numpyro.infer import MCMC, NUTS
    except ImportError:
        raise DataError('the posterior needs numpyro: pip install -c constraints.txt ".[posterior]"') from None
    stage = result.model.with_substeps(1)
    runs = prepare_again(result.model, records, initial, holdout)
    weighing = Weighing.of(runs, [residual_of(stage, run) for run in runs])
    precision = [
        jnp.asarray(1 / (noise**2 * correlation))
        for noise, correlation in zip(weighing.noise_um, weighing.correlation, strict=True)
    ]
    coordinates = offsets_out(stage, True)
    data = coordinates, [run.samples for run in runs], precision
    sampler = MCMC(
        NUTS(potential_fn=eqx.Partial(_potential, data), dense_mass=True),
        num_warmup=warmup,
        num_samples=draws,
        progress_bar=False,
    )
    # The sampler's own arithmetic mixes precisions.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        sampler.run(jax.random.key(seed), init_params=coordinates.of(stage), extra_fields=("diverging",))
        z = sampler.get_samples()
        lost = int(np.sum(np.asarray(sampler.get_extra_fields()["diverging"])))
    values = np.asarray(jax.vmap(coordinates.values)(z))
    return Draws(tuple(parameter.name for parameter in result.parameters), values, lost)
