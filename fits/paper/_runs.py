"""What `microid paper` does on the bench of `data_synth`: identification, feedforward, and all runs of its tables."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import data_synth
from data_synth import PaperBench
from fits.control._compensate import compensate
from fits.io._atomic import write_csv
from fits.io._read_csv import read_table
from fits.io._record import Record, Reference
from fits.loop._fit import fit
from fits.loop._result import FitResult
from fits.paper._gains import INTERVAL_s, PaperMode, paper_controller, shown_reference
from fits.stage._frequency import estimate_response, read_multisine
from fits.stage._modal_fit import fit_response
from microid import Preisach, positive_saturation
from microid.control import AbstractController

LEVELS = 23
# Loops are closed this long before a run begins, so that the noise they carry has found its level.
LEAD_s = 1.0
# What a table learns from before a tracking run: two periods and a rest each.
TRAINING_RUNS = 6
_STEP_s = 3.0


@dataclass(frozen=True, eq=False)
class PaperRun:
    """True displacement, reading, and the command held from there on, `(benches, n)`, for a reference, `(n,)`."""

    reference_um: np.ndarray
    displacement_um: np.ndarray
    reading_um: np.ndarray
    command_V: np.ndarray

    def last(self, samples: int) -> "PaperRun":
        runs = self.displacement_um, self.reading_um, self.command_V
        return PaperRun(self.reference_um[-samples:], *(values[:, -samples:] for values in runs))


@functools.cache
def _compiled(controllers: Any, states: Any) -> Callable[..., Any]:
    """One step of such controllers and states on bare arrays: modules take longer to take apart than a step takes."""

    @jax.jit
    def advance(held: Any, before: Any, signals: Any) -> tuple[Any, Any]:
        def one(held: Any, before: Any, signals: Any) -> tuple[Any, Any]:
            controller = jax.tree.unflatten(controllers, held)
            state, command = controller.step(jax.tree.unflatten(states, before), signals[0], signals[1], signals[2])
            return jax.tree.leaves(state), command

        return jax.vmap(one)(held, before, signals)

    return advance


def stacked(make: Callable[[int], AbstractController], count: int) -> AbstractController:
    """Controllers that differ in their numbers only, as one whose arrays have a first axis more."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(make(k) for k in range(count)))


def run_feedback(
    controllers: AbstractController,
    bench: PaperBench,
    reference_um: np.ndarray,
    feedforward_V: np.ndarray,
    shown_um: np.ndarray | None = None,
) -> PaperRun:
    """Run closed loops with `stacked` controllers side by side; what leads and what is shown are `(benches, n)`."""
    shown = np.broadcast_to(reference_um, feedforward_V.shape) if shown_um is None else shown_um
    states, form = jax.tree.flatten(eqx.filter_jit(eqx.filter_vmap(lambda one: one.init()))(controllers))
    held, kind = jax.tree.flatten(controllers)
    advance = _compiled(kind, form)
    now = bench.reset()
    visited, commands = [], []
    for wanted, lead in zip(shown.T, feedforward_V.T, strict=True):
        states, command = advance(held, states, np.stack([wanted, now[1], lead], axis=1))
        visited.append(now)
        commands.append(np.asarray(command))
        now = bench.step(commands[-1])
    displacement_um, reading_um = (np.stack(values, axis=1) for values in zip(*visited, strict=True))
    return PaperRun(reference_um, displacement_um, reading_um, np.stack(commands, axis=1))


@dataclass(frozen=True, eq=False)
class Identified:
    """What one noisy CSV taught: the piezo's hysteresis, fitted to the record."""

    fit: FitResult[Preisach]
    record: Record
    # What the piezo's sensor would read at the bias, by the fit.
    rest_um: float
    # The straight line of the open loop: stroke over range.
    slope_um_per_V: float

    def feedforward_V(self, axis: data_synth.PaperAxis, reference_um: np.ndarray) -> np.ndarray:
        """Voltage of the inverse hysteresis at the nominal amplification, shape `(n,)` as the reference has."""
        wanted_um = self.rest_um + np.append(0.0, reference_um) / axis.amplification
        time_s = np.arange(len(wanted_um), dtype=float) * INTERVAL_s
        found = compensate(self.fit.model, Reference(time_s, wanted_um, source="reference"), "positive", clip=True)
        return found.voltage_V[1:]


_at = eqx.filter_jit(lambda model, voltage_V, start: model(voltage_V, start))


def identify(piezo: data_synth.PaperPiezo, seeds: list[np.random.Generator], folder: Path) -> list[Identified]:
    """Measure the piezo once per generator, through a CSV, and fit its hysteresis."""
    found = []
    for rng in seeds:
        path = folder / "loops.csv"
        write_csv(path, data_synth.paper_loops(piezo, data_synth.PaperSensor(), rng))
        record = read_table(path)
        result = fit([record], levels=LEVELS, holdout=0.0, initial="negative")
        assert record.displacement_um is not None
        slope = float(np.ptp(record.displacement_um) / np.ptp(record.voltage_V))
        saturated = positive_saturation(result.model.density.lower_V, result.model.density.upper_V)
        rest = _at(result.model, jnp.asarray([data_synth.PAPER_BIAS_V]), saturated)
        found.append(Identified(result, record, float(rest[0]), slope))
    return found


def identify_modes(
    axis: data_synth.PaperAxis, piezo: data_synth.PaperPiezo, count: int, rng: np.random.Generator, folder: Path
) -> list[PaperMode]:
    """Measure the response of an axis `count` times, through a CSV, and fit its mode."""
    found = []
    for columns in data_synth.paper_responses(axis, piezo, data_synth.PaperSensor(), count, rng):
        path = folder / "response.csv"
        write_csv(path, columns)
        modes = fit_response(estimate_response(read_multisine(path)), modes=1).model
        omega = 2 * np.pi * float(modes.natural_frequency_Hz[0])
        gain = float(modes.static_gain_um_per_V[0, 0])
        found.append(PaperMode(omega, float(modes.damping_ratio[0]), gain))
    return found


@dataclass(frozen=True, eq=False)
class PaperStand:
    """One axis on the bench, with everything that was identified for it by seed."""

    axis: data_synth.PaperAxis
    piezo: data_synth.PaperPiezo
    identified: list[Identified]
    modes: list[PaperMode]

    def bench(self, rng: np.random.Generator | None) -> data_synth.PaperBench:
        """A bench per seed; without a generator, with an ideal sensor."""
        return data_synth.PaperBench(
            self.axis, self.piezo, rng=rng, benches=len(self.identified), interval_s=INTERVAL_s
        )

    def feedforward_V(self, reference_um: np.ndarray) -> np.ndarray:
        """Voltages of the inverse hysteresis, shape `(seeds, n)`."""
        return np.stack([one.feedforward_V(self.axis, reference_um) for one in self.identified])

    def track(self, scheme: str, rng: np.random.Generator) -> PaperRun:
        """The tracking run of Tables 3 and 4."""
        reference_um = data_synth.paper_reference_um(self.axis, INTERVAL_s)
        bench = self.bench(rng)
        if scheme == "OPEN":
            slopes_um_per_V = np.array([[one.slope_um_per_V] for one in self.identified])
            command_V = data_synth.PAPER_BIAS_V + reference_um / self.axis.amplification / slopes_um_per_V
            return PaperRun(reference_um, *bench.run(command_V), command_V)
        lead_V = self.feedforward_V(reference_um)
        if scheme == "HC":
            return PaperRun(reference_um, *bench.run(lead_V), lead_V)
        # At the bias loops close where they begin, so that every period asks for the same voltages.
        begin = round(self.axis.rest_s / INTERVAL_s)
        period = np.arange(begin, begin + round(data_synth.PAPER_PERIOD_s / INTERVAL_s))
        rest = np.zeros(round(LEAD_s / INTERVAL_s), dtype=int)
        training = [period, period, rest] * TRAINING_RUNS if scheme == "HC+CMAC-PID" else []
        order = np.concatenate([rest, *training, np.arange(len(reference_um))])
        controllers = stacked(
            lambda k: paper_controller(scheme, self.modes[k], k, data_synth.PAPER_SWING_um, False), len(self.modes)
        )
        run = run_feedback(controllers, bench, reference_um[order], lead_V[:, order])
        return run.last(len(reference_um))

    def step(self, scheme: str, rng: np.random.Generator | None) -> PaperRun:
        """The step of Table 2, which begins with the first sample."""
        target_um = data_synth.PAPER_STEP_um
        samples, rest = round(_STEP_s / INTERVAL_s), round(LEAD_s / INTERVAL_s)
        reference_um = np.concatenate([np.zeros(rest), np.full(samples, target_um)])
        bench, lead_V = self.bench(rng), self.feedforward_V(reference_um)
        if scheme == "HC":
            return PaperRun(reference_um, *bench.run(lead_V), lead_V).last(samples)
        controllers = stacked(lambda k: paper_controller(scheme, self.modes[k], k, target_um, True), len(self.modes))
        shown = np.stack([shown_reference(scheme, mode, reference_um) for mode in self.modes])
        return run_feedback(controllers, bench, reference_um, lead_V, shown).last(samples)


def compensated(one: Identified, piezo: data_synth.PaperPiezo) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A slow loop of the piezo under its inverse, for Fig. 9: wanted um, voltage and reached um, of shape `(n,)`."""
    model = one.fit.model
    lowest_um = float(model.offset_um)
    ramp_um = np.linspace(lowest_um, lowest_um + piezo.stroke_um, 1501)
    wanted_um = np.concatenate([ramp_um, ramp_um[-2::-1]])
    reference = Reference(np.arange(len(wanted_um), dtype=float) * 0.02, wanted_um, source="reference")
    voltage_V = compensate(model, reference, "negative", clip=True).voltage_V
    reached, states = [], piezo.radii_V
    for value in voltage_V.tolist():
        elongation_um, states = piezo.glide(np.array([value]), states)
        reached.append(float(elongation_um[0]))
    return wanted_um - lowest_um, voltage_V, np.array(reached)
