"""How fine a grid the records bear: resolutions tried until blocks are no longer predicted better."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fits.io._errors import DataError
from fits.loop._grid import BELIEF_LEVELS, GridSolution, cross_validate, relaxation_of, solve_coloured, solve_grid
from fits.loop._moments import BLOCKS, PIECES, Data, gather, grid_of
from fits.loop._prior import Hyper
from fits.loop._result import FitError, LevelTrial
from fits.loop._run import Progress, Run, simulate_run
from fits.stats._metrics import WHITE
from fits.stats._noise import correlation_samples, huber_weight, quantum_um, repeated_square

# Resolutions in steps of the square root of two.
LADDER = (16, 23, 32, 45, 64, 90)


@dataclass(frozen=True)
class GridTrial:
    """A resolution that was tried: its data, its solution, and how it predicts blocks from the others.

    `white` is the smoothness and noise that the evidence has where all samples are taken for independent ones.
    """

    data: Data
    solution: GridSolution
    white: Hyper
    correlation: float
    error_um: float
    discrepancy_um: float


def choose_grid(
    runs: Sequence[Run], levels: int | None, progress: Progress, finest: int = LADDER[-1], alone: bool = False
) -> tuple[float, GridTrial, list[LevelTrial]]:
    """Fit grids of rising resolution up to the finest, or of the one given, and keep the one that predicts best.

    A hysteresis that is fitted `alone` may be rougher than the evidence has it; beside what lags or creeps it would
    take that in. Returns the stroke in um, the unit of the columns, the grid that is kept, and all trials. A
    `DataError` where there is no loop to fit, a `FitError` where a solver fails.
    """
    stroke = max(_stroke(run) for run in runs)

    def trial(n: int, before: GridTrial | None) -> GridTrial:
        progress(f"{n} levels")
        data = gather(grid_of(runs, n), runs, progress=progress)
        return try_grid(data, runs, stroke, before, levels is None, alone)

    digit = max(quantum_um(run.displacement_um[run.fitted]) for run in runs)
    tried, trials = _resolve(trial, levels, finest, 1.2 * digit / 12**0.5)
    return stroke, tried, trials


def _resolve(
    trial: Callable[[int, GridTrial | None], GridTrial], levels: int | None, finest: int, rounding_um: float
) -> tuple[GridTrial, list[LevelTrial]]:
    """Refine until it no longer pays; of grids that predict alike the finest is kept.

    What a last digit rounds off repeats itself with every loop, and a fine grid would follow it from digit to digit.
    """
    best = trial(levels or LADDER[0], None)
    trials = [LevelTrial(best.data.grid.levels, best.error_um)]
    for n in [n for n in LADDER[1:] if n <= finest] if levels is None else ():
        if best.error_um <= rounding_um:
            break
        try:
            finer = trial(n, best)
        except FitError:
            # What is coarser has an answer.
            break
        trials.append(LevelTrial(n, finer.error_um))
        # A fit takes eight times as long for twice the levels, and must be worth it.
        pays = finer.error_um < (1 - 0.005 * max(1.0, n / 32) ** 2) * best.error_um
        best = finer if finer.error_um <= best.error_um else best
        if not pays:
            break
    return best, trials


def try_grid(
    data: Data, runs: Sequence[Run], stroke: float, before: GridTrial | None, compare: bool, alone: bool = False
) -> GridTrial:
    """Fit a grid, after what another one found `before`.

    The smoothness is the density's, not the grid's: of a hysteresis `alone` it is kept. Beside what is not there yet
    it is looked for anew, from there on.
    """
    grid, correlation = data.grid, 1.0
    start = Hyper.start() if before is None else before.solution.hyper
    solution = solve_grid(data, stroke, None if alone else start, known=before.white if alone and before else None)
    white = solution.hyper
    model = grid.surface(solution.columns * stroke)
    # Misfit and coloured noise make neighbouring residuals agree; counted as independent they would fake precision.
    off = [run.without_nuisance(run.displacement_um - simulate_run(model, run), run.fitted) for run in runs]
    left = [run.weighed(one)[run.fitted] for run, one in zip(runs, off, strict=True)]
    found = correlation_samples(left)
    if found > WHITE:
        correlation = found
        pieces = int(np.clip(sum(map(len, left)) / correlation, BLOCKS, PIECES))
        data = data if pieces == PIECES else gather(grid, runs, pieces)
        if alone:
            relaxation = relaxation_of(data, stroke, solution.hyper)
            solution = solve_coloured(data, stroke, correlation, solution.hyper, relaxation)
        else:
            # What a stage adds is not there yet, and must not become roughness of the density.
            solution = solve_grid(data, stroke, start, correlation)
    n = grid.levels if compare else min(grid.levels, BELIEF_LEVELS)
    error, discrepancy = cross_validate(data, runs, stroke, correlation, solution.hyper, n)
    # What is finer than the samples looks like noise but for coming back with the voltage.
    repeated = [
        repeated_square(run.voltage_V[run.fitted], one, correlation) for run, one in zip(runs, left, strict=True)
    ]
    discrepancy = max(discrepancy, float(np.average(repeated, weights=[len(one) for one in left])) ** 0.5)
    return GridTrial(data, solution, white, correlation, error, discrepancy)


def _stroke(run: Run) -> float:
    voltage, displacement = run.record.voltage_V[run.fitted], run.displacement_um[run.fitted]
    if np.ptp(displacement) == 0 or np.ptp(voltage) == 0:
        raise DataError(f"{run.record.source}: nothing moves in the samples to be fitted; hold out less")
    together = float(np.corrcoef(voltage, displacement)[0, 1])
    if abs(together) < 0.3:
        _refuse_ringing(run)
        raise DataError(
            f"{run.record.source}: the displacement hardly follows the voltage (correlation {together:.2f}), so "
            "there is no hysteresis loop to fit; check that the right columns are named"
        )
    if together < 0:
        raise DataError(
            f"{run.record.source}: the displacement falls where the voltage rises, which no density of relays does; "
            "change the sign of one of the two columns, or name them the other way round if they are exchanged"
        )
    # Measured loops have -0.9 to -1.0, see `_leads`, and 0.8 to 1.0 with their columns exchanged.
    if _leads(voltage, displacement) > 0.5:
        raise DataError(
            f"{run.record.source}: the displacement runs ahead of the voltage round its loops, where a piezo stays "
            "behind: the two columns are exchanged, or the second is the force that a motion meets, as of friction; "
            "correct the header, or name them the other way round"
        )
    return float(np.ptp(displacement))


def _refuse_ringing(run: Run) -> None:
    """Refuse a run whose displacement follows its voltage, but not at once."""
    from scipy import signal  # slow to import, and hardly ever needed

    which = np.flatnonzero(run.fitted)
    piece = slice(which[0], which[-1] + 1)
    voltage, displacement = run.record.voltage_V[piece], run.displacement_um[piece]
    rate_Hz = float(1 / np.median(np.diff(run.record.time_s[piece])))
    settings: dict[str, Any] = {"fs": rate_Hz, "nperseg": max(len(voltage) // 16, 16)}
    frequency, cross = signal.csd(voltage, displacement, **settings)
    power, out = (signal.welch(one, **settings)[1] for one in (voltage, displacement))
    shared = np.abs(cross) ** 2 / (power * out + 1e-300)
    follows = float(np.average(shared, weights=power))
    if follows < 0.2:
        return
    clear = (shared > min(0.3, follows)) & (power > np.median(power))  # lines whose gain is trusted
    gain = np.where(clear, np.abs(cross) / (power + 1e-300), 0.0)
    raise DataError(
        f"{run.record.source}: the displacement follows the voltage (coherence {follows:.2f}), but not at once, and "
        f"most near {frequency[np.argmax(gain)]:.4g} Hz: this run plays up to a resonance and beyond, and shows no "
        "hysteresis loop; give a slow run over the whole range of the voltage, beside this one to fit a whole stage"
    )


def _leads(voltage_V: np.ndarray, displacement_um: np.ndarray) -> float:
    """Signed over absolute area of the loops: -1 where the displacement lags everywhere, 1 where it leads."""
    place = (voltage_V - voltage_V.mean()) / np.ptp(voltage_V)
    cubic = np.vander(place, 4)
    beside = displacement_um - cubic @ np.linalg.lstsq(cubic, displacement_um)[0]
    parts = (beside[1:] + beside[:-1]) * np.diff(place)
    return float(parts.sum() / (np.abs(parts).sum() + 1e-300))


def weigh_robustly(runs: Sequence[Run], progress: Progress) -> list[Run]:
    """Weigh samples so that outliers count linearly (Huber), by reweighted fits on a coarse grid."""
    progress("weighing outliers")
    stroke = max(_stroke(run) for run in runs)
    grid, hyper = grid_of(runs, LADDER[0]), Hyper.start()
    for _ in range(8):  # outliers have settled by then
        solution = solve_grid(gather(grid, runs), stroke, hyper)
        hyper = solution.hyper
        model = grid.surface(solution.columns * stroke)
        left = [run.displacement_um - simulate_run(model, run) for run in runs]
        runs = [replace(run, weight=huber_weight(one, run.fitted)) for run, one in zip(runs, left, strict=True)]
    return list(runs)
