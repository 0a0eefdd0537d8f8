"""The whole stage: a chain of parts from command voltage to measured displacement (Section 3.1)."""

import math
from collections.abc import Mapping
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from microid._linear import Hold, Times
from microid._param import ParameterInfo, _as_inexact, parameter_table, static
from microid._part import (
    AbstractHysteresis,
    AbstractLinear,
    AbstractPart,
    Scene,
    Signal,
    _imaginary,
    run_parts,
)
from microid._precision import _full_precision
from microid._refine import _lines, refined

# So many are exact to the last digit for any part; more take time and memory only.
_MOST_SUBSTEPS = 1000


def _maybe_inexact(value: Any) -> Any:
    return None if value is None else _as_inexact(value)


class Start(eqx.Module):
    """How a stage stood before the first sample of a record.

    Attributes
    ----------
    rest_V
        Command under which it was at rest; the record's first sample if None, so that nothing moves at first.
    memory
        State of the hysteresis before it came to `rest_V`, such as a `Staircase` for `Preisach`; the law's own
        default if None.
    """

    rest_V: Float[Array, ""] | None = eqx.field(converter=_maybe_inexact, default=None)
    memory: Any = None


class Stage(eqx.Module):
    """Parts in series, from command voltage to measured displacement, differentiable from end to end.

    Neighbouring linear parts are solved together, exactly for the hold of the command. A hysteresis sees the voltage
    at the samples only, exactly so far as no extreme falls between two of them. What follows it sees its output
    joined smoothly if an inertia comes before, and by lines otherwise: an error that falls with the fourth power of
    the interval (the third where a command in lines turns), or the square, and that `substeps` makes smaller. Behind
    a driver whose command is in steps the output settles within each interval as the driver does, which is off by the
    curvature of the hysteresis alone.

    Attributes
    ----------
    parts
        In the order of the signal.
    names
        One name per part, no two alike.
    hold
        How the command runs between samples: `"first"` in lines, `"zero"` in steps, `"smooth"` along
        band-limited curves, which have corners only where single samples show them.
    substeps
        Into how many steps every interval is divided.
    frozen
        Names of parts, or of parameters such as `"driver.gain"`, that a fit must not move; see `free`.
    """

    parts: tuple[AbstractPart, ...]
    names: tuple[str, ...] = static()
    hold: Hold = eqx.field(static=True, default="first")
    substeps: int = eqx.field(static=True, default=1)
    frozen: tuple[str, ...] = eqx.field(static=True, default=())

    @classmethod
    def of(cls, *, hold: Hold = "first", substeps: int = 1, **parts: AbstractPart) -> Self:
        """Chain parts in the order in which they are named: `Stage.of(driver=..., hysteresis=..., mechanics=...)`.

        Raises
        ------
        ValueError
            See `Stage`: if the chain does not run from a voltage to a displacement.
        """
        return cls(tuple(parts.values()), tuple(parts), hold, substeps)

    def __check_init__(self) -> None:
        """Refuse chains that do not fit together."""
        if len(self.names) != len(self.parts) or len(set(self.names)) != len(self.names) or not self.parts:
            raise ValueError(f"a stage needs one part or more and one name for each, no two alike, got {self.names}")
        if self.hold not in ("first", "zero", "smooth") or not 1 <= self.substeps <= _MOST_SUBSTEPS:
            raise ValueError(
                f"hold must be 'first', 'zero' or 'smooth' and substeps 1 to {_MOST_SUBSTEPS}, got "
                f"{self.hold!r} and {self.substeps}"
            )
        for name, part in zip(self.names, self.parts, strict=True):
            if not isinstance(part, AbstractPart):
                raise ValueError(f"{name!r} must be a part of a stage, got a {type(part).__name__}")
        unit, giver = "V", "the command"
        for name, part in zip(self.names, self.parts, strict=True):
            if part.takes != unit:
                raise ValueError(f"{name!r} takes {part.takes} but {giver} gives {unit}: change their order")
            unit, giver = part.gives, repr(name)
        if unit != "um":
            raise ValueError(f"a stage must give a displacement in um, but {giver} gives {unit}: append a part")
        paths = [self.named(info.path) for info in parameter_table(self)] if self.frozen else []
        for name in self.frozen:
            if name not in self.names and not any(_below(path, name) for path in paths):
                raise ValueError(f"there is nothing called {name!r} to freeze: choose some of {', '.join(paths)}")

    @_full_precision
    def __call__(
        self,
        time_s: Times,
        voltage_V: Float[Array, " t"],
        start: Start | None = None,
        columns: Mapping[str, Float[Array, " t"]] | None = None,
    ) -> Float[Array, " t"]:
        """Respond to a command.

        Parameters
        ----------
        time_s
            Increasing times, shape `(t,)`, evenly spaced or not; or the one interval between all samples, shape `()`,
            with which derivatives are faster.
        voltage_V
            Command, shape `(t,)`.
        start
            How the stage stood before; by default at rest under the first sample.
        columns
            What else was recorded, by name, each of shape `(t,)`: some effects need a `temperature_degC`.

        Returns
        -------
        Array
            Measured displacement in um, shape `(t,)`.
        """
        start = Start() if start is None else start
        time, voltage = refined(_as_inexact(time_s), _as_inexact(voltage_V), self.substeps, self.hold)
        before = voltage[0] if start.rest_V is None else start.rest_V.astype(voltage.dtype)
        signal = Signal(voltage, before, self.hold)
        beside = {name: _lines(_as_inexact(values), self.substeps) for name, values in (columns or {}).items()}
        scene = Scene(signal, beside, start.memory)
        signal = run_parts(self.parts, time, signal, scene)
        return signal.values[:: self.substeps]

    def with_substeps(self, substeps: int) -> Self:
        """Return a stage that divides every interval into so many steps."""
        return type(self)(self.parts, self.names, self.hold, substeps, self.frozen)

    def with_hold(self, hold: Hold) -> Self:
        """Return a stage whose command runs in another way between its samples."""
        return type(self)(self.parts, self.names, hold, self.substeps, self.frozen)

    def __getitem__(self, name: str) -> AbstractPart:
        return self.parts[self._place(name)]

    def _place(self, name: str) -> int:
        if name not in self.names:
            raise ValueError(f"there is no part {name!r}: choose one of {', '.join(self.names)}")
        return self.names.index(name)

    def _with(self, parts: dict[str, AbstractPart]) -> Self:
        frozen = tuple(name for name in self.frozen if name.partition(".")[0] in parts)
        return type(self)(tuple(parts.values()), tuple(parts), self.hold, self.substeps, frozen)

    def swap(self, name: str, part: AbstractPart) -> Self:
        """Return a stage with another part under the same name."""
        self._place(name)
        return self._with(dict(zip(self.names, self.parts, strict=True)) | {name: part})

    def append(self, name: str, part: AbstractPart) -> Self:
        """Return a stage with one more part at its end."""
        return self.insert(len(self.parts), name, part)

    def insert(self, place: int, name: str, part: AbstractPart) -> Self:
        """Return a stage with one more part, before the one at a place."""
        if name in self.names:
            raise ValueError(f"there is a part {name!r} already: choose another name, or swap it")
        items = list(zip(self.names, self.parts, strict=True))
        return self._with(dict([*items[:place], (name, part), *items[place:]]))

    def without(self, name: str) -> Self:
        """Return a stage that lacks a part."""
        self._place(name)
        items = zip(self.names, self.parts, strict=True)
        return self._with({other: part for other, part in items if other != name})

    def freeze(self, *names: str) -> Self:
        """Return a stage of which a fit must not move these parts or parameters, such as `"driver.gain"`."""
        return type(self)(self.parts, self.names, self.hold, self.substeps, tuple(dict.fromkeys(self.frozen + names)))

    def thaw(self, *names: str) -> Self:
        """Return a stage of which a fit may move them again."""
        frozen = tuple(name for name in self.frozen if name not in names)
        return type(self)(self.parts, self.names, self.hold, self.substeps, frozen)

    def free(self, info: ParameterInfo) -> bool:
        """Whether a parameter may be moved: `Coordinates(stage, stage.free)` leaves out what is frozen."""
        path = self.named(info.path)
        return not any(_below(path, name) for name in self.frozen)

    def named(self, path: str) -> str:
        """Path of a parameter with the part's name, `driver.gain` for `parts[0].gain`."""
        place, _, rest = path.removeprefix("parts[").partition("]")
        return f"{self.names[int(place)]}{rest}"

    def transfer(
        self, s_rad_per_s: Complex[Array, "..."], slope_um_per_V: Float[Array, ""] | float | None = None
    ) -> Complex[Array, "..."]:
        """Transfer function in um/V at complex frequencies: Eq. 15 and 17, and their product 18 as corrected.

        Parameters
        ----------
        s_rad_per_s
            Complex frequencies.
        slope_um_per_V
            What stands for a hysteresis: the slope of its output for small voltages.

        Raises
        ------
        ValueError
            If there is a hysteresis and no slope, or a part that has no transfer function.
        """
        s = jnp.asarray(s_rad_per_s)
        total = jnp.ones_like(s)
        for name, part in zip(self.names, self.parts, strict=True):
            if isinstance(part, AbstractLinear):
                total = total * part.transfer(s)
            elif isinstance(part, AbstractHysteresis) and slope_um_per_V is not None:
                total = total * jnp.asarray(slope_um_per_V).astype(s.dtype)
            else:
                raise ValueError(f"{name!r} has no transfer function: give the slope_um_per_V that stands for it")
        return total

    def frequency_response(
        self, frequency_Hz: Float[Array, "..."], slope_um_per_V: Float[Array, ""] | float | None = None
    ) -> Complex[Array, "..."]:
        """Transfer function along the imaginary axis, in um/V; see `transfer`."""
        return self.transfer(_imaginary(frequency_Hz), slope_um_per_V)

    @property
    def poles_rad_per_s(self) -> Complex[Array, " n"]:
        """Poles of all linear parts."""
        return jnp.concatenate([part.poles_rad_per_s for part in self.parts if isinstance(part, AbstractLinear)])

    @property
    def static_gain(self) -> Float[Array, ""]:
        """Product of the gains of the linear parts; um/V if there is no hysteresis."""
        gains = (part.static_gain for part in self.parts if isinstance(part, AbstractLinear))
        return math.prod(gains, start=jnp.asarray(1.0))


def _below(path: str, name: str) -> bool:
    return path == name or path.startswith((f"{name}.", f"{name}["))
