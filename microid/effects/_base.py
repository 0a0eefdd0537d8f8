"""What a physical effect is to the rest of the package: one more part of a stage, and what is known of it."""

import abc
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._linear import Times
from microid._part import AbstractHysteresis, AbstractPart, Signal, innermost
from microid._plant import Driver, Lag, Mechanics
from microid._stage import Stage

Place = Literal["driver", "hysteresis", "mechanics", "environment", "sensor", "time", "noise"]
"""Where an effect acts: ahead of, in or behind a part of the stage, on the time stamps, or on the noise."""
PLACES: tuple[Place, ...] = ("driver", "hysteresis", "mechanics", "environment", "sensor", "time", "noise")
"""All places, in the order of the signal."""
View = Literal["voltage", "position", "velocity", "frequency", "time", "since_move"]
"""What a residual is drawn against: the last is the time since the voltage last started, stopped or turned."""
# What would tell faults of the clocks apart, in the words of a report.
_TIME_STAMPS = "raw time stamps of both clocks, which show a lost sample or a wrong rate at once."
Statistic = Literal["", "spikes", "repeats", "rounding", "jitter", "band"]
"""What is measured of single samples and of the noise to find an effect; empty for one that moves the stage."""


@dataclass(frozen=True)
class Scales:
    """How large things are in the records at hand, from which an effect chooses where to be probed.

    Attributes
    ----------
    lower_V, upper_V
        Range of the command.
    fastest_V_per_s
        Largest rate of the command.
    stroke_um, middle_um
        Range of the displacement of the plain stage, and its middle.
    interval_s
        Shortest time between two samples.
    duration_s
        Duration of the longest record.
    shortest_s
        Duration of the shortest, which shows the dynamics if any does.
    noise_um
        What the plain stage leaves, standard deviation.
    resonance_Hz
        Of the plain stage; None without dynamics.
    columns
        Mean and range of each further column by name, such as `temperature_degC`.
    period_um
        With which the residual repeats itself in the position; None where it does not.
    """

    lower_V: float
    upper_V: float
    fastest_V_per_s: float
    stroke_um: float
    middle_um: float
    interval_s: float
    duration_s: float
    shortest_s: float
    noise_um: float
    resonance_Hz: float | None = None
    columns: tuple[tuple[str, float, float], ...] = ()
    period_um: float | None = None


class AbstractEffect(AbstractPart):
    """One physical effect: a part of a stage that does nothing where its strength is zero.

    To add an effect, put one file with one final, registered subclass into `microid/effects/`. Its class variables
    are all that the diagnosis and its report know of it; several forms of one effect agree in those from `view` on.

    Attributes
    ----------
    name
        Name of the effect, that of its file.
    title
        The name in words, where those are not the name without underscores.
    form
        Which of several models of that effect this is; empty where there is one.
    place
        Where in the chain it acts, one of `PLACES`.
    strength
        Names of the fields that are zero where there is no effect; all else says what it would be like.
    needs
        Columns beside time, command and displacement without which there is nothing to see.
    unless
        Columns with which another form of it says what this one guesses.
    history
        Names of the fields that say what went on in it before each record; they are zero after a long rest.
    ages
        Names of the given fields that say how long before a record that was, and the part of its duration that stands
        for it where nothing is known.
    moved
        Unit of what may have moved before a record, `um`, `V` or `K`: no more goes on of it than the strength times
        its range. Empty where the history is that itself.
    fast
        Whether it is only seen in records that show the dynamics.
    per_run
        Whether it differs from record to record, as a drift does.
    past
        Whether it is what the hysteresis remembers from before a record: no cause where that is estimated.
    finite
        Whether it must be tried at its full size, because at zero it has no derivative, or none that says much.
    repeats
        Whether there may be several of them in a record.
    counted
        Names of the fields that are whole sampling intervals.
    extremes
        Names of the fields at whose upper bound it is nothing of its kind any more, as a mode without a peak is none.
    lines_Hz, tolerance
        Frequencies of the lines whose amplitudes are the entries of its strengths, and the part by which those may be
        off: samples may turn a line into a drift.
    phases
        Names of two strengths that are cosines and sines, of these lines if any, of which amplitudes are shown. Empty
        for an effect that is shown by its strengths.
    fingerprint
        What it leaves in the residual of the plain stage, one sentence.
    confusions
        Names of the effects that it is mistaken for.
    experiment
        What tells it from those, one sentence.
    source
        Where the model comes from.
    view
        What the residual is drawn against in a report, so that the effect shows best.
    column
        A further column that would tell it from others: one of those in `fits/io/columns/`, such as
        `temperature_degC`, or a sentence that names another. Empty for none.
    statistic
        For a fault of single samples or of the noise, which no model holds: what is measured of it. Empty for an
        effect that changes the mean.
    independent
        Whether it goes on whatever the command does, and looks like nothing that depends on the command.
    flexible
        Whether its shape bends to what models of other effects leave, so that beside them it takes much evidence.
    universal
        Whether every piezo has it: where records cannot tell it from others, it is named first.
    held
        The strength that the voltage shows while a controller holds the displacement; empty where it shows none.
    delay
        For a pure delay of the readings, the strength that is its time in s, as steps of a held command resemble one;
        empty for all others.
    lag, relaxation
        For a lag of the first order of the readings, and for one relaxation behind the hysteresis, the parameter that
        is its time constant in s, as slow loops are fitted with both; empty for all others.
    rise
        For what happens at once, the parameter that is how long that took, as what takes long is a drift; empty for
        all others.
    origin
        For what comes again with the position, the parameters that are where it begins and how far it is to the next:
        a run that was not fitted has an offset of its own. Empty for all others.
    """

    name: eqx.AbstractClassVar[str]
    place: eqx.AbstractClassVar[Place]
    strength: eqx.AbstractClassVar[tuple[str, ...]]
    fingerprint: eqx.AbstractClassVar[str]
    confusions: eqx.AbstractClassVar[tuple[str, ...]]
    experiment: eqx.AbstractClassVar[str]
    source: eqx.AbstractClassVar[str]
    title: ClassVar[str] = ""
    form: ClassVar[str] = ""
    needs: ClassVar[tuple[str, ...]] = ()
    unless: ClassVar[tuple[str, ...]] = ()
    history: ClassVar[tuple[str, ...]] = ()
    ages: ClassVar[tuple[tuple[str, float], ...]] = ()
    moved: ClassVar[str] = ""
    fast: ClassVar[bool] = False
    per_run: ClassVar[bool] = False
    past: ClassVar[bool] = False
    finite: ClassVar[bool] = False
    repeats: ClassVar[bool] = False
    counted: ClassVar[tuple[str, ...]] = ()
    extremes: ClassVar[tuple[str, ...]] = ()
    lines_Hz: ClassVar[tuple[float, ...]] = ()
    tolerance: ClassVar[float] = 0.0
    phases: ClassVar[tuple[str, ...]] = ()
    view: ClassVar[View] = "voltage"
    column: ClassVar[str] = ""
    statistic: ClassVar[Statistic] = ""
    independent: ClassVar[bool] = False
    flexible: ClassVar[bool] = False
    universal: ClassVar[bool] = False
    held: ClassVar[str] = ""
    delay: ClassVar[str] = ""
    lag: ClassVar[str] = ""
    relaxation: ClassVar[str] = ""
    rise: ClassVar[str] = ""
    origin: ClassVar[tuple[str, ...]] = ()

    @classmethod
    @abc.abstractmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Effects of a size that would be seen, with which the data are asked whether there is one.

        Parameters
        ----------
        scales
            Of the records.
        inner
            The part that this effect is put around; None for one that stands by itself.

        Returns
        -------
        tuple of tuples
            Alternatives; each is a group of effects that are tried together, such as the cosine and sine of a line.
            Empty where the records cannot show it.
        """

    @abc.abstractmethod
    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Pass a signal on; `start` is the `Scene` of the record."""


EFFECTS: list[type[AbstractEffect]] = []
"""Every form of every effect, in the order of the files."""

_Effect = TypeVar("_Effect", bound=type[AbstractEffect])


def register(effect: _Effect) -> _Effect:
    """Make a form of an effect known."""
    EFFECTS.append(effect)
    return effect


def card_of(name: str) -> type[AbstractEffect]:
    """What is known of the effect of a name: its first form.

    Raises
    ------
    LookupError
        If no effect has that name.
    """
    for effect in EFFECTS:
        if effect.name == name:
            return effect
    raise LookupError(f"no effect is called {name!r}")


def host(effect: type[AbstractEffect], stage: Stage) -> int | None:
    """Place of the part that an effect is put around.

    That is one of the kind that its field `inner` is declared as; None for an effect that stands by itself.

    Raises
    ------
    ValueError
        If the stage has no such part.
    """
    field = effect.__dataclass_fields__.get("inner")
    if field is None:
        return None
    kinds = {"driver": Driver, "hysteresis": AbstractHysteresis, "mechanics": Mechanics}
    for place, part in enumerate(stage.parts):
        if isinstance(innermost(part), kinds[effect.place]):
            return place
    raise ValueError(f"{effect.name!r} acts on a {effect.place}, and this stage has none")


def extend(stage: Stage, effect: AbstractEffect) -> Stage:
    """Put an effect into a stage, where it belongs in the chain.

    Raises
    ------
    ValueError
        If the stage has it already and there is only one of its kind, or lacks the part that it acts on.
    """
    name = effect.name
    if name in stage.names and not effect.repeats:
        raise ValueError(f"the stage has the effect {name!r} already")
    count = sum(isinstance(part, AbstractEffect) and part.name == name for part in stage.parts)
    if count:
        name = f"{name}_{count + 1}"
    place = host(type(effect), stage)
    if place is not None:
        own = stage.names[place]
        # What was frozen of the part lies one level deeper now.
        deeper = tuple(
            path.replace(f"{own}.", f"{own}.inner.", 1) for path in stage.frozen if path.startswith(f"{own}.")
        )
        kept = stage.thaw(*(path for path in stage.frozen if path.startswith(f"{own}.")))
        return kept.swap(own, effect).freeze(*deeper)
    rank = PLACES.index(effect.place)
    for index, part in enumerate(stage.parts):
        if _rank(part) > rank or (effect.place == "driver" and isinstance(innermost(part), Driver)):
            return stage.insert(index, name, effect)
    return stage.append(name, effect)


def _rank(part: AbstractPart) -> float:
    """Place of a part among those of the effects: an effect comes behind what its place is named after."""
    inner = innermost(part)
    if isinstance(inner, AbstractHysteresis):
        return PLACES.index("hysteresis") - 0.5
    if isinstance(inner, Lag):
        return PLACES.index("hysteresis") + 0.5
    if isinstance(inner, Mechanics):
        # What acts on the mechanics from before is ahead of them.
        return PLACES.index("mechanics") + 0.5
    return PLACES.index(part.place) if isinstance(part, AbstractEffect) else -1 if part.gives == "V" else 3.5


def _times_of(time_s: Times, count: int) -> Float[Array, " t"]:
    """Times of the samples from the first on, shape `(t,)`, be it given or only the interval."""
    if time_s.ndim == 0:
        return time_s * jnp.arange(count, dtype=time_s.dtype)
    return time_s - time_s[0]


def _rate_of(time_s: Times, values: Float[Array, " t"]) -> Float[Array, " t"]:
    """Rate of change at the samples, by central differences, shape `(t,)`."""
    time = _times_of(time_s, values.shape[0])
    inner = (values[2:] - values[:-2]) / (time[2:] - time[:-2])
    ends = (values[1] - values[0]) / (time[1] - time[0]), (values[-1] - values[-2]) / (time[-1] - time[-2])
    return jnp.concatenate([ends[0][None], inner, ends[1][None]])


def _lowpass(time_s: Times, values: Float[Array, " t"], time_constant_s: Float[Array, ""]) -> Float[Array, " t"]:
    """Follow values with a lag of the first order, from rest at the first, shape `(t,)`."""
    return Driver(time_constant_s).system().respond(time_s, values, values[0], "first")
