"""What every family's solver hands over: a model, how sure it is, and what it leaves."""

from dataclasses import dataclass

from jaxtyping import Array, Float

from microid import Preisach


@dataclass(frozen=True)
class Estimate:
    """A fitted operator.

    Attributes
    ----------
    model
        In um, with no offset.
    levels
        Of the grid on which the covariance is given; it may be coarser than the model's.
    factor_um
        `factor_um @ factor_um.T` is the covariance of the columns of that grid, shape `(D, k)`.
    noise_um
        Standard deviation of the residual.
    correlation
        Samples of the residual that are worth one independent one.
    discrepancy_um
        Standard deviation of the model's own error that the covariance does not own up to.
    """

    model: Preisach
    levels: int
    factor_um: Float[Array, "D k"]
    noise_um: float
    correlation: float
    discrepancy_um: float
