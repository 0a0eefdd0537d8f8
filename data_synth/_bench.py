"""The virtual bench: a scenario in, records out, all in memory."""

import secrets
from dataclasses import dataclass

import numpy as np

from data_synth._errors import ScenarioError
from data_synth._history import initial_history
from data_synth._plant import Plant
from data_synth._rig import Rig
from data_synth._scenario import Run, Scenario
from data_synth._types import FloatArray, Hysteresis


@dataclass(frozen=True, eq=False)
class Record:
    """One run as it was measured, and the truth behind it.

    Attributes
    ----------
    name
        Name of the run.
    time_s, voltage_V, displacement_um
        What goes into the CSV: time (s), voltage (V) and the sensor's reading (um), each of shape (n,).
    true_displacement_um
        The displacement itself, without the sensor's noise, last digit and offset, shape (n,), in um.
    history_V
        Turning points of the voltage before the record, shape (k,), in V.
    """

    name: str
    time_s: FloatArray
    voltage_V: FloatArray
    displacement_um: FloatArray
    true_displacement_um: FloatArray
    history_V: FloatArray


@dataclass(frozen=True, eq=False)
class Bench:
    """A simulated scenario: its records, the rig and plant they were measured on, and the seed that gives them again.

    `plant` is None where the scenario says nothing of dynamics.
    """

    scenario: Scenario
    seed: int
    rig: Rig
    records: tuple[Record, ...]
    plant: Plant | None = None


def simulate(scenario: Scenario, seed: int | None = None) -> Bench:
    """Measure every run of a scenario.

    The runs share one rig; each starts from its own initial state.

    Parameters
    ----------
    scenario
        What to measure.
    seed
        Where all randomness starts. If None, the scenario's; if that is None too, a fresh one.

    Raises
    ------
    ScenarioError
        If the seed is negative, or the rig cannot have the loop width the scenario asks for.
    """
    if seed is None:
        seed = secrets.randbelow(2**32) if scenario.seed is None else scenario.seed
    if seed < 0:
        raise ScenarioError(f"the seed must be zero or positive, got {seed}")
    # A generator each, so that one more run, or one more draw within a run, changes nothing elsewhere.
    rig_rng, *run_rngs = np.random.default_rng(seed).spawn(1 + len(scenario.runs))
    try:
        rig = scenario.rig.draw(rig_rng)
    except ValueError as error:
        raise ScenarioError(f"{scenario.file}: rig: {error}") from error
    # A child of the rig's generator: dynamics change nothing else, and neither do more runs change the dynamics.
    plant = None if scenario.plant is None else scenario.plant.draw(rig_rng.spawn(1)[0])
    hysteresis = rig.hysteresis()
    records = tuple(
        _measure(run, rig, plant, hysteresis, scenario, rng) for run, rng in zip(scenario.runs, run_rngs, strict=True)
    )
    return Bench(scenario, seed, rig, records, plant)


def _measure(
    run: Run, rig: Rig, plant: Plant | None, hysteresis: Hysteresis, scenario: Scenario, rng: np.random.Generator
) -> Record:
    history_rng, program_rng, sensor_rng = rng.spawn(3)
    history_V = initial_history(run.initial, rig.lower_V, rig.upper_V, history_rng)
    voltage_V = run.voltage_V(float(history_V[-1]), rig.lower_V, rig.upper_V, program_rng)
    # The driver's last digit is 1 uV: the CSV stays short, and the stage is driven by just what the CSV says.
    voltage_V = np.clip(np.round(voltage_V, 6), rig.lower_V, rig.upper_V)
    hysteresis.play(history_V)
    if plant is None:
        true_displacement_um = rig.reversible(voltage_V) + hysteresis.play(voltage_V)
    else:
        true_displacement_um = plant.respond(
            voltage_V, run.sample_rate_Hz, lambda path_V: rig.reversible(path_V) + hysteresis.glide(path_V)
        )
    return Record(
        name=run.name,
        time_s=np.round(np.arange(len(voltage_V)) / run.sample_rate_Hz, 9),
        voltage_V=voltage_V,
        displacement_um=scenario.sensor.read(true_displacement_um, sensor_rng),
        true_displacement_um=true_displacement_um,
        history_V=history_V,
    )
