"""Score tests: how much of what the baseline leaves lies along each effect that it lacks."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace

import jax.numpy as jnp
import numpy as np
from scipy import stats

from fits.diagnosis._baseline import Baseline
from fits.diagnosis._effects import Bench, Law, times, without_host
from fits.diagnosis._orthonormal import take_off
from fits.diagnosis._projector import Projector
from fits.io._threads import map_in_threads
from fits.io.columns import columns_beside
from fits.stage._encode import spec_of
from fits.stats._score_test import best_multiples, evidence, evidence_of, robust_z, squares
from microid import Coordinates
from microid.effects import EFFECTS, AbstractEffect, Scales, host

_DRAWS = 2000
# Why an effect was not asked about.
_NO_SAMPLES = "nothing of it was found, sample by sample"
_TOO_PLAIN = "the runs are too short or too plain to show it"
# Share of a signature that must be left for the records to show it at all.
_BLIND = 0.003


@dataclass(frozen=True)
class Probe:
    """A group of effects, of the size probed, that the data are asked about together.

    `signatures` are what each changes in all runs, in um: per column, a list over runs, where an effect that differs
    from run to run has one column per run. They are `positive` where the strength cannot be negative.
    """

    effects: tuple[AbstractEffect, ...]
    signatures: tuple[tuple[np.ndarray, ...], ...]
    positive: bool

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.effects[0].name

    @property
    def form(self) -> type[AbstractEffect]:
        """Which model of it."""
        return type(self.effects[0])

    @property
    def most(self) -> float:
        """The largest multiple of its signatures that means anything.

        What has a finite size, as a gap, and would have to be so much larger to show is not seen in the records.
        """
        return 300.0 if self.effects[0].finite else np.inf


def scales_of(bench: Bench, noise_um: float, period_um: float | None = None) -> Scales:
    """Measure how large things are in the runs, whose residual may have a period in the position."""
    baseline, plain = bench.baseline, bench.plain
    records = [run.record for run in baseline.runs]
    fastest = max(float(np.max(np.abs(np.diff(r.voltage_V) / np.diff(r.time_s)))) for r in records)
    lowest_um, highest_um = float(min(p.min() for p in plain)), float(max(p.max() for p in plain))
    columns: dict[str, tuple[float, float]] = {}
    for record in records:
        for name, values in columns_beside(record).items():
            columns.setdefault(name, (float(np.mean(values)), float(np.ptp(values))))
    return Scales(
        lower_V=baseline.range_V[0],
        upper_V=baseline.range_V[1],
        fastest_V_per_s=fastest,
        stroke_um=highest_um - lowest_um,
        middle_um=(highest_um + lowest_um) / 2,
        interval_s=min(float(np.median(np.diff(r.time_s))) for r in records),
        duration_s=max(r.duration_s for r in records),
        shortest_s=min(r.duration_s for r in records),
        noise_um=noise_um,
        resonance_Hz=baseline.resonance_Hz,
        columns=tuple((name, *value) for name, value in columns.items()),
        period_um=period_um,
    )


def applicable(baseline: Baseline, form: type[AbstractEffect]) -> str | None:
    """Why an effect cannot be asked about, as the end of a sentence; None where it can."""
    if form.fast and not baseline.dynamic:
        return "the runs do not show the dynamics"
    beside = [set(columns_beside(run.record)) for run in (*baseline.runs, *baseline.aside)]
    everywhere = set.intersection(*beside)
    for name in form.needs:
        if name not in everywhere:
            return f"not all runs, those held out included, have a column {name} that varies"
    for name in form.unless:
        if name in everywhere:
            return f"the column {name} says what it would be, and that is asked about instead"
    try:
        host(form, baseline.stage)
    except ValueError as error:
        return str(error)
    return None


def probes_of(
    bench: Bench,
    form: type[AbstractEffect],
    scales: Scales,
    projector: Projector | None = None,
    beside: Sequence[Sequence[AbstractEffect]] = (),
) -> Iterator[Probe]:
    """Simulate all probes of an effect, and with a projector those that begin where the residual says, too.

    `beside` are effects that each run has already.
    """
    place = host(form, bench.stage)
    inner = None if place is None else bench.stage.parts[place]
    groups = form.probes(scales, inner)
    if projector is not None and groups and hasattr(groups[0][0], "after_s"):
        groups = (*groups, *((effect,) for effect in _from_onsets(bench, projector, groups[0][0])))
    for group in groups:
        if not all(map(_is_allowed, group)):
            continue
        columns: list[tuple[np.ndarray, ...]] = []
        for effect in group:
            change = _change(bench, effect, beside)
            if form.per_run and len(change) > 1:
                nothing = [np.zeros_like(c) for c in change]
                columns += [(*nothing[:k], own, *nothing[k + 1 :]) for k, own in enumerate(change)]
            else:
                columns.append(tuple(change))
        if all(np.all(np.isfinite(c)) for column in columns for c in column):
            yield Probe(tuple(group), tuple(columns), one_sided(form))


def probe_all(bench: Bench, scales: Scales, projector: Projector) -> tuple[list[Probe], list[tuple[str, str]]]:
    """Simulate every probe of every effect that can be asked about, and say of the others why not."""

    def ask(form: type[AbstractEffect]) -> tuple[list[Probe], str | None]:
        reason = applicable(bench.baseline, form)
        found = [] if reason else list(probes_of(bench, form, scales, projector))
        unseen = _NO_SAMPLES if form.statistic else _TOO_PLAIN
        return found, reason or (None if found else unseen)

    each = map_in_threads(ask, EFFECTS)
    skipped = [(form.name, reason) for form, (_, reason) in zip(EFFECTS, each, strict=True) if reason is not None]
    return [probe for found, _ in each for probe in found], skipped


def _is_allowed(effect: AbstractEffect) -> bool:
    """Whether all but strengths keep within their bounds: of fast or slow samples not all is asked."""
    known = [(getattr(effect, field.name), spec_of(field)) for field in fields(effect)]
    return all(spec is None or np.all((spec.lower <= x) & (x <= spec.upper)) for x, spec in known)


def _change(
    bench: Bench, effect: AbstractEffect, beside: Sequence[Sequence[AbstractEffect]] = ()
) -> list[np.ndarray]:
    """What an effect changes in each run; of one that grows with its strength, the derivative where it is weak."""
    share = 1.0 if effect.finite else 1e-2
    one = effect if effect.finite else times(effect, share)
    return [c / share for c in bench.change([one], beside)]


def _from_onsets(bench: Bench, projector: Projector, effect: AbstractEffect) -> list[AbstractEffect]:
    """The effect from that instant on from which it explains most of a run, for each run.

    What begins at an instant is, to first order, what is always there less all before (matched filter).
    """

    def since(at_s: float) -> AbstractEffect:
        return replace(effect, after_s=jnp.asarray(at_s))  # type: ignore[call-arg]

    always = projector.split(projector.join(_change(bench, since(1e-9))))
    left = projector.split(projector.off(projector.residual))
    found = []
    for signal, residual, mask, one in zip(always, left, projector.masks, bench.prepared, strict=True):
        product, energy = (np.cumsum(x[::-1])[::-1] for x in (signal * residual, signal**2))
        if one_sided(type(effect)):
            product = np.maximum(product, 0.0)
        gained = product**2 / np.maximum(energy, 1e-9 * energy[:1] + 1e-300)
        time_s = one.run.record.time_s
        found.append(since(float(time_s[mask][np.argmax(gained)] - time_s[0])))
    return found


def one_sided(form: type[AbstractEffect]) -> bool:
    """Whether the strength of an effect cannot be negative."""
    specs = [spec_of(form.__dataclass_fields__[name]) for name in form.strength]
    return all(spec is not None and spec.lower >= 0 for spec in specs)


@dataclass(frozen=True)
class Scored:
    """One probe, asked.

    `size` is the norm of its signatures off the baseline's tangent space, whitened, `share_left` that over the norm
    of the raw signatures, and `coefficients` are their best multiples, shape `(k,)`. `z` is the evidence in standard
    deviations, `drop` the decrease of the sum of squares in noise variances. `robust_z` is the evidence where what is
    left counts as noise that stays alike for a while: little for an effect that only comes nearest to a misfit of
    another shape.
    """

    probe: Probe
    size: float
    z: float
    robust_z: float
    coefficients: np.ndarray
    drop: float
    share_left: float

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.probe.name

    @property
    def form(self) -> type[AbstractEffect]:
        """Which model of it."""
        return self.probe.form


@dataclass(frozen=True)
class Scores:
    """Probes asked together, and the `gram` matrix of all their signatures off the tangent, shape `(k, k)`."""

    each: tuple[Scored, ...]
    gram: np.ndarray


def score(
    projector: Projector, probes: Sequence[Probe], residual: np.ndarray, basis: np.ndarray | None = None
) -> Scores:
    """Ask about probes, beside effects that are fitted already where a `basis` spans their tangent.

    `residual` and `basis`, shape `(rows, k)`, are joined and off the baseline's tangent.
    """
    signals = [column for probe in probes for column in probe.signatures]
    joined = np.empty((len(residual), len(signals)), order="F")
    for k, column in enumerate(signals):
        joined[:, k] = projector.join(column)
    raw = squares(joined)
    projector.take_off(joined)
    # A line that sampling turns into a constant, for example: what is left of it is rounding. Or what has died away
    # so far that its square is nothing.
    joined[:, squares(joined) <= _BLIND**2 * raw] = 0.0
    if basis is not None:
        take_off(joined, basis)
    found, stop = [], 0
    for probe in probes:
        own = slice(stop, stop := stop + len(probe.signatures))
        found.append(_scored(probe, joined[:, own], residual, float(np.sum(raw[own])) ** 0.5))
    return Scores(tuple(found), joined.T @ joined)


def best_of(scores: Sequence[Scored]) -> dict[str, Scored]:
    """The highest score of each effect, the highest first."""
    found: dict[str, Scored] = {}
    for one in sorted(scores, key=lambda s: -s.z):
        found.setdefault(one.name, one)
    return found


def _scored(probe: Probe, columns: np.ndarray, residual: np.ndarray, raw: float) -> Scored:
    size = float(np.sum(squares(columns))) ** 0.5
    left = size / raw if raw > 0 else 0.0
    if left < _BLIND:
        # What the baseline follows but for rounding cannot be asked about.
        columns[:] = 0.0
        return Scored(probe, 0.0, 0.0, 0.0, np.zeros(columns.shape[1]), 0.0, left)
    z, coefficients, drop = evidence(columns, residual, probe.positive, probe.most)
    return Scored(probe, size, z, robust_z(columns @ coefficients, residual), coefficients, drop, left)


class Family:
    """The largest evidence of all probes, where there is no effect: by simulation."""

    def __init__(self, scores: Scores, rng: np.random.Generator):
        scale = np.sqrt(np.diagonal(scores.gram))
        scale = np.where(scale > 0, scale, 1.0)
        gram = scores.gram / scale / scale[:, None]
        value, vector = np.linalg.eigh(gram)
        draws = vector * np.sqrt(np.maximum(value, 0)) @ rng.standard_normal((len(value), _DRAWS))
        at, largest = 0, np.zeros(_DRAWS)
        for one in scores.each:
            stop = at + len(one.coefficients)
            own, cross = gram[at:stop, at:stop], draws[at:stop]
            multiples = best_multiples(own, cross, one.probe.positive, one.probe.most * scale[at:stop])
            largest = np.maximum(largest, evidence_of(own, cross, multiples)[0])
            at = stop
        self.largest = np.sort(largest)

    def p(self, z: float) -> float:
        """Probability that chance alone gives any effect as much evidence."""
        above = float(np.mean(self.largest >= z))
        if above * _DRAWS >= 20:
            return above
        # Beyond what was drawn, the tail of as many independent tests as agree where it was.
        edge = float(self.largest[-20])
        tests = 20 / _DRAWS / (2 * stats.norm.sf(edge))
        return float(min(1.0, tests * 2 * stats.norm.sf(z)))


def law_of(scored: Scored, runs: int, more: float = 1.0) -> Law:
    """Start from a probe and the multiples of its signatures that the data ask for, or more of them."""
    form, first = scored.form, scored.probe.effects[0]
    specs = {info.path: info.spec for info in Coordinates(without_host(first)).table}
    effects: list[AbstractEffect] = []
    for run in range(runs):
        shares = scored.coefficients[run::runs] if form.per_run and runs > 1 else scored.coefficients
        values = {}
        for name in form.strength:
            each = [
                more * share * np.asarray(getattr(effect, name))
                for share, effect in zip(shares, scored.probe.effects, strict=True)
            ]
            values[name] = jnp.asarray(np.clip(sum(each), specs[name].lower, specs[name].upper))
        effects.append(replace(first, **values) if values else first)
    return Law(effects)
