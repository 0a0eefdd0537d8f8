"""A scenario is data: what stage stands on the bench, what is played to it, and what the sensor adds."""

import functools
import importlib.resources
import inspect
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from data_synth._environment import OtherAxisSettings, TemperatureSettings
from data_synth._errors import ScenarioError
from data_synth._plant import Hold, Plant, random_plant
from data_synth._programs import PROGRAMS
from data_synth._read_toml import parse_toml, read_text
from data_synth._rig import Kind, Rig, random_rig
from data_synth._sensor import Sensor
from data_synth._strength import EffectSettings
from data_synth._table import build, nearest, read_arguments
from data_synth._types import FloatArray, Initial

# Of a run, and of all runs together: a CSV of 1 GB; fewer of more plays, which take longer.
_MOST_SAMPLES, _USUAL_PLAYS = 10_000_000, 400
# No record of a stage is sampled more slowly or faster.
_RATES_Hz = (1e-3, 1e8)


def _require(holds: bool, sentence: str) -> None:
    if not holds:
        raise ValueError(sentence)


@dataclass(frozen=True)
class RigSettings:
    """The table `[rig]`. Shapes are always drawn from the seed; these are the numbers one may want to state.

    Attributes
    ----------
    random
        Whether `kind`, `stroke_um`, `reversible_share` and `loop_width` are drawn where they are not stated.
        Otherwise they are `"relays"`, 40 um, 0.65 and 0.13.
    kind
        Sort of hysteresis.
    lower_V, upper_V
        The range of the voltage, in V.
    stroke_um
        The displacement over the range, in um.
    reversible_share
        The part of the stroke that has no memory.
    loop_width
        The widest gap of the major loop over the stroke.
    relays
        The number of relays along one side of their grid.
    plays
        The number of play operators.
    roughness
        How irregular they are: 1 for radii and weights at random, 0 for those of a smooth curve.
    """

    random: bool = False
    kind: Kind | None = None
    lower_V: float = 0.0
    upper_V: float = 120.0
    stroke_um: float | None = None
    reversible_share: float | None = None
    loop_width: float | None = None
    relays: int = 2000
    plays: int = 400
    roughness: float = 1.0

    def __post_init__(self) -> None:
        """Raise ValueError for a rig that cannot be."""
        _require(
            -math.inf < self.lower_V < self.upper_V < math.inf,
            f"lower_V must be below upper_V, got {self.lower_V} and {self.upper_V}",
        )
        _require(
            self.stroke_um is None or 0 < self.stroke_um < math.inf,
            f"stroke_um must be positive, got {self.stroke_um}",
        )
        for name in ("reversible_share", "loop_width"):
            share = getattr(self, name)
            _require(share is None or 0 < share < 1, f"{name} must be between 0 and 1, got {share}")
        _require(2 <= self.relays <= 10_000, f"relays must be 2 to 10000, got {self.relays}")
        _require(20 <= self.plays <= 10_000, f"plays must be 20 to 10000, got {self.plays}")
        _require(0 <= self.roughness <= 1, f"roughness must be 0 to 1, got {self.roughness}")

    def draw(self, rng: np.random.Generator) -> Rig:
        """Draw the rig. Raises ValueError where no hysteresis has so wide a loop."""
        usual: dict[str, Any] = {"kind": "relays", "stroke_um": 40.0, "reversible_share": 0.65, "loop_width": 0.13}
        stated = {name: getattr(self, name) for name in usual}
        if not self.random:
            stated = {name: usual[name] if value is None else value for name, value in stated.items()}
        return random_rig(
            rng,
            **stated,
            lower_V=self.lower_V,
            upper_V=self.upper_V,
            relays=self.relays,
            plays=self.plays,
            roughness=self.roughness,
        )


@dataclass(frozen=True)
class PlantSettings:
    """The table `[plant]`. Without it the stage is quasi-static: it follows the voltage at once.

    Attributes
    ----------
    random
        Whether what is not stated is drawn. Otherwise it is not there: no driver, or no mass.
    time_constant_s
        Of the driver, in s.
    natural_frequency_Hz, damping_ratio
        Of the mass on its spring, in Hz and dimensionless.
    hold
        What the command does between two samples: a straight line (`first`), or nothing and a jump (`zero`).
    """

    random: bool = False
    time_constant_s: float | None = None
    natural_frequency_Hz: float | None = None
    damping_ratio: float | None = None
    hold: Hold = "first"

    def __post_init__(self) -> None:
        """Raise ValueError for a plant that cannot be."""
        plant = self.draw(np.random.default_rng(0))
        _require(
            plant.time_constant_s is not None or plant.natural_frequency_Hz is not None,
            "time_constant_s, or natural_frequency_Hz and damping_ratio, or random = true must be stated",
        )

    def draw(self, rng: np.random.Generator) -> Plant:
        """Draw the plant."""
        make = functools.partial(random_plant, rng) if self.random else Plant
        return make(
            time_constant_s=self.time_constant_s,
            natural_frequency_Hz=self.natural_frequency_Hz,
            damping_ratio=self.damping_ratio,
            hold=self.hold,
        )


@dataclass(frozen=True)
class Segment:
    """One table `[[runs.program]]`: a program by its `kind`, and its keyword arguments."""

    kind: str
    settings: Mapping[str, Any]

    @classmethod
    def from_table(cls, table: object, where: str) -> "Segment":
        """Read a table, whose keys are the program's arguments; the rig supplies a missing `lower_V` or `upper_V`."""
        if not isinstance(table, dict):
            raise ScenarioError(f"{where} must be a table, got {table!r}")
        settings = dict(table)
        kind = settings.pop("kind", None)
        if kind is None:
            raise ScenarioError(f"{where}: key 'kind' is missing")
        if not isinstance(kind, str) or kind not in PROGRAMS:
            raise ScenarioError(f"{where}: unknown kind {kind!r}, {nearest(str(kind), PROGRAMS)}")
        supplied, optional = ("start_V", "sample_rate_Hz", "rng"), ("lower_V", "upper_V")
        return cls(kind, read_arguments(PROGRAMS[kind], settings, where, supplied, optional))

    def voltage_V(
        self, start_V: float, sample_rate_Hz: float, lower_V: float, upper_V: float, rng: np.random.Generator
    ) -> FloatArray:
        """Sample the program, shape (n,), in V. Raises ValueError where a setting makes no sense to it."""
        program = PROGRAMS[self.kind]
        surroundings = {"sample_rate_Hz": sample_rate_Hz, "lower_V": lower_V, "upper_V": upper_V, "rng": rng}
        wanted = {name: surroundings[name] for name in inspect.signature(program).parameters if name in surroundings}
        voltage_V = program(start_V, **(wanted | dict(self.settings)))
        for extreme_V in (voltage_V.min(initial=start_V), voltage_V.max(initial=start_V)):
            _require(
                lower_V - 1e-9 <= extreme_V <= upper_V + 1e-9,
                f"the program reaches {extreme_V:.6g} V, outside of the rig's {lower_V:g} to {upper_V:g} V",
            )
        return voltage_V


@dataclass(frozen=True)
class Run:
    """One table `[[runs]]`: a record, which becomes one CSV.

    Attributes
    ----------
    name
        Name of the CSV, without the ending.
    sample_rate_Hz
        Samples per second, from 0.001 to 1e8.
    program
        What is played, one program after another.
    initial
        What the stage remembers at the start.
    start_V
        Where the record starts, in V, if it is not where `initial` ends: the voltage goes straight there from that.
    """

    name: str
    sample_rate_Hz: float
    program: tuple[Segment, ...]
    initial: Initial = "negative"
    start_V: float | None = None

    def __post_init__(self) -> None:
        """Raise ValueError for a run that cannot be played or written."""
        _require(
            re.fullmatch(r"[A-Za-z0-9_-]+", self.name) is not None,
            f"name must be made of letters, digits, '_' and '-', got {self.name!r}",
        )
        low_Hz, high_Hz = _RATES_Hz
        _require(
            low_Hz <= self.sample_rate_Hz <= high_Hz,
            f"sample_rate_Hz must lie in {low_Hz:g} to {high_Hz:g}, got {self.sample_rate_Hz}",
        )
        _require(len(self.program) > 0, "program must hold at least one table")

    def voltage_V(self, start_V: float, lower_V: float, upper_V: float, rng: np.random.Generator) -> FloatArray:
        """Sample the whole record, shape (n,), in V, from `start_V` on. Raises ValueError as the programs do."""
        pieces = [np.array([start_V])]
        for k, segment in enumerate(self.program):
            try:
                pieces.append(segment.voltage_V(float(pieces[-1][-1]), self.sample_rate_Hz, lower_V, upper_V, rng))
            except ValueError as error:
                raise ValueError(f"program[{k}] ({segment.kind}): {error}") from error
            if len(pieces[-1]) == 0:
                pieces.pop()
            _require(
                sum(map(len, pieces)) <= _MOST_SAMPLES,
                f"program[{k}]: the run takes more than {_MOST_SAMPLES:,} samples: shorten it, or sample slower",
            )
        return np.concatenate(pieces)


@dataclass(frozen=True)
class Scenario:
    """A whole scenario.

    Attributes
    ----------
    name, description
        What it is called and what it is for.
    rig
        The stage; all runs share it.
    runs
        The records.
    sensor
        What the sensor adds.
    plant
        Its dynamics; None for a quasi-static stage.
    effects
        What the stage hides.
    temperature, other_axis
        The room and a second axis; None where nobody looks at them.
    fine_steps
        Whether a stage that hides nothing goes through the fine-step chain too, as one does that hides something:
        otherwise it is solved in closed form.
    seed
        Where all randomness starts; a fresh one for each simulation if it is None.
    file
        Where the scenario was read, for messages.
    text
        The TOML as it was read.
    """

    name: str
    description: str
    rig: RigSettings
    runs: tuple[Run, ...]
    sensor: Sensor = field(default_factory=Sensor)
    plant: PlantSettings | None = None
    effects: tuple[EffectSettings, ...] = ()
    temperature: TemperatureSettings | None = None
    other_axis: OtherAxisSettings | None = None
    fine_steps: bool = False
    seed: int | None = None
    file: str = "scenario"
    text: str = ""

    def __post_init__(self) -> None:
        """Raise ValueError for runs that cannot be played."""
        _require(self.seed is None or self.seed >= 0, f"seed must be zero or positive, got {self.seed}")
        _require(len(self.runs) > 0, "runs must hold at least one table")
        hidden = [effect.name for effect in self.effects]
        for k, name in enumerate(hidden):
            _require(hidden.count(name) == 1, f"effects[{k}]: {name} stands twice")
        samples = 0
        names = [run.name.casefold() for run in self.runs]  # not every file system tells Train from train
        for k, run in enumerate(self.runs):
            _require(names.count(names[k]) == 1, f"runs[{k}]: name {run.name!r} is taken by another run")
            # Programs are tried once, so that a bad number is refused before anything is simulated.
            start_V = self.rig.lower_V if run.start_V is None else run.start_V
            _require(
                self.rig.lower_V <= start_V <= self.rig.upper_V,
                f"runs[{k}]: start_V must lie in {self.rig.lower_V:g} to {self.rig.upper_V:g} V, got {start_V:g}",
            )
            try:
                played_V = run.voltage_V(start_V, self.rig.lower_V, self.rig.upper_V, np.random.default_rng(0))
            except ValueError as error:
                raise ValueError(f"runs[{k}]: {error}") from error
            samples += len(played_V)
            most = _MOST_SAMPLES * _USUAL_PLAYS // max(_USUAL_PLAYS, self.rig.plays)
            _require(samples <= most, f"runs[{k}]: all runs take more than {most:,} samples")


def parse_scenario(text: str, file: str = "scenario") -> Scenario:
    """Read a scenario from TOML text.

    Parameters
    ----------
    text
        The TOML.
    file
        What to call it in messages.

    Raises
    ------
    ScenarioError
        For the first thing in it that is not as it should be.
    """
    scenario: Scenario = build(Scenario, parse_toml(text, file), file, file=file, text=text)
    return scenario


def scenario_names() -> list[str]:
    """Names of the scenarios that come with the package, in alphabetical order."""
    folder = importlib.resources.files("data_synth") / "scenarios"
    return sorted(Path(entry.name).stem for entry in folder.iterdir() if entry.name.endswith(".toml"))


def load_scenario(scenario: str) -> Scenario:
    """Read a scenario by the name it is shipped under, or from a file whose path ends in `.toml`.

    Raises
    ------
    ScenarioError
        If there is no such scenario, or as `parse_scenario` does.
    """
    if not scenario.endswith(".toml"):
        if scenario not in scenario_names():
            raise ScenarioError(f"no scenario is called '{scenario}': {nearest(scenario, scenario_names())}")
        shipped = importlib.resources.files("data_synth") / "scenarios" / f"{scenario}.toml"
        return parse_scenario(shipped.read_text(encoding="utf-8"), f"{scenario}.toml")
    return parse_scenario(read_text(scenario), scenario)
