"""Whether the parts of what was fitted as one hysteresis belong to one, and whether readings come late in it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fits.io._errors import DataError
from fits.io._length import length
from fits.io._record import Record
from fits.loop._grid import non_negative, solve_grid
from fits.loop._misfit import Misfit, compare_gains, misfits, remarks_on, worst
from fits.loop._moments import gather, grid_of
from fits.loop._prior import Hyper, Posterior, roughness
from fits.loop._result import FitError
from fits.loop._run import Run, simulate_run
from fits.loop._surface import Surface
from fits.stats._metrics import WHITE
from fits.stats._noise import correlation_samples

# Levels on which parts are fitted alone: enough to see whether they agree.
_LEVELS = 16
# Parts disagree where both together leave so many times what each leaves alone.
_TIMES = 2.0
# A change is looked for at so many places of a run.
_PLACES = 5
# Samples that each part of a run needs.
_FEWEST_SAMPLES = 200
# A hysteresis takes part of a delay for width: it is known to so many samples at best.
_SURELY = 0.5


def check_loops(
    runs: list[Run],
    prepare: Callable[[Record, Run], Run],
    model: Surface,
    stroke_um: float,
    hyper: Hyper,
    robust: bool,
) -> tuple[Misfit, list[str]]:
    """Say how far from noise a fitted hysteresis is, and what is wrong with its runs; errors of `disagreements`.

    `prepare` makes a record ready as a run is; `robust` says whether outliers counted less.
    """
    residuals = [left_of(model, run) for run in runs]
    left, remarks = misfits(runs, residuals), remarks_on(runs, residuals, robust)
    separate = SeparateFits(stroke_um, hyper)
    try:
        told = disagreements(runs, residuals, separate, left)
    except FitError:
        # Fits of parts are only asked for an opinion.
        told = []
    quiet = all(
        one.times_noise < 1.3 and correlation_samples([residual[run.fitted]]) < WHITE
        for one, residual, run in zip(left, residuals, runs, strict=True)
    )
    if not told and not quiet:
        told = delays(runs, prepare, separate, left)
    return worst(left), [*told, *remarks]


@dataclass(frozen=True)
class SeparateFits:
    """Fits of single runs, or parts of them, on a coarse grid, in strokes, with the smoothness and noise given."""

    stroke_um: float
    hyper: Hyper

    def fit(self, runs: Sequence[Run]) -> Surface:
        """Fit a hysteresis to some runs; a `FitError` where that fails."""
        data = gather(grid_of(runs, _LEVELS), runs)
        solution = solve_grid(data, self.stroke_um, self.hyper)
        return data.grid.surface(solution.columns * self.stroke_um)

    def left(self, run: Run) -> np.ndarray:
        """What a run leaves that is fitted alone as smoothly as all are, at its fitted samples, in um."""
        data = gather(grid_of([run], _LEVELS), [run])
        moments = data.total.scaled(1.0, self.stroke_um)
        columns, _ = non_negative(Posterior.of(moments, roughness(_LEVELS), self.hyper))
        return left_of(data.grid.surface(columns * self.stroke_um), run)[run.fitted]


def left_of(model: Surface, run: Run) -> np.ndarray:
    """Measurement less prediction, in um, shape `(n,)`; offset and past are fitted to the same samples as the rest.

    In a run that was only predicted they are fitted to all known samples.
    """
    among = run.fitted if run.fitted.any() else run.known
    return run.without_nuisance(run.displacement_um - simulate_run(model, run), among)


def predicted_um(model: Surface, run: Run) -> np.ndarray:
    """What a surface predicts beside the offset and the past of a run, in um, shape `(n,)`."""
    return run.displacement_um - left_of(model, run)


def disagreements(
    runs: Sequence[Run], residuals: Sequence[np.ndarray], separate: SeparateFits, left: Sequence[Misfit]
) -> list[str]:
    """Look for runs, and parts of runs, that a hysteresis explains one by one but not together: a sentence for each.

    The residuals are those of all runs together. A `DataError` if gains of two runs differ too much for one rig.
    """
    if not any(one.far for one in left):
        return []
    remarks = []
    left_um = [residual[run.fitted] for residual, run in zip(residuals, runs, strict=True)]
    own = [_rms(left_of(separate.fit([run]), run)[run.fitted]) for run in runs]
    together = [_rms(one) for one in left_um]
    if len(runs) > 1 and _pooled(together, runs) > _TIMES * _pooled(own, runs):
        measured_um = [run.displacement_um[run.fitted] for run in runs]
        said = [measured - one for measured, one in zip(measured_um, left_um, strict=True)]
        high, low, ratio = compare_gains(said, left_um)
        joint, apart = (
            ", ".join(f"{100 * rms / np.ptp(measured):.2g}" for rms, measured in zip(each, measured_um, strict=True))
            for each in (together, own)
        )
        sentence = (
            f"{', '.join(run.record.source for run in runs)}: these runs do not show one hysteresis: fitted together "
            f"they leave {joint} % of their strokes, each alone {apart} %; under the same voltage "
            f"{runs[high].record.source} moves {ratio:.3g} times as far as {runs[low].record.source}: they are of "
            "different rigs or settings, or differ in rate, drift, load or temperature; fit them apart"
        )
        if ratio > 1.1:
            raise DataError(sentence)
        remarks.append(sentence)
    for run, rms in zip(runs, own, strict=True):
        remarks += _change_point(run, separate, rms)
    return remarks


def _change_point(run: Run, separate: SeparateFits, rms_um: float) -> list[str]:
    """Find the place from where on a run shows another hysteresis."""
    order = np.cumsum(run.fitted)
    total = int(order[-1])
    best: tuple[float, int, Surface, Surface] | None = None

    def parts(place: int) -> tuple[Run, Run]:
        before = np.arange(len(order)) < place
        return replace(run, fitted=run.fitted & before), replace(run, fitted=run.fitted & ~before)

    for k in range(1, _PLACES):
        place = int(np.searchsorted(order, total * k / _PLACES))
        if min(order[place], total - order[place]) < _FEWEST_SAMPLES:
            continue
        for _ in range(4):  # each round moves the place to where it is best
            first, second = parts(place)
            if min(first.fitted.sum(), second.fitted.sum()) < _FEWEST_SAMPLES:
                break
            models = separate.fit([first]), separate.fit([second])
            squares = [
                np.where(run.fitted, left_of(m, p) ** 2, 0.0) for m, p in zip(models, parts(place), strict=True)
            ]
            split = float(np.sqrt((squares[0][:place].sum() + squares[1][place:].sum()) / total))
            if best is None or split < best[0]:
                best = split, place, *models
            moved = int(np.argmin(np.cumsum(squares[0]) + squares[1].sum() - np.cumsum(squares[1]))) + 1
            if moved == place:
                break
            place = moved
    if best is None or best[0] * _TIMES > rms_um:
        return []
    split, place, one, other = best
    gains = [simulate_run(model, run)[run.fitted] for model in (one, other)]
    ratio = float(np.std(gains[1]) / max(np.std(gains[0]), 1e-300))
    stroke = float(np.ptp(run.displacement_um[run.fitted]))
    return [
        f"{run.record.source}: something changed near sample {place + 1} ({run.record.time_s[place]:.6g} s): fitted "
        f"as one hysteresis the run leaves {100 * rms_um / stroke:.2g} % of its stroke, its parts before and after "
        f"{100 * split / stroke:.2g} %; after it the stage moves {ratio:.3g} times as far as before: two rigs or "
        "settings, a sensor that jumped or stuck, creep over a hold, or a part that came loose; split the file "
        "there, and fit the parts apart"
    ]


def delays(
    runs: Sequence[Run], prepare: Callable[[Record, Run], Run], separate: SeparateFits, left: Sequence[Misfit]
) -> list[str]:
    """Look for readings that come late, or before their command, by fitting each run with its voltage shifted."""
    remarks = []
    for run, miss in zip(runs, left, strict=True):
        interval = float(np.median(np.diff(run.record.time_s)))

        def residual(samples: float, run: Run = run, interval: float = interval) -> np.ndarray:
            record = run.record
            voltage = np.interp(record.time_s - samples * interval, record.time_s, record.voltage_V)
            return separate.left(prepare(replace(record, voltage_V=voltage), run))

        try:
            found = _profile(residual)
        except (DataError, FitError):
            continue
        if found is None:
            continue
        samples, sd, before, after, gained = found
        # Where it leaves more than twice the noise it must take most of the residual away.
        if (
            gained < 30.0  # in twice the log likelihood
            or abs(samples) < max(5 * sd, _SURELY)
            or after > (0.4 if after > 2.0 * miss.noise_um else 1.0) * before
        ):
            continue
        sd = max(sd, _SURELY)
        size = f"{abs(samples):.1f} +- {sd:.1f} samples ({abs(samples) * interval:.3g} s)"
        where = "AFTER the voltage" if samples > 0 else "BEFORE the voltage that causes it"
        remarks.append(
            f"{run.record.source}: the displacement comes {size} {where}: taken out, the residual falls from "
            f"{length(before)} to {length(after)}; check columns and time stamps, or the lag of amplifier and sensor"
        )
    return remarks


def _profile(residual: Callable[[float], np.ndarray]) -> tuple[float, float, float, float, float] | None:
    """Delay in samples, its sd, the residual's rms without and with it, and the evidence; None if it has no end."""
    known = {0.0: residual(0.0)}

    def cost(samples: float) -> float:
        if samples not in known:
            known[samples] = residual(samples)
        return float(np.mean(known[samples] ** 2))

    # Down from none, by steps that double, and back by halves.
    best, step = 0.0, 1.0 if cost(1.0) < cost(-1.0) else -1.0
    while abs(best + step) <= 64 and cost(best + step) < cost(best):
        best, step = best + step, 2 * step
    while abs(step) > 1:
        step /= 2
        best = min((best - step, best, best + step), key=cost)
    low, middle, high = (cost(best + one) for one in (-1.0, 0.0, 1.0))
    bend = (low + high) / 2 - middle
    if not bend > 0:
        return None
    at = best + float(np.clip((low - high) / (4 * bend), -1, 1))
    after = cost(at)
    count = len(known[at]) / correlation_samples([known[at]])
    sd = float(np.sqrt(after / bend / count))
    before = cost(0.0)
    return at, sd, before**0.5, after**0.5, count * float(np.log(before / after)) if after > 0 else np.inf


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _pooled(rms: Sequence[float], runs: Sequence[Run]) -> float:
    counts = [int(run.fitted.sum()) for run in runs]
    return float(np.sqrt(np.average(np.square(rms), weights=counts)))
