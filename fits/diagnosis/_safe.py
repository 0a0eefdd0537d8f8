"""Programs that stay inside the limits of a rig, whichever of the stages that the records allow is the true one."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.diagnosis._baseline import Baseline, with_effects
from fits.diagnosis._explanation import Selection
from fits.diagnosis._predict import FARTHEST_DRAW, Hypothesis, next_record
from fits.diagnosis._prepare import Prepared
from fits.diagnosis._programs import Limits, Path, Program, Samples, menu
from fits.diagnosis._projector import Projector
from fits.io._limits import Extreme, RangeMap, Ranges, allowed, beyond, compared, joined
from fits.io._record import Record
from fits.loop._known import known_samples
from fits.stage._motion import motion, reached_by
from microid import Stage

# Draws of the plain stage, and of the stage with each hypothesis.
_DRAWS, _EACH = 4, 2
# Rounds in which the range of the voltage is narrowed, what each takes off beyond the excess, and the share of the
# range below which nothing is worth playing.
_ROUNDS, _OVERSHOOT, _NARROWEST = 12, 1.1, 0.1


@dataclass(frozen=True)
class Model:
    """A stage that the records allow, and that predicts no better than `left_um`, what it leaves of them.

    `zero_um` is what the sensor reads where the stage's own displacement is zero.
    """

    stage: Stage
    zero_um: float
    left_um: float


class Guard:
    """Predicts what a program makes the rig do, and compares it with the limits.

    The `models` are stages that the records allow, fitted with commands in `range_V`. The next run is taken to have
    the further columns of the record that it is `like`.
    """

    def __init__(self, models: Sequence[Model], limits: Ranges, like: Record, range_V: tuple[float, float]):
        self.models, self.limits, self._like, self._range_V = tuple(models), limits, like, range_V

    def extremes(self, program: Samples) -> tuple[Extreme, ...]:
        """What all stages reach, beside the limits."""
        return compared(joined(self._each(program)), self.limits)

    def allows(self, program: Samples) -> bool:
        """Whether all stages stay inside."""
        return not any(beyond(compared(ranges, self.limits)) for ranges in self._each(program))

    def _each(self, program: Samples) -> Iterable[Ranges]:
        record = next_record(*program, self._like)
        # Relays that the program does not reach may have been left in any state.
        states = ("negative",) if program[1][0] <= self._range_V[0] else ("negative", "positive")
        for model in self.models:
            for state in states:
                ranges, _ = motion(model.stage, record, self._range_V, state)
                low, high = (end + model.zero_um for end in ranges["displacement"])
                yield {**ranges, "displacement": (low - model.left_um, high + model.left_um)}

    def narrowed(self, limits: Limits) -> Limits | None:
        """Limits of commands whose slow loops stay inside; None where hardly any voltage does."""
        narrowest_V = _NARROWEST * limits.span_V
        lower_V, upper_V = self.limits["voltage"]
        lower_V, upper_V = max(limits.lower_V, lower_V), min(limits.upper_V, upper_V)
        fastest_V_per_s = min(limits.fastest_V_per_s, self.limits["slew"][1])
        limits = replace(limits, lower_V=lower_V, upper_V=upper_V, fastest_V_per_s=fastest_V_per_s)
        for _ in range(_ROUNDS):
            if not limits.span_V > narrowest_V:
                return None
            slow = replace(limits, interval_s=max(limits.interval_s, limits.duration_s / 1000))
            (moved,) = (one for one in self.extremes(Path(slow).samples()) if one.name == "displacement")
            if moved.excess <= 0:
                return limits
            per_V = (moved.high - moved.low) / limits.span_V
            lower_V = limits.lower_V + _OVERSHOOT * max(moved.lowest - moved.low, 0.0) / per_V
            upper_V = limits.upper_V - _OVERSHOOT * max(moved.high - moved.highest, 0.0) / per_V
            limits = replace(limits, lower_V=lower_V, upper_V=upper_V)
        return None

    def menu(self, limits: Limits, most: int) -> tuple[Program, ...]:
        """Programs that start inside, each with the fastest slew with which it does; with so many samples at most."""
        found: dict[tuple[str, float], Program] = {}
        for halvings in range(8):
            for program in menu(replace(limits, fastest_V_per_s=0.5**halvings * limits.fastest_V_per_s), most):
                key = program.words, program.limits.interval_s
                if key not in found and self.allows(program.samples(program.start)):
                    found[key] = program
        return tuple(found.values())


def guard_of(
    ready: Prepared, found: Selection, hypotheses: Sequence[Hypothesis], stated: RangeMap, margin: float
) -> Guard:
    """Make a guard of what a diagnosis knows, with stages drawn from what the records leave open.

    See `fits.io._limits.allowed` for the limits that are `stated`, and `margin`.
    """
    baseline = ready.baseline
    records = [run.record for run in baseline.runs]
    # What an unknown past adds is no property of the rig.
    known = [run.known & known_samples(run.record.voltage_V, *baseline.range_V) for run in baseline.runs]
    reached, offsets_um = reached_by(baseline.stage, records, baseline.range_V, ["unknown"] * len(records), known)
    limits = allowed({**reached, "voltage": baseline.range_V}, stated, margin)
    longest = int(np.argmax([record.duration_s for record in records]))
    like = records[longest]
    assert like.displacement_um is not None
    # As the sensor of the first record would have read it.
    read_um = like.displacement_um - offsets_um[longest] + offsets_um[0]
    rng = np.random.default_rng(0)

    def model(stage: Stage) -> Model:
        _, own_um = motion(stage, like, baseline.range_V)
        left_um = (read_um - own_um)[known[longest]]
        return Model(stage, float(np.mean(left_um)), float(np.std(left_um)))

    beside = found.bench.baseline
    stages = [baseline.stage]
    stages += [with_effects(beside.stage, h.effects(longest)) for h in hypotheses if h.laws]
    stages += [_drawn(baseline, ready.projector, rng) for _ in range(_DRAWS)]
    for h in hypotheses:
        for _ in range(_EACH if h.laws else 0):
            stages.append(with_effects(_drawn(beside, found.projector, rng), h.drawn(rng).effects(longest)))
    return Guard([model(stage) for stage in stages], limits, like, baseline.range_V)


def _drawn(baseline: Baseline, projector: Projector, rng: np.random.Generator) -> Stage:
    """A plain stage out of those that the records allow."""
    dz, dcolumns_um = projector.draw(rng)
    kept = np.maximum(baseline.columns_um + dcolumns_um, 0.0)
    return baseline.moved(np.clip(dz, -FARTHEST_DRAW, FARTHEST_DRAW), kept - baseline.columns_um).stage
