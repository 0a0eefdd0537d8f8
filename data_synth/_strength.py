"""How strong an effect is: its size is searched until the readings differ by so much from those without it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from data_synth._effect import REGISTRY, Effect
from data_synth._engine import Acting, Player
from data_synth._errors import ScenarioError
from data_synth._table import nearest, read_arguments
from data_synth._types import FloatArray
from data_synth.effects import EFFECTS, OUTSIDE

_USUAL_RMS_PER_NOISE = 5.0
_TRIES = 14
_TOLERANCE = 0.01


@dataclass(frozen=True)
class EffectSettings:
    """One table `[[effects]]`: an effect by its `name`, its arguments, and how strong it is.

    Attributes
    ----------
    name
        One of `EFFECTS` or `OUTSIDE`.
    settings
        Arguments of its function that are stated; the others are drawn, or have their usual values.
    rms_per_noise
        How large the effect is: the root mean square of what it changes in the readings, each run's mean taken off,
        over the sensor's noise. 5 if neither it nor the effect's size is stated.
    at_most
        Whether an effect that cannot get so large within what physics allows is as large as it can be; otherwise it
        is refused.
    """

    name: str
    settings: dict[str, Any]
    rms_per_noise: float | None = None
    at_most: bool = True

    def __post_init__(self) -> None:
        """Raise ValueError for an effect that cannot be."""
        if self.name not in REGISTRY:
            raise ValueError(f"unknown effect {self.name!r}, {nearest(self.name, (*EFFECTS, *OUTSIDE))}")
        size = REGISTRY[self.name].size
        REGISTRY[self.name].require_sense(self.settings)
        if self.rms_per_noise is not None:
            if size in self.settings:
                raise ValueError(f"state {size} or rms_per_noise and not both")
            if not 0 <= self.rms_per_noise < math.inf:
                raise ValueError(f"rms_per_noise must be zero or positive, got {self.rms_per_noise}")

    @classmethod
    def from_table(cls, table: object, where: str) -> "EffectSettings":
        """Read a table, whose keys are the arguments of the effect's function besides the strength."""
        if not isinstance(table, dict):
            raise ScenarioError(f"{where} must be a table, got {table!r}")
        settings = dict(table)
        name = settings.pop("name", None)
        if name is None:
            raise ScenarioError(f"{where}: key 'name' is missing")
        if not isinstance(name, str) or name not in REGISTRY:
            raise ScenarioError(f"{where}: unknown effect {name!r}, {nearest(str(name), (*EFFECTS, *OUTSIDE))}")
        strength = {key: settings.pop(key) for key in ("rms_per_noise", "at_most") if key in settings}
        strength = read_arguments(_strength_keys, strength, where)
        entry = REGISTRY[name]
        arguments = read_arguments(entry.function, settings, where, entry.signals(), (entry.size,))
        try:
            return cls(name, arguments, **strength)
        except ValueError as error:
            raise ScenarioError(f"{where}: {error}") from error


def _strength_keys(*, rms_per_noise: float = 0.0, at_most: bool = True) -> None:
    """Stand for the keys of a table that say how strong an effect is."""


@dataclass(frozen=True)
class HiddenEffect:
    """The truth about an effect.

    Attributes
    ----------
    name
        One of `EFFECTS` or `OUTSIDE`, or of the second truth's own.
    parameters
        All arguments of its function.
    rms_um
        Root mean square of what it changes, alone, in the readings of the runs its strength was set by, in um: each
        run's mean is taken off.
    runs_rms_um
        The same for each run by its name, in um.
    capped
        Whether physics kept it from being as strong as asked for.
    """

    name: str
    parameters: dict[str, Any]
    rms_um: float
    runs_rms_um: dict[str, float]
    capped: bool = False


class Strength:
    """Runs, and their readings without any effect and without noise, to compare with.

    Parameters
    ----------
    players
        The runs by their names.
    counted
        Names of the runs that the strength is measured over.
    noise_um
        Standard deviation of the sensor's noise, in um.
    """

    def __init__(self, players: dict[str, Player], counted: Sequence[str], noise_um: float) -> None:
        self._players, self._counted, self._noise_um = players, counted, noise_um
        self._plain_um = {name: player.respond()[0] for name, player in players.items()}
        self._noises_um = {
            name: noise_um * np.random.default_rng(len(um)).standard_normal(len(um))
            for name, um in self._plain_um.items()
        }

    def change_um(self, name: str, acting: Acting) -> FloatArray:
        """What an effect changes in the readings of a run, shape (n,), in um, each with its mean taken off."""
        player, plain_um = self._players[name], self._plain_um[name]
        if acting.effect.place == "reading":  # a last digit is only random under noise
            noisy_um = plain_um + self._noises_um[name]
            change_um = player.read(noisy_um, [acting]) - noisy_um
        else:
            change_um = player.respond([acting])[0] - plain_um
        return change_um - change_um.mean()

    def set(self, settings: EffectSettings, seed: tuple[int, ...], where: str) -> tuple[Acting, HiddenEffect]:
        """Draw what is not stated of an effect, and find its size.

        Raises
        ------
        ScenarioError
            If there is no noise to count in, or the effect cannot be so strong and `at_most` is false.
        """
        effect = REGISTRY[settings.name]
        parameters = _draw(effect, settings.settings, np.random.default_rng((*seed, 1)))

        def sized(size: float) -> Acting:
            return Acting(effect, parameters | {effect.size: size}, (*seed, 2))

        # The size that is found was tried last, as a rule: its changes need not be simulated again.
        last: dict[str, FloatArray] = {}
        last_size = math.nan

        def rms_um(size: float) -> float:
            nonlocal last, last_size
            if size != last_size:
                last, last_size = {name: self.change_um(name, sized(size)) for name in self._counted}, size
            return _rms(np.concatenate(list(last.values())))

        capped = False
        if effect.size in settings.settings:
            size = float(settings.settings[effect.size])
        else:
            ratio = _USUAL_RMS_PER_NOISE if settings.rms_per_noise is None else settings.rms_per_noise
            if self._noise_um == 0:
                raise ScenarioError(f"{where}: rms_per_noise counts in noise_um of [sensor], which must be positive")
            size, capped = _find(rms_um, ratio * self._noise_um, effect)
            if capped and not settings.at_most:
                raise ScenarioError(
                    f"{where}: {effect.name} cannot be {ratio:g} times the noise within {effect.size} = "
                    f"{effect.limit:g}: lower rms_per_noise, or allow less with at_most = true"
                )
        acting, total_um = sized(size), rms_um(size)
        others = {name: self.change_um(name, acting) for name in self._players if name not in last}
        truth = HiddenEffect(
            name=effect.name,
            parameters=dict(acting.parameters),
            rms_um=total_um,
            runs_rms_um={name: _rms((last | others)[name]) for name in self._players},
            capped=capped,
        )
        return acting, truth


def _rms(signal: FloatArray) -> float:
    return float(np.sqrt(np.mean(signal**2)))


def _draw(effect: Effect, stated: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """All arguments but the size: each is drawn, whether it is stated or not, so that the others stay."""
    parameters = effect.defaults()
    for name, (low, *rest) in effect.draws.items():
        chance = float(rng.random())
        if isinstance(low, str):
            words = (low, *rest)
            parameters[name] = words[int(chance * len(words))]
        else:
            parameters[name] = float(low * (float(rest[0]) / low) ** chance)
    return parameters | stated


def _find(rms_um: Callable[[float], float], target_um: float, effect: Effect) -> tuple[float, bool]:
    """The size that gives the target (um), and whether it is the limit because even that gives less.

    The logarithm of the strength, counted from the usual size towards the limit, is moved by the secant rule within
    what is known to be too weak and too strong.
    """
    sign = 1.0 if effect.limit > effect.usual else -1.0
    top = abs(math.log(effect.limit / effect.usual))

    def size(x: float) -> float:
        return effect.usual * math.exp(sign * x)

    if target_um == 0:
        return size(-40.0), False
    weak, strong = -40.0, top
    x, slope = 0.0, 1.0
    tried: list[tuple[float, float]] = []
    for _ in range(_TRIES):
        found_um = rms_um(size(x))
        if abs(found_um / target_um - 1) < _TOLERANCE:
            return size(x), False
        if found_um < target_um:
            if x >= top:
                return size(top), True
            weak = x
        else:
            strong = x
        if found_um > 0:
            gap = math.log(target_um / found_um)
            if tried and x != tried[-1][0] and tried[-1][1] > 0:
                slope = min(max((math.log(found_um / tried[-1][1])) / (x - tried[-1][0]), 0.2), 10.0)
            tried.append((x, found_um))
            x = min(x + gap / slope, top)
            if not weak < x < strong and not (x == top and strong == top):
                x = (weak + strong) / 2 if weak > -40 else strong - 1
        else:
            x = min(x + 1, top) if strong == top else (x + strong) / 2
    best = min(tried, key=lambda pair: abs(math.log(pair[1] / target_um)), default=(top, 0.0))
    return size(best[0]), best[1] < target_um * 0.9
