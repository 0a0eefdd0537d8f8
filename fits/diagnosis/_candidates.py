"""The effects that records can be asked about, and what each would change in them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.diagnosis._baseline import Baseline
from fits.diagnosis._evaluate import respond_again, with_effects
from fits.io.columns import columns_beside
from fits.stage._motion import Prepared, prepare, signals
from microid import AbstractEffect, Mechanics, Scales, Signal, Stage, host

# Strength at which an effect's derivative is taken, as a share of that of its probe.
_STEP = 1e-2
# Part of a period of the resonance between samples, beyond which a run does not resolve it.
_PERIOD = 0.25
# Periods of a line in a record, as its samples show it, below which it is a drift as well.
_PERIODS = 3


class Bench:
    """A fitted stage and the runs, ready to be simulated with effects.

    Parameters
    ----------
    baseline
        The plain stage.
    aside
        Whether the runs are those that are held out whole.
    finest
        Whether intervals are divided into many steps, rather than few.
    """

    def __init__(self, baseline: Baseline, aside: bool = False, finest: bool = False):
        self.baseline = baseline
        stage = baseline.stage.with_substeps(1)
        # What a fit may move is looked up anew for every stage that is built.
        self.stage = stage.thaw(*stage.frozen)
        few, many = (baseline.coarse_aside, baseline.finest_aside) if aside else (baseline.coarse, baseline.finest)
        runs = many if finest else few
        mechanics = [part for part in stage.parts if isinstance(part, Mechanics)]
        self.resonance_Hz = float(mechanics[0].natural_frequency_Hz) if mechanics else 0.0
        self.prepared = [prepare(self.stage, run) for run in runs]
        self.known = [signals(self.stage, one) for one in self.prepared]
        self.plain = [self._out(known[-1], one) for known, one in zip(self.known, self.prepared, strict=True)]

    @staticmethod
    def _out(signal: Signal, prepared: Prepared) -> np.ndarray:
        return np.asarray(signal.values)[:: prepared.run.samples.stride][: len(prepared.run.record)]

    def respond(self, effects: Sequence[Sequence[AbstractEffect]]) -> list[np.ndarray]:
        """Simulate all runs with effects, one list of effects per run; um, shape `(n,)` each."""
        return [
            respond_again(with_effects(self.stage, self._seen(own, one)), self.stage, known, one)
            for own, known, one in zip(effects, self.known, self.prepared, strict=True)
        ]

    def _seen(self, effects: Sequence[AbstractEffect], prepared: Prepared) -> list[AbstractEffect]:
        """Those that a run may be asked about: none that is its own and too fast for its samples."""
        record = prepared.run.record
        interval_s = float(np.median(np.diff(record.time_s)))
        effects = [without_drifts(effect, interval_s, record.duration_s) for effect in effects]
        if not self.resonance_Hz * interval_s > _PERIOD:
            return effects
        return [effect for effect in effects if not (effect.fast and effect.per_run)]

    def change(
        self, effects: Sequence[AbstractEffect], before: Sequence[np.ndarray] | None = None
    ) -> list[np.ndarray]:
        """What effects that all runs share change in them, in um."""
        out = self.respond([list(effects)] * len(self.prepared))
        return [a - b for a, b in zip(out, self.plain if before is None else before, strict=True)]


@dataclass(frozen=True)
class Probe:
    """A group of effects that the data are asked about together.

    Attributes
    ----------
    effects
        Of the size probed.
    signatures
        What each changes in all runs, in um: per column, a list over runs. Where an effect differs from run to run
        there is one column per run.
    positive
        Whether its strength cannot be negative.
    """

    effects: tuple[AbstractEffect, ...]
    signatures: tuple[tuple[np.ndarray, ...], ...]
    positive: bool

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.effects[0].name


def scales_of(bench: Bench, noise_um: float) -> Scales:
    """Measure how large things are in the runs."""
    baseline, plain = bench.baseline, bench.plain
    records = [run.record for run in baseline.runs]
    stage = baseline.stage
    mechanics = [part for part in stage.parts if isinstance(part, Mechanics)]
    fastest = max(float(np.max(np.abs(np.diff(r.voltage_V) / np.diff(r.time_s)))) for r in records)
    columns: dict[str, tuple[float, float]] = {}
    for run in baseline.runs:
        for name, values in columns_beside(run.record).items():
            columns.setdefault(name, (float(np.mean(values)), float(np.ptp(values))))
    return Scales(
        lower_V=baseline.range_V[0],
        upper_V=baseline.range_V[1],
        fastest_V_per_s=fastest,
        stroke_um=float(max(p.max() for p in plain) - min(p.min() for p in plain)),
        middle_um=float(max(p.max() for p in plain) + min(p.min() for p in plain)) / 2,
        interval_s=min(float(np.median(np.diff(r.time_s))) for r in records),
        duration_s=max(r.duration_s for r in records),
        shortest_s=min(r.duration_s for r in records),
        noise_um=noise_um,
        resonance_Hz=float(mechanics[0].natural_frequency_Hz) if mechanics else None,
        columns=tuple((name, *value) for name, value in columns.items()),
    )


def applicable(baseline: Baseline, form: type[AbstractEffect]) -> str | None:
    """Why an effect cannot be asked about, as the end of a sentence; None where it can."""
    stage: Stage = baseline.stage
    if form.fast and not baseline.dynamic:
        return "the runs do not show the dynamics"
    beside = [columns_beside(run.record) for run in (*baseline.runs, *baseline.aside)]
    for name in form.needs:
        if not all(name in columns for columns in beside):
            return f"not all runs, those held out included, have a column {name} that varies"
    for name in form.unless:
        if all(name in columns for columns in beside):
            return f"the column {name} says what it would be, and that is asked about instead"
    try:
        host(form, stage)
    except ValueError as error:
        return str(error)
    return None


def probes_of(bench: Bench, form: type[AbstractEffect], scales: Scales) -> Iterator[Probe]:
    """Simulate all probes of an effect."""
    stage = bench.stage
    place = host(form, stage)
    inner = None if place is None else stage.parts[place]
    for group in form.probes(scales, inner):
        columns: list[tuple[np.ndarray, ...]] = []
        for effect in group:
            share = 1.0 if form.finite else _STEP
            change = [c / share for c in bench.change([_scaled(effect, share)])]
            if form.per_run and len(change) > 1:
                for k in range(len(change)):
                    columns.append(tuple(c if i == k else np.zeros_like(c) for i, c in enumerate(change)))
            else:
                columns.append(tuple(change))
        if all(np.all(np.isfinite(c)) for column in columns for c in column):
            yield Probe(tuple(group), tuple(columns), one_sided(form))


def without_drifts(effect: AbstractEffect, interval_s: float, duration_s: float) -> AbstractEffect:
    """An effect without the lines that samples so far apart may turn into a drift of a record of this duration."""
    lines_Hz = np.array(effect.lines_Hz)
    # Samples shift a frequency by a multiple of their rate.
    shifted_Hz = np.abs(lines_Hz - np.round(lines_Hz * interval_s) / interval_s)
    seen = (shifted_Hz - effect.tolerance * lines_Hz) * duration_s > _PERIODS
    if seen.all():
        return effect
    return replace(effect, **{name: getattr(effect, name) * seen.astype(float) for name in effect.strength})


def _scaled(effect: AbstractEffect, share: float) -> AbstractEffect:
    if share == 1.0 or not effect.strength:
        return effect
    return replace(effect, **{name: share * getattr(effect, name) for name in effect.strength})


def one_sided(form: type[AbstractEffect]) -> bool:
    """Whether the strength of an effect cannot be negative."""
    from fits.stage._encode import spec_of

    fields = form.__dataclass_fields__
    specs = [spec_of(fields[name]) for name in form.strength]
    return not specs or all(spec is not None and spec.lower >= 0 for spec in specs)
