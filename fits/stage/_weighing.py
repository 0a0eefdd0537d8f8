"""How much each run counts in the fit of a stage: by what is left of it, and how alike neighbouring samples are."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.loop._moments import Moments
from fits.loop._run import Run
from fits.stage._moments import RunSums
from fits.stats._noise import correlation_samples


@dataclass(frozen=True)
class Weighing:
    """How much a sample of each run counts, by the standard deviation of the run's residual.

    So many samples as `correlation` are worth one independent one; `counted` is the same as the samples are counted.
    No run counts as quieter than the part `least_noise_share` of the loudest.
    """

    noise_um: tuple[float, ...]
    correlation: tuple[float, ...]
    counted: tuple[float, ...]
    least_noise_share: float = 0.0

    @classmethod
    def of(cls, runs: Sequence[Run], residuals: Sequence[np.ndarray], *counted: float) -> "Weighing":
        """Weigh runs by what a fit leaves of them, all equally correlated unless `counted` is given."""
        noise, correlation = [], []
        for run, residual in zip(runs, residuals, strict=True):
            left = residual[run.fitted]
            noise.append(float(np.sqrt(np.average(left**2, weights=run.fit_weight[run.fitted]))))
            correlation.append(correlation_samples([left]))
        each = float(np.exp(np.mean(np.log(correlation))))
        return cls(tuple(noise), tuple(correlation), counted or (each,) * len(noise))

    def alike(self) -> "Weighing":
        """As if all runs had the same noise, and no sample any of another."""
        noise = (float(np.sqrt(np.mean(np.square(self.noise_um)))),) * len(self.noise_um)
        return replace(self, noise_um=noise, counted=(1.0,) * len(noise))

    @property
    def least_um(self) -> float:
        """The smallest noise, in which the joint problem is measured."""
        return max(min(self.noise_um), self.least_noise_share * max(self.noise_um))

    @property
    def shares(self) -> list[float]:
        """Independent samples of the quietest run that a sample of each run is worth."""
        noises = zip(self.noise_um, self.counted, strict=True)
        return [(self.least_um / max(um, self.least_um)) ** 2 / each for um, each in noises]

    def total(self, sums: Sequence[RunSums]) -> Moments:
        """Moments of all runs."""
        first, *more = (one.moments.scaled(share, 1.0) for one, share in zip(sums, self.shares, strict=True))
        return sum(more, start=first)

    def cost_um2(self, runs: Sequence[Run], residuals: Sequence[np.ndarray]) -> float:
        """Sum of squares that goes with `total`."""
        each = zip(runs, residuals, self.shares, strict=True)
        return sum(share * float(np.sum(run.fit_weight * left**2)) for run, left, share in each)
