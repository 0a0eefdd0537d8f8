"""A plain stage fitted to runs, their command in one way between samples, and whether the runs show another way."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from fits.diagnosis._baseline import simulate
from fits.diagnosis._effects import Bench, Law
from fits.diagnosis._joint_fit import alternate, fit_from_poles
from fits.diagnosis._noise import Faults
from fits.diagnosis._projector import Projector
from fits.diagnosis._refit import nothing, refit, refit_beside
from fits.diagnosis._regression import Regression
from fits.diagnosis._residual_tests import period_of, repeats_in
from fits.diagnosis._score import Probe, Scored, law_of, probe_all, probes_of, scales_of, score
from fits.diagnosis._thresholds import THRESHOLDS, Thresholds
from fits.stage._run import residual_of
from microid import Hold
from microid.effects import EFFECTS, AbstractEffect, Scales

Holds = tuple[Hold, ...]
IN_LINES: Holds = ("first",)
IN_STEPS: Holds = ("zero",)
_HOLDS: Holds = "first", "smooth", "zero"
# Halves of a sample by which readings are late of a command that is held between samples.
_LEAST, _MOST = 0.5, 1.2
# What is left exceeds noise by no more than this part of it.
_NOISE = 0.05
# So many effects are fitted beside a way of the command, which one explains that leaves half of what others do.
_TRIED, _HALF = 4, 0.5
# Lines with a lag that is no more than steps leave less of what is beyond noise by no more than this part.
_PLAIN = 0.1


@dataclass(frozen=True)
class PlainFit:
    """The plain stage, fitted to runs in one way."""

    regression: Regression
    faults: Faults
    thresholds: Thresholds = THRESHOLDS

    @property
    def holds(self) -> Holds:
        """How the command of each run is taken to go between samples."""
        return tuple(run.hold for run in self.regression.baseline.runs)

    @property
    def is_rounded(self) -> bool:
        """Whether rounding is more than a minor part of the noise."""
        return self.faults.is_rounded(self.thresholds)

    @cached_property
    def projector(self) -> Projector:
        return Projector(self.regression, self.faults.noise).bounded()

    @cached_property
    def bench(self) -> Bench:
        return Bench(self.regression.baseline)

    @cached_property
    def scales(self) -> Scales:
        repeated = repeats_in(self.projector, self.left, self.bench.plain)
        period_um = period_of(repeated, self.faults.quantum_um, self.thresholds)
        return scales_of(self.bench, min(noise.total_um for noise in self.faults.noise), period_um)

    @cached_property
    def probed(self) -> tuple[list[Probe], list[tuple[str, str]]]:
        """Probes of every effect that can be asked about, and why the others cannot be."""
        return probe_all(self.bench, self.scales, self.projector)

    @cached_property
    def left(self) -> np.ndarray:
        """What the stage leaves, whitened and joined."""
        return self.projector.off(self.projector.residual)

    def left_in(self, faults: Faults) -> np.ndarray:
        """What the stage leaves, in the noise of others."""
        there = Projector(self.regression, faults.noise).bounded()
        return there.off(there.residual)

    def in_noise_of(self, other: "PlainFit") -> "PlainFit":
        """The same beside the noise of another fit; effects are not simulated again."""
        found = replace(self, faults=other.faults)
        found.__dict__.update(bench=self.bench, scales=self.scales, probed=self.probed, _delays=self._delays)
        return found

    @cached_property
    def _delays(self) -> list[Probe]:
        form = next(form for form in EFFECTS if form.delay)
        return list(probes_of(self.bench, form, self.scales))

    def late(self, left: np.ndarray | None = None) -> tuple[float, float]:
        """Decrease of that, or of what is `left` otherwise, by a delay, and the delay in s."""
        scores = score(self.projector, self._delays, self.left if left is None else left).each
        if not scores:
            return 0.0, 0.0
        best = max(scores, key=lambda one: one.drop)
        return best.drop, float(best.coefficients[0] * getattr(best.probe.effects[0], best.probe.form.delay))

    def delay_drop(self, left: np.ndarray) -> float:
        """The same decrease, if that is a delay and no lead."""
        drop, late_s = self.late(left)
        return drop if late_s > 0 else 0.0

    def largest_z(self, left: np.ndarray | None = None) -> float:
        """Evidence of the effect that has most, in what is `left`."""
        scores = score(self.projector, self.probed[0], self.left if left is None else left).each
        return max((one.z for one in scores), default=0.0)

    @cached_property
    def _under(self) -> list[dict[Hold, np.ndarray]]:
        """What another command between the samples of each run changes, the stage following along its tangent."""
        baseline, found = self.regression.baseline, []
        for k, run in enumerate(baseline.finest):
            here, each = simulate(baseline.stage, run), dict[Hold, np.ndarray]()
            for hold in _HOLDS:
                change = [np.zeros(len(one.record)) for one in baseline.finest]
                if hold != run.hold:
                    change[k] = simulate(baseline.stage, replace(run, hold=hold)) - here
                each[hold] = self.projector.off(self.projector.join(change))
            found.append(each)
        return found

    def left_under(self, holds: Sequence[Hold]) -> np.ndarray:
        """What is left with the command of each run in some way between samples."""
        found: np.ndarray = self.left - sum(each[hold] for each, hold in zip(self._under, holds, strict=True))
        return found

    def better_holds(self, thresholds: Thresholds) -> Holds:
        """How the command of each run goes between samples, as it was taken unless there is evidence for another way.

        Curves must leave less than lines beyond chance. Steps must explain what a delay behind the others does, or
        leave far less than any effect beside the others. Together they must explain more with the best effect beside
        them than those that were taken.
        """
        least, off = thresholds.other_hold_z**2, thresholds.model_error
        taken, noise = self.holds, len(self.left)
        whole, best = float(self.left @ self.left), self.largest_z() ** 2

        def gained(holds: Holds) -> float:
            left = self.left_under(holds)
            return whole - float(left @ left)

        @cache
        def delayed(holds: Holds) -> float:
            return self.delay_drop(self.left_under(holds))

        def alone(holds: Holds) -> float:
            return gained(holds) - least * sum(hold != own for hold, own in zip(holds, taken, strict=True))

        def worth(holds: Holds) -> float:
            # A delay beside them is one cause more.
            return alone(holds) + (1 - off) * delayed(holds)

        def most(worth: Callable[[Holds], float]) -> Holds:
            starts = taken, *((hold,) * len(taken) for hold in _HOLDS)
            return max((_climbed(worth, start) for start in starts), key=worth)

        found = most(worth)
        if {*found} - {*taken} >= {"zero"}:
            without = tuple(_HOLDS[0] if hold == "zero" else hold for hold in found)
            late, more = delayed(without), gained(found) - gained(without)
            explained = late > least and (more > (1 - off) * late or more + delayed(found) - late > off * late)
            # The stage may have taken up how late they are, in a way that leaves far more than steps do.
            if not explained and not is_far_less(whole - gained(found), whole - best, noise):
                found = _climbed(worth, without, _HOLDS[:2])

        @cache
        def beside(holds: Holds) -> float:
            return gained(holds) + self.largest_z(self.left_under(holds)) ** 2

        def shared(holds: Holds, by: Callable[[Holds], float] = gained) -> Holds:
            """The same with runs that do not show their own way going as the others do.

            Of what more than noise is left in any way, a small part shows none. What takes an effect to explain as
            much as their own ways do without any is no simpler.
            """
            alike = max(((way,) * len(holds) for way in dict.fromkeys(holds)), key=by)
            own = max(least, off * (whole - len(self.left)))
            needs_more = gained(holds) > max(gained(alike) + own, (1 - off) * beside(alike))
            return alike if by(alike) > by(holds) - own and not needs_more else holds

        if any(way == "zero" != own for way, own in zip(found, taken, strict=True)):
            # What only a delay beside it would be worth may hide what needs none.
            ways = (way for way in (found, most(alone)) if gained(way) > least and beside(way) > (1 - off) * best)
            return shared(next(ways, taken))
        # A large effect may hide between the samples what only shows beside it.
        each = [{k} for k in range(len(taken))] + [set(range(len(taken)))]

        def instead(way: Hold) -> list[Holds]:
            """One run, or all of them, going in another way."""
            changed = (tuple(way if k in which else hold for k, hold in enumerate(taken)) for which in each)
            return [holds for holds in changed if holds != taken]

        # Levels looked like steps, and may have been lines.
        curves = [holds for holds in (found, *instead(_HOLDS[1]), *instead(_HOLDS[0])) if holds != taken]
        # Steps that leave less without any effect explain what a delay does.
        late = delayed(taken)
        as_delay = (1 - off) * late if late > least else np.inf
        steps = [holds for holds in instead(_HOLDS[2]) if not least <= gained(holds) <= as_delay]
        found = max((*curves, *steps), key=beside)
        # Of what more than noise is left in any way, a small part decides nothing.
        if beside(found) > best + max(least, off * (whole - best - len(self.left))):
            return shared(found, beside)
        # They need no parameter, and are taken beside an effect that would explain little more.
        found = max(curves, key=gained, default=taken)
        large = gained(found) > max(least, thresholds.minor_share * best)
        return shared(found) if large and beside(found) > (1 - off) * best else taken

    def may_be_held(self, thresholds: Thresholds) -> bool:
        """Whether more than noise is left, and is late, or a run held out is predicted better in steps."""
        if {*self.holds} == {"zero"} or float(self.left @ self.left) <= (1 + _NOISE) * len(self.left):
            return False
        return self.foretold_in_steps or self.delay_drop(self.left) > thresholds.other_hold_z**2

    @property
    def foretold_in_steps(self) -> bool:
        """Whether a run held out is predicted better in steps, though those that were fitted run in another way."""
        aside = {run.hold for run in self.regression.baseline.aside}
        return "zero" in aside and "zero" not in self.holds

    @property
    def is_half_a_sample_late(self) -> bool:
        """Whether nothing explains more than a delay of half a sample, of which the poles may have taken some."""
        drop, late_s = self.late()
        halves = 2 * late_s / self.scales.interval_s
        return drop > (1 - self.thresholds.model_error) * self.largest_z() ** 2 and _LEAST < halves < _MOST

    @cached_property
    def missed_um2(self) -> float:
        """Sum of squares by which all that is held out is missed."""
        baseline = self.regression.baseline
        parts = [*((run, run.held_out) for run in baseline.runs), *((run, run.known) for run in baseline.aside)]
        return sum(float(np.sum(residual_of(baseline.stage, run)[which] ** 2)) for run, which in parts)

    def explains_more(self, other: "PlainFit") -> bool:
        """Whether less is left beside the best effect than another fit leaves, and nothing is predicted worse.

        It is enough that about as much is left, and that what is held out is predicted better, where runs held out go
        as here, and not as those of the other, or nothing explains more there than a delay of half a sample.
        """
        here = self.in_noise_of(other)
        noise, off = len(here.left), self.thresholds.model_error
        rest, there = (float(one.left @ one.left) - one.largest_z() ** 2 for one in (here, other))
        if self.missed_um2 > (1 + off) * other.missed_um2:
            return False
        # Of noise alone nothing would leave less.
        if there > (1 + _NOISE) * noise and rest < there - max(
            self.thresholds.other_hold_z**2, off * (there - noise)
        ):
            return True
        predicts = rest < (1 + off) * there and self.missed_um2 < (1 - off) * other.missed_um2
        return predicts and (other.foretold_in_steps or other.is_half_a_sample_late)

    def leaves_less(self, other: "PlainFit") -> bool:
        """Whether less is left here than another fit leaves."""
        left = self.left_in(other.faults)
        return float(left @ left) < float(other.left @ other.left)

    def left_beside_lag(self) -> float:
        """Sum of squares beside a lag of the reading, from poles that the runs show together with it."""
        probe = next((probe for probe in self.probed[0] if probe.form.lag), None)
        if probe is None:
            return np.inf
        law = Law([probe.effects[0]] * len(self.regression.baseline.runs))
        model = refit(self.bench, self.projector, [law], [law.start], 0)
        ends = fit_from_poles(self.bench, self.projector, model)
        return min((end[-1].cost for end in ends), default=np.inf)

    def left_beside_delay(self) -> float:
        """Sum of squares beside a delay of the reading."""
        scores = score(self.projector, self._delays, self.left).each
        if not scores:
            return np.inf
        law = law_of(max(scores, key=lambda one: one.drop), len(self.regression.baseline.runs))
        model = refit(self.bench, self.projector, [law], [law.start])
        return alternate(self.bench, self.projector, model)[-1].cost

    @cached_property
    def left_beside_late(self) -> float:
        """Sum of squares beside a lag or a delay of the reading, which may leave noise alone, too."""
        return min(self.left_beside_lag(), self.left_beside_delay())

    @cached_property
    def left_beside_best(self) -> float:
        """Sum of squares beside the best of some effects, fitted with the stage; no lags, as steps resemble these."""
        nothing_yet = nothing(self.bench, self.projector)
        probes = [probe for probe in self.probed[0] if not (probe.form.delay or probe.form.lag)]
        best: dict[type[AbstractEffect], Scored] = {}
        for one in sorted(score(self.projector, probes, self.left).each, key=lambda one: -one.z):
            best.setdefault(one.form, one)
        found = [refit_beside(self.bench, self.projector, nothing_yet, one) for one in [*best.values()][:_TRIED]]
        if not found:
            return np.inf
        model = min(found, key=lambda one: one.cost)
        return min(model.cost, alternate(self.bench, self.projector, model)[-1].cost)

    def outdoes(self, other: "PlainFit") -> bool:
        """Whether less is left here than by another fit, each with what explains most beside it.

        Steps need no parameter, and are much like lines behind a delay, so that lines must leave less by more than a
        little, and a lag may stand beside either. Curves need no effect, or leave less by far beside one, or lines
        are kept.
        """
        there = other.in_noise_of(self)
        whole, here, noise = (float(there.left @ there.left), float(self.left @ self.left), len(there.left))
        if "zero" in other.holds:
            # Of noise alone nothing would leave less; of rounding, whose errors are not independent, by a little.
            slack = self.thresholds.rest_noise**2 if self.is_rounded else _NOISE
            if whole <= (1 + slack) * noise:
                return False
            lines, steps = (min(one.left_beside_best, one.left_beside_lag()) for one in (self, there))
            return lines < steps - max(self.thresholds.other_hold_z**2, _PLAIN * (steps - noise))
        # Where either leaves noise alone, that is not asked.
        if min(here, whole) > (1 + _NOISE) * noise:
            near, far = self.left_beside_best, there.left_beside_best
            if is_far_less(min(near, far), max(near, far), noise):
                return near < far
        if max(here, whole) <= (1 + _NOISE) * noise:
            # Of noise alone no more than chance is left less by either.
            return self.missed_um2 <= other.missed_um2
        rest = whole - other.largest_z() ** 2
        # Lines that leave no more, alone and beside the best effect, are kept.
        if here <= whole and here - self.largest_z() ** 2 <= rest:
            return True
        if rest <= (1 + _NOISE) * noise:
            least = min(there.left_beside_late, there.left_beside_best) - self.thresholds.other_hold_z**2
            return self.left_beside_late < least
        # Of what is more than noise either way, a small part decides nothing, unless the best effect explains less.
        if here - whole < min(_NOISE * (here - noise), self.largest_z() ** 2):
            return True
        return self.left_beside_late < min((1 + _NOISE) * rest, (1 - _NOISE) * whole)


def is_far_less(cost: float, other: float, noise: int) -> bool:
    """Whether one sum of squares is far less beyond noise than another, which is beyond it."""
    return cost - noise < _HALF * (other - noise) and other > (1 + _NOISE) * noise


def _climbed(worth: Callable[[Holds], float], holds: Holds, among: Holds = _HOLDS) -> Holds:
    """Change one hold at a time, that which is worth most, for as long as that is worth more."""
    while True:
        others = [(*holds[:k], hold, *holds[k + 1 :]) for k in range(len(holds)) for hold in among]
        best = max(others, key=worth)
        if worth(best) <= worth(holds):
            return holds
        holds = best
