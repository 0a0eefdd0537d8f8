"""The virtual bench: a scenario in, records out, all in memory."""

import secrets
from dataclasses import dataclass, replace

import numpy as np

from data_synth._effect import REGISTRY, Situation
from data_synth._engine import AFTER, Acting, Player, refinement
from data_synth._environment import Room
from data_synth._errors import ScenarioError
from data_synth._history import initial_history
from data_synth._plant import Plant
from data_synth._rig import Rig
from data_synth._scenario import Scenario
from data_synth._strength import HiddenEffect, Strength
from data_synth._types import FloatArray, Hysteresis

_PAUSE_S = 30.0
"""Between the end of a run and the start of the next."""

# Samples of a run whose stage hides something: each is simulated in 16 steps or more.
_MOST_FINE = 500_000

# Streams of chance that runs without effects know nothing of, each after the seed.
_ROOM, _OTHER, _EFFECTS, _COLUMNS = 101, 102, 103, 104


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
    temperature_C, other_um
        What was measured besides, each of shape (n,): the temperature (degrees Celsius) and the displacement of a
        second axis (um); None where it was not.
    """

    name: str
    time_s: FloatArray
    voltage_V: FloatArray
    displacement_um: FloatArray
    true_displacement_um: FloatArray
    history_V: FloatArray
    temperature_C: FloatArray | None = None
    other_um: FloatArray | None = None

    def columns(self) -> dict[str, FloatArray]:
        """What goes into the CSV: the columns by their names, which end in their units, each of shape (n,)."""
        columns = {name: getattr(self, name) for name in ("time_s", "voltage_V", "displacement_um")}
        for name in ("temperature_C", "other_um"):
            if getattr(self, name) is not None:
                columns[name] = getattr(self, name)
        return columns


@dataclass(frozen=True, eq=False)
class Bench:
    """A simulated scenario: its records, the rig and plant they were measured on, and the seed that gives them again.

    Attributes
    ----------
    scenario, seed
        What was simulated, and from where its randomness starts.
    rig, plant
        The stage; the plant is None where the scenario says nothing of dynamics.
    records
        The runs as they were measured.
    effects
        The truth about what the stage hides.
    """

    scenario: Scenario
    seed: int
    rig: Rig
    records: tuple[Record, ...]
    plant: Plant | None = None
    effects: tuple[HiddenEffect, ...] = ()

    def record(self, name: str) -> Record:
        """The run of a name. Raises KeyError if there is none."""
        return {record.name: record for record in self.records}[name]

    def play(
        self, time_s: FloatArray, voltage_V: FloatArray, rng: np.random.Generator, name: str = "again"
    ) -> Record:
        """Measure one more run on the same stage, with the same effects and fresh noise.

        It is played after all runs of the scenario, with the same memory before it as they have: a full sweep to the
        lower voltage, and straight from there to the run's first voltage.

        Parameters
        ----------
        time_s, voltage_V
            The command, both of shape (n,), in s and V. The times are even.
        rng
            Source of the noise, and of what is random in the effects.
        name
            Name of the record.

        Raises
        ------
        ScenarioError
            If the times are not even or too far apart for the mass, or a voltage is out of the rig's range.
        """
        time_s, voltage_V = np.asarray(time_s, dtype=float), np.asarray(voltage_V, dtype=float)
        if time_s.ndim != 1 or time_s.shape != voltage_V.shape or len(time_s) < 2:
            raise ScenarioError(
                f"time_s and voltage_V must be two columns of the same length of two or more, got shapes "
                f"{time_s.shape} and {voltage_V.shape}"
            )
        sample_rate_Hz = (len(time_s) - 1) / float(time_s[-1] - time_s[0])
        even_s = time_s[0] + np.arange(len(time_s)) / sample_rate_Hz
        if not (sample_rate_Hz > 0 and np.abs(time_s - even_s).max() < 1e-3 / sample_rate_Hz):
            raise ScenarioError("time_s must rise in even steps")
        rig = self.rig
        _require_samples(self.scenario.file, self.plant, name, sample_rate_Hz)
        if not (rig.lower_V <= voltage_V.min() and voltage_V.max() <= rig.upper_V):
            raise ScenarioError(
                f"voltage_V must lie in {rig.lower_V:g} to {rig.upper_V:g} V, "
                f"got {voltage_V.min():g} to {voltage_V.max():g}"
            )
        history_V = np.array([rig.lower_V, rig.upper_V, rig.lower_V, float(voltage_V[0])])
        clock = _Clock()
        for past, run in zip(self.records, self.scenario.runs, strict=True):
            clock = clock.after(past.voltage_V, run.sample_rate_Hz)
        stage = _Stage(self.scenario, self.rig, self.plant, self.rig.hysteresis(), self.seed)
        seed = int(rng.integers(2**32))
        acting = [
            Acting(REGISTRY[effect.name], effect.parameters, (seed, _EFFECTS, k))
            for k, effect in enumerate(self.effects)
        ]
        played = _Played(name, sample_rate_Hz, voltage_V, history_V, len(self.records), clock, (seed,))
        fine = bool(acting) or self.scenario.fine_steps
        record = stage.measure(played, stage.player(played) if fine else None, acting, rng)
        return replace(record, time_s=time_s)


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
        If the seed is negative, the rig cannot have the loop width the scenario asks for, a run is sampled too
        slowly for the mass, or an effect cannot be on this stage.
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
    stage = _Stage(scenario, rig, plant, rig.hysteresis(), seed)
    runs: list[tuple[_Played, np.random.Generator]] = []
    clock = _Clock()
    for index, (run, rng) in enumerate(zip(scenario.runs, run_rngs, strict=True)):
        _require_samples(scenario.file, plant, run.name, run.sample_rate_Hz)
        history_rng, program_rng, sensor_rng = rng.spawn(3)
        history_V = initial_history(run.initial, rig.lower_V, rig.upper_V, history_rng)
        if run.start_V is not None:
            history_V = np.append(history_V, run.start_V)
        voltage_V = run.voltage_V(float(history_V[-1]), rig.lower_V, rig.upper_V, program_rng)
        # The driver's last digit is 1 uV: the CSV stays short, and the stage is driven by just what the CSV says.
        voltage_V = np.clip(np.round(voltage_V, 6), rig.lower_V, rig.upper_V)
        played = _Played(run.name, run.sample_rate_Hz, voltage_V, history_V, index, clock, (seed,))
        runs.append((played, sensor_rng))
        clock = clock.after(voltage_V, run.sample_rate_Hz)
    fine = scenario.fine_steps or bool(scenario.effects)
    players = {played.name: stage.player(played) for played, _ in runs} if fine else {}
    acting, truths = _hide(scenario, stage, players) if scenario.effects else ([], ())
    records = tuple(
        stage.measure(played, players.get(played.name), acting, sensor_rng) for played, sensor_rng in runs
    )
    return Bench(scenario, seed, rig, records, plant, tuple(truths))


def _require_samples(file: str, plant: Plant | None, name: str, sample_rate_Hz: float) -> None:
    try:
        (plant or Plant()).require_samples(sample_rate_Hz)
    except ValueError as error:
        raise ScenarioError(f"{file}: run {name}: {error}") from error


def _hide(scenario: Scenario, stage: "_Stage", players: dict[str, Player]) -> tuple[list[Acting], list[HiddenEffect]]:
    where = [f"{scenario.file}: effects[{k}]" for k in range(len(scenario.effects))]
    for place, settings in zip(where, scenario.effects, strict=True):
        REGISTRY[settings.name].require(stage.plant, place)
        if REGISTRY[settings.name].needs == "other_axis" and scenario.other_axis is None:
            raise ScenarioError(f"{place}: {settings.name} needs a second axis: state the table [other_axis]")
    # What is held out says nothing of how strong an effect is: nobody estimates from it.
    counted = [name for name in players if not name.startswith("heldout")] or list(players)
    strength = Strength(players, counted, scenario.sensor.noise_um)
    acting, truths = [], []
    for k, (place, settings) in enumerate(zip(where, scenario.effects, strict=True)):
        one, truth = strength.set(settings, (stage.seed, _EFFECTS, k), place)
        acting.append(one)
        truths.append(truth)
    return acting, truths


@dataclass(frozen=True)
class _Clock:
    """Time (s) and path of the voltage (V) since the first run began."""

    time_s: float = 0.0
    path_V: float = 0.0

    def after(self, voltage_V: FloatArray, sample_rate_Hz: float) -> "_Clock":
        return _Clock(
            self.time_s + len(voltage_V) / sample_rate_Hz + _PAUSE_S,
            self.path_V + float(np.abs(np.diff(voltage_V)).sum()),
        )


@dataclass(frozen=True, eq=False)
class _Played:
    """What is played in one run."""

    name: str
    sample_rate_Hz: float
    voltage_V: FloatArray
    history_V: FloatArray
    index: int
    clock: _Clock
    seed: tuple[int, ...]


class _Stage:
    """A stage on the bench with what is around it."""

    def __init__(self, scenario: Scenario, rig: Rig, plant: Plant | None, hysteresis: Hysteresis, seed: int) -> None:
        self.scenario, self.rig, self.plant, self.seed = scenario, rig, plant, seed
        self._hysteresis = hysteresis
        self._room: Room | None = None
        if scenario.temperature is not None:
            self._room = scenario.temperature.draw(np.random.default_rng((seed, _ROOM)))

    def player(self, played: _Played) -> Player:
        """The run on a fine grid."""
        plant = self.plant or Plant()
        samples = len(played.voltage_V)
        if samples > _MOST_FINE:
            raise ScenarioError(
                f"{self.scenario.file}: run {played.name} takes {samples:,} samples, and in fine steps at most "
                f"{_MOST_FINE:,} are simulated: shorten it, or sample slower"
            )
        steps = refinement(plant, played.sample_rate_Hz, samples)
        time_s = np.arange((samples + AFTER - 1) * steps + 1) / (played.sample_rate_Hz * steps)
        situation = Situation(
            rig=self.rig,
            plant=plant,
            index=played.index,
            sample_rate_Hz=played.sample_rate_Hz,
            samples=samples,
            refinement=steps,
            time_s=time_s,
            start_s=played.clock.time_s,
            path_before_V=played.clock.path_V,
            temperature_K=None if self._room is None else self._room.above_mean_K(played.clock.time_s + time_s),
            other_um=self._other_um(played, time_s),
        )
        return Player(played.voltage_V, played.history_V, situation, self._hysteresis)

    def measure(
        self, played: _Played, player: Player | None, acting: list[Acting], rng: np.random.Generator
    ) -> Record:
        """Measure a run: through its player, or in closed form where it is None."""
        time_s = np.arange(len(played.voltage_V)) / played.sample_rate_Hz
        if player is not None:
            reading_um, true_displacement_um = player.respond(acting)
            displacement_um = player.read(self.scenario.sensor.read(reading_um, rng), acting)
        else:
            true_displacement_um = self._plainly(played)
            displacement_um = self.scenario.sensor.read(true_displacement_um, rng)
        columns_rng = np.random.default_rng((*played.seed, _COLUMNS, played.index))
        temperature_C = other_um = None
        if self._room is not None and self._room.settings.column:
            temperature_C = self._room.read_C(played.clock.time_s + time_s, columns_rng)
        if not (np.isfinite(displacement_um).all() and np.isfinite(true_displacement_um).all()):
            raise ScenarioError(
                f"{self.scenario.file}: run {played.name}: the displacement is not finite; some number of the "
                "scenario is too large"
            )
        axis, true_other_um = self.scenario.other_axis, self._other_um(played, time_s)
        if axis is not None and axis.column and true_other_um is not None:
            other_um = axis.read_um(true_other_um, columns_rng)
        return Record(
            name=played.name,
            time_s=np.round(time_s, 9),
            voltage_V=played.voltage_V,
            displacement_um=displacement_um,
            true_displacement_um=true_displacement_um,
            history_V=played.history_V,
            temperature_C=temperature_C,
            other_um=other_um,
        )

    def _other_um(self, played: _Played, time_s: FloatArray) -> FloatArray | None:
        axis = self.scenario.other_axis
        if axis is None:
            return None
        rng = np.random.default_rng((*played.seed, _OTHER, played.index))
        return axis.displacement_um(time_s, len(played.voltage_V) / played.sample_rate_Hz, rng)

    def _plainly(self, played: _Played) -> FloatArray:
        rig, hysteresis = self.rig, self._hysteresis
        if self.plant is None:
            hysteresis.play(played.history_V)
            return rig.reversible(played.voltage_V) + hysteresis.play(played.voltage_V)
        for turn_V in played.history_V:
            hysteresis.glide(np.array([turn_V]))
        return self.plant.respond(
            played.voltage_V,
            played.sample_rate_Hz,
            lambda path_V: rig.reversible(path_V) + hysteresis.glide(path_V),
        )
