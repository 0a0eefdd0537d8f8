"""What tolerances make of a gain beyond first order: mean shift and variance from second derivatives."""

from dataclasses import dataclass

import numpy as np

from fits.machining._design import Design
from fits.machining._gains import gain_model, gradient, hessian, inputs_of, twin
from fits.machining._tolerances import Distribution, check, covariance, excess_fourth_moment, tolerances
from microid import MOTIONS, Axis


@dataclass(frozen=True)
class SecondOrder:
    """Spread of a gain that is a quadratic function of the dimensions' errors.

    Attributes
    ----------
    axis, unit
        Which, and the unit of its gain: `um/um` or `rad/um`; per um of free elongation with `voltage`.
    distribution, voltage
        As asked for.
    names
        Dimensions that the gain depends on, `k` of them.
    gain, gradient, hessian
        At the nominal dimensions, and derivatives per mm or rad, shapes `(k,)` and `(k, k)`.
    first_order_sd, mean_shift
        Standard deviation from the gradient alone, and mean less the gain at the nominal dimensions.
    pairs
        What each pair adds to the variance at second order, shape `(k, k)`; the sum of all counts, and two equal
        halves of a pair stand at either side of the diagonal.
    """

    axis: Axis
    unit: str
    distribution: Distribution
    voltage: bool
    names: tuple[str, ...]
    gain: float
    gradient: np.ndarray
    hessian: np.ndarray
    first_order_sd: float
    mean_shift: float
    pairs: np.ndarray

    @property
    def sd(self) -> float:
        """Standard deviation at second order."""
        return float(np.sqrt(max(0.0, self.first_order_sd**2 + self.pairs.sum())))

    @property
    def second_order_share(self) -> float:
        """Part of the variance that the gradient does not give."""
        return float(self.pairs.sum() / (self.first_order_sd**2 + self.pairs.sum()))


def second_order(
    design: Design, axis: Axis, distribution: Distribution = "normal", *, voltage: bool = False
) -> SecondOrder:
    r"""Expand the gain of an axis to second order in the dimensions' errors.

    With the covariance :math:`\Sigma`, gradient g and Hessian H, the mean shifts by :math:`\tfrac12 \mathrm{tr} H
    \Sigma` and the variance is

    .. math::

        g^T \Sigma g + \tfrac12 \mathrm{tr} H \Sigma H \Sigma + \tfrac14 \sum_i H_{ii}^2 (\mu_{4i} - 3 \sigma_i^4)

    for independent dimensions of any symmetric distribution with fourth moments :math:`\mu_4`, and for correlated
    normal ones. Correlated dimensions that are not normal have joint fourth moments that this leaves out. Third
    derivatives add to the variance at the same power of the tolerances unless the gradient vanishes; they are left
    out, too.

    Parameters
    ----------
    design
        Dimensions and tolerances.
    axis
        One of `AXES`.
    distribution
        `normal` with the tolerance as three standard deviations; `uniform` or `triangular` over the tolerance.
    voltage
        Impose the voltage of the piezo instead of its elongation.

    Raises
    ------
    DataError
        If there is no such axis or distribution, or a tolerance is as large as its dimension.
    """
    check(design, (axis,), distribution)
    names = inputs_of(axis, voltage)
    at = gain_model(design, voltage), twin(axis), names
    value, slopes, bends = (np.asarray(found) for found in (*gradient(*at), hessian(*at)))
    sigma = covariance(design, names, distribution)
    bent = bends @ sigma
    tails = np.diag(bends) ** 2 * excess_fourth_moment(distribution) * tolerances(design, names) ** 4 / 4
    return SecondOrder(
        axis=axis,
        unit=f"{MOTIONS[axis].unit}/um",
        distribution=distribution,
        voltage=voltage,
        names=names,
        gain=float(value),
        gradient=slopes,
        hessian=bends,
        first_order_sd=float(np.sqrt(slopes @ sigma @ slopes)),
        mean_shift=float(np.trace(bent) / 2),
        pairs=bent * bent.T / 2 + np.diag(tails),
    )
