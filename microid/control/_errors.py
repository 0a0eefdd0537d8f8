"""Figures of merit of tracking and of steps, as in the paper's tables."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class TrackingErrors(eqx.Module):
    """Errors as a share of the reference's range (Eq. 35 and 36, Tables 3 and 4).

    Attributes
    ----------
    e_max_pct, e_rms_pct
        Largest and root-mean-square error, in percent.
    """

    e_max_pct: Float[Array, ""]
    e_rms_pct: Float[Array, ""]


def tracking_errors(reference_um: Float[Array, " t"], displacement_um: Float[Array, " t"]) -> TrackingErrors:
    """Compare a displacement with its reference.

    The paper calls `x_d` the measured displacement and divides by its range (erratum 34); here the range is that of
    the reference, which no controller changes.

    Parameters
    ----------
    reference_um, displacement_um
        Shape `(t,)`, from where the comparison is to start.
    """
    error = reference_um - displacement_um
    share = 100 / jnp.ptp(reference_um)
    return TrackingErrors(share * jnp.max(jnp.abs(error)), share * jnp.sqrt(jnp.mean(error * error)))


class StepMetrics(eqx.Module):
    """Answer to a step of the reference (Table 2).

    Attributes
    ----------
    settling_time_s
        From the step to the first sample from which on the displacement stays within the band; `inf` if the last
        sample is outside, or nothing has moved.
    overshoot_pct
        Largest displacement beyond the settling value, in percent of the way to it; where it has not settled, beyond
        the target, in percent of the step: the mean over the end of a motion that goes on is no place to count from.
    settling_value_um
        Mean over the end of the record.
    positioning_error_pct
        Distance between target and settling value, in percent of the step: Table 2's 6.429 um of 6.613 um are 2.78 %.
    """

    settling_time_s: Float[Array, ""]
    overshoot_pct: Float[Array, ""]
    settling_value_um: Float[Array, ""]
    positioning_error_pct: Float[Array, ""]


def step_metrics(
    time_s: Float[Array, " t"],
    displacement_um: Float[Array, " t"],
    target_um: Float[Array, ""] | float,
    start_um: Float[Array, ""] | float = 0.0,
    *,
    band_pct: float = 2.0,
    tail: float = 0.1,
) -> StepMetrics:
    """Measure the answer to a step at the first sample.

    Parameters
    ----------
    time_s, displacement_um
        Shape `(t,)`.
    target_um, start_um
        Reference after and before the step.
    band_pct
        Half the width of the band about the settling value, in percent of the way to it. It is about the settling
        value and not about the target, which the paper's own responses miss by up to 2.78 %.
    tail
        Share of the record, at its end, whose mean is the settling value.

    Returns
    -------
    StepMetrics
        The settling time is a sample's time and has no derivative.
    """
    count = max(1, round(tail * displacement_um.shape[0]))
    settled = jnp.mean(displacement_um[-count:])
    way, step = settled - start_um, target_um - start_um
    beyond = (displacement_um - settled) / way
    past_target = (displacement_um - target_um) / step
    # Without a way there is no quotient, and no band to be within.
    outside = ~(jnp.abs(beyond) <= band_pct / 100)
    index = jnp.arange(outside.shape[0], dtype=jnp.int32)
    first = jnp.max(jnp.where(outside, index + 1, 0))
    last = time_s[jnp.minimum(first, index[-1])] - time_s[0]
    return StepMetrics(
        jnp.where(outside[-1], jnp.inf, last),
        100 * jnp.maximum(jnp.max(jnp.where(outside[-1], past_target, beyond)), 0),
        settled,
        100 * jnp.abs(target_um - settled) / jnp.abs(step),
    )
