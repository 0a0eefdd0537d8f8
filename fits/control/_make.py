"""What a closed loop is made of: a model and a reference made ready, and controllers of all kinds.

The PID controller is tuned, the others are made around it.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import microid as m
from fits.control._compensate import compensate
from fits.control._gains import PID_SETTINGS, Given, replaced
from fits.control._period import strongest_Hz
from fits.control._tune import parameter_values, tune_controller
from fits.control._tune_problem import Goal, Tuning
from fits.control._tune_start import relay_start, slope_array, steepest_slope
from fits.io._errors import DataError
from fits.io._record import Reference
from fits.loop._run import initial_state
from fits.stage._run import as_stage, place_of_hysteresis, range_of
from microid import control as ctl

Feedforward = Literal["none", "static", "dynamic"]
_FEWEST = 16


@dataclass(frozen=True)
class Setup:
    """What a loop needs beside its stage and controller, at rest where the reference begins; signals `(t,)`."""

    interval_s: float
    reference_um: np.ndarray
    feedforward_V: np.ndarray | None
    limits_V: tuple[float, float]
    start: m.Start
    static_V: np.ndarray  # would hold the stage at the reference
    remarks: tuple[str, ...]


def setup(
    model: m.Preisach | m.Stage,
    reference: Reference,
    feedforward: Feedforward = "static",
    *,
    initial: str = "negative",
    limits_V: tuple[float, float] | None = None,
) -> Setup:
    """Make a model and a reference ready for a closed loop, in which a hysteresis is a stage of one part.

    The feedforward is none, the inverse of the hysteresis alone, or that of the whole stage; limits are by default
    those of the model. A `DataError` says that the times are uneven or too few, that the stage cannot be stepped or
    inverted, or that the limits are not within the model's range.
    """
    stage = as_stage(model).with_hold("zero")
    interval = _interval_s(reference)
    try:
        sampled = ctl.SampledStage(stage, interval)
    except ValueError as error:
        raise DataError(f"the model cannot be stepped from sample to sample: {error}", of_model=True) from error
    wanted, remarks = np.asarray(reference.displacement_um), list[str]()
    place = place_of_hysteresis(stage)
    if place is None:
        memory, limits = None, (-np.inf, np.inf) if limits_V is None else limits_V
        gain, offset = float(stage.static_gain), float(sampled.init(m.Start(jnp.asarray(0.0)))[1])
        if not (np.isfinite(gain) and gain > 0):
            raise DataError(
                f"the stage gives {gain:g} um/V at rest, expected a positive one; turn the sign of a column",
                of_model=True,
            )
        static_V = ahead_V = (wanted - offset) / gain
        if feedforward == "dynamic":
            try:
                ahead_V = np.asarray(ctl.two_degrees(stage, interval, jnp.asarray(wanted)).feedforward_V)
            except ValueError as error:
                raise DataError(f"the model has no dynamic inverse: {error}", of_model=True) from error
        if feedforward != "none" and not np.array_equal(np.clip(ahead_V, *limits), ahead_V):
            remarks.append("the feedforward was cut to the limits")
        ahead_V = np.clip(ahead_V, *limits)
    else:
        law = stage.parts[place]
        if not isinstance(law, m.Preisach):
            raise DataError(
                f"{stage.names[place]!r} is a {type(law).__name__}, expected a Preisach hysteresis; fit one",
                of_model=True,
            )
        invert = partial(compensate, stage, reference, initial, clip=True, limits_V=limits_V)
        found = invert(way="static")
        static_V = ahead_V = found.voltage_V
        memory = initial_state(initial, float(law.density.lower_V), float(law.density.upper_V))
        limits = range_of(stage) if limits_V is None else limits_V
        if found.clipped.any():
            remarks.append(f"{int(found.clipped.sum())} samples of the reference are out of reach within the limits")
        if feedforward == "dynamic":
            if isinstance(model, m.Preisach) or len(stage.parts) == 1:
                raise DataError(
                    "expected a model with mechanics for a dynamic feedforward, found a hysteresis alone",
                    of_model=True,
                )
            led = invert(way="dynamic")
            ahead_V, remarks = led.voltage_V, [*remarks, *led.remarks]
    start = m.Start(jnp.asarray(float(ahead_V[0])), memory)
    fed_V = None if feedforward == "none" else ahead_V
    return Setup(interval, wanted, fed_V, limits, start, static_V, tuple(remarks))


def _interval_s(reference: Reference) -> float:
    if len(reference) < _FEWEST:
        raise DataError(
            f"{reference.source}: expected {_FEWEST} samples or more, found {len(reference)}; sample it more finely"
        )
    steps = np.diff(reference.time_s)
    interval = float(steps.mean())
    worst = int(np.argmax(np.abs(steps - interval)))
    if abs(steps[worst] - interval) > 1e-3 * interval:
        raise DataError(
            f"{reference.source}: expected even times, as of a controller, found a step of {steps[worst]:.6g} s "
            f"at sample {worst + 2} where the mean is {interval:.6g} s; resample the reference"
        )
    return interval


def own_settings(controller: type[ctl.AbstractController]) -> list[ctl.Setting]:
    """Settings of a controller beside the fields of its PID controller."""
    return [setting for setting in ctl.settings_of(controller) if setting.name not in PID_SETTINGS]


def with_defaults(
    settings: Collection[ctl.Setting],
    stated: Mapping[str, Any],
    task: ctl.ControlTask,
    place: Callable[[str], str],
) -> tuple[dict[str, Any], list[str]]:
    """Settings as stated, or else their defaults, with what is to be said of these; `place` names one to the user."""
    found: dict[str, Any] = {}
    said = []
    for setting in settings:
        name, default = setting.name, setting.default
        if name in stated:
            found[name] = stated[name]
        elif default is not None:
            try:
                found[name] = default(task) if callable(default) else default
            except DataError as error:
                raise DataError(f"{place(name)}: no default is found ({error}); state it.") from error
            except ValueError as error:
                raise DataError(f"{place(name)}: {error}; state it.") from error
            if setting.said:
                said.append(setting.said.format(found[name]))
    return found, said


@dataclass(frozen=True)
class Loop:
    """What stays the same while controllers change: plants, noise, and `skip`, how many samples do not count."""

    ready: Setup
    plants: list[m.Stage]
    noise_um: float
    delay: int
    resolution_um: float | None
    skip: int

    def run(
        self,
        controller: ctl.AbstractController,
        noise_um: np.ndarray | None,
        resolution_V: float | None,
        plant: m.Stage,
    ) -> ctl.ControlledRun:
        return ctl.simulate_loop(
            controller,
            plant,
            jnp.asarray(self.ready.reference_um),
            feedforward_V=None if self.ready.feedforward_V is None else jnp.asarray(self.ready.feedforward_V),
            noise_um=None if noise_um is None else jnp.asarray(noise_um),
            delay=self.delay,
            resolution_um=self.resolution_um,
            resolution_V=resolution_V,
            limits_V=self.ready.limits_V,
            start=self.ready.start,
        )

    def margins(self, controller: ctl.AbstractController) -> list[ctl.Margins]:
        """Margins of every plant, at the steepest slope of its hysteresis."""
        return [
            ctl.margins(controller.linear(), one, delay=self.delay, slope_um_per_V=slope_array(one))
            for one in self.plants
        ]


@dataclass(frozen=True)
class Made:
    """A controller, the PID controller that it is or was made around, and the tuning if no gains were given."""

    controller: ctl.AbstractController
    pid: ctl.PID
    tuning: Tuning[Any] | None
    remarks: list[str]


@dataclass(frozen=True)
class Maker:
    """Makes controllers for a loop; see `tune_controller`. The noise they are tuned under has the shape `(t,)`."""

    loop: Loop
    goal: Goal
    starts: int
    seed: int
    noise_um: np.ndarray | None
    progress: Callable[[str], None]

    def make(self, name: str, given: Given | None, frequency_Hz: Sequence[float]) -> Made:
        """Make a controller by its kind, tuned if no gains are given; frequencies are those of resonators."""
        loop, kind = self.loop, ctl.CONTROLLERS[name]
        tuning: Tuning[Any] | None = None
        if given is None:
            self.progress("start by Ziegler and Nichols")
            pid = relay_start(loop.plants, loop.ready.interval_s, delay=loop.delay)
        else:
            fields = {**given.pid, "interval_s": loop.ready.interval_s}
            pid = ctl.PID(**{field: jnp.asarray(value) for field, value in fields.items()})
        limits_V = tuple(jnp.asarray(limit) for limit in loop.ready.limits_V)
        pid = eqx.tree_at(lambda pid: (pid.lower_V, pid.upper_V), pid, limits_V)
        if given is None:
            tuning = self._tuned(pid)
            pid = tuning.controller
        remarks = [] if tuning is None else list(tuning.remarks)
        if kind is ctl.PID:
            return Made(pid, pid, tuning, remarks)
        own, said = self._stated(kind, given, frequency_Hz)
        if kind.learns:
            which = "margins are" if tuning is None else "what was tuned, and margins, are"
            said.append(f"{which} those of its PID controller, before it learns")

        def place(setting: str) -> str:
            return "frequency" if setting == "frequency_Hz" else f"controller {name}: {setting}"

        ready, stage = loop.ready, loop.plants[0]
        task = ctl.ControlTask(
            stage,
            ready.interval_s,
            lambda: ready.reference_um,
            lambda: ready.static_V,
            lambda: steepest_slope(stage),
            lambda: strongest_Hz(ready.reference_um, ready.interval_s),
        )
        numbers, more = with_defaults(own_settings(kind), {"seed": self.seed} | own, task, place)
        if "frequency_Hz" in numbers:
            self._check_frequencies(np.atleast_1d(numbers["frequency_Hz"]))
        try:
            made = kind.of(pid, numbers, ctl.ControlledPlant(stage, slope_array(stage), loop.delay))
        except ValueError as error:
            raise DataError(f"{name}: {error}; choose pid.") from error
        if given is not None or kind.learns:
            return Made(replaced(made, own), pid, tuning, [*remarks, *said, *more])
        tuning = self._tuned(self._with_margin(made))
        # The PID controller within is tuned anew: what was said of it alone no longer holds.
        return Made(tuning.controller, pid, tuning, [*said, *more, *tuning.remarks])

    def _tuned(self, controller: Any) -> Tuning[Any]:
        ready = self.loop.ready
        return tune_controller(
            controller,
            self.loop.plants,
            ready.reference_um,
            goal=self.goal,
            feedforward_V=ready.feedforward_V,
            noise_um=self.noise_um,
            delay=self.loop.delay,
            resolution_um=self.loop.resolution_um,
            start=ready.start,
            skip=self.loop.skip,
            starts=self.starts,
            seed=self.seed,
            progress=self.progress,
        )

    def _with_margin(self, controller: Any) -> Any:
        """Halve a controller's own gains until the loop is stable with some margin, so that it can be tuned."""
        for _ in range(20):
            every = self.loop.margins(controller)
            if all(bool(one.stable) and float(one.sensitivity_peak) < 4 for one in every):
                break
            values = parameter_values(controller)
            controller = replaced(controller, {name: values[name] / 2 for name in controller.own if name in values})
        return controller

    def _stated(
        self, kind: type[ctl.AbstractController], given: Given | None, frequency_Hz: Sequence[float]
    ) -> tuple[dict[str, np.ndarray], list[str]]:
        """Parameters that are given beside those of the PID controller, by path, and remarks on them."""
        own = {} if given is None else {name: x for name, x in given.others.items() if name in kind.own}
        several = [setting.name for setting in own_settings(kind) if setting.several]
        found = {name: np.atleast_1d(own[name]) for name in several if name in own}
        shapes = {value.shape for value in found.values()}
        if found and (len(found) < len(several) or len(shapes) > 1 or len(shapes.pop()) != 1):
            raise DataError(f"gains: expected {', '.join(several)} with as many numbers each; state all or none.")
        if not frequency_Hz:
            return own | found, []
        wanted = np.asarray(frequency_Hz)
        if found and np.array_equal(np.sort(found["frequency_Hz"]), np.sort(wanted)):
            return own | found, []
        kept = {name: x for name, x in own.items() if name not in several} | {"frequency_Hz": wanted}
        anew = "the resonators of the gains are at other frequencies than those stated, and made anew"
        return kept, [anew] if found else []

    def _check_frequencies(self, frequency_Hz: np.ndarray) -> None:
        highest = 0.5 / self.loop.ready.interval_s
        bad = frequency_Hz[~((frequency_Hz > 0) & (frequency_Hz < highest))]
        if len(bad):
            raise DataError(f"frequency: expected one between 0 and {highest:g} Hz, found {bad[0]:g} Hz.")
        near = np.sort(frequency_Hz)
        # Resonators that are nearer to each other fight.
        if np.any(np.diff(near) <= 1e-3 * near[1:]):
            raise DataError("frequency: expected frequencies that differ, found two alike; state each once.")
