"""The numbers that decide in a diagnosis, in one place."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Thresholds:
    """What decides in a diagnosis, beside the probability of a false alarm.

    All other numbers of the package are settings of its numerics: steps, grids, rounds and what is tried first.

    Attributes
    ----------
    tie
        Difference of the Bayesian information criterion up to which two explanations are as good (Kass & Raftery,
        Journal of the American Statistical Association 90 (1995) 773, call more than 10 very strong evidence).
    apart_z
        Standard deviations up to which two are the same: effects of one class, estimates of one noise.
    model_error
        Relative error of an effect's model: what a cause leaves may look like another effect of that size.
    confused_error
        The same for effects that are known to be mistaken for each other.
    chance_z
        Standard deviations up to which a sum of squares is above its mean, or a strength off zero, by chance.
    worse_z
        Standard deviations by which an extension may predict held-out data worse, and by which one must predict them
        better that is weak, small beside the noise, or beside a rest that it does not explain; half as many where it
        is one of these.
    worse_share
        Part of their mean square by which errors in held-out data may grow with an extension: what the data held out
        do not show changes by less than that, by chance.
    strong_z
        Evidence, in standard deviations, that needs no support by other data.
    other_hold_z
        Evidence from which on the command is taken to run in another way between samples.
    explained_share
        Part of the reproducible misfit that the causes must explain to be named.
    rest_noise
        Root mean square of what is left, in sensor noise, from which on it counts as unexplained.
    rest_chance
        Probability that chance leaves as much, below which it counts.
    spike_z
        Standard deviations beyond which a single sample is an outlier.
    minor_share
        Part of a sum of squares, as of noise or a misfit, up to which something else makes it.
    cycles
        Evidence of a period in the position, in e-folds of chance.
    burst_spread, burst_kurtosis
        Spread of the sizes of a residual's stretches about their mean, and excess kurtosis of what is new in every
        sample, beyond which it comes in bursts.
    most_causes
        Causes at most.
    """

    tie: float = 10.0
    apart_z: float = 4.0
    model_error: float = 0.06
    confused_error: float = 0.6
    chance_z: float = 3.0
    worse_z: float = 2.0
    worse_share: float = 0.005
    strong_z: float = 8.0
    other_hold_z: float = 5.0
    explained_share: float = 0.65
    rest_noise: float = 0.3
    rest_chance: float = 1e-6
    spike_z: float = 7.0
    minor_share: float = 0.3
    cycles: float = 50.0
    burst_spread: float = 0.4
    burst_kurtosis: float = 1.5
    most_causes: int = 4


THRESHOLDS = Thresholds()
